"""Compare the present code with the golden corpus: all of it.

    python tests/golden/check.py                     # everything, two processes
    python tests/golden/check.py --family points12 --call auto
    python tests/golden/check.py --roads             # only the recorded roads with each other

Prints, for each family, call and road, the largest difference of every number in units of its
recorded SD, where it is above the tolerance, and every decision that flipped, problem by problem.
Problems that are known to differ (``corpus.DIFFERENT``) are named with the reason. Exit status 1 if
another one is above its tolerance or a decision of another one flipped.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from golden.flags import set_flags

set_flags()

import jax  # noqa: E402
import numpy as np  # noqa: E402

from golden import corpus  # noqa: E402
from jaxcal.runtime import executables  # noqa: E402

Task = tuple[str, str, str]
"""Family, call, road; the road ``gradient`` is that of the derivatives."""

LEAST_COST = 1e-12
"""Costs below it are those of exact data."""


def tasks(families: list[str] | None, calls: list[str] | None) -> list[Task]:
    """What there is to check, the longest first."""
    found = [
        (family, call.name, road)
        for family in corpus.CALLS
        for call in corpus.CALLS[family]
        for road in call.roads
    ]
    recorded = corpus.recorded_gradients()
    found += [(*which, "gradient") for which in corpus.GRADIENTS if "/".join(which) in recorded]
    found = [
        task
        for task in found
        if (not families or task[0] in families) and (not calls or task[1] in calls)
    ]

    def slowness(task: Task) -> tuple[bool, bool, bool]:
        return (task[2] == "gradient", "auto" in task[1], task[2] == "batch")

    return sorted(found, key=slowness, reverse=True)


def check(task: Task) -> tuple[Task, list[str], bool, float]:
    """One family, call and road: lines to print, whether it passes, seconds."""
    began = time.perf_counter()
    family_name, call_name, road = task
    family, answers = corpus.load(family_name)
    call = family.call(call_name)
    if road == "gradient":
        lines, passes = check_gradient(family, call)
    else:
        recorded = answers[call_name, road]
        lines, passes = compare(family, recorded, corpus.compute(family, call, road), call, road)
    jax.clear_caches()
    executables.forget()
    return task, lines, passes, time.perf_counter() - began


def check_gradient(family: corpus.Family, call: corpus.Call) -> tuple[list[str], bool]:
    """The derivatives of one call."""
    recorded = corpus.recorded_gradients()[f"{family.name}/{call.name}"]
    found = corpus.gradient_arrays(family, call, recorded["rows"], recorded["weight"])
    worst = corpus.gradient_differences(recorded, found)
    summary = "  ".join(f"{name} {values.max():.1e}" for name, values in worst.items())
    passes = all(values.max() <= corpus.GRADIENT_TOLERANCE for values in worst.values())
    return [f"  relative: {summary}"], passes


def compare(
    family: corpus.Family,
    recorded: corpus.Arrays,
    found: corpus.Arrays,
    call: corpus.Call,
    road: str,
) -> tuple[list[str], bool]:
    """Lines for every number and every flip, and whether all is within its tolerance.

    ``road`` is that of the recorded answers; of problems whose answer there is known not to be at
    its minimum only the status counts. Problems that are known to differ are named with the reason.
    """
    lines, passes = [], True
    early = corpus.stopped_early(family, call.name, road)
    reasons = corpus.known_to_differ(family.name, call.name, road)
    known = np.isin(np.arange(len(family)), [*reasons])
    flat = np.array([row for row, why in reasons.items() if why == corpus.FLAT], int)
    worst = corpus.differences(recorded, found)
    flips = corpus.flips(recorded, found)
    differs = np.isin(np.arange(len(family)), [row for rows in flips.values() for row in rows])
    summary = []
    for name, values in worst.items():
        values = np.where(early, np.nan, values)
        limit = corpus.tolerance(family.name, call.name, name)
        differs |= np.nan_to_num(values, nan=0.0) > limit
        for row in flat[np.nan_to_num(values[flat], nan=0.0) > corpus.FLAT_ALLOWANCE]:
            passes = False
            lines.append(f"  {name}: {values[row]:.2e} in problem {row}, more than rounding")
        values = np.where(known, np.nan, values)
        if np.isnan(values).all():
            continue
        row = int(np.nanargmax(values))
        summary.append(f"{name} {values[row]:.1e}")
        if values[row] > limit:
            passes = False
            above = int(np.nansum(values > limit))
            lines.append(
                f"  {name}: {above} above {limit:.0e}, most {values[row]:.2e} in problem {row} "
                f"({family.kinds[row]})"
            )
    for name, rows in flips.items():
        rows = rows[~known[rows]]
        if name != "status_code":
            rows = rows[~early[rows]]
        passes &= not len(rows)
        for row in rows:
            lines.append(
                f"  flip of {name} in problem {row} ({family.kinds[row]}): "
                f"{np.ravel(recorded[name][row]).astype(int).tolist()} -> "
                f"{np.ravel(found[name][row]).astype(int).tolist()}"
            )
    for row in np.flatnonzero(known):
        told = reasons[row] if differs[row] else "no longer differs"
        before, now = float(recorded["cost"][row]), float(found["cost"][row])
        if not now <= before * (1 + corpus.COST_ALLOWANCE) + LEAST_COST:
            passes, told = False, f"its cost is {now:.6g}, {before:.6g} is recorded"
        lines.append(f"  problem {row} ({family.kinds[row]}): {told}")
    return ["  " + "  ".join(summary), *lines], passes


def compare_roads() -> bool:
    """The recorded answers of ``calibrate`` with those of ``calibrate_batch``."""
    passes = True
    for name, calls in corpus.CALLS.items():
        family, answers = corpus.load(name)
        for call in calls:
            if set(call.roads) != {"one", "batch"}:
                continue
            rows = np.flatnonzero(family.usable())
            one, batch = (corpus.at(answers[call.name, road], rows) for road in call.roads)
            kinds, masks = [family.kinds[row] for row in rows], family.arrays["mask"][rows]
            some = corpus.Family(name, kinds, {"mask": masks}, probe=family.probe)
            lines, good = compare(some, one, batch, call, "one")
            passes &= good
            print(f"{name}, {call.name}: {'agree' if good else 'DIFFER'}", *lines, sep="\n")
    return passes


def main() -> int:
    """Check and say."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--family", action="append", help="only this one")
    parser.add_argument("--call", action="append", help="only this one")
    parser.add_argument("--roads", action="store_true", help="the recorded roads with each other")
    parser.add_argument("--processes", type=int, default=2)
    chosen = parser.parse_args()
    if chosen.roads:
        return 0 if compare_roads() else 1
    began, bad, seconds = time.perf_counter(), 0, 0.0
    todo = tasks(chosen.family, chosen.call)
    # Without max_tasks_per_child: with it, Python 3.11 waits for ever once the first workers go.
    with ProcessPoolExecutor(chosen.processes, mp_context=get_context("spawn")) as pool:
        for task, lines, good, took in pool.map(check, todo):
            bad, seconds = bad + (not good), seconds + took
            verdict = "agrees" if good else "DIFFERS"
            print(f"{', '.join(task)}: {verdict} ({took:.0f} s)", *lines, sep="\n", flush=True)
    print(
        f"{len(todo) - bad} of {len(todo)} agree; {time.perf_counter() - began:.0f} s, "
        f"jax {jax.__version__}, Python {sys.version.split()[0]}"
    )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
