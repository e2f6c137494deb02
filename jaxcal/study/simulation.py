"""Simulated experiments after the paper's section 3.1, as a pure function of a key.

The target is imaged in n poses. Lateral position and depth are uniform over the field, the
elevational offset has one of the laws of :mod:`jaxcal.study.offsets`, the probe is turned about a
random axis by up to 30 degrees, and the distance to every element has white noise. Lateral position
and range are then segmented from the distances by least squares on Eq. 5. The tracker may have
errors, too. Test images lie in the plane and carry no noise. The paper leaves the ranges open;
``experiments/paper_tables`` says which choices come near its tables (``test_fraction`` is fitted).

A curvilinear array sees a sector: the direction is uniform within 0.9 of its half angle, the depth
counts from the arc. Its data are the distances themselves; the points beside them are the in-plane
fit, which is what an image would show.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex64, Float, Int, Key

from jaxcal import InputError
from jaxcal.data.geometry import matrix_from_rotation
from jaxcal.data.probe import L14_5, CurvilinearProbe, Probe, check_probe
from jaxcal.data.problem import Channels, Problem
from jaxcal.data.recording import MINIMUM_IMAGES, MOST_IMAGES, Recording, Truth, make_images
from jaxcal.data.segmentation.deviations import fit_deviations, halves
from jaxcal.data.segmentation.time_of_flight import fit_in_plane
from jaxcal.model import unrolled
from jaxcal.runtime import executables
from jaxcal.runtime.arrays import is_traced
from jaxcal.runtime.compiler import ONE_PROBLEM, compiled, computed_once
from jaxcal.runtime.given_values import (
    LARGEST_SEED,
    check_flag,
    check_key,
    check_made,
    is_number,
    whole_number,
)
from jaxcal.runtime.jax_modes import in_own_modes, inside_transformation, require_float64
from jaxcal.runtime.messages import shown
from jaxcal.study import draws
from jaxcal.study.laws import LawName, check_law
from jaxcal.study.offsets import standard_offsets

Scalar = float | Float[Array, ""]
"""A number of a protocol: plain, or traced, so that one compiled program serves all its values."""


_LARGEST = {
    "elevation_mm": (1000, " mm"),
    "noise_mm": (1000, " mm"),
    "lateral_mm": (1000, " mm"),
    "depth_mm": (1000, " mm"),
    "rotation_rad": (4, " rad"),
    "test_fraction": (10, ""),
    "sector": (1, ""),
    "tracker_mm": (1000, " mm"),
    "tracker_rad": (1, " rad"),
}
"""Largest value and unit of the numbers of a protocol; the least is 0."""
NUMBERS = tuple(_LARGEST)
"""Fields of a protocol that are arguments of a program, so that one serves all their values."""


@dataclass(frozen=True)
class Protocol:
    """The distributions of a simulated experiment.

    The program that draws is compiled for given counts, law of the offsets, ``probe`` and ``raw``.
    Every other field may be a traced number (``dataclasses.replace`` inside the transformed
    function).

    Attributes:
        images: calibration images.
        test_images: noise-free in-plane test images.
        elevation_mm: bound or SD of the elevational offsets, depending on their distribution.
        elevation_distribution: their distribution, see :mod:`jaxcal.study.offsets`.
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
    elevation_distribution: LawName = "uniform"
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
        for name, least in (("images", MINIMUM_IMAGES), ("test_images", 0)):
            number = whole_number(name, getattr(self, name), least, MOST_IMAGES)
            object.__setattr__(self, name, number)
        try:
            shallow, deep = self.depth_mm
        except (TypeError, ValueError):
            raise InputError("depth_mm must be two numbers: nearest and farthest") from None
        for name, (largest, unit) in _LARGEST.items():
            for value in self.depth_mm if name == "depth_mm" else (getattr(self, name),):
                good = is_traced(value) or (is_number(value) and 0 <= value <= largest)
                if not good:
                    told = shown(value)
                    raise InputError(f"{name} must be between 0 and {largest}{unit}, not {told}")
        if not is_traced(self.depth_mm) and shallow > deep:
            raise InputError(f"depth_mm must be nearest, then farthest, not {self.depth_mm}")
        check_law(self.elevation_distribution)
        check_probe(self.probe)
        check_flag("raw", self.raw)


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
    point: Float[Array, " 3"]
    test_poses: Float[Array, "m 4 4"]
    test_points: Float[Array, "m 2"]
    distances: Float[Array, "n elements"] | None = None

    @in_own_modes
    def problem(self, max_elevation: float | None = None, probe: Probe | None = None) -> Problem:
        """The calibration images as a :class:`Problem` (traceable; without covariances).

        Experiments with leading axes, as ``jax.vmap`` makes them, become a batch of problems.

        Args:
            max_elevation: bound on the offsets, mm.
            probe: the protocol's, where the distances are to be handed over beside the points.
        """
        mask = jnp.ones(self.points.shape[:-1], self.points.dtype)
        batch, channels, speed, delay = mask.shape[:-1], None, None, None
        if probe is not None:
            speed = jnp.full(batch, probe.sound_speed_m_s, mask.dtype)
            delay = jnp.full(batch, probe.delay_s, mask.dtype)
        if probe is not None and self.distances is not None:
            heard = (self.distances > 0).astype(mask.dtype)
            elements = jnp.asarray(probe.element_positions(), mask.dtype)
            positions = jnp.broadcast_to(elements, (*batch, *elements.shape))
            channels = Channels(heard * self.distances, heard, positions)
        return Problem(
            channels=channels,
            sound_speed=speed,
            delay=delay,
            curved=isinstance(probe, CurvilinearProbe),
            poses=self.poses,
            measurements=self.points,
            mask=mask,
            spacing=jnp.ones((*batch, 2), mask.dtype),
            face_offset=jnp.zeros(batch, mask.dtype),
            max_elevation=None if max_elevation is None else max_elevation * mask,
        )


class Numbers(eqx.Module):
    """The random numbers of one experiment except the noise.

    Attributes:
        axis: of the rotations of X, of the images' poses and of the test images' poses.
        turn: angles about these axes, as fractions of the largest angle.
        place: X's origin and the target, in units of their SDs.
        position: of the target in images and test images, each coordinate between -1 and 1.
        offset: elevational offsets for a law of size 1.
        tracker: standard normals of the tracker's six errors, or None.
    """

    axis: Float[Array, "3 images"]
    turn: Float[Array, " images"]
    place: Float[Array, " 6"]
    position: Float[Array, "2 others"]
    offset: Float[Array, " n"]
    tracker: Float[Array, "6 n"] | None


_AXIS, _TURN, _PLACE, _POSITION, _NOISE, _TRACKER = range(6)
"""Streams of :mod:`jaxcal.study.draws`. Offsets have a folded key, as laws need several streams."""


class Planes(eqx.Module):
    """The geometry of one experiment in planes, as the solvers read it: images are the last axis.

    Attributes:
        rotation: R_i by rows.
        origin: b_i, mm.
        exact: true lateral position and range (curvilinear: depth), mm.
        elevation: y_i, mm.
        true_rotation: of X.
        true_translation: of X, mm.
        target: c, mm.
        test_rotation: of the test images.
        test_origin: of the test images, mm.
        test_point: of the test images, exact lateral position and range, mm.
    """

    rotation: Float[Array, "9 n"]
    origin: Float[Array, "3 n"]
    exact: Float[Array, "2 n"]
    elevation: Float[Array, " n"]
    true_rotation: Float[Array, "3 3"]
    true_translation: Float[Array, " 3"]
    target: Float[Array, " 3"]
    test_rotation: Float[Array, "9 m"]
    test_origin: Float[Array, "3 m"]
    test_point: Float[Array, "2 m"]


@in_own_modes
def simulate(key: Key[Array, ""], protocol: Protocol) -> Experiment:
    """Draw one experiment; ``jax.jit(jax.vmap(...))`` over keys for a batch.

    Args:
        key: a JAX key; for trial k of a study ``jax.random.fold_in(root, k)``, so that draws do not
            depend on chunks or devices.
        protocol: the distributions.

    Raises:
        InputError: what is not one key, or no protocol.
    """
    require_float64("jaxcal.simulate")
    check_key("key", key)
    check_made("protocol", protocol, Protocol, "jaxcal.Protocol")
    if inside_transformation(key, vars(protocol)):
        return _simulated(key, protocol)
    # Step by step it would be several hundred programs, and one more in every call.
    shape, numbers = split_protocol(protocol)
    program = compiled(_from_numbers, 2, next(iter(key.devices())).platform)
    return program(key, tuple(numbers.values()), shape)


def _simulated(key: Key[Array, ""], protocol: Protocol) -> Experiment:
    """Draw one experiment (traceable)."""
    numbers, noise = draw(key, protocol), draw_noise(key, protocol)
    planes = arrange(numbers, protocol)
    distances = _distances(planes, noise, protocol)
    if isinstance(protocol.probe, CurvilinearProbe):
        fit = fit_in_plane(distances, jnp.asarray(protocol.probe.element_positions()))
        points, inverse, kept = fit.position, fit.inverse_normal, True
    else:
        elements, kept = protocol.probe.element_lateral(), protocol.raw
        size = jnp.asarray(protocol.noise_mm, planes.exact.dtype)
        points = jnp.stack(
            fit_deviations(noise, size, planes.exact[0], planes.exact[1], elements), axis=1
        )
        inverse = _inverse_normal(points, elements)
    return Experiment(
        poses=_matrices(planes.rotation, planes.origin),
        points=points,
        covariance=protocol.noise_mm**2 * inverse,
        elevation=planes.elevation,
        image_to_probe=matrix_from_rotation(planes.true_rotation, planes.true_translation),
        point=planes.target,
        test_poses=_matrices(planes.test_rotation, planes.test_origin),
        test_points=planes.test_point.T,
        distances=distances if kept else None,
    )


def draw(key: Key[Array, ""], protocol: Protocol) -> Numbers:
    """The random numbers of one experiment; only static fields of the protocol matter."""
    return computed_once(lambda: _numbers(key, protocol), protocol.noise_mm)


def _numbers(key: Key[Array, ""], protocol: Protocol) -> Numbers:
    n, images = protocol.images, protocol.images + protocol.test_images
    position = draws.uniforms(key, _POSITION, 2 * images).reshape(2, images)
    tracker = draws.normals(key, _TRACKER, 6 * n).reshape(6, n) if _tracked(protocol) else None
    law = protocol.elevation_distribution
    return Numbers(
        axis=draws.unit_vectors(key, _AXIS, 1 + images),
        turn=draws.uniforms(key, _TURN, 1 + images),
        place=draws.normals(key, _PLACE, 6),
        position=2 * position - 1,
        offset=standard_offsets(jax.random.fold_in(key, 0), law, n),
        tracker=tracker,
    )


def draw_noise(key: Key[Array, ""], protocol: Protocol) -> Complex64[Array, "n half"]:
    """Standard normals of the elements.

    Real parts are for the first half of the elements, imaginary parts for the others.
    """
    shape = (protocol.images, -(-protocol.probe.elements // 2))
    return computed_once(lambda: draws.normal_pairs(key, _NOISE, shape), protocol.noise_mm)


def arrange(numbers: Numbers, protocol: Protocol) -> Planes:
    """Poses and targets from the random numbers; nothing is measured yet."""
    probe, n = protocol.probe, protocol.images
    curved = isinstance(probe, CurvilinearProbe)
    witness = protocol.noise_mm
    width = protocol.sector * probe.half_angle_rad if curved else protocol.lateral_mm
    shallow, deep = protocol.depth_mm
    middle, half = 0.5 * (shallow + deep), 0.5 * abs(deep - shallow)
    truth = _rotation(numbers.axis[:, :1], numbers.turn[:1] * np.pi, witness)
    truth = jnp.stack(truth).reshape(3, 3)
    translation, target = 50.0 * numbers.place[:3], 100.0 * numbers.place[3:]

    def positions(drawn: Array, fraction: Scalar) -> tuple[Array, Array]:
        across, depth = fraction * width * drawn[0], middle + fraction * half * drawn[1]
        if not isinstance(probe, CurvilinearProbe):
            return across, depth
        return _from_sector(across, depth, probe.radius_mm)

    lateral, depth = positions(numbers.position[:, :n], 1.0)
    across, far = positions(numbers.position[:, n:], protocol.test_fraction)
    elevation = protocol.elevation_mm * numbers.offset
    turns = _rotation(numbers.axis[:, 1:], numbers.turn[1:] * protocol.rotation_rad, witness)
    rotation, test_rotation = [row[:n] for row in turns], [row[n:] for row in turns]

    def origin(rotation: list[Array], in_image: list[Array | int]) -> list[Array]:
        # Poses put the target where it was drawn: t_i = c - R_i X p_i.
        in_probe = unrolled.apply([list(row) for row in truth], in_image)
        in_probe = [a + b for a, b in zip(in_probe, translation, strict=True)]
        turned = unrolled.apply(_rows(rotation), in_probe)
        return [c - value for c, value in zip(target, turned, strict=True)]

    tracked, origins = rotation, origin(rotation, [lateral, elevation, depth])
    if numbers.tracker is not None:
        slip = unrolled.rotation([protocol.tracker_rad * error for error in numbers.tracker[3:]])
        tracked = [entry for row in unrolled.product(_rows(rotation), slip) for entry in row]
        origins = [
            value + protocol.tracker_mm * error
            for value, error in zip(origins, numbers.tracker[:3], strict=True)
        ]
    exact = jnp.stack([lateral, depth if curved else jnp.hypot(elevation, depth)])
    return Planes(
        rotation=jnp.stack(tracked),
        origin=jnp.stack(origins),
        exact=exact,
        elevation=elevation,
        true_rotation=truth,
        true_translation=translation,
        target=target,
        test_rotation=jnp.stack(test_rotation),
        test_origin=jnp.stack(origin(test_rotation, [across, 0, far])),
        test_point=jnp.stack([across, far]),
    )


def _distances(
    planes: Planes, noise: Complex64[Array, "n half"], protocol: Protocol
) -> Float[Array, "n elements"]:
    """What the elements measure, mm."""
    probe = protocol.probe
    if isinstance(probe, CurvilinearProbe):
        target = jnp.stack([planes.exact[0], planes.elevation, planes.exact[1]], -1)
        elements = jnp.asarray(probe.element_positions())
        exact = jnp.linalg.norm(target[:, None] - elements, axis=-1)
    else:
        along = planes.exact[0][:, None] - jnp.asarray(probe.element_lateral())
        exact = jnp.hypot(along, planes.exact[1][:, None])
    return exact + protocol.noise_mm * jnp.concatenate(halves(noise, probe.elements), axis=1)


def _inverse_normal(
    points: Float[Array, "n 2"], elements: Float[np.ndarray, " elements"]
) -> Float[Array, "n 2 2"]:
    """Inverse of J'J of Eq. 5 at the points."""
    along, distance = points[:, :1] - elements, points[:, 1:]
    far = jnp.hypot(along, distance)
    jx, jr = along / far, distance / far
    a, b, c = jnp.sum(jx * jx, 1), jnp.sum(jx * jr, 1), jnp.sum(jr * jr, 1)
    rows = [jnp.stack([c, -b], axis=-1), jnp.stack([-b, a], axis=-1)]
    return jnp.stack(rows, axis=-2) / (a * c - b * b)[:, None, None]


def _rotation(
    axis: Float[Array, "3 count"], angle: Float[Array, " count"], witness: Scalar
) -> list[Array]:
    """Nine planes of rotations by angles (rad) about axes.

    By quaternions, which need no normalisation.
    """
    half = angle / (4 * np.pi)
    scalar, sine = computed_once(lambda: draws.circle(half), witness)
    vector = [sine * component for component in axis]
    double = 2 / (scalar * scalar + unrolled.dot(vector, vector))
    lever = unrolled.cross(vector)
    square = unrolled.product(lever, lever)
    return [
        unrolled.add(
            float(i == j), double * unrolled.add(unrolled.times(scalar, lever[i][j]), square[i][j])
        )
        for i in range(3)
        for j in range(3)
    ]


def _rows(planes: list[Array]) -> list[list[Array]]:
    return [planes[3 * i : 3 * i + 3] for i in range(3)]


def _matrices(rotation: Float[Array, "9 n"], origin: Float[Array, "3 n"]) -> Float[Array, "n 4 4"]:
    return jax.vmap(matrix_from_rotation)(rotation.T.reshape(-1, 3, 3), origin.T)


def _from_sector(
    angle: Float[Array, " count"], depth: Float[Array, " count"], radius: float
) -> tuple[Float[Array, " count"], Float[Array, " count"]]:
    """Lateral and axial from the direction (rad) and the range from the arc."""
    lateral = (radius + depth) * jnp.sin(angle)
    return lateral, depth * jnp.cos(angle) - 2 * radius * jnp.sin(angle / 2) ** 2


def _tracked(protocol: Protocol) -> bool:
    """Whether the tracker has errors; a traced size may be zero or not, so it counts as errors."""
    sizes = (protocol.tracker_mm, protocol.tracker_rad)
    return any(is_traced(size) or bool(size > 0) for size in sizes)


def times_of_flight(
    distances: Float[np.ndarray, "*batch elements"], probe: Probe, clock_hz: float | None = None
) -> Float[np.ndarray, "*batch elements"]:
    """One-way times as the electronics would report them, s.

    Args:
        distances: measured, mm; those that noise made negative become NaN (no answer).
        probe: its sound speed and delay apply.
        clock_hz: the counter's frequency: times are rounded to its period; None: not at all.

    Raises:
        InputError: a clock that is not positive, or so slow that a time becomes zero.
    """
    times = probe.time_of_flight_s(np.where(np.asarray(distances) > 0, distances, np.nan))
    if clock_hz is None:
        return times
    if not (is_number(clock_hz) and clock_hz > 0):
        raise InputError(f"the clock needs a positive frequency in Hz, not {shown(clock_hz)}")
    counted = np.round(times * clock_hz)
    if (counted == 0).any():
        raise InputError(f"a clock of {clock_hz:g} Hz is too slow: it counts no period of a time")
    return counted / clock_hz


def split_protocol(protocol: Protocol) -> tuple[Protocol, dict[str, np.ndarray]]:
    """What a program that draws is compiled for, and the numbers that are its arguments.

    A perfect tracker has no numbers, since nothing is drawn for it.
    """
    names = NUMBERS if _tracked(protocol) else NUMBERS[:-2]
    shape = replace(protocol, **{name: getattr(Protocol, name) for name in NUMBERS})
    return shape, {name: np.asarray(getattr(protocol, name), np.float64) for name in names}


def join_protocol(shape: Protocol, numbers: Mapping[str, Any]) -> Protocol:
    """The protocol of :func:`split_protocol`, whose numbers may be traced now."""
    shallow, deep = numbers["depth_mm"]
    return replace(shape, **{**numbers, "depth_mm": (shallow, deep)})


def _drawn(seed: int, protocol: Protocol) -> Experiment:
    """One experiment; on a CPU by a program that is kept."""
    shape, numbers = split_protocol(protocol)
    arguments = (np.asarray(seed, np.int64), tuple(numbers.values()))
    if executables.processor() is None:
        return jax.jit(_from_seed, static_argnums=2)(*arguments, shape)
    label = {"method": "simulation", "images": protocol.images}
    return executables.run(_from_seed, arguments, shape, flags=ONE_PROBLEM, label=label)


def _from_seed(seed: Int[Array, ""], sizes: tuple[Array, ...], shape: Protocol) -> Experiment:
    """Draw an experiment of a protocol whose numbers are traced."""
    return _from_numbers(jax.random.key(seed), sizes, shape)


def _from_numbers(key: Key[Array, ""], sizes: tuple[Array, ...], shape: Protocol) -> Experiment:
    """:func:`_from_seed` by a key."""
    numbers = dict(zip(NUMBERS, sizes, strict=False))  # a perfect tracker has no sizes
    return _simulated(key, join_protocol(shape, numbers))


@in_own_modes
def simulate_recording(
    protocol: Protocol, seed: int = 0, *, clock_hz: float | None = None
) -> Recording:
    """One simulated experiment as a :class:`Recording` with truth and test set.

    Args:
        protocol: the distributions; where it is ``raw`` or its probe curvilinear, the calibration
            images hold times of flight, otherwise points. Test images always hold points.
        seed: of the draws.
        clock_hz: times of flight are rounded to this clock.

    Raises:
        InputError: a seed that is no whole number from 0 to 2^63 - 1, or a clock without times.
    """
    check_made("protocol", protocol, Protocol, "jaxcal.Protocol")
    if is_traced(vars(protocol)):
        raise InputError("a recording has no traced numbers: jaxcal.simulate is for jit and vmap")
    seed = whole_number("seed", seed, 0, LARGEST_SEED)
    curved = isinstance(protocol.probe, CurvilinearProbe)
    if clock_hz is not None and not (protocol.raw or curved):
        raise InputError("a clock rounds times of flight: it needs a raw simulation")
    experiment = _drawn(seed, protocol)
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
    test = None
    if protocol.test_images:
        test = make_images(array["test_poses"], array["test_points"], where="simulation", minimum=1)
    return Recording(
        calibration=calibration,
        test=test,
        truth=Truth(array["image_to_probe"], array["point"], array["elevation"]),
        probe=protocol.probe,
        source=f"simulation (seed {seed})",
    )
