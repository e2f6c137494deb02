"""The parts of the engine, for those who bring a solver or a problem of their own.

A calibration in jaxcal is least squares: unknowns that step on a manifold (:class:`Parameters`,
:func:`retract`), residuals (:func:`measurement_residual`, :func:`circle_residual`,
:func:`channel_residual`), a minimiser, and the derivative of the minimum by the implicit function
theorem. Every method begins at :func:`initial_fit`.

For a batch of problems there are :class:`ImagePlanes` (the data), :class:`Iterate` (the unknowns),
an :class:`Observation` (:class:`Points`, :class:`OwnCovariances`, :class:`TrackedPoints`,
:class:`InPlane`, :class:`BoundedOffsets`, :class:`ChannelDistances`, or one of your own),
:func:`accumulate` (the :class:`NormalEquations`, in one pass over the images), :func:`minimise`
(which returns a :class:`Minimum`) and :func:`implicit_tangent`. A number of every image is a plane
(batch, images); the batch axis of all other arrays is the last.

:class:`LevenbergMarquardt` is the same loop behind optimistix's interface, for residuals of any
shape. :func:`arrow_least_squares` is the loop for problems with shared unknowns and one local
unknown for each row.

Unlike :func:`jaxcal.calibrate`, these functions compute in the caller's modes: switch 64 bits on
(``jax.enable_x64``) before making a problem's arrays. ``docs/how-to/own-solver.md`` has worked
examples. Names here are public, and provisional until version 1.0: a change is announced by a
DeprecationWarning for one minor version.
"""

from __future__ import annotations

from functools import partial

import jax

from jaxcal import InputError
from jaxcal.data.problem import Problem
from jaxcal.model.batch import ImagePlanes, Iterate
from jaxcal.model.observations import (
    BoundedOffsets,
    ChannelDistances,
    Component,
    FurtherUnknowns,
    InPlane,
    LocalUnknown,
    MediumPrior,
    Observation,
    OwnCovariances,
    Points,
    TrackedPoints,
)
from jaxcal.model.parameters import Parameters, retract
from jaxcal.model.residuals import (
    channel_residual,
    circle_residual,
    measured_points,
    measurement_residual,
    target_in_image,
)
from jaxcal.model.unknowns import RIGID, Blocks, count_unknowns, free_unknowns
from jaxcal.solvers.general import LevenbergMarquardt, arrow_least_squares
from jaxcal.solvers.implicit import implicit_tangent
from jaxcal.solvers.levenberg_marquardt import Minimum, minimise
from jaxcal.solvers.normal_equations import NormalEquations, accumulate
from jaxcal.solvers.start import conventional

__all__ = [
    "RIGID",
    "Blocks",
    "BoundedOffsets",
    "ChannelDistances",
    "Component",
    "FurtherUnknowns",
    "ImagePlanes",
    "InPlane",
    "Iterate",
    "LevenbergMarquardt",
    "LocalUnknown",
    "MediumPrior",
    "Minimum",
    "NormalEquations",
    "Observation",
    "OwnCovariances",
    "Parameters",
    "Points",
    "Problem",
    "TrackedPoints",
    "accumulate",
    "arrow_least_squares",
    "channel_residual",
    "circle_residual",
    "count_unknowns",
    "implicit_tangent",
    "initial_fit",
    "measured_points",
    "measurement_residual",
    "minimise",
    "retract",
    "target_in_image",
]


def initial_fit(problem: Problem, blocks: Blocks = RIGID) -> Parameters:
    """The conventional fit (Eq. 7) from the closed form, at which every method of jaxcal begins.

    Args:
        problem: one problem (vmap for a batch).
        blocks: the free unknowns: :data:`RIGID`, then ``scale``, ``sound-speed`` and ``delay``, as
            far as they are free.

    Raises:
        InputError: something else than one problem, pixels of an unknown size that is not free, or
            other unknowns.
    """
    blocks = free_unknowns(blocks)
    if not isinstance(problem, Problem) or problem.batch_shape:
        raise InputError(
            "initial_fit takes one problem: jaxcal.Problem.from_recording makes one, "
            "jax.vmap(initial_fit) takes a batch"
        )
    if problem.pixels and not problem.spacing_known and "scale" not in blocks:
        raise InputError(
            "the pixels have no spacing_mm: give it (jaxcal import --spacing), or free the scale: "
            'blocks (*backend.RIGID, "scale")'
        )
    return _initial_fit(problem, blocks)


# Compiled as a whole: step by step it would be several hundred programs.
@partial(jax.jit, static_argnums=1)
def _initial_fit(problem: Problem, blocks: Blocks) -> Parameters:
    images = ImagePlanes.of(jax.tree.map(lambda leaf: leaf[None], problem))
    found = conventional(images, blocks).iterate.parameters()
    return jax.tree.map(lambda leaf: leaf[0], found)
