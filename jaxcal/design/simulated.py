"""Simulated errors of poses: what calibrations of such images turn out to be.

:func:`jaxcal.design.criteria.curve` predicts errors in closed form from SDs alone. What a method
really makes of few images, or of offsets with edges, a mean or long tails, is not in a formula. It
is in many simulated recordings: the target is seen from the given poses, elevational offsets follow
a law, lateral position and range err by the model's SDs, and every recording is calibrated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import check_poses
from jaxcal.data.problem import Problem
from jaxcal.data.recording import MINIMUM_IMAGES
from jaxcal.design.candidates import Candidates
from jaxcal.design.information import Model
from jaxcal.design.planning import Plan
from jaxcal.diagnostics.metrics import reconstruction_precision
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.given_values import LARGEST_SEED, check_made, real_array, whole_number
from jaxcal.runtime.jax_modes import importing_jax, in_own_modes
from jaxcal.solvers.names import Method, PriorName
from jaxcal.study.laws import LawName

MOST_TRIALS = 100_000
"""Of one call; they are all in memory at once."""
_TEST_POSES = 50
"""Poses over which the reconstruction precision of every trial is computed."""


@dataclass(frozen=True)
class SimulatedErrors:
    """Errors of simulated calibrations.

    Attributes:
        law: of the elevational offsets.
        images: in each recording.
        trials: recordings.
        tre_mm: root mean square TRE over the region and the trials, mm.
        tre_error_mm: standard error of ``tre_mm``.
        tre_95_mm: 95 % of the trials have a smaller root mean square TRE over the region, mm.
        rp_mm: mean reconstruction precision (Eq. 8) of exact images at other poses, mm.
        rp_error_mm: standard error of ``rp_mm``.
        lost: trials without an answer, which are in none of these numbers.
    """

    law: LawName
    images: int
    trials: int
    tre_mm: float
    tre_error_mm: float
    tre_95_mm: float
    rp_mm: float
    rp_error_mm: float
    lost: int


@importing_jax
@in_own_modes
def simulate_errors(
    poses: Plan | Float[np.ndarray, "*trials n 4 4"],
    law: LawName = "uniform",
    candidates: Candidates | None = None,
    *,
    method: Method = "joint",
    prior: PriorName = "auto",
    trials: int = 1000,
    seed: int = 0,
) -> SimulatedErrors:
    """Errors of calibrations from simulated images at these poses.

    The first call compiles the method for a batch, which takes most of its time.

    Args:
        poses: a plan (after the images taken already, where there are some), or poses probe ->
            tracker, mm: one set for all trials, or a set for each of them.
        law: of the offsets, see :mod:`jaxcal.study.offsets`; their SD is the model's.
        candidates: with X, target, SDs, and the region of the TRE; by default the plan's. After a
            calibration give those that were planned from: the plan's have the SD that the offsets
            are worth, which may be smaller than their own.
        method: see :func:`jaxcal.calibrate`.
        prior: see :func:`jaxcal.calibrate`.
        trials: simulated recordings; not needed where every one has its own poses.
        seed: of the offsets and errors.

    Raises:
        InputError: no candidates, fewer than 4 poses, one that is not rigid, an unknown law, or a
            wrong number of trials.
    """
    from jaxcal.calibration.calibrate import calibrate_batch
    from jaxcal.study.laws import check_law

    check_law(law, "law")
    if isinstance(poses, Plan):
        candidates = poses.candidates if candidates is None else candidates
        poses = _with_taken(poses)
    if candidates is None:
        raise InputError("poses alone do not say what the images show: give candidates as well")
    check_made("candidates", candidates, Candidates, "make_candidates or candidates_around")
    poses = real_array(poses, "poses")
    if poses.ndim not in (3, 4) or poses.shape[-2:] != (4, 4):
        raise InputError(f"poses must be (n, 4, 4) or (trials, n, 4, 4), not {poses.shape}")
    if poses.shape[-3] < MINIMUM_IMAGES:
        raise InputError(f"{poses.shape[-3]} poses are too few: at least {MINIMUM_IMAGES}")
    check_poses(poses.reshape(-1, 4, 4))
    if poses.ndim == 4:
        trials = len(poses)
    whole_number("trials", trials, 2, MOST_TRIALS)
    whole_number("seed", seed, 0, LARGEST_SEED)
    poses = np.broadcast_to(poses, (trials, *poses.shape[-3:]))
    model = candidates.model
    problems = _recordings(poses, model, law, np.random.default_rng(seed))
    found = calibrate_batch(
        problems, method, prior, estimate=("scale",) if model.scale else ()
    ).numpy()
    there = np.isfinite(found.image_to_probe).all(axis=(1, 2))
    if np.count_nonzero(there) < 2:
        raise InputError(f"{trials} simulated calibrations of these poses have no answer")
    transforms = np.asarray(found.image_to_probe)[there]
    scale = np.ones((len(transforms), 2))
    if model.scale:
        scale = np.asarray(found.scale_mm_per_px)[there]
    squares = _squared_errors(transforms, scale, model, candidates.constraints.region.grid())
    tests = candidates.poses[:: -(-len(candidates) // _TEST_POSES)]
    places = _seen(model.targets(tests), scale, model)[..., ::2]
    precision = np.array(
        [reconstruction_precision(x, tests, p) for x, p in zip(transforms, places, strict=True)]
    )
    root, tre = np.sqrt(len(squares)), float(np.sqrt(squares.mean()))
    return SimulatedErrors(
        law=law,
        images=poses.shape[1],
        trials=trials,
        tre_mm=tre,
        tre_error_mm=float(squares.std() / root / 2 / tre) if tre > 0 else 0.0,
        tre_95_mm=float(np.sqrt(np.quantile(squares, 0.95))),
        rp_mm=float(precision.mean()),
        rp_error_mm=float(precision.std() / root),
        lost=int(trials - np.count_nonzero(there)),
    )


def _with_taken(plan: Plan) -> Float[np.ndarray, "n 4 4"]:
    """The poses of a plan after those of the images that its calibration used."""
    before = plan.candidates
    if plan.known.images == 0:
        return plan.poses
    return np.concatenate([before.taken_and_used, plan.poses])


def _recordings(
    poses: Float[np.ndarray, "trials n 4 4"], model: Model, law: LawName, rng: np.random.Generator
) -> Problem:
    """Problems whose poses are off along the elevational axis, with erring measurements."""
    import jax

    from jaxcal.study.offsets import standard_deviation, standard_offsets

    trials, count = poses.shape[:2]
    places = model.targets(poses)
    sd = model.noise.sigma(places)
    keys = jax.random.split(jax.random.key(int(rng.integers(2**31))), trials)
    draw = jax.jit(jax.vmap(lambda key: standard_offsets(key, law, count)))
    drawn = np.asarray(draw(keys))
    offsets = sd[..., 2] * drawn / standard_deviation(law)
    seen = places + offsets[..., None] * np.array([0.0, 1.0, 0.0])
    moved = np.array(poses)
    elevational = poses[..., :3, :3] @ model.image_to_probe[:3, 1]
    moved[..., :3, 3] -= offsets[..., None] * elevational
    points = np.stack([seen[..., 0], np.hypot(seen[..., 1], seen[..., 2])], axis=-1)
    points += rng.normal(size=points.shape) * sd[..., :2]
    points[..., 1] -= model.face_offset_mm
    arrays: dict[str, Any] = {
        "poses": moved,
        "measurements": points,
        "mask": np.ones((trials, count)),
        "spacing": np.ones((trials, 2)),
        "face_offset": np.full(trials, model.face_offset_mm),
    }
    return Problem(**arrays, pixels=model.scale)


def _seen(
    points: Float[np.ndarray, "m 3"], scale: Float[np.ndarray, "trials 2"], model: Model
) -> Float[np.ndarray, "trials m 3"]:
    """Where image points are taken to be with the pixel scales of every trial, mm."""
    face = np.array([0.0, 0.0, model.face_offset_mm])
    factors = np.stack([scale[:, 0], np.ones(len(scale)), scale[:, 1]], axis=-1)
    return (points - face) * factors[:, None] + face


def _squared_errors(
    transforms: Float[np.ndarray, "trials 4 4"],
    scale: Float[np.ndarray, "trials 2"],
    model: Model,
    points: Float[np.ndarray, "m 3"],
) -> Float[np.ndarray, " trials"]:
    """Mean squared TRE over image points of every trial, mm^2."""
    found = _seen(points, scale, model)
    placed = np.einsum("kij,kpj->kpi", transforms[:, :3, :3], found) + transforms[:, None, :3, 3]
    true = points @ model.image_to_probe[:3, :3].T + model.image_to_probe[:3, 3]
    return ((placed - true) ** 2).sum(axis=-1).mean(axis=1)
