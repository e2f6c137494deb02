"""The tables of docs/results/paper-experiment.md, from the tables in results/."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Callable
from pathlib import Path

from tank_run import Run
from tank_sensitivity import EXACT_ROBOT, LABELS

from jaxcal.io.atomic import write_text

PAGE = Path(__file__).parents[1] / "docs" / "results" / "paper-experiment.md"
RESULTS = Path(__file__).parent / "results"
_BLOCK = "<!-- table: {} -->\n{}\n<!-- end -->"
_PATTERN = re.compile(r"<!-- table: ([\w-]+) -->\n.*?<!-- end -->", re.DOTALL)


def rows(name: str) -> list[dict[str, str]]:
    """A table of results/."""
    with (RESULTS / f"paper_experiment{name}.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def markdown(header: list[str], lines: list[list[str]]) -> str:
    """A table for the page."""
    found = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    return "\n".join(found + ["| " + " | ".join(line) + " |" for line in lines])


def number(row: dict[str, str], name: str, form: str = ".2f") -> str:
    """A number of a row; empty stays empty."""
    return format(float(row[name]), form) if row[name] else ""


def cells() -> str:
    """Table 4, ours beside the paper's."""
    chosen = [row for row in rows("") if row["paper_rp_mm"]]
    inside = sum(row["paper_in_95_range"] == "True" for row in chosen)
    table = markdown(
        ["experiment", "calibrate/test", "paper", "ours", "best of 3", "X alone", "test's own"],
        [
            [
                row["experiment"],
                row["calibrate_test"],
                number(row, "paper_rp_mm"),
                f"{number(row, 'rp_mm')} ± {number(row, 'ci95_half_mm')}",
                f"{number(row, 'best_of_3_mm')} ± {number(row, 'best_ci95_half_mm')}",
                f"{number(row, 'exact_mm', '.3f')} ± {number(row, 'exact_ci95_half_mm', '.3f')}",
                number(row, "test_scatter_mm"),
            ]
            for row in chosen
        ],
    )
    return (
        f"{table}\n\nThe paper's figure lies within the range of 95 % of our experiments in "
        f"{inside} of {len(chosen)} cells."
    )


def joint() -> str:
    """The columns that the paper does not have: joint estimation, experiment 4."""
    chosen = [
        row
        for row in rows("")
        if row["experiment"] == "Exp. 4" and row["calibrate_test"].endswith("/Opt")
    ]
    return markdown(
        ["calibrate/test", "method", "RP", "X alone"],
        [
            [
                row["calibrate_test"],
                row["method"],
                f"{number(row, 'rp_mm')} ± {number(row, 'ci95_half_mm')}",
                f"{number(row, 'exact_mm', '.3f')} ± {number(row, 'exact_ci95_half_mm', '.3f')}",
            ]
            for row in chosen
        ],
    )


def _statements() -> list[tuple[str, str, str, list[str]]]:
    """Section, statement, verdict and evidence of every statement."""
    found = []
    for row in rows("_statements"):
        source, statement = row["section"], row["statement"]
        if statement.startswith("(ours) "):
            source, statement = f"ours, on {source}", statement.removeprefix("(ours) ")
        verdict = row["verdict"].replace("see figures", "no verdict")
        evidence = row["evidence"].replace("+-", "±").split("; ")
        found.append((source, statement, verdict, evidence))
    return found


def statements() -> str:
    """Every statement with its verdict."""
    lines = [
        [str(which), source, statement, verdict]
        for which, (source, statement, verdict, _) in enumerate(_statements(), 1)
    ]
    return markdown(["", "section", "statement", "verdict"], lines)


def evidence() -> str:
    """What the verdicts on the statements rest on."""
    return "\n".join(
        f"{which}. {'. '.join(part[:1].upper() + part[1:] for part in parts)}."
        for which, (*_, parts) in enumerate(_statements(), 1)
    )


def sensitivity() -> str:
    """Errors of X at the least and the largest value of each parameter."""
    named = LABELS | {EXACT_ROBOT: EXACT_ROBOT.replace("element_mm", LABELS["element_mm"])}
    by_axis = itertools.groupby(rows("_sensitivity"), key=lambda row: row["axis"])
    pairs = [(values[0], values[-1]) for _, group in by_axis if (values := list(group))]
    return markdown(
        [
            "",
            "value",
            "AE",
            "CW",
            "Auto-AE",
            "Auto-AE, joint",
            "AE over CW, %",
            "joint over without, %",
        ],
        [
            [
                "" if row is pair[1] else named[row["axis"]],
                f"{float(row['value']):g}",
                *(
                    f"{number(row, f'{name}_exact_mm', '.3f')} ± "
                    f"{number(row, f'{name}_ci95_half_mm', '.3f')}"
                    for name in ("ae", "cw", "auto_ae")
                ),
                number(row, "auto_ae_joint_exact_mm", ".3f"),
                f"{number(row, 'ae_over_cw_exact_percent', '+.0f')} ± "
                f"{number(row, 'ae_over_cw_exact_half', '.0f')}",
                f"{number(row, 'joint_over_without_exact_percent', '+.0f')} ± "
                f"{number(row, 'joint_over_without_exact_half', '.0f')}",
            ]
            for pair in pairs
            for row in pair
        ],
    )


def times() -> str:
    """Minutes to a wanted precision, robot without pose error."""
    chosen = [row for row in rows("_planning_times") if float(row["accuracy_mm"]) == 0]
    wanted = list(dict.fromkeys(row["wanted_rp_mm"] for row in chosen))
    pairs = list(dict.fromkeys((row["placement"], row["method"]) for row in chosen))
    by_key = {(r["placement"], r["method"], r["wanted_rp_mm"]): r for r in chosen}
    return markdown(
        ["placement", "method", *(f"{value} mm" for value in wanted)],
        [
            [*pair, *(number(by_key[*pair, value], "minutes", ".1f") or "-" for value in wanted)]
            for pair in pairs
        ],
    )


def bounds() -> str:
    """Mean RP of every arm, 60 images."""
    chosen = [row for row in rows("_bounds") if row["images"] == "60"]
    scenarios = list(dict.fromkeys(row["scenario"] for row in chosen))
    arms = list(dict.fromkeys(row["arm"] for row in chosen))
    by_key = {(row["scenario"], row["arm"]): row for row in chosen}
    return markdown(
        ["", *scenarios],
        [[arm, *(number(by_key[name, arm], "rp_mm", ".3f") for name in scenarios)] for arm in arms],
    )


def validation() -> str:
    """The fast model against the bench, over the experiments."""
    both = [row for row in rows("_validation") if row["fast_model"]]
    quantities = list(dict.fromkeys(row["quantity"] for row in both))

    def over(quantity: str, name: str) -> str:
        found = sorted(float(row[name]) for row in both if row["quantity"] == quantity)
        ends = dict.fromkeys(f"{value:.3f}" for value in (found[0], found[-1]))
        return " to ".join(ends)

    return markdown(
        ["quantity", "fast model, mm", "bench, mm"],
        [[name, over(name, "fast_model"), over(name, "bench")] for name in quantities],
    )


TABLES: dict[str, Callable[[], str]] = {
    "cells": cells,
    "joint": joint,
    "statements": statements,
    "evidence": evidence,
    "sensitivity": sensitivity,
    "times": times,
    "bounds": bounds,
    "validation": validation,
}


def renewed(text: str) -> str:
    """The page with the tables as results/ has them."""
    return _PATTERN.sub(lambda m: _BLOCK.format(m[1], TABLES[m[1]]()), text)


def page(run: Run) -> None:
    """Write the page's tables; the quick run's are not for it."""
    if not run.quick:
        write_text(PAGE, renewed(PAGE.read_text(encoding="utf-8")))
        print(PAGE)
