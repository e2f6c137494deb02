"""Claims of the page on accuracy: false alarms, and errors that the model leaves out."""

from __future__ import annotations

from claims import ACCURACY, claim, column, percent, span


# False alarms.
def _suspects(of: str, fault: str, *images: str) -> tuple[float, float]:
    return span(percent(column("suspects", of, fault=fault, images=images)))


claim(
    ACCURACY,
    "in {:.1f} to {:.1f} % of the recordings with 30 and 54 images; with 200 it is {:.1f} to "
    "{:.1f} %,",
    lambda: (*_suspects("suspects", "none", "30", "54"), *_suspects("suspects", "none", "200")),
)
claim(
    ACCURACY,
    "Some image is named as an outlier in {:.1f} to {:.1f} % of the recordings with uniform and "
    "normal offsets; with heavy-tailed ones it is {:.1f}, {:.1f} and {:.1f} % (30, 54 and 200 "
    "images),",
    lambda: percent(
        [
            *span(
                column(
                    "suspects",
                    "outliers",
                    fault="none",
                    elevation_distribution=("uniform", "normal"),
                )
            ),
            *column("suspects", "outliers", fault="none", elevation_distribution="heavy-tailed"),
        ]
    ),
)
claim(
    ACCURACY,
    "Errors that grow with depth are named in {:.1f} to {:.1f} % of the recordings with 30 images, "
    "{:.1f} to {:.1f} % with 54, and {:.1f} to {:.1f} % with 200.",
    lambda: [
        share for images in ("30", "54", "200") for share in _suspects("said_depth", "none", images)
    ],
)
claim(
    ACCURACY,
    "are named in {:.1f} to {:.1f} % of the recordings of 30 images, in {:.1f} to {:.1f} % of "
    "those of 54.",
    lambda: (
        *_suspects("fault_named", "three images", "30"),
        *_suspects("fault_named", "three images", "54"),
    ),
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
    ACCURACY,
    "clean recordings {:.1f} to {:.1f} % are reported to have such an error, and of those with the "
    "sound speed estimated {:.1f} to {:.1f} %.",
    lambda: (
        *span(percent(column("unmodelled", "told_of", fault="none"))),
        *span(percent(column("unmodelled", "told_of", fault="none, sound speed estimated"))),
    ),
)
for fault, words in FAULTS.items():
    claim(
        ACCURACY,
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


claim(ACCURACY, "None of {:.0f} means at most {:.1f} % (95 % interval).", _never)


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
    ACCURACY,
    "a slip, a skew and a lateral scale are named in all {:.0f} recordings with 60 images,",
    _named_and_good,
)


def _clean_targets() -> list[float]:
    if any(column("unmodelled", "two_targets", fault=CLEAN)):
        raise ValueError("the page says that no clean recording shows two targets")
    return [sum(column("unmodelled", "trials", fault=CLEAN))]


CLEAN = ("none", "none, sound speed estimated")
claim(ACCURACY, "Two targets are reported in none of the {:,.0f} clean recordings.", _clean_targets)


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
    ACCURACY,
    "Of the clean ones {:.1f} to {:.1f} % are reported to have such an error. The sound speed of "
    "the curved array, 3 % too high, is named in all {:.0f}. A slip, a step, a displaced target, a "
    "distortion and two targets are named in {:.0f} to {:.0f} % of the recordings with 30 and 60 "
    "images, wrong markers in {:.0f} to {:.0f} %. With all faults the verdict is good or fair "
    "although the error exceeds the upper end of its 95 % interval in at most {:.0f} % (by the "
    "covariance alone: up to {:.0f} %). Targets 6 mm to one side of the plane are hardly noticed "
    "with 30 and 60 images ({:.0f} to {:.0f} %):",
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


def _none_at_import() -> float:
    if any(column("lag", "told_at_import", lag_s="0")):
        raise ValueError("the page says that the import reports none without a lag")
    (trials,) = set(column("lag", "trials", lag_s="0"))
    return trials


claim(
    ACCURACY,
    "Without a lag, the import reports one in none of {:.0f} recordings of each kind, and the "
    "verdict names one in at most {:.1f} %.",
    lambda: (_none_at_import(), *percent([_lag("told_by_verdict", "0")[1]])),
)
claim(
    ACCURACY,
    "A lag of 20 ms is named by the verdict in at least {:.0f} %, of 50 or 100 ms in all of "
    "{:.0f}; the import reports one of 50 ms in at least {:.0f} %, of 100 ms in at least {:.0f} %.",
    lambda: [
        100 * _lag("told_by_verdict", "0.02")[0],
        _all_of("lag", "told_by_verdict", lag_s=("0.05", "0.1")),
        100 * _lag("told_at_import", "0.05")[0],
        100 * _lag("told_at_import", "0.1")[0],
    ],
)
claim(
    ACCURACY,
    "The lags that the verdict names are {:.1f} to {:.1f} ms off (RMS), those of the import {:.1f} "
    "to {:.1f} ms.",
    lambda: [
        1000 * error
        for of in ("verdict_error_s", "import_error_s")
        for error in _lag(of, "0.02", "0.05", "0.1", "0.2")
    ],
)
claim(
    ACCURACY,
    "Without a lag the verdict names another error in at most {:.1f} % of the recordings with "
    "independent errors, and in at most {:.1f} % of those with errors that are alike in successive "
    "images.",
    lambda: percent(
        max(column("lag", "other_told", lag_s="0", alike=alike)) for alike in ("0", "0.6")
    ),
)
claim(
    ACCURACY,
    "With a lag of 100 ms the verdict is good or fair in {:.0f} to {:.0f} %; with the lag of the "
    "import stated, the median error falls from {:.2f} to {:.2f} mm to {:.2f} to {:.2f} mm, where "
    "recordings without a lag have {:.2f} to {:.2f} mm.",
    lambda: (
        *percent(_lag("good_or_fair", "0.1")),
        *_lag("error_mm", "0.1"),
        *_lag("error_once_stated_mm", "0.1"),
        *_lag("error_mm", "0"),
    ),
)
claim(
    ACCURACY,
    "is named as poses that are out of step in all of {:.0f}: the line of named lags falls to zero "
    "there. The verdict is good or fair although the error exceeds the upper end of its 95 % "
    "interval in at most {:.0f} %.",
    lambda: (
        _all_of("lag", "other_told", images="100", lag_s="0.2"),
        100 * max(column("lag", "good_and_wrong")),
    ),
)
