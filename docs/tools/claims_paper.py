"""Claims of the pages on the paper."""

from __future__ import annotations

import re

from claims import (
    EXPERIMENT,
    FITTED,
    PAPER,
    cells,
    claim,
    compared,
    number,
    only,
    quantity,
    span,
    table,
    unmatched,
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
