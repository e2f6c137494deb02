"""How long a person waits for an answer: fresh processes, cold and warm.

Every command runs in processes of its own, in rounds that go through all of them, each beside a
process that imports JAX and computes one sum; ratios are to that one of the same round. With a
cache folder of the round's own:

- *cold*: the first run ever;
- *warm*: the same again;
- *other number*: fewer images of the same bucket, which no run has seen before.

The recordings: the public cross-wire one where it lies beside this repository
(``shared/data/crosswire``; otherwise 54 simulated points in pixels), times of flight of a
curvilinear probe (60 images), a study of one condition and one method, and the emulated bench to
its first estimate. CPU seconds are of the process and all that it started (not of the bench, which
is killed). Beside other work wall times say little: the 1-minute load average is in the table.
Seed 20261122.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

SEED = 20261122
DATA = Path(__file__).parents[3] / "shared" / "data" / "crosswire"
ROUNDS, QUICK_ROUNDS = 5, 1
IMAGES, FEWER = 54, 51
CHANNEL_IMAGES, CHANNEL_FEWER = 60, 57
SPACING_MM = (0.15, 0.14)

METHODS: dict[str, list[str]] = {
    "conventional": ["--method", "conventional"],
    "alternating": ["--method", "alternating", "--max-elevation", "2"],
    "joint, auto": [],
    "joint, gaussian": ["--prior", "gaussian"],
    "joint, robust": ["--robust"],
}
QUICK_METHODS = ("conventional", "joint, auto")

STUDY = f"""
name = "one"
seed = {SEED}
trials = 64
[conditions]
images = 50
elevation_mm = 2
noise_mm = 0.5
[[methods]]
name = "joint"
method = "joint"
"""

REFERENCE = "import jax; (jax.numpy.zeros(3) + 1).block_until_ready()"
HEADER = ["command", "state", "rounds", "wall_s", "cpu_s", "wall_ratio", "cpu_ratio", "load"]
ESTIMATE = "X at ("
"""What ``jaxcal-hw acquire`` says with its first estimate."""


@dataclass(frozen=True)
class Case:
    """Something that a person runs.

    Attributes:
        name: of the table's row.
        cold: the arguments of ``python -m``.
        other: the arguments with another number of images, or none.
        until: text of standard output at which the answer is there; none: the end.
    """

    name: str
    cold: list[str]
    other: list[str]
    until: str = ""


def recordings(folder: Path) -> tuple[Path, Path, Path, Path]:
    """Cross-wire points and times of flight, whole and cut."""
    import jaxcal
    from jaxcal.data.recording import OF_SOME
    from jaxcal.io.text import read_crosswire

    if DATA.is_dir():
        whole = read_crosswire(
            DATA / "crossWirePhantomTransformations.txt", DATA / "crossWirePhantom2DPoints.txt"
        )
    else:
        protocol = jaxcal.Protocol(images=IMAGES, elevation_mm=2.0, noise_mm=0.5)
        drawn = jaxcal.simulate_recording(protocol, SEED).calibration
        whole = jaxcal.Recording(
            jaxcal.make_images(drawn.poses, drawn.measurements / np.array(SPACING_MM), "pixel")
        )
    probe = jaxcal.CurvilinearProbe()
    protocol = jaxcal.Protocol(
        images=CHANNEL_IMAGES, elevation_mm=2.0, noise_mm=0.5, probe=probe, raw=True
    )
    raw = jaxcal.simulate_recording(protocol, SEED)
    of_each_image = ("poses", "measurements", "mask", "velocity", *OF_SOME)
    paths = []
    for name, recording, count in (
        ("points", whole, IMAGES),
        ("fewer_points", whole, FEWER),
        ("raw", raw, CHANNEL_IMAGES),
        ("fewer_raw", raw, CHANNEL_FEWER),
    ):
        images = recording.calibration
        rows = {
            key: None if getattr(images, key) is None else getattr(images, key)[:count]
            for key in of_each_image
        }
        paths.append(folder / f"{name}.h5")
        # What is known of all images does not fit to a part of them.
        truth = recording.truth if count == len(images.poses) else None
        cut = replace(recording, calibration=replace(images, **rows), truth=truth)
        jaxcal.save(cut, paths[-1])
    return paths[0], paths[1], paths[2], paths[3]


def cases(folder: Path, quick: bool) -> list[Case]:
    """All commands."""
    points, fewer, raw, fewer_raw = map(str, recordings(folder))
    found = []
    for name, words in METHODS.items():
        if quick and name not in QUICK_METHODS:
            continue
        others = ["--estimate", "scale", "--json", *words]
        start = ["jaxcal", "calibrate"]
        found.append(Case(name, [*start, points, *others], [*start, fewer, *others]))
    start = ["jaxcal", "calibrate"]
    found.append(
        Case("channels", [*start, raw, "--json"], [] if quick else [*start, fewer_raw, "--json"])
    )
    (folder / "one.toml").write_text(STUDY)
    found.append(Case("study", ["jaxcal", "study", "run", str(folder / "one.toml"), "--out"], []))
    bench = ["hw", "acquire", "--bench", "--images", "60"]
    found.append(Case("bench, first estimate", bench, [], ESTIMATE))
    return found


def measure(words: list[str], environment: dict[str, str], until: str = "") -> tuple[float, float]:
    """Wall and CPU seconds of a process and of those that it started.

    Args:
        words: after ``python``.
        environment: of the process.
        until: text on its output at which it is stopped.
    """
    before, began = os.times(), time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *words], env=environment, text=True, start_new_session=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    assert process.stdout is not None
    said, seen, cpu = [], not until, 0.0
    for line in process.stdout:
        said.append(line)
        if until and until in line:
            seen = True
            taken = time.perf_counter() - began
            cpu = cpu_of(process.pid)
            process.send_signal(signal.SIGINT)  # the robot is stopped, the file closed
            process.communicate()
            return taken, cpu
    process.wait()
    # An answer is an answer, however good it is.
    if process.returncode not in (0, 3, 5) or not seen:
        raise SystemExit(f"{' '.join(words)} ended with {process.returncode}:\n{''.join(said)}")
    after = os.times()
    spent = after.children_user + after.children_system
    return time.perf_counter() - began, spent - before.children_user - before.children_system


def cpu_of(pid: int) -> float:
    """CPU seconds of a running process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def one_round(every: list[Case], folder: Path) -> list[tuple[str, str, float, float, float, float]]:
    """Each command in each state, and the reference beside it."""
    found = []
    for case in every:
        home = tempfile.mkdtemp(dir=folder)
        environment = os.environ | {"XDG_CACHE_HOME": home, "JAX_PLATFORMS": "cpu"}
        environment.pop("JAXCAL_NO_CACHE", None)
        states = [("cold", case.cold), ("warm", case.cold), ("other number", case.other)]
        for number, (state, words) in enumerate(states):
            if not words:
                continue
            if words[-1] == "--out":
                words = [*words, f"{home}/out{number}"]
            elif words[0] == "hw":
                words = [*words[:2], f"{home}/out{number}.h5", *words[2:]]
            reference = measure(["-c", REFERENCE], environment)
            taken = measure(["-m", *words], environment, case.until)
            found.append((case.name, state, *taken, *reference))
            print(
                f"{case.name}, {state}: {taken[0]:.2f} s, {taken[1]:.2f} CPU s; reference "
                f"{reference[0]:.2f} s, {reference[1]:.2f} CPU s",
                flush=True,
            )
    return found


def main() -> None:
    """Measure and write the table."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from common import arguments, write_table

    quick, folder = arguments(__doc__)
    with tempfile.TemporaryDirectory() as name:
        every = cases(Path(name), quick)
        load = os.getloadavg()[0]
        rounds = QUICK_ROUNDS if quick else ROUNDS
        found: list[tuple] = []
        for _ in range(rounds):
            found += one_round(every, Path(name))
            write_table(folder / "time_to_answer.csv", HEADER, medians(found, load))


def medians(found: list[tuple], load: float) -> list[list[object]]:
    """The table of all rounds so far."""
    from common import machine

    rows: list[list[object]] = []
    for key in dict.fromkeys(row[:2] for row in found):
        numbers = np.array([row[2:] for row in found if row[:2] == key])
        ratios = numbers[:, :2] / numbers[:, 2:]
        middle = [*np.median(numbers[:, :2], axis=0), *np.median(ratios, axis=0)]
        rows.append([*key, len(numbers), *map(float, middle), load])
    rows.append(["", machine(), "", "", "", "", "", ""])
    return rows


if __name__ == "__main__":
    main()
