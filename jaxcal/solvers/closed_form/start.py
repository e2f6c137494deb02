"""The closed form of Eq. 7 as the start of the other methods. Numpy only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxcal.data.problem import Problem
from jaxcal.model.unknowns import Blocks
from jaxcal.runtime.array_types import Bool, Float, HeldArray
from jaxcal.runtime.arrays import array_tree, assembled
from jaxcal.solvers.closed_form.single import solve_problem


@array_tree
class Start:
    """The start of methods that begin at the conventional fit: Eq. 7's minimum of one problem.

    Attributes:
        rotation: of X.
        translation: of X, mm.
        point: the target in the tracker's frame, mm.
        scale: factors on the problem's [lateral, axial] spacing.
        sound_speed: factor on the nominal one.
        searched: the minimum is not proved to be the only one; descents from many rotations found
            it.
    """

    rotation: Float[HeldArray, "*batch 3 3"]
    translation: Float[HeldArray, "*batch 3"]
    point: Float[HeldArray, "*batch 3"]
    scale: Float[HeldArray, "*batch 2"]
    sound_speed: Float[HeldArray, "*batch"]
    searched: Bool[HeldArray, "*batch"]


def closed_form_start(problem: Problem, blocks: Blocks) -> Start:
    """The start of a method, from the closed form of Eq. 7.

    Args:
        problem: one problem with concrete, finite values and at least 4 used images.
        blocks: the free unknowns; those without a closed form begin at their nominal values.

    Returns:
        The start in the problem's own precision.
    """
    known = replace(problem, spacing_known=True, channels=None)
    found = solve_problem(known, ("scale",) if "scale" in blocks else ())
    scale = np.ones(2)
    if found.scale_mm_per_px is not None:
        scale = np.asarray(found.scale_mm_per_px) / np.asarray(problem.spacing)
    parts = {
        "rotation": found.image_to_probe[:3, :3],
        "translation": found.image_to_probe[:3, 3],
        "point": found.point_mm,
        "scale": scale,
        "sound_speed": np.asarray(found.sound_speed_factor),
    }
    dtype = np.asarray(problem.mask).dtype
    parts = {name: np.asarray(value, dtype) for name, value in parts.items()}
    parts["searched"] = np.asarray(not (found.certified and found.unique))
    return assembled(Start, parts)
