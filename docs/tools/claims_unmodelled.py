"""Claims of the page on the verdict: false alarms, faults, and images that lag."""

from __future__ import annotations

from claims import VERDICT, claim, column, number, percent, span, table


# Wrong frames and units.
def _wrong_frames() -> list[float]:
    """How many recordings, and faults; that all but those on the page are named or refused."""
    unseen = {
        ("u mirrored", "mm"),
        ("u mirrored", "px, known"),
        ("u mirrored", "px, unknown"),
        ("u and v swapped", "px, unknown"),
        ("poses in cm", "px, unknown"),
    }
    rows = table("wrong_frames")
    (recordings,) = {number(row, "recordings") for row in rows}
    for row in rows:
        told = number(row, "named") + number(row, "refused")
        right = row["slip"] == "none" or (row["slip"], row["form"]) in unseen
        if told != (0 if right else recordings):
            raise ValueError(f"the page says otherwise of {row['slip']}, {row['form']}")
    if column("wrong_frames", "good_or_fair", slip="poses in cm") != [0, 0, 0]:
        raise ValueError("the page says that poses in cm are never good or fair")
    return [recordings, len({row["slip"] for row in rows} - {"none"})]


claim(
    VERDICT,
    "`wrong_frames`: {:.0f} recordings, in mm, in pixels of known and in pixels of unknown size, "
    "as they are and with each of {:.0f} faults",
    _wrong_frames,
)


# False alarms.
def _suspects(of: str, fault: str, *images: str) -> tuple[float, float]:
    return span(percent(column("suspects", of, fault=fault, images=images)))


def _outliers(images: str, *laws: str) -> list[float]:
    """Share of clean recordings in which an image is named as an outlier, %, for each law."""
    where = {"fault": "none", "images": images, "elevation_distribution": laws}
    return percent(column("suspects", "outliers", **where))


COUNTS = ("30", "54", "200")
for what, of in (
    ("a suspicious image", "suspects"),
    ("errors that grow with depth (right: the simulated ones do)", "said_depth"),
):
    claim(
        VERDICT,
        f"| {what} " + 3 * "| {:.1f} to {:.1f} " + "|",
        lambda of=of: [share for images in COUNTS for share in _suspects(of, "none", images)],
    )
claim(
    VERDICT,
    "| an outlier, uniform and normal offsets " + 3 * "| {:.1f} to {:.1f} " + "|",
    lambda: [share for images in COUNTS for share in span(_outliers(images, "uniform", "normal"))],
)
claim(
    VERDICT,
    "| an outlier, heavy-tailed offsets | {:.1f} | {:.1f} | {:.1f} |",
    lambda: [*(share for images in COUNTS for share in _outliers(images, "heavy-tailed"))],
)
claim(
    VERDICT,
    "at least one of them is named in {:.1f} to {:.1f} % of the recordings of 30 images, in "
    "{:.1f} to {:.1f} % of those of 54 and in {:.1f} to {:.1f} % of those of 200.",
    lambda: [
        share for images in COUNTS for share in _suspects("fault_named", "three images", images)
    ],
)


# Errors that the model leaves out.
FAULTS = {
    "scale": "ranges 4 % too long (a wrong sound speed)",
    "skew": "lateral positions off by 3 % of the depth",
    "lateral": "lateral positions 4 % too long, sound speed estimated",
    "curve": "ranges 1 mm too long at 20 mm to the side, by the square of the lateral position",
    "beside": "all targets 6 mm to one side of the plane",
    "second echo": "a part of the images 5 mm too deep (a second echo)",
    "slip": "the image moves by 2 mm on the probe during the recording",
    "step": "the image moves by 2 mm at once, before the last quarter",
    "displaced": "the target moves by 2 mm before the last quarter",
    "targets": "a second target, 12 mm from the first, in a third of the images",
    "distortion": "tracked positions off by 1 mm (RMS) near a piece of metal",
    "marker": "markers wrong from one side (1.2 degrees, 1 mm)",
}


def _fault(of: str, fault: str) -> list[float]:
    """With 12, 30 and 60 images, %; rounded to what a share of 200 can be."""
    return [round(value, 1) for value in percent(column("unmodelled", of, fault=fault))]


claim(
    VERDICT,
    "clean recordings {:.1f} to {:.1f} % are reported to have such an error, and of those with the "
    "sound speed estimated {:.1f} to {:.1f} %.",
    lambda: (
        *span(percent(column("unmodelled", "told_of", fault="none"))),
        *span(percent(column("unmodelled", "told_of", fault="none, sound speed estimated"))),
    ),
)
for fault, words in FAULTS.items():
    claim(
        VERDICT,
        f"| {words} " + 4 * "| {:g} / {:g} / {:g} " + "|",
        lambda fault=fault: [
            share
            for of in ("right", "good_or_fair", "good_and_wrong", "stated_good_and_wrong")
            for share in _fault(of, fault)
        ],
    )


def _never() -> list[float]:
    """The upper end of the exact 95 % interval of a share that is none of so many."""
    (trials,) = set(column("unmodelled", "trials", fault=tuple(FAULTS)))
    return [trials, 100 * (1 - 0.025 ** (1 / trials))]


claim(VERDICT, "None of {:.0f} means at most {:.1f} % (95 % interval).", _never)


def _named_and_good() -> list[float]:
    """Lateral and skewed positions and a slip with 60 images: all named, all good or fair."""
    where = {"fault": ("skew", "lateral", "slip"), "images": "60"}
    shares = [
        *column("unmodelled", "right", **where),
        *column("unmodelled", "good_or_fair", **where),
    ]
    if set(shares) != {1.0}:
        raise ValueError("the page says that all are named and good or fair")
    return [*set(column("unmodelled", "trials", **where))]


claim(
    VERDICT,
    "a slip, a skew and a lateral scale are named in all {:.0f} recordings with 60 images,",
    _named_and_good,
)


def _clean_targets() -> list[float]:
    if any(column("unmodelled", "two_targets", fault=CLEAN)):
        raise ValueError("the page says that no clean recording shows two targets")
    return [sum(column("unmodelled", "trials", fault=CLEAN))]


CLEAN = ("none", "none, sound speed estimated")
claim(VERDICT, "Two targets are reported in none of the {:,.0f} clean recordings.", _clean_targets)


# The same in times of flight.
MANY = ("30", "60")
TIMES_FAULTS = (
    "speed", "beside", "slip", "step", "displaced", "distortion", "marker", "targets",
)  # fmt: skip


def _all_of(name: str, of: str, **where: str | tuple[str, ...]) -> float:
    """The trials of each of these rows, in all of which it was so."""
    if set(column(name, of, **where)) != {1.0}:
        raise ValueError(f"the page says that {of} of {name} is so in all of {where}")
    (trials,) = set(column(name, "trials", **where))
    return trials


def _of_times(of: str, *faults: str, images: tuple[str, ...] = ("12", *MANY)) -> list[float]:
    return list(span(percent(column("unmodelled_times", of, fault=faults, images=images))))


claim(
    VERDICT,
    "Of the clean ones {:.1f} to {:.1f} % are reported to have such an error. The sound speed of "
    "the curved array, 3 % too high, is named in all {:.0f}. A slip, a step, a displaced target, a "
    "distortion and two targets are named in {:.0f} to {:.0f} % of the recordings with 30 and 60 "
    "images, wrong markers in {:.0f} to {:.0f} %. Over all faults, at most {:.0f} % of the "
    "verdicts are wrong (by the covariance alone: up to {:.0f} %). Targets 6 mm to one side of the "
    "plane are hardly noticed with 30 and 60 images ({:.0f} to {:.0f} %):",
    lambda: (
        *_of_times("told_of", "none"),
        _all_of("unmodelled_times", "right", fault="speed"),
        *_of_times("right", "slip", "step", "displaced", "distortion", "targets", images=MANY),
        *_of_times("right", "marker", images=MANY),
        _of_times("good_and_wrong", *TIMES_FAULTS)[1],
        _of_times("stated_good_and_wrong", *TIMES_FAULTS)[1],
        *_of_times("right", "beside", images=MANY),
    ),
)


# Images that lag behind their poses.
def _lag(of: str, *lags: str) -> tuple[float, float]:
    return span(column("lag", of, lag_s=lags))


for words, lag in (("none", "0"), ("20 ms", "0.02"), ("50 ms", "0.05"), ("100 ms", "0.1")):
    claim(
        VERDICT,
        f"| {words} | {{:.0f}} to {{:.0f}} % | {{:.1f}} to {{:.1f}} % | {{:.0f}} to {{:.0f}} % "
        "| {:.2f} to {:.2f} | {:.2f} to {:.2f} |",
        lambda lag=lag: (
            *percent(
                share
                for of in ("told_at_import", "told_by_verdict", "good_or_fair")
                for share in _lag(of, lag)
            ),
            *_lag("error_mm", lag),
            *_lag("error_once_stated_mm", lag),
        ),
    )
claim(
    VERDICT,
    "The lags that the verdict names are {:.1f} to {:.1f} ms off (RMS), those of the import {:.1f} "
    "to {:.1f} ms. At most {:.0f} % of the verdicts are wrong.",
    lambda: [
        *(
            1000 * error
            for of in ("verdict_error_s", "import_error_s")
            for error in _lag(of, "0.02", "0.05", "0.1", "0.2")
        ),
        100 * max(column("lag", "good_and_wrong")),
    ],
)
claim(
    VERDICT,
    "Without a lag the verdict names another error in at most {:.1f} % of the recordings with "
    "independent errors, and in at most {:.1f} % of those with errors that are alike in successive "
    "images.",
    lambda: percent(
        max(column("lag", "other_told", lag_s="0", alike=alike)) for alike in ("0", "0.6")
    ),
)
claim(
    VERDICT,
    "is named as poses that are out of step in all of {:.0f}: the line of named lags falls to zero "
    "there.",
    lambda: [_all_of("lag", "other_told", images="100", lag_s="0.2")],
)
