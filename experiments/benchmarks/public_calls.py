"""What the public calls cost: a problem in a batch, the first call, the size of the program.

Everything goes through ``jaxcal.calibrate_batch`` and ``jaxcal.calibrate``, as a user meets them:

- *batch*: 1,024 problems of 50 images (times of flight: 64 of 32 elements), on one pinned core,
  float64, status, X and covariance read into numpy; CPU and wall microseconds a problem, median
  and quartiles of the rounds;
- *first call*: each method in a process of its own that has compiled nothing: CPU and wall seconds
  of that first call on the batch, imports and draws excluded;
- *program*: StableHLO lines that define a value, of the default path (joint, auto) of one problem
  and of a batch, as traced inside somebody's ``jax.jit``.

The load of the machine when each process began is in the table (1-minute load average). Beside
other work wall times say nothing, and CPU times are too long by what the caches lose. Offsets to
2 mm, 2 mm of noise on each element's distance, 0.2 mm on the times of flight. Seed 20261121.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

SEED = 20261121
IMAGES, PROBLEMS = 50, 1024
CHANNEL_PROBLEMS, ELEMENTS = 64, 32
QUICK_PROBLEMS, QUICK_CHANNEL_PROBLEMS = 128, 8
ROUNDS, QUICK_ROUNDS = 15, 3
LONGEST_S = 20.0
"""No method is measured for longer, once compiled."""

SIGMA = (0.36, 0.18, 1.15)
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "conventional": ("points", {"method": "conventional"}),
    "given SDs": ("points", {"sigma": SIGMA}),
    "REML": ("points", {"prior": "gaussian"}),
    "auto": ("points", {}),
    "alternation": ("points", {"method": "alternating", "max_elevation": 2.0}),
    "bounded": ("points", {"prior": "bounded", "max_elevation": 2.0}),
    "pixels, unknown scale": ("pixels", {"prior": "gaussian", "estimate": ("scale",)}),
    "channels": ("channels", {"prior": "gaussian", "data": "channels"}),
}
"""Name, kind of problem, arguments of ``calibrate_batch``."""

HEADER = [
    "part",
    "method",
    "problems",
    "rounds",
    "median",
    "quartile_low",
    "quartile_high",
    "unit",
    "load_average",
]


def draw(kind: str, count: int):
    """So many problems of a kind, in a batch."""
    import jax
    import jax.numpy as jnp

    import jaxcal

    probe = jaxcal.LinearProbe(elements=ELEMENTS, pitch_mm=58.5 / ELEMENTS)
    channels = kind == "channels"
    protocol = jaxcal.Protocol(
        images=IMAGES,
        test_images=2,
        elevation_mm=2.0,
        noise_mm=0.2 if channels else 2.0,
        **({"probe": probe, "raw": True} if channels else {}),
    )
    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(SEED), count)

        def one(key):
            return jaxcal.simulate(key, protocol).problem(probe=probe if channels else None)

        problems = jax.jit(lambda keys: jax.lax.map(one, keys, batch_size=8))(keys)
        if kind == "pixels":
            spacing = jnp.asarray([0.15, 0.14])
            problems = replace(
                problems,
                measurements=problems.measurements / spacing,
                pixels=True,
                spacing_known=False,
            )
        return jax.block_until_ready(problems)


def measure(name: str, quick: bool) -> dict[str, Any]:
    """One method in this process: its first call, then rounds."""
    load = os.getloadavg()[0]
    os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[-1]})  # before JAX counts cores
    import jax
    import numpy as np

    import jaxcal

    kind, keywords = METHODS[name]
    count = PROBLEMS if kind != "channels" else CHANNEL_PROBLEMS
    if quick:
        count = QUICK_PROBLEMS if kind != "channels" else QUICK_CHANNEL_PROBLEMS
    problems = draw(kind, count)
    jax.clear_caches()

    def call() -> tuple[float, float]:
        began = time.process_time(), time.perf_counter()
        result = jaxcal.calibrate_batch(problems, **keywords)
        read = (result.status, np.asarray(result.image_to_probe), np.asarray(result.covariance))
        assert np.mean(read[0] == "converged") > 0.9, f"{name}: {np.unique(read[0])}"
        return time.process_time() - began[0], time.perf_counter() - began[1]

    first, once = call(), call()
    rounds = int(np.clip(LONGEST_S / once[1], 3, QUICK_ROUNDS if quick else ROUNDS))
    taken = np.array([call() for _ in range(rounds)]) / count * 1e6
    cpu, wall = np.percentile(taken, (50, 25, 75), axis=0).T.tolist()
    return {
        "first": first,
        "cpu": cpu,
        "wall": wall,
        "rounds": rounds,
        "problems": count,
        "load": load,
    }


def program() -> dict[str, Any]:
    """Lines that define a value in the default path's program."""
    load = os.getloadavg()[0]
    import jax

    import jaxcal

    problems = draw("points", 64)
    defines = re.compile(r"^\s*%\S+(:\d+)? = ", re.MULTILINE)

    def lines(call, argument) -> int:
        with jax.enable_x64(True):
            return len(defines.findall(jax.jit(call).lower(argument).as_text()))

    one = problems[0]
    return {
        "one problem": lines(jaxcal.calibrate, one),
        "load": load,
        "a batch": lines(jaxcal.calibrate_batch, problems),
    }


def in_a_fresh_process(*words: str) -> dict[str, Any]:
    """What another process of this script finds."""
    command = [sys.executable, __file__, *words]
    environment = os.environ | {"JAXCAL_NO_CACHE": "1", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure every method in a process of its own and write the table."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from common import arguments, machine, write_table

    quick, folder = arguments(__doc__)
    flag = ["--quick"] if quick else []
    rows: list[list[Any]] = []
    for name in METHODS:
        found = in_a_fresh_process("--method", name, *flag)
        load, first = found["load"], found["first"]
        for kind, unit in (("cpu", "CPU us a problem"), ("wall", "us a problem")):
            rows.append(
                ["batch", name, found["problems"], found["rounds"], *found[kind], unit, load]
            )
        for seconds, unit in zip(first, ("CPU s", "s"), strict=True):
            rows.append(["first call", name, found["problems"], 1, seconds, "", "", unit, load])
        print(
            f"{name}: {found['cpu'][0]:.4g} CPU us a problem, first call {first[0]:.1f} CPU s "
            f"(load {load:.1f})",
            flush=True,
        )
    sizes = in_a_fresh_process("--program")
    for which in ("one problem", "a batch"):
        rows.append(
            [
                "program",
                f"auto, {which}",
                1 if which == "one problem" else 64,
                "",
                sizes[which],
                "",
                "",
                "StableHLO lines",
                sizes["load"],
            ]
        )
        print(f"auto, {which}: {sizes[which]} StableHLO lines", flush=True)
    rows.append(["", machine(), "", "", "", "", "", "", ""])
    write_table(folder / "public_calls.csv", HEADER, rows)


if __name__ == "__main__":
    if "--method" in sys.argv:
        asked = sys.argv[sys.argv.index("--method") + 1]
        print(json.dumps(measure(asked, "--quick" in sys.argv)))
    elif "--program" in sys.argv:
        print(json.dumps(program()))
    else:
        main()
