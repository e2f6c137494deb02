"""Sets that cannot determine X say so; weak ones say what is weak; nobody supplies a guess."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from conftest import problem, random_poses

import jaxcal
from jaxcal.model.batch import ImagePlanes, Iterate
from jaxcal.model.observations import InPlane
from jaxcal.model.parameters import Parameters
from jaxcal.model.residuals import target_in_image
from jaxcal.model.unknowns import RIGID
from jaxcal.solvers.levenberg_marquardt import minimise

METHODS = [
    {"method": "conventional"},
    {"method": "alternating"},
    {"method": "joint"},
    {"method": "joint", "prior": "bounded"},
]


def in_plane(rotations: np.ndarray, points: np.ndarray, noise: float = 0.05, seed: int = 0):
    """A problem with given probe rotations and [lateral, depth] points, and its true X."""
    truth = random_poses(1, 11)[0]
    target = np.array([30.0, -20.0, 100.0])
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3] = rotations
    image = np.stack([points[:, 0], 0 * points[:, 0], points[:, 1]], axis=1)
    probe = image @ truth[:3, :3].T + truth[:3, 3]
    poses[:, :3, 3] = target - np.einsum("nij,nj->ni", rotations, probe)
    measured = points + noise * np.random.default_rng(seed).normal(size=points.shape)
    # With a probe, as simulated recordings have one: problems of one structure share programs.
    recording = jaxcal.Recording(jaxcal.make_images(poses, measured), probe=jaxcal.LinearProbe())
    return jaxcal.Problem.from_recording(recording), truth


def turned(count: int, largest: float, seed: int = 0, axis: np.ndarray | None = None):
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(count, 3)) if axis is None else np.tile(axis, (count, 1))
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return Rotation.from_rotvec(axes * rng.uniform(-largest, largest, (count, 1))).as_matrix()


def spread(count: int, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(-25, 25, count), rng.uniform(15, 85, count)], axis=1)


@pytest.mark.parametrize("arguments", METHODS, ids=lambda a: "-".join(a.values()))
def test_degenerate_sets_are_unobservable_and_named(arguments):
    parallel, _ = in_plane(np.tile(np.eye(3), (12, 1, 1)), spread(12))
    axis = np.array([0.0, 0.0, 1.0])
    single, _ = in_plane(turned(12, 0.5, axis=axis), spread(12))
    for data, words in (
        (parallel, "translation along"),
        (single, "translation along"),
    ):
        bound = np.full(12, 5.0) if "prior" in arguments else None
        result = jaxcal.calibrate(data, **arguments, max_elevation=bound)
        assert result.status == "unobservable"
        assert words in result.observability["weakest_direction"]
        assert "not observable" in result.warnings[0]
        assert np.isnan(result.covariance).all()
        assert not result.differentiable


def test_rotation_about_one_axis_names_the_translation_along_it():
    truth = random_poses(1, 11)[0]
    # The axis common to all poses, here the image's own axial one seen from the probe.
    axis = truth[:3, 2]
    data, _ = in_plane(turned(12, 0.5, axis=axis), spread(12))
    result = jaxcal.calibrate(data, method="conventional")
    direction = result.observability["weakest_direction"]
    assert direction.startswith("translation along the axial axis")


def test_points_on_a_line_leave_a_rotation_open():
    points = spread(12)
    points[:, 1] = 50.0
    data, _ = in_plane(turned(12, 0.5), points, noise=0.0)
    result = jaxcal.calibrate(data, method="conventional")
    assert result.status == "unobservable"
    assert "rotation about the lateral axis" in result.observability["weakest_direction"]


@pytest.mark.slow
def test_a_start_drowned_in_noise_is_searched_for():
    data = problem(17, images=4, elevation_mm=5.0, noise_mm=10.0)
    result = jaxcal.calibrate(data, method="conventional")
    assert result.convergence.searched_start
    assert any("descents from many rotations" in warning for warning in result.warnings)
    # Noise of this size may well have moved the minimum; none better is near the truth, though.
    truth = jaxcal.simulate_recording(
        jaxcal.Protocol(images=4, elevation_mm=5.0, noise_mm=10.0), 17
    ).truth
    assert float(result.convergence.cost) <= float(
        cost_from(data, truth.image_to_probe, truth.point)
    ) * (1 + 1e-9)


@jax.jit
def cost_from(data, matrix, point):
    """That of the minimum which is found from these."""
    start = Parameters.of(matrix[:3, :3], matrix[:3, 3], point)
    alone, start = jax.tree.map(lambda leaf: leaf[None], (data, start))
    images = ImagePlanes.of(alone)
    return minimise(Iterate.of(start, RIGID), InPlane.of(images), images).cost[0]


def test_no_pose_is_advised_for_a_delay_of_points():
    """It is a shift along the axial axis, at any pose."""
    result = jaxcal.calibrate(problem(1, images=12), "conventional", estimate=("delay",))
    assert result.status == "unobservable"
    assert str(result.observability["advice"]).startswith("leave the delay out")
    said = result.verdict()
    assert any(line.startswith("- Leave the delay out: of points,") for line in said)
    assert not any("tilt" in line for line in said)


def test_a_narrow_cone_is_weak_but_solved():
    data, truth = in_plane(turned(12, np.radians(3.0)), spread(12), noise=0.02)
    result = jaxcal.calibrate(data, method="conventional")
    assert result.status == "converged"
    error = np.linalg.norm(np.asarray(result.image_to_probe)[:3, 3] - truth[:3, 3])
    sd = np.sqrt(np.trace(result.covariance[:3, :3]))
    assert 0.02 < sd < 5.0
    assert error < 4 * sd
    assert "translation" in result.observability["weakest_direction"]


def test_sds_that_determine_nothing_to_rounding_are_told():
    """The status was ``converged`` beside a covariance of NaN, or one far too small."""
    data = problem(3, images=12, noise_mm=0.1)
    for size in (1e6, 1e7):
        result = jaxcal.calibrate(data, prior="gaussian", sigma=(1 / size, 1 / size, size))
        assert result.status == "unobservable"
        assert not result.differentiable


def test_what_only_the_bound_fixes_is_said():
    data = problem(3, images=12, elevation_mm=0.5, noise_mm=0.2)
    for bound, held in ((10.0, "interval"), (0.2, "images are at the bound")):
        result = jaxcal.calibrate(data, prior="bounded", max_elevation=np.full(12, bound))
        about = [w for w in result.warnings if "nothing but the bound" in w]
        assert len(about) == 1
        assert "rotation about the lateral axis" in about[0]
        assert held in about[0]
        sight = result.observability
        assert sight["known_only_from_prior"] == "rotation about the lateral axis"
        if bound == 10.0:
            assert "rotation about the lateral axis" in sight["weakest_direction"]
            assert not result.differentiable
            assert np.isnan(result.covariance).all()


def test_an_offset_at_the_edge_of_its_bound_is_flagged():
    data = problem(3, images=12, elevation_mm=2.0, noise_mm=2.0)
    bounded = jaxcal.calibrate(data, prior="bounded", max_elevation=np.full(12, 1.0))
    assert bounded.differentiable
    free = np.flatnonzero(np.asarray(bounded.at_bound) == 0)
    edge = np.full(12, 1.0)
    # A bound that an inner offset just touches makes a kink there.
    edge[free[0]] = abs(float(bounded.elevation[free[0]]))
    kink = jaxcal.calibrate(data, prior="bounded", max_elevation=edge)
    assert not kink.differentiable


@jax.jit
def in_image(data, matrix, point):
    return target_in_image(Parameters.of(matrix[:3, :3], matrix[:3, 3], point), data)


@pytest.mark.slow
def test_predicted_covariance_is_the_scatter_of_repeats():
    count = 200
    base = problem(0, images=20, elevation_mm=1.0, noise_mm=2.0, elevation_distribution="normal")
    rng = np.random.default_rng(0)
    tiled = jax.tree.map(lambda leaf: np.tile(leaf, (count, *[1] * leaf.ndim)), base)
    fixed = jaxcal.calibrate_batch(tiled, sigma=(0.5, 0.5, 1.0))
    # Repeats of one geometry: errors drawn anew about a target placed where the model puts it.
    x, point = np.asarray(fixed.image_to_probe)[0], np.asarray(fixed.point)[0]
    q = np.asarray(in_image(base, x, point))
    rows = []
    for _ in range(count):
        offsets = rng.normal(size=20)
        # Moving the probe along its own elevational axis offsets the target by as much.
        poses = np.array(base.poses)
        axis = poses[:, :3, :3] @ x[:3, 1]
        poses[:, :3, 3] -= axis * (offsets - q[:, 1])[:, None]
        points = np.stack([q[:, 0], np.hypot(offsets, q[:, 2])], axis=1)
        rows.append((poses, points + 0.5 * rng.normal(size=points.shape)))
    poses, points = (np.stack(part) for part in zip(*rows, strict=True))
    problems = replace(tiled, poses=poses, measurements=points)
    results = jaxcal.calibrate_batch(problems, sigma=(0.5, 0.5, 1.0))
    moved = np.asarray(results.image_to_probe)
    lateral = (moved[:, :3, 3] - x[:3, 3]) @ x[:3, :3]
    relative = x[:3, :3].T @ moved[:, :3, :3]
    turns = np.stack(
        [relative[:, 2, 1] - relative[:, 1, 2], relative[:, 0, 2] - relative[:, 2, 0],
         relative[:, 1, 0] - relative[:, 0, 1]], axis=1) / 2  # fmt: skip
    error = np.concatenate([lateral, turns], axis=1)
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(results.covariance), error)
    # Mean of 200 chi-squares with 6 degrees of freedom: 6 with an SD of 0.25.
    assert 5.0 < squared.mean() < 7.0
