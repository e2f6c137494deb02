"""Moves each chosen pose along the gradient of its gain, inside the constraints.

A pose moves in the five numbers of :mod:`jaxcal.design.constraints`, where region, cone and turn
are exact limits. A step is halved, and in the end not taken, if it leaves the box, the reach or
another constraint, or if the pose would be one replicate too many. So a polished pose satisfies all
constraints that its candidate satisfied.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.data.geometry import matrix_from_rotation, rotation_from_vector
from jaxcal.design.candidates import Candidates
from jaxcal.design.constraints import Region
from jaxcal.design.greedy import LEAST_GAIN, Chosen, Search, are_alike
from jaxcal.design.information import Model, covariance_of
from jaxcal.runtime.jax_modes import in_own_modes

_STEPS = 8
_HALVINGS = 5
_FIRST_STEP = 0.25
"""In units of the extent: an eighth of the full range of region, cone and turns."""


def pose_of(
    numbers: Float[Array, " 5"],
    reference: Float[Array, "3 3"],
    image_to_probe: Float[Array, "4 4"],
    point: Float[Array, " 3"],
    region: Region,
) -> Float[Array, "4 4"]:
    """Pose probe -> tracker (mm) from five numbers (JAX, differentiable)."""
    zero = jnp.zeros_like(numbers[4])
    tilt = rotation_from_vector(jnp.stack([numbers[2], numbers[3], zero]))
    turn = rotation_from_vector(jnp.stack([zero, zero, numbers[4]]))
    rotation = reference @ tilt @ turn @ image_to_probe[:3, :3].T
    place = image_to_probe[:3, :3] @ region.place(numbers[:2]) + image_to_probe[:3, 3]
    return matrix_from_rotation(rotation, point - rotation @ place)


@partial(jax.jit, static_argnames="region")
def _scored(
    numbers: Float[Array, " 5"],
    known: Float[Array, "k p p"],
    weight: Float[Array, "p p"] | None,
    factors: Float[Array, "k 3"],
    reference: Float[Array, "3 3"],
    model: Model,
    *,
    region: Region,
) -> tuple[Float[Array, ""], Float[Array, " 5"]]:
    """The score of a pose as in :func:`jaxcal.design.criteria.gains`, and its gradient."""

    def score(numbers: Float[Array, " 5"]) -> Float[Array, ""]:
        rows = model.jacobian(
            pose_of(numbers, reference, model.image_to_probe, model.point, region)
        )

        def one(covariance: Float[Array, "p p"], factor: Float[Array, " 3"]) -> Float[Array, ""]:
            own = rows / factor[:, None]
            spread = own @ covariance
            around = jnp.eye(3) + spread @ own.T
            if weight is None:
                return jnp.linalg.slogdet(around)[1] / covariance.shape[0]
            gained = jnp.trace(jnp.linalg.solve(around, spread @ weight @ spread.T))
            return -jnp.log1p(-gained / jnp.sum(weight * covariance))

        return jnp.mean(jax.vmap(one)(known, factors))

    return jax.value_and_grad(score)(numbers)


def _cut_off(
    numbers: Float[np.ndarray, " 5"], extent: Float[np.ndarray, " 5"]
) -> Float[np.ndarray, " 5"]:
    """The nearest numbers inside region, cone and turn."""
    tilt, cone = float(np.hypot(*numbers[2:4])), extent[2]
    inside = np.clip(numbers, -extent, extent)
    inside[2:4] = numbers[2:4] * (cone / tilt if tilt > cone else 1.0)
    return inside


@in_own_modes
def polish(search: Search, candidates: Candidates, chosen: Chosen) -> Float[np.ndarray, "n 4 4"]:
    """The chosen poses, moved one after the other.

    Those that fill space stay, and so do a caller's own that are outside the constraints.
    """
    model, bounds = candidates.model, candidates.constraints
    x, point = model.image_to_probe, model.point
    poses = candidates.poses[chosen.rows].copy()
    numbers = candidates.numbers[chosen.rows]
    rotations = search.rotations[chosen.rows].copy()
    places = search.places[chosen.rows].copy()
    information = chosen.information.copy()
    # In units of the extent, of which none is zero.
    scale = np.maximum(bounds.extent, np.radians(1e-3))
    given = (search.weight, search.factors, bounds.reference, model)

    def evaluate(at: np.ndarray, known: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = _scored(at, known, *given, region=bounds.region)
        return float(value), np.asarray(slope)

    def among_too_many(k: int, pose: np.ndarray) -> bool:
        others = np.arange(len(poses)) != k
        turns = np.concatenate([rotations[others], search.taken_rotations])
        seen = np.concatenate([places[others], search.taken_places])
        turn, place = (pose[:3, :3] @ x[:3, :3]).reshape(1, 9), model.targets(pose)[None]
        near = are_alike(turns, seen, turn, place, search.rules).sum()
        return bool(near >= search.rules.replicates)

    def better_step(
        k: int, known: np.ndarray, here: np.ndarray, value: float, slope: np.ndarray, step: float
    ) -> tuple[np.ndarray, float, np.ndarray, float, np.ndarray] | None:
        """The next numbers, value, slope, step and pose; None if no step along the slope gains."""
        direction = slope * scale
        length = float(np.linalg.norm(direction))
        if length < 1e-9:
            return None
        for _ in range(_HALVINGS):
            there = _cut_off(here + step * scale * direction / length, bounds.extent)
            pose = bounds.poses(there[None], x, point)
            if bounds.keeps(pose, x, point)[0] and not among_too_many(k, pose[0]):
                better, steeper = evaluate(there, known)
                if better > value + LEAST_GAIN:
                    return there, better, steeper, step, pose[0]
            step *= 0.5
        return None

    # From outside the constraints, the way into them may cost more than the gradient gives.
    inside = bounds.keeps(poses, x, point)
    for k, filling in enumerate(chosen.filling):
        if filling or not inside[k]:
            continue
        own = _outer(model, poses[k], search.factors)
        known = covariance_of(information - own)
        here = _cut_off(numbers[k], bounds.extent)
        value, slope = evaluate(here, known)
        step = _FIRST_STEP
        for _ in range(_STEPS):
            found = better_step(k, known, here, value, slope, step)
            if found is None:
                break
            here, value, slope, step, poses[k] = found
        rotations[k] = (poses[k, :3, :3] @ x[:3, :3]).reshape(9)
        places[k] = model.targets(poses[k])
        information = information + _outer(model, poses[k], search.factors) - own
    return poses


def _outer(
    model: Model, pose: Float[np.ndarray, "4 4"], factors: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "k p p"]:
    rows = model.jacobian(pose) / factors[:, :, None]
    return np.einsum("kia,kib->kab", rows, rows)
