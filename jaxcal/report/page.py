"""One page for a browser: verdict, error map, matrix in every form, scene, residuals, comparison.

The page is one file that loads nothing else: styles, script, figures (SVG) and the whole record are
inside, and a content security policy forbids everything else. All text from a recording is escaped.
Numbers that are also in the JSON have their path in it as ``data-record``.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from scipy import special

from jaxcal import InputError
from jaxcal.data.poses import targets_in_images
from jaxcal.data.recording import Recording
from jaxcal.diagnostics.metrics import reconstruct
from jaxcal.diagnostics.outliers import outliers
from jaxcal.io.atomic import check_writable, write_text
from jaxcal.io.outputs import check_output
from jaxcal.report import svg
from jaxcal.report.certified import certificate_words
from jaxcal.report.next_poses import next_poses_sentences
from jaxcal.report.paragraphs import BULLET, as_html, listed
from jaxcal.report.resampled import resampled_sentences
from jaxcal.report.tables import frames_and_target, further_facts
from jaxcal.report.verdict import (
    advice,
    believe,
    certainty,
    findings,
    fine_form,
    frames_of_images,
    headline,
    length_form,
    limits,
    scatter,
    usable,
    verdict_word,
    where,
    why_larger,
)
from jaxcal.result.calibration import Calibration
from jaxcal.result.saved import transform_from_record
from jaxcal.result.transform import SaveFormat
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.colours import BLUE, GREEN, ORANGE
from jaxcal.runtime.messages import counted
from jaxcal.solvers.plan import TUNED

MOST_POSES, MOST_PLANES = 300, 60
"""Most poses, and most image planes, that are drawn in space."""
LONGEST_LIST = 3000
"""Longer lists are left out of the page's record."""

_DOCTYPE, _TITLE = "<!DOCTYPE html>", "<title>Calibration of "
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
_KINDS = (
    ("lateral", "lateral", BLUE),
    ("range", "axial", GREEN),
    ("elevational", "out of the plane", ORANGE),
)
_FORMS: tuple[tuple[SaveFormat, str, str], ...] = (
    ("plus", "PLUS", "ImageToProbe, to paste into CoordinateDefinitions of a device set."),
    ("slicer", "3D Slicer and ITK", "Save as ImageToProbe.tfm and drag it into Slicer."),
    ("numpy", "numpy", "PLUS's matrix: (u, v, 0, 1) in pixels to the probe in mm."),
    ("ros", "ROS", "Rigid, metres: easy_handeye's YAML and the command of tf2."),
    ("tusrec", "TUS-REC", "calib_matrix.csv."),
    ("json", "jaxcal", "What jaxcal apply, export and serve read."),
)


def write_page(
    path: str | os.PathLike[str], record: dict[str, Any], result: Calibration, recording: Recording
) -> None:
    """Write the page of a settled record, complete or not at all; only another page is replaced.

    Raises:
        InputError: the file exists and is no page.
        OutputError: it could not be written; the file is as it was.
    """
    check_page(path)
    write_text(path, page(record, result, recording))


def check_page(path: str | os.PathLike[str], inputs: Sequence[str] = ()) -> None:
    """Check that a page can be written, before other work begins.

    Raises:
        InputError: the file is one of the inputs, exists and is no page, or is not named .html.
        OutputError: it cannot be made or replaced.
    """
    check_output(path, "a page of jaxcal", _is_page, inputs, endings=(".html", ".htm"))
    check_writable(path)


def _is_page(path: str | os.PathLike[str]) -> bool:
    with open(path, "rb") as file:
        start = file.read(2048)
    return start.startswith(_DOCTYPE.encode()) and _TITLE.encode() in start


def page(record: dict[str, Any], result: Calibration, recording: Recording) -> str:
    """The page as text."""
    answer = result.numpy()
    sections = [_head(record), _findings(record)]
    # With wrong frames there are no results to copy or to trust.
    if usable(record):
        sections += [
            _accuracy(record, answer, recording),
            _matrix(record),
            _scene(record, answer, recording),
            _residuals(record, answer),
            _limits(record),
            _comparison(record),
        ]
    sections += [_observability(record), _facts(record)]
    name = escape(Path(record["source"]).name)
    files = resources.files("jaxcal.report")
    style = (files / "page.css").read_text("utf-8")
    script = (files / "page.js").read_text("utf-8")
    return (
        f'{_DOCTYPE}\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        f"{_TITLE}{name}</title>\n<style>\n{style}</style></head>\n<body>\n"
        + "\n".join(sections)
        + f"\n{_embedded('record', _shortened(record))}\n<script>\n{script}</script>\n"
        "</body></html>\n"
    )


def _embedded(name: str, value: Any) -> str:
    """JSON inside the page; no text in it can close the script element."""
    text = json.dumps(value, allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>'


def _shortened(record: dict[str, Any]) -> dict[str, Any]:
    """The record without very long lists."""

    def short(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: short(item) for key, item in value.items()}
        return None if isinstance(value, list) and len(value) > LONGEST_LIST else value

    return short(record)


def _value(record: dict[str, Any], path: str) -> Any:
    """What the record holds at a path of keys and places, with dots between them."""
    value: Any = record
    for key in path.split("."):
        value = value[int(key)] if isinstance(value, list) else value[key]
    return value


def _number(record: dict[str, Any], path: str, form: str, unit: str = "") -> str:
    """A number of the record, with its path there."""
    value = _value(record, path)
    if value is None:
        return "not known"
    tail = f"&nbsp;{escape(unit)}" if unit else ""
    return f'<span data-record="{path}" data-form="{form}">{value:{form}}</span>{tail}'


def _length(record: dict[str, Any], path: str, unit: str = "") -> str:
    """A length of the record (mm), with as many digits as in the verdict."""
    return _number(record, path, length_form(_value(record, path) or 0.0), unit)


def _fine(record: dict[str, Any], path: str, unit: str = "") -> str:
    """The same with as many digits as in the table of a terminal."""
    return _number(record, path, fine_form(_value(record, path) or 0.0), unit)


def _section(title: str, *parts: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{''.join(parts)}</section>"


def _figure(drawn: str, caption: str) -> str:
    return f"<figure>{drawn}<figcaption>{caption}</figcaption></figure>"


def _table(rows: Iterable[Sequence[str]], head: Sequence[str] = (), words: int = 1) -> str:
    """A table of HTML; all columns after the first ones, of ``words``, hold numbers."""

    def line(tag: str, cells: Sequence[str]) -> str:
        kinds = [tag if k < words else f'{tag} class="n"' for k in range(len(cells))]
        return "".join(f"<{kind}>{cell}</{tag}>" for kind, cell in zip(kinds, cells, strict=True))

    lines = [line("th", head)] if head else []
    lines += [line("td", row) for row in rows]
    body = "".join(f"<tr>{cells}</tr>" for cells in lines)
    return f'<div class="wide"><table>{body}</table></div>'


def _head(record: dict[str, Any]) -> str:
    tre = record["tre"]
    kind = escape(record["verdict"] or "uncertain")
    number = ""
    if usable(record) and tre is not None and tre.get("rms_mm") is not None:
        number = (
            f'<div><span class="big">{_length(record, "tre.rms_mm", "mm")}</span>'
            "<small>error to expect at the image (TRE, root mean square)<br>95 % interval "
            f"{_length(record, 'tre.interval_95_mm.0')} to "
            f"{_length(record, 'tre.interval_95_mm.1', 'mm')}</small></div>"
        )
    prior = "" if record["prior"] == "none" else f", prior {record['prior']}"
    said = [headline(record)]
    if usable(record):
        said += [*why_larger(record), *where(record)]
        said += [*listed("What limits it", limits(record)), *scatter(record)]
    return (
        f"<header><h1>Calibration of {escape(Path(record['source']).name)}</h1>"
        f'<p class="soft">{escape(record["source"])}: {record["images_used"]} images used of '
        f"{record['images']}; method {escape(record['method'] + prior)}; "
        f"jaxcal {escape(record['jaxcal_version'])}</p></header>"
        f'<div class="verdict {kind}"><div class="word">{escape(verdict_word(record))}</div>'
        f"{number}</div>"
        f"{as_html(said)}"
    )


def _findings(record: dict[str, Any]) -> str:
    """What looks wrong, from all checks, and what to do about it."""
    parts = []
    if found := findings(record):
        parts += ["<h3>Look at this</h3>", as_html([BULLET + text for text in found])]
    if todo := advice(record):
        parts += ["<h3>What to do</h3>", as_html([BULLET + text for text in todo])]
    if more := next_poses_sentences(record):
        parts += ["<h3>Further images</h3>", as_html(more)]
    return _section("What to look at, and what to do", *parts) if parts else ""


def map_of_error(record: dict[str, Any], answer: Calibration, recording: Recording) -> str:
    """The error to expect over the image, and where the target was seen, as SVG."""
    tre = record["tre"]
    lateral, axial, stated = (
        np.array(tre["map"][name], float) for name in ("lateral_mm", "axial_mm", "stated_mm")
    )
    poses = recording.calibration.poses[np.asarray(answer.mask) > 0]
    seen = targets_in_images(poses, answer.image_to_probe, answer.point)[:, [0, 2]]
    label = "Target registration error to expect over the image, mm"
    return svg.error_map(lateral, axial, tre["factor"] * stated, seen, label)


def _accuracy(record: dict[str, Any], answer: Calibration, recording: Recording) -> str:
    tre, rows = record["tre"], []
    if tre is None:
        return ""
    for k, point in enumerate(tre["points"]):
        path = f"tre.points.{k}"
        u, v = (_number(record, f"{path}.image.{axis}", "z.1f") for axis in range(2))
        low, high = (_length(record, f"{path}.interval_95_mm.{end}") for end in range(2))
        error = _length(record, f"{path}.tre_mm")
        rows.append((escape(point["name"]), f"{u}, {v}", error, f"{low} to {high}"))
    head = ("point", f"image ({tre['unit']})", "TRE (mm)", "95 % interval (mm)")
    why = "".join(f"<li>{escape(text)}</li>" for text in tre["contradictions"])
    if why:
        why = (
            f"<p>The covariance states {_length(record, 'tre.stated_mm', 'mm')}. All "
            f"numbers here are {_number(record, 'tre.factor', '.2f')} times as large, because</p>"
            f"<ul>{why}</ul>"
        )
    return _section(
        "How accurate",
        '<div class="grid">',
        _figure(
            map_of_error(record, answer, recording),
            "Distance to expect between the true position of what is seen at a point of the image "
            "and its position by this calibration. Dots: where the target was.",
        ),
        "<div>",
        _table(rows, head),
        why,
        '<p class="soft">Each interval leaves 2.5 % below and 2.5 % above. When you use the '
        "calibration, errors of the tracker and of the point you pick are added.</p></div></div>",
    )


def _matrix(record: dict[str, Any]) -> str:
    transform = transform_from_record(record, source=record["source"])
    parts = [
        "<p>PLUS's and Slicer's ImageToProbe takes pixels (u, v, 0, 1) to the probe in mm and "
        "carries the pixel size; image_plane_to_probe is rigid and takes (lateral, elevational, "
        "axial) in mm. They are different matrices.</p>"
    ]
    for form, title, words in _FORMS:
        try:
            text = transform.text(form)
        except InputError:
            continue
        name = f"form-{form}"
        opened = " open" if len(parts) == 1 else ""
        parts.append(
            f"<details{opened}><summary>{escape(title)}</summary><div class='copy'><span "
            f'class="soft">{escape(words)}</span><button type="button" data-copy="{name}">copy'
            f'</button></div><pre id="{name}">{escape(text)}</pre></details>'
        )
    rows = [
        [_number(record, f"image_plane_to_probe.{i}.{j}", ".6f") for j in range(4)]
        for i in range(4)
    ]
    parts += ["<h3>image_plane_to_probe (mm)</h3>", _table(rows, words=0)]
    return _section("The matrix", *parts)


def _scene(record: dict[str, Any], answer: Calibration, recording: Recording) -> str:
    used = np.flatnonzero(np.asarray(answer.mask) > 0)
    shown = used[:: max(-(-len(used) // MOST_POSES), 1)]
    x, point = np.asarray(answer.image_to_probe), np.asarray(answer.point)
    poses = recording.calibration.poses[shown]
    seen = targets_in_images(poses, x, point)
    # The measured point is in the plane, at the measured lateral position and range.
    cloud = np.asarray(reconstruct(x, poses, seen - np.asarray(answer.residual)[shown]))
    whole = _planes(poses @ x, seen, point, shown)
    close = _close_up(answer, cloud, shown, record["degrees_of_freedom"])
    ellipsoid = ""
    if close["lines"]:
        ellipsoid = (
            " with its 95 % ellipsoid (lines), from the covariance and the degrees of freedom of "
            "its SDs, without what contradicts the noise model"
        )
    all_images = (
        "Planes of the images (blue, with a dot where lateral position and depth are zero) and the "
        "target (orange), in the tracker's frame."
    )
    by_image = (
        "The target's position by each image (green; orange: an image that does not fit the "
        f"rest), and its estimate{ellipsoid}."
    )
    place = ", ".join(_number(record, f"point_mm.{k}", ".3f") for k in range(3))
    return _section(
        "In space",
        f'<div class="grid">{_view("scene-all", whole, all_images)}'
        f"{_view('scene-target', close, by_image)}</div>",
        f"<p>Target in the tracker's frame: {place}&nbsp;mm.</p>",
    )


def _planes(
    images: Float[np.ndarray, "n 4 4"],
    seen: Float[np.ndarray, "n 3"],
    point: Float[np.ndarray, " 3"],
    shown: np.ndarray,
) -> dict[str, Any]:
    """The planes of images in the tracker's frame, as far as targets were ``seen``, and the target.

    ``shown`` are the images' numbers; all lengths are mm.
    """
    wide = max(float(np.ptp(seen[:, 0])) / 2, 10.0)
    deep = float(seen[:, 2].max())
    middle = float(0.5 * (seen[:, 0].min() + seen[:, 0].max()))
    across, down = np.array([-1, 1, 1, -1, -1]), np.array([0, 0, 1, 1, 0])
    corners = np.stack([middle + wide * across, 0.0 * down, deep * down], axis=-1)
    frames = corners @ np.swapaxes(images[:, :3, :3], 1, 2) + images[:, None, :3, 3]
    far = np.concatenate([frames.reshape(-1, 3), point[None]])
    centre = 0.5 * (far.min(axis=0) + far.max(axis=0))
    lines = [
        {"points": _rounded(outline), "colour": BLUE, "width": 0.5, "fill": BLUE}
        for outline in frames[:: max(-(-len(frames) // MOST_PLANES), 1)]
    ]
    dots = [
        {"at": _rounded(frame[:3, 3]), "r": 1.6, "colour": BLUE, "title": f"image {image}"}
        for frame, image in zip(images, shown.tolist(), strict=True)
    ]
    dots.append({"at": _rounded(point), "r": 4, "colour": ORANGE, "title": "target"})
    return {
        "centre": _rounded(centre),
        "radius": float(np.linalg.norm(far - centre, axis=1).max()),
        "lines": lines,
        "dots": dots,
        "bar": svg.bar_length(float(np.linalg.norm(np.ptp(far, axis=0)))),
    }


def _view(name: str, scene: dict[str, Any], words: str) -> str:
    """A figure that the page's script draws and turns."""
    return (
        f'<figure>{_embedded(name, scene)}<svg class="scene" viewBox="0 0 380 300" role="img" '
        f'tabindex="0" aria-label="{escape(words)}" data-scene="{name}"></svg>'
        f'<figcaption>{escape(words)} <span class="screen">Drag, or use the arrow keys, to turn.'
        "</span></figcaption></figure>"
    )


def _close_up(
    answer: Calibration, cloud: Float[np.ndarray, "n 3"], shown: np.ndarray, freedom: float | None
) -> dict[str, Any]:
    point, named = np.asarray(answer.point), set(outliers(answer))
    lines: list[dict[str, Any]] = []
    covariance = np.asarray(answer.point_covariance, float)
    reach = 0.0
    if np.isfinite(covariance).all():
        values, vectors = np.linalg.eigh(covariance)
        axes = vectors * np.sqrt(square_within(freedom) * np.maximum(values, 0.0))
        reach = float(np.linalg.norm(axes, axis=0).max())
        turned = np.linspace(0, 2 * np.pi, 49)
        circle = np.stack([np.cos(turned), np.sin(turned)], axis=-1)
        for pair in ([0, 1], [1, 2], [2, 0]):
            ring = point + circle @ axes[:, pair].T
            lines.append({"points": _rounded(ring), "colour": "var(--text)", "width": 0.8})
    away = np.linalg.norm(cloud - point, axis=1)
    # A few points that are far off must not shrink the others to a single dot.
    radius = max(1.15 * float(np.quantile(away, 0.97)) if len(away) else 1.0, 1.2 * reach, 1e-3)
    dots = [
        {
            "at": _rounded(place),
            "r": 2.2,
            "title": f"image {image}, {apart:.3g} mm",
            "colour": ORANGE if image in named else GREEN,
        }
        for place, image, apart in zip(cloud, shown.tolist(), away, strict=True)
        if apart <= 1.2 * radius
    ]
    dots.append({"at": _rounded(point), "r": 3, "colour": "var(--text)", "title": "target"})
    return {
        "centre": _rounded(point),
        "radius": radius,
        "lines": lines,
        "dots": dots,
        "bar": svg.bar_length(2 * radius),
    }


def square_within(freedom: float | None) -> float:
    """The square, in SDs, below which a vector along three axes is with a probability of 95 %.

    ``freedom`` are the degrees of freedom of Student's distribution; None if it is normal.
    """
    if freedom is None:
        return float(special.chdtri(3, 0.05))
    return 3 * float(special.fdtri(3, freedom, 0.95))


def _rounded(values: Any) -> Any:
    """Numbers (mm) rounded to a hundredth of a micrometre, as plain lists."""
    return np.round(np.asarray(values, float), 5).tolist()


def _residuals(record: dict[str, Any], answer: Calibration) -> str:
    used = np.flatnonzero(np.asarray(answer.mask) > 0)
    suspected = (each["image"] for each in record["suspects"])
    named = set(used.tolist()) & {*outliers(answer), *suspected}
    residual = np.asarray(answer.residual)[used]
    first = svg.series(
        [
            (f"{name} (mm)", used, residual[:, axis], colour)
            for name, axis, colour in svg.DIRECTIONS
        ],
        named,
        "Residual of every image: the target less the point that was measured, mm",
        height=78.0,
    )
    offset = np.asarray(answer.elevation)[used]
    second = svg.series(
        [("offset (mm)", used, offset, ORANGE)],
        named,
        "Estimated offset of the target from the image plane, mm",
        spread=np.asarray(answer.elevation_sd)[used],
        height=120.0,
    )
    known = bool(np.isfinite(np.asarray(answer.elevation_sd)[used]).any())
    spread = ", with one standard deviation (grey)" if known else ""
    parts = [
        _figure(
            first,
            "Residual of every image, one scale for all: the estimated target less the measured "
            "point, taken in the image plane. Rings: images that do not fit the rest, or are "
            "suspicious.",
        ),
        _figure(second, f"Estimated distance of the target from the image plane{spread}."),
    ]
    influence = record["influence"]
    if influence is not None:
        moved = influence["moved_mm"]
        shown = [int(k) for k in used if moved[int(k)] is not None]
        third = svg.series(
            [("change (mm)", shown, [moved[k] for k in shown], BLUE)],
            influence["most"][:3],
            "How far leaving out an image would change the calibration, mm in the image",
            height=120.0,
        )
        parts[1] += _figure(
            third,
            "How far points of the image would move if one image were left out (to first order). "
            "Rings: the three images with the largest effect.",
        )
    words = [*frames_of_images(record), *resampled_sentences(record)]
    if len(used) > svg.MOST_DRAWN:
        words.insert(
            0,
            f"Of {len(used)} images the figures show those with the least and the greatest value "
            f"of each {-(-2 * len(used) // svg.MOST_DRAWN)} successive ones.",
        )
    columns = "".join(f"<div>{part}</div>" for part in parts)
    return _section("Image by image", f'<div class="grid">{columns}</div>', as_html(words))


def _limits(record: dict[str, Any]) -> str:
    found, rows = record["limits"], []
    if found is None:
        return ""
    for title, name in (
        ("Mean square error of the calibration in the image", "error_share"),
        ("Mean square residual of the target", "scatter_share"),
    ):
        shares = [(word, found[name][kind], colour) for kind, word, colour in _KINDS]
        if all(share is not None for _, share, _ in shares):
            rows.append((title, [(word, float(share), colour) for word, share, colour in shares]))
    kinds = {"lateral": "lateral", "range": "range", "out of the plane": "elevation"}
    sds = ", ".join(
        f"{word} {_length(record, f'sigma_{name}_mm', 'mm')}" for word, name in kinds.items()
    )
    drawn = svg.stacked(rows, "Where the errors come from, in shares of mean squares")
    return _section(
        "Where the errors come from",
        f"<figure>{drawn}</figure><p>Standard deviations found: {sds}. Residual, root mean square: "
        f"{_fine(record, 'rms_mm', 'mm')}, of which "
        f"{_fine(record, 'limits.rms_in_plane_mm', 'mm')} in the image plane and "
        f"{_fine(record, 'limits.rms_elevational_mm', 'mm')} out of it.</p>",
        '<p class="soft">The upper bar is about the calibration. The lower one is about how the '
        "target was imaged and picked, which no calibration can improve.</p>",
    )


def _comparison(record: dict[str, Any]) -> str:
    beside = record["comparison"]
    if beside is None:
        return ""

    def number(name: str, form: str) -> str:
        return _number(record, f"comparison.{name}", form)

    def length(name: str) -> str:
        return _fine(record, f"comparison.{name}")

    rows = [
        ("residual, root mean square (mm)", length("conventional_rms_mm"), length("rms_mm")),
        (
            "expected error, if errors are independent and Gaussian (mm)"
            if record["prior"] in TUNED
            else "expected error: Gaussian offsets; any offsets within the bound (mm)",
            length("conventional_tre_mm"),
            length("tre_mm"),
        ),
    ]
    if beside["log_density_gain"] is not None:
        gain = f"{number('log_density_gain', '+.1f')} ± {number('log_density_gain_sd', '.1f')}"
        rows.append(("images left out, log density", "0", gain))
    return _section(
        "Comparison with the conventional fit",
        _table(rows, ("", "conventional", escape(record["method"]))),
        as_html(believe(record)),
    )


def _observability(record: dict[str, Any]) -> str:
    sight = record["observability"]
    words = [f"Least well determined: {sight['weakest_direction']}."]
    if usable(record):
        words += certainty(record)
    proved = certificate_words(record)
    if proved is not None:
        words.append(f"{proved[0].upper()}{proved[1:]}.")
    parts = [as_html(words)]
    if usable(record) and record["image_covariance"] is not None:
        covariance = np.array(record["image_covariance"], float)
        sd = np.sqrt(np.diagonal(covariance))
        names = record["image_unknowns"]
        rows = [
            (str(k), escape(_plain(name)), _in_unit(name, float(value)))
            for k, (name, value) in enumerate(zip(names, sd, strict=True), start=1)
        ]
        drawn = svg.matrix_map(
            [_plain(name) for name in names],
            covariance / np.outer(sd, sd),
            "Correlations of the unknowns",
        )
        parts.append(
            f'<div class="grid">{_table(rows, ("", "unknown", "standard deviation"), 2)}'
            f"{_figure(drawn, 'Correlations: orange positive, blue negative.')}</div>"
        )
    return _section("What the images determine", *parts)


def _plain(name: str) -> str:
    """An unknown's name for a person."""
    words = {"v": "shift", "omega": "turn", "log_scale": "pixel size", "log": "", "delay": "delay"}
    body = name.removesuffix("_mm").removesuffix("_rad")
    for short, long in words.items():
        if body == short or body.startswith(short + "_"):
            return f"{long} {body[len(short) + 1 :]}".strip().replace("_", " ")
    return body.replace("_", " ")


def _in_unit(name: str, sd: float) -> str:
    if name.endswith("_rad"):
        return f"{math.degrees(sd):.3g} deg"
    if name == "delay_mm":
        return f"{sd:.3g} mm of distance"
    return f"{100 * sd:.3g} %" if name.startswith("log_") else f"{sd:.3g} mm"


def _facts(record: dict[str, Any]) -> str:
    rows = [
        ("status", f"{record['status']} after {counted(record['iterations'], 'iteration')}"),
        ("images", f"{record['images_used']} used of {record['images']}"),
        ("data", record["data"]),
        ("jaxcal", record["jaxcal_version"]),
        *([("date (UTC)", record["date"])] if "date" in record else []),
        *frames_and_target(record),
        *further_facts(record),
    ]
    short = "" if record["images"] <= LONGEST_LIST else ", without the values of every image"
    return _section(
        "Facts",
        _table([(escape(name), escape(value.replace("+-", "±"))) for name, value in rows], words=2),
        f'<p class="soft">The whole record of the calibration{short} is inside this page '
        "(the element with the id record).</p>",
    )
