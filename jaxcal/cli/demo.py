"""``jaxcal demo``: an experiment simulated and calibrated three ways, beside the truth."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import click

from jaxcal.cli.common import (
    exit_code,
    import_engine,
    json_option,
    prepare_jax,
    print_json,
    print_page,
    progress,
    seed_option,
)
from jaxcal.solvers.names import Method

if TYPE_CHECKING:
    from pathlib import Path

    from jaxcal.data.recording import Recording
    from jaxcal.result.calibration import Calibration

_METHODS: tuple[Method, ...] = ("conventional", "alternating", "joint")
IMAGES, ELEVATION_MM, NOISE_MM = 50, 2.0, 0.5
RECORDING = "recording.h5"


@click.command(short_help="Try it: simulate an experiment and calibrate it three ways.")
@click.option("--out", type=click.Path(), metavar="DIR", help="Write a report to this folder.")
@seed_option("Seed of the simulation.")
@json_option
def demo(out: str | None, seed: int, as_json: bool) -> int:
    """Simulate an experiment, calibrate it three ways, and compare them.

    50 images whose target lies up to 2 mm out of the image plane, with 0.5 mm of noise on every
    element's distance; the alternation uses the paper's bound of 1 mm. The first run takes about a
    minute to compile; later ones take seconds.
    """
    import_engine()
    from jaxcal.io.outputs import check_output, is_simulated
    from jaxcal.report.record import calibration_record
    from jaxcal.report.write import prepare_folder
    from jaxcal.result.saved import dated
    from jaxcal.study.simulation import Protocol, simulate_recording

    with nullcontext() if out is None else prepare_folder(out) as folder:
        if folder is not None:
            check_output(folder / RECORDING, "a simulated recording", is_simulated)
        prepare_jax()
        with progress("simulating"):
            protocol = Protocol(images=IMAGES, elevation_mm=ELEVATION_MM, noise_mm=NOISE_MM)
            recording = simulate_recording(protocol, seed)
        with progress(f"compiling and solving ({', '.join(_METHODS)})"):
            results, milliseconds = _solve(recording)
        records: dict[Method, dict[str, Any]] = {
            name: dated(calibration_record(result, recording)) for name, result in results.items()
        }
        if folder is not None:
            with progress("drawing the report"):
                _write(folder, records, results, recording)
    if as_json:
        print_json({"seed": seed, "calibrations": records, "solve_ms": milliseconds})
    else:
        _print(records, milliseconds, seed, out)
    return exit_code(records.values())


def _solve(recording: Recording) -> tuple[dict[Method, Calibration], dict[Method, float]]:
    """Each method's calibration, and the milliseconds that it takes once it is compiled."""
    import jax

    from jaxcal.calibration.calibrate import calibrate
    from jaxcal.data.problem import Problem

    problem = Problem.from_recording(recording)

    def solved(method: Method) -> Calibration:
        return jax.block_until_ready(calibrate(problem, method))

    # Side by side: the compiler is most of the first run, and uses one core for each program.
    with ThreadPoolExecutor() as pool:
        results = dict(zip(_METHODS, pool.map(solved, _METHODS), strict=True))
    milliseconds: dict[Method, float] = {}
    for method in _METHODS:
        elapsed = []
        for _ in range(5):
            start = time.perf_counter()
            solved(method)
            elapsed.append(time.perf_counter() - start)
        milliseconds[method] = 1e3 * min(elapsed)
    return results, milliseconds


def _write(
    folder: Path,
    records: dict[Method, dict[str, Any]],
    results: dict[Method, Calibration],
    recording: Recording,
) -> None:
    """The report of the joint calibration, all three records, and the recording itself."""
    from jaxcal.data.problem import Problem
    from jaxcal.io.hdf5 import save
    from jaxcal.report.convergence import bounded_curves
    from jaxcal.report.write import write_report

    curves = bounded_curves(Problem.from_recording(recording), alternating=results["alternating"])
    save(recording, folder / RECORDING)
    write_report(folder, records["joint"], results["joint"], recording, curves, {**records})


def _print(
    records: dict[Method, dict[str, Any]],
    milliseconds: dict[Method, float],
    seed: int,
    out: str | None,
) -> None:
    from jaxcal.report.tables import comparison_table
    from jaxcal.report.verdict import verdict

    print_page(
        f"Simulated: {IMAGES} images, elevational offsets up to {ELEVATION_MM:g} mm, "
        f"{NOISE_MM:g} mm noise on every element's distance, seed {seed}.",
        comparison_table({**records}, {**milliseconds}),
        "The joint calibration:",
        *verdict(records["joint"]),
        *([] if out is None else ["", f"report: {out}"]),
    )
