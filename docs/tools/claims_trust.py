"""Claims of the page on accuracy: further laws, stated errors, jumps, held probes, false alarms."""

from __future__ import annotations

import itertools

import numpy as np
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
claim(
    ACCURACY,
    "In these the error of X's translation is {:.2f} to {:.2f} mm (RMS), and {:.2f} to {:.2f} mm "
    "if every frame counted.",
    lambda: [
        *span(_frames("error_mm", "calibrate", SWEEPS)),
        *span(_frames("error_mm", "every frame", SWEEPS)),
    ],
)


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
    "targets", "lateral",
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
    "The fault is named in {:.1f} to {:.1f} % of the recordings with 30 and 60 images, in {:.1f} "
    "to {:.1f} % of those with 12.",
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
    "Two targets are named in {:.1f} % of the recordings with 30 images that show them and in "
    "{:.1f} % with 60, and in at most {:.1f} % of the clean ones.",
    lambda: (
        *percent(column("unmodelled", "right", fault="targets", images=("30", "60"))),
        max(percent(column("unmodelled", "two_targets", fault="none"))),
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


# The bench.
def _bench(poses: str, *columns: str) -> list[float]:
    return [only("pose_design_benches", name, poses=poses) for name in columns]


def _bounds() -> list[float]:
    """The least TRE over that of random poses, and how far above it the plans are at most, in %."""
    planned, least = (
        np.array(column("pose_design_bound", f"{name}_over_random"))
        for name in ("planned", "least")
    )
    return [*least, max(100 * (planned / least - 1))]


claim(
    ACCURACY,
    "is at least {:.2f}, {:.2f}, {:.2f} and {:.2f} of that of random poses (8, 12, 30 and 60 "
    "images, 40 degrees), and {:.2f}, {:.2f}, {:.2f} and {:.2f} (10 degrees); the plans are "
    "at most {:.1f} % above",
    _bounds,
)


def _foreseen(of: str, *laws: str) -> tuple[float, float]:
    return span(
        column("pose_design_predicted", f"{of}_over_actual", **({"law": laws} if laws else {}))
    )


claim(
    ACCURACY,
    "predicts a TRE that is {:.2f} to {:.2f} times the actual one of `auto`, in {:.0f} cells of "
    "{:.0f} recordings: five distributions, planned and random poses, both limits of tilt, {:.0f} "
    "to {:.0f} images",
    lambda: (
        *_foreseen("simulated"),
        len(column("pose_design_predicted", "simulated_over_actual")),
        *set(column("pose_design_predicted", "trials")),
        *span(column("pose_design_predicted", "images")),
    ),
)
claim(
    ACCURACY,
    "It is {:.2f} to {:.2f} times the actual TRE for normal, triangular and heavy-tailed offsets, "
    "up to {:.2f} times for uniform ones, whose edges `auto` finds in many images, and {:.2f} to "
    "{:.2f} times for one-sided ones,",
    lambda: (
        *_foreseen("planned", "normal", "triangular", "heavy-tailed"),
        _foreseen("planned", "uniform")[1],
        *_foreseen("planned", "one-sided"),
    ),
)


BOTH = ("tre_mm", "tre_error_mm")
claim(
    ACCURACY,
    "TRE {:.3f} +- {:.3f} mm against {:.3f} +- {:.3f}, RP {:.3f} +- {:.3f} mm against {:.3f} +- "
    "{:.3f} (one standard error). 36 of the Sobol plan: {:.3f} mm.",
    lambda: (
        *_bench("optimal 36", *BOTH),
        *_bench("sobol 60", *BOTH),
        *_bench("optimal 36", "rp_mm", "rp_error_mm"),
        *_bench("sobol 60", "rp_mm", "rp_error_mm"),
        *_bench("sobol 36", "tre_mm"),
    ),
)
claim(
    ACCURACY,
    "On {:.0f} emulated benches 36 planned poses",
    lambda: _bench("optimal 36", "benches"),
)


def _one_sided() -> tuple[float, float]:
    ratios = column(
        "pose_design",
        "predicted_over_actual",
        law="one-sided",
        method="auto",
        images=("8", "12", "30"),
        poses=("random", "optimal"),
    )
    return span(1 / ratio for ratio in ratios)


claim(
    ACCURACY,
    "up to 30 images the actual TRE is {:.1f} to {:.1f} times what `auto` predicts,",
    _one_sided,
)


def _over_five_laws(of: str, cone: str) -> float:
    """The largest over the numbers of images, of the mean over the laws."""
    where = {"cone": cone, "poses": "optimal", "method": "auto"}
    counts = (column("pose_design", of, images=images, **where) for images in ("12", "30", "60"))
    return max(sum(values) / len(values) for values in counts)


claim(
    ACCURACY,
    "the mean of the five ratios (planned to random poses) is at most {:.2f} (TRE) and {:.2f} "
    "(RP) with 40 degrees, {:.2f} and {:.2f} with 10 degrees.",
    lambda: [
        _over_five_laws(of, cone)
        for cone in ("wide", "narrow")
        for of in ("tre_over_random", "rp_over_random")
    ],
)


SYMMETRIC = ("uniform", "normal", "heavy-tailed", "triangular")


def _standard_errors(*arms: str) -> tuple[float, float]:
    """Of the table's ratios of root mean squares over the laws, in %."""
    found = []
    for arm, cone, images, of in itertools.product(
        arms, ("wide", "narrow"), ("12", "30", "60"), ("tre", "rp")
    ):
        squared = 0.0
        for poses in (arm, "random"):
            where = {"cone": cone, "images": images, "poses": poses, "method": "auto"}
            means, errors = (
                np.array(column("pose_design", f"{of}_{what}", law=SYMMETRIC, **where))
                for what in ("mm", "error_mm")
            )
            squared += np.sum((means * errors) ** 2) / np.sum(means**2) ** 2
        found.append(100 * squared**0.5)
    return span(found)


claim(
    ACCURACY,
    "One standard error is {:.1f} to {:.1f} % (re-planned: {:.1f} to {:.1f} %).",
    lambda: (
        *_standard_errors("sobol", "optimal", "wrong+", "wrong-"),
        *_standard_errors("replanned"),
    ),
)


def _filled(of: str, *shares: str, poses: str = "planned") -> list[float]:
    """Of the recordings whose ranges are too long towards the sides."""
    where = {"poses": poses, "curve_mm": "1", "space_filling": shares}
    return list(span(column("plan_faults", of, **where)))


claim(
    ACCURACY,
    "If no planned pose fills space, the error is reported in {:.0f} to {:.0f} % of the "
    "recordings, and in {:.0f} to {:.0f} % the verdict is good or fair although the error exceeds "
    "the upper end of its 95 % interval. If a tenth fills space, these are {:.0f} to {:.0f} % and "
    "at most {:.1f} %; if a fifth does, {:.0f} % and {:.0f} %.",
    lambda: [
        *percent(_filled("told_of", "0")),
        *percent(_filled("good_and_wrong", "0")),
        *percent(_filled("told_of", "0.1")),
        *percent(_filled("good_and_wrong", "0.1")[1:]),
        *percent(_filled("told_of", "0.2")[:1]),
        *percent(_filled("good_and_wrong", "0.2")[1:]),
    ],
)
claim(
    ACCURACY,
    "{:.2f} to {:.2f} mm (TRE, a fifth fills space), at random poses by {:.2f} to {:.2f} mm.",
    lambda: (*_filled("tre_mm", "0.2"), *_filled("tre_mm", "", poses="random")),
)


# The certificate.
def _certified(*images: str) -> float:
    where = {"family": "all", "estimate": "all", "images": images}
    sums = [sum(column("closed_form_study", name, **where)) for name in ("certified", "problems")]
    return 100 * sums[0] / sums[1]


def _none(name: str) -> None:
    if only("closed_form_study", name, family="all", estimate="all", images="4-50"):
        raise ValueError(f"the page says that closed_form_study has none that is {name}")


def _closed_form() -> list[float]:
    _none("above_64_descents")
    _none("false_certificates")
    whole = {"family": "all", "estimate": "all", "images": "4-50"}
    problems = only("closed_form_study", "problems", **whole)
    return [problems, _certified("8"), _certified("12-19", "20-50")]


claim(
    ACCURACY,
    "compares {:,.0f} random problems, degenerate ones among them, with Levenberg-Marquardt from "
    "64 starts. In none of them is the closed form above its best by more than 1e-9, and no "
    "certificate is false. A certificate is found for {:.2f} % of the problems with 8 images and "
    "{:.2f} % of those with 12 or more.",
    _closed_form,
)
