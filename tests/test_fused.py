"""The fused kernel against the readable reference, and against itself."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from jaxcal.model.parameters import RIGID, Parameters
from jaxcal.model.priors import Bounded, Explicit, Gaussian, InPlane
from jaxcal.simulation import Protocol, simulate
from jaxcal.solvers import lanes, unrolled
from jaxcal.solvers.fused import (
    Belief,
    Circle,
    Guess,
    Held,
    Images,
    Measured,
    Term,
    accumulate,
    targets,
)
from jaxcal.solvers.least_squares import minimise
from jaxcal.solvers.moments import Moments

LANES, IMAGES = 6, 20
SIGMA = (0.3, 0.4, 0.5)
OFFSET_SD = 1.5
TIGHT = 1e-12


@pytest.fixture(scope="module")
def drawn():
    """Problems, one image left out of each, and a start half a degree and half a mm off."""
    protocol = Protocol(images=IMAGES, elevation_mm=2.0, noise_mm=1.0)
    keys = jax.random.split(jax.random.key(3), LANES)
    experiments = jax.jit(jax.vmap(partial(simulate, protocol=protocol)))(keys)
    problems = jax.vmap(lambda experiment: experiment.problem())(experiments)
    mask = problems.mask.at[:, 4].set(0.0)
    measurements = problems.measurements.at[:, 4].set(jnp.nan)
    problems = type(problems)(**(vars(problems) | {"mask": mask, "measurements": measurements}))
    truth = experiments.image_to_probe
    guess = Guess(
        jnp.moveaxis(truth[:, :3, :3], 0, -1), truth[:, :3, 3].T, experiments.point.T
    )  # fmt: skip
    move = jax.random.normal(jax.random.key(4), (9, LANES))
    move = move.at[3:6].multiply(np.radians(0.3)).at[:3].multiply(0.3).at[6:].multiply(0.3)
    return problems, guess.moved(list(move))


def beliefs(name):
    """A belief of the kernel and the reference's."""
    lanes_of = {
        "measured": Measured(jnp.tile(jnp.asarray(SIGMA)[:, None], LANES)),
        "circle": Circle(
            jnp.tile(jnp.asarray(SIGMA)[:, None], LANES), jnp.full(LANES, OFFSET_SD),
            jnp.full((LANES, IMAGES), jnp.inf),
        ),
        "bounded": Circle(
            jnp.ones((3, LANES)), jnp.full(LANES, jnp.inf), jnp.full((LANES, IMAGES), 0.7)
        ),
        "conventional": Held(jnp.zeros((LANES, IMAGES))),
    }  # fmt: skip
    references = {
        "measured": Gaussian(jnp.asarray(SIGMA)),
        "circle": Explicit(jnp.asarray(SIGMA), jnp.asarray(OFFSET_SD)),
        "bounded": Bounded(jnp.full(IMAGES, 0.7)),
        "conventional": InPlane(),
    }
    return lanes_of[name], references[name]


NAMES = ("measured", "circle", "bounded", "conventional")


@pytest.mark.parametrize("name", NAMES)
def test_sums_are_the_derivatives_of_the_cost(drawn, name):
    problems, guess = drawn
    belief, _ = beliefs(name)
    images, ones = Images.of(problems), jnp.ones(LANES)

    def cost(move):
        q, _ = targets(guess.moved(list(move)), images)
        return 0.5 * jnp.sum(belief.term(q, images, ones[:, None]).cost)

    zero, along = jnp.zeros((9, LANES)), jax.random.normal(jax.random.key(5), (9, LANES))
    normal = accumulate(guess, belief, images, ones)
    gradient, bent = jax.jit(partial(jax.jvp, jax.grad(cost)))((zero,), (along,))
    np.testing.assert_allclose(normal.gradient, gradient, atol=1e-12 * np.abs(gradient).max())
    np.testing.assert_allclose(jnp.sum(normal.cost), 2 * cost(zero), rtol=1e-12)
    expected = unrolled.apply(normal.matrix(), list(along))
    np.testing.assert_allclose(expected, bent, atol=1e-12 * np.abs(bent).max())


@pytest.mark.parametrize(
    "name",
    ["measured", "circle", *(pytest.param(name, marks=pytest.mark.slow) for name in NAMES[2:])],
)
def test_same_optimum_as_the_reference(drawn, name):
    problems, guess = drawn
    belief, prior = beliefs(name)
    found = jax.jit(partial(lanes.minimise, tolerance=TIGHT))(guess, belief, Images.of(problems))
    start: Parameters = guess.parameters()

    def reference(start, problem):
        return minimise(start, prior, problem, RIGID, exact=True, tolerance=TIGHT)

    clean = jnp.where(jnp.isnan(problems.measurements), 50.0, problems.measurements)
    problems = type(problems)(**(vars(problems) | {"measurements": clean}))
    expected = jax.jit(jax.vmap(reference))(start, problems)
    ours = found.guess.parameters()
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-11)
    if name == "bounded":
        # Minimisers may form an interval there; the cost is what both have to reach.
        return
    for part in ("rotation", "translation", "point"):
        difference = np.abs(getattr(ours, part) - getattr(expected.parameters, part))
        assert difference.max() < 1e-8, part  # 1e-10 of the lever arm
    assert not np.any(found.active)


@pytest.mark.parametrize("name", ["measured", "circle"])
def test_where_the_last_step_was_not_looked_at_the_gradient_is_gone_too(drawn, name):
    problems, guess = drawn
    belief, _ = beliefs(name)
    images = Images.of(problems)
    found = jax.jit(lanes.minimise)(guess, belief, images)
    rounding = lanes.Rounding.of(found.guess, belief, images)
    normal = accumulate(found.guess, belief, images, jnp.zeros(LANES))
    assert np.all(found.settled)
    assert np.all(found.cosine <= 1e-10)
    assert np.all(lanes.gradient_cosine(normal, rounding.vanished) <= 1e-10)
    # Its cost is that before the last step: higher, by nothing.
    np.testing.assert_allclose(found.cost, normal.cost, rtol=1e-10)


def test_offsets_are_the_closest_points_of_the_circles(drawn):
    problems, guess = drawn
    images = Images.of(problems)
    belief = Circle(
        jnp.tile(jnp.asarray(SIGMA)[:, None], LANES), jnp.full(LANES, OFFSET_SD),
        jnp.full((LANES, IMAGES), 0.8),
    )  # fmt: skip
    found = np.asarray(belief.offset(guess, images))
    q, _ = targets(guess, images)

    def cost(y, k, i):
        error = np.array([q[1][k, i] - y, q[2][k, i] - np.sqrt(images.distance[k, i] ** 2 - y**2)])
        return np.sum((error / np.asarray(SIGMA[1:])) ** 2) + (y / OFFSET_SD) ** 2

    for k, i in [(0, 0), (1, 7), (3, 12), (5, 19)]:
        best: Any = minimize_scalar(
            cost, bounds=(-0.8, 0.8), args=(k, i), method="bounded", options={"xatol": 1e-10}
        )
        assert abs(found[k, i] - best.x) < 1e-6
    assert np.all(found[:, 4] == 0)  # the image that is left out
    assert np.any(np.abs(found) == 0.8)


def test_a_step_turns_by_the_rotation_vector_to_third_order():
    vector = np.array([0.02, -0.03, 0.01])
    turn = np.array(unrolled.rotation(list(vector)))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-15)
    exact = Rotation.from_rotvec(vector).as_matrix()
    assert np.abs(turn - exact).max() < np.linalg.norm(vector) ** 3 / 12 * 1.01
    large = np.array(unrolled.rotation([2.0, -3.0, 5.0]))
    np.testing.assert_allclose(large @ large.T, np.eye(3), atol=1e-14)


def test_a_lost_lane_leaves_its_neighbours_alone(drawn):
    problems, guess = drawn
    belief, _ = beliefs("measured")
    images = Images.of(problems)
    run = jax.jit(lanes.minimise)
    whole = run(guess, belief, images)
    spoilt = images.lateral.at[2, 0].set(jnp.nan)
    images = Images(**(vars(images) | {"lateral": spoilt}))
    broken = run(guess, belief, images)
    others = np.delete(np.arange(LANES), 2)
    assert np.isnan(broken.cost[2])
    assert not broken.active[2]
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(broken), strict=True):
        assert np.array_equal(np.asarray(a)[..., others], np.asarray(b)[..., others])


class Planar(Belief):
    """q - (x, 0, r) with common weights: what the moments know, image by image."""

    weight: Float[Array, "3 lanes"]

    def term(self, q, images, gate):
        weight = [images.mask * value[:, None] for value in self.weight]
        errors = [q[0] - images.lateral, q[1], q[2] - images.distance]
        pull = [w * error for w, error in zip(weight, errors, strict=True)]
        cost = pull[0] * errors[0] + pull[1] * errors[1] + pull[2] * errors[2]
        return Term(cost, pull, [[weight[i] if i == j else 0 for j in range(3)] for i in range(3)])


def test_moments_give_the_normal_equations_of_all_images(drawn):
    problems, guess = drawn
    images = Images.of(problems)
    weight = jnp.asarray([4.0, 0.6, 2.0])[:, None] * jnp.linspace(0.5, 2.0, LANES)
    ours = Moments.of(images, guess.point - 3.0).normal(guess, weight)
    expected = accumulate(guess, Planar(weight), images, jnp.zeros(LANES))
    for part in ("curvature", "gradient", "cost"):
        scale = np.abs(getattr(expected, part)).max()
        np.testing.assert_allclose(getattr(ours, part), getattr(expected, part), atol=1e-13 * scale)


@pytest.mark.parametrize("name", ["measured", "circle", "bounded"])
def test_a_head_start_ends_at_the_same_optimum_sooner(drawn, name):
    problems, guess = drawn
    belief, _ = beliefs(name)
    images = Images.of(problems)
    away = guess.moved([jnp.full(LANES, value) for value in (9, -5, 7, 0.2, -0.1, 0.2, 8, 9, -4)])
    with_it, without = (
        jax.jit(partial(lanes.minimise, head_start=head_start))(away, belief, images)
        for head_start in (True, False)
    )
    assert np.all(with_it.settled)
    assert np.all(without.settled)
    np.testing.assert_allclose(with_it.cost, without.cost, rtol=1e-9)
    assert np.all(with_it.iterations < without.iterations)


def test_a_step_that_fails_is_tried_again_with_more_damping(drawn):
    """An exact curvature far from the optimum: without rejections there is no way down."""
    problems, guess = drawn
    belief, _ = beliefs("circle")
    images = Images.of(problems)
    away = guess.moved(
        [jnp.full(LANES, value) for value in (60, -50, 70, 1.5, -1, 1.2, 80, 90, -40)]
    )
    rounding = lanes.Rounding.of(away, belief, images)
    state = lanes.Descent.before(away, 1e-9, exact=True)
    step = jax.jit(
        lambda s: lanes.iterate(
            s, lambda g, gate: accumulate(g, belief, images, gate), rounding, 1e-10, 100
        )
    )
    failed = 0
    while np.any(state.active):
        before, state = state, step(state)
        # A place that is looked at again may be worth another cost: far away, what eliminating y
        # leaves of it depends on whether second derivatives are exact.
        taken = ~np.asarray(before.again)
        assert np.all(state.cost[taken] <= before.cost[taken] * (1 + 1e-9))
        failed += int(np.sum(state.again & state.active))
    assert failed > 0
    assert np.all(state.settled)
