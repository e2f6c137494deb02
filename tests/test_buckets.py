"""Padding changes no answer, and one program serves every number of images of a size."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import problem as simulated
from conftest import select
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcal
from jaxcal.calibration import pipeline
from jaxcal.calibration.calibrate import Request, prepare
from jaxcal.data.problem import lengthened, taken
from jaxcal.runtime import executables
from jaxcal.runtime.arrays import each_image, first_images
from jaxcal.runtime.executables import FEWEST_PADDED, bucket, padded_images

METHODS: dict[str, dict] = {
    "alternating": {"method": "alternating", "max_elevation": 2.0},
    "auto": {},
}


@pytest.fixture(scope="module")
def problems() -> list[jaxcal.Problem]:
    return [simulated(seed, images=12, elevation_mm=2.0, noise_mm=0.5) for seed in (1, 2)]


def test_buckets_grow_by_a_half_or_a_third():
    expected = (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)
    assert tuple(sorted({bucket(n) for n in range(1, 513)})) == expected
    assert all(n <= bucket(n) for n in range(1, 2000))
    assert all(bucket(n) <= 1.5 * n for n in range(8, 2000))


def test_images_of_one_problem_double():
    assert sorted({padded_images(n) for n in range(4, 513)}) == [64, 128, 256, 512]
    assert all(n <= padded_images(n) < max(2 * n, FEWEST_PADDED + 1) for n in range(4, 2000))


def test_every_axis_of_images_is_known(problems):
    """What holds a number for each image is padded and cut; nothing else is."""
    result = jaxcal.calibrate(problems[0], "conventional").numpy()
    cut = first_images(result, 9)
    before, after = dict(shapes(result)), dict(shapes(cut))
    changed = {name for name in before if before[name] != after[name]}
    assert {"elevation", "mask", "problem.poses", "problem.measurements"} <= changed
    for name in changed:
        assert before[name][0] == 12
        assert after[name] == (9, *before[name][1:])
    assert all(12 not in shape for name, shape in before.items() if name not in changed)
    # What is computed when it is read is that of the images that are left.
    assert cut.residual.shape == (9, 3)
    assert cut.inspection.outlier.shape == (9,)
    raw = jaxcal.simulate_recording(jaxcal.Protocol(images=12, raw=True), 1)
    channels = lengthened(jaxcal.Problem.from_recording(raw), 16).channels
    assert channels is not None
    assert channels.distances.shape == channels.heard.shape == (16, 128)
    assert channels.elements.shape == (128, 3)


def shapes(tree, prefix=""):
    for field in fields(tree):
        value = getattr(tree, field.name)
        if is_dataclass(value):
            yield from shapes(value, f"{prefix}{field.name}.")
        elif hasattr(value, "shape"):
            yield prefix + field.name, value.shape


def with_garbage(problem: jaxcal.Problem, more: int) -> jaxcal.Problem:
    """Further images, masked, that hold no numbers."""
    count = problem.images
    longer = taken(problem, [*range(count), *[0] * more])
    mask = np.concatenate([np.asarray(problem.mask), np.zeros(more)])
    used = (mask > 0) | (np.arange(count + more) < count)

    def spoilt(values):
        return np.where(used.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)

    return replace(
        jax.tree.map(jnp.asarray, longer),
        mask=jnp.asarray(mask),
        poses=jnp.asarray(spoilt(longer.poses)),
        measurements=jnp.asarray(spoilt(longer.measurements)),
    )


def same(one: jaxcal.Calibration, other: jaxcal.Calibration, images: int) -> None:
    """Equal to 1e-10 SD, every decision included."""
    one, other = one.numpy(), first_images(other.numpy(), images)
    assert one.status == other.status
    for name in ("mask", "at_bound"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for name in ("searched_start", "tolerance_met"):
        ends = (getattr(each.convergence, name) for each in (one, other))
        np.testing.assert_array_equal(*ends)
    np.testing.assert_array_equal(one.outlier, other.outlier)
    if one.status == "failed":
        return
    moved = np.linalg.solve(np.asarray(one.image_to_probe), np.asarray(other.image_to_probe))
    turned = np.array([moved[2, 1], moved[0, 2], moved[1, 0]])
    sd = np.sqrt(np.diagonal(one.covariance))
    # mm and rad where there are no SDs.
    np.testing.assert_allclose(np.concatenate([moved[:3, 3], turned]), 0, atol=1e-9)
    if np.isfinite(sd).all():
        assert np.abs(np.concatenate([moved[:3, 3], turned]) / sd).max() < 1e-10
        np.testing.assert_allclose(other.covariance / np.outer(sd, sd),
                                   one.covariance / np.outer(sd, sd), atol=1e-8)  # fmt: skip
    np.testing.assert_allclose(other.elevation, one.elevation, atol=1e-9)
    np.testing.assert_allclose(other.residual, one.residual, atol=1e-9)
    np.testing.assert_allclose(other.sigma, one.sigma, rtol=1e-8)
    np.testing.assert_allclose(other.rms, one.rms, rtol=1e-9)


@pytest.mark.parametrize("name", METHODS)
def test_masked_images_beyond_the_bucket_change_nothing(name, problems):
    """From 5 to 12 images, some of them masked, padded to 64 and to 128.

    The conventional method is compared with the problem without padding below.
    """
    smaller = simulated(3, images=12, elevation_mm=2.0, noise_mm=0.5)
    sources = [
        *problems,
        jax.tree.map(jnp.asarray, taken(smaller, [*range(8), 0])),
    ]  # nine: one comes twice

    @settings(max_examples=12)
    @given(
        source=st.sampled_from(sources),
        count=st.integers(9, 12),
        left_out=st.sets(st.integers(0, 11), max_size=4),
        more=st.integers(FEWEST_PADDED - 11, 2 * FEWEST_PADDED - 12),
    )
    def holds(source, count, left_out, more):
        count = min(count, source.images)
        problem = select(source, slice(0, count))
        mask = jnp.asarray([float(k not in left_out) for k in range(count)])
        problem = replace(problem, mask=mask)
        padded = with_garbage(problem, 12 - count + more)
        assert padded_images(padded.images) == 2 * FEWEST_PADDED
        same(jaxcal.calibrate(problem, **METHODS[name]), jaxcal.calibrate(padded, **METHODS[name]),
             count)  # fmt: skip

    holds()


def test_images_left_out_between_others_change_nothing(problems):
    problem = problems[1]
    first = [0, 2, 4, 5, 6, 8, 9, 12, 15, 18, 22, 23]
    rows = [first.index(k) if k in first else 0 for k in range(24)]
    spread = jax.tree.map(jnp.asarray, taken(problem, rows))
    spread = replace(spread, mask=jnp.zeros(24).at[np.array(first)].set(1.0))
    found = jaxcal.calibrate(spread).numpy()
    found = each_image(found, lambda values, axis: np.take(values, first, axis))
    same(jaxcal.calibrate(problem), found, 12)


def test_the_answer_is_that_of_the_unpadded_problem(problems):
    nine = select(problems[0], slice(0, 9))
    nine, plan, given = prepare(nine, Request(method="conventional"))
    solved = jax.jit(pipeline.solve_one, static_argnums=4)(nine, given, None, None, plan)
    exact = solved.with_problem(nine)
    found = jaxcal.calibrate(nine, "conventional")
    assert found.elevation.shape == (9,)
    same(exact, found, 9)


@pytest.mark.parametrize("name", METHODS)
def test_every_number_of_images_in_a_bucket_is_one_program(problems, name):
    executables.forget()
    jax.clear_caches()
    jaxcal.calibrate(problems[1], **METHODS[name]).numpy()
    fewer = [select(problems[1], slice(0, count)) for count in (9, 10, 11)]
    compiled = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if "backend_compile" in event:
            compiled.append((event, duration_secs))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        several = [jaxcal.calibrate(each, **METHODS[name]).numpy() for each in fewer]
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert compiled == []
    assert len(executables._loaded) == 1  # nor is another one on the disk
    assert [found.images_used for found in several] == [9, 10, 11]
    assert all(np.isfinite(found.image_to_probe).all() for found in several)
    # No image rests on its bound, which leaves an interval of answers and no covariance.
    assert all(np.isfinite(found.covariance).all() == (name == "auto") for found in several)
