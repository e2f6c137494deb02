"""Poses to choose from: those of a probe over a region, or those to add to a recording.

Candidates follow one Sobol sequence over the five numbers of :mod:`jaxcal.design.constraints`,
shifted by a seed. Tilts are uniform over the cone's cap; turns and places are uniform, too. Poses
that the constraints do not allow are skipped.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import check_poses, nearest_rotations
from jaxcal.data.probe import Probe
from jaxcal.data.recording import Recording, check_recording
from jaxcal.design.constraints import Constraints, Region
from jaxcal.design.information import Model
from jaxcal.design.noise import Noise, check_result, used_images
from jaxcal.result.calibration import Calibration
from jaxcal.result.transform import ImageTransform
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.arrays import outline
from jaxcal.runtime.given_values import LARGEST_SEED, check_made, truth_array, whole_number

COUNT = 5000
"""Number of candidates of a plan; twice as many change the predicted error by less than 1 %."""
MOST_CANDIDATES = 200_000
SOBOL: tuple[tuple[int, tuple[int, ...]], ...] = (
    (0, (1,) * 30),
    (0, (1,)),
    (1, (1, 3)),
    (1, (1, 3, 1)),
    (2, (1, 1, 1)),
)
"""Primitive polynomials (their inner coefficients) and first direction numbers of each axis.

Source: Joe and Kuo, SIAM J. Sci. Comput. 30, 2008 (new-joe-kuo-6); the first axis is van der
Corput's.
"""
SOBOL_BITS = 30
_TRIES_PER_POSE = 50
_LEAST_CONE_DEG, _LEAST_TURN_DEG = 30.0, 60.0
_WIDER = 0.15
_NEAR_MM = 10.0
"""A mount or a target known by eye may be wrong by this much; poses in metres are farther off."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses to choose from.

    Attributes:
        poses: (m, 4, 4) probe -> tracker, mm.
        model: X, target and SDs.
        constraints: what polished poses must keep.
        taken: (k, 4, 4) poses of the images taken already.
        used: (k,) which of these images a calibration used.
    """

    poses: Float[np.ndarray, "m 4 4"]
    model: Model
    constraints: Constraints
    taken: Float[np.ndarray, "k 4 4"] | None = None
    used: np.ndarray | None = None
    _checked: bool = field(default=False, repr=False)

    __repr__ = outline

    def __post_init__(self) -> None:
        if self._checked:
            return
        poses = check_poses(self.poses, what="candidate pose")
        if not 1 <= len(poses) <= MOST_CANDIDATES:
            raise InputError(f"there must be 1 to {MOST_CANDIDATES} candidates, not {len(poses)}")
        object.__setattr__(self, "poses", poses)
        check_made("model", self.model, Model, "jaxcal.design.Model")
        check_made("constraints", self.constraints, Constraints, "jaxcal.design.Constraints")
        if self.taken is not None:
            object.__setattr__(self, "taken", check_poses(self.taken, what="taken pose"))
        if self.used is not None:
            count = 0 if self.taken is None else len(self.taken)
            if truth_array(self.used, "used").shape != (count,):
                raise InputError(f"used must hold a truth value for each of {count} taken poses")
        seen = self.model.targets(poses)
        region = self.constraints.region
        nearest = region.place(np.clip(region.unit(seen), -1, 1))
        if np.linalg.norm(seen - nearest, axis=1).min() > _NEAR_MM:
            raise InputError(
                f"at none of the candidate poses is the target within {_NEAR_MM:g} mm of the "
                "image region: are they probe -> tracker, in mm, and do they belong to the "
                "model's X and target?"
            )
        # Copies with other SDs, or with some of the poses, need no new check.
        object.__setattr__(self, "_checked", True)

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def taken_and_used(self) -> Float[np.ndarray, "k 4 4"]:
        """Poses of the images taken already, without those that the calibration left out."""
        taken = np.zeros((0, 4, 4)) if self.taken is None else self.taken
        return taken if self.used is None else taken[np.asarray(self.used) > 0]

    @property
    def numbers(self) -> Float[np.ndarray, "m 5"]:
        """The five numbers of each pose."""
        model = self.model
        return self.constraints.coordinates(self.poses, model.image_to_probe, model.point)


def sobol_sequence(count: int) -> Float[np.ndarray, "n 5"]:
    """The first points of Sobol's sequence in the unit cube, the same as in ``scipy.stats.qmc``.

    The import of ``scipy.stats.qmc`` takes longer than planning. The points are in the order of the
    Gray code, after Antonov and Saleev 1979.
    """
    order = np.arange(count, dtype=np.int64)
    gray = order ^ (order >> 1)
    found = np.zeros((count, len(SOBOL)), np.int64)
    for axis, (polynomial, initial) in enumerate(SOBOL):
        numbers = list(initial)
        for k in range(len(numbers), SOBOL_BITS):
            degree = len(initial)
            value = numbers[k - degree] ^ (numbers[k - degree] << degree)
            for i in range(1, degree):
                if polynomial >> (degree - 1 - i) & 1:
                    value ^= numbers[k - i] << i
            numbers.append(value)
        for k, number in enumerate(numbers):
            found[:, axis] ^= (gray >> k & 1) * (number << (SOBOL_BITS - 1 - k))
    return found / 2.0**SOBOL_BITS


def sobol_numbers(count: int, constraints: Constraints, seed: int) -> Float[np.ndarray, "n 5"]:
    """The first ``count`` points of the sequence (rounded up to a power of two), as numbers."""
    draws = sobol_sequence(1 << int(np.ceil(np.log2(max(count, 2)))))
    # Sobol points are balanced in powers of two; a shift modulo 1 keeps them uniform.
    shifted = (draws + np.random.default_rng(seed).random(5)) % 1.0
    height, round_, turn, lateral, depth = shifted.T
    tilt = np.arccos(1 - height * (1 - np.cos(np.radians(constraints.cone_deg))))
    azimuth = 2 * np.pi * round_
    return np.column_stack(
        [
            2 * lateral - 1,
            2 * depth - 1,
            tilt * np.cos(azimuth),
            tilt * np.sin(azimuth),
            np.radians(constraints.turn_deg) * (2 * turn - 1),
        ]
    )


def sobol_poses(
    count: int, model: Model, constraints: Constraints, seed: int = 0
) -> tuple[Float[np.ndarray, "n 4 4"], int]:
    """The first ``count`` allowed poses of the sequence, and how many others were skipped.

    There are fewer poses if the constraints allow fewer than ``count`` of 50 ``count`` tries.
    """
    whole_number("count", count, 1, MOST_CANDIDATES)
    whole_number("seed", seed, 0, LARGEST_SEED)
    x, point = model.image_to_probe, model.point
    found: list[np.ndarray] = []
    passed = first = 0
    # A part of the sequence is nearly always enough, and a check may take long.
    for tries in (2 * count, 8 * count, _TRIES_PER_POSE * count):
        numbers = sobol_numbers(tries, constraints, seed)[first:]
        first += len(numbers)
        poses = constraints.poses(numbers, x, point)
        good = np.flatnonzero(constraints.keeps(poses, x, point))
        good = good[: count - sum(map(len, found))]
        found.append(poses[good])
        if sum(map(len, found)) == count:
            return np.concatenate(found), passed + int(good[-1]) + 1 - len(good)
        passed += len(poses) - len(good)
    return np.concatenate(found), passed


def make_candidates(
    probe: Probe | None = None,
    region: Region | None = None,
    *,
    count: int = COUNT,
    constraints: Constraints | None = None,
    model: Model | None = None,
    seed: int = 0,
) -> Candidates:
    """Candidates from a probe and a region alone.

    X and the target's position need not be known. Which poses tell most depends on where the target
    is in the image and on the image's orientation, not on where the probe's frame is on the probe.

    Args:
        probe: the transducer, for the region and for the SDs; None: a linear one.
        region: of the image, for the target; by default most of the area in front of the probe.
        count: how many candidates.
        constraints: cone, turns, box, reach; its region is used if ``region`` is None.
        model: X, target and SDs as far as they are known.
        seed: another seed gives other candidates of the same quality.

    Returns:
        Poses to choose from, for :func:`jaxcal.design.plan` and :func:`jaxcal.design.next_poses`.

    Raises:
        InputError: constraints that leave too few poses.
    """
    if constraints is None:
        default = Region() if probe is None else Region.of_probe(probe)
        constraints = Constraints(region=default)
    check_made("constraints", constraints, Constraints, "jaxcal.design.Constraints")
    if region is not None:
        constraints = replace(constraints, region=region)
    if model is None:
        model = Model() if probe is None else Model(noise=Noise.of_probe(probe))
    check_made("model", model, Model, "jaxcal.design.Model")
    poses, _ = sobol_poses(count, model, constraints, seed)
    if len(poses) < count:
        raise InputError(
            f"only {len(poses)} of {count} candidate poses stay inside the constraints: widen box "
            "or reach, or narrow the cone"
        )
    return Candidates(poses, model, constraints)


def candidates_around(
    recording: Recording,
    result: Calibration,
    *,
    count: int = COUNT,
    region: Region | None = None,
    cone_deg: float | None = None,
    turn_deg: float | None = None,
    constraints: Constraints | None = None,
    seed: int = 0,
) -> Candidates:
    """Candidates for poses to add to a recording, about the mean orientation of its images.

    Args:
        recording: what was calibrated.
        result: the recording's calibration; it may be unobservable.
        count: how many.
        region: of the image; by default where the target was, and the probe's face over that depth.
        cone_deg: half angle of the cone; by default that of the images, at least 30 degrees.
        turn_deg: largest turn either way; by default that of the images, at least 60 degrees.
        constraints: replace ``region``, ``cone_deg``, ``turn_deg`` and the mean orientation.
        seed: see :func:`make_candidates`.

    Returns:
        Poses to choose from, for :func:`jaxcal.design.plan` and :func:`jaxcal.design.next_poses`.

    Raises:
        InputError: a calibration that failed.
    """
    check_recording(recording, "candidates_around")
    check_result(result)
    answer = result.numpy()
    x, point = np.asarray(answer.image_to_probe, float), np.asarray(answer.point, float)
    if not (np.isfinite(x).all() and np.isfinite(point).all()):
        raise InputError("the calibration failed: there is nothing to plan from")
    poses = recording.calibration.poses
    used = used_images(result, len(poses))
    face = float(recording.calibration.face_offset_mm)
    model = Model(x, point, scale="scale" in result.blocks, face_offset_mm=face)
    targets = model.targets(poses)
    sigma = np.asarray(answer.sigma, float)
    if np.isfinite(sigma).all():
        model = replace(model, noise=Noise.learned(result, targets))
    if constraints is not None:
        check_made("constraints", constraints, Constraints, "jaxcal.design.Constraints")
    else:
        images = poses[used, :3, :3] @ x[:3, :3]
        reference, _ = nearest_rotations(images.mean(axis=0)[None])
        constraints = Constraints(
            region=(
                seen_region(recording, targets[used], answer.image_transform())
                if region is None
                else region
            ),
            reference=reference[0],
        )
        seen = constraints.coordinates(poses[used], x, point)
        spread = np.degrees(np.abs(np.stack([np.hypot(seen[:, 2], seen[:, 3]), seen[:, 4]])))
        cone, turn = spread.max(axis=1)
        constraints = replace(
            constraints,
            cone_deg=min(max(cone, _LEAST_CONE_DEG), 85.0) if cone_deg is None else cone_deg,
            turn_deg=min(max(turn, _LEAST_TURN_DEG), 180.0) if turn_deg is None else turn_deg,
        )
    found, _ = sobol_poses(count, model, constraints, seed)
    return Candidates(found, model, constraints, poses, used)


def seen_region(
    recording: Recording, targets: Float[np.ndarray, "n 3"], transform: ImageTransform | None = None
) -> Region:
    """Where the target was, slightly enlarged; at least most of the face of a known probe.

    If the size of the frames is known, and by ``transform`` that of a pixel, the region does not go
    beyond the last column and row.
    """
    probe = recording.probe
    whole = Region() if probe is None else Region.of_probe(probe)
    if probe is not None and whole.radius_mm is not None:
        unit = whole.unit(targets)
        far = whole.depth_mm[0] + 0.5 * (unit[:, 1].max() + 1) * np.ptp(whole.depth_mm)
        return replace(whole, depth_mm=(whole.depth_mm[0], max(far, whole.depth_mm[0] + 20.0)))
    left, right = targets[:, 0].min(), targets[:, 0].max()
    near, far = targets[:, 2].min(), targets[:, 2].max()
    aside, deeper = _WIDER * max(right - left, 20.0), _WIDER * max(far - near, 20.0)
    # Not nearer than 5 mm, unless the target was there.
    nearest = max(near - deeper, min(max(near, 0.1), 5.0))
    lateral, depth = (left - aside, right + aside), (nearest, far + deeper)
    if probe is not None:
        lateral = (min(left, whole.lateral_mm[0]), max(right, whole.lateral_mm[1]))
    if recording.calibration.kind == "pixel":  # an image has no columns below 0
        lateral = (max(lateral[0], min(left, 0.0)), lateral[1])
    size = recording.calibration.frame_size
    if size is not None and transform is not None and transform.scale_mm_per_px is not None:
        pixel = transform.scale_mm_per_px * [1.0, transform.range_factor]
        column, row = pixel * (np.array(size) - 1.0) + [0.0, transform.face_offset_mm]
        lateral = (lateral[0], min(lateral[1], max(right, column)))
        depth = (depth[0], min(depth[1], max(far, row)))
    depth = (min(depth), max(depth))
    return Region(tuple(map(float, lateral)), tuple(map(float, depth)))  # pyright: ignore[reportArgumentType]
