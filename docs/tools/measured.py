"""Where each number of the README and of the results pages comes from.

A claim is a piece of a sentence with places for numbers, and the function that computes these from
a table in ``experiments/results``. ``python docs/tools/measured.py`` lists what is not as the
tables say; ``--write`` puts the tables' present values into the sentences (read them afterwards:
what a number means may have changed with it).
"""

from __future__ import annotations

import csv
import math
import re
import statistics
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "experiments" / "results"

Row = dict[str, str]

README, INDEX, ACCURACY, PAPER, SPEED = PAGES = (
    "README.md",
    "docs/results/index.md",
    "docs/results/accuracy.md",
    "docs/results/paper.md",
    "docs/results/speed.md",
)


@dataclass(frozen=True)
class Claim:
    """A piece of a page with numbers in it.

    Attributes:
        page: path in the repository.
        words: as on the page, with ``{:.2f}`` or the like for each number of a table.
        values: computes these numbers.
    """

    page: str
    words: str
    values: Callable[[], Iterable[object]]

    def text(self) -> str:
        """The piece with the tables' numbers."""
        return self.words.format(*self.values())

    def pattern(self) -> re.Pattern[str]:
        """What finds the piece whatever its numbers are, and however its lines are broken."""
        parts = re.split(r"\{[^}]*\}", self.words)
        fixed = [r"\s+".join(re.escape(word) for word in re.split(r"\s+", part)) for part in parts]
        return re.compile(r"[-\d.,]*\d(?:e-?\d+)?".join(fixed))


CLAIMS: list[Claim] = []


def claim(page: str, words: str, values: Callable[[], Iterable[object]]) -> None:
    """Register a claim."""
    CLAIMS.append(Claim(page, words, values))


@cache
def table(name: str) -> tuple[Row, ...]:
    """A table of ``experiments/results``; rows of which only the first cell is filled are notes."""
    with (RESULTS / f"{name}.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return tuple(row for row in rows if any(list(row.values())[1:]))


def number(row: Row, column: str) -> float:
    """A cell as a number; NaN where it is empty."""
    return float(row[column] or "nan")


def column(name: str, of: str, **where: str | tuple[str, ...]) -> list[float]:
    """The numbers of a column in the rows where others have these values; without NaN."""
    found = []
    for row in table(name):
        if all(row[k] in ((v,) if isinstance(v, str) else v) for k, v in where.items()):
            found.append(number(row, of))
    return [value for value in found if not math.isnan(value)]


def only(name: str, of: str, **where: str) -> float:
    """The one number of a column in the one row that fits."""
    (value,) = column(name, of, **where)
    return value


def quantity(name: str, what: str) -> float:
    """From a table of quantities."""
    return only(name, "value", quantity=what)


def span(values: Iterable[float]) -> tuple[float, float]:
    """Least and largest."""
    values = list(values)
    return min(values), max(values)


def percent(values: Iterable[float]) -> list[float]:
    """Times hundred."""
    return [100 * value for value in values]


ONE_SIDED = {"elevation_distribution": "one-sided"}


def tre_span(name: str) -> tuple[float, float]:
    """Least and largest of a column of tre_calibration, for the laws of mean zero."""
    rows = table("tre_calibration")
    return span(float(row[name]) for row in rows if row["elevation_distribution"] != "one-sided")


def covered(**where: str) -> tuple[float, ...]:
    """Least and largest coverage of X's six parameters, %."""
    names = [name for name in table("coverage")[0] if name.startswith("cover_")]
    return tuple(percent(span(v for name in names for v in column("coverage", name, **where))))


def auto() -> list[float]:
    """Auto over conventional wherever conventional errs."""
    return column("auto_grid", "auto_over_conventional")


LAWS = ("uniform", "normal", "one-sided", "heavy-tailed", "triangular")
AUTO, BAYES = "auto_over_conventional", "auto_over_bayes"


def bayes(images: str) -> list[float]:
    """Auto over the Bayes limit."""
    return column("bayes_limit", BAYES, images=images)


def spoilt() -> list[Row]:
    """Rows of the outlier study with outliers."""
    return [row for row in table("outliers") if float(row["fraction"]) > 0]


def worst_spoilt(kind: str | None = None) -> Row:
    """The row with the largest error over the oracle's."""
    rows = [row for row in spoilt() if kind is None or row["kind"] == kind]
    return max(rows, key=lambda row: number(row, "robust_over_oracle"))


def placed(name: str) -> float:
    """Precision of the joint calibration after this placement."""
    return only("placement", "rp_joint_mm", placement=name)


def cells(protocol: str) -> list[object]:
    """Cells within one SD and cells, of each of the paper's tables."""
    rows = [row for row in table("paper_tables_verdict") if row["protocol"] == protocol]
    return [int(row[k]) for row in rows for k in ("within_1_sd", "cells")]


FITTED = "fitted: test 0.55, 2 rounds"


def unmatched() -> list[Row]:
    """Cells of the fitted protocol that are not within the paper's one SD."""
    fitted = [row for row in table("paper_tables") if row["protocol"] == FITTED]
    return [row for row in fitted if row["within_1_sd"] == "False"]


def poses(cone: str, images: str) -> list[float]:
    """A row of the table of poses: TRE and RP over random poses'."""
    found = []
    for planned in ("sobol", "optimal", "wrong+", "wrong-", "replanned"):
        for error in ("tre_mm", "rp_mm"):
            sums = []
            for name in (planned, "random"):
                values = column(
                    "pose_design", error, cone=cone, images=images, poses=name, method="auto",
                    law=("uniform", "normal", "heavy-tailed", "triangular"),
                )  # fmt: skip
                sums.append(sum(value**2 for value in values))
            found.append(math.sqrt(sums[0] / sums[1]))
    return found


def compared(method: str, what: str) -> int:
    """Sum of a column of the comparison's summary over the offsets' distributions."""
    return int(sum(column("alternating_vs_joint_summary", what, method=method)))


def crosswire_halves(of: str) -> list[float]:
    """The joint rows of the choice of halves."""
    rows = [row for row in table("pose_design_crosswire") if row["method"] == "joint"]
    return [number(row, of) for row in rows]


def trials(row: str) -> float:
    """A median of the study throughput."""
    return only("study_throughput", "median", what=row)


# README and the table of results.
for page, words in (
    (README, "| error against conventional calibration, on average, in {} conditions | "
     "{:.2f} to {:.2f} of it |"),
):  # fmt: skip
    claim(page, words, lambda: (len(auto()), *span(auto())))
claim(
    README,
    "| error against the best possible (the Bayes limit), median of {} conditions | "
    "{:.2f} times it |",
    lambda: (len(bayes("50")), statistics.median(bayes("50"))),
)
claim(
    README,
    "| 95 % intervals that cover the truth, each of 6 parameters in {} conditions | "
    "{:.1f} to {:.1f} % |",
    lambda: (len(table("coverage")), *covered()),
)
claim(
    INDEX,
    "| {:.2f} to {:.2f} of its mean error, in {} simulated conditions |",
    lambda: (*span(auto()), len(auto())),
)
claim(
    INDEX,
    "| {:.2f} times the Bayes limit's error (median of {} conditions), {:.2f} at worst |",
    lambda: (statistics.median(bayes("50")), len(bayes("50")), max(bayes("50"))),
)
claim(INDEX, "95 % intervals cover in {:.1f} to {:.1f} % |", covered)
claim(
    INDEX,
    "95 % intervals of TRE hold in {:.1f} to {:.1f} % for offsets of mean zero; the predicted TRE "
    "is {:.2f} to {:.2f} times the actual one |",
    lambda: (*percent(tre_span("held_at_points")), *tre_span("predicted_over_actual")),
)
claim(
    INDEX,
    "| {:.2f} times the error without the spoilt images, at worst |",
    lambda: [number(worst_spoilt(), "robust_over_oracle")],
)
claim(
    INDEX,
    "| {} of {} cells within the paper's mean +- 1 SD, with two choices fitted |",
    lambda: (sum(cells(FITTED)[::2]), sum(cells(FITTED)[1::2])),  # type: ignore[arg-type]
)
claim(
    INDEX,
    "| never above in {:.0f} problems; {:.0f} steps against {:.0f} rounds |",
    lambda: (
        quantity("same_objective_summary", "problems"),
        only("same_objective_convergence", "iterations_to_best_median", arm="joint"),
        only("same_objective_convergence", "iterations_to_best_median", arm="alternation"),
    ),
)
claim(
    INDEX,
    "| {:.2f} to {:.2f} of conventional's error |",
    lambda: span(column("curvilinear_joint", "joint_over_conventional")),
)
claim(
    INDEX,
    "| precision within {:.0f} % of knowing both |",
    lambda: [100 * max(abs(v - 1) for v in column("sound_speed_delay", "rp_estimated_over_known"))],
)
claim(
    INDEX,
    "| {:.3f} mm against {:.3f} mm by a steady hand |",
    lambda: (placed("amplitude scan"), placed("free hand")),
)
claim(
    INDEX,
    "| {:,.0f} on two cores |",
    lambda: [round(trials("jaxcal study: trials a second, two cores"), -2)],
)

# Accuracy.
claim(
    ACCURACY,
    "Over conventional's, at worst {:.2f} for uniform offsets, {:.2f} for normal, {:.2f} for "
    "one-sided, {:.2f} for heavy-tailed and {:.2f} for triangular ones.",
    lambda: [
        max(column("auto_grid", AUTO, elevation_distribution=law, images="50")) for law in LAWS
    ],
)
claim(
    ACCURACY,
    "With 12, 20 and 200 images at worst {:.2f}, {:.2f} and {:.2f}. So it is above 1 in none of "
    "{} cells. From points without covariances: at worst {:.2f}.",
    lambda: (
        *(max(column("auto_grid", AUTO, images=images)) for images in ("12", "20", "200")),
        len(auto()),
        max(column("auto_grid", "auto_points_over_conventional")),
    ),
)


def _points_over_alternating() -> list[float]:
    rows = [row for row in table("auto_grid") if row["auto_points_over_alternating"] != "nan"]
    worst = max(rows, key=lambda row: number(row, "auto_points_over_alternating"))
    (again,) = table("auto_grid_again")
    return [
        number(row, f"auto_points_over_alternating{end}")
        for row, ends in ((worst, ("", "_ci95_half")), (again, ("", "_ci95_half")))
        for end in ends
    ]


claim(
    ACCURACY,
    "is better in none: over it, at worst {:.2f}.",
    lambda: [max(column("auto_grid", "auto_over_alternating"))],
)
claim(
    ACCURACY,
    "From points without covariances {:.2f} +- {:.2f} in one cell; on 4000 draws of its own that "
    "cell is at {:.2f} +- {:.2f}.",
    _points_over_alternating,
)


def _hindsight() -> list[object]:
    ratio = column("auto_grid", "hindsight_over_auto")
    return [sum(v < 1 for v in ratio), len(ratio), min(ratio)]


claim(
    ACCURACY,
    "is ahead in {} of {} cells, at best by a factor of {:.2f}:",
    _hindsight,
)


def _loses() -> list[float]:
    # Without offsets there is nothing to be better at.
    rows = [row for row in table("auto_grid") if float(row["elevation_mm"]) > 0]
    return [100 * max(number(row, "auto_loses") for row in rows)]


claim(ACCURACY, "in {:.0f} % of the trials of the worst cell.", _loses)
claim(
    ACCURACY,
    "Over conventional's {:.2f} to {:.2f}; the three estimated SDs are {:.3f} to {:.3f} of what "
    "was realised.",
    lambda: (
        *span(column("self_tuned_grid", "joint_over_conventional")),
        *span(
            value
            for name in ("lateral", "range", "elevation")
            for value in column("self_tuned_grid", f"sigma_{name}_over_realised")
        ),
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
    "auto's mean error is {:.2f} times the limit's in the median, {:.2f} at worst. With 12 images "
    "{:.2f} to {:.2f}, with 20 images {:.2f} to {:.2f}.",
    lambda: (
        statistics.median(bayes("50")),
        max(bayes("50")),
        *span(bayes("12")),
        *span(bayes("20")),
    ),
)
claim(
    ACCURACY,
    "with exact data, {} cells of {} are above 1.20. On 1000 draws of their own they are at "
    "{:.2f} to {:.2f}:",
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
claim(
    ACCURACY,
    "in {:.1f} to {:.1f} % of the trials with 50 images, and in {:.1f} to {:.1f} % with 12. The "
    "predicted target registration error is {:.2f} to {:.2f} times the actual one, on average.",
    lambda: (
        *covered(images="50"),
        *covered(images="12"),
        *span(column("coverage", "predicted_over_actual")),
    ),
)
claim(
    ACCURACY,
    "with the present `auto`: {:.0f} recordings of {:.0f} images a condition, offsets of {:g} and "
    "{:g} mm, {:g} mm of noise.",
    lambda: (
        only("tre_calibration", "trials", **ONE_SIDED, elevation_mm="5"),
        only("tre_calibration", "images", **ONE_SIDED, elevation_mm="5"),
        *span(column("tre_calibration", "elevation_mm")),
        only("tre_calibration", "noise_mm", **ONE_SIDED, elevation_mm="5"),
    ),
)
claim(
    ACCURACY,
    "the 95 % interval of TRE at an image point holds the actual one in {:.1f} to {:.1f} %. The "
    "predicted TRE is {:.2f} to {:.2f} times the actual one:",
    lambda: (*percent(tre_span("held_at_points")), *tre_span("predicted_over_actual")),
)
claim(
    ACCURACY,
    "One-sided offsets of 5 mm: {:.1f} %; of 1.5 mm: {:.1f} %,",
    lambda: percent(
        [
            only("tre_calibration", "held_at_points", **ONE_SIDED, elevation_mm=size)
            for size in ("5", "1.5")
        ]
    ),
)
claim(
    ACCURACY,
    "The error is at worst {:.2f} +- {:.2f} times that of the same images without the spoilt "
    "ones. At least {:.1f} % of these are named, and at most {:.1f} % of the clean images. Of "
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
    "pass for noise in {} of {} trials ({:.2f} +- {:.2f})",
    lambda: (
        worst_spoilt("slip")["trials_with_one_left_in"],
        worst_spoilt("slip")["trials"],
        number(worst_spoilt("slip"), "robust_over_oracle"),
        number(worst_spoilt("slip"), "ci95_half_of_ratio"),
    ),
)


def _crosswire(*names: str) -> list[float]:
    return [quantity("crosswire_real", name) for name in names]


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
    "the two methods are alike: {:.2f} mm (conventional) and {:.2f} mm.",
    lambda: _crosswire("held_out_rms_conventional_mm", "held_out_rms_joint_mm"),
)
claim(
    ACCURACY,
    "beat one by {:.1f} +- {:.1f} in leave-one-out log-likelihood. Elevational errors have "
    "kurtosis {:.1f}, range errors {:.1f};",
    lambda: _crosswire(
        "log_density_gained",
        "log_density_gained_standard_error",
        "kurtosis_elevation",
        "kurtosis_range",
    ),
)
claim(
    ACCURACY,
    "moves X by at most {:.2f} of its stated SD, 200 bootstrap samples scatter by {:.2f} of it and "
    "none by more than {:.1f}; precision on images not used is {:.3f} times conventional's.",
    lambda: _crosswire(
        "joint_left_out_largest_shift_sds",
        "joint_bootstrap_scatter_sds",
        "joint_bootstrap_largest_sds",
        "precision_not_used_over_conventional",
    ),
)
claim(
    ACCURACY,
    "mean of the offsets (probability {:.2f}), since the residuals are heavy-tailed and alike in "
    "successive images: {:.2f} of what they say",
    lambda: _crosswire("mean_probability", "mean_trust"),
)
claim(
    ACCURACY,
    "({:.0f} of {:.0f}) and fits to {:.3f} mm; its clean twin to {:.3f} mm. The two tips differ by "
    "{:.2f} mm.",
    lambda: _crosswire(
        "pivot_outliers_named",
        "pivot_outliers_poses",
        "pivot_outliers_robust_rms_mm",
        "pivot_clean_rms_mm",
        "pivot_tips_apart_mm",
    ),
)
claim(
    ACCURACY,
    "Joint calibration, {:.3f} mm with the amplitude scan, {:.3f} mm with pattern injection, "
    "{:.3f} mm with the threshold climb, {:.3f} mm with a steady free hand. Without placement "
    "{:.2f} mm (by hand) and {:.2f} mm (by robot,",
    lambda: [
        placed(name)
        for name in (
            "amplitude scan", "pattern injection", "threshold climb", "free hand", "none, by hand",
            "none, by robot",
        )
    ],
)  # fmt: skip
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
            ACCURACY,
            words.format(images) + 5 * "| {:.2f} / {:.2f} " + "|",
            lambda cone=cone, images=images: poses(cone, images),
        )
claim(
    ACCURACY,
    "with a precision of {:.2f} mm (TRE), {:.2f} (RP) and {:.2f} (D), joint with estimated scales.",
    lambda: crosswire_halves("chosen_rp_mm"),
)
claim(
    ACCURACY,
    "The median of {:.0f} random halves is {:.2f} mm (5 to 95 %: {:.2f} to {:.2f}), and "
    "{:.0f}, {:.0f} and {:.0f} % of them are better.",
    lambda: (
        *(crosswire_halves(name)[0] for name in (
            "random_halves", "random_median_mm", "random_5_mm", "random_95_mm")),
        *percent(crosswire_halves("share_better")),
    ),
)  # fmt: skip

# The paper.
for words, protocol in (
    ("| fitted: test images over 0.55 of the field, 2 rounds ", FITTED),
    ("| default of `jaxcal.Protocol`: 0.75, until X rests ", "default: test 0.75, at rest"),
    ("| the whole field, 2 rounds ", "test 1.0, 2 rounds"),
    ("| unfitted: the whole field, until X rests ", "unfitted: test 1.0, at rest"),
):
    claim(PAPER, words + 3 * "| {} of {} " + "|", lambda protocol=protocol: cells(protocol))
claim(
    PAPER,
    "Not matched when fitted: {} of {} cells.",
    lambda: (len(unmatched()), sum(cells(FITTED)[1::2])),  # type: ignore[arg-type]
)
claim(
    PAPER,
    "Two are in Table 1 (offsets of 1 mm, noise of 4 and 6 mm): {:.2f} and {:.2f} mm, where the "
    "paper has {:.2f} +- {:.2f} and {:.2f} +- {:.2f}.",
    lambda: (
        *(number(row, "mean_mm") for row in unmatched() if row["table"] == "1"),
        *(
            number(row, name)
            for row in unmatched()
            if row["table"] == "1"
            for name in ("paper_mean_mm", "paper_sd_mm")
        ),
    ),
)


def _statement(beginning: str, pattern: str) -> list[str]:
    """Numbers out of the evidence of a statement of the paper."""
    (evidence,) = (
        row["evidence"]
        for row in table("paper_tables_statements")
        if row["statement"].startswith(beginning)
    )
    match = re.search(pattern, evidence)
    assert match, evidence
    return list(match.groups())


claim(
    PAPER,
    "(with compensation significant at {} of {} noise levels)",
    lambda: reversed(
        _statement("with compensation RP falls", r"of (\d+) noises above 0, significantly at (\d+)")
    ),
)
claim(
    PAPER,
    "is reversed at high noise: {} cells lower, {} higher.",
    lambda: _statement("RP is generally lower", r"(\d+) are lower and (\d+) higher"),
)


def _same(*names: str) -> list[float]:
    return [quantity("same_objective_summary", name) for name in names]


claim(
    PAPER,
    "{:.0f} problems, the alternation run to 1e-10 or 20,000 rounds. The joint bounded solve is "
    "above the alternation's objective in {:.0f} and below in {:.0f};",
    lambda: _same(
        "problems",
        "joint objective above alternation's x (1 + 1e-8) + 1e-12 sum r^2",
        "joint objective lower by more than that",
    ),
)
claim(
    PAPER,
    "its scaled KKT residual is at most {:.1e}. scipy's bounded trust region finds a lower one in "
    "{:.0f} of {:.0f}. The joint solve's median is {:.0f} iterations,",
    lambda: _same(
        "joint scaled KKT residual, largest",
        "scipy trf: problems where it found a lower objective",
        "scipy trf: problems compared",
        "joint iterations, median",
    ),
)
claim(
    PAPER,
    "The alternation takes {:.0f} rounds (median) to the same objective where it gets there; "
    "{:.0f} problems do not get there in 20,000.",
    lambda: (
        *_same("alternation rounds to the joint's objective, median where reached"),
        quantity("same_objective_summary", "problems")
        - quantity(
            "same_objective_summary", "alternation: problems that reach it within 20,000 rounds"
        ),
    ),
)


def _steps(of: str, *arms: str) -> list[float]:
    return [only("same_objective_convergence", of, arm=arm) for arm in arms]


claim(
    PAPER,
    "in a median of {:.0f} steps (90th percentile {:.0f}), the alternation in {:.0f} rounds "
    "({:.0f}).",
    lambda: [
        value
        for arm in ("joint", "alternation")
        for name in ("median", "p90")
        for value in _steps(f"iterations_to_best_{name}", arm)
    ],
)
claim(
    PAPER,
    "a round by {:.2f} ({:.3f} in the slowest tenth).",
    lambda: [*_steps("rate_median", "alternation"), *_steps("rate_p90", "alternation")],
)
claim(
    PAPER,
    "reaches the same objectives in {:.0f} steps (90th percentile {:.0f}, with exact second "
    "derivatives {:.0f})",
    lambda: [
        *_steps("iterations_to_best_median", "variable projection"),
        *_steps("iterations_to_best_p90", "variable projection", "variable projection, exact"),
    ],
)
claim(
    PAPER,
    "({:.1f} % of those with an isolated minimiser)",
    lambda: [
        100
        * only(
            "same_objective_convergence_starts",
            "solves_above_best",
            arm="joint",
            minimiser="isolated",
            tolerance="1e-10",
        )
    ],
)


def _stopped(arm: str, tolerance: str) -> float:
    return only(
        "same_objective_convergence_tolerance",
        "rp_over_conventional",
        arm=arm,
        tolerance=tolerance,
    )


claim(
    PAPER,
    "its mean precision is {:.2f} of conventional's, run to the end {:.2f}, the exact joint "
    "optimum {:.2f}, joint steps stopped early {:.2f}.",
    lambda: (
        _stopped("alternation", "0.1"),
        _stopped("alternation", "1e-10"),
        _stopped("joint", "1e-10"),
        _stopped("joint", "0.1"),
    ),
)
claim(
    PAPER,
    "significantly worse than conventional in {} of the {} conditions",
    lambda: (
        compared("joint, bounded by the truth", "cells_worse"),
        compared("joint, bounded by the truth", "cells"),
    ),
)
claim(
    PAPER,
    "is worse than conventional in {} of {} with 1 mm, in {} with the true bound, in {} with half "
    "and in {} with twice of it.",
    lambda: (
        compared("alternating, 1 mm", "cells_worse"),
        compared("alternating, 1 mm", "cells"),
        *(
            compared(f"alternating, {bound}", "cells_worse")
            for bound in ("true bound", "half the bound", "twice the bound")
        ),
    ),
)

# Speed.
claim(
    SPEED,
    "takes {:.0f} us of CPU: {:,.0f} trials a second on both cores.",
    lambda: (
        1e6 / trials("jaxcal study: trials a second of CPU time, one core"),
        round(trials("jaxcal study: trials a second, two cores"), -2),
    ),
)


def _throughput(peer: str) -> float:
    return trials(f"ratio to numpy and scipy, {peer}: trials a second, two cores")


claim(
    SPEED,
    "That is {:.0f} times as many as numpy with scipy at its best (exact Jacobians, MINPACK), "
    "{:.0f} times as many as with scipy's defaults, and {:.0f} times where scipy segments as well. "
    "A whole trial of the joint method takes {:.2f} times",
    lambda: (
        *(_throughput(peer) for peer in ("best", "usual", "plain")),
        trials(
            "a whole trial of the joint method over its random numbers alone plus its solve alone"
        ),
    ),
)


def _memory() -> list[float]:
    largest = max(table("study_memory"), key=lambda row: float(row["trials"]))
    quarters = [number(largest, f"{name}_quarter_mib") for name in ("first", "last")]
    return [*span(column("study_memory", "peak_mib")), abs(quarters[1] - quarters[0])]


claim(
    SPEED,
    "memory is flat from {:,.0f} to {:,.0f} trials,",
    lambda: span(column("study_memory", "trials")),
)
claim(
    SPEED,
    "{:.0f} to {:.0f} MiB at most; within the largest, first and last quarter differ by "
    "{:.1f} MiB.",
    _memory,
)


def _segmentation(case: str, of: str, **where: str) -> float:
    return column("benchmark_segmentation", of, case=case, **where)[0]


claim(
    SPEED,
    "takes {:.0f} us in a batch (robust: {:.0f} us), {:.0f} times less than scipy in a loop, and "
    "{:.0f} times less than MINPACK with exact Jacobians (robust: {:.0f} times).",
    lambda: (
        _segmentation("least squares", "jaxcal_us_per_trial"),
        _segmentation("robust", "jaxcal_us_per_trial"),
        _segmentation("least squares", "median_ratio", against="scipy, plain"),
        _segmentation("least squares", "median_ratio", against="scipy, best"),
        _segmentation("robust", "median_ratio"),
    ),
)
claim(
    SPEED,
    "prior auto costs {:.1f} times the self-tuned Gaussian solve.",
    lambda: [only("auto_cost", "over_gaussian", images="50", contestant="auto")],
)

SETTINGS: dict[str, tuple[str, ...]] = {
    README: (
        "PLUS and 3D Slicer",
        "Boctor (2017)",
        "Python 3.11 or newer",
        "BSD 3-clause",
    ),
    INDEX: ("21 and 22 November 2026",),
    ACCURACY: (
        "+- is a 95 % interval",
        "7 x 7 grid of offsets and noise, for five distributions of the offsets, with 50 images",
        "with 12, 20 and 200 images",
        "(1 mm, its stopping rule)",
        "(0.125 to 4 times the true one)",
        "(1 to 256)",
        "7 x 6 cells for each of four symmetric distributions, 50 images",
        "12 and 50 images. 95 % intervals",
        "10 % and 30 % of the images 20 to 100 mm off, three distributions, five cells of the grid "
        "with 50 images, and 12, 20 and 200 images",
        "30 % of the images that slipped together",
        "54 hand-picked points",
        "exactly poses 336 to 479",
        "64 simulated benches of 60 images",
        "offsets to 1, 3 and 5 mm, channel noise 0.05 to 2 mm, 500 trials a cell",
        "2 % and 0.5 us off, 500 trials a cell",
        "10000 frames a cell",
        "clocks of 20 and 100 MHz",
        "from 0.5 mm of noise on",
        "48 trials a cell (a reduced run), offsets of SD 1 mm, 0.5 mm of noise",
        "about 6 %",
        "told 3 times too large",
        "is 2 to 3 times what any calibration predicts of itself up to 30 images",
        "60 planned poses see it",
        "27 of its 54 images, chosen by the criterion, predict the other 27",
    ),
    PAPER: (
        "Journal of Medical Imaging 4(3), 2017",
        "448 trials a cell",
        "the paper's mean +- 1 SD",
        "| Table 1 | Table 2 | Table 3 |",
        "dips at 0.5 to 1 mm",
        "30 rounds of warm-up",
        "200 problems, one start",
        "from 1e-4 to 1e-10, a joint step multiplies it by 1e-4",
        "turned by up to 2 degrees",
    ),
    SPEED: ("AVX-512", "a trial of 50 x 128", "with 50 images"),
}
"""Numbers that are no results: what an experiment was set to, dates, names."""

_NUMBER = re.compile(r"\d[\d.,]*")


def plain(text: str) -> str:
    """A page without code, addresses and headings, which hold no results; places stay."""

    def blank(match: re.Match[str]) -> str:
        return re.sub(r"[^\n]", " ", match[0])

    for pattern in (
        r"^```.*?^```$", r"`[^`\n]*`", r"\]\([^)]*\)", r"^\[\w+\]: .*$", r"\]\[\w+\]", r"^#.*$",
        r"<!--.*?-->",
    ):  # fmt: skip
        flags = re.MULTILINE | re.DOTALL if "```" in pattern or "<!--" in pattern else re.MULTILINE
        text = re.sub(pattern, blank, text, flags=flags)
    return text


def problems() -> list[str]:
    """What is not as the tables say, one line each."""
    found = []
    for page in PAGES:
        text = (ROOT / page).read_text(encoding="utf-8")
        known = [False] * len(text)
        for piece in (c for c in CLAIMS if c.page == page):
            matches = list(piece.pattern().finditer(text))
            wanted = piece.text()
            if not matches:
                found.append(f"{page}: nowhere: {wanted}")
            for match in matches:
                if re.sub(r"\s+", " ", match[0]) != re.sub(r"\s+", " ", wanted):
                    found.append(f"{page}: the tables say: {wanted}")
                known[match.start() : match.end()] = [True] * (match.end() - match.start())
        for words in SETTINGS[page]:
            pattern = r"\s+".join(re.escape(word) for word in words.split())
            matches = list(re.finditer(pattern, text))
            if not matches:
                found.append(f"{page}: nowhere: {words}")
            for match in matches:
                known[match.start() : match.end()] = [True] * (match.end() - match.start())
        for match in _NUMBER.finditer(plain(text)):
            if not known[match.start()]:
                line = text.count("\n", 0, match.start()) + 1
                around = " ".join(text[max(match.start() - 30, 0) : match.end() + 20].split())
                found.append(f"{page}:{line}: {match[0]} comes from no table: ... {around} ...")
    return found


def write() -> None:
    """Put the tables' present values into the pages."""
    for piece in CLAIMS:
        path = ROOT / piece.page
        text = path.read_text(encoding="utf-8")
        path.write_text(
            piece.pattern().sub(lambda _, piece=piece: piece.text(), text), encoding="utf-8"
        )


def main() -> int:
    """Run the command line; returns the exit status."""
    if sys.argv[1:] == ["--write"]:
        write()
    found = problems()
    print("\n".join(found))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
