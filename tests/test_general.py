"""Our Levenberg-Marquardt on other people's problems, and the arrow-shaped one, against scipy."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import conftest
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares, root

import jaxcal
from jaxcal import backend
from jaxcal.model.parameters import Parameters
from jaxcal.solvers.general import LevenbergMarquardt, arrow_least_squares

POINTS = 12


def banana(unknowns, args):
    del args
    return {"valley": 10 * (unknowns[1] - unknowns[0] ** 2), "along": 1 - unknowns[0]}


def test_rosenbrock():
    start = jnp.asarray([-1.2, 1.0])
    solution = optx.least_squares(banana, LevenbergMarquardt(), start, max_steps=200)
    assert solution.result == optx.RESULTS.successful
    np.testing.assert_allclose(solution.value, [1, 1], atol=1e-10)


def test_root_find_judges_the_answers_residuals():
    """Its criterion is aux of the answer (which was that of the start), and ``atol`` (0)."""

    def beside(unknowns, shift):
        valley, along = banana(unknowns, None).values()
        return jnp.stack([valley, along + shift]), {"sum": jnp.sum(unknowns)}

    @jax.jit
    def find(shift):
        start = jnp.asarray([-1.2, 1.0])
        return optx.root_find(beside, LevenbergMarquardt(), start, shift, has_aux=True, throw=False)

    found = find(0.0)
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose(found.value, [1, 1], atol=1e-10)
    np.testing.assert_allclose(found.aux["sum"], 2, atol=1e-10)
    np.testing.assert_allclose(jax.jacobian(lambda shift: find(shift).value)(0.0), [1, 2])


def test_a_minimum_is_no_root():
    def apart(unknown, args):
        return 1e-3 * jnp.stack([unknown + 1, unknown - 1])

    found = optx.root_find(apart, LevenbergMarquardt(), jnp.asarray(1.0), throw=False)
    np.testing.assert_allclose(found.value, 0, atol=1e-9)
    assert found.result == optx.RESULTS.nonlinear_max_steps_reached


def test_the_tolerance_follows_the_dtype(noisy):
    """In float32, a gradient cosine of 1e-10 cannot be met: four more steps ended the loop."""
    start = {"size": jnp.ones((), jnp.float32), "rate": jnp.zeros((), jnp.float32)}
    data = jnp.asarray(noisy[0], jnp.float32)
    by_default = optx.least_squares(decay, LevenbergMarquardt(), start, data)
    stated = optx.least_squares(decay, LevenbergMarquardt(tolerance=1e-4), start, data)
    assert by_default.stats["num_steps"] == stated.stats["num_steps"]
    wide = fitted(jnp.asarray(noisy[0])).value
    np.testing.assert_allclose(by_default.value["rate"], wide["rate"], rtol=1e-3)


def decay(unknowns, data):
    time = jnp.linspace(0, 2, data.shape[0], dtype=data.dtype)
    return unknowns["size"] * jnp.exp(-unknowns["rate"] * time) - data


def fitted(data, steps: int = 100):
    start = {"size": jnp.asarray(1.0), "rate": jnp.asarray(0.1)}
    return optx.least_squares(decay, LevenbergMarquardt(), start, data, max_steps=steps)


@pytest.fixture(scope="module")
def noisy() -> np.ndarray:
    rng = np.random.default_rng(0)
    time = np.linspace(0, 2, POINTS)
    return 3 * np.exp(-1.5 * time) + 0.1 * rng.normal(size=(3, POINTS))


def test_a_curve_is_scipys_and_has_both_derivatives(noisy):
    """In a batch, by one program: the value, and the implicit derivative in both modes."""

    def value(data):
        found = fitted(data).value
        return found["size"] + 2 * found["rate"]

    along = np.random.default_rng(1).normal(size=POINTS)

    @jax.jit
    @jax.vmap
    def everything(data):
        forward = jax.jvp(value, (data,), (jnp.asarray(along),))[1]
        return fitted(data).value, forward, jax.grad(value)(data)

    found, forward, reverse = everything(jnp.asarray(noisy))
    for k, data in enumerate(noisy):
        time = np.linspace(0, 2, POINTS)

        def jacobian(u, time=time):
            return np.exp(-u[1] * time)[:, None] * np.stack([1 + 0 * time, -u[0] * time], 1)

        def scipys(data, time=time):
            def residuals(u):
                return u[0] * np.exp(-u[1] * time) - data

            fit = least_squares(residuals, [3.0, 1.5], jacobian, method="lm")
            # The cost hardly changes near the minimum, and MINPACK stops anywhere there: on some
            # processors up to 1e-8 away. The gradient's root is known to the last digits.
            return root(lambda u: residuals(u) @ jacobian(u), fit.x, tol=1e-14).x

        np.testing.assert_allclose([found["size"][k], found["rate"][k]], scipys(data), atol=1e-6)
        step = 1e-4
        ends = [scipys(data + sign * step * along) @ [1, 2] for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose([forward[k], reverse[k] @ along], [difference] * 2, rtol=1e-4)


def test_too_few_steps_are_said():
    solution = optx.least_squares(
        banana, LevenbergMarquardt(), jnp.asarray([-1.2, 1.0]), max_steps=2, throw=False
    )
    assert solution.result == optx.RESULTS.nonlinear_max_steps_reached


def parabola(curve, local, data):
    """Points that err in both coordinates; the local unknown is where a point is along x."""
    return jnp.stack([local, curve["low"] + curve["bend"] * local**2], 1) - data


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    x = np.linspace(0, 1, POINTS)
    rng = np.random.default_rng(1)
    return np.stack([x, 2 + 3 * x**2], 1) + 0.05 * rng.normal(size=(3, POINTS, 2))


@pytest.fixture(scope="module")
def arrow():
    """Shared and local unknowns with their derivatives, of a batch, with a bound on the local."""

    def fit(data, limit):
        start = {"low": jnp.asarray(1.0), "bend": jnp.asarray(1.0)}
        solution = arrow_least_squares(parabola, start, 0.5 * data[:, 0], data, limit=limit)
        curve, local = solution.value
        return jnp.stack([curve["low"], curve["bend"]]), local

    def both(data, limit, along):
        def moved(step):
            return fit(data + step * along, limit)[0]

        shared, local = fit(data, limit)
        reverse = jax.jacrev(lambda data: fit(data, limit)[0])(data)
        return shared, local, jax.jvp(moved, (0.0,), (1.0,))[1], reverse

    return jax.jit(jax.vmap(both, in_axes=(0, None, None)))


def peer(data: np.ndarray, limit: float) -> np.ndarray:
    """All unknowns at once, by scipy."""

    def residual(u):
        local = u[2:]
        return (np.stack([local, u[0] + u[1] * local**2], 1) - data).ravel()

    first = np.concatenate([[1.0, 1.0], np.clip(0.5 * data[:, 0], -0.9 * limit, 0.9 * limit)])
    bound = np.concatenate([[np.inf] * 2, np.full(POINTS, limit)])
    return least_squares(
        residual, first, bounds=(-bound, bound), xtol=1e-15, ftol=1e-15, gtol=1e-15
    ).x


@pytest.mark.parametrize("limit", [np.inf, 0.8])
def test_shared_and_local_unknowns_are_those_of_a_dense_solver(arrow, points, limit):
    along = np.random.default_rng(2).normal(size=(POINTS, 2))
    most = np.full(POINTS, limit)
    shared, local, forward, reverse = arrow(points, most, along)
    for k, data in enumerate(points):
        dense = peer(data, limit)
        np.testing.assert_allclose(shared[k], dense[:2], atol=1e-5)
        np.testing.assert_allclose(local[k], dense[2:], atol=1e-5)
    assert np.any(np.abs(local) == limit) == np.isfinite(limit)
    np.testing.assert_allclose(
        forward, np.einsum("kanm,nm->ka", reverse, along), rtol=1e-8, atol=1e-10
    )
    if np.isinf(limit):
        step = 1e-5
        ends = [arrow(points + sign * step * along, most, along)[0] for sign in (1, -1)]
        np.testing.assert_allclose(forward, (ends[0] - ends[1]) / (2 * step), rtol=1e-5)


@pytest.mark.parametrize("start", [5.0, -5.0])
def test_local_unknowns_that_begin_beyond_their_limit_end_on_it(start):
    """They stayed where they were, and the solve failed."""

    def residual(shared, local, args):
        return jnp.stack([local - 10.0, shared[0] - 1 + 0 * local], axis=1)

    shared, local = arrow_least_squares(residual, jnp.zeros(1), jnp.full(3, start), limit=1.0).value
    np.testing.assert_allclose(shared, 1.0, atol=1e-9)
    np.testing.assert_array_equal(local, 1.0)


def test_what_the_pieces_cannot_take_is_said_in_a_sentence():
    one = jaxcal.Problem.from_recording(
        jaxcal.simulate_recording(jaxcal.Protocol(images=12), seed=1)
    )
    batch = jaxcal.stack([one, one])
    images = jax.jit(backend.ImagePlanes.of)(batch)
    somewhere = Parameters.of(jnp.eye(3), jnp.zeros(3), jnp.zeros(3))
    pixels = replace(one, pixels=True, spacing_known=False)
    place = backend.Iterate.of(jax.tree.map(lambda a: jnp.stack([a, a]), somewhere), backend.RIGID)

    def made_of(found):
        class Own(backend.Observation):
            sigma: jax.Array

            def components(self, q, further, images):
                return found(q)

        return Own

    for call, said in (
        (lambda: backend.initial_fit(batch), "takes one problem"),
        (lambda: backend.initial_fit(pixels), "the pixels have no spacing_mm"),
        *(
            (lambda call=call, blocks=blocks: call(blocks), said)
            for call in (
                partial(backend.initial_fit, one),
                partial(backend.Iterate.of, jax.tree.map(lambda a: a[None], somewhere)),
            )
            for blocks, said in (
                (("scale", *backend.RIGID), "in this order"),
                ((*backend.RIGID, "delay", "sound-speed"), "in this order"),
                (("translation", "rotation"), "in this order"),
                ((*backend.RIGID, "shear"), "'shear' is no unknown"),
            )
        ),
        (lambda: backend.ImagePlanes.of(one), "a batch with one leading axis"),
        *(
            (
                lambda count=count, sigma=sigma: backend.minimise(
                    backend.Iterate.of(
                        jax.tree.map(lambda a: jnp.stack([a] * count), somewhere), backend.RIGID
                    ),
                    backend.Points(sigma),
                    images,
                ),
                f"{name} must be of 2 problems",
            )
            for name, count, sigma in (
                ("start", 1, jnp.ones((3, 2))),
                ("sigma", 2, jnp.ones((3, 3))),
            )
        ),
        *(
            (
                lambda change=change: backend.minimise(
                    backend.Iterate.of(
                        jax.tree.map(lambda a: jnp.stack([a, a]), somewhere), backend.RIGID
                    ),
                    backend.Points(jnp.ones((3, 2))),
                    images,
                    **change,
                ),
                said,
            )
            for change, said in (
                ({"damping": -1.0}, "damping must be finite and not negative"),
                ({"tolerance": -1e-9}, "tolerance must be finite and not negative"),
                ({"tolerance": np.nan}, "tolerance must be finite and not negative"),
                ({"max_steps": -1}, "max_steps must be between 1 and"),
                ({"trace": -1}, "trace must be between 0 and"),
            )
        ),
        (
            lambda: backend.minimise(
                jax.tree.map(lambda a: a.astype(jnp.float32), place),
                backend.Points(jnp.ones((3, 2))),
                images,
            ),
            "start is of float32, the images are of float64",
        ),
        *(
            (
                lambda found=found, sigma=sigma: backend.accumulate(
                    place, made_of(found)(jnp.ones(sigma)), images
                ),
                said,
            )
            for found, sigma, said in (
                (lambda q: [backend.Component(q)], (3,), r"sigma must have shape \(1, 2\)"),
                (lambda q: [backend.Component(q)], (3, 2), "returns 1 components of 2 problems"),
                (
                    lambda q: [backend.Component([jnp.sum(q[0], 1)])],
                    (1, 2),
                    r"planes of shape \(2, 12\)",
                ),
            )
        ),
        (
            lambda: backend.channel_residual(somewhere, one),
            "the problem has no times of flight",
        ),
        (
            lambda: backend.arrow_least_squares(lambda s, y, d: d, np.zeros(2, int), np.zeros(3)),
            "floating arrays",
        ),
        *(
            (
                lambda made=made: backend.arrow_least_squares(
                    lambda s, y, d: made, jnp.asarray(1.0), np.zeros(4)
                ),
                r"residual must return a \(4, columns\) array, not",
            )
            for made in (None, jnp.zeros(4), jnp.zeros((3, 2)), jnp.zeros((4, 0)))
        ),
        (
            lambda: backend.arrow_least_squares(
                lambda s, y, d: jnp.stack([s + y - d, y - jnp.roll(y, 1)], 1),
                jnp.asarray(1.0),
                np.zeros(10),
                jnp.arange(10.0),
            ),
            "depends on the local unknown of another row",
        ),
        (
            lambda: backend.count_unknowns(("rotation", "angle")),
            "'angle' is no unknown: choose from trans",
        ),
        (
            lambda: backend.retract(somewhere, jnp.zeros(6), backend.RIGID),
            "a step of translation, rotation, point has 9 numbers",
        ),
        (lambda: backend.LevenbergMarquardt(damping=-1.0), "damping must be .* not -1.0"),
        *(
            (lambda sigma=sigma: backend.Points(jnp.array(sigma)), "sigma must be positive")
            for sigma in ([[-0.3], [0.3], [0.6]], [[0.3], [0.0], [0.6]], [[0.3], [0.3], [jnp.nan]])
        ),
        (
            lambda: backend.TrackedPoints(jnp.ones((3, 1)), jnp.array([-0.1])),
            "tracker_sd must be zero or positive",
        ),
        (
            lambda: backend.BoundedOffsets(jnp.ones((1, 1)), jnp.full((1, 8), -2.0)),
            "bound must be zero or positive",
        ),
    ):
        with pytest.raises(jaxcal.InputError, match=said):
            call()


def test_other_solvers_tune_sds_in_float32():
    """Its last digits change for ever; 60 solves were the end of it."""
    problem, precision = conftest.problem(3, images=20), "float32"
    given = jaxcal.Options(solver=LevenbergMarquardt(), precision=precision)
    found = jaxcal.calibrate(problem, prior="gaussian", options=given)
    exact = jaxcal.calibrate(problem, prior="gaussian")
    assert found.converged
    assert found.convergence.variance_rounds < 20
    np.testing.assert_allclose(found.sigma, exact.sigma, rtol=1e-2)
    given = jaxcal.Options(solver=optx.Dogleg(1e-5, 1e-5), precision=precision)
    with pytest.raises(jaxcal.InputError, match="Dogleg does not run in float32"):
        jaxcal.calibrate(problem, prior="gaussian", options=given)


def test_local_unknowns_reach_their_minimum_where_the_shared_gradient_is_zero():
    """At s = 0 the gradient of s is zero from the start, but the local ones' minimum is far away.

    An undamped step to ln 10 goes to 9. The same residual of other data is traced for its shape
    alone: the program is there already.
    """
    traces = []

    def residual(shared, local, size):
        traces.append(size)
        return jnp.stack([jnp.exp(local) - size + shared, 3 * shared + 0 * local], axis=1)

    for size in (2.0, 10.0):
        before = len(traces)
        shared, local = arrow_least_squares(
            residual, jnp.asarray(0.0), np.zeros(4), jnp.asarray(size)
        ).value
        np.testing.assert_allclose(shared, 0, atol=1e-12)
        np.testing.assert_allclose(local, np.log(size), atol=1e-9)
    assert len(traces) - before == 1
