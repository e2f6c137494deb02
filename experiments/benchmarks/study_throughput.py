"""Trials a second of a complete study, against the same pipeline in numpy and scipy.

A trial is: draws (n = 50 images, 128 elements), distance fit, conventional, alternating (1 mm) and
self-tuned joint calibration, reconstruction precision; two sizes of offsets by two of noise. jaxcal
runs as a study does on two cores, by the worker function of its cluster in two processes, each on a
core of its own; the peer (study_peer.py, in three styles) in two processes on the same two cores,
with one thread of BLAS. Rounds alternate; only one side computes at a time. CPU time is reported
beside wall time: all programs are single-threaded, and what else runs on the machine does not count
in it. Before anything is timed, the peer analyses the study's own draws, and all reconstruction
precisions and SDs have to agree. At the end, a whole trial of the joint method is set against its
random numbers alone plus its solve alone. Seed 20261124.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import study_peer
from common import arguments, machine, save_figure, write_table

from jaxcal.runtime.jax_cache import enable_compilation_cache
from jaxcal.study.cluster import compute_from_text
from jaxcal.study.spec import Spec, parse_spec
from jaxcal.study.workers import core_groups

SEED, WORKERS = 20261124, 2
TOLERANCE_MM = 1e-6
"""Within which the peer's precisions and SDs have to be the study's."""

SPEC = f"""
name = "throughput"
seed = {SEED}
trials = 1000000
chunk_trials = 512
[conditions]
images = 50
test_images = 50
elevation_mm = [1, 3]
noise_mm = [0.5, 2]
[[methods]]
name = "conventional"
method = "conventional"
[[methods]]
name = "alternating"
method = "alternating"
max_elevation_mm = 1
[[methods]]
name = "joint self-tuned"
method = "joint"
prior = "gaussian"
"""


def pin(core: set[int]) -> None:
    """Keep this process on its core, before JAX counts them."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, core)


def pool() -> list[ProcessPoolExecutor]:
    """One process for each worker, on cores of its own."""
    context = multiprocessing.get_context("spawn")
    return [
        ProcessPoolExecutor(1, mp_context=context, initializer=pin, initargs=(group,))
        for group in core_groups(WORKERS)
    ]


WHERE = (("module", "jaxcal.study.spec"), ("name", "Spec"))
"""Of the class that the study's text is of (jaxcal.study.interface)."""


def study_share(canonical: str, chunks: list[int]) -> tuple[int, float]:
    """A worker's share of the study; returns how many trials it was, and their CPU seconds."""
    begun = time.process_time()
    trials = sum(compute_from_text(canonical, WHERE, index)[0]["rp"].shape[1] for index in chunks)
    return trials, time.process_time() - begun


def draws_of(spec: Spec, chunk: int, trials: int) -> list[study_peer.Drawn]:
    """The first trials of a chunk as the study draws them, with the distances."""
    import jax.numpy as jnp

    from jaxcal.study.pipeline import protocol
    from jaxcal.study.simulation import simulate

    part = spec.chunk(chunk)
    given = replace(protocol(spec.condition(part.condition), spec.probe), raw=True)
    indices = part.condition * spec.trials + part.start + np.arange(trials, dtype=np.uint32)
    root = jax.random.key(np.asarray(spec.seed, np.uint64))
    one = jax.vmap(lambda index: simulate(jax.random.fold_in(root, index), given))
    drawn = jax.jit(one)(jnp.asarray(indices, jnp.uint32))
    names = ("poses", "distances", "image_to_probe", "point", "test_poses", "test_points")
    arrays = [np.asarray(getattr(drawn, name)) for name in names]
    return [study_peer.Drawn(*(array[k] for array in arrays)) for k in range(trials)]


def agreement(spec: Spec, trials: int) -> dict[str, float]:
    """Largest difference (mm) of the peer's precisions and SDs from the study's, by style."""
    from jaxcal.study.pipeline import compute_chunk

    small = replace(spec, chunk_trials=64)
    apart: dict[str, float] = {style: 0.0 for style in study_peer.STYLES}
    for condition in range(small.condition_count):
        chunk = small.chunk(condition * small.chunks_per_condition)
        ours = compute_chunk(small, chunk)
        for k, drawn in enumerate(draws_of(small, chunk.index, trials)):
            for style in apart:
                # The others take much longer; a few trials of them show the same.
                if style != "best" and k >= max(2, trials // 8):
                    continue
                measured, sigma = study_peer.analyse(drawn, style=style)
                precision = np.abs(measured[:, 0] - ours["rp"][:, k]).max()
                sds = np.abs(sigma - ours["sigma"][2, k]).max()
                apart[style] = max(apart[style], float(precision), float(sds))
    return apart


def stage_times(canonical: str, repeats: int) -> dict[str, float]:
    """Where a trial's time goes in a worker, CPU s: the study's own compiled programs, one by one.

    Those in brackets are further programs, which the study does not run by themselves.
    """
    import jax.numpy as jnp

    import jaxcal
    from jaxcal.study import pipeline, trials
    from jaxcal.study.simulation import draw, draw_noise

    spec = Spec.from_canonical(canonical)
    devices = tuple(jax.local_devices())
    condition = spec.condition(spec.condition_count - 1)
    given, size = pipeline.protocol(condition, spec.probe), pipeline.BATCH_SIZE["cpu"]
    indices = np.arange(size * pipeline.MOST_PIECES, dtype=np.uint32).reshape(-1, size)
    seed = np.asarray(spec.seed, np.uint64)
    block = pipeline.Block(spec, condition, indices, devices)
    begin = pipeline.begin_program(100, devices)

    def numbers(indices, seed):
        keys = pipeline.trial_keys(indices, seed)
        drawn = jax.vmap(lambda key: (draw(key, given), draw_noise(key, given)))(keys)
        # A complex array is a pair of normals; its sum would do as well, but nobody draws so.
        return drawn

    def solve(batch):
        problems = trials.problems_of(batch.images)
        options = jaxcal.Options(differentiate=False)
        found = jaxcal.calibrate_batch(problems, prior="gaussian", options=options)
        # What is not read of the answer is not computed.
        return found.image_to_probe

    numbers_alone = pipeline.compile_pieces(numbers, devices, pieces=1)
    solve_alone = pipeline.compile_pieces(solve, devices, pieces=1)
    normals = pipeline.compile_pieces(
        lambda indices, seed: jax.vmap(lambda key: jax.random.normal(key, (50, 128), jnp.float32))(
            pipeline.trial_keys(indices, seed)
        ),
        devices,
        pieces=1,
    )
    runs = {
        "draws and distance fit": lambda: pipeline.Block(spec, condition, indices, devices).batch,
        "start and conventional": lambda: begin(block.batch),
        "(random numbers alone)": lambda: numbers_alone(indices, seed),
        "(6,400 normals by jax.random in float32)": lambda: normals(indices, seed),
        "(joint solve alone, from scratch)": lambda: solve_alone(block.batch),
    }
    for method in spec.methods:
        name = "what the conventional one stores" if method.name == "conventional" else method.name
        runs[name] = lambda m=method: block.measured(m)
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        jax.block_until_ready(run())
    for _ in range(repeats):
        for name, run in runs.items():
            began = time.process_time()
            jax.block_until_ready(run())
            spent[name].append((time.process_time() - began) / indices.size)
    return {name: float(np.median(times)) for name, times in spent.items()}


def whole_study(spec: Spec, trials: int) -> float:
    """Trials a second of ``run_study`` with two workers from start to end, programs cached."""
    from jaxcal.study import run_study

    spec = replace(spec, trials=trials, chunk_trials=min(trials, 512))
    with tempfile.TemporaryDirectory() as folder:
        summary = run_study(spec, Path(folder) / "study", workers=WORKERS)
    return summary.trials / summary.seconds


def main() -> None:
    quick, folder = arguments(__doc__)
    enable_compilation_cache()
    looped = {"best": 80, "usual": 32, "plain": 16}
    rounds, looped = (3, {name: n // 8 for name, n in looped.items()}) if quick else (15, looped)
    spec = parse_spec(SPEC)
    apart = agreement(spec, 8 if quick else 32)
    print("largest difference from the peer's results (mm):", apart, flush=True)
    if max(apart.values()) > TOLERANCE_MM:
        raise SystemExit(f"the peer's results differ by more than {TOLERANCE_MM:g} mm")

    canonical = spec.canonical()
    conditions = tuple(
        (spec.condition(k).elevation_mm, spec.condition(k).noise_mm)
        for k in range(spec.condition_count)
    )
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"  # inherited by the processes, read when they import numpy
    cache = getattr(jax.config, "jax_compilation_cache_dir", None)
    if cache is not None:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(cache)
    ours, theirs = pool(), pool()
    per_worker = 4  # chunks of each condition
    rates: dict[str, list[float]] = {"jaxcal": [], **{name: [] for name in looped}}
    busy: dict[str, list[float]] = {name: [] for name in rates}
    clocks = {style: np.zeros(len(study_peer.STAGES)) for style in looped}
    counted = dict.fromkeys(looped, 0)

    def study_round(number: int) -> float:
        asked = []
        for worker in range(WORKERS):
            first = (number * WORKERS + worker) * per_worker
            mine = range(first, first + per_worker)
            cells = range(spec.condition_count)
            asked.append([cell * spec.chunks_per_condition + k for cell in cells for k in mine])
        began = time.perf_counter()
        futures = [p.submit(study_share, canonical, s) for p, s in zip(ours, asked, strict=True)]
        shares = [future.result() for future in futures]
        elapsed = time.perf_counter() - began
        trials, cpu = (sum(column) for column in zip(*shares, strict=True))
        busy["jaxcal"].append(trials / cpu)
        return trials / elapsed

    def peer_round(number: int, style: str) -> float:
        trials = looped[style]
        began = time.perf_counter()
        futures = [
            p.submit(study_peer.run, (SEED, number, k), trials, conditions, style)
            for k, p in enumerate(theirs)
        ]
        results = [future.result() for future in futures]
        elapsed = time.perf_counter() - began
        done = WORKERS * trials * len(conditions)
        for _, clock, _ in results:
            clocks[style] += clock
        counted[style] += done
        busy[style].append(done / sum(cpu for _, _, cpu in results))
        return done / elapsed

    study_round(0)  # compiles
    for style in looped:
        peer_round(0, style)
        clocks[style][:], counted[style] = 0, 0
    for values in busy.values():
        values.clear()
    load = os.getloadavg()[0]
    for number in range(1, rounds + 1):
        rates["jaxcal"].append(study_round(number))
        for style in looped:
            rates[style].append(peer_round(number, style))
        print(number, {name: round(values[-1], 1) for name, values in rates.items()}, flush=True)
    loads = (load, os.getloadavg()[0])
    futures = [p.submit(stage_times, canonical, 10 if quick else 40) for p in ours]
    stages = [future.result() for future in futures]
    stages = {name: float(np.mean([one[name] for one in stages])) for name in stages[0]}
    for one in (*ours, *theirs):
        one.shutdown()
    complete = whole_study(spec, 256 if quick else 4096)

    rows: list[list[object]] = []

    def add(label: str, values: np.ndarray | list[float]) -> None:
        low, middle, high = (float(value) for value in np.percentile(values, [25, 50, 75]))
        rows.append([label, middle, low, high])

    for table, unit in ((rates, "a second, two cores"), (busy, "a second of CPU time, one core")):
        for name, values in table.items():
            label = "jaxcal study" if name == "jaxcal" else f"numpy and scipy, {name}"
            add(f"{label}: trials {unit}", values)
        for style in looped:
            ratio = np.array(table["jaxcal"]) / np.array(table[style])
            add(f"ratio to numpy and scipy, {style}: trials {unit}", ratio)
    rows.append(["jaxcal study run --workers 2, start and files included, programs cached: "
                 "trials a second", complete, "", ""])  # fmt: skip
    for name, seconds in stages.items():
        rows.append([f"jaxcal, CPU us a trial: {name}", 1e6 * seconds, "", ""])
    parts = ("draws and distance fit", "start and conventional", "joint self-tuned")
    alone = stages["(random numbers alone)"] + stages["(joint solve alone, from scratch)"]
    rows.append(["a whole trial of the joint method over its random numbers alone plus its solve "
                 "alone", sum(stages[part] for part in parts) / alone, "", ""])  # fmt: skip
    for style in looped:
        for name, seconds in zip(study_peer.STAGES, clocks[style], strict=True):
            label = f"numpy and scipy, {style}, CPU us a trial: {name}"
            rows.append([label, 1e6 * float(seconds) / counted[style], "", ""])
    for style, value in apart.items():
        rows.append([f"largest difference from numpy and scipy, {style} (mm)", value, "", ""])
    rows += [
        ["rounds", rounds, "", ""],
        ["load average before and after", loads[0], loads[1], ""],
        [machine(), "", "", ""],
    ]
    write_table(folder / "study_throughput.csv", ["what", "median", "quartile_1", "quartile_3"],
                rows)  # fmt: skip
    plot(folder / "study_throughput.png", rates, stages, clocks)
    for row in rows:
        print(*row)


def plot(
    path: Path,
    rates: dict[str, list[float]],
    stages: dict[str, float],
    clocks: dict[str, np.ndarray],
) -> None:
    """Rates, round by round, and where a trial's time goes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    labels = {"jaxcal": "jaxcal study"}
    labels |= {style: f"numpy and\nscipy, {style}" for style in study_peer.STYLES}
    left.boxplot(list(rates.values()), tick_labels=list(labels.values()), whis=(0, 100))
    left.set(yscale="log", ylabel="complete trials a second, two cores",
             title=f"n = 50; {len(rates['jaxcal'])} alternating rounds")  # fmt: skip
    for place, values in enumerate(rates.values(), 1):
        left.annotate(f"{np.median(values):,.0f}", (place, np.median(values)), (14, 4),
                      textcoords="offset points")  # fmt: skip
    left.grid(axis="y", alpha=0.3)
    ours: dict[str, float] = {name: t for name, t in stages.items() if not name.startswith("(")}
    columns = {"jaxcal": ours}
    for style, clock in clocks.items():
        columns[style] = {n: float(t) for n, t in zip(study_peer.STAGES, clock, strict=True)}
    parts = ("draws", "distance fit", "draws and distance fit", "start and conventional",
             "what the conventional one stores", *study_peer.METHODS, "metric")  # fmt: skip
    for k, part in enumerate(parts):
        base = [sum(c.get(p, 0.0) for p in parts[:k]) / sum(c.values()) for c in columns.values()]
        height = [c.get(part, 0.0) / sum(c.values()) for c in columns.values()]
        right.bar(list(labels.values()), height, bottom=base, label=part)
    right.set(ylabel="share of a trial's time", title="where the time goes")
    right.legend(fontsize="small", loc="center left", bbox_to_anchor=(1, 0.5))
    save_figure(figure, path, dpi=110)


if __name__ == "__main__":
    main()
