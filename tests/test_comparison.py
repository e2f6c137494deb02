"""Do two calibrations of one probe agree? ``jaxcal compare`` and what it computes."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal import ImageTransform, InputError, compare_calibrations
from jaxcal.cli.main import main
from jaxcal.diagnostics.comparison import Comparison
from jaxcal.runtime.arrays import map_arrays

POINTS = np.array([[100.0, 300.0], [10, 10], [390, 10], [10, 490], [390, 490]])
SCALE = np.array([0.1, 0.12])


def place() -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    transform[:3, 3] = 10.0, 20.0, -30.0
    return transform


def twist(step: np.ndarray) -> np.ndarray:
    """Exp([v, omega]), also of many."""
    generator = np.zeros((*step.shape[:-1], 4, 4))
    generator[..., :3, 3] = step[..., :3]
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        generator[..., i, j], generator[..., j, i] = step[..., 3 + k], -step[..., 3 + k]
    return expm(generator)


def test_a_shift_and_a_turn_are_what_they_are():
    first = ImageTransform(place(), SCALE)
    shifted = ImageTransform(place() @ twist(np.array([0, 3.0, 0, 0, 0, 0])), SCALE)
    found = compare_calibrations(first, shifted, POINTS)
    np.testing.assert_allclose(found.apart_mm, 3.0)
    assert found.rms_mm == pytest.approx(3.0)
    assert found.rotation_deg == pytest.approx(0.0, abs=1e-9)
    assert found.agree is None
    assert np.isnan([found.limit_mm, found.expected_rms_mm, *found.expected_mm]).all()
    turned = ImageTransform(place() @ twist(np.array([0, 0, 0, 0, 0, 0.1])), SCALE)
    found = compare_calibrations(first, turned, POINTS[2:3])
    # About the axial axis, by the lateral position of 39 mm.
    assert found.apart_mm == pytest.approx([2 * 39.0 * np.sin(0.05)])
    assert found.rotation_deg == pytest.approx(np.degrees(0.1))


def test_results_are_compared_as_their_transforms_are():
    recordings = [jaxcal.simulate_recording(jaxcal.Protocol(images=8), seed) for seed in (1, 2)]
    first, second = (jaxcal.calibrate(each, "conventional") for each in recordings)
    millimetres = np.array([[0.0, 30.0], [10.0, 60.0]])
    found = compare_calibrations(first, second, millimetres)
    one, alone = (compare_calibrations(first, second, millimetres[k]) for k in (0, slice(1)))
    assert one.points.shape == (1, 2)
    assert one.limit_mm == alone.limit_mm
    both = [each.image_transform() for each in (first, second)]
    stored = compare_calibrations(*both, millimetres)
    mixed = compare_calibrations(first, both[1], millimetres)
    assert found.rms_mm == stored.rms_mm == mixed.rms_mm > 0
    assert found.limit_mm == stored.limit_mm
    with pytest.raises(InputError, match="first takes points in mm, memory pixels"):
        compare_calibrations(first, ImageTransform(place(), SCALE), millimetres)
    batch = map_arrays(lambda leaf: np.stack([leaf, leaf]), first)
    with pytest.raises(InputError, match="take one of them"):
        compare_calibrations(batch, first, millimetres)


def test_nineteen_of_twenty_pairs_with_right_covariances_agree():
    """The errors of X and of the pixel size are correlated, and those of one are twice the other's.

    Of 4,000 pairs the standard error of the share is 0.3 %. The limit is that of the truth.
    """
    draws = np.random.default_rng(0)
    factor = np.tril(0.3 * draws.normal(size=(8, 8)), -1) + np.eye(8)
    factor = np.array([0.1, 0.5, 0.1, 0.008, 0.002, 0.004, 0.01, 0.008])[:, None] * factor
    covariance = factor @ factor.T

    def with_errors_of(size: float) -> ImageTransform:
        return ImageTransform(
            place(),
            SCALE,
            unknowns=("translation", "rotation", "scale"),
            covariance=size**2 * covariance[:6, :6],
            image_covariance=size**2 * covariance,
        )

    def placed(size: float) -> np.ndarray:
        error = size * draws.normal(size=(4000, 8)) @ factor.T
        u, v = np.moveaxis(POINTS * SCALE * np.exp(error[:, None, 6:]), -1, 0)
        in_plane = np.stack([u, 0 * u, v, np.ones_like(u)], axis=-1)
        return in_plane @ np.swapaxes(place() @ twist(error[:, :6]), -1, -2)

    found = compare_calibrations(with_errors_of(1.0), with_errors_of(2.0), POINTS)
    assert found.agree
    apart = np.linalg.norm(placed(1.0) - placed(2.0), axis=2)
    share = np.mean(np.sqrt(np.mean(apart**2, axis=1)) <= found.limit_mm)
    assert share == pytest.approx(0.95, abs=0.015)
    expected = found.expected_mm
    np.testing.assert_allclose(np.sqrt(np.mean(apart**2, axis=0)), expected, rtol=0.05)
    assert found.expected_rms_mm == pytest.approx(np.sqrt(np.mean(expected**2)))


def test_sds_estimated_from_few_images_widen_the_limit():
    """For shifts alike along all axes: the distance squared is 3 s^2 F(3, n) with Student's n."""
    s, n = 0.2, 5.0
    exact = ImageTransform(place(), SCALE, covariance=np.zeros((6, 6)))
    given = replace(exact, covariance=np.diag([s, s, s, 0, 0, 0]) ** 2)
    fitted = replace(given, degrees_of_freedom=n)
    tuned = replace(fitted, variance_factor=n / (n - 2))

    def limit(square: float, freedom: float) -> float:
        return np.sqrt(3 * square * stats.f.ppf(0.95, 3, freedom))

    def found(first: ImageTransform, second: ImageTransform) -> Comparison:
        return compare_calibrations(first, second, POINTS)

    for one in (fitted, tuned):
        for pair in ((one, exact), (exact, one)):
            assert found(*pair).limit_mm == pytest.approx(limit(s**2, n), rel=5e-3)
    assert found(fitted, fitted).limit_mm == pytest.approx(limit(2 * s**2, 2 * n), rel=5e-3)
    # The vector with 10 degrees of freedom has the covariance of the two with 5.
    same = 2 * s**2 * tuned.variance_factor / (10 / 8)
    assert found(tuned, tuned).limit_mm == pytest.approx(limit(same, 2 * n), rel=5e-3)
    expected = [found(each, each).expected_rms_mm for each in (given, fitted, tuned)]
    assert expected == pytest.approx(np.sqrt([6.0, 6.0, 10.0]) * s)
    # Beside one that is known three times as well, the other's degrees of freedom count.
    better = replace(tuned, covariance=tuned.covariance / 9)
    left = (1 + 1 / 9) ** 2 / (1 / n + 1 / 81 / n)
    square = (1 + 1 / 9) * s**2 * (5 / 3) / (left / (left - 2))
    assert found(tuned, better).limit_mm == pytest.approx(limit(square, left), rel=5e-3)


def test_what_cannot_be_compared_is_refused():
    pixels = ImageTransform(place(), SCALE, source="px.json")
    points = ImageTransform(place(), source="mm.json")
    for pair in ((pixels, points), (points, pixels)):
        with pytest.raises(InputError, match=r"mm\.json takes points in mm, px\.json pixels"):
            compare_calibrations(*pair, POINTS)
    with pytest.raises(InputError, match=r"bad\.json: must not be used"):
        compare_calibrations(
            pixels, ImageTransform(place(), SCALE, converged=False, source="bad.json"), POINTS
        )


@pytest.fixture
def files(tmp_path) -> list[str]:
    """Three calibrations: two agree, one is 5 mm away."""
    covariance = np.diag([0.3, 0.3, 0.3, 0.004, 0.004, 0.004]) ** 2
    names = []
    for k, step in enumerate((0.0, 0.2, 5.0)):
        transform = place() @ twist(np.array([step, 0, 0, 0, 0, 0]))
        names.append(str(tmp_path / f"{k}.json"))
        ImageTransform(transform, SCALE, covariance=covariance).save(names[-1])
    return names


PIXELS = ("--pixel", "100", "300", "--pixel", "390", "490")


def test_the_command_tells_who_agrees(files, capsys):
    assert main(["compare", *files[:2], *PIXELS]) == 0
    page = " ".join(capsys.readouterr().out.split())
    assert "The calibrations agree: image points are 0.20 mm apart (RMS)" in page
    assert main(["compare", *files[1:], *PIXELS]) == 5
    page = " ".join(capsys.readouterr().out.split())
    assert "do not agree: image points are 4.80 mm apart" in page
    assert "less accurate than its covariance says" in page
    assert main(["compare", *files, *PIXELS]) == 5
    printed = capsys.readouterr().out
    page = " ".join(printed.split())
    assert "2 of 3 pairs are farther apart than 95 %" in page
    # Long paths stay whole, so that they can be copied.
    assert printed.splitlines()[:3] == [f"{k}: {name}" for k, name in enumerate(files, start=1)]
    assert re.search(r"^ *2 +3 .* no *$", printed, re.M)
    assert main(["compare", *files, *PIXELS, "--json"]) == 5
    pairs = json.loads(capsys.readouterr().out)["pairs"]
    assert [pair["agree"] for pair in pairs] == [True, False, False]
    assert pairs[0]["points"] == [[100, 300], [390, 490]]


def test_some_of_many_pairs_may_be_apart_by_chance(tmp_path, capsys):
    """Of ten right calibrations one in two has a pair beyond 95 %; few have one beyond chance."""
    covariance = np.diag([0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3]) ** 2
    rng = np.random.default_rng(0)
    status, beyond = [], []
    for _ in range(10):
        names = []
        for k, step in enumerate(rng.multivariate_normal(np.zeros(6), covariance, size=8)):
            names.append(str(tmp_path / f"{k}.json"))
            ImageTransform(place() @ twist(step), SCALE, covariance=covariance).save(names[-1])
        status.append(main(["compare", *names, *PIXELS]))
        page = " ".join(capsys.readouterr().out.split())
        beyond.append(" 0 of 28 pairs" not in page)
        assert ("than any of so many is by chance" in page) == (status[-1] == 5)
    assert sum(beyond) >= 5
    assert status.count(5) <= 2
    main(["compare", names[0], names[0], names[1], *PIXELS])
    assert "the same" in capsys.readouterr().out


def test_a_verdict_that_expects_larger_errors_is_told(files, capsys):
    known = jaxcal.load_calibration(files[2])
    replace(known, tre_factor=2.8).save(files[2])
    said = told(capsys, *files[1:])
    assert said.count("expects errors 2.8 times as large as its covariance says") == 1
    assert f"verdictof{files[2]}expects" in said.replace(" ", "")  # the whole name
    assert "2.8 times" in told(capsys, *files)
    assert "times as large" not in told(capsys, *files[:2])
    main(["compare", *files, *PIXELS, "--json"])
    factors = json.loads(capsys.readouterr().out)["tre_factor"]
    assert factors == dict(zip(files, (1.0, 1.0, 2.8), strict=True))


def test_lengths_that_may_be_in_another_unit_are_told_wherever_they_are_used(tmp_path, capsys):
    doubted, other = str(tmp_path / "doubted.json"), str(tmp_path / "other.json")
    ImageTransform(place(), SCALE, doubtful_unit="may be in cm").save(doubted)
    ImageTransform(place(), SCALE).save(other)
    for arguments, where in (
        (["compare", doubted, other, *PIXELS], 0),
        (["apply", doubted, "--pixel", "1", "2"], 1),
        (["export", doubted, "--plus"], 1),
    ):
        assert main(arguments) == 0
        assert capsys.readouterr()[where].count("may be in cm") == 1
    assert main(["apply", other, "--pixel", "1", "2"]) == 0
    assert capsys.readouterr().err == ""


def test_without_covariances_nothing_is_claimed(files, tmp_path, capsys):
    plain = str(tmp_path / "plain.tfm")
    ImageTransform(place(), SCALE).save(plain)
    assert main(["compare", files[2], plain, *PIXELS]) == 0
    assert "How far apart they should be is not known" in " ".join(capsys.readouterr().out.split())
    assert main(["compare", files[2], plain, *PIXELS, "--json"]) == 0
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert (pair["agree"], pair["limit_95_mm"], pair["expected_mm"]) == (None, None, [None, None])


def test_points_are_those_of_the_first_record_that_states_its_error(files, capsys):
    assert main(["compare", *files[:2]]) == 2
    assert "name points of the image by --pixel" in capsys.readouterr().err
    assert main(["compare", files[0]]) == 2
    record = json.loads(Path(files[1]).read_text())
    stated = [{"name": "middle", "image": point} for point in POINTS.tolist()]
    # A point that "calibrate --tre" was asked for may lie far outside the image.
    stated.append({"name": "asked for", "image": [9e3, 9e3]})
    Path(files[1]).write_text(json.dumps(record | {"tre": {"points": stated}}))
    assert main(["compare", *files[:2], "--json"]) == 0
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert pair["points"] == POINTS.tolist()
    for nonsense in ({"points": [{"image": [1, None]}]}, {"points": 3}, [], {"points": []}):
        Path(files[1]).write_text(json.dumps(record | {"tre": nonsense}))
        assert main(["compare", *files[:2]]) == 2
        assert "name points of the image" in capsys.readouterr().err


def test_calibrations_of_other_images_of_one_probe_agree(tmp_path, capsys):
    """As a person makes them; ``calibrate --out`` says where the image was used."""
    from jaxcal.data.problem import taken

    whole = jaxcal.Problem.from_recording(jaxcal.simulate_recording(jaxcal.Protocol(images=24), 3))
    names = []
    for half in (range(0, 24, 2), range(1, 24, 2)):
        names.append(str(tmp_path / f"{half.start}.json"))
        jaxcal.calibrate(taken(whole, [*half]), "conventional").save(names[-1])
    assert main(["compare", *names, "--json"]) == 0
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert len(pair["points"]) == 5
    assert 0.1 < pair["rms_mm"] / pair["expected_rms_mm"] < 2.0


def told(capsys, *names: str) -> str:
    main(["compare", *names, *PIXELS])
    return " ".join(capsys.readouterr().out.split())


def test_what_two_calibrations_should_share_and_do_not_is_told(files, tmp_path, capsys):
    record = json.loads(Path(files[1]).read_text())
    Path(files[1]).write_text(json.dumps(record | {"source": "rec.h5"}))
    again = str(tmp_path / "again.tfm")
    jaxcal.load_calibration(files[0]).save(again)
    for names in ((files[0], files[0]), (files[0], again)):
        assert "The two are one and the same calibration" in told(capsys, *names)
        main(["compare", *names, *PIXELS, "--json"])
        assert [pair["same"] for pair in json.loads(capsys.readouterr().out)["pairs"]] == [True]
    other = str(tmp_path / "other.json")
    frames = {"from": "Port 1", "to": None}
    changed = record | {"scale_mm_per_px": [0.05, 0.12], "plus_image_to_probe": None}
    changed |= {"source": "rec.h5", "pose_frames": frames}
    Path(other).write_text(json.dumps(changed))
    said = told(capsys, files[1], other)
    assert "A pixel is 0.1000 x 0.1200 mm in the first and 0.0500 x 0.1200 mm in the second" in said
    assert "made from 'rec.h5'. If that is one recording, they share its errors" in said
    assert "different names" not in said
    main(["compare", files[1], other, *PIXELS, "--json"])
    in_json = json.loads(capsys.readouterr().out)
    assert in_json["pairs"][0]["same"] is False
    assert all(note in said for note in in_json["notes"])
    assert len(in_json["notes"]) == 2
    Path(files[0]).write_text(json.dumps(record | {"pose_frames": {"from": "Wand", "to": None}}))
    said = told(capsys, files[0], other)
    assert "have different names: 'Wand' in the first, 'Port 1' in the second." in said
    assert "one depth" not in told(capsys, *files[:2])
    # Of several, each is compared with the first; their names are folded, which adds blanks.
    said = told(capsys, *files, other).replace(" ", "")
    assert f"0.1000x0.1200mmin{files[0]}and0.0500x0.1200mmin{other}" in said
    assert said.count("onedepthsetting") == 1
    assert f"differentnames:'Wand'in{files[0]},'Port1'in{other}." in said
