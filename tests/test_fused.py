"""The fused kernel against the readable reference, and against itself."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.model.parameters import RIGID, Parameters
from jaxcal.model.priors import Bounded, Explicit, Gaussian, InPlane
from jaxcal.simulation import Protocol, simulate
from jaxcal.solvers import lanes, unrolled
from jaxcal.solvers.fused import Circle, Guess, Held, Images, Measured, accumulate, targets
from jaxcal.solvers.least_squares import minimise

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
    np.testing.assert_allclose(found.normal.cost, expected.cost, rtol=1e-11)
    if name == "bounded":
        # Minimisers may form an interval there; the cost is what both have to reach.
        return
    for part in ("rotation", "translation", "point"):
        difference = np.abs(getattr(ours, part) - getattr(expected.parameters, part))
        assert difference.max() < 1e-8, part  # 1e-10 of the lever arm
    assert not np.any(found.active)


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
    assert np.isnan(broken.normal.cost[2])
    assert not broken.active[2]
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(broken), strict=True):
        assert np.array_equal(np.asarray(a)[..., others], np.asarray(b)[..., others])
