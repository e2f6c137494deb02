"""Pivot calibration: B_i p = c, on real recordings and on poses whose tip is known."""

from __future__ import annotations

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal import FormatError, InputError
from jaxcal.cli.main import main
from jaxcal.io.importing.frame_poses import tool_poses
from jaxcal.io.importing.sources import ImportOptions
from jaxcal.io.sequence_files import write_sequence
from jaxcal.io.text import read_poses

TIP, POINT = np.array([3.0, -20.0, 150.0]), np.array([100.0, -200.0, 900.0])
POSES = 300
"""Padded to 512, as those of the real recordings are: one program serves all."""


def swung(rotations: Rotation, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(rotations), 1, 1))
    poses[:, :3, :3] = rotations.as_matrix()
    poses[:, :3, 3] = POINT - rotations.apply(TIP)
    poses[:, :3, 3] += noise * np.random.default_rng(seed).normal(size=(len(rotations), 3))
    return poses


def random_rotations(count: int, seed: int = 0) -> Rotation:
    return Rotation.from_rotvec(0.4 * np.random.default_rng(seed).normal(size=(count, 3)))


def test_a_known_tip():
    exact = jaxcal.calibrate_pivot(swung(random_rotations(POSES)))
    np.testing.assert_allclose(exact.tip, TIP, atol=1e-9)
    np.testing.assert_allclose(exact.point, POINT, atol=1e-9)
    assert exact.status == "converged"
    assert not np.asarray(exact.outlier).any()
    noisy = jaxcal.calibrate_pivot(swung(random_rotations(POSES), noise=0.5))
    assert float(noisy.sigma) == pytest.approx(0.5, rel=0.1)
    error = np.concatenate([noisy.tip - TIP, noisy.point - POINT])
    # A chi-square with 6 degrees of freedom is below 22.5 in 999 of 1000.
    assert error @ np.linalg.solve(noisy.covariance, error) < 22.5


def slid(seed: int) -> np.ndarray:
    """A stylus that is turned at 30 poses a second, and slides in the dimple within a second."""
    rng, wander = np.random.default_rng(seed), np.zeros((300, 3))
    time = np.arange(300)[:, None] / 30
    waves = np.sin(2 * np.pi * time * [0.23, 0.31, 0.17] + rng.uniform(0, 6, 3))
    for index in range(1, 300):
        wander[index] = 0.97 * wander[index - 1] + 0.05 * rng.normal(size=3)
    poses = swung(Rotation.from_rotvec(0.5 * waves), noise=0.05, seed=seed)
    poses[:, :3, 3] += wander
    return poses


def test_errors_that_successive_poses_share_widen_the_covariance():
    squares = 0.0
    for seed in range(6):
        found = jaxcal.calibrate_pivot(slid(seed))
        assert float(found.alike_for) > 10
        error = found.tip - TIP
        squares += float(error @ np.linalg.solve(found.covariance[:3, :3], error))
    # A chi-square with 18 degrees of freedom is below 42.3 in 999 of 1000.
    assert squares < 42.3
    found = jaxcal.calibrate_pivot(slid(0))
    told = f"errors are alike for about {float(found.alike_for):.0f} successive poses"
    assert told in str(found)
    both = np.asarray(found.information @ found.covariance)
    np.testing.assert_allclose(both, float(found.sigma) ** 2 * np.eye(6), atol=1e-8)
    shuffled = jaxcal.calibrate_pivot(slid(0)[np.random.default_rng(0).permutation(300)])
    assert float(shuffled.alike_for) == 1.0
    assert "alike" not in str(shuffled)
    np.testing.assert_allclose(found.covariance, shuffled.covariance * found.alike_for, rtol=1e-6)


def test_rotation_about_one_axis_leaves_the_tip_open_along_it():
    axis = np.array([0.0, 0.6, 0.8])
    one = Rotation.from_rotvec(np.linspace(-0.5, 0.5, 300)[:, None] * axis)
    for noise in (0.0, 0.3):
        result = jaxcal.calibrate_pivot(swung(one, noise))
        assert result.status == "unobservable"
        assert np.isnan(result.covariance).all()
        assert abs(float(np.asarray(result.weakest) @ axis)) > 0.999
        assert "do not determine the tip along" in result.warnings[0]
    with pytest.raises(InputError, match="300 used poses, 1 of them different, are too few"):
        jaxcal.calibrate_pivot(swung(Rotation.identity(300)))


def test_a_third_of_the_poses_may_be_anything():
    poses = swung(random_rotations(POSES), noise=0.4)
    poses[200:, :3, 3] += np.random.default_rng(2).uniform(20, 100, (100, 3))
    robust = jaxcal.calibrate_pivot(poses)
    assert np.flatnonzero(robust.outlier).tolist() == list(range(200, 300))
    used = np.arange(300) < 200
    good = jaxcal.calibrate_pivot(poses, used, robust=False)
    np.testing.assert_allclose(robust.tip, good.tip, atol=1e-9)
    plain = jaxcal.calibrate_pivot(poses, robust=False)
    assert np.linalg.norm(plain.tip - TIP) > 20 * np.linalg.norm(robust.tip - TIP)


def test_errors_that_no_tip_in_a_dimple_has_are_told(tmp_path, capsys):
    poses = swung(random_rotations(POSES))
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    poses[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()  # the scalar read as x
    found = jaxcal.calibrate_pivot(poses)
    assert found.wrong_frames is not None
    assert "too large for a tip that stays in place" in found.wrong_frames
    assert found.warnings[0] == found.wrong_frames
    told = str(found)
    assert told.count(found.wrong_frames) == 1
    assert told.startswith("do not use: ")
    path = tmp_path / "poses.txt"
    np.savetxt(path, poses.reshape(POSES, 16))
    assert main(["pivot", str(path), "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["wrong_frames"] == found.wrong_frames
    right = jaxcal.calibrate_pivot(swung(random_rotations(POSES), noise=0.5))
    assert right.warnings == []
    assert right.wrong_frames is None


def test_poses_that_a_tracker_repeats_count_once(tmp_path, capsys):
    poses = swung(random_rotations(POSES), noise=0.5)
    once = jaxcal.calibrate_pivot(poses, np.arange(POSES) < POSES // 2)
    repeated = np.repeat(poses[: POSES // 2], 2, axis=0)
    twice = jaxcal.calibrate_pivot(repeated)
    assert int(twice.mask.sum()) == 150
    path = tmp_path / "poses.txt"
    np.savetxt(path, repeated.reshape(POSES, 16))
    assert main(["pivot", str(path)]) == 0
    said = capsys.readouterr().out
    assert "150 poses repeat an earlier one exactly: not used" in said
    assert str(twice).split() == said.split()
    assert twice.record()["repeated"] == 150
    np.testing.assert_allclose(twice.record()["tip_mm"], TIP, atol=0.5)
    with_hidden = np.ma.masked_array(np.ones(POSES), np.arange(POSES) >= 50)
    assert int(jaxcal.calibrate_pivot(poses, with_hidden).mask.sum()) == 50
    np.testing.assert_allclose(twice.covariance, once.covariance, rtol=1e-9)
    with pytest.raises(InputError, match="20 used poses, 2 of them different, are too few"):
        jaxcal.calibrate_pivot(np.repeat(poses[:2], 10, axis=0))


def test_a_tool_that_is_hardly_turned_is_told(tmp_path, capsys):
    turns = Rotation.from_rotvec(0.002 * np.random.default_rng(1).normal(size=(POSES, 3)))
    result = jaxcal.calibrate_pivot(swung(turns, noise=0.05))
    worst = np.sqrt(np.linalg.eigvalsh(np.asarray(result.covariance)[:3, :3])[-1])
    assert worst > 1
    assert f"known to {worst:.1f} mm (SD)" in result.warnings[0]
    assert "turn the tool farther" in result.warnings[0]
    np.savetxt(tmp_path / "poses.txt", swung(turns, noise=0.05).reshape(POSES, 16))
    assert main(["pivot", str(tmp_path / "poses.txt"), "--json"]) == 5
    record = json.loads(capsys.readouterr().out)
    assert record["converged"]
    assert record["uncertain"]


def test_metres_are_refused():
    poses = swung(random_rotations(POSES))
    poses[:, :3, 3] /= 1000
    with pytest.raises(jaxcal.InputError, match="look like metres"):
        jaxcal.calibrate_pivot(poses)


@pytest.mark.slow
def test_batches_and_masks():
    poses = np.stack([swung(random_rotations(300, seed), 0.1, seed) for seed in range(3)])
    masks = np.ones((3, 300))
    masks[:, 290:] = 0
    together = jaxcal.calibrate_pivot(poses, masks)
    alone = jaxcal.calibrate_pivot(poses[1, :290])
    np.testing.assert_allclose(together.tip[1], alone.tip, atol=1e-9)
    plain = jax.jit(lambda *given: jaxcal.calibrate_pivot(*given, robust=False))
    alone = jaxcal.calibrate_pivot(poses[1, :290], robust=False)
    np.testing.assert_allclose(plain(poses[1], masks[1]).tip, alone.tip, atol=1e-9)


def test_a_batch_of_rows_without_the_last_one():
    poses = np.stack([swung(random_rotations(12, seed), 0.1, seed) for seed in range(2)])
    whole = jaxcal.calibrate_pivot(poses, robust=False)
    found = jaxcal.calibrate_pivot(poses[:, :, :3], robust=False)
    np.testing.assert_array_equal(found.tip, whole.tip)
    np.testing.assert_array_equal(found.status, ["converged", "converged"])
    with pytest.raises(jaxcal.InputError, match="a batch holds many"):
        _ = found.warnings
    with pytest.raises(jaxcal.InputError, match="a batch holds many"):
        _ = found.wrong_frames
    with pytest.raises(jaxcal.InputError, match="a batch holds many"):
        found.record()
    assert str(found).startswith("Pivot(")
    np.testing.assert_array_equal(found[1].tip, whole.tip[1])
    assert [each.status for each in found] == ["converged"] * len(found)
    with pytest.raises(jaxcal.InputError, match="not a batch"):
        found[0][0]


def test_a_mask_may_be_traced_where_the_poses_are_not():
    poses = swung(random_rotations(12), noise=0.1)
    with jax.enable_x64(True):
        solve = jax.jit(lambda mask: jaxcal.calibrate_pivot(poses, mask, robust=False).tip)
        found = solve(np.arange(12) < 9)
    known = jaxcal.calibrate_pivot(poses[:9], robust=False)
    np.testing.assert_allclose(found, known.tip, atol=1e-9)


def test_poses_left_out_are_not_read_in_a_batch_either():
    poses = np.stack([swung(random_rotations(12, seed), 0.1, seed) for seed in range(2)])
    used = np.arange(12) < 9
    whole = jaxcal.calibrate_pivot(poses, used, robust=False)
    poses[:, 9:] = np.nan
    found = jaxcal.calibrate_pivot(poses, used, robust=False)
    np.testing.assert_array_equal(found.tip, whole.tip)
    np.testing.assert_array_equal(found.covariance, whole.covariance)
    np.testing.assert_array_equal(found.status, ["converged", "converged"])


def test_a_batch_with_a_problem_of_too_few_poses_says_which():
    poses = np.stack([swung(random_rotations(12, seed), 0.1, seed) for seed in range(2)])
    found = jaxcal.calibrate_pivot(poses, np.arange(12) < [[12], [3]], robust=False)
    np.testing.assert_array_equal(found.status, ["converged", "failed"])
    np.testing.assert_array_equal(np.isnan(found.covariance).all(axis=(1, 2)), [False, True])
    assert np.isfinite(found.covariance[0]).all()
    for_all = jaxcal.calibrate_pivot(poses, np.arange(12) < 3, robust=False)
    np.testing.assert_array_equal(for_all.status, ["failed", "failed"])


def test_bad_input_is_named():
    with pytest.raises(jaxcal.InputError, match="3 used poses are too few"):
        jaxcal.calibrate_pivot(swung(random_rotations(3)))
    for none in (np.zeros((0, 4, 4)), np.zeros((2, 0, 4, 4))):
        with pytest.raises(jaxcal.InputError, match="0 poses are too few"):
            jaxcal.calibrate_pivot(none)
    poses = swung(random_rotations(8))
    poses[5, 0, 0] = np.nan
    with pytest.raises(jaxcal.InputError, match="5"):
        jaxcal.calibrate_pivot(poses)


def test_too_few_poses_are_told_with_their_file(tmp_path, capsys):
    (tmp_path / "poses.txt").write_text("1 2 3 0 0 0 1\n")
    assert main(["pivot", str(tmp_path / "poses.txt"), "--quaternion", "xyzw"]) == 2
    assert "poses.txt: 1 used pose is too few" in capsys.readouterr().err


def test_reading_poses(tmp_path):
    rotations = random_rotations(5)
    poses = swung(rotations)
    quaternions = np.hstack([poses[:, :3, 3], rotations.as_quat()])
    file = tmp_path / "poses.txt"
    for rows in (poses.reshape(5, 16), poses[:, :3].reshape(5, 12)):
        np.savetxt(file, rows)
        np.testing.assert_allclose(read_poses(file), poses, atol=1e-12)
    with pytest.raises(jaxcal.FormatError, match="its poses are matrices: leave --quaternion out"):
        read_poses(file, quaternion="xyzw")
    for stacked in (poses, poses[:, :3]):
        np.savetxt(file, stacked.reshape(-1, 4))
        np.testing.assert_allclose(read_poses(file), poses, atol=1e-12)
    np.savetxt(file, quaternions)
    np.testing.assert_allclose(read_poses(file, quaternion="xyzw"), poses, atol=1e-12)
    with pytest.raises(jaxcal.FormatError, match=r"poses.txt:1: 7 columns hold a quaternion: say"):
        read_poses(file)
    quaternions[3, 3:] *= 2
    np.savetxt(file, quaternions)
    with pytest.raises(jaxcal.FormatError, match=r"poses.txt: quaternion in line 4 has length 2"):
        read_poses(file, quaternion="xyzw")


def test_real_recording_with_outliers_reaches_the_clean_ones_precision(real_data, capsys):
    folder = real_data / "crosswire"
    clean = jaxcal.calibrate_pivot(
        read_poses(folder / "pivotCalibrationData.txt", quaternion="xyzw")
    )
    assert float(clean.rms) == pytest.approx(0.511, abs=0.001)
    assert not np.asarray(clean.outlier).any()
    disturbed = folder / "pivotCalibrationDataWithOutliers.txt"
    assert main(["pivot", str(disturbed), "--quaternion", "xyzw", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    # The last 144 of its 480 poses are wrong.
    assert record["outliers"] == list(range(336, 480))
    assert record["rms_mm"] == pytest.approx(float(clean.rms), rel=0.05)
    apart = np.array(record["tip_mm"]) - np.asarray(clean.tip)
    assert np.linalg.norm(apart) < 0.4
    both = np.array(record["covariance"])[:3, :3] + np.asarray(clean.covariance)[:3, :3]
    # A chi-square with 3 degrees of freedom is below 7.81 in 95 of 100.
    assert apart @ np.linalg.solve(both, apart) < 7.81
    plain = jaxcal.calibrate_pivot(read_poses(disturbed, quaternion="xyzw"), robust=False)
    assert float(plain.rms) == pytest.approx(33.6, abs=0.1)


def test_poses_of_a_tool_are_read_from_sequences_and_tables(tmp_path):
    poses = swung(random_rotations(5))
    seen = np.array([True, True, False, True, True])
    pair, other = ("Stylus", "Tracker"), ("Probe", "Tracker")
    file = tmp_path / "pivot.igs.mha"
    write_sequence(file, {other: poses[::-1], pair: poses}, np.arange(5.0), valid={pair: seen})
    read, notes = tool_poses(file, ImportOptions())
    np.testing.assert_allclose(read, poses[seen], atol=1e-9)
    assert notes[0].startswith("poses from Stylus to Tracker")
    assert notes[1] == "1 of 5 frames left out: their tracking was not OK"
    probe, _ = tool_poses(file, ImportOptions(source="Probe"))
    np.testing.assert_allclose(probe, poses[::-1], atol=1e-9)
    write_sequence(tmp_path / "probe.igs.mha", {other: poses}, np.arange(5.0))
    _, notes = tool_poses(tmp_path / "probe.igs.mha", ImportOptions())
    assert "no Stylus was tracked, so another tool was taken" in notes[-1]

    scalar_first = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    rows = np.concatenate([poses[:, :3, 3] / 1000, scalar_first], axis=1)
    lines = [",".join(map(repr, row.tolist())) for row in rows]
    table = tmp_path / "pivot.csv"
    table.write_text("\n".join(["x [m],y [m],z [m],qw,qx,qy,qz", *lines[:3], ",,,,,,", lines[4]]))
    read, notes = tool_poses(table, ImportOptions(skip_invalid=True))
    np.testing.assert_allclose(read, poses[[0, 1, 2, 4]], atol=1e-9)
    assert notes == [f"{table}: 1 invalid row left out (3, counted from 0)"]
    table.write_text("\n".join(lines))
    read, _ = tool_poses(table, ImportOptions(quaternion="wxyz", pose_units="m"))
    np.testing.assert_allclose(read, poses, atol=1e-9)
    for each in (file, table):
        asked = ImportOptions(quaternion=None if each == file else "wxyz", pose_units="mm")
        (plain, _), (back, _) = (
            tool_poses(each, replace(asked, invert_poses=turned)) for turned in (False, True)
        )
        np.testing.assert_allclose(back @ plain, np.tile(np.eye(4), (len(plain), 1, 1)), atol=1e-9)
    with pytest.raises(InputError, match="--from is for sequences"):
        tool_poses(table, ImportOptions(source="Stylus"))
    # The inverse of a transposed matrix passed for a pose with a tip at the origin.
    table.write_text("\n".join(" ".join(map(repr, pose.T.ravel().tolist())) for pose in poses))
    with pytest.raises(FormatError, match=r"in line 1 is not a rigid transform.*transposed"):
        tool_poses(table, ImportOptions(invert_poses=True))
