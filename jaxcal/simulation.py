"""Simulated experiments after the paper's section 3.1, as a pure function of a key.

The target is imaged in n poses: lateral position and depth uniform over the field, the elevational
offset after one of the laws of :mod:`jaxcal.offsets`, the probe turned about a random axis by up to
30 degrees, and white noise on the distance to every element; lateral position and range are then
segmented from the distances by least squares on Eq. 5. The tracker may err, too. Test images lie in
the plane and carry no noise. The paper leaves the ranges open; ``experiments/paper_tables`` says
which choices come near its tables (``test_fraction`` is a fitted one).

A curvilinear array sees a sector: the direction is uniform within 0.9 of its half angle, the depth
counts from the arc. Its data are the distances themselves; the points beside them are the in-plane
fit, which is what an image would show.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Key

from jaxcal.compiler import quick_to_compile
from jaxcal.errors import InputError
from jaxcal.geometry import matrix_from_rotation
from jaxcal.offsets import OffsetLaw, check_law, standard_offsets
from jaxcal.probe import L14_5, CurvilinearProbe, Probe
from jaxcal.problem import Channels, Problem, is_traced
from jaxcal.recording import MINIMUM_IMAGES, Recording, Truth, make_images
from jaxcal.segmentation.time_of_flight import fit_distances, fit_in_plane

Scalar = float | Float[Array, ""]
"""A number of a protocol: a plain one, or one that is traced and so shared by a compiled program
among all the values it may take."""


@dataclass(frozen=True)
class Protocol:
    """The distributions of a simulated experiment.

    Counts, the law of the offsets and the probe shape the program that draws; every other field
    may be a traced number (``dataclasses.replace`` inside the transformed function).

    Attributes:
        images: calibration images.
        test_images: noise-free in-plane test images.
        elevation_mm: bound (uniform, one-sided, triangular) or SD (normal, heavy-tailed) of the
            elevational offsets.
        elevation_distribution: their law, see :mod:`jaxcal.offsets`.
        noise_mm: SD of the noise on each element's distance.
        lateral_mm: the target's lateral position is uniform within +- this (linear probes).
        depth_mm: its depth is uniform between these; curvilinear probes: its range from the arc.
        rotation_rad: the probe is turned by up to this about a random axis.
        test_fraction: test positions cover this fraction of the field (0.75: fitted).
        probe: the transducer.
        sector: curvilinear probes: directions cover this fraction of the array's half angle.
        raw: keep the distances that the points come from; curvilinear probes always do.
        tracker_mm: SD of the tracked position of every calibration pose, each axis.
        tracker_rad: SD of its tracked rotation, about each of the probe's axes.
    """

    images: int = 50
    test_images: int = 50
    elevation_mm: Scalar = 1.0
    elevation_distribution: OffsetLaw = "uniform"
    noise_mm: Scalar = 0.5
    lateral_mm: Scalar = 29.25
    depth_mm: tuple[Scalar, Scalar] = (10.0, 90.0)
    rotation_rad: Scalar = float(np.radians(30.0))
    test_fraction: Scalar = 0.75
    probe: Probe = L14_5
    sector: Scalar = 0.9
    raw: bool = False
    tracker_mm: Scalar = 0.0
    tracker_rad: Scalar = 0.0

    def __post_init__(self) -> None:
        if not MINIMUM_IMAGES <= self.images <= 100_000:
            raise InputError(f"images must be between {MINIMUM_IMAGES} and 100000")
        for name, largest, unit in (
            ("elevation_mm", 1000, "mm"), ("noise_mm", 1000, "mm"),
            ("tracker_mm", 1000, "mm"), ("tracker_rad", 1, "rad"),
        ):  # fmt: skip
            value = getattr(self, name)
            if not (is_traced(value) or (np.isfinite(value) and 0 <= value <= largest)):
                raise InputError(f"{name} must be between 0 and {largest} {unit}, not {value}")
        check_law(self.elevation_distribution)


class Experiment(eqx.Module):
    """One simulated experiment: what is measured, and what is true.

    Attributes:
        poses: B_i, probe -> tracker, mm.
        points: segmented [lateral, range], mm.
        covariance: of the points, mm^2; zero without noise.
        elevation: true offsets y_i, mm.
        image_to_probe: true X, mm.
        point: true target in the tracker's frame, mm.
        test_poses: poses of the test images.
        test_points: their exact [lateral, range], mm.
        distances: measured distance of the target to every element, mm, or None (not kept).
    """

    poses: Float[Array, "n 4 4"]
    points: Float[Array, "n 2"]
    covariance: Float[Array, "n 2 2"]
    elevation: Float[Array, " n"]
    image_to_probe: Float[Array, "4 4"]
    point: Float[Array, 3]
    test_poses: Float[Array, "m 4 4"]
    test_points: Float[Array, "m 2"]
    distances: Float[Array, "n elements"] | None = None

    def problem(self, max_elevation: float | None = None, probe: Probe | None = None) -> Problem:
        """The calibration images as a :class:`Problem` (traceable; without covariances).

        Args:
            max_elevation: bound on the offsets, mm.
            probe: the protocol's, where the distances are to be handed over beside the points.
        """
        mask = jnp.ones(self.points.shape[0], self.points.dtype)
        channels = None
        if probe is not None and self.distances is not None:
            heard = (self.distances > 0).astype(mask.dtype)
            positions = jnp.asarray(probe.element_positions(), mask.dtype)
            channels = Channels(heard * self.distances, heard, positions)
        return Problem(
            channels=channels,
            sound_speed=None if probe is None else jnp.asarray(probe.sound_speed_m_s, mask.dtype),
            delay=None if probe is None else jnp.asarray(probe.delay_s, mask.dtype),
            curved=isinstance(probe, CurvilinearProbe),
            poses=self.poses,
            measurements=self.points,
            mask=mask,
            spacing=jnp.ones(2, mask.dtype),
            face_offset=jnp.zeros((), mask.dtype),
            max_elevation=None if max_elevation is None else max_elevation * mask,
        )


def simulate(key: Key[Array, ""], protocol: Protocol) -> Experiment:
    """Draw one experiment; vmap over keys for a batch.

    Args:
        key: a JAX key; for trial k of a study ``jax.random.fold_in(root, k)``, so that draws do not
            depend on chunks or devices.
        protocol: the distributions.
    """
    keys = jax.random.split(key, 9)
    probe = protocol.probe
    curved = isinstance(probe, CurvilinearProbe)
    width = protocol.sector * probe.half_angle_rad if curved else protocol.lateral_mm
    shallow, deep = protocol.depth_mm
    field = jnp.asarray([width, 0.5 * abs(deep - shallow)])
    middle = jnp.asarray([0.0, 0.5 * (shallow + deep)])
    truth = jaxlie.SE3.from_rotation_and_translation(
        _rotation(keys[0], np.pi), 50.0 * jax.random.normal(keys[1], (3,))
    )
    point = 100.0 * jax.random.normal(keys[2], (3,))

    n = protocol.images
    lateral, depth = _positions(keys[3], n, field, middle)
    if curved:
        lateral, depth = _from_sector(lateral, depth, probe.radius_mm)
    draw = standard_offsets(keys[4], protocol.elevation_distribution, n)
    elevation = protocol.elevation_mm * draw
    poses = _poses(keys[5], truth, point, jnp.stack([lateral, elevation, depth], -1), protocol)

    noise = protocol.noise_mm * jax.random.normal(keys[6], (n, probe.elements))
    if curved:
        elements = jnp.asarray(probe.element_positions())
        target = jnp.stack([lateral, elevation, depth], -1)
        measured = jnp.linalg.norm(target[:, None] - elements, axis=-1) + noise
        fit = fit_in_plane(measured, elements)
        points, inverse = fit.position, fit.inverse_normal
    else:
        elements = jnp.asarray(probe.element_lateral())
        exact_range = jnp.hypot(elevation, depth)
        measured = jnp.hypot(lateral[:, None] - elements, exact_range[:, None]) + noise
        points, inverse = fit_distances(measured, elements)

    m = protocol.test_images
    across, deep = _positions(keys[7], m, protocol.test_fraction * field, middle)
    if curved:
        across, deep = _from_sector(across, deep, probe.radius_mm)
    test = jnp.stack([across, deep], -1)
    in_plane = jnp.stack([test[:, 0], jnp.zeros(m), test[:, 1]], -1)
    return Experiment(
        poses=_tracked(jax.random.fold_in(keys[5], n), poses, protocol),
        points=points,
        covariance=protocol.noise_mm**2 * inverse,
        elevation=elevation,
        image_to_probe=matrix_from_rotation(truth.rotation().as_matrix(), truth.translation()),
        point=point,
        test_poses=_poses(keys[8], truth, point, in_plane, protocol),
        test_points=test,
        distances=measured if protocol.raw or curved else None,
    )


def _from_sector(
    angle: Float[Array, " count"], depth: Float[Array, " count"], radius: float
) -> tuple[Float[Array, " count"], Float[Array, " count"]]:
    """Lateral and axial from the direction (rad) and the range from the arc."""
    lateral = (radius + depth) * jnp.sin(angle)
    return lateral, depth * jnp.cos(angle) - 2 * radius * jnp.sin(angle / 2) ** 2


def _positions(
    key: Key[Array, ""], count: int, half: Float[Array, 2], middle: Float[Array, 2]
) -> tuple[Float[Array, " count"], Float[Array, " count"]]:
    draw = jax.random.uniform(key, (count, 2), minval=-1.0, maxval=1.0)
    positions = middle + half * draw
    return positions[:, 0], positions[:, 1]


def _rotation(key: Key[Array, ""], largest: Scalar) -> jaxlie.SO3:
    axis_key, angle_key = jax.random.split(key)
    axis = jax.random.normal(axis_key, (3,))
    angle = jax.random.uniform(angle_key, (), maxval=largest)
    return jaxlie.SO3.exp(angle * axis / jnp.linalg.norm(axis))


def _poses(
    key: Key[Array, ""],
    truth: jaxlie.SE3,
    point: Float[Array, 3],
    in_image: Float[Array, "n 3"],
    protocol: Protocol,
) -> Float[Array, "n 4 4"]:
    """Poses that put the target where it was drawn: t_i = c - R_i X p_i."""

    def pose(key: Key[Array, ""], position: Float[Array, 3]) -> Float[Array, "4 4"]:
        rotation = _rotation(key, protocol.rotation_rad)
        translation = point - rotation.apply(truth.apply(position))
        return matrix_from_rotation(rotation.as_matrix(), translation)

    return jax.vmap(pose)(jax.random.split(key, in_image.shape[0]), in_image)


def times_of_flight(
    distances: Float[np.ndarray, "*batch elements"], probe: Probe, clock_hz: float | None = None
) -> Float[np.ndarray, "*batch elements"]:
    """One-way times as the electronics would report them, s.

    Args:
        distances: measured, mm; what noise made negative is no answer (NaN).
        probe: its sound speed and delay apply.
        clock_hz: the counter's frequency: times are rounded to its period; None: not at all.

    Raises:
        InputError: a clock that is not positive.
    """
    times = probe.time_of_flight_s(np.where(np.asarray(distances) > 0, distances, np.nan))
    if clock_hz is None:
        return times
    if not (np.isfinite(clock_hz) and clock_hz > 0):
        raise InputError(f"the clock needs a positive frequency in Hz, not {clock_hz}")
    return np.round(times * clock_hz) / clock_hz


def _tracked(
    key: Key[Array, ""], poses: Float[Array, "n 4 4"], protocol: Protocol
) -> Float[Array, "n 4 4"]:
    """The poses as the tracker reports them: errors of its position, and of its rotation."""
    numbers = (protocol.tracker_mm, protocol.tracker_rad)
    if not any(is_traced(number) or number > 0 for number in numbers):
        return poses
    errors = jax.random.normal(key, (poses.shape[0], 6))

    def one(pose: Float[Array, "4 4"], error: Float[Array, " 6"]) -> Float[Array, "4 4"]:
        turned = jaxlie.SO3.exp(protocol.tracker_rad * error[3:]).as_matrix()
        moved = pose[:3, 3] + protocol.tracker_mm * error[:3]
        return matrix_from_rotation(pose[:3, :3] @ turned, moved)

    return jax.vmap(one)(poses, errors)


def simulate_recording(
    protocol: Protocol, seed: int = 0, *, clock_hz: float | None = None
) -> Recording:
    """One simulated experiment as a :class:`Recording` with truth and test set.

    Args:
        protocol: the distributions; where it is ``raw`` or its probe curvilinear, the calibration
            images hold times of flight, otherwise points. Test images always hold points.
        seed: of the draws.
        clock_hz: times of flight are rounded to this clock.
    """
    curved = isinstance(protocol.probe, CurvilinearProbe)
    if clock_hz is not None and not (protocol.raw or curved):
        raise InputError("a clock rounds times of flight: it needs a raw simulation")
    flags = quick_to_compile(jax.default_backend())
    program = jax.jit(simulate, static_argnums=1, compiler_options=flags)
    experiment = program(jax.random.key(seed), protocol)
    array = {name: np.asarray(value) for name, value in vars(experiment).items()}
    if experiment.distances is None:
        calibration = make_images(
            array["poses"],
            array["points"],
            covariance=array["covariance"] if protocol.noise_mm > 0 else None,
            where="simulation",
        )
    else:
        times = times_of_flight(array["distances"], protocol.probe, clock_hz)
        calibration = make_images(array["poses"], times, "time_of_flight", where="simulation")
    return Recording(
        calibration=calibration,
        test=make_images(array["test_poses"], array["test_points"], where="simulation"),
        truth=Truth(array["image_to_probe"], array["point"], array["elevation"]),
        probe=protocol.probe,
        source=f"simulation (seed {seed})",
    )
