"""Claims of the page on accuracy: further laws, stated errors, jumps, held probes, bounds."""

from __future__ import annotations

from claims import ACCURACY, INDEX, Row, claim, column, number, only, percent, span, table

MIXTURE = {"elevation_distribution": "sometimes off-centre"}

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
claim(
    ACCURACY,
    "the predicted TRE is {:.2f} (1.5 mm) and {:.2f} (5 mm) times the actual one, and the "
    "intervals contain it in {:.1f} and {:.1f} %.",
    lambda: (
        *(_mixture("predicted_over_actual")),
        *percent(_mixture("held_at_points")),
    ),
)


def _mixture(of: str) -> list[float]:
    return [only("tre_calibration", of, **MIXTURE, elevation_mm=size) for size in ("1.5", "5")]


def _scales(of: str, method: str, prior: str) -> tuple[float, float]:
    where = {"unknowns": "scale", "method": method, "prior": prior}
    return span(column("tre_calibration_scale", of, **where))


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
claim(
    ACCURACY,
    "X moves by at most {:.2f} SD between such points. If the offsets acquire a mean, or one "
    "image moves away by 3 mm, {:.0f} of {:.0f} paths of 30 images has a step",
    lambda: (
        max(_jumps("largest_step_sds", "own covariances")),
        max(_jumps("paths_above_a_tenth", path)[1] for path in ("mean", "outlier")),
        max(column("continuity", "paths")),
    ),
)
claim(
    ACCURACY,
    "with 12 images {:.0f} and {:.0f} paths have such a step,",
    lambda: (_jumps("paths_above_a_tenth", path)[0] for path in ("mean", "outlier")),
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
    "of {:.0f} others each, {:.0f} and {:.0f}.",
    lambda: (
        column("weak_direction", "other_integral_paths", path="mean")
        + column("weak_direction", "other_integral_above_a_tenth")
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


claim(
    ACCURACY,
    "contain the truth in {:.1f} to {:.1f} %, on average over the parameters; if every frame "
    "counted as an image, in {:.1f} to {:.1f} %.",
    lambda: percent(
        [
            *span(_frames("cover_95_mean", "calibrate", HOLDS + SWEEPS)),
            *span(_frames("cover_95_mean", "every frame", ("3 holds x 20", *HOLDS, *SWEEPS))),
        ]
    ),
)
claim(
    ACCURACY,
    "Of 40 or 100 frames along a slow path, whose errors have a correlation of 0, 0.3 or 0.6 in "
    "successive frames, the intervals of `calibrate` contain it in {:.1f} to {:.1f} %; if every "
    "frame counted as an image, in {:.1f} to {:.1f} %.",
    lambda: percent(
        [
            *span(_frames("cover_95_mean", "calibrate", PATHS)),
            *span(_frames("cover_95_mean", "every frame", PATHS)),
        ]
    ),
)
claim(
    ACCURACY,
    "Of 24 frames with a correlation of 0.6 it is {:.1f} %. In a random order of the poses it is "
    "{:.1f} % with that correlation.",
    lambda: percent(
        [
            *_frames("cover_95_mean", "calibrate", ("path of 24, correlation 0.6",)),
            *_frames("cover_95_mean", "calibrate", ("random order of 40, correlation 0.6",)),
        ]
    ),
)


def _good() -> list[float]:
    name = "good_outside_99"
    if any(_frames(name, "calibrate", HOLDS)):
        raise ValueError("the page says that it is none of the trials with 4 to 20 poses")
    return percent(span(_frames(name, "calibrate", SWEEPS)))


claim(ACCURACY, "and in {:.1f} to {:.1f} % of the sweeps.", _good)


def _smooth(*counts: str) -> tuple[str, ...]:
    return tuple(f"smooth sweep of {count} s apart" for count in counts)


claim(
    ACCURACY,
    "The intervals of `calibrate` contain the truth in {:.1f} to {:.1f} % only; if every frame "
    "counted as an image, in {:.1f} to {:.1f} %.",
    lambda: percent(
        [
            *span(_frames("cover_95_mean", "calibrate", _smooth(*SMOOTH))),
            *span(_frames("cover_95_mean", "every frame", _smooth(*SMOOTH))),
        ]
    ),
)
claim(
    ACCURACY,
    "By the stated error {:.1f} to {:.1f} % of the sweeps with 20 and 30 images would be good "
    "although the truth is outside a 99 % interval, where it would be {:.1f} to {:.1f} %.",
    lambda: percent(
        [
            *span(_frames("good_outside_99", "calibrate", _smooth(*SMOOTH[1:3]))),
            *span(_frames("good_outside_99", "every frame", _smooth(*SMOOTH[1:3]))),
        ]
    ),
)
claim(
    ACCURACY,
    "Where the offsets are drawn anew for every image of such a path, the intervals contain the "
    "truth in {:.1f} to {:.1f} %.",
    lambda: percent(
        span(
            _frames(
                "cover_95_mean",
                "calibrate",
                tuple(f"sweep of {count}, 0.5 s apart, offsets anew" for count in (12, 20, 30)),
            )
        )
    ),
)
KEPT, ONE_OF_A_TIME = "2.5, at least 60", "1 of a time"


def _one_of_a_time() -> list[float]:
    few, kept = (column("stream_images", "error_mm", kept=rule) for rule in (ONE_OF_A_TIME, KEPT))
    if any(column("stream_images", "refused", kept=KEPT)):
        raise ValueError("the page says that none are refused with these")
    more = span(one / other for one, other in zip(few, kept, strict=True))
    return [*more, max(column("stream_images", "refused", kept=ONE_OF_A_TIME))]


claim(
    ACCURACY,
    "the error of X's translation (RMS) is {:.1f} to {:.1f} times as large as with the images that "
    "`calibrate` keeps, and up to {:.0f} of the 200 recordings are refused,",
    _one_of_a_time,
)
claim(
    ACCURACY,
    "With these images the intervals contain the truth in {:.1f} to {:.1f} %, with all images in "
    "{:.1f} to {:.1f} %.",
    lambda: percent(
        [
            *span(column("stream_images", "cover_95_mean", kept=KEPT)),
            *span(column("stream_images", "cover_95_mean", kept="all")),
        ]
    ),
)
claim(
    ACCURACY,
    "In these the error of X's translation is {:.2f} to {:.2f} mm (RMS), and {:.2f} to {:.2f} mm "
    "if every frame counted.",
    lambda: [
        *span(_frames("error_mm", "calibrate", SWEEPS)),
        *span(_frames("error_mm", "every frame", SWEEPS)),
    ],
)


# Bounded and uniform offsets.
claim(
    ACCURACY,
    "exceeds the upper end of its 95 % interval in at most {:.1f} % of the recordings (by the "
    "covariance alone: in up to {:.1f} %).",
    lambda: [
        max(percent(column("sharp_limits", name)))
        for name in ("good_and_wrong", "stated_good_and_wrong")
    ],
)
claim(
    ACCURACY,
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
