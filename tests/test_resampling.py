from __future__ import annotations

import numpy as np
import pytest

import jaxcal
from jaxcal.resampling import bootstrap, cross_validate, field_points, influence


@pytest.fixture(scope="module")
def recording():
    return jaxcal.simulate_recording(
        jaxcal.Protocol(images=30, elevation_mm=1.0, noise_mm=0.5), seed=5
    )


@pytest.fixture(scope="module")
def problem(recording):
    return jaxcal.Problem.from_recording(recording)


def test_leave_one_out_is_what_calibrating_without_the_image_says(problem):
    import dataclasses

    found = cross_validate(problem, method="conventional")
    assert np.all(np.asarray(found.converged))
    left_out = 7
    kept = dataclasses.replace(problem, mask=problem.mask.at[left_out].set(0.0))
    alone = jaxcal.calibrate(kept, method="conventional")
    to_image = np.linalg.inv(np.asarray(problem.poses[left_out] @ alone.image_to_probe))
    q = to_image[:3, :3] @ np.asarray(alone.point) + to_image[:3, 3]
    lateral, distance = np.asarray(problem.measurements[left_out])
    wanted = [q[0] - lateral, np.hypot(q[1], q[2]) - distance, q[1]]
    np.testing.assert_allclose(found.residual[left_out], wanted, atol=1e-9)


def test_folds_share_the_used_images_and_the_others_are_not_judged(problem):
    import dataclasses

    fewer = dataclasses.replace(problem, mask=problem.mask.at[3].set(0.0))
    found = cross_validate(fewer, folds=5, method="conventional")
    counts = np.bincount(np.asarray(found.fold)[np.asarray(found.fold) >= 0], minlength=5)
    assert counts.sum() == 29
    assert counts.max() - counts.min() <= 1
    assert found.fold[3] == -1
    assert np.isnan(found.residual[3]).all()
    assert np.isfinite(np.delete(np.asarray(found.residual), 3, axis=0)).all()
    whole = jaxcal.calibrate(fewer, method="conventional")
    # Images that were not seen are fitted worse than those that were, but not by much.
    assert float(np.sqrt((np.asarray(found.rms) ** 2).sum())) > float(whole.rms)
    assert float(found.precision) < 2 * float(whole.rms)


def test_an_image_that_is_off_has_the_largest_influence(problem):
    import dataclasses

    moved = problem.measurements.at[11, 0].add(8.0)
    found = influence(dataclasses.replace(problem, measurements=moved), method="conventional")
    assert int(np.nanargmax(found.displacement)) == 11
    assert int(np.nanargmax(found.distance)) == 11
    others = np.delete(np.asarray(found.displacement), 11)
    assert found.displacement[11] > 2 * others.max()


@pytest.mark.slow
def test_the_bootstraps_sd_is_near_the_covariances(recording, problem):
    found = bootstrap(problem, 60, seed=1, prior="gaussian")
    assert np.mean(np.asarray(found.converged)) > 0.97
    whole = jaxcal.calibrate(problem, prior="gaussian")
    ratio = np.asarray(found.sd) / np.sqrt(np.diag(np.asarray(whole.covariance)))
    # Two estimates of an SD, from 30 images and from 60 resamples.
    assert np.all((ratio > 0.5) & (ratio < 2.0)), ratio
    corners = np.asarray(field_points(whole, problem))
    assert corners.shape == (5, 2)
    points = np.asarray(recording.calibration.measurements)
    np.testing.assert_allclose(corners[[0, 3]], [points.min(axis=0), points.max(axis=0)])
    assert np.all(np.asarray(found.reproducibility) > 0)


def test_a_resample_does_not_depend_on_how_many_there_are(problem):
    some = bootstrap(problem, 30, seed=1, method="conventional")
    fewer = bootstrap(problem, 5, seed=1, method="conventional")
    np.testing.assert_allclose(fewer.image_to_probe, some.image_to_probe[:5], atol=1e-7)


def test_what_cannot_be_resampled_is_refused(problem):
    with pytest.raises(jaxcal.InputError, match="between 2 and the 30"):
        cross_validate(problem, folds=31)
    with pytest.raises(jaxcal.InputError, match="at least 2"):
        bootstrap(problem, 1)
    with pytest.raises(jaxcal.InputError, match="one problem at a time"):
        influence(jaxcal.stack([problem, problem]))
    few = jaxcal.simulate_recording(jaxcal.Protocol(images=5), seed=1)
    with pytest.raises(jaxcal.InputError, match="leave fewer than 4"):
        cross_validate(few, folds=2)


def test_the_command_line_tells_what_other_images_say(recording, tmp_path, capsys, monkeypatch):
    import json

    from jaxcal.cli.main import main

    monkeypatch.setenv("JAXCAL_NO_CACHE", "1")
    path = tmp_path / "rec.h5"
    jaxcal.save(recording, path)
    arguments = ["calibrate", str(path), "--method", "conventional", "--json"]
    assert main([*arguments, "--cross-validate", "--bootstrap", "30"]) == 0
    record = json.loads(capsys.readouterr().out)
    left_out, resampled = record["cross_validation"], record["bootstrap"]
    assert left_out["folds"] == 30
    assert len(left_out["held_out_residual_mm"]) == 30
    assert left_out["most_influential_image"] == np.argmax(left_out["displacement_mm"])
    assert resampled["resamples"] == 30
    assert min(resampled["reproducibility_mm"]) > 0
    assert main([*arguments, "--bootstrap", "1"]) == 2
