"""Which poses: gains against brute force, plans inside their constraints, promises kept."""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

import jaxcal
from jaxcal import InputError, design
from jaxcal.data import geometry
from jaxcal.data.recording import Recording, make_images
from jaxcal.design import Constraints, Model, Noise, Region
from jaxcal.design.candidates import seen_region, sobol_poses, sobol_sequence
from jaxcal.design.criteria import check_criterion, curve, gains, rp_weight, tre_weight, weight_of
from jaxcal.design.greedy import Rules, are_alike
from jaxcal.design.information import Known, covariance_of, known_information
from jaxcal.design.planning import make_search
from jaxcal.diagnostics.sd_by_place import basis_at, log_sd_slopes

MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_rotvec([0.4, -0.8, 1.1]).as_matrix()
MOUNT[:3, 3] = [20.0, -35.0, 60.0]
TARGET = np.array([250.0, -120.0, 80.0])
EQUAL = Noise.constant((0.5, 0.5, 0.5), doubt=1.0)
MODEL = Model(MOUNT, TARGET, EQUAL)


def some(count: int = 400, seed: int = 0, model: Model = MODEL, **constraints) -> design.Candidates:
    return design.make_candidates(
        count=count, constraints=Constraints(**constraints), model=model, seed=seed
    )


def measured(model: Model, pose: np.ndarray) -> np.ndarray:
    """Lateral position, range, elevational offset."""
    q = model.targets(pose)
    return np.array([q[0], np.hypot(q[1], q[2]), q[1]])


@pytest.mark.parametrize(("scale", "face"), [(False, 0.0), (True, 0.0), (True, 12.0)])
def test_jacobian_is_that_of_the_measurements(scale, face):
    noise = Noise(np.random.default_rng(0).normal(0, 0.2, (3, 4)))
    model = Model(MOUNT, TARGET, noise, scale, face)
    for pose in some(5, model=model).poses:
        columns = []
        for k in range(9):
            step = np.zeros(9)
            step[k] = 1e-5 if 3 <= k < 6 else 1e-4

            def moved(sign, step=step, pose=pose):
                x = MOUNT.copy()
                x[:3, 3] += MOUNT[:3, :3] @ (sign * step[:3])
                x[:3, :3] = MOUNT[:3, :3] @ Rotation.from_rotvec(sign * step[3:6]).as_matrix()
                return measured(Model(x, TARGET + sign * step[6:]), pose)

            columns.append((moved(1) - moved(-1)) / (2 * step[k]))
        sigma = noise.sigma(model.targets(pose))
        if scale:
            lateral, depth, _ = measured(model, pose)
            columns += [np.array([-lateral, 0, 0]), np.array([0, face - depth, 0])]
        wanted = np.array(columns).T / sigma[:, None]
        np.testing.assert_allclose(model.jacobian(pose), wanted, rtol=1e-6, atol=1e-5)


def test_gain_is_that_of_brute_force_and_its_gradient_that_of_differences():
    model = Model(MOUNT, TARGET, Noise.of_probe(jaxcal.LinearProbe()))
    candidates = some(60, model=model)
    information = model.information(candidates.poses[:9]) + model.beliefs()
    covariance = covariance_of(information)
    weight = design.tre_weight(candidates.constraints.region.grid(), model)
    rows = model.jacobian(candidates.poses)
    quick = gains(rows, covariance, weight)
    volume = gains(rows, covariance, None)
    before = np.sum(weight * covariance)
    gain = jax.jit(lambda pose: design.gain(pose, covariance, weight, model))
    for k in range(9, 60, 7):
        after = np.linalg.inv(information + rows[k].T @ rows[k])
        told = float(gain(candidates.poses[k]))
        assert told == pytest.approx(before - np.sum(weight * after), rel=1e-7)
        assert quick[k] == pytest.approx(-np.log(np.sum(weight * after) / before), rel=1e-6)
        drop = np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(after)[1]
        assert volume[k] == pytest.approx(drop / 9, rel=1e-6)

    pose = jnp.asarray(candidates.poses[20])

    def along(tangent):
        turn = geometry.rotation_from_vector(tangent[3:])
        moved = geometry.matrix_from_rotation(
            pose[:3, :3] @ turn, pose[:3, 3] + pose[:3, :3] @ tangent[:3]
        )
        return gain(moved)

    along = jax.jit(along)
    slope = np.asarray(jax.grad(along)(jnp.zeros(6)))
    for k in range(6):
        size = 1e-4 if k >= 3 else 1e-2
        values = [float(along(size * m * jnp.eye(6)[k])) for m in (-2, -1, 1, 2)]
        wanted = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * size)
        assert slope[k] == pytest.approx(wanted, rel=1e-6, abs=1e-6 * np.abs(slope).max())


def test_weights_are_the_errors_that_they_stand_for():
    rng = np.random.default_rng(3)
    spread = rng.normal(size=(6, 6)) * np.array([0.3] * 3 + [0.004] * 3)[:, None]
    covariance = np.zeros((9, 9))
    covariance[:6, :6] = spread @ spread.T
    candidates = some(40)
    points = candidates.constraints.region.grid()
    draws = rng.normal(size=(4000, 6)) @ spread.T
    poses = candidates.poses
    places = MODEL.targets(poses) * np.array([1.0, 0.0, 1.0])
    squared, precision = [], []
    for draw in draws:
        x = MOUNT.copy()
        x[:3, 3] += MOUNT[:3, :3] @ draw[:3]
        x[:3, :3] = MOUNT[:3, :3] @ Rotation.from_rotvec(draw[3:]).as_matrix()
        apart = points @ (x - MOUNT)[:3, :3].T + (x - MOUNT)[:3, 3]
        squared.append((apart**2).sum(axis=1).mean())
        cloud = np.einsum("nij,nj->ni", poses[:, :3, :3], places @ x[:3, :3].T + x[:3, 3])
        precision.append((cloud + poses[:, :3, 3]).var(axis=0, ddof=1).sum())
    assert np.mean(squared) == pytest.approx(
        np.sum(tre_weight(points, MODEL) * covariance), rel=0.05
    )
    wanted = np.sum(rp_weight(poses, MODEL) * covariance)
    assert np.mean(precision) == pytest.approx(wanted, rel=0.05)


@settings(max_examples=8)
@given(
    cone=st.floats(2, 60), turn=st.floats(2, 180), seed=st.integers(0, 1000),
    half=st.floats(20, 80), near=st.floats(100, 250), tilted=st.booleans(),
    criterion=st.sampled_from(["tre", "rp", "d"]),
)  # fmt: skip
def test_no_pose_of_a_plan_leaves_the_constraints(cone, turn, seed, half, near, tilted, criterion):
    box = (tuple((TARGET - half).tolist()), tuple((TARGET + half + 20).tolist()))

    def allowed(poses):
        """What only a pose can tell, such as an arm's kinematics."""
        return poses[:, 0, 2] > -0.9 if tilted else np.ones(len(poses), bool)

    bounds = Constraints(
        cone_deg=cone, turn_deg=turn, box_mm=box, reach_mm=(near, 400.0), allowed=allowed,
        reference=Rotation.from_rotvec([0.1, 2.8, 0.4]).as_matrix(),
    )  # fmt: skip
    model = replace(MODEL, noise=Noise.constant((0.4, 0.3, 1.0), doubt=1.0))
    poses, _ = sobol_poses(100, model, bounds, seed)
    assume(len(poses) >= 20)
    candidates = design.Candidates(poses, model, bounds)
    plan = design.plan(candidates, 10, criterion)
    assert bounds.keeps(plan.poses, MOUNT, TARGET).all()
    numbers = bounds.coordinates(plan.poses, MOUNT, TARGET)
    np.testing.assert_allclose(bounds.poses(numbers, MOUNT, TARGET), plan.poses, atol=1e-9)
    np.testing.assert_allclose(plan.targets[:, 1], 0.0, atol=1e-9)
    tips = plan.poses[:, :3, :3] @ MOUNT[:3, 3] + plan.poses[:, :3, 3]
    assert (tips >= np.array(box[0])).all()
    assert (tips <= np.array(box[1])).all()
    axial = plan.poses[:, :3, :3] @ MOUNT[:3, 2]
    assert (
        np.degrees(np.arccos(np.clip(axial @ bounds.reference[:, 2], -1, 1))).max() <= cone + 1e-4
    )
    assert allowed(plan.poses).all()
    if criterion == "tre":
        unpolished = design.plan(candidates, 10, criterion, polish=False)
        assert plan.tre_mm[-1] <= unpolished.tre_mm[-1] * (1 + 1e-9)


def test_exchange_and_polish_each_improve_and_five_numbers_are_a_pose():
    candidates = some(1000)
    greedy = design.plan(candidates, 12, polish=False, swap=False)
    swapped = design.plan(candidates, 12, polish=False)
    polished = design.plan(candidates, 12)
    assert polished.tre_mm[-1] < swapped.tre_mm[-1] <= greedy.tre_mm[-1]
    assert polished.tre_mm[-1] < 0.99 * greedy.tre_mm[-1]


def test_a_fifth_fills_space_and_replicates_are_capped():
    rules = Rules(replicates=1, apart_deg=8.0, apart_mm=1e6)
    candidates = some(1500)
    plan = design.plan(candidates, 25, rules=rules)
    assert plan.filling.sum() == 5
    turns = (plan.poses[:, :3, :3] @ MOUNT[:3, :3]).reshape(-1, 9)
    for k in range(25):
        assert are_alike(turns, plan.targets, turns[[k]], plan.targets[[k]], rules).sum() == 1
    free = design.plan(candidates, 25, rules=Rules(space_filling=0.0, replicates=100))
    assert not free.filling.any()
    assert free.tre_mm[-1] < plan.tre_mm[-1]
    numbers = np.abs(candidates.numbers[plan.rows[plan.filling], :2])
    assert numbers.min() < 0.5


@pytest.mark.parametrize(
    ("constraints", "words"),
    [({"cone_deg": 0.0, "turn_deg": 0.0}, ["tilted about the image's lateral axis"]),
     ({"cone_deg": 0.0}, ["tilted about"]),
     ({"region": Region((3.0, 3.0), (40.0, 40.0))}, ["nearer and farther"])],
)  # fmt: skip
def test_candidates_that_determine_nothing_are_no_plan(constraints, words):
    candidates = some(200, **constraints)
    with pytest.raises(InputError, match=r"would not determine .*: add poses") as caught:
        design.plan(candidates, 10)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert "\n" not in str(caught.value)


def pose_of(candidates):
    model = candidates.model
    return candidates.constraints, model.image_to_probe, model.point


def test_other_types_are_refused_in_words_where_types_are_not_checked():
    # In a process of its own: here the annotations are checked first, and give another error.
    code = """
import numpy as np
import jaxcal
from jaxcal import design

candidates = design.make_candidates(count=50)
plan = design.plan(candidates, 5, polish=False)
for call, said in (
    (lambda: design.plan(candidates, "12"), "the number of poses must be a whole number"),
    (lambda: design.plan("candidates", 12), "candidates must be made by make_candidates"),
    (lambda: design.plan(candidates, 12, prior="x"), "result must be made by jaxcal.calibrate"),
    (lambda: design.plan(candidates, 12, rules="x"), "rules must be made by jaxcal.design.Rules"),
    (lambda: design.plan(candidates, 12, polish="no"), "polish must be True or False"),
    (lambda: design.plan(candidates, 12, cost_s="x"), "cost_s must be an array"),
    (lambda: design.least_error(candidates, 12.5), "the number of poses must be a whole number"),
    (lambda: design.simulate_errors(plan, trials="9"), "trials must be a whole number"),
    (lambda: design.simulate_errors(plan, "flat"), "law must be one of uniform"),
    (lambda: design.images_to(plan, "0.2"), "the wanted error must be a positive number"),
    (lambda: design.images_to(plan, 1e-3, [plan]), "candidates must be made by make_candidates"),
    (lambda: design.make_candidates("linear"), "probe must be a jaxcal.LinearProbe"),
    (lambda: design.make_candidates(region="x"), "region must be made by jaxcal.design.Region"),
    (lambda: design.make_candidates(model="x"), "model must be made by jaxcal.design.Model"),
    (lambda: design.candidates_around("a.h5", None), "candidates_around takes a recording"),
    (lambda: design.known_information("x", candidates.model, []), "result must be made by"),
    (lambda: design.plan_figure("plan"), "plan must be made by jaxcal.design.plan"),
    (lambda: design.gain(np.eye(3), np.eye(9), np.eye(9), candidates.model), "pose must have"),
    (lambda: design.tre_weight(np.eye(2), candidates.model), "points must have shape (m, 3), not"),
    (lambda: design.tre_weight(np.eye(3), "m"), "model must be made by jaxcal.design.Model"),
    (lambda: design.Constraints(cone_deg="40"), "cone_deg must be 0 to 85 degrees, not '40'"),
    (lambda: design.Constraints(reach_mm=3), "reach_mm must be two mm in order, not 3"),
    (lambda: design.Constraints(allowed="all"), "allowed must be a function of poses"),
    (lambda: design.Region(depth_mm=5), "depth_mm of the region must be two mm in order"),
    (lambda: design.Region.of_probe(None), "probe must be a jaxcal.LinearProbe"),
    (lambda: design.Noise(np.ones((2, 4))), "the noise model's coefficients must have shape"),
    (lambda: design.Model(np.eye(3)), "image_to_probe of the model must be an array of shape"),
    (lambda: design.Model(point="abc"), "point of the model must be an array of shape"),
    (lambda: design.Model(scale="no"), "scale of the model must be True or False"),
    (lambda: design.Model(face_offset_mm="a"), "face_offset_mm of the model must be a number"),
    (lambda: design.Noise(np.full((3, 4), "a")), "the noise model's coefficients must be an array"),
    (lambda: design.plan(candidates, 8, prior=1j * np.eye(9)), "information must be an array"),
    (lambda: design.pose_in_words(np.eye(4), None, np.eye(4), np.zeros(3)), "constraints must be"),
    (lambda: design.Noise.learned(None, np.zeros((9, 3))), "result must be made by"),
    (lambda: design.simulate_errors(np.tile(np.eye(4), (3, 1, 1)), candidates=candidates), "3 pos"),
):
    try:
        call()
    except jaxcal.InputError as error:
        assert str(error).startswith(said), error
    else:
        raise AssertionError(said)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_batch_is_no_calibration_to_plan_from(flat):
    recording, result = flat
    batch = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), result)
    assert batch.rms.shape == (2,)
    with pytest.raises(InputError, match="the result is of a batch"):
        design.candidates_around(recording, batch)


def test_what_cannot_be_asked():
    candidates = some(50)
    for call, match in (
        (lambda: design.plan(candidates, 3), "between 4 and"),
        (lambda: design.plan(candidates, 12, prior=-np.eye(9)), "negative eigenvalues"),
        (lambda: design.make_candidates(count=0), "count must be between 1"),
        (lambda: design.make_candidates(seed=-1), "seed must be between 0"),
        (lambda: design.pose_in_words(np.full((4, 4), np.nan), *pose_of(candidates)), "NaN"),
        (lambda: some(50, reference=-np.eye(3)), "3x3 rotation"),
        (lambda: some(50, box_mm=((1.0,) * 3, (0.0,) * 3)), "least and the largest corner"),
        (lambda: some(50, allowed=lambda poses: np.ones(3, bool)), "allowed must return"),
        (lambda: some(50, allowed=lambda poses: "yes"), "allowed must return .* not 'yes'"),
        (lambda: design.Rules(replicates=0), "replicates"),
        (lambda: design.Rules(space_filling=2.0), "space_filling"),
        (lambda: check_criterion("volume"), "criterion must be"),
        (lambda: design.plan(candidates, 10, prior=np.eye(6)), "9 x 9"),
        (lambda: some(50, cone_deg=99.0), "cone_deg"),
        (lambda: Region((5.0, -5.0)), "lateral_mm"),
        (lambda: Region((-1e308, 1e308)), "up to 5000 mm"),
        (lambda: Noise.constant((1.0, 0.0, 1.0)), "three positive"),
        (lambda: Noise(np.full((3, 4), np.nan)), "finite"),
        (lambda: design.images_to(design.plan(candidates, 5), -1.0), "positive"),
        (lambda: design.images_to(design.plan(candidates, 5), 1e-4), "more than 1000"),
        (lambda: some(50, box_mm=((0.0,) * 3, (1.0,) * 3)), "widen"),
        (lambda: some(50, model=Model(2 * MOUNT, TARGET, EQUAL)), "not a rigid transform"),
        (lambda: some(50, model=Model(MOUNT, TARGET * np.nan, EQUAL)), "must be finite"),
        (lambda: some(50, model=Model(MOUNT, TARGET, EQUAL, False, np.nan)), "number of mm"),
        (lambda: Noise.constant((1e-30, 1.0, 1.0)), "three positive mm between"),
        (lambda: Noise.of_probe(jaxcal.LinearProbe(), channel_mm=0.0), "channel_mm must be an SD"),
        (lambda: Noise.of_probe(jaxcal.LinearProbe(), focus_mm=np.nan), "focus_mm must be"),
        (lambda: design.plan(some(50, model=Model(noise=Noise(np.full((3, 4), 300.0)))), 8),
         "SDs must be 1e-06 to 1e.06 mm at all"),
        (lambda: design.plan(candidates, 8, cost_s=np.full(50, np.inf)), "positive number of sec"),
        (lambda: design.plan(candidates, 8, prior=Known(np.eye(11))), "9 x 9"),
        (lambda: design.plan(candidates, 8, prior=Known(np.eye(9) * np.nan)), "finite 9 x 9"),
        (lambda: replace(candidates, taken=np.full((1, 4, 4), np.nan), _checked=False),
         "taken pose 0"),
        (lambda: replace(candidates, taken=candidates.poses, used=np.array([True]), _checked=False),
         "used must hold"),
        (lambda: replace(candidates, used=np.array([True]), _checked=False), "used must hold"),
        (lambda: design.plan(candidates, 8, polish=False).first(-1), "between 0 and 8"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=match):
            call()


def test_poses_that_are_alike_are_counted_once_for_each_image_in_use():
    """All of several blocks of images, and none of those that a calibration left out."""
    pool, taken = some(60), some(700, seed=1).poses
    used = np.arange(700) % 3 > 0
    pool = replace(pool, taken=taken, used=used)
    rules = Rules(replicates=5, apart_deg=15.0, apart_mm=20.0)
    search = make_search(pool, Known(MODEL.beliefs(), 400), "tre", rules)
    others = np.concatenate([taken[used], pool.poses[[3, 7]]])
    turns = Rotation.from_matrix(others[:, :3, :3])
    angles = [(Rotation.from_matrix(p[:3, :3].T) * turns).magnitude() for p in pool.poses]
    apart = np.linalg.norm(MODEL.targets(pool.poses)[:, None] - MODEL.targets(others), axis=-1)
    alike = (np.degrees(angles) < rules.apart_deg) & (apart < rules.apart_mm)
    assert alike.sum() > 100
    np.testing.assert_array_equal(search.counts([3, 7]), alike.sum(axis=1))
    alone = search.alike(3)
    np.testing.assert_array_equal(search.counts([3]) - search.counts([]), alone)
    # Nor does a plan that goes on with another one count them.
    first = design.plan(pool, 5, prior=Known(MODEL.beliefs(), 400), polish=False)
    after = design.next_poses(first, pool, 2)
    expected = np.concatenate([taken[used], first.poses])
    np.testing.assert_array_equal(after.candidates.taken_and_used, expected)
    # Its poses determine what a single candidate alone would not.
    single = replace(pool, poses=pool.poses[:1], taken=None, used=None)
    assert len(design.next_poses(first, single)) == 1


@pytest.mark.parametrize("model", [MODEL, Model()])
def test_metres_taken_for_mm_are_noticed(model):
    poses = some(50, model=model).poses.copy()
    poses[:, :3, 3] /= 1000
    with pytest.raises(InputError, match=r"none of the candidate poses .* in mm"):
        design.Candidates(poses, model, Constraints())


def test_polish_makes_no_pose_outside_the_constraints_worse():
    wide = some(cone_deg=60.0, turn_deg=170.0)
    narrow = design.Candidates(wide.poses, MODEL, Constraints(cone_deg=15.0, turn_deg=20.0))
    alone, polished = (design.plan(narrow, 6, polish=moved) for moved in (False, True))
    assert polished.tre_mm[-1] <= alone.tre_mm[-1]


def test_a_calibration_of_other_images_is_no_prior(flat):
    recording, result = flat
    around = design.candidates_around(recording, result, count=50)
    fewer = replace(around, taken=around.taken[:-1])
    with pytest.raises(InputError, match=r"the calibration is of \d+ images, \d+ poses"):
        design.next_poses(result, fewer)
    other = jaxcal.simulate_recording(jaxcal.Protocol(images=20), seed=1)
    with pytest.raises(InputError, match=r"the calibration is of \d+ images, 20 poses"):
        design.candidates_around(other, result)
    scaled = replace(around, model=replace(around.model, scale=True))
    with pytest.raises(InputError, match="pixel scales are unknown"):
        design.next_poses(result, scaled)


def test_with_sds_wrong_by_three_a_plan_is_nearly_as_good():
    true = Noise.constant((0.4, 0.3, 1.0), doubt=1.0)
    pool = some(500, model=replace(MODEL, noise=true))
    nothing = Known(MODEL.beliefs())

    def error(poses):
        return curve(pool, nothing, poses)[0][-1]

    right = error(design.plan(pool, 20, polish=False).poses)
    random = np.mean([error(pool.poses[k : k + 20]) for k in range(0, 200, 20)])
    for factors in ((1, 3, 1), (1, 1 / 3, 1), (1, 1, 3), (1, 1, 1 / 3), (3, 1, 3), (1, 3, 1 / 3)):
        wrong = Noise.constant(np.array([0.4, 0.3, 1.0]) * factors)
        candidates = replace(pool, model=replace(MODEL, noise=wrong))
        assert error(design.plan(candidates, 20, polish=False).poses) < 1.1 * right
    assert right < 0.8 * random


@pytest.fixture(scope="module")
def every_five():
    """Seven candidates, and TRE and reconstruction precision of every set of five."""
    few = some(7)
    curves = [
        curve(few, Known(MODEL.beliefs()), few.poses[list(rows)])
        for rows in itertools.combinations_with_replacement(range(7), 5)
    ]
    return few, [(tre[-1], rp[-1]) for tre, rp, *_ in curves]


@pytest.mark.parametrize("criterion", ["tre", "rp"])
def test_no_set_of_poses_goes_below_the_bound(criterion, every_five):
    few, errors = every_five
    which = 0 if criterion == "tre" else 1
    best = min(each[which] for each in errors)
    least = design.least_error(few, 5, criterion)
    assert 0.85 * best < least < best
    # Of many candidates a plan takes nearly the best.
    pool = some(2000)
    chosen = design.plan(pool, 20, criterion, polish=False, rules=Rules(0.0, 20))
    least = design.least_error(pool, 20, criterion)
    assert least < (chosen.tre_mm, chosen.rp_mm)[which][-1] < 1.04 * least
    # After a plan, what is known counts.
    assert design.least_error(pool, 20, criterion, chosen) < 0.8 * least
    with pytest.raises(InputError, match="choose the criterion tre or rp"):
        design.least_error(pool, 20, "d")
    with pytest.raises(InputError, match="between 1 and"):
        design.least_error(pool, 0)


def test_sds_that_grow_with_depth_are_learned_and_moved_away_from():
    rng = np.random.default_rng(1)
    count = 3000
    places = np.column_stack(
        [rng.uniform(-25, 25, count), np.zeros(count), rng.uniform(15, 85, count)]
    )
    basis = basis_at(places)
    basis[:, 1:] -= basis[:, 1:].mean(axis=0)
    squared = np.exp(basis @ [0.0, 1.6, 0.0, 0.0]) * rng.chisquare(1, count)
    slopes = 2 * log_sd_slopes(basis, squared, np.ones_like(squared))
    assert slopes[0] == pytest.approx(1.6, abs=0.2)
    assert np.abs(slopes[1:]).max() < 0.3
    noise = Noise.of_probe(jaxcal.LinearProbe())
    shallow, deep = noise.sigma(np.array([[0.0, 0.0, 40.0], [0.0, 0.0, 80.0]]))
    assert deep[0] > 1.4 * shallow[0]
    assert deep[2] > 1.4 * shallow[2]
    growing = Noise(EQUAL.coefficients + np.array([0.0, 1.5, 0.0, 0.0]), 1.0)
    usual = design.plan(some(800), 20).targets[:, 2].mean()
    assert (
        design.plan(some(800, model=replace(MODEL, noise=growing)), 20).targets[:, 2].mean() < usual
    )


def simulated(candidates: design.Candidates, poses: np.ndarray, rng: np.random.Generator):
    """A recording at these poses: every image errs by the model's SDs in all three directions."""
    model = candidates.model
    true = model.targets(poses)
    error = rng.normal(size=true.shape) * model.noise.sigma(true)[:, [0, 2, 1]]
    moved = poses.copy()
    moved[:, :3, 3] += np.einsum("nij,nj->ni", poses[:, :3, :3] @ MOUNT[:3, :3], error)
    return Recording(make_images(moved, true[:, [0, 2]]))


def actual(candidates: design.Candidates, poses: np.ndarray, trials: int, seed: int) -> np.ndarray:
    """Root mean square TRE of conventional calibration, in closed form."""
    rng = np.random.default_rng(seed)
    points = candidates.constraints.region.grid()
    squared = []
    for _ in range(trials):
        found = jaxcal.calibrate_closed_form(simulated(candidates, poses, rng)).image_to_probe
        apart = points @ (found - MOUNT)[:3, :3].T + (found - MOUNT)[:3, 3]
        squared.append((apart**2).sum(axis=1).mean())
    return np.sqrt(np.mean(squared))


def test_optimal_poses_beat_random_ones_as_promised_and_in_fact():
    """Conventional: with equal SDs its error is the bound that plans promise."""
    pool = some(1000)
    known = Known(MODEL.beliefs())
    plan = design.plan(pool, 12)
    sets = {"optimal": plan.poses, "random": pool.poses[:12]}
    told, seen = {}, {}
    for name, poses in sets.items():
        covariance = covariance_of(known.information + MODEL.information(poses))
        told[name] = np.sqrt(np.sum(weight_of("tre", pool) * covariance))
        seen[name] = actual(pool, poses, 120, 5)
        assert seen[name] == pytest.approx(told[name], rel=0.12)
    assert told["optimal"] < 0.75 * told["random"]
    assert seen["optimal"] < 0.8 * seen["random"]


def test_next_poses_go_on_with_a_plan_and_images_to_counts_them():
    pool = some(800)
    first = design.plan(pool, 10)
    more = design.next_poses(first, pool, 6)
    assert more.tre_mm[0] == pytest.approx(first.tre_mm[-1])
    assert (np.diff(more.tre_mm) < 0).all()
    wanted = float(more.tre_mm[4])
    assert 10 <= design.images_to(first, wanted) <= 16
    assert design.images_to(first, float(first.tre_mm[-1])) == 10
    assert design.images_to(first, 0.5 * wanted) > 30


@pytest.fixture(scope="module")
def flat():
    """Twelve images without a tilt or a turn about two of the axes, and their calibration."""
    rng = np.random.default_rng(2)
    constraints = Constraints(cone_deg=30.0, turn_deg=0.0)
    numbers = np.column_stack([rng.uniform(-1, 1, (12, 2)), np.zeros((12, 3))])
    numbers[:, 2] = rng.uniform(-0.5, 0.5, 12)
    poses = constraints.poses(numbers, MOUNT, TARGET)
    recording = simulated(some(50), poses, rng)
    return recording, jaxcal.calibrate(recording, "conventional")


def test_the_trackers_errors_are_those_of_further_images_too():
    recording = jaxcal.simulate_recording(jaxcal.Protocol(images=12))
    found = jaxcal.calibrate(recording, "conventional")
    tracked = replace(found.linearisation, tracker_sd=np.array(4.0))
    found = replace(found, method="joint", sigma=np.full(3, 3.0), linearisation=tracked)
    targets = np.random.default_rng(0).uniform(20.0, 60.0, (12, 3))
    np.testing.assert_allclose(Noise.learned(found, targets).sigma(targets), 5.0, rtol=1e-12)


def test_a_plan_from_an_unobservable_recording_aims_at_the_unseen_direction(flat):
    recording, result = flat
    assert result.status == "unobservable"
    candidates = design.candidates_around(recording, result, count=800)
    more = design.next_poses(result, candidates, 3)
    x, point = candidates.model.image_to_probe, candidates.model.point
    numbers = candidates.constraints.coordinates(more.poses, x, point)
    # All images tilt about the lateral axis alone; what is missing are the other two.
    assert np.hypot(numbers[:, 3], numbers[:, 4]).max() > np.radians(25)
    assert more.tre_mm[-1] < 0.2 * more.tre_mm[0]
    along = known_information(result, candidates.model, recording.calibration.poses)
    same = candidates.constraints.poses(
        np.column_stack([np.zeros((3, 2)), [[-0.4], [0.0], [0.4]], np.zeros((3, 2))]), x, point
    )
    alike = covariance_of(along + candidates.model.information(same))
    weight = weight_of("tre", candidates)
    assert np.sum(weight * alike) > 10 * np.sum(weight * more.covariance)


def test_what_a_calibration_knows_is_its_covariance():
    pool = some(50)
    recording = simulated(pool, pool.poses[:12], np.random.default_rng(4))
    result = jaxcal.calibrate(recording, "conventional")
    assert result.status == "converged"
    candidates = design.candidates_around(recording, result, count=500)
    information = known_information(result, candidates.model, recording.calibration.poses)
    found = covariance_of(information)[:6, :6]
    np.testing.assert_allclose(found, np.asarray(result.covariance), rtol=1e-6, atol=1e-12)
    plan = design.next_poses(result, candidates, 2)
    assert plan.known.images == 12
    assert (np.diff(plan.tre_mm) < 0).all()
    assert design.images_to(result, float(plan.tre_mm[0]) / 2, candidates) > 8
    with pytest.raises(InputError, match="candidates_around"):
        design.plan(some(50), 5, prior=result)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [((-0.9, 0.9, 0.0, -np.radians(20), 0.0),
      "tilt 20 degrees towards the marker, target in the lower left corner"),
     ((0.9, -0.9, np.radians(32), 0.0, np.radians(41)),
      "tilt 30 degrees towards you, turn 40 degrees clockwise, target in the upper right corner"),
     ((0.0, 0.0, 0.0, 0.0, 0.0), "hold it straight, target in the middle of the image"),
     ((0.0, 0.8, -0.3, 0.3, -0.3),
      "tilt 25 degrees away from the marker and away from you, turn 15 degrees counter-clockwise, "
      "target in the middle of the lower part")],
)  # fmt: skip
def test_poses_in_words(numbers, words):
    bounds = Constraints(reference=Rotation.from_rotvec([2.0, 0.3, 0.1]).as_matrix())
    pose = bounds.poses(np.array([numbers]), MOUNT, TARGET)[0]
    assert design.pose_in_words(pose, bounds, MOUNT, TARGET) == words
    # The handle is behind the image: towards the marker is along the lateral axis.
    straight = bounds.reference
    handle = -(pose[:3, :3] @ MOUNT[:3, :3])[:, 2] @ straight
    if "tilt" in words and "marker" in words:
        assert (handle[0] > 0) == ("towards the marker" in words)


def test_curvilinear_regions_are_sectors():
    region = Region.of_probe(jaxcal.CurvilinearProbe())
    unit = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    np.testing.assert_allclose(region.unit(region.place(unit)), unit, atol=1e-12)
    place = region.place(unit)
    assert jaxcal.CurvilinearProbe().contains(place, 90.0).all()
    candidates = design.make_candidates(jaxcal.CurvilinearProbe(), count=300)
    plan = design.plan(candidates, 8)
    assert (np.abs(region.unit(plan.targets)) <= 1 + 1e-9).all()


def test_the_region_of_a_shallow_target_is_where_it_was():
    targets = np.array([[-2.0, 0.0, 1.5], [2.0, 0.0, 8.0]])
    images = make_images(np.tile(np.eye(4), (4, 1, 1)), np.ones((4, 2)))
    assert seen_region(Recording(images), targets).depth_mm == (1.5, 11.0)
    targets[:, 2] += 4.0
    assert seen_region(Recording(images), targets).depth_mm == (5.0, 15.0)


def test_the_region_of_pixels_has_no_negative_columns():
    targets = np.array([[1.0, 0.0, 6.0], [5.0, 0.0, 12.0]])
    poses, points = np.tile(np.eye(4), (4, 1, 1)), np.ones((4, 2))
    in_mm, in_px = (Recording(make_images(poses, points, kind)) for kind in ("point", "pixel"))
    assert seen_region(in_mm, targets).lateral_mm == (-2.0, 8.0)
    assert seen_region(in_px, targets).lateral_mm == (0.0, 8.0)


def test_the_region_of_pixels_ends_with_the_frame():
    targets = np.array([[1.0, 0.0, 6.0], [5.0, 0.0, 12.0]])
    poses, pixels = np.tile(np.eye(4), (4, 1, 1)), np.ones((4, 2))
    transform = jaxcal.ImageTransform(np.eye(4), np.array([0.1, 0.2]), 1.0, range_factor=0.5)

    def ends(size):
        images = make_images(poses, pixels, "pixel", frame_size=size)
        region = seen_region(Recording(images), targets, transform)
        return region.lateral_mm[1], region.depth_mm[1]

    assert ends(None) == ends((1000, 1000)) == (8.0, 15.0)
    # The centre of the last pixel, at the estimated sound speed, from the range of row 0.
    np.testing.assert_allclose(ends((61, 131)), (6.0, 14.0))
    # A target that was seen is inside whatever the frame's size says.
    assert ends((11, 11)) == (5.0, 12.0)


@pytest.mark.parametrize("count", [4, 10])
def test_the_figure_is_a_figure(tmp_path, count):
    plan = design.plan(some(200), count)
    figure = design.plan_figure(plan, 0.3)
    figure.savefig(tmp_path / "plan.png")
    assert (figure.axes[2].get_xticks() % 1 == 0).all()
    last = figure.axes[2].lines[0].get_xydata()[-1]
    np.testing.assert_array_equal(last, [count, plan.tre_mm[-1]])
    assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG")
    # Not by colour alone, and every line of errors has a name.
    assert len({line.get_marker() for line in figure.axes[1].lines}) == 2
    assert not any(str(line.get_label()).startswith("_") for line in figure.axes[2].lines)
    # The marker is to the right and the person below, as in the words.
    bounds, model = plan.candidates.constraints, plan.candidates.model
    for which, line in zip((~plan.filling, plan.filling), figure.axes[1].lines, strict=True):
        for azimuth, pose in zip(np.asarray(line.get_xdata()), plan.poses[which], strict=True):
            words = design.pose_in_words(pose, bounds, model.image_to_probe, model.point)
            assert "towards the marker" not in words or np.cos(azimuth) > 0
            assert "away from the marker" not in words or np.cos(azimuth) < 0
            assert "towards you" not in words or np.sin(azimuth) < 0
            assert "away from you" not in words or np.sin(azimuth) > 0


def test_sobols_sequence_is_scipys():
    expected = qmc.Sobol(5, scramble=False).random_base2(9)
    np.testing.assert_array_equal(sobol_sequence(512), expected)


@pytest.mark.parametrize(("scale", "face"), [(False, 0.0), (True, 12.0)])
def test_simulated_errors_with_equal_sds_are_the_bound(scale, face):
    """For equal Gaussian errors the conventional fit is the maximum of the likelihood."""
    model = replace(MODEL, noise=Noise.constant((0.2, 0.2, 0.2), doubt=1.0), scale=scale)
    model = replace(model, face_offset_mm=face)
    candidates = some(60, model=model)
    poses = candidates.poses[:16]
    found = design.simulate_errors(poses, "normal", candidates, method="conventional", seed=1)
    covariance = covariance_of(model.information(poses))
    points = candidates.constraints.region.grid()
    bound = np.sqrt(np.sum(tre_weight(points, model) * covariance))
    assert found.lost == 0
    assert abs(found.tre_mm - bound) < 4 * found.tre_error_mm + 0.005 * bound
    assert found.tre_error_mm < 0.02 * bound
    tests = candidates.poses[::2]
    scatter = np.sqrt(np.sum(rp_weight(tests, model) * covariance))
    # The mean of roots is below the root of the mean.
    assert 0.85 * scatter < found.rp_mm < scatter


def test_simulated_errors_know_the_law():
    """A mean cannot be told from a shift. (What edges tell: see the plan in test_cli.py.)"""
    candidates = some(100, model=replace(MODEL, noise=Noise.constant((0.1, 0.1, 1.0))))
    sets = candidates.poses[np.random.default_rng(2).integers(100, size=(1000, 16))]
    found = {
        law: design.simulate_errors(sets, law, candidates, method="conventional", seed=3)
        for law in ("uniform", "normal", "one-sided")
    }
    assert found["uniform"].trials == 1000
    assert found["uniform"].tre_mm == pytest.approx(found["normal"].tre_mm, rel=0.05)
    assert found["one-sided"].tre_mm > 1.5 * found["normal"].tre_mm
    assert found["normal"].tre_mm < found["normal"].tre_95_mm


def test_simulated_errors_count_the_images_taken_before():
    recording = jaxcal.simulate_recording(jaxcal.Protocol(images=12), seed=1)
    result = jaxcal.calibrate(recording, "conventional")
    around = design.candidates_around(recording, result, count=60)
    more = design.next_poses(result, around, 4)
    found = design.simulate_errors(more, "normal", around, method="conventional")
    assert found.images == 16
    # What a fit with equal weights to errors of these sizes gives; 4 SDs are 5 %.
    poses = np.concatenate([recording.calibration.poses, more.poses])
    sd = around.model.noise.sigma(around.model.targets(poses))[..., None]
    rows = around.model.jacobian(poses) * sd
    steps = np.linalg.pinv(rows.reshape(-1, 9)) * sd.ravel()
    expected = np.sqrt(np.sum(weight_of("tre", around) * (steps @ steps.T)))
    assert found.tre_mm == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"candidates": None}, "candidates"),
        ({"poses": np.tile(np.eye(4), (2, 2, 5, 1, 1))}, "poses must be"),
        ({"poses": np.full((5, 4, 4), np.nan)}, "pose 0 holds NaN or Inf"),
        ({"trials": 1}, "trials"),
    ],
)
def test_simulations_that_cannot_be(change, match):
    candidates = some(8)
    given = {"poses": candidates.poses, "law": "normal", "candidates": candidates} | change
    with pytest.raises(InputError, match=match):
        design.simulate_errors(given.pop("poses"), **given)


@pytest.mark.usefixtures("unchecked")
def test_a_calibration_is_no_law():
    with pytest.raises(InputError, match="law must be one of"):
        design.simulate_errors(np.tile(np.eye(4), (5, 1, 1)), np.eye(4), some(8))
