"""Record the golden corpus: the answers of the code as it stands.

    python tests/golden/make.py                      # answers of all families, inputs as stored
    python tests/golden/make.py --family points12    # of one
    python tests/golden/make.py --call auto --call uniform   # these calls of all families
    python tests/golden/make.py --inputs             # draw the inputs anew, too

Each file says which commit and versions it was written by. When one may do that: README.md.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from dataclasses import replace
from datetime import date
from importlib.metadata import version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from golden.flags import set_flags

set_flags()

import jax  # noqa: E402
import numpy as np  # noqa: E402

from golden import corpus, draws  # noqa: E402


def written() -> dict[str, str]:
    """By what a file is written."""
    folder = Path(__file__).parent

    def git(*words: str) -> str:
        done = subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True)
        return done.stdout.strip()

    changed = git("status", "--porcelain", "--", str(folder.parents[1] / "jaxcal"))
    names = ("jax", "jaxlib", "numpy", "equinox", "optimistix")
    return {
        "commit": git("rev-parse", "HEAD") + (" with changes to jaxcal/" if changed else ""),
        "date": date.today().isoformat(),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "XLA_FLAGS": os.environ["XLA_FLAGS"],
    } | {name: version(name) for name in names}


def gradient_rows(family: corpus.Family, name: str) -> np.ndarray:
    """Problems whose answer by that call is differentiable, as it says itself."""
    rows = np.flatnonzero(family.usable())
    call = family.call(name)
    found = corpus.compute(family, call, call.roads[-1], rows)
    good = rows[found["differentiable"] & (found["status_code"] == 0)]
    return good[np.linspace(0, len(good) - 1, corpus.GRADIENT_PROBLEMS).astype(int)]


def record_gradients(again: bool) -> None:
    """Write the derivatives' file, after each call; those that are there already stay.

    Args:
        again: record them all.
    """
    recorded = {} if again else corpus.recorded_gradients()
    for name, call_name in corpus.GRADIENTS:
        if f"{name}/{call_name}" in recorded:
            continue
        began = time.perf_counter()
        family, _ = corpus.load(name)
        images = family.arrays["mask"].shape[1]
        weight = np.random.default_rng(draws.SEED).normal(size=15 + images)
        weight[:12].reshape(3, 4)[:, :3] *= 50.0  # rotations in mm at 50 mm
        rows = gradient_rows(family, call_name)
        found = corpus.gradient_arrays(family, family.call(call_name), rows, weight)
        recorded[f"{name}/{call_name}"] = found
        arrays = {
            f"{which}/{key}": v for which, each in recorded.items() for key, v in each.items()
        }
        arrays["about"] = np.array(json.dumps(written()))
        np.savez_compressed(corpus.FOLDER / "gradients.npz", **arrays)  # pyright: ignore
        jax.clear_caches()
        print(f"gradient {name} {call_name}: {time.perf_counter() - began:.0f} s", flush=True)


def main() -> None:
    """Record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--inputs", action="store_true", help="draw the problems anew")
    parser.add_argument("--family", action="append", help="only this one (or gradients)")
    parser.add_argument("--call", action="append", help="only this call's answers")
    parser.add_argument("--again", action="store_true", help="gradients: also those recorded")
    chosen = parser.parse_args()
    wanted = chosen.family or [*corpus.CALLS, "gradients"]
    for family in draws.families():
        if family.name not in wanted:
            continue
        if not chosen.inputs:
            family, _ = corpus.load(family.name)
        answers, about = {}, written()
        if chosen.call and not chosen.inputs:
            answers = corpus.load(family.name)[1]
            about = family.written | {f"{name} by": about["commit"] for name in chosen.call}
        for call in corpus.CALLS[family.name]:
            if chosen.call and call.name not in chosen.call:
                continue
            for road in call.roads:
                began = time.perf_counter()
                answers[call.name, road] = corpus.compute(family, call, road)
                jax.clear_caches()
                seconds = time.perf_counter() - began
                print(f"{family.name} {call.name} {road}: {seconds:.0f} s", flush=True)
        corpus.save(replace(family, written=about), answers)
    if "gradients" in wanted:
        record_gradients(chosen.again)


if __name__ == "__main__":
    main()
