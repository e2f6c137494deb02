"""The report page: numbers of the JSON, nothing from outside, nothing over anything else."""

from __future__ import annotations

import json
import re
import sys
from base64 import b64decode
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from conftest import experiment

import jaxcal
from jaxcal.report import svg
from jaxcal.report.page import page, write_page
from jaxcal.report.paragraphs import as_html
from jaxcal.report.record import calibration_record
from jaxcal.result.saved import load_calibration
from jaxcal.runtime.colours import BLUE, GREEN, ORANGE

sys.path.insert(0, str(Path(__file__).parent / "hw"))
from browser import browsing, open_page

HOSTILE = '</script><script>alert(1)</script><img src=x onerror=alert(1)>"&\u2028.h5'

CHECK = """
const found = [];
const over = (a, b) => a.left < b.right - 0.7 && b.left < a.right - 0.7
  && a.top < b.bottom - 0.7 && b.top < a.bottom - 0.7;
for (const svg of document.querySelectorAll("svg")) {
  const outer = svg.getBoundingClientRect();
  const texts = [...svg.querySelectorAll("text")]
    .map((e) => [e.textContent, e.getBoundingClientRect()]);
  for (const [k, [words, box]] of texts.entries()) {
    if (box.left < outer.left - 1 || box.right > outer.right + 1 || box.top < outer.top - 1
        || box.bottom > outer.bottom + 1) found.push(["outside", svg.ariaLabel, words]);
    for (const [other, second] of texts.slice(k + 1))
      if (over(box, second)) found.push([svg.ariaLabel, words, other]);
  }
}
const blocks = [...document.querySelectorAll("h1,h2,h3,p,li,figure,table,details,.verdict>div")]
  .filter((e) => e.offsetParent !== null);
for (const [k, first] of blocks.entries()) for (const second of blocks.slice(k + 1))
  if (!first.contains(second)
      && over(first.getBoundingClientRect(), second.getBoundingClientRect()))
    found.push(["block", first.textContent.slice(0, 30), second.textContent.slice(0, 30)]);
return {found, wide: document.documentElement.scrollWidth,
  drawn: [...document.querySelectorAll("svg.scene")].map((e) => e.childElementCount),
  back: getComputedStyle(document.body).backgroundColor};
"""


@pytest.fixture(scope="module")
def recording():
    return replace(experiment(3, images=24, elevation_mm=1.0), source=f"/tmp/{HOSTILE}")


@pytest.fixture(scope="module")
def result(recording):
    return jaxcal.calibrate(recording, "conventional")


@pytest.fixture(scope="module")
def record(result, recording):
    found = calibration_record(result, recording)
    found["warnings"] = [*found["warnings"], f"left out {HOSTILE}"]
    return found


@pytest.fixture(scope="module")
def text(record, result, recording):
    return page(record, result, recording)


class Tags(HTMLParser):
    """Every element, its attributes, and the text inside those with an id or a place."""

    def __init__(self):
        super().__init__()
        self.tags, self.told, self.inside, self.open = [], {}, {}, []

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.tags.append((tag, given))
        self.open.append((tag, given))

    def handle_endtag(self, tag):
        while self.open and self.open.pop()[0] != tag:
            pass

    def handle_data(self, data):
        for tag, given in self.open:
            if tag == "span" and "data-record" in given:
                self.told.setdefault((given["data-record"], given["data-form"]), []).append(data)
            if "id" in given:
                self.inside[given["id"]] = self.inside.get(given["id"], "") + data


@pytest.fixture(scope="module")
def tags(text):
    parser = Tags()
    parser.feed(text)
    return parser


def test_what_a_named_error_explains_is_not_listed_once_more(record, result, recording):
    groups = "noise model: the range errors come in two groups"
    for kind, listed in (("step", False), ("skew", True)):
        tre = {**record["tre"], "unmodelled": {"kind": kind}}
        changed = {**record, "tre": tre, "warnings": [groups, "another one"]}
        shown = page(changed, result, recording).partition('id="record"')[0]
        assert "<li>another one</li>" in shown
        assert (f"<li>{groups}</li>" in shown) == listed


def test_numbers_are_those_of_the_record(tags, record):
    assert len(tags.told) > 40
    for (path, form), shown in tags.told.items():
        value = record
        for key in path.split("."):
            value = value[int(key)] if isinstance(value, list) else value[key]
        assert set(shown) == {format(value, form)}, path
    assert {"tre.rms_mm", "tre.interval_95_mm.1", "rms_mm"} <= {path for path, _ in tags.told}
    assert json.loads(tags.inside["record"]) == record


def test_small_errors_are_not_zero_and_estimates_are_told(record, result, recording):
    tre = {**record["tre"], "rms_mm": 0.0039, "interval_95_mm": [0.0014, 0.0074]}
    found = {"sound_speed_m_s": 1490.43, "sound_speed_sd_m_s": 0.86,
             "delay_s": -2.14e-8, "delay_sd_s": None,
             "image_unknowns": [*record["image_unknowns"], "delay_mm"],
             "covariance": (0.04 * np.eye(6)).tolist(),
             "image_covariance": (0.04 * np.eye(7)).tolist()}  # fmt: skip
    text = page({**record, **found, "tre": tre}, result, recording)
    assert ">0.0039</span>" in text
    assert ">0.0014</span>" in text
    assert "1490.4 ± 0.9<" in text
    assert "-0.021 ± -<" in text
    assert ">0.2 mm of distance<" in text


@pytest.mark.parametrize("freedom", [3.0, None])
def test_the_ellipsoid_of_the_target_holds_95_percent(record, result, recording, freedom):
    """Vectors with Student's distribution, drawn from its definition."""
    parser = Tags()
    parser.feed(page({**record, "degrees_of_freedom": freedom}, result, recording))
    scene = json.loads(parser.inside["scene-target"])
    rings = [np.array(line["points"]) - scene["centre"] for line in scene["lines"]]
    longest = max(np.linalg.norm(ring, axis=1).max() for ring in rings)
    covariance = np.asarray(result.point_covariance)
    square = longest**2 / np.linalg.eigvalsh(covariance).max()
    draw = np.random.default_rng(0)
    normal = draw.standard_normal((200_000, 3))
    share = 1.0 if freedom is None else draw.chisquare(freedom, 200_000) / freedom
    inside = np.mean(np.sum(normal**2, axis=1) / share <= square)
    assert inside == pytest.approx(0.95, abs=0.003)


def test_matrix_to_copy_is_the_one_that_is_exported(tags, result, tmp_path):
    (tmp_path / "cal.json").write_text(tags.inside["form-json"])
    loaded = load_calibration(tmp_path / "cal.json")
    np.testing.assert_array_equal(loaded.image_plane_to_probe, result.image_to_probe)
    assert tags.inside["form-ros"] == loaded.text("ros")
    # Points in mm have no pixels, and so no ImageToProbe.
    assert "form-plus" not in tags.inside


def test_nothing_from_outside_and_nothing_from_names(text, tags):
    assert len(text.encode()) < 2e6
    for tag, given in tags.tags:
        assert tag not in ("img", "iframe", "object", "embed", "form", "base")
        assert not any(name.startswith("on") for name in given)
        for name in ("src", "href", "data"):
            assert given.get(name, "data:,") == "data:,"
    assert [tag for tag, _ in tags.tags].count("script") == 4  # ours, the record, two scenes
    assert "@import" not in text
    assert not re.search(r"url\(|https?://(?!www\.w3\.org/2000/svg)", text)


def test_a_page_that_cannot_be_written_leaves_the_old_one(tmp_path, record, result, recording):
    path = tmp_path / "cal.html"
    write_page(path, record, result, recording)
    assert path.read_text().startswith("<!DOCTYPE html>")
    write_page(path, record, result, recording)  # its own page is replaced, and nothing else
    (tmp_path / "mine.html").write_text("<!DOCTYPE html><title>Notes</title>")
    with pytest.raises(jaxcal.InputError, match="exists and is not a page of jaxcal"):
        write_page(tmp_path / "mine.html", record, result, recording)
    (tmp_path / "mine.html").unlink()
    with pytest.raises(jaxcal.OutputError):
        write_page(tmp_path / "no" / "cal.html", record, result, recording)
    assert [entry.name for entry in tmp_path.iterdir()] == ["cal.html"]


@pytest.mark.parametrize(
    ("status", "word"),
    [
        ("unobservable", "do not use"),
        ("max_iterations", "do not trust"),
        ("failed", "failed"),
    ],
)
def test_a_failed_solve_has_a_page_too(record, result, recording, status, word):
    lost = {
        **record, "status": status, "converged": False, "verdict": None, "tre": None,
        "limits": None, "influence": None, "comparison": None, "covariance": None,
        "image_covariance": None,
    }  # fmt: skip
    unknown = replace(
        result,
        unknowns_covariance=np.full(np.shape(result.unknowns_covariance), np.nan),
    )
    text = page(lost, unknown, recording)
    assert f'<div class="word">{word}</div>' in text
    assert f"<p>{word.capitalize()}: " in text
    assert "How accurate" not in text
    # No words about an ellipsoid that is not drawn.
    assert "95 % ellipsoid" not in text


def test_wrong_frames_leave_nothing_to_copy(record, result, recording):
    told = "the poses are inverted: tracker to probe"
    wrong = {**record, "wrong_frames": told, "verdict": None, "warnings": [told]}
    text = page(wrong, result, recording)
    assert f"Do not use: {told}." in text
    assert "What to look at" not in text
    assert 'id="form-' not in text
    assert "How accurate" not in text


def test_many_images_stay_small(result, recording):
    rng = np.random.default_rng(0)
    for count in (5000, 20_000):
        values = rng.normal(size=count)
        drawn = svg.series([("offset (mm)", range(count), values, BLUE)],
                           range(0, count, 3), "many", spread=values**2)  # fmt: skip
        assert len(drawn) < 6e5
    shown = svg.drawn(values, np.array([7, 19_999]))
    assert {7, 19_999, values.argmin(), values.argmax()} <= set(shown)
    for part in np.array_split(np.arange(count), 100):
        assert {values[part].min(), values[part].max()} <= set(values[shown])
    assert len(shown) <= 2002
    np.testing.assert_array_equal(svg.drawn(values[:2000], np.array([3])), np.arange(2000))
    places = np.stack([np.arange(3000.0), np.full(3000, 20.0)], axis=1)
    lateral, axial = np.meshgrid([0.0, 3000.0], [0.0, 3000.0])
    across = [float(x) for x in re.findall(r'cx="([^"]*)"', svg.error_map(
        lateral, axial, axial, places, "map"))]  # fmt: skip
    assert 300 < len(across) <= 401
    # Those of the whole recording, not of its beginning.
    assert np.ptp(across) > 200


@pytest.mark.parametrize("largest", [0.2, 0.45, 0.8, 0.99, 1.3, 2.1, 70.0])
def test_axes_of_images_tell_a_scale_and_only_images_that_exist(largest):
    values = [-0.4 * largest, 0.0, 0.9 * largest, largest]
    drawn = svg.series([("x (mm)", [0, 1, 2, 3], values, BLUE)], [], "few", height=78.0)
    down = re.findall(r'text-anchor="end" class="tick">([^<]*)<', drawn)
    along = re.findall(r'text-anchor="middle" class="tick">([^<]*)<', drawn)
    assert len(down) >= 2
    assert along == ["0", "1", "2", "3"]


@pytest.mark.parametrize(("wide", "deep"), [(50.0, 7.0), (1000.0, 1300.0), (8.0, 9.0)])
def test_error_map_of_any_size_tells_its_scales(wide, deep):
    lateral, axial = np.meshgrid(np.linspace(0, wide, 5), np.linspace(0, deep, 5))
    drawn = svg.error_map(lateral, axial, 0.1 + 0.2 * axial / deep, np.zeros((0, 2)), "map")
    height = float(re.findall(r'viewBox="0 0 380 ([0-9.]+)"', drawn)[0])
    found = re.findall(r'y="([0-9.]+)" text-anchor="start" class="tick">([0-9.]+)<', drawn)
    places = np.array([float(y) for y, _ in found])
    assert len(places) >= 2
    assert (np.abs(np.diff(places)) > 10).all()
    assert (places < height).all()
    for length in map(float, re.findall(r">([0-9.]+) mm</text>", drawn)):
        assert wide / 12 < length <= wide / 4


@pytest.mark.parametrize("largest", [3e-6, 0.0011, 0.012, 0.3, 4000.0])
def test_a_label_has_room_beside_the_numbers_of_its_axis(largest):
    drawn = svg.series([("x (mm)", [0, 1], [-largest, largest], BLUE)], [], "few")
    label = float(re.findall(r'<text x="([0-9.]+)"[^>]*class="label" transform', drawn)[0])
    ends = re.findall(r'<text x="([0-9.]+)"[^>]*text-anchor="end" class="tick">([^<]*)<', drawn)
    # 9 px type of 0.64 em a digit, as wide as any, and half of a label of 10 px.
    assert label + 5 < min(float(end) - 5.76 * len(words) for end, words in ends) + 2
    assert label > 5


def test_shares_are_readable_on_every_colour():
    def luminance(colour):
        parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        return np.dot([0.2126, 0.7152, 0.0722], [((v + 0.055) / 1.055) ** 2.4 for v in parts])

    kinds = [(colour, 1 / 3, colour) for colour in (BLUE, GREEN, ORANGE)]
    inks = re.findall(r"fill:(#[0-9a-f]{3})", svg.stacked([("error", kinds)], "shares"))
    for (_, _, colour), ink in zip(kinds, inks, strict=True):
        dark, light = sorted((luminance(colour), {"#000": 0.0, "#fff": 1.0}[ink]))
        assert (light + 0.05) / (dark + 0.05) > 4.5, colour


def test_a_number_stays_with_its_unit_on_a_page():
    shown = as_html(["Good: 95 % of 3.2 mm:", "- log density +5.0 +- 1.2", "- 6 SDs < 7"])
    assert shown == (
        "<p>Good: 95&nbsp;% of 3.2&nbsp;mm:</p>"
        "<ul><li>log density +5.0 ± 1.2</li><li>6&nbsp;SDs &lt; 7</li></ul>"
    )


@pytest.mark.parametrize(("low", "high"), [(0.2, 0.58), (-3.1, 2.2), (0.0, 1e-4), (-71.0, 88.0)])
def test_ticks_are_round_and_inside(low, high):
    found = svg.ticks(low, high, 5)
    assert 2 <= len(found) <= 6
    assert low - 1e-9 <= found[0] <= found[-1] <= high + 1e-9
    step = found[1] - found[0]
    assert round(step / 10 ** np.floor(np.log10(step) + 1e-9)) in (1, 2, 5)


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (1280, "dark"), (390, "dark")])
def test_in_a_browser_without_a_network(tmp_path, text, width, scheme):
    (tmp_path / "cal.html").write_text(text)
    with browsing(tmp_path / "profile") as browser:
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {
            "width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False,
        })  # fmt: skip
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        browser.execute_cdp_cmd("Log.enable", {})
        open_page(browser, (tmp_path / "cal.html").as_uri())
        seen = browser.execute_script(CHECK)
        entries = [json.loads(entry["message"])["message"] for entry in
                   browser.get_log("performance")]  # fmt: skip
    assert seen["found"] == []
    assert seen["wide"] <= width
    assert min(seen["drawn"]) > 20
    assert (seen["back"] == "rgb(255, 255, 255)") == (scheme == "light")
    own = (tmp_path / "cal.html").as_uri()
    asked = {entry["params"]["request"]["url"] for entry in entries
             if entry["method"] == "Network.requestWillBeSent"
             and entry["params"]["documentURL"] == own}  # fmt: skip
    assert asked - {"data:,"} == {own}
    wrong = [entry for entry in entries
             if entry["method"] in ("Log.entryAdded", "Runtime.exceptionThrown")]  # fmt: skip
    assert wrong == []


PRINTED = """
const dark = (colour) => colour.match(/[0-9.]+/g).slice(0, 3).every((part) => part < 110);
const shown = (e) => e.getClientRects().length > 0;
const cut = [...document.querySelectorAll("pre, .wide, table, p, figure")].filter(shown)
  .filter((e) => e.scrollWidth > e.clientWidth + 1)
  .map((e) => e.textContent.slice(0, 40));
const pale = [...document.querySelectorAll("h1, h2, p, td, pre, svg text, figcaption")]
  .filter(shown)
  .filter((e) => !dark(getComputedStyle(e)[e.closest("svg") ? "fill" : "color"]))
  // White words stand on coloured bars.
  .filter((e) => !e.getAttribute("style"))
  .map((e) => e.textContent.slice(0, 40));
return {cut, pale, buttons: [...document.querySelectorAll("button, .screen")].filter(shown).length};
"""


def test_on_paper(tmp_path, text):
    """A4 by a person whose screen is dark: light, whole, nothing over anything else."""
    (tmp_path / "cal.html").write_text(text)
    with browsing(tmp_path / "profile") as browser:
        # 210 mm less two margins of 14 mm, at 96 px an inch.
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {
            "width": 688, "height": 1017, "deviceScaleFactor": 1, "mobile": False,
        })  # fmt: skip
        features = [{"name": "prefers-color-scheme", "value": "dark"}]
        browser.execute_cdp_cmd(
            "Emulation.setEmulatedMedia", {"media": "print", "features": features}
        )
        open_page(browser, (tmp_path / "cal.html").as_uri())
        seen, printed = browser.execute_script(CHECK), browser.execute_script(PRINTED)
        pdf = browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})["data"]
    assert seen["found"] == []
    assert seen["wide"] <= 688
    assert seen["back"] == "rgb(255, 255, 255)"
    assert min(seen["drawn"]) > 20
    assert printed == {"cut": [], "pale": [], "buttons": 0}
    content = b64decode(pdf)
    assert content.startswith(b"%PDF")
    assert 3 <= content.count(b"/Type /Page\n") <= 8
