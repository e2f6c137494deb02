"""Claims of the README, the overview and the page on accuracy."""

from __future__ import annotations

import math
import statistics

from claims import (
    ACCURACY,
    AUTO,
    AUTO_POINTS,
    BAYES,
    BY_GAUSSIAN,
    FITTED,
    INDEX,
    LAWS,
    MIXTURE,
    ONE_SIDED,
    PLACED,
    PLANNED,
    README,
    UNFITTED,
    auto,
    bayes,
    claim,
    column,
    compared,
    covered,
    crosswire_halves,
    fitted,
    number,
    only,
    percent,
    placed,
    poses,
    quantity,
    significant,
    span,
    spoilt,
    table,
    tank_compared,
    tre_span,
    trials,
    within,
    worst_spoilt,
)

from jaxcal.study.offsets import standard_deviation

SIZES = {
    "uniform": " | the bound on both sides | 0",
    "one-sided": " (uniform) | the bound on one side | 0.5 mm",
    "triangular": " | the bound on both sides | 0",
    "normal": " | the SD | 0",
    "heavy-tailed": " (Student's t, 4 degrees of freedom) | the SD | 0",
}
"""What the size of each distribution of the offsets is, and its mean at size 1 mm."""

claim(
    README,
    "| mean error, relative to conventional calibration, in {} conditions with a perfect tracker "
    "(points alone) | {:.2f} to {:.2f} |",
    lambda: (len(auto()), *span(column("auto_grid", AUTO_POINTS))),
)
claim(
    README,
    "| mean error, relative to the best possible (the Bayes limit), median of {} conditions | "
    "{:.2f} |",
    lambda: (len(bayes("50")), statistics.median(bayes("50"))),
)
claim(
    README,
    "| coverage of 95 % intervals, for 6 parameters in {} conditions, if offsets have mean "
    "zero | {:.1f} to {:.1f} % |",
    lambda: (len(table("coverage")), *covered()),
)
claim(
    INDEX,
    "in {} simulated conditions with a perfect tracker, {:.2f} to {:.2f} of its mean error from "
    "points alone; {:.2f} to {:.2f} with covariances from times of flight |",
    lambda: (len(auto()), *span(column("auto_grid", AUTO_POINTS)), *span(auto())),
)
claim(
    INDEX,
    "joint calibration is significantly worse in {} of {} conditions of the emulated tank and "
    "better in {}; on emulated benches its mean error is {:.3f} to {:.3f} mm, that of conventional "
    "calibration {:.3f} to {:.3f} mm |",
    lambda: (
        *tank_compared(),
        *span(placed(name) for name in PLACED),
        *span(placed(name, "conventional") for name in PLACED),
    ),
)
claim(
    INDEX,
    "{:.2f} to {:.2f} times the error of prior `gaussian` in {} conditions, both from points "
    "alone; significantly better in {} and worse in {}",
    lambda: (
        *span(column("auto_grid", BY_GAUSSIAN)),
        len(column("auto_grid", BY_GAUSSIAN)),
        *significant("auto_grid", BY_GAUSSIAN),
    ),
)
claim(
    INDEX,
    "| {:.2f} times the Bayes limit's error (median of {} conditions), {:.2f} at worst |",
    lambda: (statistics.median(bayes("50")), len(bayes("50")), max(bayes("50"))),
)
claim(
    INDEX,
    "95 % intervals cover the truth in {:.1f} to {:.1f} % if the offsets have mean zero; if they "
    "have a mean, in [as few as {:.0f} %]",
    lambda: (*covered(), *percent([min(column("off_centre", "cover_t_elevational"))])),
)
claim(
    INDEX,
    "95 % intervals of TRE contain the actual one in {:.1f} to {:.1f} % for offsets of mean zero; "
    "the predicted TRE is {:.2f} to {:.2f} times the actual one |",
    lambda: (*percent(tre_span("held_at_points")), *tre_span("predicted_over_actual")),
)
claim(
    INDEX,
    "| {:.2f} times the error without the spoilt images, at worst |",
    lambda: [number(worst_spoilt(), "robust_over_oracle")],
)
claim(
    INDEX,
    "{} of {} cells within the paper's mean +- 1 SD, {} within half an SD, after fitting two "
    "choices ({} within one SD unfitted) |",
    lambda: (within("1", FITTED), len(fitted()), within("half", FITTED), within("1", UNFITTED)),
)
claim(
    INDEX,
    "| joint never higher in {:.0f} problems |",
    lambda: [quantity("same_objective_summary", "problems")],
)
claim(
    INDEX,
    "| {:.2f} to {:.2f} of conventional's error |",
    lambda: span(column("curvilinear_joint", "joint_over_conventional")),
)
claim(
    INDEX,
    "| precision within {:.0f} % of that with both known |",
    lambda: [100 * max(abs(v - 1) for v in column("sound_speed_delay", "rp_estimated_over_known"))],
)
claim(
    INDEX,
    "no measurable difference: {:.3f} mm against {:.3f} mm by a steady hand (ratio {:.2f} +- "
    "{:.2f}) |",
    lambda: (
        placed("amplitude scan"),
        placed("free hand"),
        *(
            only("placement", f"joint_over_free_hand{half}", placement="amplitude scan")
            for half in ("", "_ci95_half")
        ),
    ),
)
claim(
    INDEX,
    "| {:,.0f} on two cores |",
    lambda: [round(trials("jaxcal study: trials a second, two cores"), -2)],
)

# Accuracy.
claim(
    ACCURACY,
    "Ratio to conventional calibration: at worst {:.2f} for uniform offsets, {:.2f} for normal, "
    "{:.2f} for one-sided, {:.2f} for heavy-tailed and {:.2f} for triangular ones.",
    lambda: [
        max(column("auto_grid", AUTO, elevation_distribution=law, images="50")) for law in LAWS
    ],
)
claim(
    ACCURACY,
    "With 12, 20 and 200 images: at worst {:.2f}, {:.2f} and {:.2f}. So the ratio is above 1 in "
    "none of {} cells. From points alone it is {:.2f} to {:.2f}.",
    lambda: (
        *(max(column("auto_grid", AUTO, images=images)) for images in ("12", "20", "200")),
        len(auto()),
        *span(column("auto_grid", AUTO_POINTS)),
    ),
)
claim(
    ACCURACY,
    "Without offsets the ratio is still {:.2f} to {:.2f}, and {:.2f} to {:.2f} from points alone:",
    lambda: (
        *span(column("auto_grid", AUTO, elevation_mm="0")),
        *span(column("auto_grid", AUTO_POINTS, elevation_mm="0")),
    ),
)
for law in LAWS:
    claim(
        ACCURACY,
        f"| {law}{SIZES[law]} | {{:.2f}} mm |",
        lambda law=law: [standard_deviation(law)],
    )


claim(
    ACCURACY,
    "is better in no cell: the ratio of auto's error to the alternation's is at worst {:.2f}, and "
    "{:.2f} from points alone.",
    lambda: [
        max(column("auto_grid", f"{name}_over_alternating")) for name in ("auto", "auto_points")
    ],
)


def _hindsight() -> list[object]:
    ratio, points = (
        column("auto_grid", f"hindsight_over_{name}") for name in ("auto", "auto_points")
    )
    return [sum(v < 1 for v in ratio), len(ratio), sum(v < 1 for v in points), min(ratio)]


claim(
    ACCURACY,
    "is better in {} of {} cells ({} if `auto` has points alone), at best by a factor of {:.2f}:",
    _hindsight,
)


def _loses() -> list[float]:
    # Without offsets there is nothing to be better at.
    rows = [row for row in table("auto_grid") if float(row["elevation_mm"]) > 0]
    further = max(table("further_laws"), key=lambda row: number(row, "auto_loses"))
    if (further["elevation_distribution"], further["images"]) != ("off-centre", "8"):
        raise ValueError("the page says that the worst cell is off centre, with 8 images")
    return percent([max(number(row, "auto_loses") for row in rows), number(further, "auto_loses")])


claim(
    ACCURACY,
    "in {:.0f} % of the trials of this table's worst cell, and in {:.0f} % of the worst one of "
    "`further_laws`",
    _loses,
)


# Auto or Gaussian.
def _by_law(law: str) -> list[object]:
    ratios = column("auto_grid", BY_GAUSSIAN, elevation_distribution=law)
    known = significant("auto_grid", BY_GAUSSIAN, elevation_distribution=law)
    return [*span(ratios), *known, len(ratios)]


for law in ("none", *LAWS):
    claim(
        ACCURACY,
        f"| {law} | {{:.2f}} to {{:.2f}} | {{}} | {{}} | {{}} |",
        lambda law=law: _by_law(law),
    )


def _worst_normal() -> tuple[float, float]:
    rows = [row for row in table("auto_grid") if row["elevation_distribution"] != "none"]
    worst = max(rows, key=lambda row: number(row, BY_GAUSSIAN))
    where = worst["elevation_distribution"], worst["elevation_mm"], worst["noise_mm"]
    if where != ("normal", "4", "0.5"):
        raise ValueError(f"the page says where it is largest; it is {where}")
    return number(worst, BY_GAUSSIAN), number(worst, f"{BY_GAUSSIAN}_ci95_half")


claim(
    ACCURACY,
    "most ({:.2f} +- {:.2f}) for offsets of 4 mm and 0.5 mm of noise.",
    _worst_normal,
)
claim(
    ACCURACY,
    "With 12 and 20 images it is better for heavy tails as well, by up to {:.0f} %.",
    lambda: [
        100
        * (
            max(
                column(
                    "auto_grid",
                    BY_GAUSSIAN,
                    elevation_distribution="heavy-tailed",
                    images=("12", "20"),
                )
            )
            - 1
        )
    ],
)
claim(
    ACCURACY,
    "there auto loses up to {:.0f} %. Elsewhere it gains up to {:.0f} %. With covariances from "
    "times of flight the ratio is {:.2f} to {:.2f} in the same cells.",
    lambda: (
        100 * (max(column("auto_grid", BY_GAUSSIAN, elevation_distribution="normal")) - 1),
        100 * (1 - min(column("auto_grid", BY_GAUSSIAN))),
        *span(column("auto_grid", "auto_over_gaussian")),
    ),
)
claim(
    ACCURACY,
    "Auto is worse in up to {:.0f} % of the single trials of a cell.",
    lambda: percent([max(column("auto_grid", "auto_points_loses_to_gaussian"))]),
)
claim(
    ACCURACY,
    "Ratio to conventional calibration: {:.2f} to {:.2f}; the three estimated SDs are {:.3f} to "
    "{:.3f} times those of the errors that were drawn.",
    lambda: (
        *span(column("self_tuned_grid", "joint_over_conventional")),
        *span(
            value
            for name in ("lateral", "range", "elevation")
            for value in column("self_tuned_grid", f"sigma_{name}_over_realised")
        ),
    ),
)
claim(
    ACCURACY,
    "from points alone, it is {:.2f} to {:.2f} times: significantly better in {} of {}, and worse "
    "in {}.",
    lambda: (
        *span(column("further_laws", BY_GAUSSIAN)),
        significant("further_laws", BY_GAUSSIAN)[0],
        len(column("further_laws", BY_GAUSSIAN)),
        significant("further_laws", BY_GAUSSIAN)[1],
    ),
)
SELF_TUNED = "joint, self-tuned"
claim(
    ACCURACY,
    "{} conditions, 448 trials each: significantly better than conventional in {}, and "
    "significantly worse in {}: one-sided offsets of 5 mm at 0.5 mm noise ({:.2f} times).",
    lambda: (
        compared(SELF_TUNED, "cells"),
        compared(SELF_TUNED, "cells_better"),
        compared(SELF_TUNED, "cells_worse"),
        max(column("alternating_vs_joint_summary", "worst_ratio", method=SELF_TUNED)),
    ),
)
claim(
    ACCURACY,
    "auto's mean error is {:.2f} times the limit in the median, {:.2f} times at worst. With 12 "
    "images {:.2f} to {:.2f}, with 20 images {:.2f} to {:.2f}.",
    lambda: (
        statistics.median(bayes("50")),
        max(bayes("50")),
        *span(bayes("12")),
        *span(bayes("20")),
    ),
)
claim(
    ACCURACY,
    "with exact data, {} cells of {} are above 1.20. With 1000 new draws they are at {:.2f} to "
    "{:.2f}:",
    lambda: (
        sum(v > 1.2 for v in bayes("50")),
        len(bayes("50")),
        *span(column("bayes_limit_again", BAYES)),
    ),
)
claim(
    ACCURACY,
    "1000 trials a condition, in {} conditions:",
    lambda: [len(table("coverage"))],
)
for words, of in (
    ("`auto` ([table][coverage])", "coverage"),
    ("conventional ([table][conventional])", "coverage_conventional"),
):
    claim(
        ACCURACY,
        f"| {words} " + 2 * "| {:.1f} to {:.1f} % " + "| {:.2f} to {:.2f} |",
        lambda of=of: (
            *covered(of, images="12"),
            *covered(of, images="50"),
            *span(column(of, "predicted_over_actual")),
        ),
    )
claim(
    ACCURACY,
    "csv)): {:.0f} recordings of {:.0f} images a condition, {:g} mm of noise.",
    lambda: [
        only("tre_calibration", name, **ONE_SIDED, elevation_mm="5")
        for name in ("trials", "images", "noise_mm")
    ],
)
claim(
    ACCURACY,
    "| four distributions with mean zero, {:g} and {:g} mm | {:.1f} to {:.1f} % | {:.2f} to {:.2f} "
    "|",
    lambda: (
        *span(column("tre_calibration", "elevation_mm")),
        *percent(tre_span("held_at_points")),
        *tre_span("predicted_over_actual"),
    ),
)
for words, law, size in (
    ("a mean in one recording of ten (as `auto` assumes), 1.5 mm", MIXTURE, "1.5"),
    ("a mean in one recording of ten, 5 mm", MIXTURE, "5"),
    ("one-sided, 5 mm", ONE_SIDED, "5"),
    ("one-sided, 1.5 mm: their mean cannot be told from a shift of X", ONE_SIDED, "1.5"),
):
    claim(
        ACCURACY,
        f"| {words} | {{:.1f}} % | {{:.2f}} |",
        lambda law=law, size=size: (
            *percent([only("tre_calibration", "held_at_points", **law, elevation_mm=size)]),
            only("tre_calibration", "predicted_over_actual", **law, elevation_mm=size),
        ),
    )
claim(
    ACCURACY,
    "The error is at worst {:.2f} +- {:.2f} times that of the same images without the spoilt "
    "ones. At least {:.1f} % of these are named, and at most {:.1f} % of the clean images. For "
    "clean data it is {:.2f} to {:.2f} times.",
    lambda: (
        number(worst_spoilt(), "robust_over_oracle"),
        number(worst_spoilt(), "ci95_half_of_ratio"),
        100 * min(number(row, "named") for row in spoilt()),
        100 * max(column("outliers", "false_alarms")),
        *span(column("outliers", "robust_over_oracle", fraction="0")),
    ),
)
claim(
    ACCURACY,
    "slipped together, {} of {} trials fail to recognise them, and these two dominate the mean "
    "({:.2f} +- {:.2f}).",
    lambda: (
        worst_spoilt("slip")["trials_with_one_left_in"],
        worst_spoilt("slip")["trials"],
        number(worst_spoilt("slip"), "robust_over_oracle"),
        number(worst_spoilt("slip"), "ci95_half_of_ratio"),
    ),
)


def _noisy_spoilt() -> list[object]:
    where = {"elevation_mm": "5", "noise_mm": "10", "fraction": "0.3", "kind": "mixed"}
    rows = [row for row in spoilt() if all(row[key] == value for key, value in where.items())]
    worst = max(rows, key=lambda row: number(row, "robust_over_oracle"))
    left = [int(row["trials_with_one_left_in"]) for row in rows]
    return [
        *span(number(row, "robust_over_oracle") for row in rows),
        number(worst, "robust_over_oracle"), number(worst, "ci95_half_of_ratio"),
        min(left), max(left), worst["trials"],
    ]  # fmt: skip


claim(
    ACCURACY,
    "the error is {:.2f} to {:.2f} times as large (at worst {:.2f} +- {:.2f}), and some outlier "
    "stays in for {} to {} of {} trials.",
    _noisy_spoilt,
)


def _crosswire(*names: str) -> list[float]:
    return [quantity("crosswire_real", name) for name in names]


claim(
    ACCURACY,
    "(200 splits) are {:.2f} mm apart in the image where their covariances expect {:.2f} mm, and "
    "{:.0f} % are within the limit for 95 %; conventional ones {:.2f} mm where {:.2f} mm are "
    "expected, and {:.1f} %. So the stated errors are {:.1f} (joint) and {:.1f} times "
    "(conventional) what the halves show.",
    lambda: [
        *_crosswire("joint_halves_apart_mm", "joint_halves_expected_mm"),
        100 * quantity("crosswire_real", "joint_halves_agree"),
        *_crosswire("conventional_halves_apart_mm", "conventional_halves_expected_mm"),
        100 * quantity("crosswire_real", "conventional_halves_agree"),
        *(
            quantity("crosswire_real", f"{method}_halves_expected_mm")
            / quantity("crosswire_real", f"{method}_halves_apart_mm")
            for method in ("joint", "conventional")
        ),
    ],
)
claim(
    ACCURACY,
    "reaches an RMS of {:.3f} mm. The default (prior auto) finds errors of {:.2f} mm "
    "lateral, {:.2f} mm axial and {:.2f} mm elevational (SD)",
    lambda: _crosswire(
        "conventional_rms_mm", "sigma_lateral_mm", "sigma_range_mm", "sigma_elevation_mm"
    ),
)
claim(
    ACCURACY,
    "the two methods perform alike: {:.2f} mm (conventional) and {:.2f} mm.",
    lambda: _crosswire("held_out_rms_conventional_mm", "held_out_rms_joint_mm"),
)
claim(
    ACCURACY,
    "beat one common SD by {:.1f} (standard error {:.1f}) in leave-one-out log-likelihood. "
    "Elevational errors have kurtosis {:.1f}, range errors {:.1f};",
    lambda: _crosswire(
        "log_density_gained",
        "log_density_gained_standard_error",
        "kurtosis_elevation",
        "kurtosis_range",
    ),
)
claim(
    ACCURACY,
    "moves X by at most {:.2f} of its stated SD ({:.2f} mm), 200 bootstrap samples scatter by "
    "{:.2f} of it and none by more than {:.1f}; precision on images not used is {:.3f} times "
    "conventional's.",
    lambda: (
        *_crosswire("joint_left_out_largest_shift_sds"),
        math.prod(_crosswire("joint_left_out_largest_shift_sds", "joint_sd_at_lever_mm")),
        *_crosswire(
            "joint_bootstrap_scatter_sds",
            "joint_bootstrap_largest_sds",
            "precision_not_used_over_conventional",
        ),
    ),
)
claim(
    ACCURACY,
    "mean of the offsets (probability {:.2f}), because the residuals are heavy-tailed and "
    "correlated in successive images: {:.2f} of their information",
    lambda: _crosswire("mean_probability", "mean_trust"),
)
claim(
    ACCURACY,
    "({:.0f} of {:.0f}) are left out, and the rest fit to {:.3f} mm; its clean counterpart fits "
    "to {:.3f} mm. The two tips differ by {:.2f} mm.",
    lambda: _crosswire(
        "pivot_outliers_named",
        "pivot_outliers_poses",
        "pivot_outliers_robust_rms_mm",
        "pivot_clean_rms_mm",
        "pivot_tips_apart_mm",
    ),
)
for words, name in (
    ("amplitude scan (robot)", "amplitude scan"),
    ("pattern injection (robot)", "pattern injection"),
    ("threshold climb (robot)", "threshold climb"),
    ("steady free hand", "free hand"),
    ("none, by hand", "none, by hand"),
    ("none, by robot", "none, by robot"),
):
    claim(
        ACCURACY,
        f"| {words} " + 3 * "| {:.3f} " + "| {:.2f} +- {:.2f} |",
        lambda name=name: (
            *(placed(name, method) for method in ("joint", "gaussian", "conventional")),
            *(
                only("placement", f"joint_over_conventional{half}", placement=name)
                for half in ("", "_ci95_half")
            ),
        ),
    )
claim(
    ACCURACY,
    "On the benches of [placement](#placement), auto's error is {:.2f} to {:.2f} times that of "
    "`gaussian`.",
    lambda: span(column("placement", "joint_over_gaussian")),
)
claim(
    ACCURACY,
    "once the target is placed, the offsets have an SD of {:.2f} mm,",
    lambda: {round(sd, 2) for sd in column("placement", "offset_sd_mm", placement=PLACED)},
)
claim(
    ACCURACY,
    "significantly worse than conventional calibration in {} of {} conditions, and better in {} "
    "(`paper_experiment_sensitivity`).",
    tank_compared,
)
claim(
    ACCURACY,
    "the error after its placements is {:.2f} to {:.2f} times that after a free hand with an "
    "equally good tracker (intervals of +- {:.2f} to {:.2f}): no difference is shown.",
    lambda: (
        *span(column("placement", "joint_over_free_hand", placement=PLACED[:3])),
        *span(column("placement", "joint_over_free_hand_ci95_half", placement=PLACED[:3])),
    ),
)
claim(
    ACCURACY,
    "has {:.2f} to {:.2f} of conventional's mean error, and the sign of {:.1f} to {:.1f} %",
    lambda: (
        *span(column("curvilinear_joint", "joint_over_conventional")),
        *percent(span(column("curvilinear_joint", "right_signs"))),
    ),
)
claim(
    ACCURACY,
    "is harmful: {:.2f} to {:.0f} times conventional's.",
    lambda: span(column("curvilinear_joint", "paper_way_over_conventional")),
)
claim(
    ACCURACY,
    "within 2 reported SDs in {:.0f} to {:.0f} % of the trials, with a precision within {:.0f} % "
    "of that with both known. Left at their nominal values, the error is {:.0f} to {:.0f} times as "
    "large.",
    lambda: (
        *percent(
            span(
                v
                for name in ("speed", "delay")
                for v in column("sound_speed_delay", f"{name}_within_2sd")
            )
        ),
        100 * max(abs(v - 1) for v in column("sound_speed_delay", "rp_estimated_over_known")),
        *span(
            number(row, "rp_wrong_mm") / number(row, "rp_known_mm")
            for row in table("sound_speed_delay")
        ),
    ),
)
claim(
    ACCURACY,
    "Normalised squared errors are {:.2f} to {:.2f} (2 is exact), also with a fifth of the lines "
    "missing.",
    lambda: span(
        column(
            "segmentation_accuracy",
            "mean_normalised_squared_error",
            method=("least squares", "least squares, robust"),
            data=("complete", "missing"),
        )
    ),
)
for cone, words in (
    ("wide", "| 40 degrees (turn 90), {} "),
    ("narrow", "| 10 degrees (turn 10), {} "),
):
    for images in ("12", "30", "60"):
        claim(
            PLANNED,
            words.format(images) + 5 * "| {:.2f} / {:.2f} " + "|",
            lambda cone=cone, images=images: poses(cone, images),
        )
claim(
    PLANNED,
    "with a precision of {:.2f} mm (TRE), {:.2f} (RP) and {:.2f} "
    "([D-optimality](../reference/glossary.md)), joint with estimated scales.",
    lambda: crosswire_halves("chosen_rp_mm"),
)
claim(
    PLANNED,
    "The median of {:.0f} random halves is {:.2f} mm (5 to 95 %: {:.2f} to {:.2f}), and "
    "{:.0f}, {:.0f} and {:.0f} % of them are better.",
    lambda: (
        *(crosswire_halves(name)[0] for name in (
            "random_halves", "random_median_mm", "random_5_mm", "random_95_mm")),
        *percent(crosswire_halves("share_better")),
    ),
)  # fmt: skip

# The paper.
