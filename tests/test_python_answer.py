"""The answer in Python: printed, saved, applied, drawn; what is no problem is refused in a line."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import experiment

import jaxcal
from jaxcal.data.problem import as_problem
from jaxcal.design import candidates_around, next_poses
from jaxcal.report import plots
from jaxcal.report.record import calibration_record
from jaxcal.result.saved import load_calibration
from jaxcal.runtime.jax_modes import inside_transformation


@pytest.fixture(scope="module")
def recording():
    named = ("US_Probe", "Reference")
    return replace(experiment(3, images=24, elevation_mm=1.0), pose_frames=named)


@pytest.fixture(scope="module")
def result(recording):
    return jaxcal.calibrate(recording, "conventional")


def test_print_shows_numbers_and_verdict(result):
    text = str(result)
    for value in np.asarray(result.image_to_probe)[:3].ravel():
        assert f"{value:.6f}" in text
    assert f"{result.record()['tre']['rms_mm']:.2f} mm off" in text
    assert max(map(len, text.splitlines())) <= 100
    assert result.verdict()[0].split(":")[0].lower() == result.record()["verdict"]


def test_record_in_memory_is_the_command_lines(result, recording):
    mine = result.record()
    theirs = calibration_record(result, replace(recording, test=None, truth=None))
    for name in set(theirs) - {"source"}:
        assert mine[name] == theirs[name], name


def test_what_is_read_again_is_not_computed_again(result, recording):
    answer = result.numpy()
    assert answer is not result  # JAX is imported here, and result holds its arrays
    assert answer.numpy() is answer is result.numpy()
    assert answer.inspection is result.inspection
    images = recording.calibration
    inverted = replace(images, poses=np.linalg.inv(images.poses))
    wrong = jaxcal.calibrate(inverted, "conventional")
    assert "invert them" in wrong.wrong_frames
    # Equal texts that were put together twice would be two objects.
    assert wrong.wrong_frames is wrong.numpy().wrong_frames


def test_saved_by_the_name_of_the_recordings_frame(result, tmp_path):
    assert result.record()["pose_frames"] == {"from": "US_Probe", "to": "Reference"}
    for extension in ("json", "npz"):
        result.save(tmp_path / f"cal.{extension}")
        assert load_calibration(tmp_path / f"cal.{extension}").probe_frame == "US_Probe"


def test_notebooks_get_a_drawing_and_no_script(result):
    html = result._repr_html_()
    assert "<p>- " not in html
    assert "<svg" in html
    assert f"{np.asarray(result.image_to_probe)[0, 3]:.6f}" in html
    assert "<script" not in html


def test_batches_and_traces_print_without_a_verdict(recording):
    problem = jaxcal.Problem.from_recording(recording)
    batch = jaxcal.calibrate_batch([problem, recording], "conventional")
    assert str(batch) == (
        "Calibration of a batch of 2: 2 converged. Frames and units are not checked here, but in "
        "each calibration: batch[0] is the first"
    )
    assert batch._repr_html_() is None
    one = jaxcal.calibrate(problem, "conventional")
    np.testing.assert_allclose(batch.image_to_probe[1], one.image_to_probe, atol=1e-9)
    assert [each.status for each in batch] == ["converged"] * 2
    assert len(batch) == len(list(batch)) == 2
    grid = jax.tree.map(lambda leaf: leaf[None], batch)
    for part in (batch[..., 1], batch[[0, 1]][-1], grid[0, 1], grid[..., 1][0], grid[:, 1][0]):
        np.testing.assert_array_equal(part.image_to_probe, batch.image_to_probe[1])
        assert part.mask.shape == one.mask.shape
    with pytest.raises(jaxcal.InputError, match="traced"):
        jax.jit(lambda index: batch[index].rms)(1)
    with pytest.raises(IndexError):
        _ = batch[2]
    none = batch[:0]
    assert all([one, batch, none])
    assert none.residual.shape == (0, one.images_used, 3)
    assert none.outlier.shape == none.elevation_sd.shape == (0, one.images_used)
    with pytest.raises(jaxcal.InputError, match="one calibration, not a batch"):
        list(one)
    with pytest.raises(jaxcal.InputError, match="one calibration, not a batch"):
        len(one)
    with pytest.raises(jaxcal.InputError, match="take one of them"):
        batch.verdict()
    seen = []
    jax.jit(lambda p: seen.append(str(jaxcal.calibrate(p, "conventional"))))(problem)
    shapes = jax.eval_shape(lambda each: each, batch[0])
    for other in (seen[0], str(shapes), str(jax.tree.map(np.shape, batch[0]))):
        assert other.startswith("Calibration(")
    assert shapes._repr_html_() is None


def test_values_are_values_inside_a_jit_too(recording, result):
    """A jit traces the operators of JAX arrays that have values, and each of these calls ended in
    JAX's traceback where the problem or the answer was no argument of the jit."""
    problem = jaxcal.Problem.from_recording(recording)
    assert isinstance(problem.sound_speed, jax.Array)
    assert isinstance(result.status_code, jax.Array)
    told, seen = str(result), []

    def inside(x):
        seen.append((bool(result.converged), int(result.images_used), result.warnings, str(result)))
        seen.append(jaxcal.simulate_recording(jaxcal.Protocol(images=24, elevation_mm=1.0), 3))
        return x * jaxcal.calibrate(problem, "conventional").rms

    assert jax.eval_shape(inside, 2.0).shape == ()
    assert seen[0] == (True, 24, result.warnings, told)
    np.testing.assert_array_equal(seen[1].calibration.poses, recording.calibration.poses)


def test_debuggers_and_lists_of_a_notebook_show_no_arrays(recording):
    """``repr`` says what a problem or a calibration is; its fields where it has no values."""
    pixels = jaxcal.make_images(
        np.tile(np.eye(4), (5, 1, 1)), np.ones((5, 2)), "pixel", spacing_mm=(0.1, 0.2)
    )
    problem = jaxcal.Problem.from_recording(recording)
    result = jaxcal.calibrate(problem, "conventional")
    batch = jaxcal.calibrate_batch([problem, problem], "conventional")
    assert repr(jaxcal.Problem.from_recording(pixels)) == (
        "Problem(5 used of 5 images, pixels of 0.1 x 0.2 mm)"
    )
    n = problem.images
    known = "points in mm, with sound_speed, delay"
    assert repr(problem) == f"Problem({n} used of {n} images, {known})"
    assert repr(batch.problem).startswith(f"Problem(batch of 2, {n} images each, points in mm")
    assert repr(result) == (
        f"Calibration(conventional, converged, {n} used of {n} images, "
        f"RMS {float(result.rms):.3g} mm)"
    )
    assert repr(batch) == "Calibration(conventional, batch of 2: 2 converged)"
    assert str(replace(result, problem=None)) == repr(result)
    assert "information=float64[9,9], design=float64[9,9]" in repr(result.linearisation)
    assert f"Diagnostics(elevation_sd=float64[{n}]" in repr(result._diagnostics)
    assert f"Inspection(outlier=float64[{n}]" in repr(result.inspection)
    points = np.ones((20, 2))
    assert repr(result.apply(points)) == (
        "AppliedPoints(points=float64[20,3], covariance=float64[20,3,3])"
    )
    assert "points=float64[20,2]" in repr(jaxcal.compare_calibrations(result, result, points))
    around = candidates_around(recording, result, count=30)
    assert "Candidates(poses=float64[30,4,4]" in repr(around)
    assert len(repr(next_poses(result, around, k=5))) < 2000
    shapes = jax.eval_shape(lambda each: each, (problem, result))
    traced = []
    jax.jit(lambda each: traced.append(repr(each)))(problem)
    for said in (*map(repr, shapes), *traced):
        assert f"mask=float64[{n}]" in said
        assert len(said) < 2500


def test_intervals_are_refused_in_words_where_they_are_traced(result):
    with pytest.raises(jaxcal.CalibrationError, match="not available under jit"):
        jax.jit(jaxcal.transform_intervals)(result)


def test_saved_and_loaded(result, tmp_path):
    result.save(tmp_path / "cal.json")
    loaded = load_calibration(tmp_path / "cal.json")
    np.testing.assert_array_equal(loaded.image_plane_to_probe, result.image_to_probe)
    assert loaded.converged is True
    pose = np.eye(4)
    pose[:3, 3] = 10, 20, 30
    points = np.array([[1.0, 40.0], [-8.0, 70.0]])
    mine, theirs = result.apply(points, pose), loaded.apply(points, pose)
    np.testing.assert_array_equal(mine.points, theirs.points)
    np.testing.assert_array_equal(mine.covariance, theirs.covariance)
    x = np.asarray(result.image_to_probe)
    plane = np.insert(points, 1, 0.0, axis=1)
    np.testing.assert_allclose(mine.points, plane @ x[:3, :3].T + x[:3, 3] + pose[:3, 3])
    trace = np.trace(mine.covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(np.sqrt(trace), jaxcal.predicted_tre(result, points), rtol=1e-9)
    with pytest.raises(jaxcal.InputError, match="no pixel size is known"):
        result.plus_matrix()
    with pytest.raises(jaxcal.InputError, match="no format"):
        result.save(tmp_path / "cal.nonsense")
    transform = result.image_transform()
    assert (transform.unknowns, transform.range_factor) == (("translation", "rotation"), 1.0)
    np.testing.assert_array_equal(transform.covariance, transform.image_covariance)


def test_figures_have_units_and_the_datas_numbers(result):
    tre = result.plot_tre()
    assert tre.axes[0].get_xlabel() == "lateral (mm)"
    assert tre.axes[0].get_ylabel() == "depth (mm)"
    assert "(mm)" in tre.axes[1].get_ylabel()
    assert any(text.get_text() == "10 mm" for text in tre.axes[0].texts)
    tre.canvas.draw()
    assert tre.axes[0].yaxis.label.get_window_extent().x0 >= 0
    moved = result.plot_influence().axes[0].lines[0].get_ydata()
    np.testing.assert_allclose(moved, result.record()["influence"]["moved_mm"], rtol=1e-9)
    panel = result.plot_limits().axes[0]
    widths = [bar.get_width() for bar in panel.patches]
    limits = result.record()["limits"]
    shares = [*limits["scatter_share"].values(), *limits["error_share"].values()]
    np.testing.assert_allclose(widths, shares, rtol=1e-9)
    # Both figures split the same residuals, and call the directions the same.
    directions = panel.get_legend_handles_labels()[1]
    residuals = result.plot_residuals().axes
    assert [each.get_ylabel() for each in residuals] == [f"{name} (mm)" for name in directions]
    offsets = result.plot_offsets(np.zeros(24)).axes[0]
    assert "true" in offsets.get_legend_handles_labels()[1]
    lost = replace(result, unknowns_covariance=jnp.full((9, 9), jnp.nan))
    for plot in (plots.plot_tre, plots.plot_influence, plots.plot_limits):
        with pytest.raises(jaxcal.InputError, match="do not determine"):
            plot(lost)


def test_the_scale_bar_is_below_the_numbers_of_a_shallow_image():
    images = experiment(3, images=100).calibration
    depth = images.measurements[:, 1]
    strip = np.abs(depth - np.median(depth)) < 8
    data = jaxcal.Problem.from_arrays(images.poses, images.measurements, mask=strip)
    tre = jaxcal.calibrate(data, "conventional").plot_tre()
    tre.canvas.draw()
    axes = tre.axes[0]
    numbers = min(label.get_window_extent().y0 for label in axes.get_xticklabels())
    assert axes.lines[-1].get_window_extent().y1 < numbers


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("rec.h5", r"not a path: jaxcal\.calibrate\(jaxcal\.load\('rec\.h5'\)\)"),
        ({"poses": 1}, "not a dictionary: jaxcal.Problem.from_arrays"),
        ([1, 2], "not list"),
        (np.eye(4), "not ndarray"),
        (None, "not NoneType"),
    ],
)
def test_what_is_no_problem_is_refused_in_a_line(given, message):
    with pytest.raises(jaxcal.InputError, match=message) as caught:
        as_problem(given, "jaxcal.calibrate")
    assert "\n" not in str(caught.value)


def test_lists_and_single_names(recording):
    problem = jaxcal.Problem.from_recording(recording)
    with pytest.raises(jaxcal.InputError, match=r"not 2: jaxcal\.calibrate_batch takes a list"):
        as_problem([problem, problem], "jaxcal.calibrate")
    assert not inside_transformation(each for each in [problem])  # without a warning of JAX
    with pytest.raises(jaxcal.InputError, match="the list is empty"):
        jaxcal.calibrate_batch([])
    # A single name is one name, and not its letters.
    with pytest.raises(jaxcal.InputError, match="in mm already"):
        jaxcal.calibrate(problem, estimate="scale")
    with pytest.raises(jaxcal.InputError, match="cannot estimate 'sped'"):
        jaxcal.calibrate(problem, estimate="delay, sped")


def test_calls_as_users_make_them():
    """Without the type checks of these tests: an InputError, in a line, for whatever is given."""
    code = r"""
import dataclasses
import warnings
import jax
import numpy as np
import jaxcal
from jaxcal.data.problem import Channels
from hw.acquisition.live_calibration import LiveCalibration
from jaxcal import backend
from jaxcal.study import run_study
from jaxcal.study.spec import parse_spec
class Unknown:  # as pandas' NA
    def __eq__(self, other):
        return self
    def __bool__(self):
        raise TypeError
START = 'name = "a"\nseed = 1\ntrials = 1\n[[methods]]\nname = "a"\nmethod = "alternating"\n'
warnings.simplefilter("error")
draws = np.random.default_rng(0)
poses = np.tile(np.eye(4), (9, 1, 1))
poses[:, :3, 3] = draws.uniform(-50, 50, (9, 3))
points = draws.uniform(10, 50, (9, 2))
images = jaxcal.make_images(poses, points)
problem = jaxcal.Problem.from_arrays(poses, points, dtype=">f8")
result = jaxcal.calibrate(problem, "conventional")
probe = jaxcal.LinearProbe(elements=16)
raw = jaxcal.make_images(poses, np.full((9, 16), 2e-5), "time_of_flight")
mapping = jaxcal.ImageTransform(np.eye(4))
found = jaxcal.calibrate(jaxcal.simulate_recording(jaxcal.Protocol(images=12), 1), "conventional")
of_one = backend.Parameters.of(jax.numpy.eye(3), jax.numpy.zeros(3), jax.numpy.zeros(3))
skewed = np.eye(6) + np.eye(6, k=1)
assert jaxcal.predicted_tre(result, [0.0, 50.0]).shape == ()
keep = np.ma.array(np.ones(9, bool), mask=np.arange(9) == 2)
fewer = jaxcal.Problem.from_arrays(poses, points, mask=keep)
np.testing.assert_array_equal(fewer.mask, keep.filled(False))
for mask in (keep.filled(False), keep.filled(False).astype(int)):
    same = dataclasses.replace(problem, mask=mask)
    assert same.mask.dtype == float
    np.testing.assert_array_equal(same.mask, fewer.mask)
for call, *given in (
    (jaxcal.calibrate, "rec.h5"), (jaxcal.calibrate, {}),
    (jaxcal.calibrate_batch, "rec.h5"), (jaxcal.calibrate_batch, [1]),
    (jaxcal.predicted_tre, result, [[0.0, 50.0, 1.0]]), (jaxcal.predicted_tre, result, 1.0),
    (jaxcal.predicted_tre, result, [np.nan, 1.0]), (jaxcal.predicted_tre, result, ["a", "b"]),
    (jaxcal.predicted_tre, result, [1j, 1.0]),
    (jaxcal.stack, []), (jaxcal.stack, [1]), (jaxcal.stack, problem),
    (jaxcal.calibrate_pivot, np.eye(4)), (jaxcal.calibrate_pivot, 3), (jaxcal.calibrate_pivot, []),
    (jaxcal.calibrate_pivot, poses, np.ones(4)),
    (lambda folds: jaxcal.cross_validate(problem, folds=folds), "4"),
    (lambda folds: jaxcal.cross_validate(problem, folds=folds), 1),
    (jaxcal.bootstrap, problem, 2.5), (jaxcal.bootstrap, problem, 4, "a"),
    (jaxcal.simulate_recording, jaxcal.Protocol(), "a"),
    (jaxcal.simulate_recording, jaxcal.Protocol(), -1),
    (lambda depth: jaxcal.Protocol(depth_mm=depth), (90, 10)),
    (lambda depth: jaxcal.Protocol(depth_mm=depth), 10),
    (lambda depth: jaxcal.Protocol(depth_mm=depth), (-1, 10)),
    (lambda noise: jaxcal.Protocol(noise_mm=noise), "a"),
    (lambda images: jaxcal.Protocol(images=images), 8.5),
    (jaxcal.Problem.from_arrays, poses + 0j, points),
    (jaxcal.Problem.from_arrays, poses, points.tolist()[:-1] + [[1.0]]),
    (lambda kind: jaxcal.Problem.from_arrays(poses, points, kind=kind), "pixels"),
    (jaxcal.Problem.from_arrays, poses, np.ma.array(points, mask=points > 40)),
    (jaxcal.make_images, np.ma.array(poses, mask=poses > 40), points),
    (jaxcal.make_images, poses, points + 0j), (jaxcal.make_images, poses, points.astype(str)),
    (lambda value: jaxcal.make_images(poses, points, max_elevation=value), np.ones(5)),
    (lambda value: jaxcal.make_images(poses, points, face_offset_mm=value), "a"),
    (jaxcal.Recording, poses), (jaxcal.save, None, "x.h5"), (jaxcal.simulate_recording, 3),
    (jaxcal.calibrate_pivot, np.ma.array(poses, mask=poses > 40)),
    (jaxcal.reconstruction_precision, np.eye(4), poses, points[:3]),
    (jaxcal.reconstruction_precision, np.eye(4), poses[:1], points),
    (jaxcal.calibration_reproducibility, np.eye(4), [[0.0, 20.0]]),
    (jaxcal.calibration_reproducibility, [np.eye(4)], [[0.0, 20.0]]),
    (jaxcal.certify, problem, result.image_to_probe, [1.0]), (jaxcal.calibrate_closed_form, 3),
    (jaxcal.LinearProbe, 2.5), (jaxcal.LinearProbe, "64"),
    (jaxcal.CurvilinearProbe, 64, [1.0, 2.0]),
    (lambda chunk: jaxcal.calibrate_batch([problem], chunk=chunk), 1.5),
    *((lambda value, name=name: jaxcal.Options(**{name: value}), value) for name, value in (
        ("tolerance_mm", "0.1"), ("tolerance_rad", None), ("gradient_tolerance", [1.0, 2.0]),
        ("max_rounds", 2.5), ("max_rounds", 10**20), ("trace", True), ("inner_steps", 0),
        ("solver", np.array(["lm", "gradient"])), ("differentiate", "no"),
    )),
    *((lambda value, name=name: jaxcal.calibrate(problem, "joint", **{name: value}), value)
      for name, value in (
        ("options", {"max_rounds": 3}), ("sigma", "abc"), ("sigma", ["1", "1", "1"]),
        ("sigma", [1.0, np.nan, 1.0]), ("max_elevation", "1 mm"), ("max_elevation", np.ones(5)),
        ("max_elevation", np.ones((9, 1, 1))), ("sound_speed_sd", [1.0, 2.0]), ("estimate", 5),
        ("prior", np.array(["auto", "uniform"])), ("robust", "no"), ("data", None),
    )),
    *((lambda text: parse_spec(START + text), text) for text in (
        "max_iterations = 1.5", 'max_elevation_mm = "1 mm"', "tolerance_mm = true",
        "tolerance_rad = [1]", "prior = 3", "max_elevation_mm = [1]",
    )),
    (lambda level: jaxcal.transform_intervals(result, level), "0.95"),
    (lambda level: jaxcal.transform_intervals(result, level), None),
    (lambda probe: jaxcal.Protocol(probe=probe), "linear"),
    (lambda raw: jaxcal.Protocol(raw=raw), "no"),
    (lambda radius: jaxcal.CurvilinearProbe(radius_mm=radius), None),
    (jaxcal.Problem.from_recording, "rec.h5"), (jaxcal.segment, "rec.h5"),
    (jaxcal.segment_recording, "rec.h5"), (jaxcal.simulate, 3, jaxcal.Protocol()),
    (jaxcal.ImageTransform(np.eye(4)).apply, [[0.0, 50.0]], "pose"),
    (run_study, "no-such-study.toml", "no-such-folder"),
    (lambda local: backend.arrow_least_squares(lambda s, y, d: d, np.zeros(2), local), points),
    (lambda n: run_study(parse_spec(START), "no-such-folder", workers=n), "2"),
    *((call, path) for call in (jaxcal.load, jaxcal.load_calibration, result.save)
      for path in (None, 3, b"rec.h5")),
    (jaxcal.save, jaxcal.Recording(jaxcal.make_images(poses, points)), None),
    (backend.LevenbergMarquardt, "fast"),
    *((lambda value, name=name: jaxcal.segment(raw, probe, **{name: value}), value)
      for name, value in (
        ("minimum_lines", "8"), ("minimum_lines", 8.5), ("minimum_lines", -3), ("robust", "no"),
        ("interpolate", None), ("scale", np.array(["frame", "pooled"])), ("method", np.ones(2)),
        ("minimum_amplitude", [1.0, 2.0]),
    )),
    (jaxcal.sound_speed_in_water, "20"), (jaxcal.sound_speed_in_water, [[1.0], [1.0, 2.0]]),
    *((lambda value, name=name: jaxcal.LinearProbe(**{name: value}), None)
      for name in ("elements", "pitch_mm", "sound_speed_m_s", "delay_s")),
    (probe.contains, "abc", 30.0), (probe.image_to_cartesian, "a", 3.0),
    (probe.one_way_range_mm, "a"),
    (jaxcal.reconstruction_precision, np.eye(4), poses, points, ["a"] * 9),
    (jaxcal.reconstruction_precision, np.eye(4), poses, points.astype(str)),
    (jaxcal.calibration_reproducibility, [np.eye(4), np.eye(3)], [[0.0, 20.0]]),
    (jaxcal.calibration_reproducibility, np.full((2, 4, 4), "a"), [[0.0, 20.0]]),
    (jaxcal.cross_validate, None), (jaxcal.cross_validate, "rec.h5"), (jaxcal.bootstrap, None),
    *((lambda given: jaxcal.cross_validate(problem, result=given), given)
      for given in (3, jaxcal.calibrate_batch([problem, problem], "conventional"))),
    (lambda given: jaxcal.bootstrap(problem, 4, result=given), 3),
    *((jaxcal.bootstrap, problem, 4, key)
      for key in (jax.numpy.array(1), jax.random.split(jax.random.key(1)))),
    (jaxcal.calibrate_pivot, poses, ["a"] * 9),
    (lambda robust: jaxcal.calibrate_pivot(poses, robust=robust), "no"),
    (jaxcal.calibrate_pivot, [np.eye(4), np.eye(3)]),
    (lambda mask: jaxcal.make_images(poses, points, mask=mask), [[1, 0], [1]]),
    (lambda least: jaxcal.make_images(poses, points, minimum=least), "a"),
    (lambda truth: jaxcal.Recording(jaxcal.make_images(poses, points), truth=truth), 3),
    (lambda probe: jaxcal.Recording(jaxcal.make_images(poses, points), probe=probe), "linear"),
    (jaxcal.ImageTransform, None),
    *((lambda value, name=name: jaxcal.ImageTransform(np.eye(4), **{name: value}), value)
      for name, value in (("converged", "no"), ("unknowns", 3), ("covariance", skewed))),
    *((jaxcal.ImageTransform(np.eye(4)).with_pixels, *given) for given in (
        ("a",), (0.1,), ((0.1,),), ((0.1, 0.1), "a"), ((0.1, 0.1), 3), ((0.1, 0.1), None),
    )),
    (result.save, "x.json", ["json"]), (found.record, 3), (found.record, ["abc"]),
    (found.record, [[1.0, 2.0, 3.0]]), (result.plot_offsets, [1.0, 2.0]),
    (lambda batch: batch.warnings, jaxcal.calibrate_batch([problem], "conventional")),
    (lambda batch: batch.wrong_frames, jaxcal.calibrate_batch([problem], "conventional")),
    (lambda batch: batch.observability, jaxcal.calibrate_batch([problem], "conventional")),
    (jaxcal.simulate, jax.random.key(1), None),
    (jaxcal.simulate, jax.random.split(jax.random.key(1)), jaxcal.Protocol()),
    (lambda clock: jaxcal.simulate_recording(jaxcal.Protocol(raw=True), clock_hz=clock), "fast"),
    (lambda watcher: run_study(parse_spec(START), "no-such-folder", watcher=watcher), 3),
    (lambda resume: run_study(parse_spec(START), "no-such-folder", resume=resume), "yes"),
    *((lambda value, name=name: backend.arrow_least_squares(
        lambda s, y, d: d, np.zeros(2), np.zeros(9), points, **{name: value}), value)
      for name, value in (
        ("limit", -1.0), ("limit", np.nan), ("limit", np.ones(3)), ("limit", "a"),
        ("max_steps", 0), ("max_steps", 2.5),
    )),
    *((lambda value, name=name: jaxcal.calibrate(
        dataclasses.replace(problem, **{name: value}), "conventional"), value)
      for name, value in (
        ("spacing", np.array([np.nan, 1.0])), ("spacing", np.ones(3)), ("face_offset", 0.0),
        ("mask", np.ones(5)), ("poses", poses[:, :3]), ("measurements", points.astype(str)),
        ("measurements", points.tolist()), ("measurements", None), ("max_elevation", np.ones(3)),
        ("mask", np.full(9, 0.5)), ("mask", np.full(9, np.nan)), ("max_elevation", -np.ones(9)),
        ("covariance", np.tile(-np.eye(2), (9, 1, 1))), ("covariance", np.zeros((9, 2, 2))),
        ("covariance", np.full((9, 2, 2), np.nan)), ("sound_speed", 1490.0),
        ("sound_speed", np.array(1.49)), ("sound_speed", np.full(9, 1490.0)),
        ("delay", np.array(np.nan)), ("channels", np.ones((9, 4))),
        ("channels", Channels(np.ones((9, 4)), np.ones((9, 4)), np.ones((3, 3)))),
        ("channels", Channels(np.full((9, 4), np.nan), np.ones((9, 4), bool), np.ones((4, 3)))),
    )),
    *((lambda dtype: jaxcal.Problem.from_arrays(poses, points, dtype=dtype), dtype)
      for dtype in (int, "points", np.longdouble)),
    (lambda mask: jaxcal.calibrate_batch(
        dataclasses.replace(jaxcal.stack([problem]), mask=mask), "conventional"), np.ones((2, 9))),
    (backend.Iterate.of, of_one, backend.RIGID),
    (backend.circle_residual, of_one, np.zeros(3), problem),
    (lambda kind: LiveCalibration(kind=kind), "px"),
    (lambda mask: jaxcal.reconstruction_precision(np.eye(4), poses, points, mask), np.full(9, 0.5)),
    (LiveCalibration, 8.5), (LiveCalibration, "many"),
    (lambda probe: LiveCalibration(probe=probe), "linear"),
    (LiveCalibration().add, np.eye(4), "0 50"), (LiveCalibration().leave_out, "a"),
    (lambda bound: LiveCalibration().put(np.eye(4), points[0], bound), "one"),
    (jaxcal.compare_calibrations, "first.json", "second.json", points),
    (jaxcal.compare_calibrations, mapping, mapping, [[0.0, 20.0, 1.0]]),
    (lambda names: jaxcal.calibrate_closed_form(problem, estimate=names), 3),
    *((lambda mask, data=data: jaxcal.calibrate_closed_form(
        dataclasses.replace(data, mask=mask)), mask)
      for data, mask in ((problem, np.ones(5)), (jaxcal.stack([problem]), np.ones((1, 5))))),
    (lambda mask: jaxcal.Problem.from_arrays(poses, points, mask=mask), [True] * 8 + [Unknown()]),
    *((lambda value, name=name: dataclasses.replace(problem, **{name: value}), value)
      for name, value in (("mask", keep), ("measurements", np.ma.array(points, mask=points > 40)))),
    (jaxcal.calibrate_pivot, poses, np.full(9, 0.5)), (jaxcal.calibrate_pivot, poses, -np.ones(9)),
    (jaxcal.make_images, poses, [np.ma.array(row, mask=row > 40) for row in points]),
    (jaxcal.make_images, poses, [*points[:8].tolist(), [1.0, np.ma.masked]]),
    *((lambda value, name=name: dataclasses.replace(images, **{name: value}), value)
      for name, value in (("mask", keep), ("mask", [True] * 9), ("kind", "points"))),
    *((lambda values: jaxcal.calibrate(dataclasses.replace(problem, poses=values), "conventional"),
       values) for values in (poses.swapaxes(1, 2), -poses, poses * np.array([-1.0, 1, 1, 1]))),
    (mapping.image_points, [[0.0, 20.0, 1.0]]), (mapping.image_points, "a"),
    (lambda names: jaxcal.ImageTransform(np.eye(4), unknowns=names),
     ("translation", "rotation", "delay", "scale")),
    (found.with_problem, images), (found.with_problem, problem),
    (jax.jit(lambda value: jaxcal.Options(tolerance_mm=value) and value), 0.1),
    *((lambda names, call=call: call(problem, estimate=names), [["scale"]])
      for call in (jaxcal.calibrate, jaxcal.calibrate_closed_form)),
    (lambda noise: jaxcal.Protocol(noise_mm=noise), "0.5"),
):
    try:
        call(*given)
    except jaxcal.InputError as error:
        print(error)
    else:
        raise AssertionError(given)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert len(lines) == 229
    assert lines[0].startswith("jaxcal.calibrate takes a problem, not a path: ")
    assert lines[3].startswith("jaxcal.calibrate_batch takes a problem or a recording, not int: ")
    assert lines[4] == "points must have shape (..., 2), not (1, 3)"
    assert lines[16] == "folds must be a whole number, not '4'"
    assert lines[22] == "depth_mm must be nearest, then farthest, not (90, 10)"
    assert lines[27] == "poses must be an array of real numbers"
    assert (
        lines[29] == "kind must be one of point (mm), pixel (px), time_of_flight (s), not 'pixels'"
    )
    assert lines[30] == "measurements must not hold masked entries: leave those rows out (mask=)"
    assert lines[50] == "tolerance_mm must be finite and positive, in mm, not '0.1'"
    assert lines[53] == "max_rounds must be a whole number, not 2.5"
    assert lines[59] == (
        "options must be made by jaxcal.Options, e.g. jaxcal.Options(max_rounds=100), not "
        "{'max_rounds': 3}"
    )
    assert (
        lines[64]
        == "max_elevation must be one number, or one for each of 9 images, mm; its shape is (5,)"
    )
    assert lines[71] == "methods[0]: max_iterations must be a whole number, not 1.5"
    assert lines[72] == (
        "methods[0]: max_elevation must be finite and not negative, in mm, not '1 mm'"
    )
    assert lines[77] == "level must be between 0 and 1, not '0.95'"
    assert lines[82] == (
        "jaxcal.Problem.from_recording takes a recording (jaxcal.load reads one), not str"
    )
    assert lines[85] == "key must be a JAX key, e.g. jax.random.key(1), not 3"
    assert lines[87].startswith("run_study takes a study, not 'no-such-study.toml'")
    for line in lines[90:100]:
        assert line.startswith("the name of a file must be text or a pathlib.Path, not ")
    assert not Path("no-such-folder").exists()
    assert lines[207] == "mask must hold booleans (True = used)"
    for line in [*lines[208:210], *lines[212:215]]:
        assert line.endswith(" must not hold masked entries: leave those rows out (mask=)")
    assert lines[210] == lines[211] == lines[207]
    assert lines[215] == "mask must be a numpy array, not a list"
    assert lines[219].startswith("pose 0 is a reflection")
    assert lines[69] == "robust must be True or False, not 'no'"
