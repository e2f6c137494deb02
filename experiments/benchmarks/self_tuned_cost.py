"""What self-tuning costs beside a solve with given SDs, and what is spent after either.

Problems of 50 images (offsets to 2 mm, 2 mm of noise on each element's distance), float64, one
core, 64 side by side as in ``calibrate_batch``. Given SDs are the root mean squares of those that
self-tuning finds, so both solve the same objective. Timed are

- the solvers alone, from the same conventional fits: given SDs, self-tuned (REML);
- what follows a solution, by the reference (``pipeline.finish`` on every lane: *before*) and by the
  fused passes (``abreast.finish_batch``: *after*), with the largest difference of any number;
- ``calibrate_batch`` in all.

Rounds are interleaved; times are medians with quartiles, microseconds a problem. A second table
says what waiting for the slowest of a chunk costs: passes needed against passes made, the time when
the problems come sorted by their number of passes (the most that regrouping stragglers could gain),
and other sizes of chunk. Seed 20261126.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

CORES = sorted(os.sched_getaffinity(0))
os.sched_setaffinity(0, {CORES[0]})  # before JAX counts them

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1]))
from common import arguments, machine, results_folder, write_table  # noqa: E402

import jaxcal  # noqa: E402
from jaxcal import abreast, compiler  # noqa: E402
from jaxcal.options import (  # noqa: E402
    DELAY_SD_S,
    SOUND_SPEED_SD_M_S,
    Given,
    Method,
    Plan,
    PriorName,
    Request,
    prepare,
    with_bound,
)
from jaxcal.pipeline import finish  # noqa: E402
from jaxcal.problem import Problem  # noqa: E402
from jaxcal.simulation import Protocol, simulate  # noqa: E402
from jaxcal.solvers.fused import Images, Measured  # noqa: E402
from jaxcal.solvers.fused_methods import from_scratch  # noqa: E402
from jaxcal.solvers.fused_variance import self_tuned  # noqa: E402
from jaxcal.solvers.lanes import minimise  # noqa: E402

SEED = 20261126
IMAGES, LANES = 50, 64
ELEVATION_MM, NOISE_MM = 2.0, 2.0
CHUNKS = (32, 128)


def draw(count: int) -> Problem:
    """So many problems."""
    protocol = Protocol(images=IMAGES, elevation_mm=ELEVATION_MM, noise_mm=NOISE_MM, test_images=2)

    @jax.jit
    def drawn(keys):
        return jax.lax.map(lambda key: simulate(key, protocol).problem(), keys, batch_size=LANES)

    return jax.block_until_ready(drawn(jax.random.split(jax.random.key(SEED), count)))


def compiled(function: Callable, *parts) -> Callable:
    """The function with jaxcal's compiler flags."""
    options = compiler.fast_to_run(jax.default_backend())
    return jax.jit(function).lower(*parts).compile(compiler_options=options)


def by_chunks(function: Callable, chunk: int) -> Callable:
    """Map a function of batches over chunks of lanes."""

    def mapped(*parts):
        split = jax.tree.map(
            lambda leaf: leaf.reshape(len(leaf) // chunk, chunk, *leaf.shape[1:]), parts
        )
        done = jax.lax.map(lambda part: function(*part), split)
        return jax.tree.map(lambda leaf: leaf.reshape(len(leaf) * chunk, *leaf.shape[2:]), done)

    return mapped


def interleaved(programs: dict[Any, Callable], rounds: int, count: int) -> dict[Any, np.ndarray]:
    """Microseconds a problem of every program in every round."""
    taken = {name: [] for name in programs}
    for program in programs.values():
        jax.block_until_ready(program())
    for _ in range(rounds):
        for name, program in programs.items():
            begun = time.perf_counter()
            jax.block_until_ready(program())
            taken[name].append((time.perf_counter() - begun) / count * 1e6)
    return {name: np.array(each) for name, each in taken.items()}


class Case:
    """One method: its plan, its solutions, and the programs that follow."""

    def __init__(
        self, problems: Problem, method: Method, prior: PriorName, sigma: tuple | None
    ) -> None:
        request = Request(
            method, prior, None, sigma, None, (), "auto", SOUND_SPEED_SD_M_S, DELAY_SD_S, None,
            False,
        )  # fmt: skip
        self.arguments: dict[str, Any] = {"method": method, "prior": prior, "sigma": sigma}
        self.plan, self.given = prepare(problems, request)
        self.problems = with_bound(problems, self.given)

    def solve(self, problems: Problem):
        """Start, conventional fit and method."""
        images = Images.of(problems)
        begun = from_scratch(images, max_steps=self.plan.options.max_iterations)
        return abreast.run_method(begun, images, problems, self.given, self.plan)

    def before(self, solution, problems: Problem):
        """The reference's finish."""
        return reference(solution, problems, self.given, self.plan)

    def after(self, solution, problems: Problem):
        """The fused passes."""
        return abreast.finish_batch(self.plan, solution, problems, problems, self.given)


def reference(solution, problems: Problem, given: Given, plan: Plan):
    """``pipeline.finish``, lane by lane."""
    return jax.vmap(lambda one, problem: finish(one, problem, problem, given, plan))(
        solution, problems
    )


def largest_difference(first, second) -> float:
    """Of any number, relative to the largest of its kind; directions have no sign."""
    worst = 0.0
    leaves = jax.tree_util.tree_leaves_with_path
    for (path, a), (_, b) in zip(leaves(first), leaves(second), strict=True):
        a, b = np.asarray(a, float), np.asarray(b, float)
        if jax.tree_util.keystr(path) in (".weakest", ".prior_direction"):
            a, b = np.abs(a), np.abs(b)
        if not np.array_equal(np.isnan(a), np.isnan(b)):
            return np.inf
        scale = max(float(np.nanmax(np.abs(b), initial=0.0)), 1e-12)
        worst = max(worst, float(np.nanmax(np.abs(a - b), initial=0.0)) / scale)
    return worst


def solver_programs(problems: Problem, sigma: np.ndarray) -> tuple[dict, Callable]:
    """The two solvers from the same conventional fits; also as functions of (fits, problems)."""

    def fits(problems: Problem):
        fit = from_scratch(Images.of(problems)).fit.guess
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), fit)

    def lanes_last(fit):
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), fit)

    def fixed(fit, problems: Problem):
        sd = jnp.tile(jnp.asarray(sigma)[:, None], problems.mask.shape[0])
        done = minimise(
            lanes_last(fit), Measured(sd), Images.of(problems), damping=1e-6, head_start=False
        )
        return done.guess.parameters(), done.iterations

    def tuned(fit, problems: Problem):
        held = jnp.ones((3, problems.mask.shape[0]))
        done = self_tuned(lanes_last(fit), held, Images.of(problems))
        return done.guess.parameters(), done.rounds

    fit = jax.jit(by_chunks(fits, LANES))(problems)
    return {"given SDs": fixed, "self-tuned": tuned}, fit


def main() -> None:
    """Measure and write the tables."""
    quick = arguments(__doc__ or "").quick
    count, rounds = (256, 5) if quick else (1024, 21)
    problems = draw(count)
    sd = jaxcal.calibrate_batch(problems, "joint", "gaussian").sigma
    sigma = tuple(float(value) for value in np.sqrt(np.mean(np.asarray(sd) ** 2, axis=0)))
    cases = {
        "conventional": Case(problems, "conventional", "auto", None),
        "alternating": Case(problems, "alternating", "auto", None),
        "given SDs": Case(problems, "joint", "gaussian", sigma),
        "self-tuned": Case(problems, "joint", "gaussian", None),
    }
    rows: list[list[Any]] = []
    programs: dict[Any, Callable] = {}
    differs: dict[Any, float] = {}
    solvers, fit = solver_programs(problems, np.array(sigma))
    for name, solver in solvers.items():
        program = compiled(by_chunks(solver, LANES), fit, problems)
        programs["solver", name] = lambda program=program: program(fit, problems)
    for name, case in cases.items():
        solution = compiled(by_chunks(case.solve, LANES), case.problems)(case.problems)
        results = []
        for label, part in (("before", case.before), ("after", case.after)):
            program = compiled(by_chunks(part, LANES), solution, case.problems)
            programs[f"finish, {label}", name] = lambda program=program, s=solution, c=case: (
                program(s, c.problems)
            )
            results.append(program(solution, case.problems))
        differs["finish, after", name] = largest_difference(results[1], results[0])
        programs["whole", name] = lambda c=case: jaxcal.calibrate_batch(problems, **c.arguments)
        print(f"{name}: compiled", flush=True)

    taken = interleaved(programs, rounds, count)
    for (part, name), each in taken.items():
        low, middle, high = np.percentile(each, (25, 50, 75))
        rows.append([part, name, float(middle), float(low), float(high),
                     differs.get((part, name), "")])  # fmt: skip
    for part in ("solver", "whole"):
        ratio = taken[part, "self-tuned"] / taken[part, "given SDs"]
        low, middle, high = np.percentile(ratio, (25, 50, 75))
        rows.append([f"{part}: ratio", "self-tuned over given SDs", float(middle), float(low),
                     float(high), ""])  # fmt: skip
    for row in rows:
        print("  ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in row))
    rows.append([machine(), f"{count} problems, {rounds} rounds", "", "", "", ""])
    header = ["part", "method", "median_us", "quartile1_us", "quartile3_us", "largest_difference"]
    folder = results_folder(quick)
    write_table(folder / "self_tuned_cost.csv", header, rows)
    runs = {name: programs["solver", name] for name in solvers}
    write_table(folder / "stragglers.csv", *stragglers(solvers, runs, fit, problems, rounds))


def stragglers(solvers: dict, runs: dict, fit, problems: Problem, rounds: int) -> tuple[list, list]:
    """What waiting for the slowest of a chunk costs: header and rows."""
    count = problems.mask.shape[0]
    rows = []
    for name, solver in solvers.items():
        passes = np.asarray(runs[name]()[1])
        order = jnp.asarray(np.argsort(passes))
        ranked = jax.tree.map(lambda leaf, order=order: leaf[order], (fit, problems))
        program = compiled(by_chunks(solver, LANES), fit, problems)
        programs = {
            "as drawn": runs[name],
            "sorted": lambda program=program, ranked=ranked: program(*ranked),
        }
        for chunk in CHUNKS:
            other = compiled(by_chunks(solver, chunk), fit, problems)
            programs[f"chunks of {chunk}"] = lambda other=other: other(fit, problems)
        taken = interleaved(programs, rounds, count)
        made = np.mean(passes.reshape(-1, LANES).max(axis=1))
        for variant, each in taken.items():
            low, middle, high = np.percentile(each, (25, 50, 75))
            ratio = float(np.median(each / taken["as drawn"]))
            rows.append([name, variant, float(middle), float(low), float(high), ratio,
                         float(np.mean(passes)), float(made), int(passes.max())])  # fmt: skip
            print("  ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in rows[-1]))
    header = ["solver", "variant", "median_us", "quartile1_us", "quartile3_us", "over_as_drawn",
              "passes_needed_mean", "passes_made_mean", "passes_most"]  # fmt: skip
    return header, rows


if __name__ == "__main__":
    main()
