"""The recorded public answers against an oracle that shares no code with them.

``tests/golden`` holds what ``jaxcal.calibrate`` and ``jaxcal.calibrate_batch`` answer (and
``test_golden.py`` that they still do); here the same problems are solved from the definitions, by
``tests/oracle``: numpy and scipy, dense, with derivatives by complex steps. Differences are in the
answers' own standard deviations.
"""

from __future__ import annotations

import ast
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from golden import corpus
from oracle import correlation, least_squares, model_average, uncertainty, variance
from oracle.model import RIGID, Data, Unknowns, jacobian, points, size, target
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

import jaxcal

AGREE = 1e-6
"""In SDs."""

QUADRATURE = 2e-3
"""What sixteen nodes instead of an exact quadrature move X, in SDs (7e-4 at most was seen)."""

FEW_STEPS = 3e-2
"""What the model average's few updates and sweeps leave of its fixed point, in SDs."""

SCALE = (*RIGID, "scale")
GIVEN = np.array([0.3, 0.15, 1.0])


@cache
def load(name: str):
    return corpus.load(name)


@cache
def data_of(name: str, row: int) -> Data:
    """Plain arrays of the used images."""
    family, _ = load(name)
    used = family.arrays["mask"][row] > 0
    arrays = {key: values[row][used] for key, values in family.arrays.items() if key != "mask"}
    covariance = None
    if "covariance" in arrays:
        xx, xy, yy = arrays["covariance"].T
        covariance = np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)
    poses = arrays["poses"]
    data = Data(
        poses[:, :, :3],
        poses[:, :, 3],
        arrays.get("measurements", np.zeros((len(poses), 2))),
        np.ones(2),
        covariance,
        arrays.get("max_elevation"),
    )
    if family.probe is None:
        return data
    # Which answers of the elements count is the segmentation's to say.
    problem = family.problems(np.array([row]))
    channels = problem.channels
    assert channels is not None
    return replace(
        data,
        measured=np.asarray(problem.measurements)[0][used],
        distances=np.asarray(channels.distances)[0][used],
        heard=np.asarray(channels.heard)[0][used],
        elements=np.asarray(channels.elements)[0],
    )


@cache
def conventional(name: str, row: int, blocks=RIGID) -> least_squares.Fit:
    """The fit that the others start from."""
    return least_squares.conventional(data_of(name, row), blocks)


def answers(name: str, call: str, row: int) -> dict[str, corpus.Arrays]:
    """What was recorded of a problem, by road."""
    _, recorded = load(name)
    return {
        road: {key: values[row] for key, values in fields.items()}
        for (own, road), fields in recorded.items()
        if own == call
    }


def symmetric(upper: np.ndarray) -> np.ndarray:
    count = {21: 6, 6: 3}[len(upper)]
    full = np.zeros((count, count))
    full[np.triu_indices(count)] = upper
    return full + np.triu(full, 1).T


def apart(answer: corpus.Arrays, u: Unknowns) -> float:
    """Largest distance of X's six and the target's three unknowns, in the answer's SDs."""
    x, sd = answer["image_to_probe"], np.sqrt(np.diag(symmetric(answer["covariance"])))
    moved = x[:, :3].T @ (u.translation - x[:, 3])
    turn = x[:, :3].T @ u.rotation
    turned = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    point_sd = np.sqrt(np.diag(symmetric(answer["point_covariance"])))
    point = (u.point - answer["point"]) / point_sd
    return float(np.abs(np.concatenate([moved / sd[:3], turned / sd[3:], point])).max())


def assert_covariances(answer: corpus.Arrays, covariance: np.ndarray, tolerance=AGREE) -> None:
    """X's and the target's, in units of the products of SDs."""
    for name, rows in (("covariance", slice(0, 6)), ("point_covariance", slice(6, 9))):
        recorded, mine = symmetric(answer[name]), covariance[rows, rows]
        sd = np.sqrt(np.diag(recorded))
        np.testing.assert_allclose(
            mine / np.outer(sd, sd), recorded / np.outer(sd, sd), atol=tolerance
        )


def assert_offsets(answer: corpus.Arrays, mask: np.ndarray, elevation, sd=None) -> None:
    unit = answer["elevation_sd"][mask]
    np.testing.assert_allclose(elevation / unit, answer["elevation"][mask] / unit, atol=AGREE)
    if sd is not None:
        np.testing.assert_allclose(sd, unit, rtol=AGREE)


def used_images(name: str, row: int) -> np.ndarray:
    return load(name)[0].arrays["mask"][row] > 0


def test_the_oracle_imports_numpy_and_scipy_only():
    folder = Path(__file__).parent / "oracle"
    allowed = {"__future__", "collections", "dataclasses", "numpy", "oracle", "scipy"}
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            assert {name.split(".")[0] for name in names} <= allowed, path.name


def conventional_covariances(
    fit: least_squares.Fit, count: int, path: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """For independent errors, and for errors that may be alike in successive images."""
    spread = uncertainty.residual_variance(fit.cost, count, 9)
    by_image, residual = fit.jacobian.reshape(count, 3, 9), fit.residual.reshape(-1, 3)
    variances = uncertainty.axis_variances(by_image, residual, spread)
    independent = uncertainty.covariance_by_axis(by_image, variances)
    along, errors = by_image.swapaxes(0, 1) / np.sqrt(spread), residual.T / np.sqrt(spread)
    wider = correlation.widened(independent, along, errors, variances / spread, path)
    return independent, wider


ORDINARY = [("points12", row) for row in (0, 1, 2, 3, 4, 5, 34, 42)] + [
    ("points24", row) for row in (6, 7, 8, 9)
]


@pytest.mark.parametrize(("name", "row"), ORDINARY)
def test_conventional(name, row):
    data = data_of(name, row)
    fit = conventional(name, row)
    spread = uncertainty.residual_variance(fit.cost, len(data), 9)
    independent, wider = conventional_covariances(fit, len(data))
    for road, answer in answers(name, "conventional", row).items():
        covariance = wider if road == "one" else independent
        information = np.linalg.cholesky(spread * np.linalg.inv(covariance)).T
        seen = uncertainty.observability(data, fit.unknowns, RIGID, information, spread)
        assert apart(answer, fit.unknowns) < AGREE
        assert answer["cost"] == pytest.approx(fit.cost, rel=1e-9)
        assert answer["rms"] == pytest.approx(np.sqrt(fit.cost / len(data)), rel=1e-9)
        assert_covariances(answer, covariance)
        assert_offsets(
            answer,
            used_images(name, row),
            target(data, fit.unknowns)[:, 1],
            uncertainty.offset_sd(data, fit.unknowns, RIGID, covariance),
        )
        assert answer["condition"] == pytest.approx(seen.condition, rel=1e-6)
        assert answer["weakest_sd"] == pytest.approx(seen.weakest_sd, rel=1e-6)


@pytest.mark.parametrize(("count", "step"), [(48, 0.7), (24, 1.5)])
def test_the_covariance_along_a_slow_path(count, step):
    """The second one is between slow and random."""
    rng, time = np.random.default_rng(1), step * np.arange(count)
    phases, periods = rng.uniform(0, 2 * np.pi, (7, 1)), rng.uniform(15, 40, (7, 1))
    waves = np.sin(2 * np.pi * time / periods + phases)
    rotation = Rotation.from_rotvec(0.4 * waves[:3].T).as_matrix()
    q = np.stack([20 * waves[3], 0.8 * waves[4], 45 + 20 * waves[5]], axis=1)
    x = np.array([[0.0, -1, 0, 10], [0, 0, -1, 20], [1, 0, 0, 30]])
    origin = 50 - np.einsum("nij,nj->ni", rotation, q @ x[:, :3].T + x[:, 3])
    measured = q[:, [0, 2]] + [0.3, 0.15] * rng.normal(size=(len(time), 2))
    poses = np.tile(np.eye(4), (len(time), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation, origin
    fit = least_squares.conventional(Data(rotation, origin, measured, np.ones(2)), RIGID)
    path = rotation, origin
    assert correlation.slowness(*path) > 0.1
    assert (correlation.slowness(*path) < 1) == (count == 24)
    independent, wider = conventional_covariances(fit, len(time), path)
    result = jaxcal.calibrate(jaxcal.Problem.from_arrays(poses, measured), "conventional")
    sd = np.sqrt(np.diag(wider)[:6])
    assert (sd > 1.1 * np.sqrt(np.diag(independent)[:6])).any()
    np.testing.assert_allclose(
        np.asarray(result.covariance) / np.outer(sd, sd),
        wider[:6, :6] / np.outer(sd, sd),
        atol=AGREE,
    )


@pytest.mark.parametrize(
    ("name", "row"),
    [
        *ORDINARY[:8],
        *(("covariances24", row) for row in (0, 1, 2, 3)),
        *(("pixels24", row) for row in (0, 1, 2, 3)),
    ],
)
def test_given_standard_deviations(name, row):
    data, blocks = data_of(name, row), SCALE if name.startswith("pixels") else RIGID
    shape = None if data.covariance is None else data.shape()
    start = conventional(name, row, blocks).unknowns
    fit = least_squares.joint(data, blocks, GIVEN, start, shape)
    covariance = uncertainty.covariance(fit.jacobian, size(blocks))
    for answer in answers(name, "given", row).values():
        assert apart(answer, fit.unknowns) < AGREE
        assert answer["cost"] == pytest.approx(fit.cost, rel=1e-9)
        assert_covariances(answer, covariance)
        assert_offsets(
            answer,
            used_images(name, row),
            target(data, fit.unknowns)[:, 1],
            uncertainty.offset_sd(data, fit.unknowns, blocks, covariance),
        )
        if blocks == SCALE:
            np.testing.assert_allclose(answer["scale_mm_per_px"], fit.unknowns.scale, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "row"),
    [
        *(("points12", row) for row in (0, 1, 2, 3, 4, 5)),
        *(("covariances24", row) for row in (0, 1, 2, 3)),
    ],
)
def test_a_tracker_that_errs(name, row):
    """Offsets as unknowns of their own; without tracker errors they go over into q_y."""
    data, tau = data_of(name, row), 0.2
    shape = None if data.covariance is None else data.shape()
    start = least_squares.joint(data, RIGID, GIVEN, conventional(name, row).unknowns, shape)
    fit = least_squares.joint_explicit(data, RIGID, GIVEN, tau, start.unknowns, shape)
    whole = uncertainty.covariance(fit.jacobian, 9 + len(data))
    (answer,) = answers(name, "tracker", row).values()
    assert apart(answer, fit.unknowns) < AGREE
    assert answer["cost"] == pytest.approx(fit.cost, rel=1e-9)
    assert_covariances(answer, whole[:9, :9])
    assert_offsets(answer, used_images(name, row), fit.offset, np.sqrt(np.diag(whole)[9:]))
    none = least_squares.joint_explicit(data, RIGID, GIVEN, 1e-6, start.unknowns, shape)
    (eliminated, *_) = answers(name, "given", row).values()
    assert apart(eliminated, none.unknowns) < 1e-5


BOUNDED = [("points12", row) for row in (0, 1, 2, 4, 6, 7, 8, 9, 10, 42)] + [
    ("bounds24", row) for row in (1, 4)
]


@pytest.mark.parametrize(("name", "row"), BOUNDED)
def test_bounded(name, row):
    """The same minimum from starts of the oracle's own, and the KKT conditions at the answer."""
    data = data_of(name, row)
    bound = np.ones(len(data)) if data.bound is None else data.bound
    start = conventional(name, row).unknowns
    fit = least_squares.bounded(data, RIGID, bound, start)
    (answer,) = answers(name, "bounded", row).values()
    assert answer["cost"] == pytest.approx(fit.cost, rel=1e-9)
    x, mask = answer["image_to_probe"], used_images(name, row)
    there = Unknowns(x[:, :3], x[:, 3], answer["point"], np.ones(2))
    y, held = answer["elevation"][mask], answer["at_bound"][mask]
    most = np.minimum(bound, 0.95 * points(data, there)[1])
    assert (np.abs(y) <= most + 1e-12).all()
    assert (np.abs(y) == most)[held].all()
    # A residual of r mm and a slope of one: derivatives in mm, of a cost in mm^2.
    scale = np.sqrt(fit.cost)
    force = least_squares.offset_gradient(data, there, y)
    assert np.abs(force[~held]).max(initial=0) < 1e-8 * scale
    assert (np.sign(y) * force < 0)[held].all()

    def residual(step: np.ndarray) -> np.ndarray:
        return least_squares.circle(data, there.moved(step, RIGID), y).ravel()

    along = jacobian(residual, 9)
    cosine = (along.T @ residual(np.zeros(9))) / np.linalg.norm(along, axis=0)
    assert np.abs(cosine).max() < 1e-8 * scale
    assert np.array_equal(held, ~fit.free)
    free = int(fit.free.sum())
    if 3 * len(data) - 9 - free > 0 and np.isfinite(answer["covariance"]).all():
        assert apart(answer, fit.unknowns) < AGREE
        spread = uncertainty.residual_variance(fit.cost, len(data), 9, free)
        assert_covariances(answer, uncertainty.covariance(fit.jacobian, 9, spread))


@pytest.mark.parametrize(("name", "row"), ORDINARY)
def test_alternation(name, row):
    data = data_of(name, row)
    start = conventional(name, row).unknowns
    u, y = least_squares.alternate(data, RIGID, np.ones(len(data)), start)
    for answer in answers(name, "alternating", row).values():
        # Fewer than 9 active bounds leave a direction free, and its SD unknown.
        if np.isfinite(answer["covariance"]).all():
            assert apart(answer, u) < AGREE
        elevation = answer["elevation"][used_images(name, row)]
        np.testing.assert_allclose(elevation, y, atol=AGREE * max(answer["sigma"]))
        assert answer["cost"] == pytest.approx(
            float((least_squares.circle(data, u, y) ** 2).sum()), rel=1e-6
        )


@cache
def tuned(name: str, row: int, blocks=RIGID) -> tuple[Data, variance.Tuned]:
    data = data_of(name, row)
    start = conventional(name, row, blocks).unknowns
    return data, variance.reml(variance.point_components(data), start, 3, blocks)


@pytest.mark.parametrize(
    ("name", "row"), [*ORDINARY[:6], ORDINARY[7], *ORDINARY[8:], ("pixels24", 0), ("pixels24", 1)]
)
def test_self_tuned_is_restricted_maximum_likelihood(name, row):
    blocks = SCALE if name.startswith("pixels") else RIGID
    _, found = tuned(name, row, blocks)
    independent = uncertainty.covariance(found.fit.jacobian, size(blocks))
    along = found.fit.jacobian.reshape(3, -1, size(blocks))
    wider = correlation.widened(independent, along, found.fit.residual.reshape(3, -1))
    for road, answer in answers(name, "gaussian", row).items():
        covariance = wider if road == "one" else independent
        np.testing.assert_allclose(answer["sigma"], found.sigma, rtol=1e-7)
        assert apart(answer, found.fit.unknowns) < AGREE
        assert_covariances(answer, covariance)


@pytest.mark.parametrize("row", [1, 3])
def test_self_tuned_with_correlated_errors_is_helmerts(row):
    """Own covariances that correlate lateral position and range: an estimator of its own.

    Helmert's equation for the decorrelated residuals is unbiased, but it is not the derivative of
    the restricted likelihood: on these images, whose covariances are half untrue, SDs that make
    the data likeliest are up to 39 per cent off.
    """
    data = data_of("covariances24", row)
    start = conventional("covariances24", row).unknowns
    components = variance.point_components(data, data.shape())
    found = variance.helmert(components, start, 3, RIGID)
    (answer,) = answers("covariances24", "gaussian", row).values()
    np.testing.assert_allclose(answer["sigma"], found.sigma, rtol=1e-7)
    assert apart(answer, found.fit.unknowns) < AGREE
    assert_covariances(answer, uncertainty.covariance(found.fit.jacobian, 9))
    likeliest = variance.reml(components, start, 3, RIGID)
    assert 1e-4 < np.abs(np.log(likeliest.sigma / found.sigma)).max() < 0.5


AVERAGED = [("points12", row) for row in (0, 2, 3, 10)] + [
    *(("points24", row) for row in (9, 27)),
    *(("covariances24", row) for row in (0, 1, 20)),
    *(("bounds24", row) for row in (0, 35)),
    ("covariances-bounds12", 0),
    ("pixels24", 1),
]
"""Among them little trust in the mean (points12 10, where images are left out between others;
points24 27; pixels24 1), a probable mean (bounds24 35), and own covariances that some of the answer
rests on (covariances24 20)."""


def assert_average(
    answer: corpus.Arrays, found: model_average.Average, tolerance: float, *, widened: bool = False
) -> None:
    """X, covariance, SDs and what is said of the distributions.

    Covariances of single problems are widened for correlated errors; how much is not computed here.
    """
    assert answer["weighed"]
    assert apart(answer, found.unknowns) < tolerance
    if widened:
        recorded = np.diag(symmetric(answer["covariance"]))
        assert (recorded > (1 - tolerance) * np.diag(found.covariance)[:6]).all()
    else:
        assert_covariances(answer, found.covariance, tolerance)
    np.testing.assert_allclose(answer["sigma"], found.sigma, rtol=tolerance)
    names = ("uniform", "bell", "gaussian", "student")
    probability = [found.probability.get(name, 0.0) for name in names]
    np.testing.assert_allclose(answer["probability"], probability, atol=tolerance)
    unit = max(found.mean_sd, 1e-3)
    assert abs(answer["mean"] - found.mean) / unit < tolerance
    assert abs(answer["mean_sd"] - found.mean_sd) / unit < tolerance
    assert answer["mean_probability"] == pytest.approx(found.mean_probability, abs=tolerance)
    assert answer["trust"] == pytest.approx(found.trust, abs=tolerance)
    assert answer["own_probability"] == pytest.approx(found.own_probability, abs=tolerance)


@pytest.mark.parametrize(("name", "row"), AVERAGED)
def test_model_average(name, row):
    blocks = SCALE if name.startswith("pixels") else RIGID
    data, first = tuned(name, row, blocks)
    documented = model_average.Recipe(quadrature="documented")
    found = model_average.average(data, first.fit.unknowns, first.sigma, blocks, documented)
    exact = model_average.average(data, first.fit.unknowns, first.sigma, blocks)
    for road, answer in answers(name, "auto", row).items():
        widened = road == "one" and len(data) >= correlation.FEWEST_IMAGES
        assert_average(answer, found, AGREE, widened=widened)
        assert apart(answer, exact.unknowns) < QUADRATURE


@pytest.mark.parametrize(("name", "row"), [("points12", 0), ("bounds24", 0)])
def test_uniform_only(name, row):
    data, first = tuned(name, row)
    recipe = model_average.uniform_only(model_average.Recipe(quadrature="documented"))
    found = model_average.average(data, first.fit.unknowns, first.sigma, RIGID, recipe)
    for answer in answers(name, "uniform", row).values():
        assert_average(answer, found, AGREE)


@pytest.mark.parametrize(("name", "row"), AVERAGED[:3])
def test_few_updates_and_sweeps_come_near_the_fixed_point(name, row):
    """What the average takes on purpose: two rounds of SDs, three sweeps a distribution."""
    data, first = tuned(name, row)
    recipe = model_average.Recipe(exactly=True)
    found = model_average.average(data, first.fit.unknowns, first.sigma, RIGID, recipe)
    for answer in answers(name, "auto", row).values():
        assert apart(answer, found.unknowns) < FEW_STEPS


@pytest.mark.parametrize("family", ["uniform", "bell", "student", "gaussian"])
def test_moments_of_the_distributions_against_scipy(family):
    rng = np.random.default_rng(4)
    sd, centre, spread = 1.3, rng.uniform(-4, 4, 3), rng.uniform(0.05, 9, 3)
    low, high = np.full(3, -np.inf), np.array([np.inf, 1.7, np.inf])
    found = model_average.exact_moments(family, sd, centre, spread, low, high)
    edge = min(model_average.support(family, sd), 60.0)
    for mean, variance_, top, log_mass, first, second in zip(
        centre, spread, np.minimum(edge, high), *found, strict=True
    ):

        def power(u: float, order: int, mean: float = mean, variance_: float = variance_) -> float:
            gauss = np.exp(-0.5 * (u - mean) ** 2 / variance_) / np.sqrt(2 * np.pi * variance_)
            return u**order * float(model_average.density(family, np.array(u), sd)) * gauss

        marks = [place for place in (mean, 0.0) if -edge < place < top]
        settings = {"points": marks, "limit": 400, "epsabs": 0, "epsrel": 1e-11}
        sums = [quad(power, -edge, top, args=(order,), **settings)[0] for order in range(3)]
        assert log_mass == pytest.approx(np.log(sums[0]), abs=1e-9)
        assert first == pytest.approx(sums[1] / sums[0], abs=1e-8)
        assert second == pytest.approx(sums[2] / sums[0] - (sums[1] / sums[0]) ** 2, rel=1e-7)


NOMINAL_M_S = 1490.0
CHANNELS = (
    ("curved12", "gaussian", RIGID, None),
    ("curved12", "gaussian, speed and delay", (*RIGID, "sound-speed", "delay"), (20, 1e-6)),
    ("linear12", "gaussian, speed", (*RIGID, "sound-speed"), (20, 1e-6)),
)


def medium_sd(given: tuple | None) -> np.ndarray | None:
    """Prior SDs of the log of the sound speed and of the delay in mm, from m/s and s."""
    if given is None:
        return None
    return np.array([given[0] / NOMINAL_M_S, given[1] * NOMINAL_M_S * 1e3])


@pytest.mark.parametrize("row", [2, 4])
@pytest.mark.parametrize(("name", "call", "blocks", "given"), CHANNELS)
def test_times_of_flight(name, call, blocks, given, row):
    data = data_of(name, row)
    start = conventional(name, row).unknowns
    found = variance.reml(variance.channel_components(data), start, 2, blocks, medium_sd(given))
    u, covariance = found.fit.unknowns, uncertainty.covariance(found.fit.jacobian, size(blocks))
    for answer in answers(name, call, row).values():
        assert answer["channel_sigma"] == pytest.approx(found.sigma[0], rel=1e-7)
        assert answer["sigma"][2] == pytest.approx(found.sigma[1], rel=1e-7)
        assert apart(answer, u) < AGREE
        assert_covariances(answer, covariance)
        if "sound-speed" in blocks:
            sd = NOMINAL_M_S * u.speed * np.sqrt(covariance[9, 9])
            assert answer["sound_speed_sd_m_s"] == pytest.approx(sd, rel=1e-6)
            assert abs(answer["sound_speed_m_s"] - NOMINAL_M_S * u.speed) < AGREE * sd
        if "delay" in blocks:
            sd = np.sqrt(covariance[10, 10]) / (1e3 * NOMINAL_M_S)
            assert answer["delay_sd_s"] == pytest.approx(sd, rel=1e-6)
            assert abs(answer["delay_s"] - u.delay / (1e3 * NOMINAL_M_S)) < AGREE * sd


@pytest.mark.parametrize(("name", "row"), [("curved12", 2)])
def test_model_average_on_times_of_flight(name, row):
    data = data_of(name, row)
    start = conventional(name, row).unknowns
    first = variance.reml(variance.channel_components(data), start, 2, RIGID)
    found = model_average.average(
        data,
        first.fit.unknowns,
        first.sigma,
        RIGID,
        model_average.Recipe(quadrature="documented"),
        on_channels=True,
    )
    for answer in answers(name, "auto", row).values():
        assert answer["channel_sigma"] == pytest.approx(found.sigma[0], rel=1e-6)
        assert_average(answer, replace(found, sigma=answer["sigma"]), AGREE)


def test_poses_that_determine_nothing_are_those_that_singular_values_name():
    degenerate = ("parallel", "one axis", "one pose", "line in the plane")
    family, recorded = load("points24")
    seen = set()
    for row, kind in enumerate(family.kinds):
        if kind == "NaN" or 12 < row < 34:
            continue
        # Alone, images of a single pose are refused.
        road = "batch" if kind == "one pose" else "one"
        data = data_of("points24", row)
        status = recorded["conventional", road]["status_code"][row]
        if kind in degenerate:
            assert status == jaxcal.Status.UNOBSERVABLE, (row, kind)
        answer = {key: values[row] for key, values in recorded["conventional", road].items()}
        x = answer["image_to_probe"]
        u = Unknowns(x[:, :3], x[:, 3], answer["point"], np.ones(2))
        along = jacobian(
            lambda step, data=data, u=u: least_squares.circle(
                data, u.moved(step, RIGID), np.zeros(len(data))
            ),
            9,
        )
        spread = answer["cost"] / (3 * len(data) - 9)
        found = uncertainty.observability(data, u, RIGID, along, spread)
        lever = np.sqrt(np.mean(np.sum(np.stack(points(data, u)) ** 2, axis=0)))
        unknown = found.degenerate or found.weakest_sd > 0.5 * lever
        assert unknown == (status == jaxcal.Status.UNOBSERVABLE), (row, kind)
        assert found.degenerate == (~np.isfinite(answer["weakest_sd"])), (row, kind)
        seen.add(kind)
    assert seen >= {*degenerate, "narrow cone", "uniform", "few"}


def test_reconstruction_precision_is_equation_8():
    family, recorded = load("points24")
    for row in range(12):
        poses = np.tile(np.eye(4), (24, 1, 1))
        poses[:, :3] = family.arrays["poses"][row]
        used = family.arrays["mask"][row] > 0
        x = np.vstack([recorded["auto", "one"]["image_to_probe"][row], [0.0, 0.0, 0.0, 1.0]])
        measured = family.arrays["measurements"][row]
        mine = uncertainty.reconstruction_precision(x, poses[used], measured[used])
        theirs = jaxcal.reconstruction_precision(x, poses[used], measured[used])
        assert float(theirs) == pytest.approx(mine, rel=1e-12)
