"""Resident memory of a study from 10^4 to 10^6 trials: does it grow with the number of trials?

Each size is ``jaxcal study run`` in a process of its own (8 images, 16 elements, conventional), so
that the million takes minutes, and its resident set is read from /proc ten times a second. Reported
are the peak (the kernel's own high-water mark), the median over the first and the last quarter of
the run after compilation, and the growth with the trials that were written over its second half.
Seed 20261125.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from common import arguments, machine, save_figure, write_table

PERIOD_S, CHUNK = 0.1, 2048

SPEC = """
name = "memory"
seed = 20261125
trials = {trials}
chunk_trials = {chunk}
[conditions]
images = 8
test_images = 8
elevation_mm = 1
noise_mm = 0.5
[probe]
elements = 16
pitch_mm = 3.6
[[methods]]
name = "conventional"
method = "conventional"
"""


def status_mib(pid: int, field: str) -> float | None:
    """One line of /proc/PID/status in MiB; None when the process is over."""
    try:
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith(field + ":"):
                return int(line.split()[1]) / 1024
    except (FileNotFoundError, ProcessLookupError):
        pass
    return None


def watch(trials: int, place: Path) -> tuple[np.ndarray, float, float]:
    """Run a study of so many trials.

    Returns:
        (samples, 3) seconds, resident MiB and chunks written; the peak, MiB; the whole time, s.
    """
    folder, spec = place / f"study-{trials}", place / f"{trials}.toml"
    spec.write_text(SPEC.format(trials=trials, chunk=CHUNK))
    command = [sys.executable, "-m", "jaxcal.cli.main", "study", "run", str(spec), "--out",
               str(folder)]  # fmt: skip
    environment = {**os.environ, "JAXCAL_NO_CACHE": "1"}
    began, samples, peak = time.monotonic(), [], 0.0
    child = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    while child.poll() is None:
        resident, highest = status_mib(child.pid, "VmRSS"), status_mib(child.pid, "VmHWM")
        if resident is not None and highest is not None:
            written = len(os.listdir(folder / "chunks")) if (folder / "chunks").is_dir() else 0
            samples.append((time.monotonic() - began, resident, written))
            peak = max(peak, highest)
        time.sleep(PERIOD_S)
    seconds = time.monotonic() - began
    told = child.stdout.read().strip() if child.stdout else ""
    if child.returncode != 0:
        raise SystemExit(f"the study of {trials} trials failed")
    print(told, flush=True)
    return np.array(samples), peak, seconds


def main() -> None:
    quick, out = arguments(__doc__)
    sizes = (1000, 10_000, 100_000) if quick else (10_000, 100_000, 1_000_000)
    rows: list[list[object]] = []
    runs: dict[int, np.ndarray] = {}
    with tempfile.TemporaryDirectory() as folder:
        for trials in sizes:
            samples, peak, seconds = watch(trials, Path(folder))
            runs[trials] = samples
            # Compiled when the first chunk is there; before, memory is the compiler's.
            running = samples[samples[:, 2] >= 1]
            if len(running) < 8:
                running = samples[-8:]
            quarter = max(len(running) // 4, 1)
            first, last = np.median(running[:quarter, 1]), np.median(running[-quarter:, 1])
            half = running[len(running) // 2 :]
            # Per trial that was written meanwhile; a run of seconds has no slope to speak of.
            grown: object = ""
            if np.ptp(half[:, 0]) > 5:
                grown = 1e6 / CHUNK * float(np.polyfit(half[:, 2], half[:, 1], 1)[0])
            rows.append([trials, peak, float(first), float(last), grown, seconds,
                         trials / seconds])  # fmt: skip
            print(*rows[-1], flush=True)
    header = ["trials", "peak_mib", "first_quarter_mib", "last_quarter_mib",
              "growth_mib_per_million_trials", "seconds", "trials_a_second"]  # fmt: skip
    plot(out / "study_memory.png", runs, rows)
    write_table(out / "study_memory.csv", header, [*rows, [machine(), *[""] * 6]])


def plot(path: Path, runs: dict[int, np.ndarray], rows: list[list[object]]) -> None:
    """Resident memory over the share of the run that is done, and the peaks."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for trials, samples in runs.items():
        left.plot(samples[:, 0] / samples[-1, 0], samples[:, 1], label=f"{trials:,} trials")
    left.set(xlabel="share of the run", ylabel="resident memory, MiB", ylim=(0, None))
    left.legend(fontsize="small")
    sizes = [row[0] for row in rows]
    right.semilogx(sizes, [row[1] for row in rows], "o-", label="peak")
    right.semilogx(sizes, [row[3] for row in rows], "s-", label="median, last quarter")
    right.set(xlabel="trials", ylabel="resident memory, MiB", ylim=(0, None))
    right.legend(fontsize="small")
    for panel in (left, right):
        panel.grid(alpha=0.3)
    save_figure(figure, path, dpi=110)


if __name__ == "__main__":
    main()
