"""Claims of the pages on the paper."""

from __future__ import annotations

import re
import statistics

from claims import (
    EXPERIMENT,
    FITTED,
    PAPER,
    UNFITTED,
    cells,
    claim,
    column,
    compared,
    fitted,
    number,
    only,
    percent,
    quantity,
    span,
    table,
    unmatched,
    within,
)

for words, protocol in (
    ("| fitted: test images over 0.55 of the field, 2 rounds ", FITTED),
    ("| default of `jaxcal.Protocol`: 0.75, until X converges ", "default: test 0.75, at rest"),
    ("| the whole field, 2 rounds ", "test 1.0, 2 rounds"),
    ("| unfitted: the whole field, until X converges ", "unfitted: test 1.0, at rest"),
):
    claim(PAPER, words + 3 * "| {} of {} " + "|", lambda protocol=protocol: cells(protocol))
claim(
    PAPER,
    "the paper's SDs are {:.0f} to {:.0f} % of its means. Within half an SD are {} of {} cells "
    "when fitted, and {} unfitted. Not matched when fitted: {} of {} cells:",
    lambda: (
        *percent(span(_sds_over_means())),
        within("half", FITTED),
        len(fitted()),
        within("half", UNFITTED),
        len(unmatched()),
        len(fitted()),
    ),
)


def _sds_over_means() -> list[float]:
    known = [row for row in fitted() if number(row, "paper_mean_mm") > 0]
    return [number(row, "paper_sd_mm") / number(row, "paper_mean_mm") for row in known]


for missed in unmatched():
    claim(
        PAPER,
        f"| {missed['table']} | {missed['elevation_mm']} mm | {missed['noise_mm']} mm "
        f"| {missed['method']} | {{:.2f}} mm | {{:.2f}} +- {{:.2f}} mm |",
        lambda row=missed: [
            number(row, name) for name in ("mean_mm", "paper_mean_mm", "paper_sd_mm")
        ],
    )


def _noisy() -> list[object]:
    """By how much ours are above the paper's in Tables 1 and 2 at noises of 4 mm and more."""
    more = {
        which: [
            100 * (number(row, "mean_mm") / number(row, "paper_mean_mm") - 1)
            for row in fitted()
            if row["table"] == which and number(row, "noise_mm") >= 4
        ]
        for which in ("1", "2")
    }
    (cells,) = {len(values) for values in more.values()}
    above = [sum(value > 0 for value in values) for values in more.values()]
    return [*(statistics.median(values) for values in more.values()), *above, cells]


claim(
    PAPER,
    "by {:.0f} % in Table 1 and {:.0f} % in Table 2 (median), in {} and {} of {} cells each.",
    _noisy,
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
    "(with compensation it is significant at {} of {} noise levels)",
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
    "{:.0f} problems, the alternation run to 1e-10 or 20,000 rounds. The objective of the joint "
    "bounded solve is above the alternation's in {:.0f} and below it in {:.0f};",
    lambda: _same(
        "problems",
        "joint objective above alternation's x (1 + 1e-8) + 1e-12 sum r^2",
        "joint objective lower by more than that",
    ),
)
claim(
    PAPER,
    "its scaled KKT residual is at most {:.1e}. scipy's bounded trust-region solver finds a lower "
    "objective in {:.0f} of {:.0f}. The joint solve takes a median of {:.0f} iterations,",
    lambda: _same(
        "joint scaled KKT residual, largest",
        "scipy trf: problems where it found a lower objective",
        "scipy trf: problems compared",
        "joint iterations, median",
    ),
)
claim(
    PAPER,
    "The alternation takes {:.0f} rounds (median) to reach the same objective; in {:.0f} problems "
    "it does not reach it in 20,000.",
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


def _minutes(placement: str, method: str, wanted: str) -> float:
    return only(
        "paper_experiment_planning_times",
        "minutes",
        accuracy_mm="0",
        wanted_rp_mm=wanted,
        placement=placement,
        method=method,
    )


def _by_hand_over_scan(wanted: str) -> float:
    """Time by hand over that of the amplitude scan, both with an SD for each image."""
    by_hand, scan = (
        _minutes(placement, "joint, own SDs", wanted)
        for placement in ("seen, by hand", "amplitude scan")
    )
    return by_hand / scan


claim(
    EXPERIMENT,
    "images placed by hand anywhere in the beam take {:.1f} times the time of the amplitude scan "
    "to 0.2 mm, and {:.1f} to {:.1f} times to 0.15 mm and below",
    lambda: (
        _by_hand_over_scan("0.2"),
        *span(_by_hand_over_scan(wanted) for wanted in ("0.08", "0.1", "0.15")),
    ),
)


# A bound for each image.
def _over_auto(arm: str) -> float:
    return max(column("paper_experiment_bounds", "over_auto_percent", arm=arm))


claim(
    EXPERIMENT,
    "is never more than {:.1f} % worse than no bound; SDs for each image are at most {:.1f} % "
    "worse.",
    lambda: [_over_auto(f"{kind}, amplitude") for kind in ("auto", "own SDs")],
)


claim(
    EXPERIMENT,
    "such a bound is worse than `auto` without any, by up to {:.0f} % and {:.1f} %.",
    lambda: [_over_auto(f"{kind}, amplitude") for kind in ("bounded", "alternating")],
)


def _by_hand(arm: str) -> float:
    where = {"scenario": "seen, by hand", "images": "60"}
    return only("paper_experiment_bounds", "rp_mm", arm=arm, **where)


claim(
    EXPERIMENT,
    "halves the error ({:.3f} mm instead of {:.3f} mm with 60 images)",
    lambda: [_by_hand(arm) for arm in ("own SDs, amplitude", "without")],
)
