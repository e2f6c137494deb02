"""A problem in a batch has the answer that it has alone, whatever its neighbours are."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import compiled_programs, experiment, problem, select

import jaxcal
from jaxcal.calibration.calibrate import Request, prepare
from jaxcal.calibration.resampling import relative_twist
from jaxcal.runtime import compiler

METHODS = {
    "conventional": {"method": "conventional"},
    "alternating": {"method": "alternating"},
    "bounded": {"prior": "bounded"},
    "given": {"sigma": (0.2, 0.2, 1.0)},
    "tracker": {"sigma": (0.2, 0.2, 1.0), "tracker_sd": 0.1},
    "gaussian": {"prior": "gaussian"},
    "auto": {},
    "robust": {"prior": "gaussian", "robust": True},
}
IMAGES = 11


def drawn(seed: int, **protocol) -> jaxcal.Problem:
    return select(problem(seed, images=12, **protocol), slice(IMAGES))


def hard_problems() -> tuple[list[jaxcal.Problem], list[jaxcal.Problem]]:
    """Ordinary ones; and each with something odd or wrong."""
    good = [drawn(k, elevation_mm=1.5, noise_mm=1.0) for k in range(9)]
    rest, outlier, parallel, lost, half, mirrored, row, pixel = (
        jax.tree.map(np.array, one) for one in good[1:]
    )
    rest.mask[3] = 0.0
    outlier.measurements[4, 0] += 30.0
    parallel.poses[:, :3, :3] = np.eye(3)
    lost.poses[3, 0, 3] = np.nan
    half.mask[3] = 0.5
    mirrored.poses[:, 0] *= -1.0
    row.poses[2, 3, 0] = 1.0
    pixel.spacing[1] = -1.0
    return good, [good[0], rest, outlier, parallel, lost, half, mirrored, row, pixel]


def test_bounds_of_a_batch_say_whether_they_are_of_problems_or_of_images():
    data = jaxcal.stack([drawn(k) for k in range(IMAGES)])  # as many problems as images
    bounds = np.linspace(0.5, 1.5, IMAGES)
    with pytest.raises(jaxcal.InputError, match=r"shape \(11, 11\) or \(11, 1\), mm; its shape"):
        jaxcal.calibrate_batch(data, prior="bounded", max_elevation=bounds)
    request = Request(prior="bounded", max_elevation=bounds[:, None])
    each = prepare(data, request)[0].max_elevation
    np.testing.assert_array_equal(each, np.repeat(bounds[:, None], IMAGES, 1))


LONG = [pytest.param(name, marks=pytest.mark.slow) for name in METHODS if name != "conventional"]


@pytest.mark.parametrize("name", ["conventional", *LONG])
def test_a_problem_of_a_batch_has_its_own_answer_beside_bad_ones(name):
    good, hard = hard_problems()
    result = jaxcal.calibrate_batch(jaxcal.stack(hard), **METHODS[name]).numpy()
    # The same program, the last six problems sound.
    sound = jaxcal.calibrate_batch(jaxcal.stack([*hard[:3], *good[3:]]), **METHODS[name]).numpy()
    assert result.status.tolist() == [*["converged"] * 3, "unobservable", *["failed"] * 5]
    assert sound.status.tolist() == ["converged"] * 9
    for field in ("covariance", "elevation_sd"):
        assert np.isnan(np.asarray(getattr(result, field))[3]).all()
    each = [jaxcal.calibrate(one, **METHODS[name]).numpy() for one in hard[:3]]
    alone = jax.tree.map(lambda *leaves: np.stack(leaves), *each)
    flat = [jax.tree_util.tree_leaves_with_path(each) for each in (result, sound, alone)]
    for (path, batched), (_, beside), (_, one) in zip(*flat, strict=True):
        where = jax.tree_util.keystr(path)
        batched, beside, one = (np.asarray(each)[:3] for each in (batched, beside, one))
        np.testing.assert_array_equal(batched, beside, err_msg=where)
        # One conventional problem has a closed form, without iterations.
        if where.rsplit(".")[-1] in ("iterations", "variance_rounds", "cost", "stationarity"):
            continue
        if where in (".weakest", ".prior_direction"):
            # A direction has no sign.
            across = np.abs(np.sum(batched * one, axis=-1))
            np.testing.assert_allclose(across, np.sum(one**2, axis=-1), atol=1e-6)
            continue
        if batched.dtype.kind != "f":
            np.testing.assert_array_equal(batched, one, err_msg=where)
            continue
        # The alternation stops before it is stationary, elsewhere by rounding.
        scale = np.nanmax(np.abs(one), initial=1e-12)
        np.testing.assert_allclose(batched / scale, one / scale, rtol=0, atol=1e-6, err_msg=where)


def test_a_conventional_fit_knows_the_size_of_each_axis_errors():
    """Offsets of 2 mm, points with 0.1 mm: intervals of all rotations hold the truth."""
    rng = np.random.default_rng(8)
    simulated = experiment(8, images=12)
    images, truth = simulated.calibration, np.asarray(simulated.truth.image_to_probe)
    middle = np.asarray(simulated.truth.point)
    turned = np.einsum("nij,jk->nik", images.poses[:IMAGES], truth)
    lateral, deep = rng.uniform(-20, 20, (300, IMAGES)), rng.uniform(20, 80, (300, IMAGES))
    q = np.stack([lateral, rng.normal(0, 2.0, lateral.shape), deep], axis=2)
    # The probe is moved so that the target is at q in its images.
    poses = np.broadcast_to(images.poses[:IMAGES], (300, IMAGES, 4, 4)).copy()
    seen = np.einsum("nij,knj->kni", turned[:, :3, :3], q) + turned[:, :3, 3]
    poses[..., :3, 3] += middle - seen
    points = np.stack([q[..., 0], np.hypot(q[..., 1], q[..., 2])], axis=2)
    points += rng.normal(0, 0.1, points.shape)
    one = jaxcal.Problem.from_arrays(poses[0], points[0])
    many = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (300, *np.shape(leaf))), one)
    # In pieces of 6, whose program is compiled already.
    batch = replace(many, poses=poses, measurements=points)
    result = jaxcal.calibrate_batch(batch, "conventional", chunk=6).numpy()
    off = relative_twist(truth, result.image_to_probe)
    inside = np.abs(off) <= jaxcal.transform_intervals(result)
    covered = np.mean(inside, axis=0)
    assert (covered[[0, 1, 2, 3, 5]] > 0.9).all()
    assert (covered[[1, 3, 5]] < 0.99).all()


def test_frames_of_one_pose_in_a_batch_are_told_of():
    """They are counted as independent: the SDs are too small, and the verdict says so."""
    images = experiment(3, images=12).calibration
    rows = [*range(6), *range(5)]
    one = jaxcal.Problem.from_arrays(images.poses[rows], images.measurements[rows])
    found = jaxcal.calibrate_batch(jaxcal.stack([one] * 6), "conventional")[0]
    told = f"{IMAGES} images have only 6 different poses, and each counts as independent"
    assert any(told in text for text in found.warnings)
    assert any("counted as independent" in line for line in found.verdict())
    alone = jaxcal.calibrate(one, "conventional")
    assert not any("counts as independent" in text for text in alone.warnings)


@pytest.mark.slow
def test_compiler_flags_change_rounding_only(monkeypatch):
    problems = jaxcal.stack([drawn(k, elevation_mm=1.5, noise_mm=1.0) for k in range(3)])
    fast = jaxcal.calibrate_batch(problems, method="conventional")
    again = jaxcal.calibrate_batch(problems, method="conventional")
    assert np.array_equal(fast.image_to_probe, again.image_to_probe)
    from jaxcal.calibration import pipeline

    pipeline.chunks.cache_clear()
    monkeypatch.setenv(compiler.SWITCH, "0")
    assert compiler.fast_to_run("cpu") is None
    plain = jaxcal.calibrate_batch(problems, method="conventional")
    pipeline.chunks.cache_clear()
    np.testing.assert_allclose(fast.image_to_probe, plain.image_to_probe, rtol=0, atol=1e-12)


def test_to_stack_problems_and_to_take_answers_compiles_nothing():
    """Each size of a batch left a dozen programs in memory when one of its answers was taken."""
    problems = [drawn(k % 3) for k in range(7)]
    problems[1] = select(problems[1], slice(7))
    jax.clear_caches()
    with compiled_programs() as compiled:
        batch = jaxcal.stack(problems)
    assert compiled == []
    found = jaxcal.calibrate_batch(batch, "conventional")
    assert isinstance(found.rms, jax.Array)
    with compiled_programs() as compiled:
        one, some = found[5], found[np.arange(7) > 4]
        sixth, last = batch[5], batch[-3:]
    assert compiled == []
    assert (len(batch), len(last), sixth.batch_shape) == (7, 3, ())
    assert isinstance(sixth.poses, jax.Array)
    np.testing.assert_array_equal(sixth.poses, problems[5].poses)
    assert [each.images for each in last] == [IMAGES] * 3
    again = jaxcal.calibrate_batch(last, "conventional")
    np.testing.assert_array_equal(again.image_to_probe, found.image_to_probe[-3:])
    with pytest.raises(jaxcal.InputError, match="one problem, not a batch of them"):
        list(sixth)
    assert isinstance(one.rms, jax.Array)
    assert (one.rms, one.problem.poses.dtype) == (found.rms[5], batch.poses.dtype)
    np.testing.assert_array_equal(some.point, found.point[5:])
    np.testing.assert_array_equal(batch.poses[5], problems[2].poses)
    np.testing.assert_array_equal(batch.poses[1, :7], problems[1].poses)
    assert batch.mask[1].tolist() == [1.0] * 7 + [0.0] * (IMAGES - 7)
    assert batch.measurements.dtype == problems[0].measurements.dtype


def test_stacking_unlike_problems_says_in_what_they_differ():
    one = drawn(0)
    bare = jaxcal.Problem.from_arrays(np.asarray(one.poses), np.asarray(one.measurements))
    with pytest.raises(jaxcal.InputError, match="do not hold the same: sound_speed, delay; give"):
        jaxcal.stack([one, bare])
    with pytest.raises(jaxcal.InputError, match="takes single problems, 1 is a batch"):
        jaxcal.stack([one, jaxcal.stack([one, one])])


def test_problems_without_images_are_refused():
    none = select(drawn(1), slice(0))
    with pytest.raises(jaxcal.InputError, match="no images"):
        jaxcal.calibrate_batch(jaxcal.stack([none, none]), "conventional")


def test_a_problem_of_fewer_images_has_its_own_answer():
    longer, shorter = (drawn(k, elevation_mm=1.5, noise_mm=1.0) for k in range(2))
    shorter = select(shorter, slice(8))
    found = jaxcal.calibrate_batch([shorter, longer], "conventional").numpy()
    assert found.images_used.tolist() == [8, IMAGES]
    for each, one in zip((found[0], found[1]), (shorter, longer), strict=True):
        alone = jaxcal.calibrate(one, "conventional").numpy()
        for field in ("image_to_probe", "point", "covariance"):
            np.testing.assert_allclose(
                getattr(each, field), getattr(alone, field), rtol=1e-7, atol=1e-9
            )
        assert not each.elevation[one.images :].any()


def test_problems_of_unlike_lengths_are_stacked_inside_transformations():
    problems = [drawn(0), select(drawn(1), slice(7))]
    traced = jax.eval_shape(lambda *each: jaxcal.stack(list(each)), *problems)
    assert traced.poses.shape == jaxcal.stack(problems).poses.shape == (2, IMAGES, 4, 4)


@pytest.mark.slow
def test_a_batch_has_the_derivatives_of_its_problems():
    problems = jaxcal.stack(
        [problem(k, images=12, elevation_mm=1.0, noise_mm=1.0) for k in range(3)]
    )
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(4, 4)))

    def value(result):
        return jnp.sum(weight * result.image_to_probe) + jnp.sum(result.covariance)

    def batch(measurements):
        moved = replace(problems, measurements=measurements)
        # Chunks of two: the derivative passes the loop over them.
        return value(jaxcal.calibrate_batch(moved, "conventional", chunk=2))

    def alone(measurements, one):
        return value(jaxcal.calibrate(replace(one, measurements=measurements), "conventional"))

    together = jax.jit(jax.grad(batch))(problems.measurements)
    each = jax.jit(jax.vmap(jax.grad(alone)))(problems.measurements, problems)
    np.testing.assert_allclose(together, each, rtol=1e-6, atol=1e-9)
