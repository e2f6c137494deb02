"""The loop over a batch: a large one, whose last problems go on alone, ends as a small one does."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from conftest import problem
from jaxtyping import Array

import jaxcal
from jaxcal.model.batch import ImagePlanes, Iterate
from jaxcal.model.observations import OwnCovariances
from jaxcal.model.unknowns import RIGID
from jaxcal.solvers import batch_loop
from jaxcal.solvers.batch_loop import LARGE_BATCH, PROBLEMS_PER_STRAGGLER, until_done
from jaxcal.solvers.levenberg_marquardt import Minimum, minimise
from jaxcal.solvers.start import closed_form


class Halving(eqx.Module):
    """Numbers that are halved until they are small."""

    value: Array
    passes: Array
    active: Array


def test_the_last_problems_go_on_alone():
    draws = np.random.default_rng(20261126)
    begun = draws.uniform(1, 10, LARGE_BATCH)
    hard = draws.choice(LARGE_BATCH, LARGE_BATCH // PROBLEMS_PER_STRAGGLER // 2, replace=False)
    begun[hard] *= 2.0 ** draws.integers(20, 60, len(hard))
    begun[-1] *= 2.0**70
    widths = []

    def step(state: Halving, data: tuple[Array, Array]) -> Halving:
        by, one = data
        widths.append(by.shape[0])
        value = jnp.where(state.active, state.value * by[:, 0] * one, state.value)
        return Halving(value, state.passes + state.active, state.active & (value > 1))

    shares = np.tile(draws.choice([0.25, 0.5], (LARGE_BATCH, 1)), (1, 3))
    state = Halving(jnp.asarray(begun), jnp.zeros(LARGE_BATCH, int), jnp.ones(LARGE_BATCH, bool))
    data = jnp.asarray(shares), jnp.ones(())  # the second is that of all problems
    found = jax.jit(lambda: until_done(step, state, data, lambda s: s.active))()
    passes = np.maximum(1, np.ceil(-np.log(begun) / np.log(shares[:, 0])))
    np.testing.assert_array_equal(found.passes, passes)
    np.testing.assert_allclose(found.value, begun * shares[:, 0] ** passes, rtol=1e-12)
    assert not found.active.any()
    assert {*widths} == {LARGE_BATCH, LARGE_BATCH // PROBLEMS_PER_STRAGGLER}


def test_a_solver_does_not_notice(monkeypatch):
    """Every array of its data goes on with its own problem."""
    monkeypatch.setattr(batch_loop, "LARGE_BATCH", 24)
    draws = np.random.default_rng(3)
    problems = jaxcal.stack([problem(seed, images=8, noise_mm=0.3) for seed in range(24)])
    far = np.zeros((9, 24))
    far[4, -1] = 1.0  # only this one is still active in the end
    shape = jnp.asarray(draws.uniform(0.5, 2, (3, 24, 8)) * [[[1]], [[0.1]], [[1]]])
    sigma = draws.uniform(0.1, 1, (3, 24))
    observation = OwnCovariances(jnp.asarray(sigma), shape, jnp.asarray(sigma[1] / sigma[0]))

    @jax.jit
    def begun(problems: jaxcal.Problem) -> tuple[Iterate, ImagePlanes]:
        images = ImagePlanes.of(problems)
        start, *_ = closed_form(images, RIGID)
        return start.moved(jnp.asarray(far)), images

    start, images = begun(problems)

    def solved(*, together: bool) -> Minimum:
        solve = jax.jit(partial(minimise, max_steps=30, together=together))
        return solve(start, observation, images)

    alone, whole = solved(together=False), solved(together=True)
    assert whole.converged.all()
    assert (whole.iterations[-1] > whole.iterations[:-1] + 1).all()
    np.testing.assert_array_equal(alone.iterations, whole.iterations)
    for found, expected in zip(
        jax.tree.leaves(alone.iterate), jax.tree.leaves(whole.iterate), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)
