"""One pass over the images against dense automatic differentiation, for every observation."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from jaxcal import InputError
from jaxcal.data.problem import Channels as Heard
from jaxcal.data.problem import Problem
from jaxcal.model import derivatives, unrolled
from jaxcal.model.batch import ImagePlanes, Iterate, targets, total
from jaxcal.model.observations import (
    BoundedOffsets,
    ChannelDistances,
    Component,
    FurtherUnknowns,
    HeldOffsets,
    InPlane,
    LocalUnknown,
    MediumPrior,
    Observation,
    OwnCovariances,
    Points,
    TrackedPoints,
    local_unknowns,
)
from jaxcal.model.parameters import Parameters
from jaxcal.model.unknowns import FURTHER, RIGID
from jaxcal.runtime.arrays import each_image
from jaxcal.solvers.levenberg_marquardt import (
    Descent,
    Rounding,
    gradient_cosine,
    iterate_once,
    minimise,
)
from jaxcal.solvers.normal_equations import accumulate, component_sums

PROBLEMS, IMAGES, ELEMENTS, LEFT_OUT = 3, 11, 5, 4
SIGMA = jnp.asarray(np.outer([0.3, 0.4, 1.5], [1.0, 0.7, 1.3]))
SPEEDS, SPEED_SD, DELAY_SD = jnp.asarray([1450.0, 1500.0, 1540.0]), 15.0, 3e-7
"""Nominal sound speeds, and the medium's prior; m/s, s."""
GATE = jnp.asarray([1.0, 0.0, 1.0])
"""Second derivatives in two problems, none in the one between."""


def turns(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    flat = Rotation.random(int(np.prod(shape)), random_state=rng).as_matrix()
    return flat.reshape(*shape, 3, 3)


@pytest.fixture(scope="module")
def drawn() -> tuple[Problem, Parameters]:
    """Problems, one image left out of each with rubbish in it, and unknowns some mm off."""
    rng = np.random.default_rng(3)
    rotation, target = turns(rng, (PROBLEMS,)), rng.uniform(-50, 50, (PROBLEMS, 3))
    translation = rng.uniform(-30, 30, (PROBLEMS, 3))
    poses = np.tile(np.eye(4), (PROBLEMS, IMAGES, 1, 1))
    poses[..., :3, :3] = turns(rng, (PROBLEMS, IMAGES))
    shape = (PROBLEMS, IMAGES)
    depth = rng.uniform(20, 70, shape)
    q = np.stack([rng.uniform(-25, 25, shape), 1.5 * rng.normal(size=shape), depth], axis=-1)
    in_probe = np.einsum("kij,knj->kni", rotation, q) + translation[:, None]
    away = np.einsum("knij,knj->kni", poses[..., :3, :3], in_probe)
    poses[..., :3, 3] = target[:, None] - away
    points = np.stack([q[..., 0], np.hypot(q[..., 1], q[..., 2])], axis=-1)
    across = np.linspace(-20, 20, ELEMENTS)
    elements = np.stack([across, 0 * across, -0.01 * across**2], axis=-1)
    distances = np.linalg.norm(q[:, :, None] - elements, axis=-1)
    heard = (rng.uniform(size=distances.shape) < 0.8).astype(float)
    points, distances = (v + 0.3 * rng.normal(size=v.shape) for v in (points, distances))
    mask = np.ones(shape)
    mask[:, LEFT_OUT] = 0
    points[..., 1] -= 2.0  # Range is measured from the face.
    points[:, LEFT_OUT], poses[1, LEFT_OUT] = [1e30, np.nan], np.nan
    distances[:, LEFT_OUT] = np.nan
    problems = Problem(
        *(jnp.asarray(v) for v in (poses, points, mask)),
        spacing=jnp.ones((PROBLEMS, 2)),
        face_offset=jnp.full(PROBLEMS, 2.0),
        channels=Heard(
            jnp.asarray(distances), jnp.asarray(heard), jnp.tile(elements, (PROBLEMS, 1, 1))
        ),
    )
    small = Rotation.from_rotvec(rng.normal(scale=0.01, size=(PROBLEMS, 3))).as_matrix()
    near = Parameters(
        jnp.asarray(rotation @ small),
        jnp.asarray(translation + rng.normal(scale=0.5, size=(PROBLEMS, 3))),
        jnp.asarray(target + rng.normal(scale=0.5, size=(PROBLEMS, 3))),
        jnp.asarray(rng.uniform(0.98, 1.02, (PROBLEMS, 2))),
        jnp.asarray(rng.uniform(0.98, 1.02, PROBLEMS)),
        jnp.asarray(rng.uniform(-0.5, 0.5, PROBLEMS)),
    )
    return problems, near


def shapes() -> jax.Array:
    rng = np.random.default_rng(8)
    first, second = rng.uniform(0.5, 2.0, (2, PROBLEMS, IMAGES))
    return jnp.asarray(np.stack([first, rng.uniform(-0.4, 0.4, first.shape), second]))


OFFSETS = np.random.default_rng(9).normal(size=(PROBLEMS, IMAGES))
# Images left out have a range of 1 mm; an offset has to fit in there.
OFFSETS[:, LEFT_OUT] = 0.0
TAU = jnp.asarray([0.3, 0.2, 0.5])

DIRECTIONS = jnp.asarray(np.random.default_rng(10).normal(size=(3, PROBLEMS, IMAGES)))


class OnLine(Observation):
    """Where a wire through the target, along a known direction, crosses the image."""

    sigma: jax.Array
    direction: jax.Array
    oriented: ClassVar[bool] = True

    def components(self, q, further, images):
        assert further.tracker_to_image is not None
        lateral, distance = further.points(images)
        along = unrolled.apply(further.tracker_to_image, [*self.direction])
        crossing = [q[k] - q[1] / along[1] * along[k] for k in (0, 2)]
        return [Component([crossing[0] - lateral]), Component([crossing[1] - distance])]


CASES = {
    "points": (lambda images: Points(SIGMA), RIGID + FURTHER),
    "own covariances": (
        lambda images: OwnCovariances(SIGMA, shapes(), SIGMA[1] / SIGMA[0]),
        (*RIGID, "scale"),
    ),
    "own covariances, one factor": (
        lambda images: OwnCovariances(SIGMA[1:], shapes(), jnp.ones(PROBLEMS), tied=True),
        RIGID,
    ),
    "tracked points": (lambda images: TrackedPoints(SIGMA, TAU), (*RIGID, "scale")),
    "tracked points, own covariances": (
        lambda images: TrackedPoints(SIGMA, TAU, shapes()),
        RIGID,
    ),
    "in plane": (InPlane.of, (*RIGID, "scale")),
    "held offsets": (
        lambda images: HeldOffsets.of(jnp.asarray(OFFSETS), images),
        (*RIGID, "scale"),
    ),
    "bounded offsets": (
        lambda images: BoundedOffsets.of(jnp.full((PROBLEMS, IMAGES), 1.2), images),
        RIGID + FURTHER,
    ),
    "on a line": (lambda images: OnLine(SIGMA[:2], DIRECTIONS), (*RIGID, "scale", "delay")),
    "channels": (lambda images: ChannelDistances(SIGMA[1:]), (*RIGID, "sound-speed", "delay")),
}
"""Every observation, and the unknowns it is looked at with."""


@partial(jax.jit, static_argnums=1)
def case(drawn, name: str) -> tuple[Iterate, Any, ImagePlanes, MediumPrior | None]:
    make, blocks = CASES[name]
    problems, near = drawn
    images = ImagePlanes.of(problems, channels=name == "channels")
    medium = None
    if name in ("points", "channels"):
        of_speed = replace(problems, sound_speed=SPEEDS)
        medium = MediumPrior.of(of_speed, blocks, sound_speed_sd=SPEED_SD, delay_sd=DELAY_SD)
    return Iterate.of(near, blocks), make(images), images, medium


def whitened(step, local, place: Iterate, observation, images: ImagePlanes, medium):
    """All whitened residuals of every problem after a step, (batch, n, residuals of an image)."""
    moved = place.moved(list(step))
    q, axes = targets(moved, images)
    still = [jnp.zeros((PROBLEMS, 1))] * moved.further_values.shape[0]
    further = FurtherUnknowns.of(moved, still, axes)
    if local is None:
        parts = observation.components(q, further, images)
    else:
        parts = observation.components_at(q, local, further, images)
    found = []
    for part, sd in zip(parts, observation.sigma, strict=True):
        present = 1.0 if part.present is None else part.present
        for error in part.errors:
            wide = (present * error).reshape(PROBLEMS, IMAGES, -1)
            found.append(images.mask[..., None] * wide / sd[:, None, None])
    if medium is not None:
        speed, delay = moved.further("sound-speed"), moved.further("delay")
        delay_s = delay[0] / (1e3 * SPEEDS)
        known = jnp.stack([jnp.log(speed[0]) * SPEEDS / SPEED_SD, delay_s / DELAY_SD])
        found.append(jnp.zeros((PROBLEMS, IMAGES, 2)).at[:, 0].set(known.T))
    return jnp.concatenate(found, axis=-1)


def dense(place: Iterate, observation, images: ImagePlanes, medium):
    """Cost, gradient, exact and Gauss-Newton's curvature, squares of the columns.

    Forward derivatives only: they make the smallest programs.
    """
    zero, units = jnp.zeros((place.unknowns, PROBLEMS)), jnp.eye(place.unknowns)

    def residuals(step, local=None):
        return whitened(step, local, place, observation, images, medium)

    def halves(step, local=None):
        return 0.5 * jnp.sum(residuals(step, local) ** 2, axis=-1)

    def along(function, at):
        """The value, and the derivative by every unknown."""

        def one(unit):
            return jax.jvp(function, (at,), (jnp.broadcast_to(unit[:, None], zero.shape),))

        return jax.vmap(one, out_axes=(None, 0))(units)

    def slopes(step, local=None):
        return along(lambda at: jnp.sum(halves(at, local), axis=1), step)

    local = None
    if isinstance(observation, LocalUnknown):
        q, _ = targets(place, images)
        still = [jnp.zeros((PROBLEMS, 1))] * place.further_values.shape[0]
        local, free = observation.local(q, FurtherUnknowns.of(place, still), images)
    (half, gradient), (_, exact) = along(lambda at: slopes(at, local), zero)
    _, jacobian = along(lambda at: residuals(at, local), zero)
    newton = jnp.einsum("aknr,bknr->abk", jacobian, jacobian)
    squares = jnp.einsum("aak->ak", newton)
    if local is not None:
        # Through the solution for the image's own unknown, which moves along.
        half, gradient = slopes(zero)
        ones = jnp.ones_like(local)

        def by_own(step, at):
            return jax.jvp(lambda y: halves(step, y), (at,), (ones,))[1]

        def eliminated(whole, meets, bend):
            give = jnp.where(free * images.mask > 0, 1 / jnp.where(bend > 0, bend, 1.0), 0.0)
            return whole - jnp.einsum("akn,bkn,kn->abk", meets, meets, give)

        _, meets = along(lambda at: by_own(at, local), zero)
        _, bend = jax.jvp(lambda y: by_own(zero, y), (local,), (ones,))
        exact = eliminated(exact, meets, bend)
        _, own = jax.jvp(lambda y: residuals(zero, y), (local,), (ones,))
        meets, bend = jnp.einsum("aknr,knr->akn", jacobian, own), jnp.sum(own**2, axis=-1)
        newton = eliminated(newton, meets, bend)
    return 2 * half, gradient, exact, newton, squares


# One program for each observation, which the tests share.
sums_of = jax.jit(accumulate)


def assert_close(found, wanted, tolerance: float) -> None:
    """To the largest entry of each problem."""
    wanted = np.asarray(wanted)
    scale = np.abs(wanted).reshape(-1, PROBLEMS).max(axis=0)
    np.testing.assert_allclose(np.asarray(found) / scale, wanted / scale, rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    "name",
    # The longest to compile by far, and the other one has all of it.
    [pytest.param(n, marks=[pytest.mark.slow] * (n == "tracked points")) for n in CASES],
)
def test_sums_are_the_derivatives_of_the_cost(drawn, name):
    place, observation, images, medium = case(drawn, name)
    cost, gradient, exact, newton, squares = jax.jit(dense)(place, observation, images, medium)
    # Newton's steps to a tracker's error end within rounding of its best value, not at it.
    tolerance = 1e-9 if "tracked" in name else 1e-12
    normal = sums_of(place, observation, images, GATE, medium)
    assert_close(normal.cost, cost, 1e-13)
    assert_close(normal.gradient, gradient, tolerance)
    assert_close(normal.stacked(), np.where(GATE > 0, exact, newton), tolerance)
    assert np.abs(exact - newton).max() > 1e-5 * np.abs(newton).max()
    if isinstance(observation, LocalUnknown):
        assert_close(normal.diagonal(), squares, 1e-12)


def test_a_prior_of_the_medium_is_that_of_the_free_unknowns(drawn):
    problems, near = drawn
    assert MediumPrior.of(problems, (*RIGID, "scale")) is None
    medium = MediumPrior.of(problems, (*RIGID, "delay"))
    with pytest.raises(InputError, match=r"not for .*'sound-speed'"):
        medium.deviations(Iterate.of(near, (*RIGID, "sound-speed")))
    for given in (-1.0, np.nan):
        with pytest.raises(InputError, match="delay_sd must be"):
            MediumPrior.of(problems, (*RIGID, "delay"), delay_sd=given)
    with pytest.raises(TypeError, match="'speed_sd'"):
        MediumPrior.of(problems, (*RIGID, "delay"), speed_sd=5.0)
    with pytest.raises(InputError, match="one leading axis"):
        MediumPrior.of(jax.tree.map(lambda leaf: leaf[0], problems), RIGID)
    np.testing.assert_array_equal(near.matrix()[1, :3, 3], near.translation[1])


@pytest.mark.parametrize("name", ["points", "own covariances", "on a line", "channels"])
def test_components_apart_come_to_the_whole(drawn, name):
    """The second derivatives of all go into the rest."""
    place, observation, images, medium = case(drawn, name)

    @jax.jit
    def apart():
        sums = component_sums(place, observation, images, observation.sigma, medium)
        return sums, sums.weighted(1 / observation.sigma**2)

    sums, weighed = jax.tree.map(np.asarray, apart())
    exact, newton = (
        sums_of(place, observation, images, gate, medium)
        for gate in (jnp.ones_like(GATE), 0 * GATE)
    )
    for part in ("cost", "gradient", "curvature"):
        assert_close(getattr(weighed, part), getattr(newton, part), 1e-13)
    assert_close(weighed.curvature + sums.rest, exact.curvature, 1e-13)
    if name == "channels":
        only_first = np.full(observation.sigma.shape, 1e12)
        only_first[0] = 1.0
        alone = observation.with_sigma(jnp.asarray(only_first))
        first = sums_of(place, alone, images, GATE, None)
        assert_close(sums.squares[0], first.cost, 1e-12)
        assert_close(sums.gradient[0], first.gradient, 1e-12)


@pytest.mark.parametrize("name", ["points", "own covariances", "bounded offsets", "channels"])
def test_images_left_out_and_padding_count_for_nothing(drawn, name):
    place, observation, images, medium = case(drawn, name)
    keep = np.delete(np.arange(IMAGES), LEFT_OUT)
    problems, _ = drawn
    channels = replace(
        problems.channels,
        distances=problems.channels.distances[:, keep],
        heard=problems.channels.heard[:, keep],
    )
    few = ImagePlanes.of(
        replace(
            problems,
            poses=problems.poses[:, keep],
            measurements=problems.measurements[:, keep],
            mask=problems.mask[:, keep],
            channels=channels,
        ),
        channels=name == "channels",
    )
    without = each_image(observation, lambda values, axis: jnp.take(values, keep, axis))
    # Padding is whole vectors of 64 bytes; none for times of flight.
    padded = images.padded()
    assert padded.mask.shape[1] == (IMAGES if name == "channels" else 16)
    whole = sums_of(place, observation, images, GATE, medium)
    fewer = sums_of(place, without.padded(few.padded()), few.padded(), GATE, medium)
    more = sums_of(place, observation.padded(padded), padded, GATE, medium)
    for leaf, other, third in zip(*map(jax.tree.leaves, (whole, fewer, more)), strict=True):
        assert np.isfinite(leaf).all()
        np.testing.assert_allclose(leaf, other, rtol=1e-11, atol=1e-11 * np.abs(leaf).max())
        np.testing.assert_allclose(leaf, third, rtol=1e-11, atol=1e-11 * np.abs(leaf).max())


def test_sums_of_planes_have_both_derivatives():
    planes = [jnp.arange(6.0).reshape(2, 3), 0, jnp.ones((1, 3))]

    def squares(scale):
        kept = [plane if unrolled.is_zero(plane) else scale * plane for plane in planes]
        return sum(jnp.sum(value**2) for value in total(kept))

    @jax.jit
    def everything(at):
        by_reverse = jax.grad(squares)
        # And again: curvature is asked for at optima.
        bend = jax.grad(by_reverse)(at)
        return total(planes), by_reverse(at), jax.jvp(squares, (at,), (1.0,))[1], bend

    found, *slopes, bend = everything(2.0)
    np.testing.assert_array_equal(found, [[3, 12], [0, 0], [3, 3]])
    expected = 2 * 2.0 * (3**2 + 12**2 + 2 * 3**2)
    np.testing.assert_allclose(slopes, [expected] * 2, rtol=1e-15)
    np.testing.assert_allclose(bend, expected / 2, rtol=1e-15)


def test_the_gradient_has_forward_and_reverse_derivatives_by_the_data(drawn):
    place, observation, images, _ = case(drawn, "own covariances")
    rng = np.random.default_rng(1)
    weight = jnp.asarray(rng.normal(size=(place.unknowns, PROBLEMS)))
    along = jnp.asarray(rng.normal(size=(PROBLEMS, IMAGES)))

    def value(lateral):
        data = replace(images, lateral=lateral)
        return jnp.sum(weight * accumulate(place, observation, data, GATE).gradient)

    def reference(lateral):
        data = replace(images, lateral=lateral)

        def half(step):
            return 0.5 * jnp.sum(whitened(step, None, place, observation, data, None) ** 2)

        return jnp.sum(weight * jax.grad(half)(jnp.zeros_like(weight)))

    @jax.jit
    def slopes(lateral):
        return (
            jax.jvp(value, (lateral,), (along,))[1],
            jnp.sum(along * jax.grad(value)(lateral)),
            jax.jvp(reference, (lateral,), (along,))[1],
        )

    forward, reverse, wanted = slopes(images.lateral)
    np.testing.assert_allclose([forward, reverse], [wanted] * 2, rtol=1e-9)


def test_derivatives_of_planes_leave_out_what_vanishes():
    def function(x, y, z):
        return [x * y + 3.0, jnp.sin(z), 2.0 * x - z, jnp.ones_like(x)]

    x, y, z = (jnp.asarray([[value]]) for value in (2.0, 5.0, 0.3))
    traced = jax.make_jaxpr(function)(x, y, z)
    assert derivatives.depends(traced) == [{0, 1}, {2}, {0, 2}, set()]
    rows = derivatives.first(traced, [x, y, z])
    zeros = [[unrolled.is_zero(entry) for entry in row] for row in rows]
    assert zeros == [[False, False, True], [True, True, False], [False, True, False], [True] * 3]
    np.testing.assert_allclose(
        [rows[0][0][0, 0], rows[0][1][0, 0], rows[1][2][0, 0], rows[2][0][0, 0], rows[2][2][0, 0]],
        [5, 2, np.cos(0.3), 2, -1],
    )
    bends = derivatives.second(traced, [x, y, z])
    assert set(bends) == {(0, 0, 1), (1, 2, 2)}
    np.testing.assert_allclose(bends[0, 0, 1], [[1]])
    np.testing.assert_allclose(bends[1, 2, 2], [[-np.sin(0.3)]])


def test_offsets_are_the_closest_points_of_the_circles(drawn):
    place, observation, images, _ = case(drawn, "bounded offsets")

    @jax.jit
    def looked_at():
        still = [jnp.zeros((PROBLEMS, 1))] * place.further_values.shape[0]
        distance = FurtherUnknowns.of(place, still).points(images)[1]
        return local_unknowns(place, observation, images), targets(place, images)[0], distance

    found, q, distance = jax.tree.map(np.asarray, looked_at())
    for k, i in [(0, 0), (1, 7), (2, 10), (2, 3)]:
        best: Any = minimize_scalar(
            lambda y, k=k, i=i: (
                (q[1][k, i] - y) ** 2 + (q[2][k, i] - np.sqrt(distance[k, i] ** 2 - y**2)) ** 2
            ),
            bounds=(-1.2, 1.2),
            method="bounded",
            options={"xatol": 1e-10},
        )
        # A minimum is known to the root of the rounding of its value.
        assert abs(found[k, i] - best.x) < 1e-6
    assert np.all(found[:, LEFT_OUT] == 0)
    assert np.any(np.abs(found) == 1.2)
    assert np.any((np.abs(found) > 0) & (np.abs(found) < 1.2))


def test_a_step_turns_by_the_rotation_vector_to_third_order():
    vector = np.array([0.02, -0.03, 0.01])
    turn = np.array(unrolled.rotation(list(vector)))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-15)
    exact = Rotation.from_rotvec(vector).as_matrix()
    assert np.abs(turn - exact).max() < np.linalg.norm(vector) ** 3 / 12 * 1.01
    large = np.array(unrolled.rotation([2.0, -3.0, 5.0]))
    np.testing.assert_allclose(large @ large.T, np.eye(3), atol=1e-14)


@pytest.fixture(scope="module")
def descent(drawn):
    """The minimiser of given SDs, compiled once."""
    place, observation, images, _ = case(drawn, "own covariances, one factor")
    return place, observation, images, jax.jit(minimise)


def test_where_the_last_step_was_not_looked_at_the_gradient_is_gone_too(descent):
    place, observation, images, run = descent
    found = run(place, observation, images)
    normal, gated = (sums_of(place, observation, images, gate) for gate in (None, 0 * GATE))
    for one, other in zip(jax.tree.leaves(normal), jax.tree.leaves(gated), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12 * np.abs(one).max())
    normal = sums_of(found.iterate, observation, images, None)

    @jax.jit
    def cosine():
        rounding = Rounding.of(found.iterate, observation, images)
        return gradient_cosine(normal, rounding.vanished)

    assert np.all(found.converged)
    assert np.all(found.cosine <= 1e-10)
    assert np.all(np.asarray(cosine()) <= 1e-10)
    # Its cost is that before the last step: higher, by nothing.
    np.testing.assert_allclose(found.cost, normal.cost, rtol=1e-10)


def test_a_lost_problem_leaves_its_neighbours_alone(descent):
    place, observation, images, run = descent
    whole = run(place, observation, images)
    spoilt = replace(images, lateral=images.lateral.at[1, 0].set(jnp.nan))
    broken = run(place, observation, spoilt)
    others = [0, 2]
    assert np.isnan(broken.cost[1])
    assert broken.iterations[1] == 1
    assert not broken.converged[1]
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(broken), strict=True):
        assert np.array_equal(np.asarray(a)[..., others], np.asarray(b)[..., others])


def test_a_step_that_fails_is_tried_again_with_more_damping(drawn):
    """Far from the optimum, hardly damped: without rejections there is no way down."""
    place, observation, images, _ = case(drawn, "bounded offsets")
    place = Iterate.of(place.parameters(), RIGID)
    far = (60, -50, 70, 1.5, -1, 1.2, 80, 90, -40)

    @jax.jit
    def begun():
        away = place.moved([jnp.full(PROBLEMS, float(value)) for value in far])
        number = jnp.zeros(PROBLEMS)
        start = Descent.first(away, number, 1e-9, exact_next=number)
        return start, Rounding.of(away, observation, images)

    state, rounding = begun()
    step = jax.jit(
        partial(
            iterate_once,
            equations=lambda g, gate: accumulate(g, observation, images, gate),
            rounding=rounding,
            tolerance=1e-10,
            max_steps=100,
        )
    )
    failed = 0
    while np.any(state.active):
        before, state = state, jax.tree.map(np.asarray, step(state))
        taken = ~np.asarray(before.retry)
        assert np.all(state.cost[taken] <= before.cost[taken] * (1 + 1e-9))
        failed += int(np.sum(state.retry & state.active))
    assert failed > 0
    assert np.all(state.converged)
