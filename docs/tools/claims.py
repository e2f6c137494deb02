"""What a claim is, and how the tables that claims come from are read."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "experiments" / "results"

Row = dict[str, str]

README, INDEX, ACCURACY, VERDICT, PLANNED, PAPER, EXPERIMENT, SPEED = PAGES = (
    "README.md",
    "docs/results/index.md",
    "docs/results/accuracy.md",
    "docs/results/verdict.md",
    "docs/results/poses.md",
    "docs/results/paper.md",
    "docs/results/paper-experiment.md",
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
MIXTURE = {"elevation_distribution": "sometimes off-centre"}


def tre_span(name: str) -> tuple[float, float]:
    """Least and largest of a column of tre_calibration, for the laws of mean zero."""
    centred = tuple(law for law in LAWS if law != "one-sided")
    return span(column("tre_calibration", name, elevation_distribution=centred))


def covered(which: str = "coverage", **where: str) -> tuple[float, ...]:
    """Least and largest coverage of X's six parameters, %."""
    names = [name for name in table(which)[0] if name.startswith("cover_")]
    return tuple(percent(span(v for name in names for v in column(which, name, **where))))


def auto() -> list[float]:
    """Auto over conventional wherever conventional errs."""
    return column("auto_grid", "auto_over_conventional")


LAWS = ("uniform", "normal", "one-sided", "heavy-tailed", "triangular")
AUTO, BAYES = "auto_over_conventional", "auto_over_bayes"
AUTO_POINTS = "auto_points_over_conventional"
BY_GAUSSIAN = "auto_points_over_gaussian_points"
PLACED = ("amplitude scan", "pattern injection", "threshold climb", "free hand")
"""Placements in the mid-plane; the last is not by robot."""


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


def significant(name: str, ratio: str, **where: str) -> tuple[int, int]:
    """In how many rows a ratio is significantly below 1, and in how many above."""
    values, halves = (column(name, of, **where) for of in (ratio, f"{ratio}_ci95_half"))
    both = list(zip(values, halves, strict=True))
    return sum(v + half < 1 for v, half in both), sum(v - half > 1 for v, half in both)


def placed(name: str, method: str = "joint") -> float:
    """Precision of the calibration after this placement."""
    return only("placement", f"rp_{method}_mm", placement=name)


def tank_compared() -> tuple[int, int, int]:
    """Joint against conventional in the tank: significantly worse, of how many, and better."""
    name, of = "paper_experiment_sensitivity", "joint_over_without_exact"
    both = list(zip(column(name, f"{of}_percent"), column(name, f"{of}_half"), strict=True))
    worse, better = (sum(sign * v > half for v, half in both) for sign in (1, -1))
    return worse, len(both), better


def cells(protocol: str) -> list[object]:
    """Cells within one SD and cells, of each of the paper's tables."""
    rows = [row for row in table("paper_tables_verdict") if row["protocol"] == protocol]
    return [int(row[k]) for row in rows for k in ("within_1_sd", "cells")]


FITTED, UNFITTED = "fitted: test 0.55, 2 rounds", "unfitted: test 1.0, at rest"


def fitted() -> list[Row]:
    """Cells of the fitted protocol."""
    return [row for row in table("paper_tables") if row["protocol"] == FITTED]


def unmatched() -> list[Row]:
    """Cells of the fitted protocol that are not within the paper's one SD."""
    return [row for row in fitted() if row["within_1_sd"] == "False"]


def within(sds: str, protocol: str) -> int:
    """How many cells of a protocol are within the paper's ``1`` or ``half`` SD."""
    return int(sum(column("paper_tables_verdict", f"within_{sds}_sd", protocol=protocol)))


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
