"""Tables of a study: reconstruction precision per condition and method, and paired differences.

Means are over all trials with a finite result, including those that did not converge: leaving them
out would flatter a method that fails in bad cases. Such trials are counted beside the mean.
Intervals are Student's 95 % intervals of the mean over trials. A difference is between two methods
on the same experiment: a method and the conventional one, or the first one if there is none.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal.io.table import csv_text
from jaxcal.result.calibration import Status
from jaxcal.study.pipeline import bound_mm
from jaxcal.study.spec import Condition, Spec
from jaxcal.study.store import Store

if TYPE_CHECKING:
    from rich.table import Table

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Row:
    """One method in one condition.

    Attributes:
        method: its name.
        bound_mm: the bound that it was told, or None.
        trials: done so far.
        max_iterations: number of trials with this status.
        unobservable: number of trials with this status.
        failed: number of trials with this status.
        not_finite: trials without a finite RP; they are in no mean.
        mean_mm: mean RP.
        sd_mm: SD of RP over trials.
        low_mm: lower end of the mean's confidence interval.
        high_mm: its upper end.
        difference_mm: mean of RP minus the reference's RP, paired; None for the reference itself
            (:func:`reference`).
        difference_low_mm: lower end of the difference's confidence interval, or None.
        difference_high_mm: its upper end, or None.
        rotation_rad: root mean square error of X's rotation.
        translation_mm: root mean square error of X's translation.
        iterations: median of the iterations or rounds.
    """

    method: str
    bound_mm: float | None
    trials: int
    max_iterations: int
    unobservable: int
    failed: int
    not_finite: int
    mean_mm: float | None
    sd_mm: float | None
    low_mm: float | None
    high_mm: float | None
    difference_mm: float | None
    difference_low_mm: float | None
    difference_high_mm: float | None
    rotation_rad: float | None
    translation_mm: float | None
    iterations: float | None


@dataclass(frozen=True)
class Cell:
    """One condition with a row for each method."""

    condition: Condition
    rows: tuple[Row, ...]


def summarise(store: Store[Spec]) -> list[Cell]:
    """The table of a study, as far as it is done.

    Raises:
        FormatError: a damaged file.
    """
    spec, by_condition = store.spec, {}
    for index in store.present():
        by_condition.setdefault(index // spec.chunks_per_condition, []).append(index)
    compared = reference(spec)
    cells = []
    for number, indices in sorted(by_condition.items()):
        condition = spec.condition(number)
        parts = [store.read_done(spec.chunk(index)) for index in indices]
        got = {
            name: np.concatenate([part[name] for part in parts], axis=1)
            for name in ("rp", "status", "iterations", "rotation_error", "translation_error")
        }
        rows = tuple(_row(spec, condition, got, k, compared) for k in range(len(spec.methods)))
        cells.append(Cell(condition, rows))
    return cells


def reference(spec: Spec) -> int:
    """Number of the method that the others are compared with.

    It is the first conventional one, or the first of all.
    """
    conventional = (k for k, method in enumerate(spec.methods) if method.method == "conventional")
    return next(conventional, 0)


def mean_interval(values: np.ndarray) -> tuple[float, float, float] | None:
    """Mean and Student's 95 % interval of the finite values; None for fewer than two."""
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return None
    mean, error = values.mean(), values.std(ddof=1) / np.sqrt(len(values))
    from scipy.special import stdtrit

    half = stdtrit(len(values) - 1, 0.5 + CONFIDENCE / 2) * error
    return float(mean), float(mean - half), float(mean + half)


def _row(
    spec: Spec, condition: Condition, got: dict[str, np.ndarray], k: int, compared: int
) -> Row:
    rp, status = got["rp"][k], got["status"][k]
    finite = np.isfinite(rp)
    unknown = (None, None, None)
    mean, difference = mean_interval(rp) or unknown, unknown
    if k != compared:
        difference = mean_interval(rp - got["rp"][compared]) or unknown
    bound = bound_mm(spec.methods[k], condition)
    return Row(
        method=spec.methods[k].name,
        bound_mm=bound if np.isfinite(bound) else None,
        trials=len(rp),
        max_iterations=int((status == Status.MAX_ITERATIONS).sum()),
        unobservable=int((status == Status.UNOBSERVABLE).sum()),
        failed=int((status == Status.FAILED).sum()),
        not_finite=int((~finite).sum()),
        mean_mm=mean[0],
        sd_mm=float(rp[finite].std(ddof=1)) if finite.sum() > 1 else None,
        low_mm=mean[1],
        high_mm=mean[2],
        difference_mm=difference[0],
        difference_low_mm=difference[1],
        difference_high_mm=difference[2],
        rotation_rad=_root_mean_square(got["rotation_error"][k]),
        translation_mm=_root_mean_square(got["translation_error"][k]),
        iterations=float(np.median(got["iterations"][k])),
    )


def _root_mean_square(values: np.ndarray) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def as_record(store: Store[Spec], cells: list[Cell]) -> dict[str, Any]:
    """The table as one JSON-able object."""
    spec = store.spec
    return {
        "study": spec.name,
        "spec_sha256": spec.sha256,
        "chunks": spec.chunk_count,
        "chunks_done": len(store.present()),
        "cells": [
            {"condition": asdict(cell.condition), "methods": [asdict(row) for row in cell.rows]}
            for cell in cells
        ],
    }


def as_csv(spec: Spec, cells: list[Cell]) -> str:
    """The table as CSV: one line for each condition and method; all fields of the conditions."""
    axes, columns = [name for name, _ in spec.axes], [field.name for field in fields(Row)]
    rows = [[*axes, *columns]]
    for cell in cells:
        condition = [_short(getattr(cell.condition, name)) for name in axes]
        for row in cell.rows:
            rows.append([*condition, *(_short(getattr(row, name)) for name in columns)])
    return csv_text(rows)


def as_table(spec: Spec, cells: list[Cell]) -> Table:
    """The table for a person."""
    from rich.table import Table

    table = Table(title=f"{spec.name}: reconstruction precision (mm), mean ± 95 % interval")
    # Only the fields that tell the conditions apart.
    axes = [name for name, values in spec.axes if len(values) > 1]
    for name in axes:
        table.add_column(name.replace("_", " "))
    beside = f"minus {spec.methods[reference(spec)].name}"
    for name in ("method", "trials", "mean", "SD", beside, "not ok"):
        left = name in ("method", "not ok")
        table.add_column(name, justify="left" if left else "right", overflow="fold")
    for cell in cells:
        condition = [_short(getattr(cell.condition, name)) for name in axes]
        for k, row in enumerate(cell.rows):
            table.add_row(
                *(condition if k == 0 else [""] * len(axes)),
                row.method,
                str(row.trials),
                _interval(row.mean_mm, row.high_mm),
                "-" if row.sd_mm is None else f"{row.sd_mm:.4f}",
                _interval(row.difference_mm, row.difference_high_mm, sign="+"),
                _failures(row),
                end_section=k == len(cell.rows) - 1,
            )
    return table


def _short(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _interval(mean: float | None, high: float | None, sign: str = "") -> str:
    return "-" if mean is None or high is None else f"{mean:{sign}.4f} ± {high - mean:.4f}"


def _failures(row: Row) -> str:
    counts = {
        "max. iterations": row.max_iterations,
        "unobservable": row.unobservable,
        "failed": row.failed,
    }
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count) or "0"
