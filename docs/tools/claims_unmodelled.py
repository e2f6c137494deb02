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
    "are named in {:.1f} to {:.1f} % of the recordings of 30 images, in {:.1f} to {:.1f} % of "
    "those of 54.",
    lambda: (
        *_suspects("fault_named", "three images", "30"),
        *_suspects("fault_named", "three images", "54"),
    ),
)


# Errors that the model leaves out.
FAULTS = (
    "scale", "skew", "beside", "slip", "second echo", "curve", "step", "distortion",
    "targets", "lateral", "displaced",
)  # fmt: skip


def _left_out(of: str, *images: str) -> tuple[float, float]:
    return span(percent(column("unmodelled", of, fault=FAULTS, images=images)))


claim(
    ACCURACY,
    "clean recordings {:.1f} to {:.1f} % are reported to have such an error, and of those with the "
    "sound speed estimated {:.1f} to {:.1f} %.",
    lambda: (
        *span(percent(column("unmodelled", "told_of", fault="none"))),
        *span(percent(column("unmodelled", "told_of", fault="none, sound speed estimated"))),
    ),
)
claim(
    ACCURACY,
    "All but the last are named in {:.1f} to {:.1f} % of the recordings with 30 and 60 images, in "
    "{:.1f} to {:.1f} % of those with 12.",
    lambda: (*_left_out("right", "30", "60"), *_left_out("right", "12")),
)
claim(
    ACCURACY,
    "end of its 95 % interval in at most {:.1f} % with 30 and 60 images (by the covariance alone: "
    "{:.1f} to {:.1f} %), and in up to {:.1f} % with 12 ({:.1f} to {:.1f} %).",
    lambda: (
        _left_out("good_and_wrong", "30", "60")[1],
        *_left_out("stated_good_and_wrong", "30", "60"),
        _left_out("good_and_wrong", "12")[1],
        *_left_out("stated_good_and_wrong", "12"),
    ),
)
claim(
    ACCURACY,
    "The distortion is named in {:.1f} % of the recordings with 12 images, {:.1f} % with 30 and "
    "{:.1f} % with 60.",
    lambda: percent(column("unmodelled", "right", fault="distortion")),
)

claim(
    ACCURACY,
    "Markers that are wrong from one side (in half of the orientations turned by 1.2 degrees and "
    "moved by one mm) are named in {:.1f} % of the recordings with 12 images, {:.1f} % with 30 and "
    "{:.1f} % with 60; the verdict is good or fair although the error exceeds the end of its "
    "interval in {:.1f}, {:.1f} and {:.1f} % (by the covariance alone: {:.1f}, {:.1f} and "
    "{:.1f} %).",
    lambda: percent(
        each
        for of in ("right", "good_and_wrong", "stated_good_and_wrong")
        for each in column("unmodelled", of, fault="marker")
    ),
)

claim(
    ACCURACY,
    "Two targets are named in {:.1f} % of the recordings with 30 images that show them and in "
    "{:.1f} % with 60, and in at most {:.1f} % of the clean ones.",
    lambda: (
        *percent(column("unmodelled", "right", fault="targets", images=("30", "60"))),
        max(percent(column("unmodelled", "two_targets", fault="none"))),
    ),
)


# The same in times of flight.
MANY = ("30", "60")
TIMES_FAULTS = (
    "speed", "beside", "slip", "step", "displaced", "distortion", "marker", "targets",
)  # fmt: skip


def _of_times(of: str, *faults: str, images: tuple[str, ...] = ("12", *MANY)) -> list[float]:
    return list(span(percent(column("unmodelled_times", of, fault=faults, images=images))))


claim(
    ACCURACY,
    "Of the clean ones {:.1f} to {:.1f} % are reported to have such an error. The sound speed of "
    "the curved array, 3 % too high, is named in at least {:.1f} %. A slip, a step, a displaced "
    "target, a distortion and two targets are named in {:.1f} to {:.1f} % of the recordings with "
    "30 and 60 images, wrong markers in {:.1f} to {:.1f} %. With all faults the verdict is good "
    "or fair although the error exceeds the upper end of its 95 % interval in at most {:.1f} % "
    "(by the covariance alone: up to {:.1f} %). Targets 6 mm to one side of the plane are hardly "
    "noticed with 30 and 60 images ({:.1f} to {:.1f} %):",
    lambda: (
        *_of_times("told_of", "none"),
        _of_times("right", "speed")[0],
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


claim(
    ACCURACY,
    "Without a lag, the import tells of one in at most {:.1f} % of the recordings, and the verdict "
    "names one in at most {:.1f} %.",
    lambda: percent(_lag(of, "0")[1] for of in ("told_at_import", "told_by_verdict")),
)
claim(
    ACCURACY,
    "A lag of 20 ms is named by the verdict in at least {:.1f} %, of 50 or 100 ms in at least "
    "{:.1f} %; the import tells of 50 ms in at least {:.1f} %, of 100 ms in at least {:.1f} %.",
    lambda: percent(
        [
            _lag("told_by_verdict", "0.02")[0],
            _lag("told_by_verdict", "0.05", "0.1")[0],
            _lag("told_at_import", "0.05")[0],
            _lag("told_at_import", "0.1")[0],
        ]
    ),
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
    "With a lag of 100 ms the verdict is good or fair in {:.1f} to {:.1f} %; with the lag of the "
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
    "is named as poses that are out of step in at least {:.1f} %. The verdict is good or fair "
    "although the error exceeds the upper end of its 95 % interval in at most {:.1f} %.",
    lambda: percent(
        [
            min(column("lag", "other_told", images="100", lag_s="0.2")),
            max(column("lag", "good_and_wrong")),
        ]
    ),
)
