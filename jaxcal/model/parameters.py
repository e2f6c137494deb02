"""The unknowns other than the offsets, in named blocks, and how a step moves them.

X steps on its manifold by the right perturbation X Exp([v, omega]), so v (mm) and omega (rad) are
along and about the image's own axes (lateral, elevational, axial). Steps of further unknowns are
described in :mod:`jaxcal.model.unknowns`. A solver is told which blocks are free; the rest stay
fixed.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal import InputError
from jaxcal.data.geometry import matrix_from_rotation, rotation_from_vector
from jaxcal.model.unknowns import FURTHER, TABLE, Blocks, block_slice, count_unknowns, stepped


class Parameters(eqx.Module):
    """A value of the unknowns, or a batch of them (then every array has the batch axes in front).

    Attributes:
        rotation: of X; its columns are the lateral, elevational and axial axes in the probe's
            frame.
        translation: of X, mm.
        point: the target c in the tracker's frame, mm.
        scale: factors on the problem's [lateral, axial] spacing.
        sound_speed: factor on the speed by which times became distances.
        delay: what the system adds to a distance, mm at that speed.
    """

    rotation: Float[Array, "*batch 3 3"]
    translation: Float[Array, "*batch 3"]
    point: Float[Array, "*batch 3"]
    scale: Float[Array, "*batch 2"]
    sound_speed: Float[Array, "*batch"]
    delay: Float[Array, "*batch"]

    @classmethod
    def of(
        cls,
        rotation: Float[Array, "3 3"],
        translation: Float[Array, " 3"],
        point: Float[Array, " 3"],
        scale: Float[Array, " 2"] | None = None,
    ) -> Parameters:
        """X and the target, with nominal scale, sound speed and delay."""
        one = jnp.ones((), translation.dtype)
        scale = jnp.ones(2, translation.dtype) if scale is None else scale
        return cls(rotation, translation, point, scale, one, jnp.zeros_like(one))

    def further(self, name: str) -> Float[Array, "*batch k"]:
        """A further unknown, its components on the last axis."""
        value = getattr(self, TABLE[name].field)
        return value if value.ndim == self.point.ndim else value[..., None]

    def with_further(self, values: dict[str, Float[Array, "*batch k"]]) -> Parameters:
        """The same with other values of further unknowns, components on the last axis."""
        fields = {
            TABLE[name].field: value
            if getattr(self, TABLE[name].field).ndim == value.ndim
            else value[..., 0]
            for name, value in values.items()
        }
        return replace(self, **fields)

    def matrix(self) -> Float[Array, "*batch 4 4"]:
        """X as 4x4 matrices, mm."""
        return matrix_from_rotation(self.rotation, self.translation)


def retract(parameters: Parameters, tangent: Float[Array, " p"], blocks: Blocks) -> Parameters:
    """Move parameters by a tangent vector: X by the right perturbation X Exp([v, omega]).

    Args:
        parameters: of one problem.
        tangent: in the order of ``blocks``: v (mm, along the image's axes), omega (rad, about
            them), the step of the target (mm, tracker's frame), steps of the logarithms of scale
            and sound speed, the step of the delay (mm).
        blocks: the unknowns that move.

    Raises:
        InputError: as many numbers as the blocks have unknowns are needed.
    """
    if tangent.shape != (count_unknowns(blocks),):
        raise InputError(
            f"a step of {', '.join(blocks)} has {count_unknowns(blocks)} numbers, not the shape "
            f"{tangent.shape}"
        )

    def part(name: str) -> Float[Array, " k"]:
        if name in blocks:
            return tangent[block_slice(blocks, name)]
        return jnp.zeros(TABLE[name].size, tangent.dtype)

    # R Exp([v, w]) with v itself as the translation: equal to SE(3)'s exponential to first order,
    # defined for any step, and cheaper. Rotations are kept as matrices: the residuals need nothing
    # else, and products of quaternions would double what XLA must compile.
    turn = rotation_from_vector(part("rotation"))
    moved = replace(
        parameters,
        rotation=parameters.rotation @ turn,
        translation=parameters.translation + parameters.rotation @ part("translation"),
        point=parameters.point + part("point"),
    )
    return moved.with_further(
        {
            name: stepped(name, parameters.further(name), part(name), jnp.exp)
            for name in FURTHER
            if name in blocks
        }
    )
