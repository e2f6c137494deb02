"""Simulated experiments after the paper's section 3.1, as a pure function of a key.

The target is imaged in n poses: lateral position and depth uniform over the field, the elevational
offset after one of the laws of :mod:`jaxcal.offsets`, the probe turned about a random axis by up to
30 degrees, and white noise on the distance to every element; lateral position and range are then
segmented from the distances by least squares on Eq. 5. The tracker may err, too. Test images lie in
the plane and carry no noise. The paper leaves the ranges open; the defaults reproduce its tables
(``test_fraction`` is a fitted choice: at 1.0 fewer cells agree).
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Key

from jaxcal.errors import InputError
from jaxcal.geometry import matrix_from_rotation
from jaxcal.offsets import OffsetLaw, check_law, standard_offsets
from jaxcal.probe import L14_5, LinearProbe
from jaxcal.problem import Problem, is_traced
from jaxcal.recording import MINIMUM_IMAGES, Recording, Truth, make_images
from jaxcal.segmentation.time_of_flight import fit_distances

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
        lateral_mm: the target's lateral position is uniform within +- this.
        depth_mm: its depth is uniform between these.
        rotation_rad: the probe is turned by up to this about a random axis.
        test_fraction: test positions cover this fraction of the field (0.75: fitted).
        probe: the transducer.
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
    probe: LinearProbe = L14_5
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
    """

    poses: Float[Array, "n 4 4"]
    points: Float[Array, "n 2"]
    covariance: Float[Array, "n 2 2"]
    elevation: Float[Array, " n"]
    image_to_probe: Float[Array, "4 4"]
    point: Float[Array, 3]
    test_poses: Float[Array, "m 4 4"]
    test_points: Float[Array, "m 2"]

    def problem(self, max_elevation: float | None = None) -> Problem:
        """The calibration images as a :class:`Problem` (traceable; without covariances)."""
        mask = jnp.ones(self.points.shape[0], self.points.dtype)
        return Problem(
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
    shallow, deep = protocol.depth_mm
    field = jnp.asarray([protocol.lateral_mm, 0.5 * abs(deep - shallow)])
    middle = jnp.asarray([0.0, 0.5 * (shallow + deep)])
    truth = jaxlie.SE3.from_rotation_and_translation(
        _rotation(keys[0], np.pi), 50.0 * jax.random.normal(keys[1], (3,))
    )
    point = 100.0 * jax.random.normal(keys[2], (3,))

    n = protocol.images
    lateral, depth = _positions(keys[3], n, field, middle)
    draw = standard_offsets(keys[4], protocol.elevation_distribution, n)
    elevation = protocol.elevation_mm * draw
    poses = _poses(keys[5], truth, point, jnp.stack([lateral, elevation, depth], -1), protocol)

    elements = jnp.asarray(protocol.probe.element_lateral())
    exact_range = jnp.hypot(elevation, depth)
    distances = jnp.hypot(lateral[:, None] - elements, exact_range[:, None])
    noise = jax.random.normal(keys[6], distances.shape)
    points, inverse = fit_distances(distances + protocol.noise_mm * noise, elements)

    m = protocol.test_images
    test = jnp.stack(_positions(keys[7], m, protocol.test_fraction * field, middle), -1)
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
    )


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


def simulate_recording(protocol: Protocol, seed: int = 0) -> Recording:
    """One simulated experiment as a :class:`Recording` with truth and test set.

    Args:
        protocol: the distributions.
        seed: of the draws.
    """
    experiment = jax.jit(simulate, static_argnums=1)(jax.random.key(seed), protocol)
    array = {name: np.asarray(value) for name, value in vars(experiment).items()}
    return Recording(
        calibration=make_images(
            array["poses"],
            array["points"],
            covariance=array["covariance"] if protocol.noise_mm > 0 else None,
            where="simulation",
        ),
        test=make_images(array["test_poses"], array["test_points"], where="simulation"),
        truth=Truth(array["image_to_probe"], array["point"], array["elevation"]),
        probe=protocol.probe,
        source=f"simulation (seed {seed})",
    )
