"""The report layer: record, verdict, tables, figures and files."""

import csv
import dataclasses
import json
import re
import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import jaxcal
from jaxcal import InputError, OutputError
from jaxcal.calibration.calibrate import Request
from jaxcal.cli.calibrate import _curves
from jaxcal.data.recording import Recording, make_images
from jaxcal.report.convergence import KEPT, Curve, bounded_curves
from jaxcal.report.next_poses import next_poses_record, next_poses_sentences
from jaxcal.report.paragraphs import laid_out, listed
from jaxcal.report.plots import convergence_figure, plot_offsets, plot_residuals
from jaxcal.report.record import calibration_record, check_test_images, truth_error
from jaxcal.report.tables import calibration_table, comparison_table, frames_and_target
from jaxcal.report.verdict import certainty, frames_of_images, verdict
from jaxcal.report.write import COLUMNS, prepare_folder, write_report
from jaxcal.result.calibration import Status
from jaxcal.runtime.arrays import plain
from jaxcal.solvers.plan import Options
from jaxcal.study.simulation import Protocol, simulate_recording

LEFT_OUT = 5
CURVES = [Curve("joint", np.array([3.0, 1.0, np.nan])), Curve("alternating", np.array([3.0, 2.0]))]


@pytest.fixture(scope="module")
def recording():
    simulated = simulate_recording(Protocol(images=20, test_images=20, elevation_mm=2.0), seed=1)
    mask = np.arange(20) != LEFT_OUT
    return dataclasses.replace(
        simulated, calibration=dataclasses.replace(simulated.calibration, mask=mask)
    )


@pytest.fixture(scope="module")
def result(recording):
    # As bounded_curves solves it, so that both are compiled once.
    return jaxcal.calibrate(recording, "joint", "bounded", options=Options(trace=KEPT))


@pytest.fixture(scope="module")
def record(result, recording):
    return calibration_record(result, recording)


@pytest.fixture(scope="module")
def failed(result):
    """What a solve full of NaN comes back as."""

    def lost(part, names):
        return {name: jnp.full_like(getattr(part, name), jnp.nan) for name in names}

    lines, ended = result.linearisation, result.convergence
    return dataclasses.replace(
        result,
        **lost(
            result, ("image_to_probe", "point", "elevation", "sigma", "unknowns_covariance", "rms")
        ),
        linearisation=dataclasses.replace(lines, **lost(lines, ("information", "variance"))),
        convergence=dataclasses.replace(ended, **lost(ended, ("cost", "stationarity"))),
        status_code=jnp.asarray(int(Status.FAILED)),
    )


def with_status(result, status):
    unknown = jnp.full_like(result.unknowns_covariance, jnp.nan)
    return dataclasses.replace(
        result, unknowns_covariance=unknown, status_code=jnp.asarray(int(status))
    )


def text_of(*renderables):
    console = Console(width=100, markup=False)
    with console.capture() as captured:
        for renderable in renderables:
            console.print(renderable)
    return captured.get()


def test_record_holds_what_the_result_holds(record, result, recording):
    assert record["method"] == "joint"
    assert record["prior"] == "bounded"
    assert record["converged"] is True
    assert record["status"] == "converged"
    assert (record["images"], record["images_used"]) == (20, 19)
    np.testing.assert_array_equal(record["image_plane_to_probe"], result.image_to_probe)
    np.testing.assert_array_equal(record["covariance"], result.covariance)
    np.testing.assert_array_equal(record["elevation_mm"], result.elevation)
    assert record["elevation_sd_mm"][LEFT_OUT] is None
    known = [None if np.isnan(sd) else sd for sd in np.array(result.elevation_sd)]
    assert record["elevation_sd_mm"] == known
    assert record["scale_mm_per_px"] is None
    assert record["reconstruction_precision_set"] == "test"
    assert record["reconstruction_precision_images"] == 20
    assert "over the 20 test images" in " ".join(verdict(record))
    assert record["jaxcal_version"] == jaxcal.__version__
    assert set(record["observability"]) == {
        "condition", "weakest_direction", "weakest_sd_mm", "known_only_from_prior", "advice",
    }  # fmt: skip


def test_rms_is_that_of_the_contract(record, recording):
    images, used = recording.calibration, recording.calibration.mask
    transform = np.array(record["image_plane_to_probe"])
    points = np.c_[images.measurements[:, 0], np.zeros(20), images.measurements[:, 1], np.ones(20)]
    cloud = np.einsum("nij,jk,nk->ni", images.poses, transform, points)[used, :3]
    misses = np.linalg.norm(np.array(record["point_mm"]) - cloud, axis=1)
    assert record["rms_mm"] == pytest.approx(np.sqrt(np.mean(misses**2)), rel=1e-9)


def test_precision_is_eq_8_over_the_used_images(result, recording):
    images, used = recording.calibration, recording.calibration.mask
    alone = dataclasses.replace(recording, test=None)
    record = calibration_record(result, alone)
    points = np.c_[images.measurements[:, 0], np.zeros(20), images.measurements[:, 1], np.ones(20)]
    cloud = np.einsum("nij,jk,nk->ni", images.poses, np.array(result.image_to_probe), points)
    expected = np.sqrt(np.var(cloud[used, :3], axis=0, ddof=1).sum())
    assert record["reconstruction_precision_mm"] == pytest.approx(expected, rel=1e-9)
    assert record["reconstruction_precision_set"] == "calibration"


def test_precision_needs_two_test_images(result, recording):
    only = np.arange(20) == 0
    test = dataclasses.replace(recording.test, mask=only)
    record = calibration_record(result, dataclasses.replace(recording, test=test))
    assert record["reconstruction_precision_mm"] is None
    assert record["reconstruction_precision_set"] == "test"


def pixels(images, spacing, face_offset, *, known=True):
    values = (images.measurements - [0.0, face_offset]) / spacing
    return make_images(
        images.poses,
        values,
        "pixel",
        spacing_mm=np.array(spacing) if known else None,
        face_offset_mm=face_offset,
    )


def test_residuals_of_test_images_make_up_the_precision(tmp_path, result, recording, record):
    """Along the axes of each image, from its point to the mean of all."""
    used = np.arange(20) != 4
    frame = 10 + np.arange(20)
    test = dataclasses.replace(recording.test, mask=used, frame=frame)
    named = dataclasses.replace(recording, test=test, pose_frames=("Wand", "Reference"))
    found = calibration_record(result, named)
    assert found["test_residual_mm"][4] is None
    residuals = np.array([row for row in found["test_residual_mm"] if row is not None])
    precision = np.sqrt((residuals**2).sum() / (len(residuals) - 1))
    assert precision == pytest.approx(found["reconstruction_precision_mm"], rel=1e-9)
    transform = np.asarray(result.image_to_probe)
    points = np.c_[test.measurements[:, 0], np.zeros(20), test.measurements[:, 1], np.ones(20)]
    to_image = np.linalg.inv(test.poses @ transform)
    cloud = np.einsum("nij,jk,nk->ni", test.poses, transform, points)
    target = to_image @ cloud[used].mean(axis=0)
    np.testing.assert_allclose(residuals, (target - points)[used, :3], atol=1e-9)
    write_report(tmp_path, found, result, named, [])
    with (tmp_path / "test_residuals.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert float(rows[19]["distance_mm"]) == pytest.approx(np.linalg.norm(residuals[-1]))
    assert [rows[4][name] for name in ("used", "axial_mm", "frame")] == ["0", "", "14"]
    # The frames and the target's SD, too, are those of the record.
    assert found["pose_frames"] == {"from": "Wand", "to": "Reference"}
    facts = dict(frames_and_target(found))
    assert facts["poses"] == "from Wand to Reference"
    assert set(facts) == {"poses", "target in Reference frame (mm)", "SD of the target (mm)"}
    sd = np.sqrt(np.asarray(result.point_covariance).diagonal())
    assert facts["SD of the target (mm)"] == ", ".join(f"{each:.3f}" for each in sd)
    assert "target in tracker frame (mm)" in dict(frames_and_target(record))


def test_a_few_test_images_that_do_not_fit_are_named(result, recording, record):
    """They condemned the calibration, unnamed; many of them still do."""
    wrong = {}
    for count in (3, 8):
        test = recording.test
        points = test.measurements.copy()
        points[2 : 2 + count, 0] += 15.0 * (-1.0) ** np.arange(count)
        tested = dataclasses.replace(test, measurements=points)
        wrong[count] = calibration_record(result, dataclasses.replace(recording, test=tested))
    told = "Test images 2 to 4 (counted from 0) do not fit the others"
    assert told in " ".join(verdict(wrong[3]))
    assert wrong[3]["tre"]["rms_mm"] == record["tre"]["rms_mm"]
    assert "do not fit the others" not in " ".join(verdict(wrong[8]))
    assert wrong[8]["tre"]["rms_mm"] > 2 * record["tre"]["rms_mm"]


def test_pixel_test_images_are_brought_to_mm(result, recording, record):
    other = Recording(pixels(recording.test, (0.1, 0.2), 3.0))
    converted = calibration_record(result, recording, other)
    assert converted["reconstruction_precision_mm"] == pytest.approx(
        record["reconstruction_precision_mm"], rel=1e-9
    )
    assert "hold pixels, those to calibrate with points" in converted["warnings"][-1]
    assert not any("those to calibrate with" in text for text in record["warnings"])


def test_an_estimated_scale_replaces_the_written_one(result, recording, record):
    def widened(matrix):
        return jnp.eye(11).at[:9, :9].set(matrix)

    lines = result.linearisation
    scaled = dataclasses.replace(
        result,
        scale_mm_per_px=jnp.array([0.1, 0.2]),
        blocks=(*result.blocks, "scale"),
        unknowns_covariance=jnp.eye(11).at[:9, :9].set(result.unknowns_covariance),
        linearisation=dataclasses.replace(
            lines, information=widened(lines.information), design=widened(lines.design)
        ),
    )
    test = pixels(recording.test, (0.1, 0.2), 0.0)
    measured = pixels(recording.calibration, (0.1, 0.2), 0.0)
    for written in (None, np.array([5.0, 5.0])):
        other = Recording(dataclasses.replace(test, spacing_mm=written))
        calibrated = dataclasses.replace(recording, calibration=measured)
        found = calibration_record(scaled, calibrated, other)
        precision = found["reconstruction_precision_mm"]
        assert precision == pytest.approx(record["reconstruction_precision_mm"], rel=1e-9)
        # Which other sizes the test images state is told.
        told = "A pixel is 0.1000 x 0.2000 mm in the calibration and 5.0000 x 5.0000 mm in the test"
        assert any(told in text for text in found["warnings"]) == (written is not None)


def test_test_images_that_cannot_be_used_are_refused(recording):
    unscaled = Recording(pixels(recording.test, (0.1, 0.2), 0.0, known=False), source="t.h5")
    with pytest.raises(InputError, match=r"t\.h5: test images are pixels without spacing_mm"):
        check_test_images(recording, unscaled)
    times = make_images(recording.test.poses, np.full((20, 8), 1e-5), "time_of_flight")
    with pytest.raises(InputError, match="not times of flight"):
        check_test_images(recording, Recording(times))
    assert check_test_images(dataclasses.replace(recording, test=None)) is None


def test_times_of_flight_are_no_points(result, recording):
    times = np.full((20, 2), 4e-5)
    images = make_images(recording.calibration.poses, times, "time_of_flight")
    raw = dataclasses.replace(recording, calibration=images)
    with pytest.raises(jaxcal.InputError, match=r"^[^\n]* hold times of flight[^\n]*$"):
        calibration_record(result, raw)


def test_test_images_that_are_calibrated_with_are_refused(recording):
    images = recording.calibration
    with pytest.raises(InputError, match=r"r\.h5: 19 of 19 test images are among the images to"):
        check_test_images(recording, Recording(images, source="r.h5"))
    # Files that were read and written again: those of import --add-to.
    again = dataclasses.replace(images, poses=images.poses * (1 + 1e-15))
    with pytest.raises(InputError, match="19 of 19 test images are among the images to"):
        check_test_images(recording, Recording(again))
    half = dataclasses.replace(images, mask=np.arange(20) < 5)
    others = dataclasses.replace(images, mask=np.arange(20) > LEFT_OUT)
    assert check_test_images(Recording(half), Recording(others)) is others
    # Poses of another body, and pixels of another size.
    wand = Recording(others, source="w.h5", pose_frames=("Wand", "Tracker"))
    probe = Recording(half, source="p.h5", pose_frames=("Probe", "Reference"))
    with pytest.raises(InputError, match=r"w\.h5: .* of 'Wand', not of 'Probe' as in p\.h5"):
        check_test_images(probe, wand)
    moved = dataclasses.replace(wand, pose_frames=("Probe", "Tracker"))
    assert check_test_images(probe, moved) is others
    ours, theirs = (
        Recording(make_images(each.poses, abs(each.measurements), "pixel", frame_size=size))
        for each, size in ((half, (600, 400)), (others, (640, 480)))
    )
    with pytest.raises(InputError, match="its frames have 640 x 480 px, those to calibrate with"):
        check_test_images(ours, theirs)
    with pytest.raises(InputError, match="14 of 14 test images"):
        check_test_images(Recording(images, test=others))


def test_truth_error(result, recording, record):
    truth = recording.truth
    exact = dataclasses.replace(
        result, image_to_probe=jnp.array(truth.image_to_probe), point=jnp.array(truth.point)
    )
    assert all(value < 1e-9 for value in truth_error(exact, truth).values())
    turned = truth.image_to_probe @ np.diag([-1.0, -1.0, 1.0, 1.0])
    turned[:3, 3] += [3.0, 4.0, 0.0]
    moved = truth_error(dataclasses.replace(exact, image_to_probe=jnp.array(turned)), truth)
    assert moved == pytest.approx({"rotation_deg": 180, "translation_mm": 5, "point_mm": 0})
    assert 0 < record["truth_error"]["translation_mm"] < 5
    unknown = dataclasses.replace(recording, truth=None)
    assert "truth_error" not in calibration_record(result, unknown)


def test_a_failed_solve_is_null_not_nan(failed, recording):
    record = calibration_record(failed, recording)
    text = json.dumps(record, allow_nan=False)
    assert json.loads(text) == record
    assert record["status"] == "failed"
    assert record["converged"] is False
    assert record["covariance"] is None
    assert record["image_plane_to_probe"][0][0] is None
    assert record["reconstruction_precision_mm"] is None


def test_covariance_is_whole_or_null(result, recording):
    unknown = result.unknowns_covariance.at[2, 2].set(jnp.nan)
    broken = dataclasses.replace(result, unknowns_covariance=unknown)
    assert calibration_record(broken, recording)["covariance"] is None


def test_plain():
    values = {"a": (np.float64(1.0), np.inf), "b": np.array([[np.nan, 2.0]]), "c": np.int32(3)}
    assert plain(values) == {"a": [1.0, None], "b": [[None, 2.0]], "c": 3}
    assert plain(np.array(True)) is True
    assert plain(None) is None
    assert plain("NaN") == "NaN"


@pytest.mark.parametrize("status", [Status.UNOBSERVABLE, Status.MAX_ITERATIONS])
def test_verdict_on_what_must_not_be_used(result, recording, status):
    record = calibration_record(with_status(result, status), recording)
    lines = verdict(record)
    assert lines[0].startswith(("Do not use", "Do not trust"))
    assert "What to do:" in lines
    # What tells the weakest direction, and what always helps, are not one request twice.
    assert sum(line.count("20 to 30 degrees") for line in verdict(record | {"warnings": []})) <= 1
    assert record["warnings"]
    assert all(f"- {text}" in lines for text in record["warnings"])


def test_lists_have_headings_with_room_before_them():
    assert listed("Look", []) == []
    lines = ["Good: as it is.", *listed("Look", ["a long point " * 3, "short"]), "An end:"]
    assert laid_out(lines, 30).splitlines() == [
        "Good: as it is.",
        "",
        "Look:",
        "- a long point a long point a",
        "  long point",
        "- short",
        "An end:",
    ]
    # A number stays with its unit.
    assert laid_out(["about 90 % of them or 3 mm"], 8).splitlines() == [
        "about",
        "90 % of",
        "them or",
        "3 mm",
    ]


def test_verdict_gives_zero_no_sign(record):
    points = [point | {"position_mm": [-0.2, 37.0]} for point in record["tre"]["points"]]
    said = verdict(record | {"tre": record["tre"] | {"points": points}})
    assert sum("(lateral 0, depth 37 mm)" in line for line in said) == 1


def test_the_middle_is_not_called_the_best_place(record):
    """The error may be smaller elsewhere, as the map beside these words shows."""
    said = next(line for line in verdict(record) if line.startswith("In the middle (lateral "))
    middle = next(point for point in record["tre"]["points"] if point["name"] == "middle")
    assert f" mm) it is {middle['tre_mm']:.2f} mm; at worst, in the " in said
    assert not any("Best" in line for line in verdict(record))


def test_scatter_says_that_images_left_out_count(record):
    record = {**record, "reconstruction_precision_set": "calibration"}
    for robust, outliers, told in ((True, [3], True), (True, [], False), (False, [3], False)):
        said = "\n".join(verdict({**record, "robust": robust, "outliers": outliers}))
        assert ("over the calibration images (those left out included)" in said) == told


def test_no_poses_are_named_where_a_delay_was_estimated(result, recording):
    """The plan does not know it, and would promise an error that the images have already."""
    assert next_poses_record(result, recording) is not None
    delayed = dataclasses.replace(result, blocks=(*result.blocks, "delay"))
    assert next_poses_record(delayed, recording) is None


def test_advised_tilts_can_be_limited(result, recording):
    """A hand-held probe cannot be tilted as far as every pose of a recording."""

    def tilts(cone_deg):
        poses = next_poses_record(result, recording, cone_deg)["poses"]
        images = np.array([pose["pose"] for pose in poses])[:, :3, :3] @ transform
        return np.degrees(np.arccos(images[:, :, 2] @ middle[:, 2]))

    transform = np.asarray(result.image_to_probe)[:3, :3]
    images = recording.calibration
    seen = images.poses[images.mask][:, :3, :3] @ transform
    u, _, v = np.linalg.svd(seen.mean(axis=0))
    middle = u @ v
    assert tilts(5.0).max() < 5.001
    assert tilts(None).max() > 15


def test_verdict_names_outliers_and_out_of_plane_errors(record):
    lines = verdict({**record, "outliers": [3, 7]})
    assert any("Check images 3, 7 (" in line for line in lines)
    plain_fit = {**record, "method": "conventional", "prior": "none"}
    assert any("--method joint" in line for line in verdict(plain_fit))
    assert not any("--method joint" in line for line in verdict(record))


def test_verdict_says_what_rests_on_an_assumption(record):
    sight = {**record["observability"], "known_only_from_prior": "rotation about the lateral axis"}
    said = verdict({**record, "prior": "gaussian", "observability": sight})
    assert any("do not determine rotation about the lateral axis" in line for line in said)
    for probability, words in ((0.9, "a mean of the offsets"), (0.1, "the assumption that")):
        law = {"mean_probability": probability, "words": "Gaussian."}
        mean = {**record, "prior": "gaussian", "observability": sight, "offset_law": law}
        assert f"it rests on {words}" in " ".join(verdict(mean))


def test_tables(record, failed, recording):
    text = text_of(calibration_table(record))
    assert f"{record['image_plane_to_probe'][0][3]:.6f}" in text
    assert "19 used of 20" in text
    assert record["further_unknowns"] == {}
    # Whatever further unknown the table may have one day.
    found = {"tangents": ["bend_rad"], "values": [-0.0123], "sd": [0.004], "prior_sd": 0.03}
    text = text_of(calibration_table({**record, "further_unknowns": {"bend": found}}))
    assert "bend_rad -0.0123 +- 0.004" in text
    lost = calibration_record(failed, recording)
    assert "failed" in text_of(calibration_table(lost))
    text = text_of(comparison_table({"joint": record, "lost": lost}, {"joint": 1.25}))
    assert f"{record['truth_error']['rotation_deg']:.3f}" in text
    assert "1.2" in text
    assert max(map(len, text.splitlines())) <= 100


def test_figures_have_units_and_data(result, recording):
    residuals = plot_residuals(result)
    assert [panel.get_ylabel() for panel in residuals.axes] == [
        "lateral (mm)", "axial (mm)", "elevational (mm)",
    ]  # fmt: skip
    drawn = residuals.axes[0].lines[1].get_xydata()
    used = np.flatnonzero(recording.calibration.mask)
    np.testing.assert_array_equal(drawn[:, 0], used)
    np.testing.assert_array_equal(drawn[:, 1], result.residual[used, 0])

    offsets = plot_offsets(result, recording.truth.elevation).axes[0]
    assert "(mm)" in offsets.get_ylabel()
    labels = offsets.get_legend_handles_labels()[1]
    assert set(labels) == {"true", "estimated, with one SD", "at its bound"}


def test_one_offset_far_away_leaves_the_histogram_few_bars(result):
    offset = 1e-9 * np.arange(20.0)
    offset[7] = 5.0
    figure = plot_offsets(dataclasses.replace(result, elevation=jnp.asarray(offset)))
    assert len(figure.axes[1].patches) == 5


def test_convergence_figure_shows_the_excess_over_the_best():
    curves = [*CURVES, Curve("lost", np.full(3, np.nan))]
    stopping = dataclasses.replace(CURVES[1], stopped=1)
    panel = convergence_figure([curves[0], stopping, curves[2]]).axes[0]
    assert panel.get_yscale() == "log"
    np.testing.assert_array_equal(panel.lines[0].get_ydata()[0], 2.0)
    np.testing.assert_array_equal(panel.lines[1].get_ydata(), [2.0, 1.0])
    assert "alternating: stops here" in panel.get_legend_handles_labels()[1]
    nothing = convergence_figure([curves[2]]).axes[0]
    assert "no objective values" in nothing.texts[0].get_text()


def test_bounded_curves_end_in_one_minimum(recording, result):
    joint, alternating = bounded_curves(jaxcal.Problem.from_recording(recording))
    trace = np.asarray(result.convergence.trace)
    np.testing.assert_array_equal(joint.objective[-len(trace) :], trace)
    values = [curve.objective[np.isfinite(curve.objective)] for curve in (joint, alternating)]
    for curve in values:
        assert (np.diff(curve) <= 1e-12 * curve[0]).all()
    assert values[0].min() <= values[1].min() + 1e-9
    # The joint steps alone, without the warm-up that both share the like of.
    assert len(values[0]) < len(values[1])


def test_curves_are_of_the_images_in_use(recording, result):
    """An image that a robust solve left out is still in its problem."""
    problem = jaxcal.Problem.from_recording(recording)
    points = np.array(problem.measurements)
    points[3] += 50.0
    changed = dataclasses.replace(
        result,
        problem=dataclasses.replace(problem, measurements=jnp.asarray(points)),
        mask=problem.mask.at[3].set(0.0),
    )
    for curve in _curves(Request("joint", "bounded"), changed):
        assert np.nanmin(curve.objective) < 50.0**2 / 10


@pytest.fixture(scope="module")
def written(tmp_path_factory, record, result, recording):
    """A folder with a whole report, and its files."""
    folder = tmp_path_factory.mktemp("report")
    return folder, write_report(folder, record, result, recording, CURVES, {"joint": record})


def test_report_files(written, record, result):
    folder, files = written
    assert {path.name for path in folder.iterdir()} == {path.name for path in files}
    assert json.loads((folder / "calibration.json").read_text()) == record
    with (folder / "residuals.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == 20
    assert float(rows[0]["lateral_mm"]) == result.residual[0, 0]
    assert float(rows[3]["elevation_mm"]) == result.elevation[3]
    assert rows[LEFT_OUT]["used"] == "0"
    assert rows[LEFT_OUT]["lateral_mm"] == rows[LEFT_OUT]["elevation_mm"] == ""
    assert {"verdict.txt", "accuracy.svg", "convergence.png"} <= {path.name for path in files}
    assert (folder / "verdict.txt").read_text().startswith(verdict(record)[0])
    for path in folder.glob("*.png"):
        content = path.read_bytes()
        assert content.startswith(b"\x89PNG")
        assert content.endswith(b"IEND\xaeB`\x82")


def test_frames_of_the_images_that_are_named_are_told(record, tmp_path, result, recording):
    named = {"outliers": [3], "suspects": [{"image": 7}], "influence": {"most": [5, 0, 3, 9]}}
    told = frames_of_images(record | named | {"frame": [k + (k > 4) for k in range(20)]})
    assert told == [
        "Images are counted from 0 in the recording; in the file that it came from, image 5 is "
        "frame 6, image 7 is frame 8."
    ]
    assert frames_of_images(record | named | {"frame": list(range(20))}) == []
    assert frames_of_images(record | named) == []
    images = dataclasses.replace(recording.calibration, frame=3 * np.arange(20))
    imported = dataclasses.replace(recording, calibration=images)
    jaxcal.save(imported, tmp_path / "rec.h5")
    np.testing.assert_array_equal(
        jaxcal.load(tmp_path / "rec.h5").calibration.frame, 3 * np.arange(20)
    )
    write_report(tmp_path, record, result, imported, [])
    with (tmp_path / "residuals.csv").open() as table:
        assert [row["frame"] for row in csv.DictReader(table)][:3] == ["0", "3", "6"]


def test_report_of_a_failed_solve(tmp_path, failed, recording):
    lost = calibration_record(failed, recording)
    assert len(write_report(tmp_path, lost, failed, recording, [])) == 3 + 2 * 2
    assert "nan" not in (tmp_path / "residuals.csv").read_text().lower()


def test_a_report_takes_the_place_of_another(tmp_path, written, failed, recording):
    """Nothing of the old one stays; files that no report writes do."""
    (tmp_path / "mine.png").write_text("x")
    shutil.copytree(written[0], tmp_path, dirs_exist_ok=True)
    assert (tmp_path / "comparison.json").exists()
    with prepare_folder(tmp_path):
        pass
    lost = calibration_record(failed, recording)
    files = write_report(tmp_path, lost, failed, recording, [])
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in files} | {
        "mine.png"
    }
    assert {path.stem for path in files if path.suffix == ".svg"} == {"residuals", "offsets"}
    with prepare_folder(tmp_path):
        pass  # a report of a failed solve is one, too


def test_what_is_not_a_report_is_not_replaced(tmp_path):
    (tmp_path / "offsets.png").write_text("a picture of mine")
    for content in (None, "{}", "x"):
        if content is not None:
            (tmp_path / "calibration.json").write_text(content)
        with pytest.raises(InputError, match="no report of jaxcal"), prepare_folder(tmp_path):
            pass
    # Killed in the moment in which the files took their names.
    (tmp_path / ".partial-report-0").mkdir()
    with prepare_folder(tmp_path):
        pass


def test_prepare_folder(tmp_path):
    with prepare_folder(tmp_path / "a" / "b") as folder:
        assert folder.is_dir()
    with prepare_folder(tmp_path / "a"):
        pass
    assert list((tmp_path / "a" / "b").iterdir()) == []


def test_prepare_folder_removes_only_what_it_made(tmp_path):
    (tmp_path / "mine").mkdir()

    def fail_in(path, name=None):
        with prepare_folder(path) as folder:
            if name:
                (folder / name).write_text("x")
            raise InputError("no")

    for path, name in (("mine/a/b", None), ("mine", None), ("kept/deep", "file")):
        with pytest.raises(InputError):
            fail_in(tmp_path / path, name)
    assert {path.name for path in tmp_path.iterdir()} == {"mine", "kept"}
    assert list((tmp_path / "mine").iterdir()) == []
    assert (tmp_path / "kept" / "deep" / "file").exists()


@pytest.mark.parametrize("path", ["/proc/nope", "/proc", "file", "file/below", "nul\0byte"])
def test_prepare_folder_refuses(tmp_path, path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match=r"^[^\n]+$"), prepare_folder(tmp_path / path):
        pass
    assert [item.name for item in tmp_path.iterdir()] == ["file"]


def test_small_errors_are_not_shown_as_zero(record):
    tiny = 3e-3
    spread = np.diag([(0.1 * tiny) ** 2] * 6)
    small = {
        **record,
        "rms_mm": tiny, "sigma_lateral_mm": 0.2 * tiny, "point_covariance_mm2": spread[:3, :3],
        "covariance": np.radians(spread), "limits": None, "status": "converged",
        "observability": {**record["observability"], "weakest_sd_mm": tiny},
    }  # fmt: skip
    text = text_of(calibration_table(small))
    assert not re.search(r"(?<![0-9.])0\.0+(?![0-9])", text.split("method")[1])
    assert "SD 0.0030 mm" in " ".join(text.split())
    assert not any(re.search(r"\b0\.0+ degrees", line) for line in certainty(small))
    found = {"poses": [{"words": "tilt"}], "tre_now_mm": 0.0841, "tre_then_mm": 0.0813,
             "images_to_half": None}  # fmt: skip
    told = next_poses_sentences({"next_poses": found, "tre": {"rms_mm": 0.0841}})
    assert "from 0.084 to 0.081 mm" in told[0]


@pytest.mark.parametrize(("count", "words"), [(1, "1 more image,"), (2, "2 more images,")])
def test_one_more_image_is_not_called_images(count, words):
    found = {
        "poses": [{"words": "tilt"}], "tre_now_mm": 2.0, "tre_then_mm": 1.0,
        "images_to_half": count,
    }  # fmt: skip
    told = next_poses_sentences({"next_poses": found, "tre": {"rms_mm": 2.0}})
    assert words in told[-1]
    assert "from 2.00 to 1.00 mm" in told[0]
    # Where no error is stated, none is promised.
    told = next_poses_sentences({"next_poses": found, "tre": {"rms_mm": None}})
    assert told[-1] == "- tilt"
    assert "2.00" not in told[0]
