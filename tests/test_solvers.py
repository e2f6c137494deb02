"""One suite that every solver passes: recovery, sizes, masks, batches, derivatives, precision."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import angle, experiment, problem, select

import jaxcal
from jaxcal import Options
from jaxcal.data.probe import LinearProbe


@dataclass(frozen=True)
class Solver:
    """A way to call ``calibrate``, and what it is good for."""

    name: str
    arguments: dict
    self_tuning: bool = False
    # Plain gradient descent stops on a coarse tolerance, so its answers agree only so far.
    agreement: float = 1e-8


TIGHT = Options(tolerance_rad=1e-10, tolerance_mm=1e-8, max_rounds=20_000)
SOLVERS = [
    Solver("lm", {"method": "conventional"}),
    Solver("gauss-newton", {"method": "conventional", "options": Options(solver="gauss-newton")}),
    Solver(
        "gradient",
        {
            "method": "conventional",
            "options": Options(solver="gradient", gradient_tolerance=1e-11),
        },
        agreement=2e-4,
    ),
    Solver("alternating", {"method": "alternating", "options": TIGHT}, agreement=1e-6),
    Solver("bounded", {"method": "joint", "prior": "bounded"}),
    Solver("gaussian", {"method": "joint", "sigma": (0.3, 0.15, 1.0)}),
    Solver("gaussian-tracker", {"method": "joint", "sigma": (0.3, 0.15, 1.0), "tracker_sd": 0.1}),
    Solver("self-tuned", {"method": "joint", "prior": "gaussian"}, self_tuning=True),
]


@pytest.fixture(params=SOLVERS, ids=lambda s: s.name)
def solver(request: pytest.FixtureRequest) -> Solver:
    return request.param


def noisy(images: int = 12, seed: int = 3, **protocol) -> jaxcal.Problem:
    return problem(seed, images=images, **({"elevation_mm": 2.0, "noise_mm": 2.0} | protocol))


def assert_same(first: jaxcal.Calibration, second: jaxcal.Calibration, tolerance: float) -> None:
    np.testing.assert_allclose(first.image_to_probe, second.image_to_probe, atol=30 * tolerance)
    np.testing.assert_allclose(first.point, second.point, atol=30 * tolerance)


def test_recovers_the_truth_from_exact_data(solver):
    recording = jaxcal.simulate_recording(
        jaxcal.Protocol(images=12, elevation_mm=0.0, noise_mm=0.0), 1
    )
    # Rubbish in images left out, of which nothing may be seen.
    images = recording.calibration
    used, points = np.ones(12, bool), images.measurements.copy()
    used[[3, 8]] = False
    points[[3, 8]] = [[1e4], [np.nan]]
    spoilt = replace(recording, calibration=replace(images, mask=used, measurements=points))
    result = jaxcal.calibrate(spoilt, **solver.arguments)
    truth = recording.truth
    assert result.status == "converged"
    if result.prior == "bounded":
        # Exact data rest on no bound, so nothing but the bound confines some direction.
        assert "determined by nothing but the bound" in result.warnings[0]
    precision = 1e-7 if solver.agreement < 1e-5 else 1e-3
    assert angle(result.image_to_probe, truth.image_to_probe) < precision / 50
    np.testing.assert_allclose(result.image_to_probe, truth.image_to_probe, atol=precision)
    np.testing.assert_allclose(result.point, truth.point, atol=precision)
    np.testing.assert_allclose(result.elevation, 0, atol=precision)
    assert float(result.rms) < precision


def test_images_left_out_do_not_count(solver):
    everything = noisy(12, noise_mm=0.2, elevation_mm=0.3)
    # Of four images the bounded answer is hardly determined: it moves along a valley. Nine are
    # padded to twelve: one program.
    keep = np.array([0, 1, 2, 4, 5, 6, 7, 9, 11])
    mask = np.zeros(12)
    mask[keep] = 1
    rubbish, nowhere = np.array(everything.measurements), np.array(everything.poses)
    rubbish[mask == 0] = [[1e4], [np.nan], [1e4]]
    nowhere[8] = np.nan
    masked = replace(
        everything, mask=jnp.asarray(mask), measurements=jnp.asarray(rubbish),
        poses=jnp.asarray(nowhere),
    )  # fmt: skip
    left_out = jaxcal.calibrate(masked, **solver.arguments)
    without = jaxcal.calibrate(select(everything, keep), **solver.arguments)
    assert_same(left_out, without, solver.agreement)
    np.testing.assert_allclose(
        np.asarray(left_out.elevation)[keep], without.elevation, atol=100 * solver.agreement
    )
    np.testing.assert_allclose(left_out.rms, without.rms, atol=solver.agreement)
    assert int(left_out.images_used) == len(keep)
    assert np.all(np.asarray(left_out.elevation)[mask == 0] == 0)
    assert np.all(np.isfinite(left_out.covariance)) == np.all(np.isfinite(without.covariance))


@pytest.mark.slow
@pytest.mark.parametrize("images", [4, 1000])
def test_any_number_of_images(solver, images):
    recording = experiment(5, images=images, noise_mm=0.2, elevation_mm=0.3)
    arguments = solver.arguments
    if solver.name == "alternating":
        # Offsets that rest on no bound: the rounds shrink as k^-1.5 (8e-6 mm at 2,000, 3e-7 at
        # 20,000) and never reach the tight tolerance, so the method's own stopping rule counts.
        arguments = {"method": "alternating"}
    result = jaxcal.calibrate(recording, **arguments)
    assert result.status == "converged"
    assert result.elevation.shape == (images,)
    truth = recording.truth
    # Noise of 0.2 mm on 128 distances and offsets of 0.3 mm: mm with 4 images, hundredths with
    # 1000.
    assert np.linalg.norm(result.point - truth.point) < (20 if images == 4 else 0.3)
    assert angle(result.image_to_probe, truth.image_to_probe) < (0.2 if images == 4 else 0.01)
    if solver.self_tuning and images < 8:
        assert not result.sigma_tuned
        np.testing.assert_array_equal(result.sigma, [0.5, 0.5, 1.0])
        told = next(text for text in result.warnings if "held fixed" in text)
        assert "(lateral 0.5, range 0.5, elevational 1 mm)" in told
    elif solver.self_tuning:
        assert result.sigma_tuned
        realised = np.sqrt(np.mean(truth.elevation**2))
        assert float(result.sigma[2]) == pytest.approx(realised, rel=0.05)


@pytest.mark.parametrize(
    "solver",
    [s for s in SOLVERS if s.name not in ("lm", "alternating", "bounded")],
    ids=lambda s: s.name,
)
def test_batches_of_any_shape_and_bad_problems(solver):
    """Of the first of the solvers see test_batches.py, of those with bounds test_joint.py."""
    sound = [noisy(12, seed) for seed in range(5)]
    poisoned = replace(sound[0], poses=np.array(sound[0].poses))
    poisoned.poses[3, 0, 3] = np.nan
    too_few = replace(sound[1], mask=(np.arange(12) < 3).astype(float))
    batch = jaxcal.stack([sound[0], poisoned, sound[1], too_few, sound[2], sound[3]])
    batch = jax.tree.map(lambda leaf: np.asarray(leaf).reshape((2, 3, *leaf.shape[1:])), batch)
    result = jaxcal.calibrate_batch(batch, **solver.arguments, chunk=4).numpy()
    expected = [["converged", "failed", "converged"], ["failed", "converged", "converged"]]
    assert result.status.tolist() == expected
    assert result.image_to_probe.shape == (2, 3, 4, 4)
    assert np.isfinite(np.asarray(result.image_to_probe)[result.status == "converged"]).all()
    # With three images predicted errors were 1e-12 mm.
    assert np.isnan(np.asarray(result.covariance)[result.status == "failed"]).all()
    alone = jaxcal.calibrate(sound[2], **solver.arguments)
    third = jax.tree.map(lambda leaf: leaf[1, 1], result)
    assert_same(third, alone, solver.agreement)
    np.testing.assert_allclose(third.covariance, alone.covariance, rtol=1e-3)


def of_channels() -> jaxcal.Problem:
    """A linear probe's times of flight, few elements."""
    probe = LinearProbe(elements=8, pitch_mm=6.0)
    protocol = jaxcal.Protocol(images=12, elevation_mm=2.0, noise_mm=0.3, probe=probe, raw=True)
    return jaxcal.Problem.from_recording(jaxcal.simulate_recording(protocol, 3))


SD = {"sigma": (0.3, 0.15, 1.0)}
DERIVATIVES = {
    "conventional": {"method": "conventional"},
    "bounded": {"prior": "bounded"},
    "gaussian": {"prior": "gaussian"},
    "tracker": SD | {"tracker_sd": 0.1},
    "given": SD,
    "auto": {},
    "channels": {"sigma": (0.3, 1.0), "data": "channels"},
}
LATER = ("tracker", "given", "auto", "channels")
LONG = [pytest.param(name, marks=pytest.mark.slow) for name in (*LATER, "gaussian, forward")]


@pytest.mark.parametrize("name", [*list(DERIVATIVES)[:3], *LONG])
def test_derivatives_are_finite_differences(name):
    """By poses, measurements and given SDs; of some forward as well, by one program.

    The gradient is the transpose of the same rules, and with both the others compile far longer.
    """
    forwards = name in ("conventional", "bounded", "gaussian, forward")
    name = name.partition(",")[0]
    start = of_channels() if name == "channels" else noisy(12)
    rng = np.random.default_rng(0)
    weight = jnp.asarray(rng.normal(size=(4, 4)))
    given = {
        k: jnp.asarray(v) for k, v in DERIVATIVES[name].items() if k in ("sigma", "tracker_sd")
    }
    others = {k: v for k, v in DERIVATIVES[name].items() if k not in given}
    measured = start.measurements if start.channels is None else start.channels.distances
    data = (start.poses[:, :3, 3], measured, given)
    along = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), data)
    # A step of given SDs in their own size.
    along = (*along[:2], jax.tree.map(lambda step, value: 0.1 * value * step, along[2], given))

    def value(data):
        positions, measured, given = data
        moved = replace(start, poses=start.poses.at[:, :3, 3].set(positions))
        if start.channels is None:
            moved = replace(moved, measurements=measured)
        else:
            moved = replace(moved, channels=replace(start.channels, distances=measured))
        result = jaxcal.calibrate(moved, **others, **given)
        total = jnp.sum(weight * result.image_to_probe) + jnp.sum(result.point)
        total += jnp.sum(result.elevation[::2]) + result.convergence.cost
        return total, (result.differentiable, result.status_code)

    @jax.jit
    def everything(data):
        if not forwards:
            (found, facts), gradient = jax.value_and_grad(value, has_aux=True)(data)
            return found, None, gradient, facts
        found, push, facts = jax.linearize(value, data, has_aux=True)
        (gradient,) = jax.linear_transpose(push, data)(jnp.ones_like(found))
        return found, push(along), gradient, facts

    _, forward, gradient, (valid, status) = everything(data)
    assert valid
    assert status == jaxcal.Status.CONVERGED
    leaves = zip(jax.tree.leaves(gradient), jax.tree.leaves(along), strict=True)
    back = sum(np.sum(a * b) for a, b in leaves)
    if forward is not None:
        np.testing.assert_allclose(forward, back, rtol=1e-9)
    step = 1e-5
    ends = [
        everything(jax.tree.map(lambda v, d, h=h: v + h * d, data, along))[0] for h in (step, -step)
    ]
    np.testing.assert_allclose(back, (ends[0] - ends[1]) / (2 * step), rtol=1e-5)
    # Traced numbers are not checked before: one that is no SD had the answer of its magnitude.
    for number in given:
        no_sd = (*data[:2], given | {number: -given[number]})
        assert everything(no_sd)[-1][1] == jaxcal.Status.FAILED


@pytest.mark.slow
def test_second_derivatives_are_differences_of_the_first():
    """By a whole problem, forward over reverse; an image that is left out has no derivative."""
    start, rng = noisy(12), np.random.default_rng(0)
    start = replace(
        start,
        mask=start.mask.at[3].set(0.0),
        measurements=start.measurements.at[3].set(jnp.nan),
    )
    weight = jnp.asarray(rng.normal(size=(4, 4)))
    along = replace(
        jax.tree.map(jnp.zeros_like, start),
        measurements=jnp.asarray(rng.normal(size=start.measurements.shape)),
    )

    def value(problem):
        result = jaxcal.calibrate(problem, "conventional")
        total = jnp.sum(weight * result.image_to_probe) + jnp.sum(result.point)
        return total + jnp.sum(result.elevation[::2]) + jnp.sum(result.sigma)

    @jax.jit
    def both(problem):
        return jax.jvp(jax.grad(value), (problem,), (along,))

    first, second = both(start)
    step = 1e-4
    ends = [
        both(replace(start, measurements=start.measurements + h * along.measurements))[0]
        for h in (step, -step)
    ]
    for field in ("measurements", "poses"):
        found = getattr(second, field)
        difference = (getattr(ends[0], field) - getattr(ends[1], field)) / (2 * step)
        np.testing.assert_allclose(found, difference, atol=1e-5 * np.abs(found).max())
        assert not np.any(getattr(first, field)[3])
    assert not np.any(first.mask)


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS[1:4], ids=lambda s: s.name)
def test_derivative_of_the_other_minimisers_matches_finite_differences(solver):
    """They end where the implicit derivative is told that they do."""
    start = noisy(12)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(4, 4)))
    direction = jnp.asarray(np.random.default_rng(1).normal(size=start.measurements.shape))

    def value(step):
        moved = replace(start, measurements=start.measurements + step * direction)
        result = jaxcal.calibrate(moved, **solver.arguments)
        total = jnp.sum(weight * result.image_to_probe) + jnp.sum(result.point)
        return total + jnp.sum(result.elevation[::2]), (result.differentiable, result.status_code)

    compiled = jax.jit(jax.value_and_grad(value, has_aux=True))
    (_, (valid, status)), derivative = compiled(0.0)
    assert valid
    assert status == jaxcal.Status.CONVERGED
    # Gradient descent stops short of the minimum by more than a small step moves it.
    step = 1e-5 if solver.agreement < 1e-5 else 0.1
    difference = (compiled(step)[0][0] - compiled(-step)[0][0]) / (2 * step)
    tolerance = 1e-5 if solver.agreement < 1e-5 else 2e-2
    np.testing.assert_allclose(derivative, difference, rtol=tolerance)


@pytest.mark.parametrize("solver", SOLVERS[1:], ids=lambda s: s.name)
def test_float32(solver):
    """Of the first of the solvers see test_guest.py."""
    reference = noisy(12)
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), reference)
    arguments = dict(solver.arguments)
    options = arguments.get("options", Options())
    if solver.agreement > 1e-8:
        options = Options(solver=options.solver)
        if solver.name == "alternating":
            options = Options(tolerance_rad=1e-5, tolerance_mm=1e-3)
    arguments["options"] = replace(options, precision="float32")
    result = jaxcal.calibrate(single, **arguments)
    exact = jaxcal.calibrate(reference, **solver.arguments)
    assert result.image_to_probe.dtype == jnp.float32
    assert result.status == "converged"
    np.testing.assert_allclose(
        result.image_to_probe, exact.image_to_probe, atol=5e-3 if solver.agreement < 1e-5 else 0.1
    )
