"""Which poses: an experiment that reaches the wanted error with few images.

With S the covariance of the unknowns (X's right perturbation, the target), an image at a pose adds
the information G'G of its whitened 3x9 Jacobian G, and what a lab asks for is linear in S: the
squared target registration error and the squared reconstruction precision are traces tr(W S).

constraints.py  where a pose may be: image region, cone, turn, box, reach
noise.py        SDs as functions of where the target is in the image
information.py  G of a pose; what a calibration already knows
criteria.py     W of TRE and RP; the gain of a pose in closed form
candidates.py   poses to choose from: of a probe and a region, or around a recording
greedy.py       one pose after the other; exchange.py: each of them against all others
polish.py       off the grid, along the gradient on SE(3), inside the constraints
planning.py     plan, next_poses
bound.py        what no choice among the candidates goes below
predict.py      what a plan promises; images_to
words.py        a pose for a person who holds the probe
figure.py       the plan, and how many images are needed
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
    from jaxcal.design.criteria import gain as gain
    from jaxcal.design.figure import plan_figure as plan_figure
    from jaxcal.design.greedy import Rules as Rules
    from jaxcal.design.information import Model as Model
    from jaxcal.design.information import known_information as known_information
    from jaxcal.design.noise import Noise as Noise
    from jaxcal.design.planning import Plan as Plan
    from jaxcal.design.planning import next_poses as next_poses
    from jaxcal.design.planning import plan as plan
    from jaxcal.design.predict import images_to as images_to
    from jaxcal.design.words import pose_in_words as pose_in_words

_HOME = {
    "Candidates": "candidates",
    "Constraints": "constraints",
    "Model": "information",
    "Noise": "noise",
    "Plan": "planning",
    "Region": "constraints",
    "Rules": "greedy",
    "candidates_around": "candidates",
    "gain": "criteria",
    "images_to": "predict",
    "known_information": "information",
    "least_error": "bound",
    "make_candidates": "candidates",
    "next_poses": "planning",
    "plan": "planning",
    "plan_figure": "figure",
    "pose_in_words": "words",
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'jaxcal.design' has no attribute {name!r}")
    return getattr(importlib.import_module(f"jaxcal.design.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*_HOME]
