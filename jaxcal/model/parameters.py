"""The unknowns other than the offsets, in named blocks, and how a step moves them.

X steps on its manifold by the right perturbation X Exp([v, omega]), so v (mm) and omega (rad) are
along and about the image's own axes (lateral, elevational, axial). Pixel scales and sound speed
step in their logarithm, which keeps them positive. A solver is told which blocks are free; the rest
stay fixed. :mod:`jaxcal.model.blocks` holds their names and sizes, which can be had here too.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.data.geometry import matrix_from_rotation, rotation_from_vector
from jaxcal.model.blocks import BLOCK_SIZE as BLOCK_SIZE
from jaxcal.model.blocks import EXTRA as EXTRA
from jaxcal.model.blocks import MEDIUM as MEDIUM
from jaxcal.model.blocks import RIGID as RIGID
from jaxcal.model.blocks import Blocks as Blocks
from jaxcal.model.blocks import block_slice as block_slice
from jaxcal.model.blocks import size as size


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
        translation: Float[Array, 3],
        point: Float[Array, 3],
        scale: Float[Array, 2] | None = None,
    ) -> Parameters:
        """X and the target, with nominal scale, sound speed and delay."""
        one = jnp.ones((), translation.dtype)
        scale = jnp.ones(2, translation.dtype) if scale is None else scale
        return cls(rotation, translation, point, scale, one, jnp.zeros_like(one))

    def matrix(self) -> Float[Array, "4 4"]:
        """X as a 4x4 matrix, mm."""
        return matrix_from_rotation(self.rotation, self.translation)


def retract(parameters: Parameters, tangent: Float[Array, " p"], blocks: Blocks) -> Parameters:
    """Move parameters by a tangent vector (mm, rad, mm, log units; in the order of ``blocks``)."""

    def part(name: str) -> Float[Array, " k"]:
        if name in blocks:
            return tangent[block_slice(blocks, name)]
        return jnp.zeros(BLOCK_SIZE[name], tangent.dtype)

    # R Exp([v, w]) with Exp's translation taken as v itself: the same first order as SE(3)'s
    # exponential, defined for any step, and cheaper. Rotations are kept as matrices: the residuals
    # need nothing else, and a product of quaternions to get there doubles what XLA must compile.
    turn = rotation_from_vector(part("rotation"))
    return Parameters(
        rotation=parameters.rotation @ turn,
        translation=parameters.translation + parameters.rotation @ part("translation"),
        point=parameters.point + part("point"),
        scale=parameters.scale * jnp.exp(part("scale")),
        sound_speed=parameters.sound_speed * jnp.exp(part("sound-speed")[0]),
        delay=parameters.delay + part("delay")[0],
    )
