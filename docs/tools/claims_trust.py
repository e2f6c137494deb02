"""Claims of the pages on accuracy and on the verdict: laws, stated errors, jumps, held probes."""

from __future__ import annotations

from claims import (
    ACCURACY,
    INDEX,
    MIXTURE,
    VERDICT,
    Row,
    claim,
    column,
    number,
    only,
    percent,
    span,
    table,
)

# Further laws.
claim(
    INDEX,
    "| {:.2f} to {:.2f} of conventional's mean error, in {} conditions,",
    lambda: (*span(column("further_laws", "auto_over_conventional")), len(further())),
)
claim(ACCURACY, "and the five distributions with 8 images; {} cells.", lambda: [len(further())])
claim(
    ACCURACY,
    "Ratio to conventional calibration: at worst {:.2f}. For points without covariances it is "
    "{:.2f} in one of them; with 4000 new draws, the {} cells in which any ratio was above 1 are "
    "at {:.2f} to {:.2f}.",
    lambda: (
        max(column("further_laws", "auto_over_conventional")),
        max(column("further_laws", "auto_points_over_conventional")),
        len(table("further_laws_again")),
        *span(column("further_laws_again", "auto_points_over_conventional")),
    ),
)


def further() -> tuple[Row, ...]:
    """Rows of the further laws."""
    return table("further_laws")


def _worst_again() -> Row:
    return max(table("further_laws_again"), key=lambda row: number(row, POINTS))


POINTS = "auto_points_over_alternating"
claim(
    ACCURACY,
    "Ratio to the alternation: at worst {:.2f}; for points without covariances {:.2f} +- {:.2f} "
    "(4000 draws): two-humped offsets of 1 mm and 8 images,",
    lambda: (
        max(column("further_laws_again", "auto_over_alternating")),
        number(_worst_again(), POINTS),
        number(_worst_again(), f"{POINTS}_ci95_half"),
    ),
)


# Stated errors.
NORMAL = {"elevation_distribution": "normal"}


def _scales(of: str, method: str, prior: str, law: dict[str, str] = NORMAL) -> tuple[float, float]:
    where = {"unknowns": "scale", "method": method, "prior": prior}
    return span(column("tre_calibration_scale", of, **where, **law))


claim(
    ACCURACY,
    "the ratio of predicted to actual TRE is {:.2f} to {:.2f} for conventional calibration, "
    "{:.2f} to {:.2f} for the Gaussian joint one, and {:.2f} to {:.2f} for `auto`, for the same "
    "reason. Its intervals contain the actual TRE in {:.1f} to {:.1f} %.",
    lambda: (
        *_scales("predicted_over_actual", "conventional", "auto"),
        *_scales("predicted_over_actual", "joint", "gaussian"),
        *_scales("predicted_over_actual", "joint", "auto"),
        *percent(_scales("held_at_points", "joint", "auto")),
    ),
)
claim(
    ACCURACY,
    "Over recordings of which one in ten has a mean, as `auto` assumes, the ratio is {:.2f} to "
    "{:.2f}, and the intervals contain {:.1f} to {:.1f} % ({:.0f} trials a condition).",
    lambda: (
        *_scales("predicted_over_actual", "joint", "auto", MIXTURE),
        *percent(_scales("held_at_points", "joint", "auto", MIXTURE)),
        *set(column("tre_calibration_scale", "trials", **MIXTURE)),
    ),
)
claim(
    ACCURACY,
    "(20 images, 200 trials, Gaussian): {:.2f} to {:.2f}.",
    lambda: span(
        column(
            "tre_calibration_scale",
            "predicted_over_actual",
            unknowns=("sound-speed", "delay", "sound-speed delay"),
        )
    ),
)


# Jumps.
def _jumps(of: str, path: str) -> list[float]:
    return [only("continuity", of, path=path, images=images) for images in ("12", "30")]


claim(
    ACCURACY,
    "`continuity`: {:.0f} paths between two data sets",
    lambda: [max(column("continuity", "paths"))],
)


def _both(of: str, which: int) -> list[float]:
    """Of the paths to a mean and to an outlier; which: 0 for 12 images, 1 for 30."""
    return [_jumps(of, path)[which] for path in ("mean", "outlier")]


def _unconverged(which: int) -> list[float]:
    whole = max(column("continuity", "paths"))
    return [whole - converged for converged in _both("paths_converged", which)]


claim(
    ACCURACY,
    "X moves by at most {:.2f} SD between such points. If the offsets acquire a mean, or one "
    "image moves away by 3 mm, {:.0f} of {:.0f} paths of 30 images has a step above a tenth of an "
    "SD ({:.2f} and {:.1f} SDs).",
    lambda: (
        max(_jumps("largest_step_sds", "own covariances")),
        max(_both("paths_above_a_tenth", 1)),
        max(column("continuity", "paths")),
        *_both("largest_step_sds", 1),
    ),
)
claim(
    ACCURACY,
    "with 12 images {:.0f} and {:.0f} paths have such a step, the largest of {:.1f} and {:.1f} "
    "SDs. Paths on which some solve did not converge are left out: {:.0f} and {:.0f} with 12 "
    "images, {:.0f} and {:.0f} with 30.",
    lambda: (
        *_both("paths_above_a_tenth", 0),
        *_both("largest_step_sds", 0),
        *_unconverged(0),
        *_unconverged(1),
    ),
)
claim(
    ACCURACY,
    "Of {:.0f} and {:.0f} such paths, {:.0f} and {:.0f} still have a step",
    lambda: (
        column("weak_direction", "default_paths")
        + column("weak_direction", "integral_above_a_tenth")
    ),
)
claim(
    ACCURACY,
    "with 12 images the mean error in the middle of the image is {:.2f} mm, that of prior "
    "`gaussian` {:.2f} mm.",
    lambda: [
        only("weak_direction_error", of, images="12")
        for of in ("integral_mean_mm", "gaussian_mean_mm")
    ],
)

# Held probes.
HOLDS = tuple(f"{count} holds x {60 // count}" for count in (4, 6, 10, 20))
SWEEPS = (
    "sweep 30 s, alike for 0.5 s",
    "sweep 30 s, alike for 1 s",
    "sweep 60 s, alike for 1 s",
)
SMOOTH = ("12, 0.5", "20, 0.5", "30, 0.5", "100, 0.05")
"""Number of images of smooth sweeps, and seconds between them."""
PATHS = tuple(
    f"path of {count}, correlation {share:g}" for count in (40, 100) for share in (0, 0.3, 0.6)
)


def _frames(of: str, frames: str, conditions: tuple[str, ...] | None = None) -> list[float]:
    rows = [
        row
        for row in table("dependent_frames")
        if row["frames_as"] == frames and (conditions is None or row["condition"] in conditions)
    ]
    return [number(row, of) for row in rows if row[of]]


SAME, EVERY = "calibrate, same trials", "every frame"


def _covered(conditions: tuple[str, ...], *frames: str) -> list[float]:
    """Least and largest coverage, %, with each way to count frames."""
    return percent(
        value for how in frames for value in span(_frames("cover_95_mean", how, conditions))
    )


def _smooth(*counts: str) -> tuple[str, ...]:
    return tuple(f"smooth sweep of {count} s apart" for count in counts)


for words, conditions in (
    ("60 frames of 4 to 20 held poses, and sweeps at 20 frames a second", HOLDS + SWEEPS),
    (
        "40 or 100 frames along a slow path, errors of successive frames with a correlation of 0, "
        "0.3 or 0.6",
        PATHS,
    ),
    (
        "12 to 30 images half a second apart, 100 within five seconds: smooth sweeps, whose "
        "offsets change as slowly as the pose",
        _smooth(*SMOOTH),
    ),
    (
        "12 to 30 images half a second apart, offsets drawn anew for every image",
        tuple(f"sweep of {count}, 0.5 s apart, offsets anew" for count in (12, 20, 30)),
    ),
):
    claim(
        VERDICT,
        f"| {words} " + 3 * "| {:.1f} to {:.1f} " + "|",
        lambda conditions=conditions: _covered(conditions, "calibrate", SAME, EVERY),
    )
claim(
    VERDICT,
    "in {:.1f} % for 24 frames along a slow path, and in {:.1f} % for 40 frames in a random order",
    lambda: percent(
        [
            *_frames("cover_95_mean", "calibrate", ("path of 24, correlation 0.6",)),
            *_frames("cover_95_mean", "calibrate", ("random order of 40, correlation 0.6",)),
        ]
    ),
)


def _of_smooth(of: str, frames: str) -> list[float]:
    return percent(_frames(of, frames, _smooth(*SMOOTH)))


for words, of, frames in (
    ("the verdict is good", "verdict_good_outside_99", SAME),
    ("the verdict is fair", "verdict_fair_outside_99", SAME),
    ("good by the stated error alone", "good_outside_99", SAME),
    ("good with every frame an image", "good_outside_99", EVERY),
):
    claim(
        VERDICT,
        f"| {words} " + 4 * "| {:.0f} " + "|",
        lambda of=of, frames=frames: _of_smooth(of, frames),
    )


def _good_and_outside() -> list[float]:
    """Good verdicts in smooth sweeps (of a hundred trials each); and of the other sweeps, in %."""
    outside = "verdict_good_outside_99"
    if any(_frames(outside, SAME, HOLDS)):
        raise ValueError("the page says that it is so with no held poses")
    wrong, good = sum(_of_smooth(outside, SAME)), sum(_of_smooth("verdict_good", SAME))
    return [good, wrong, *span(percent(_frames(outside, SAME, SWEEPS)))]


claim(
    VERDICT,
    "Of the {:.0f} good verdicts {:.0f} have the truth outside. So do not calibrate from one "
    "short, smooth sweep. In the longer sweeps of the first row the verdict is good with the truth "
    "outside in {:.0f} to {:.0f} %,",
    _good_and_outside,
)
TRACKED = tuple(
    f"smooth sweep of {count} s apart, tracker 0.1 mm"
    for count in ("20, 0.5", "30, 0.5", "100, 0.05", "100, 0.2")
)
claim(
    VERDICT,
    "If tracked positions are off by 0.1 mm as well, intervals of such sweeps contain the truth in "
    "{:.1f} to {:.1f} %, and the verdict is good with the truth outside in {:.0f} to {:.0f} % and "
    "fair in {:.0f} to {:.0f} %",
    lambda: [
        value
        for of, how in (
            ("cover_95_mean", "calibrate"),
            ("verdict_good_outside_99", SAME),
            ("verdict_fair_outside_99", SAME),
        )
        for value in span(percent(_frames(of, how, TRACKED)))
    ],
)
KEPT, ONE_OF_A_TIME = "2.5, at least 60", "1 of a time"


def _one_of_a_time() -> list[float]:
    name = "stream_images"
    few, kept, whole = (
        column(name, "error_of_all_mm", kept=rule) for rule in (ONE_OF_A_TIME, KEPT, "all")
    )
    if any(column(name, "refused", kept=KEPT)):
        raise ValueError("the page says that none are refused with these")
    return [
        max(column(name, "refused", kept=ONE_OF_A_TIME)),
        *span(column(name, "accepted_by_all", kept=KEPT)),
        *span(one / other for one, other in zip(few, kept, strict=True)),
        *span(one / other for one, other in zip(whole, kept, strict=True)),
    ]


claim(
    VERDICT,
    "up to {:.0f} of the 200 recordings are refused, but none with the images that `calibrate` "
    "keeps. In the {:.0f} to {:.0f} recordings that are accepted and solved in all ways, the error "
    "of X's translation (RMS) is {:.1f} to {:.1f} times as large; with all images it is {:.1f} to "
    "{:.1f} times.",
    _one_of_a_time,
)
claim(
    VERDICT,
    "With the images that `calibrate` keeps the intervals contain the truth in {:.1f} to {:.1f} %, "
    "with all images in {:.1f} to {:.1f} %.",
    lambda: percent(
        [
            *span(column("stream_images", "cover_95_mean", kept=KEPT)),
            *span(column("stream_images", "cover_95_mean", kept="all")),
        ]
    ),
)


# Bounded and uniform offsets.
claim(
    VERDICT,
    "At most {:.1f} % of the verdicts are wrong (by the covariance alone: up to {:.1f} %).",
    lambda: [
        max(percent(column("sharp_limits", name)))
        for name in ("good_and_wrong", "stated_good_and_wrong")
    ],
)
claim(
    VERDICT,
    "another answer in {:.1f} to {:.1f} % of the recordings with the right bound, and in {:.1f} to "
    "{:.1f} % with `--prior uniform`. The right bound does not help: the error is {:.2f} to {:.2f} "
    "times that of the prior `gaussian`, which has no bound. With twice the right bound, it is "
    "{:.2f} to {:.2f} times.",
    lambda: (
        *span(percent(_of_uniform("told_of", "1"))),
        *span(percent(_of_uniform("told_of", ""))),
        *_over_gaussian("1"),
        *_over_gaussian("2"),
    ),
)


def _of_uniform(of: str, bound: str) -> list[float]:
    """A column of uniform offsets; without a bound, of the prior uniform."""
    return column("sharp_limits", of, elevation_distribution="uniform", bound_mm=bound)


def _over_gaussian(bound: str) -> tuple[float, float]:
    errors, others = (_of_uniform(of, bound) for of in ("error_mm", "gaussian_error_mm"))
    return span([a / b for a, b in zip(errors, others, strict=True)])
