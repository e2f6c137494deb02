"""The engine's pieces, for those who bring a solver or a problem of their own.

A calibration of jaxcal is least squares: unknowns that step on a manifold (:class:`Parameters`,
:func:`retract`), residuals of an observation model (:class:`InPlane`, :class:`Gaussian`,
:class:`Bounded`, :class:`ChannelGaussian`, or :func:`measurement_residual` and
:func:`circle_residual` by themselves), a minimiser of them (:func:`minimise`), and the derivative
of the minimum by the implicit function theorem (:func:`implicit_tangent`). :func:`initial_fit` is
where every method begins. :func:`arrow_least_squares` is the same Levenberg-Marquardt method for
other people's problems with shared unknowns and one local unknown a row.

Unlike :func:`jaxcal.calibrate`, these functions compute in the caller's modes: switch 64 bits on
(``jax.enable_x64``) before making a problem's arrays. ``docs/api.md`` has worked examples. Names
here are public, and provisional until version 1.0: a change is announced by a DeprecationWarning
for one minor version.
"""

from __future__ import annotations

from jaxcal.model.parameters import RIGID, Blocks, Parameters, retract, size
from jaxcal.model.priors import AbstractPrior, Bounded, ChannelGaussian, Gaussian, InPlane
from jaxcal.model.residuals import (
    circle_residual,
    measured_points,
    measurement_residual,
    target_in_image,
)
from jaxcal.problem import Problem
from jaxcal.solvers.conventional import from_scratch
from jaxcal.solvers.implicit import optimum as implicit_tangent
from jaxcal.solvers.least_squares import Fit, Unknowns, arrow_least_squares, minimise

__all__ = [
    "RIGID",
    "AbstractPrior",
    "Blocks",
    "Bounded",
    "ChannelGaussian",
    "Fit",
    "Gaussian",
    "InPlane",
    "Parameters",
    "Unknowns",
    "arrow_least_squares",
    "circle_residual",
    "implicit_tangent",
    "initial_fit",
    "measured_points",
    "measurement_residual",
    "minimise",
    "retract",
    "size",
    "target_in_image",
]


def initial_fit(problem: Problem, blocks: Blocks = RIGID) -> Parameters:
    """The conventional fit (Eq. 7) from the closed form: where every method of jaxcal begins.

    Args:
        problem: one problem (vmap for a batch).
        blocks: the free unknowns.
    """
    return from_scratch(problem, blocks).fit.parameters
