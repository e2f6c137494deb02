"""Gross errors for simulated experiments: what goes wrong in a laboratory, as a pure function.

echo    the range is that of another echo: off by 20 to 100 mm
click   the point was picked elsewhere: off by 20 to 100 mm in a random direction of the image
pose    the tracker saw something else: the probe is off by 20 to 100 mm in a random direction and
        turned by up to 10 degrees
slip    the probe slipped in its mount: one such error of the pose, the same in every spoilt image
mixed   each spoilt image draws one of echo, click and pose
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxcal import InputError
from jaxcal.data.geometry import matrix_from_rotation, rotation_from_vector
from jaxcal.data.problem import Problem
from jaxcal.runtime.jax_modes import in_own_modes

OutlierKind = Literal["echo", "click", "pose", "slip", "mixed"]
OUTLIER_KINDS: tuple[OutlierKind, ...] = get_args(OutlierKind)

SMALLEST_MM, LARGEST_MM = 20.0, 100.0
LARGEST_TURN_RAD = 0.1745
_SHALLOWEST_MM = 1.0


@in_own_modes
def contaminate(
    key: Key[Array, ""], problem: Problem, fraction: float, kind: OutlierKind = "mixed"
) -> tuple[Problem, Float[Array, " n"]]:
    """Spoil a fraction of the images of a problem with points in mm; vmap over keys and problems.

    Args:
        key: of the draws.
        problem: one problem.
        fraction: of the images; rounded to a whole number of them.
        kind: see the head of this module.

    Returns:
        The spoilt problem and (n,) 1 where an image was spoilt.

    Raises:
        InputError: an unknown kind, or a fraction outside 0 to 1.
    """
    if kind not in OUTLIER_KINDS:
        raise InputError(f"kind must be one of {', '.join(OUTLIER_KINDS)}, not {kind!r}")
    if not 0 <= fraction <= 1:
        raise InputError(f"fraction must be between 0 and 1, not {fraction}")
    n, dtype = problem.images, problem.mask.dtype
    keys = jax.random.split(key, 5)
    spoilt = (jax.random.permutation(keys[0], n) < round(fraction * n)).astype(dtype)
    size = jax.random.uniform(keys[1], (n,), minval=SMALLEST_MM, maxval=LARGEST_MM)
    which = jax.random.randint(keys[2], (n,), 0, 3)
    chosen = which if kind == "mixed" else jnp.full(n, {"echo": 0, "click": 1}.get(kind, 2))

    angle = jax.random.uniform(keys[3], (n,), maxval=2 * jnp.pi)
    sign = jnp.sign(jnp.cos(angle))
    in_image = jnp.stack(
        [jnp.where(chosen == 1, jnp.cos(angle), 0.0), jnp.where(chosen == 1, jnp.sin(angle), sign)],
        axis=1,
    )
    in_image = jnp.where((chosen == 2)[:, None], 0.0, size[:, None] * in_image)
    # Nothing lies in front of the array: an error that would lead there is made deeper instead.
    depth = problem.measurements[:, 1] + in_image[:, 1]
    later = problem.measurements[:, 1] - in_image[:, 1]
    depth = jnp.where(depth < _SHALLOWEST_MM, later, depth)
    points = jnp.stack([problem.measurements[:, 0] + in_image[:, 0], depth], axis=1)

    draws = jax.random.normal(keys[4], (n, 7))
    if kind == "slip":
        draws, size = jnp.broadcast_to(draws[0], draws.shape), jnp.full(n, size[0])

    def moved(pose: Array, draw: Array, size: Array) -> Array:
        shift = size * draw[:3] / jnp.linalg.norm(draw[:3])
        turn = LARGEST_TURN_RAD * jax.nn.sigmoid(draw[6]) * draw[3:6] / jnp.linalg.norm(draw[3:6])
        return pose @ matrix_from_rotation(rotation_from_vector(turn), shift)

    poses = jax.vmap(moved)(problem.poses, draws, size)
    off = (spoilt > 0) & (chosen == 2)
    return replace(
        problem,
        poses=jnp.where(off[:, None, None], poses, problem.poses),
        measurements=jnp.where(spoilt[:, None] > 0, points, problem.measurements),
    ), spoilt
