"""Prior auto: the laws' moments, expectation propagation, evidence, intervals, and the whole."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import problem
from scipy.integrate import quad
from scipy.stats import multivariate_normal, norm, t, uniform

import jaxcal
from jaxcal import InputError
from jaxcal.diagnostics.intervals import degrees_of_freedom
from jaxcal.diagnostics.offset_fit import offset_law
from jaxcal.diagnostics.warnings import _bound_not_kept
from jaxcal.model.distributions import FAMILIES, UNIFORM
from jaxcal.model.shapes import tilted
from jaxcal.solvers.auto import Answers, median, weights
from jaxcal.solvers.dense import inverse_batch_last
from jaxcal.solvers.expectation_propagation import Marginal, Sites
from jaxcal.solvers.expectation_propagation import propagate as propagate_batch_last
from jaxcal.solvers.offset_mean import (
    LAGS,
    MEAN_SD,
    PROBABILITY,
    log_evidence_gain,
    mean_belief,
    trust_in,
)

DENSITY = {
    "uniform": uniform(-(3**0.5), 2 * 3**0.5).pdf,
    "bell": lambda u: np.where(u**2 < 7, 15 / (16 * 7**0.5) * (1 - u**2 / 7) ** 2, 0.0),
    "gaussian": norm.pdf,
    "student": t(4, scale=0.5**0.5).pdf,
}


tilted_of = jax.jit(tilted, static_argnums=0)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("cut", [None, (-0.4, 0.9)])
def test_moments_are_those_of_the_product(family, cut):
    sd = 2.0
    low, high = (-30.0, 30.0) if cut is None else cut
    edges = [-(7**0.5) * sd, -(3**0.5) * sd, 3**0.5 * sd, 7**0.5 * sd]
    for mean, variance in ((0.3, 0.2), (3.0, 0.3), (-4.2, 0.5), (1.0, 4.0)):

        def product(u: float, power: int, mean=mean, variance=variance) -> float:
            gauss = norm.pdf(u, mean, np.sqrt(variance))
            return u**power * DENSITY[family](u / sd) / sd * gauss

        points = [p for p in (*edges, mean) if low < p < high]
        moment = [quad(product, low, high, args=(k,), points=points, limit=200, epsabs=0)[0]
                  for k in range(3)]  # fmt: skip
        interval = None if cut is None else tuple(jnp.asarray([end]) for end in cut)
        at = (jnp.asarray([sd]), jnp.asarray([[mean]]), jnp.asarray([[variance]]))
        found = jax.tree.map(np.asarray, tilted_of(family, *at, interval))
        true_mean = moment[1] / moment[0]
        true_variance = moment[2] / moment[0] - true_mean**2
        assert float(np.log(found.mass[0, 0]) + found.log_factor[0, 0]) == pytest.approx(
            np.log(moment[0]), abs=3e-3
        )
        assert float(found.mean[0, 0]) == pytest.approx(true_mean, abs=2e-3)
        assert float(found.variance[0, 0]) == pytest.approx(true_variance, rel=0.02)


def test_inverse_and_determinant_of_a_positive_matrix():
    rng = np.random.default_rng(0)
    design = rng.normal(size=(20, 10)) * np.logspace(-3, 3, 10)
    matrix = design.T @ design
    sd = np.sqrt(np.diag(matrix))
    both = jnp.stack([jnp.asarray(matrix), -jnp.eye(10)], axis=-1)
    inverses, determinants = inverse_batch_last(both)
    wanted = np.linalg.inv(matrix / np.outer(sd, sd))
    np.testing.assert_allclose(inverses[..., 0] * np.outer(sd, sd), wanted, rtol=1e-9, atol=1e-12)
    assert float(determinants[0]) == pytest.approx(np.linalg.slogdet(matrix)[1], rel=1e-12)
    assert np.isnan(np.asarray(inverses[..., 1])).all()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Linear:
    """Offsets q_i = h_i'x + o_i of a few unknowns with a Gaussian likelihood."""

    information: jax.Array
    gradient: jax.Array
    direction: jax.Array
    offset: jax.Array
    used: jax.Array


class Found(NamedTuple):
    """What is looked at of a propagation."""

    mean: jax.Array
    covariance: jax.Array
    log_evidence: jax.Array
    log_evidence_change: jax.Array
    change: jax.Array


@partial(jax.jit, static_argnames=("families", "sweeps"))
def propagate(linear: Linear, families, sd, sweeps: int | None = None) -> Found:
    """As a batch of one, in the solver's six unknowns; no image sees those that are added."""
    count = linear.gradient.shape[0]
    more = 6 - count
    more_sweeps = {} if sweeps is None else {"sweeps": sweeps}
    information = jnp.eye(6).at[:count, :count].set(linear.information)
    direction = jnp.pad(linear.direction, ((0, 0), (0, more))) * linear.used[:, None]
    offset = linear.offset * linear.used
    known = Marginal(
        information[..., None],
        jnp.pad(linear.gradient, (0, more))[:, None],
        jnp.zeros((4, 1)),
        jnp.zeros((4, 6, 1)),
        jnp.eye(4)[..., None],
    )
    sites = Sites([column[None] for column in direction.T], offset[None], linear.used[None], None)
    squares, pull = direction.T @ direction, direction.T @ offset
    found = propagate_batch_last(
        known, sites, squares[..., None], pull[:, None], families, sd[:, None], **more_sweeps
    )
    return Found(
        mean=found.mean[:count, :, 0].T,
        covariance=jnp.moveaxis(found.covariance[:count, :count, :, 0], -1, 0),
        log_evidence=found.log_evidence[:, 0],
        log_evidence_change=found.log_evidence_change[:, 0],
        change=found.change[:, 0],
    )


@jax.jit
def weights_of(found: Found, prior: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The distributions' probabilities, and which have finite results."""
    return weights(found.log_evidence, found.log_evidence_change, found.change, prior)


def linear_problem(n: int = 12) -> Linear:
    """Two unknowns, n offsets, one image left out."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(2, 2))
    used = np.ones(n)
    used[3] = 0
    return Linear(
        information=jnp.asarray(root @ root.T + 0.5 * np.eye(2)),
        gradient=jnp.asarray(rng.normal(size=2)),
        direction=jnp.asarray(rng.normal(size=(n, 2)) * used[:, None]),
        offset=jnp.asarray(rng.uniform(-1, 1, n) * used),
        used=jnp.asarray(used),
    )


@pytest.mark.slow
def test_expectation_propagation_against_integration():
    linear = linear_problem()
    sd = jnp.asarray([1.1, 1.0, 0.8, 0.9])
    found = propagate(linear, FAMILIES, sd)
    axis = np.linspace(-6, 6, 1201)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    base = -0.5 * np.einsum("kp,pq,kq->k", grid, linear.information, grid)
    base = base + grid @ np.asarray(linear.gradient)
    used = np.asarray(linear.used) > 0
    offsets = (np.asarray(linear.offset) + grid @ np.asarray(linear.direction).T)[:, used]
    evidence = []
    for k, family in enumerate(FAMILIES):
        with np.errstate(divide="ignore"):
            laws = np.log(DENSITY[family](offsets / float(sd[k])) / float(sd[k]))
        weight = np.exp(base + laws.sum(axis=1))
        mean = weight @ grid / weight.sum()
        apart = grid - mean
        covariance = np.einsum("k,kp,kq->pq", weight, apart, apart) / weight.sum()
        evidence.append(np.log(weight.sum() * 1e-4 / (2 * np.pi)))
        size = np.sqrt(np.diag(covariance))
        exact = family == "gaussian"
        np.testing.assert_allclose(found.mean[k] / size, mean / size, atol=1e-3 if exact else 0.06)
        np.testing.assert_allclose(
            found.covariance[k] / np.outer(size, size), covariance / np.outer(size, size),
            atol=2e-3 if exact else 0.08,
        )  # fmt: skip
    np.testing.assert_allclose(found.log_evidence, evidence, atol=0.05)
    assert np.max(found.change) < 0.1


def test_a_law_that_excludes_an_image_does_not_count():
    linear = linear_problem()
    far = np.array(linear.offset)
    far[5] = 9.0
    information = jnp.asarray(100 * np.asarray(linear.information))
    linear = replace(linear, information=information, offset=jnp.asarray(far))
    found = propagate(linear, FAMILIES, jnp.asarray([1.0] * len(FAMILIES)))
    prior = jnp.asarray([0.25] * len(FAMILIES))
    weight, good = map(np.asarray, weights_of(found, prior))
    shares = dict(zip(FAMILIES, (weight * good).tolist(), strict=True))
    assert shares["uniform"] < 1e-6
    assert FAMILIES[int(np.argmax(weight))] == "student"


def test_laws_in_turn_settle_where_long_sweeps_do():
    """Each from the sites of the one before, against many sweeps."""
    linear = linear_problem(n=40)
    families = tuple(shape.family for shape in UNIFORM)
    sd = jnp.asarray([1.2 * shape.stretch for shape in UNIFORM])
    assert np.all(np.diff(np.asarray(sd)) < 0)
    found = propagate(linear, families, sd)
    settled = propagate(linear, families, sd, sweeps=20)
    assert np.asarray(settled.change).max() < 1e-3
    size = np.sqrt(np.diagonal(settled.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(found.mean / size, settled.mean / size, atol=0.1)
    np.testing.assert_allclose(found.log_evidence, settled.log_evidence, atol=0.05)


def test_rounding_does_not_decide_where_a_distribution_excludes_images():
    """Images drawn with replacement: the evidence rises and falls by hundreds between sweeps."""
    rng = np.random.default_rng(43)
    count = 40
    root = rng.normal(size=(6, 6)) * [3, 3, 3, 3, 3, 0.3]
    direction = rng.normal(size=(count, 6))
    offset = rng.standard_t(3, size=count)
    drawn = np.sort(rng.integers(0, count, count))
    linear = Linear(
        information=jnp.asarray(10 * root @ root.T),
        gradient=jnp.asarray(rng.normal(size=6)),
        direction=jnp.asarray(direction[drawn]),
        offset=jnp.asarray((offset / offset.std())[drawn]),
        used=jnp.ones(count),
    )
    families = (*(shape.family for shape in UNIFORM), "gaussian")
    sd = jnp.asarray([*(shape.stretch for shape in UNIFORM), 1.0])
    answers = []
    for relative in (0.0, 1e-12):
        rounded = linear.offset * (1 + relative * rng.normal(size=count))
        found = propagate(replace(linear, offset=rounded), families, sd)
        weight, good = weights_of(found, jnp.ones_like(sd))
        answers.append(weight @ jnp.where(good[:, None], found.mean, 0.0))
    np.testing.assert_allclose(answers[1], answers[0], atol=1e-6)


def answers_of(means: np.ndarray, covariance: np.ndarray, weight: np.ndarray) -> Answers:
    """Laws' answers, batch axis last, all of them numbers."""
    counted = jnp.ones(weight.shape[1:], bool)
    return Answers(
        *(jnp.asarray(each) for each in (means, covariance, weight, 0 * weight)), counted
    )


def test_the_median_is_where_the_expected_distance_is_least():
    rng = np.random.default_rng(3)
    # One unknown: E |x - N(m, s^2)| of the mixture, over x.
    means, sd = np.array([0.0, 1.0, 4.0]), np.array([0.3, 0.5, 0.8])
    weight = np.array([0.5, 0.2, 0.3])
    at_median = jax.jit(median)
    found, variance = at_median(
        answers_of(means[None, :, None], (sd**2)[None, None, :, None], weight[:, None]),
        jnp.ones((1, 1, 1)),
    )
    axis = np.linspace(-1, 5, 6001)
    z = (axis[:, None] - means) / sd
    distance = sd * (2 * norm.pdf(z) + z * (2 * norm.cdf(z) - 1))
    best = axis[np.argmin(distance @ weight)]
    assert abs(float(found[0, 0]) - best) < 0.1 < abs(weight @ means - best)
    about = weight @ (sd**2 + (means - float(found[0, 0])) ** 2)
    assert float(variance[0, 0, 0]) == pytest.approx(about)
    # Several problems, any metric: only a law that has all the weight is in the answer, and where
    # none counts there are still numbers.
    root = rng.normal(size=(4, 4))
    squares = np.stack([root @ root.T] * 2, axis=-1)
    only = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    means = rng.normal(size=(4, 3, 2))
    within = np.broadcast_to(np.eye(4)[..., None, None], (4, 4, 3, 2))
    found, _ = at_median(answers_of(means, within, only), jnp.asarray(squares))
    np.testing.assert_allclose(found, means[:, 1] * [1, 0])


believed_of = jax.jit(mean_belief)


@pytest.mark.parametrize("trust", [1.0, 0.3])
def test_the_belief_about_the_mean_is_the_mixtures(trust):
    """Against integration over b of both priors times the likelihood, to the power of the trust."""
    sd = 1.3
    prior = norm(0, MEAN_SD * sd)
    for at, width in ((0.4, 0.5), (3.0, 1.0), (-6.0, 0.8), (2.0, 30.0)):
        # The Gaussian belief under the second prior alone is what goes in.
        variance = 1 / (1 / width**2 + 1 / prior.var())
        mean = variance * at / width**2
        found = believed_of(
            jnp.asarray(mean), jnp.asarray(variance), jnp.asarray(sd), jnp.asarray(trust)
        )

        def moment(power: int, at=at, width=width) -> float:
            def product(b: float) -> float:
                return b**power * prior.pdf(b) * np.exp(-0.5 * trust * ((b - at) / width) ** 2)

            points = [0.0, at, prior.var() / (prior.var() + width**2 / trust) * at]
            return quad(product, -40, 40, points=points, limit=400, epsabs=0)[0]

        without = np.exp(-0.5 * trust * (at / width) ** 2)
        with_it = moment(0)
        share = PROBABILITY * with_it / (PROBABILITY * with_it + (1 - PROBABILITY) * without)
        assert float(found.probability) == pytest.approx(share, rel=1e-6)
        expected = share * moment(1) / with_it
        assert float(found.mean) == pytest.approx(expected, rel=1e-6)
        square = share * moment(2) / with_it
        assert float(found.variance) == pytest.approx(square - expected**2, rel=1e-6)
        gain = np.log(PROBABILITY + (1 - PROBABILITY) * without / with_it)
        assert float(log_evidence_gain(found)) == pytest.approx(gain, abs=1e-6)


def test_trust_falls_with_heavy_tails_and_with_errors_alike_in_successive_images():
    rng = np.random.default_rng(5)
    pure = rng.normal(size=(400, 60)) / np.sqrt(60)
    alike = np.apply_along_axis(lambda row: np.convolve(row, np.ones(4) / 2, "same"), 1, pure)
    tails = rng.standard_t(2.5, size=(400, 60)) / np.sqrt(60)
    trusted = jax.jit(trust_in)
    trust = {
        name: np.asarray(trusted(jnp.ones(400), jnp.asarray(moved), jnp.full(moved.shape, 1 / 60)))
        for name, moved in (("pure", pure), ("alike", alike), ("tails", tails))
    }
    assert all((values <= 1).all() for values in trust.values())
    assert np.median(trust["pure"]) > 0.7
    assert np.median(trust["alike"]) < 0.6
    assert np.median(trust["tails"]) < 0.6
    # Images left out say nothing, and fewer images than lags are no harm.
    few = jnp.asarray(pure[:, : LAGS - 2])
    assert np.isfinite(trusted(jnp.ones(400), few, few**2)).all()


@pytest.mark.slow
def test_a_mean_that_the_edges_deny_is_not_believed():
    """Two of 300 draws of exact uniform offsets: the Gaussian believes in a mean in both."""
    protocol = jaxcal.Protocol(
        images=30, elevation_mm=5.0, noise_mm=0.0, elevation_distribution="uniform"
    )
    drawn = [
        jaxcal.Problem.from_recording(jaxcal.simulate_recording(protocol, k)) for k in (119, 224)
    ]
    law = jaxcal.calibrate_batch(replace(jaxcal.stack(drawn), covariance=None)).offset_law
    assert law is not None
    # The Gaussian's log odds are 3.5 and 3.7.
    assert law.mean_probability[1] < 0.5 < law.mean_probability[0]


@pytest.mark.slow
def test_a_one_sided_law_is_found_and_mended():
    drawn = [problem(k, images=50, elevation_distribution="one-sided", elevation_mm=5.0,
                     noise_mm=0.5) for k in range(8)]  # fmt: skip
    problems = jaxcal.stack(drawn)
    auto = jaxcal.calibrate_batch(problems)
    plain = jaxcal.calibrate_batch(problems, prior="gaussian")
    truth = [jaxcal.simulate_recording(
        jaxcal.Protocol(images=50, elevation_distribution="one-sided", elevation_mm=5.0,
                        noise_mm=0.5), k).test for k in range(8)]  # fmt: skip

    def precision(result: jaxcal.Calibration) -> float:
        return np.mean([
            jaxcal.reconstruction_precision(x, test.poses, test.measurements)
            for x, test in zip(result.image_to_probe, truth, strict=True)
        ])  # fmt: skip

    law = auto.offset_law
    assert law is not None
    assert plain.offset_law is None
    assert (auto.prior, plain.prior) == ("auto", "gaussian")
    assert np.asarray(law.weighed).all()
    assert np.mean(law.mean_probability) > 0.7
    assert precision(auto) < 0.5 * precision(plain)
    np.testing.assert_allclose(np.sum(law.probability, axis=1), 1, rtol=1e-9)
    one = jax.tree.map(lambda leaf: leaf[int(np.argmax(law.mean_probability))], auto)
    said = offset_law(one.numpy())
    assert said is not None
    assert "about a mean of" in str(said["words"])
    # The offsets are 0 to 5 mm: their mean is 2.5 mm on the side that the image frame tells.
    assert abs(abs(float(one.offset_law.mean)) - 2.5) < 1.0


@pytest.mark.slow
def test_bounds_are_respected():
    data = problem(3, images=20, elevation_mm=2.0, noise_mm=2.0)
    free = jaxcal.calibrate(data)
    largest = int(np.argmax(np.abs(free.elevation)))
    bound = np.full(20, 10.0)
    bound[largest] = 0.2
    cut = jaxcal.calibrate(data, max_elevation=bound)
    assert abs(float(cut.elevation[largest])) < 0.3 < abs(float(free.elevation[largest]))
    assert float(cut.elevation_sd[largest]) < float(free.elevation_sd[largest])


@pytest.mark.slow
def test_few_files_lie_between_a_problem_and_its_answer():
    """Whoever follows a call whose program is there already has so many files to read."""
    data = problem(3, images=20, elevation_mm=2.0, noise_mm=2.0)
    jaxcal.calibrate(data)
    entered = set()
    sys.setprofile(lambda frame, *_: entered.add(frame.f_code.co_filename))
    try:
        jaxcal.calibrate(data)
    finally:
        sys.setprofile(None)
    home = Path(jaxcal.__file__).parent
    files = sorted(file for file in entered if home in Path(file).parents)
    assert 5 < len(files) <= 15, files


@pytest.mark.slow
def test_a_bound_that_the_images_deny_is_named():
    data = problem(3, images=20, elevation_mm=2.0)
    denied = jaxcal.calibrate(data, max_elevation=1e-3)
    assert not denied.offset_law.weighed
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(denied.offset_law))
    found = [warning for warning in denied.warnings if "the bound on the offsets" in warning]
    assert len(found) == 1
    assert "was not kept: 20 of 20 images" in found[0]
    # An image that a robust solve leaves out is still in its problem.
    (said,) = _bound_not_kept(replace(denied, mask=denied.mask.at[0].set(0.0)))
    assert "was not kept: 19 of 19 images" in said
    kept = jaxcal.calibrate(data, max_elevation=2.5)
    assert not any("bound on the offsets" in warning for warning in kept.warnings)


def test_what_does_not_go_together_is_refused():
    data = problem(3, images=20)
    for arguments, said in (
        ({"prior": "gaussian", "max_elevation": 1.0}, "max_elevation belongs"),
        ({"sigma": (1.0, 1.0, 1.0), "max_elevation": 1.0}, "max_elevation belongs"),
        ({"sigma": (1.0, 1.0, 1.0), "prior": "uniform"}, "tunes its SDs"),
    ):
        with pytest.raises(InputError, match=said):
            jaxcal.calibrate(data, **arguments)


@pytest.mark.slow
def test_predicted_tre_and_intervals_follow_from_the_covariance():
    data = problem(5, images=20, elevation_mm=2.0, noise_mm=2.0)
    result = jaxcal.calibrate(data)
    left = float(degrees_of_freedom(result))
    assert left == pytest.approx(17)
    sd = np.sqrt(np.diag(result.covariance))
    np.testing.assert_allclose(
        jaxcal.transform_intervals(result, 0.9), t(17).ppf(0.95) * sd, rtol=1e-9
    )
    points = np.array([[[10.0, 30.0], [-20.0, 70.0]], [[0.0, 50.0], [5.0, 1.0]]])
    draws = multivariate_normal(np.zeros(6), result.covariance).rvs(40_000, random_state=0)
    there = np.stack([points[..., 0], 0 * points[..., 0], points[..., 1]], axis=-1)
    moved = draws[:, None, None, :3] + np.cross(draws[:, None, None, 3:], there)
    expected = np.sqrt(np.mean(np.sum(moved**2, axis=-1), axis=0) * left / (left - 2))
    found = jaxcal.predicted_tre(result, points)
    assert found.shape == (2, 2)
    np.testing.assert_allclose(found, expected, rtol=0.02)
    with pytest.raises(InputError, match="between 0 and 1"):
        jaxcal.transform_intervals(result, 95.0)


@pytest.mark.slow
def test_own_covariances_are_used_where_they_are_right():
    recording = jaxcal.simulate_recording(
        jaxcal.Protocol(images=50, elevation_mm=2.0, noise_mm=2.0), 4
    )
    right = jaxcal.Problem.from_recording(recording)
    assert right.covariance is not None
    # The same covariances, handed to the wrong images.
    wrong = replace(right, covariance=jnp.roll(right.covariance, 17, axis=0))
    both = jaxcal.calibrate_batch(jaxcal.stack([right, wrong]))
    assert both.offset_law is not None
    assert both.offset_law.own_probability[0] > 0.99
    assert both.offset_law.own_probability[1] < 0.01


@pytest.mark.slow
def test_own_covariances_mean_the_same_in_pixels_that_are_not_square():
    """Own covariances fix the ratio of lateral and range SDs, in mm."""
    images = jaxcal.simulate_recording(jaxcal.Protocol(images=50), 3).calibration
    assert images.covariance is not None

    def of_size(size: np.ndarray) -> jaxcal.Problem:
        return jaxcal.Problem.from_arrays(
            images.poses,
            images.measurements / size,
            covariance=images.covariance / np.outer(size, size),
            kind="pixel",
            spacing_mm=size,
        )

    sizes = np.array([[0.2, 0.2], [0.3, 0.1]])
    found = jaxcal.calibrate_batch(jaxcal.stack([of_size(size) for size in sizes]))
    assert found.offset_law is not None
    assert (found.offset_law.own_probability > 0.5).all()
    square, other = found[0], found[1]
    np.testing.assert_allclose(other.image_to_probe, square.image_to_probe, atol=1e-9)
    np.testing.assert_allclose(other.covariance, square.covariance, rtol=1e-6, atol=1e-12)
