"""Given SDs of each image's offset: from its amplitude or bracket, and a calibration with them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from tank import Tank
from tank_placements import part

from hw.bench.tank import Beam, Noise
from hw.midplane.search import Settings
from jaxcal import Problem
from jaxcal.backend import RIGID, Component, FurtherUnknowns, ImagePlanes, Observation, minimise
from jaxcal.solvers.start import conventional

# The engine's pieces compute in the caller's modes.
jax.config.update("jax_enable_x64", True)

GAIN_SD = 0.05
"""How well the amplitude in the mid-plane is known (assumption)."""
FACTOR = Settings.factor
"""SDs that a bound reaches; as a bracket."""


class PlacedOffsets(Observation):
    """Lateral position, range and offset; the offset's SD is each image's own.

    Attributes:
        sigma: SDs of lateral position and range, mm, and the factor on the images' SDs.
        offset_sd: of every image's offset, mm.
    """

    sigma: Float[Array, "3 batch"]
    offset_sd: Float[Array, "batch n"]

    def components(self, q: list, further: FurtherUnknowns, images: ImagePlanes) -> list[Component]:
        """Errors in the plane, and offsets in their SDs."""
        lateral, distance = further.points(images)
        return [
            Component([q[0] - lateral]),
            Component([jnp.sqrt(q[1] ** 2 + q[2] ** 2) - distance]),
            Component([q[1] / self.offset_sd]),
        ]


@jax.jit
def _minimised(problem: Problem, offset_sd: Array, sigma: Array) -> tuple[Array, Array]:
    images = ImagePlanes.of(problem)
    begin = conventional(images, RIGID).iterate
    given = jnp.concatenate([sigma.T, jnp.ones((1, sigma.shape[0]))])
    found = minimise(begin, PlacedOffsets(given, offset_sd), images).iterate.parameters()
    return found.rotation, found.translation


def own_sds(
    problem: Problem, offset_sd: Float[np.ndarray, "batch n"], sigma: Float[np.ndarray, "batch 2"]
) -> Float[np.ndarray, "batch 4 4"]:
    """X of every problem by Gaussian offsets with an SD for each image.

    Args:
        problem: a batch.
        offset_sd: of every image's offset, mm.
        sigma: SDs of lateral position and range, mm.
    """
    rotation, translation = _minimised(problem, jnp.asarray(offset_sd), jnp.asarray(sigma))
    found = np.tile(np.eye(4), (len(sigma), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = rotation, translation
    return found


def from_amplitude(placements: np.ndarray, gain: float) -> tuple[np.ndarray, np.ndarray]:
    """Bounds and SDs (n,) of the offsets from the amplitudes, mm.

    Args:
        placements: (n, columns) of the library.
        gain: factor by which the amplitude in the mid-plane is misjudged.
    """
    heard, in_plane = (part(placements, name) for name in ("amplitude", "amplitude_in_plane"))
    width = np.asarray(Beam().width_mm(part(placements, "range_mm")))

    def offset(ratio: np.ndarray) -> np.ndarray:
        return width * np.sqrt(2 * np.log(np.maximum(ratio, 1.0)))

    ratio = gain * in_plane / np.maximum(heard, 1.0)
    hidden = float(np.hypot(Noise.response_mm, Tank().repeatability_mm))
    bound = offset(ratio * (1 + FACTOR * GAIN_SD)) + FACTOR * hidden
    sd = np.hypot(offset(ratio), np.hypot(hidden, width * np.sqrt(2 * GAIN_SD)))
    return bound, sd
