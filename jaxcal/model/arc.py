"""Offsets within a bound: the point of an image's circle, and whether it rests on the bound.

The target lies on the circle p(y) = (lateral, y, sqrt(r^2 - y^2)) of Eq. 5, and a bound on |y|
leaves an arc of it. The same functions serve the compiled answer (jax.numpy) and its uncertainty
(numpy).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from jaxcal.model.thresholds import LARGEST_ELEVATION
from jaxcal.runtime.array_types import Bool, Float
from jaxcal.runtime.arrays import array_module

AT_BOUND = 1e-12
"""An offset within this fraction of its bound counts as on it; the difference is rounding."""


def axial_on_circle(
    distance: Float[Any, "*batch n"], y: Float[Any, "*batch n"]
) -> Float[Any, "*batch n"]:
    """sqrt(r^2 - y^2), mm; where y exceeds the range r, a millionth of r."""
    xp = array_module(distance, y)
    return xp.sqrt(xp.maximum(distance**2 - y**2, (1e-6 * distance) ** 2))


def arc_limit(bound: Any, distance: Float[Any, "*batch n"]) -> Float[Any, "*batch n"]:
    """The largest |y| on the arc, mm: the bound, but at most LARGEST_ELEVATION of the range."""
    return array_module(bound, distance).minimum(bound, LARGEST_ELEVATION * abs(distance))


class OnArc(NamedTuple):
    """Every image's point p(y).

    Attributes:
        axial: of p(y), mm.
        slope: by how much it falls with y.
        force: half the derivative of |q - p(y)|^2 by y, mm; q is the target as predicted.
        limit: the largest |y| within the bound, mm.
        resting: whether y rests on its bound, where the cost falls outwards.
    """

    axial: Float[Any, "*batch n"]
    slope: Float[Any, "*batch n"]
    force: Float[Any, "*batch n"]
    limit: Float[Any, "*batch n"]
    resting: Bool[Any, "*batch n"]

    @classmethod
    def at(
        cls,
        y: Float[Any, "*batch n"],
        target: tuple[Float[Any, "*batch n"], Float[Any, "*batch n"]],
        distance: Float[Any, "*batch n"],
        bound: Any,
    ) -> OnArc:
        """The points at offsets y (traceable).

        Args:
            y: mm.
            target: elevational and axial coordinate of q, mm.
            distance: measured ranges r, mm.
            bound: on the size of y, mm.
        """
        xp = array_module(y, distance)
        axial = axial_on_circle(distance, y)
        slope = y / axial
        force = slope * (target[1] - axial) - (target[0] - y)
        limit = arc_limit(bound, distance)
        resting = (xp.abs(y) >= (1 - AT_BOUND) * limit) & (xp.sign(y) * force <= 0)
        return cls(axial, slope, force, limit, resting)
