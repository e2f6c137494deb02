"""The unknowns other than the offsets: a table with a row for each. Needs no JAX.

X and the target are those of Eq. 7. *Further* unknowns convert what was measured to mm:
:func:`measured` and :func:`predicted_distance` define how, in arithmetic that numpy, JAX and
complex numbers share. All other code that depends on an unknown (steps, priors, derivatives, names,
words) reads this table. A new unknown needs a row, a line in :func:`measured`, a field in
:class:`jaxcal.model.parameters.Parameters`, and, where it moves image points, a column in
:mod:`jaxcal.model.image_points`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from jaxcal import InputError
from jaxcal.runtime.messages import shown

Blocks = tuple[str, ...]
"""Names of free unknowns, in the table's order; X and the target come first."""

Values = Mapping[str, Sequence[Any]]
"""Further unknowns that are free, by name: one array for each component."""


@dataclass(frozen=True)
class Unknown:
    """One row of the table.

    Attributes:
        name: as a caller asks for it (``estimate``).
        tangents: names of its components in records, with the unit of their steps.
        step: how a step moves a component: ``frame`` along and about the axes of X, ``add``
            in its own unit, ``factor`` by its logarithm, which keeps it positive.
        lever: whether a step has to be multiplied by the lever arm to be mm at the target.
        in_image: whether the place of an image point depends on it.
        words: one component in words, with a place for the axis.
        axes: the words for that place.
        oblique: several components in words; empty for a single one.
        prior_sd: SD of its Gaussian prior about the nominal value where the caller gives none;
            None: it has no prior.
        prior_unit: the unit of that SD.
        per_unit: from the nominal sound speed (m/s) to the step that is one such unit.
    """

    name: str
    tangents: tuple[str, ...]
    step: Literal["frame", "add", "factor"]
    lever: bool
    in_image: bool
    words: str
    axes: tuple[str, ...] = ("",)
    oblique: str = ""
    prior_sd: float | None = None
    prior_unit: str = ""
    per_unit: Callable[[Any], Any] = lambda speed: 1.0

    @property
    def size(self) -> int:
        """Number of its components."""
        return len(self.tangents)

    @property
    def field(self) -> str:
        """Its name as a name in Python."""
        return self.name.replace("-", "_")

    @property
    def prior_name(self) -> str:
        """The argument by which a caller gives the SD of its prior."""
        return f"{self.field}_sd"

    @property
    def nominal(self) -> float:
        """Its value where it is not free."""
        return 1.0 if self.step == "factor" else 0.0


SOUND_SPEED_SD_M_S = 20.0
"""Prior SD of the sound speed about its nominal value, m/s: some seven kelvin of water."""

DELAY_SD_S = 1e-6
"""Prior SD of the electronic delay about its nominal value, s."""

_IMAGE_AXES = ("lateral", "elevational", "axial")

TABLE = {
    row.name: row
    for row in (
        Unknown(
            "translation",
            ("v_lateral_mm", "v_elevational_mm", "v_axial_mm"),
            "frame",
            lever=False,
            in_image=True,
            words="translation along the {} axis",
            axes=_IMAGE_AXES,
            oblique="translation along an oblique axis (lateral {:.2f}, elevational {:.2f}, "
            "axial {:.2f})",
        ),
        Unknown(
            "rotation",
            ("omega_lateral_rad", "omega_elevational_rad", "omega_axial_rad"),
            "frame",
            lever=True,
            in_image=True,
            words="rotation about the {} axis",
            axes=_IMAGE_AXES,
            oblique="rotation about an oblique axis (lateral {:.2f}, elevational {:.2f}, "
            "axial {:.2f})",
        ),
        Unknown(
            "point",
            ("point_x_mm", "point_y_mm", "point_z_mm"),
            "add",
            lever=False,
            in_image=False,
            words="target position along the tracker's {}",
            axes=("x", "y", "z"),
            oblique="target position along the tracker's ({:.2f}, {:.2f}, {:.2f})",
        ),
        Unknown(
            "scale",
            ("log_scale_lateral", "log_scale_axial"),
            "factor",
            lever=True,
            in_image=True,
            words="{} pixel scale",
            axes=("lateral", "axial"),
            oblique="both pixel scales ({:.2f}, {:.2f})",
        ),
        Unknown(
            "sound-speed",
            ("log_sound_speed",),
            "factor",
            lever=True,
            in_image=True,
            words="sound speed{}",
            prior_sd=SOUND_SPEED_SD_M_S,
            prior_unit="m/s",
            per_unit=lambda speed: 1 / speed,
        ),
        Unknown(
            "delay",
            ("delay_mm",),
            "add",
            lever=False,
            in_image=True,
            words="delay{}",
            prior_sd=DELAY_SD_S,
            prior_unit="s",
            per_unit=lambda speed: 1e3 * speed,
        ),
    )
}
"""The rows are in the order of a step's components."""

RIGID: Blocks = ("translation", "rotation", "point")
"""The unknowns of Eq. 7: X and the target."""

RIGID_UNKNOWNS = sum(TABLE[name].size for name in RIGID)
"""Number of scalar unknowns in :data:`RIGID`; further unknowns follow them."""

FURTHER: Blocks = tuple(name for name in TABLE if name not in RIGID)
"""Further unknowns: what a caller may ask for beside X and the target."""

TINY = 1e-20
"""A complex step: its square is negligible in double precision."""

MEDIUM = ("sound-speed", "delay")
"""The unknowns between a time of flight and a distance."""


def measured(lateral: Any, axial: Any, face: Any, values: Values) -> tuple[Any, Any]:
    """Lateral position and range of a point, mm, after the further unknowns.

    Pixels are multiplied by their scale. A range is really a time of flight, so it depends on sound
    speed and delay; lateral positions come from the positions of the elements.

    Args:
        lateral: at the nominal scale, mm.
        axial: range from pixel row 0 at the nominal scale, mm.
        face: range of pixel row 0, mm.
        values: free unknowns: factors on the lateral and axial scale, factor on the sound speed,
            delay in mm at the nominal speed.
    """
    if "scale" in values:
        across, along = values["scale"]
        lateral, axial = lateral * across, axial * along
    distance = axial + face
    if "delay" in values:
        distance = distance - values["delay"][0]
    if "sound-speed" in values:
        distance = distance * values["sound-speed"][0]
    return lateral, distance


def predicted_distance(distance: Any, values: Values) -> Any:
    """The distance that an element would measure of a target at ``distance``, mm.

    The inverse of what :func:`measured` does to a range: a distance at the nominal sound speed.
    """
    if "sound-speed" in values:
        distance = distance / values["sound-speed"][0]
    if "delay" in values:
        distance = distance + values["delay"][0]
    return distance


def stepped(name: str, value: Any, step: Any, exp: Callable[[Any], Any]) -> Any:
    """A component of a further unknown after a step, with the exponential of numpy or of JAX."""
    return value * exp(step) if TABLE[name].step == "factor" else value + step


def step_between(name: str, here: Any, there: Any, log: Callable[[Any], Any]) -> Any:
    """The step that :func:`stepped` takes from one value to another."""
    return log(there / here) if TABLE[name].step == "factor" else there - here


def further_derivatives(
    function: Callable[[Values], Sequence[Any]], values: Values, blocks: Blocks
) -> list[tuple[int, list[np.ndarray]]]:
    """Derivatives of real functions by the steps of the free further unknowns, in numpy.

    They come from a complex step, which has practically no rounding error (Squire and Trapp, SIAM
    Review 40, 1998). The function must be analytic, as :func:`measured` and
    :func:`predicted_distance` are.

    Args:
        function: of the values; a sequence of arrays.
        values: where the derivatives are wanted; what is missing is nominal.
        blocks: the free unknowns.

    Returns:
        For each tangent its place among those of the blocks, and the derivatives.
    """
    found = []
    for name in FURTHER:
        if name not in blocks:
            continue
        first, row = block_slice(blocks, name).start, TABLE[name]
        here = values.get(name, [np.array(row.nominal)] * row.size)
        for k in range(row.size):
            moved = list(here)
            moved[k] = stepped(name, here[k], 1j * TINY, np.exp)
            at = function({**values, name: moved})
            found.append((first + k, [np.imag(array) / TINY for array in at]))
    return found


def unknown_names(estimate: Any) -> tuple[str, ...]:
    """Names of further unknowns as a tuple; a text may hold one name or several with commas.

    Raises:
        InputError: something else than names.
    """
    if isinstance(estimate, str):
        return tuple(name.strip() for name in estimate.split(","))
    if estimate is None:
        return ()
    names = tuple(estimate) if isinstance(estimate, Iterable) else (estimate,)
    if not all(isinstance(name, str) for name in names):
        raise InputError(f"estimate must be names of unknowns, not {shown(estimate)}")
    return names


def count_unknowns(blocks: Blocks) -> int:
    """Number of scalar unknowns in the given blocks.

    Raises:
        InputError: no such unknown.
    """
    for name in blocks:
        if name not in TABLE:
            raise InputError(f"{name!r} is no unknown: choose from {', '.join(TABLE)}")
    return sum(TABLE[name].size for name in blocks)


def free_unknowns(blocks: Any) -> Blocks:
    """The free unknowns of a solve: those of Eq. 7, then further ones in the table's order.

    Raises:
        InputError: other names, or another order.
    """
    names = unknown_names(blocks)
    count_unknowns(names)
    wanted = RIGID + tuple(name for name in FURTHER if name in names)
    if names != wanted:
        raise InputError(f"the free unknowns must be {wanted}, in this order, not {names}")
    return names


def block_slice(blocks: Blocks, name: str) -> slice:
    """Where a block lies in the tangent vector of the given blocks."""
    start = count_unknowns(blocks[: blocks.index(name)])
    return slice(start, start + TABLE[name].size)


def further_slice(blocks: Blocks, name: str) -> slice:
    """Where a free further unknown lies among all the free further unknowns of the blocks."""
    at = block_slice(blocks, name)
    return slice(at.start - RIGID_UNKNOWNS, at.stop - RIGID_UNKNOWNS)


def with_prior(blocks: Blocks) -> Blocks:
    """Those of the blocks that have a prior, in the table's order."""
    return tuple(name for name in FURTHER if name in blocks and TABLE[name].prior_sd is not None)


def split_further(values: Any, blocks: Blocks) -> dict[str, list[Any]]:
    """The components of each free further unknown, by name.

    Args:
        values: all of them, (..., k); None if there are none.
        blocks: the free unknowns.
    """
    if values is None:
        return {}
    found = {}
    for name in FURTHER:
        if name in blocks:
            at = further_slice(blocks, name)
            found[name] = [values[..., k] for k in range(at.start, at.stop)]
    return found


def tangent_names(blocks: Blocks) -> list[str]:
    """Names, with units, of the tangents of these blocks, in order."""
    return [name for block in blocks for name in TABLE[block].tangents]


def in_image(blocks: Blocks) -> np.ndarray:
    """Which of the tangents of these blocks move an image point (indices)."""
    moving = [TABLE[block].in_image for block in blocks for _ in TABLE[block].tangents]
    return np.flatnonzero(moving)
