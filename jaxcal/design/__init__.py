"""Design of an experiment: choose poses that reach the wanted error with few images.

Let S be the covariance of the unknowns (X's right perturbation, the target). An image at a pose
adds the information G'G of its whitened 3x9 Jacobian G. The quantities of interest are linear in S:
the squared target registration error and the squared reconstruction precision are traces tr(W S).

constraints.py  where a pose may be: image region, cone, turn, box, reach
noise.py        SDs as functions of where the target is in the image
information.py  G of a pose; the information of a calibration
names.py        the criteria by name
criteria.py     W of TRE and RP; the gain of a pose in closed form; predicted errors
candidates.py   poses to choose from: for a probe and a region, or around a recording
greedy.py       chooses one pose after the other, then exchanges each for the best candidate
polish.py       moves poses along the gradient on SE(3), inside the constraints
planning.py     plan, next_poses
bound.py        an error that no choice among the candidates can go below
count.py        images_to: how many images a wanted error takes; plan_until: so many poses
simulated.py    errors of many simulated calibrations at given poses
words.py        a pose in words, for a person who holds the probe
figure.py       figure of the plan and of how many images are needed
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxcal.design.bound import least_error as least_error
    from jaxcal.design.candidates import Candidates as Candidates
    from jaxcal.design.candidates import candidates_around as candidates_around
    from jaxcal.design.candidates import make_candidates as make_candidates
    from jaxcal.design.constraints import Constraints as Constraints
    from jaxcal.design.constraints import Region as Region
    from jaxcal.design.count import images_to as images_to
    from jaxcal.design.criteria import gain as gain
    from jaxcal.design.criteria import tre_weight as tre_weight
    from jaxcal.design.figure import plan_figure as plan_figure
    from jaxcal.design.greedy import Rules as Rules
    from jaxcal.design.information import Model as Model
    from jaxcal.design.information import known_information as known_information
    from jaxcal.design.noise import Noise as Noise
    from jaxcal.design.planning import Plan as Plan
    from jaxcal.design.planning import next_poses as next_poses
    from jaxcal.design.planning import plan as plan
    from jaxcal.design.simulated import SimulatedErrors as SimulatedErrors
    from jaxcal.design.simulated import simulate_errors as simulate_errors
    from jaxcal.design.words import pose_in_words as pose_in_words

_HOME = {
    "Candidates": "candidates",
    "Constraints": "constraints",
    "Model": "information",
    "Noise": "noise",
    "Plan": "planning",
    "Region": "constraints",
    "Rules": "greedy",
    "SimulatedErrors": "simulated",
    "candidates_around": "candidates",
    "gain": "criteria",
    "images_to": "count",
    "known_information": "information",
    "least_error": "bound",
    "make_candidates": "candidates",
    "next_poses": "planning",
    "plan": "planning",
    "plan_figure": "figure",
    "pose_in_words": "words",
    "simulate_errors": "simulated",
    "tre_weight": "criteria",
}

__all__ = [*_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'jaxcal.design' has no attribute {name!r}")
    return getattr(importlib.import_module(f"jaxcal.design.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*_HOME]
