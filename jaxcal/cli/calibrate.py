"""``jaxcal calibrate``: one recording to its transform, with a verdict and a report."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from jaxcal import InputError
from jaxcal.cli.common import (
    CONE,
    POSITIVE,
    REQUIRED,
    WORDS,
    ImageNumbers,
    import_engine,
    json_option,
    prepare_jax,
    print_json,
    print_page,
    progress,
    segmented,
    verdict_code,
)
from jaxcal.cli.export import NAMING, TEXTS, check_configuration, patched, written
from jaxcal.report.thresholds import FAIR_MM, GOOD_MM, WIDEST
from jaxcal.runtime.messages import runs_in_words
from jaxcal.solvers.names import Data, Method, PriorName, SolverName

if TYPE_CHECKING:
    from jaxcal.calibration.calibrate import Request
    from jaxcal.data.recording import Recording
    from jaxcal.report.convergence import Curve
    from jaxcal.result.calibration import Calibration
    from jaxcal.result.transform import SaveFormat


def _one_recording(
    context: click.Context, parameter: click.Parameter, given: tuple[str, ...]
) -> str:
    if len(given) == 1:
        return given[0]
    raise click.UsageError(
        f"one recording is calibrated, not {len(given)} files: jaxcal import makes one, also from "
        "a file of poses and a file of points",
        context,
    )


@click.command(short_help="Calibrate from a recording: transform, verdict, report.")
@click.argument(
    "recording", type=click.Path(), nargs=-1, required=True, callback=_one_recording, metavar="REC"
)
@click.option(
    "--method",
    type=click.Choice(get_args(Method)),
    default="joint",
    show_default=True,
    help="joint: estimate transform, target and elevational offsets together; alternating: the "
    "paper's method; conventional: assume that every target lies in the image plane.",
)
@click.option(
    "--prior",
    type=click.Choice(get_args(PriorName)),
    default="auto",
    show_default=True,
    help="Distribution of the offsets in the joint method; auto: an average over several, "
    "weighted by their probability; uniform: only if something limits the offsets on both sides "
    "(otherwise the stated error is too small).",
)
@click.option(
    "--max-elevation",
    type=POSITIVE,
    metavar="MM",
    help="Bound on the offsets instead of the recording's own, except with --prior gaussian. "
    "Without either: 1 mm with --method alternating and --prior bounded, none with other priors.",
)
@click.option(
    "--sigma",
    type=POSITIVE,
    nargs=3,
    metavar="LATERAL RANGE ELEVATIONAL",
    help="SDs of the errors, mm, for the Gaussian prior instead of tuned ones.",
)
@click.option(
    "--estimate",
    metavar="LIST",
    help="Further unknowns, separated by commas: scale (the size of a pixel), sound-speed, delay.",
)
@click.option(
    "--data",
    type=click.Choice(get_args(Data)),
    default="auto",
    show_default=True,
    help="What the joint method fits if the recording holds times of flight: the points segmented "
    "from them, or the time of every element (channels); auto: whichever holds more information.",
)
@click.option(
    "--robust/--no-robust",
    default=False,
    show_default=True,
    help="Find the images that agree with each other first, and leave the others out: wrong "
    "echoes, wrong clicks, a slipped mount.",
)
@click.option(
    "--leave-out",
    type=ImageNumbers(),
    metavar="LIST",
    help="Images that were looked at and found wrong, by the numbers of the report (from 0), e.g. "
    "11,12,20-25. If images are chosen by their errors alone, the stated error is too small.",
)
@click.option(
    "--solver",
    type=click.Choice(get_args(SolverName)),
    help="Solver of the conventional method; lm by default.",
)
@click.option(
    "--tolerance-mm",
    type=POSITIVE,
    metavar="MM",
    help="The alternation stops when a round moves the transform by less than this (0.1 by "
    "default) and turns it by less than --tolerance-rad.",
)
@click.option(
    "--tolerance-rad",
    type=POSITIVE,
    metavar="RAD",
    help="Rotation below which the alternation stops, see --tolerance-mm (0.001 by default).",
)
@click.option(
    "--max-rounds",
    type=click.IntRange(min=1),
    metavar="N",
    help="Largest number of rounds of the alternation (1000 by default).",
)
@click.option(
    "--test",
    type=click.Path(),
    metavar="REC2",
    help="Recording whose images are the independent test set.",
)
@click.option(
    "--cross-validate",
    is_flag=True,
    help="Test every image with a calibration from the others: precision on images that were not "
    "used, and how much each image changes the calibration.",
)
@click.option(
    "--bootstrap",
    type=click.IntRange(2, 100_000),
    metavar="N",
    help="Calibrate N times from images drawn with replacement, and say how the calibrations "
    "scatter.",
)
@click.option(
    "--export",
    "exports",
    multiple=True,
    metavar="FORMAT:PATH",
    help="Also write the transform for another program: plus:CONFIG.xml (put into this "
    "configuration), slicer:PATH, itk:PATH, ros:PATH, tusrec:PATH or numpy:PATH.",
)
@click.option(
    "--tre",
    "tre_points",
    type=float,
    nargs=2,
    multiple=True,
    metavar="X Y",
    help="The error to expect at this point of the image (pixels u v, or mm lateral and depth as "
    "the recording has them), with its interval.",
)
@click.option(
    "--cone",
    type=CONE,
    metavar="DEG",
    help="Largest tilt of the poses that are advised, from the middle orientation of the images "
    "(that of the images by default, at least 30), up to 85, for a probe that cannot be tilted "
    "further.",
)
@click.option(
    "--require",
    type=click.Choice(WORDS),
    default=REQUIRED,
    show_default=True,
    help=f"Exit with status 5 if the verdict is worse: good is an error up to {GOOD_MM:g} mm at "
    f"the image (its interval up to {WIDEST * GOOD_MM:g} mm), fair up to {FAIR_MM:g} mm "
    f"({WIDEST * FAIR_MM:g} mm).",
)
@click.option("--report", type=click.Path(), metavar="HTML", help="Write a page for a browser.")
@click.option("--out", type=click.Path(), metavar="DIR", help="Write a report to this folder.")
@json_option
def calibrate(
    recording: str,
    method: Method,
    prior: PriorName,
    max_elevation: float | None,
    sigma: tuple[float, float, float] | None,
    estimate: str | None,
    solver: SolverName | None,
    data: Data,
    robust: bool,
    leave_out: tuple[int, ...] | None,
    test: str | None,
    cross_validate: bool,
    bootstrap: int | None,
    exports: tuple[str, ...],
    tre_points: tuple[tuple[float, float], ...],
    cone: float | None,
    require: str,
    report: str | None,
    out: str | None,
    as_json: bool,
    **alternation: Any,
) -> int:
    """Calibrate from the recording REC. No starting guess is needed."""
    inputs = [recording] if test is None else [recording, test]
    targets = [_export_target(export, inputs, out) for export in exports]
    import_engine()
    from jaxcal.calibration.calibrate import Request, check_alternation, check_request
    from jaxcal.calibration.calibrate import calibrate as solve
    from jaxcal.model.unknowns import unknown_names
    from jaxcal.solvers.plan import Options

    chosen = {name: value for name, value in alternation.items() if value is not None}
    check_alternation(["--" + name.replace("_", "-") for name in chosen], method)
    options = Options(**chosen, solver=solver or "lm")
    request = Request(
        method,
        prior,
        max_elevation,
        sigma,
        estimate=unknown_names(estimate),
        data=data,
        options=options,
        robust=robust,
    )
    check_request(request)
    _check_apart(targets, report, out)
    from jaxcal.io.given_files import naming
    from jaxcal.report.accuracy import settle
    from jaxcal.report.convergence import KEPT
    from jaxcal.report.next_poses import next_poses_record
    from jaxcal.report.record import calibration_record
    from jaxcal.report.write import prepare_folder, write_report
    from jaxcal.result.saved import dated

    measured, test_data, notes = _read(recording, leave_out, test)
    _check_exports(measured, targets, inputs)
    prepare_jax()
    with nullcontext() if out is None else prepare_folder(out) as folder:
        if report is not None:
            from jaxcal.report.page import check_page

            # The page may be wanted in the report's folder, which is there from now on.
            check_page(report, inputs)
        with progress(f"calibrating ({method})") as show:
            asked = request
            if folder is not None and method == "conventional":
                asked = replace(request, options=replace(options, trace=KEPT))
            with _first_answer(measured, request, show), naming(recording):
                result = solve(measured, **vars(asked))
            record = calibration_record(result, measured, test_data, tre_points)
            record["warnings"] += notes
            record["next_poses"] = next_poses_record(result, measured, cone)
        if cross_validate or bootstrap is not None:
            with progress("calibrating over and over"), naming(recording):
                record |= _resampled(measured, request, result, cross_validate, bootstrap)
            settle(record)
        record = dated(record)
        if folder is not None:
            with progress("drawing the report"):
                write_report(folder, record, result, measured, _curves(request, result))
    if report is not None:
        from jaxcal.report.page import write_page

        write_page(report, record, result, measured)
    exported = _export(record, recording, targets)
    if as_json:
        print_json(record | ({"exported": exported} if targets else {}))
    else:
        _print(record, [path for path in (out, report) if path is not None])
        print_page(*exported)
    return verdict_code(record, require)


def _read(
    recording: str, leave_out: tuple[int, ...] | None, test: str | None
) -> tuple[Recording, Recording | None, list[str]]:
    """The images to calibrate with, those of a test, and what there is to say of both."""
    from jaxcal.io.given_files import naming
    from jaxcal.io.hdf5 import load
    from jaxcal.report.record import check_test_images

    measured, notes = segmented(load(recording))
    if leave_out:
        with naming(recording):
            images = measured.calibration.without(leave_out)
        measured = replace(measured, calibration=images)
        notes.append(f"left out as requested: images {runs_in_words(leave_out)}")
    test_data = None
    if test is not None:
        test_data, told = segmented(load(test))
        notes += [f"{test}: {text}" for text in told]
    check_test_images(measured, test_data)
    return measured, test_data, notes


def _export_target(text: str, inputs: list[str], out: str | None) -> tuple[SaveFormat, str]:
    from jaxcal.io.atomic import check_writable
    from jaxcal.result.saved import check_target

    name, colon, path = text.partition(":")
    known: dict[str, SaveFormat] = {each: each for each in TEXTS}
    format = known.get(name)
    if not colon or not path or format is None:
        raise InputError(f"--export {text}: FORMAT:PATH is needed, of {', '.join(TEXTS)}")
    if format != "plus":
        check_target(path, format, inputs)
    elif not Path(path).is_file():
        raise InputError(f"--export {text}: there is no such configuration")
    # The report's folder may not be there yet.
    if out is None or Path(path).parent != Path(out):
        check_writable(path)
    return format, path


def _check_apart(
    targets: list[tuple[SaveFormat, str]], report: str | None, out: str | None
) -> None:
    """Refuse to write two files of one name, before other work begins."""
    from jaxcal.report.write import NAMES

    taken = [] if out is None else [os.path.realpath(os.path.join(out, name)) for name in NAMES]
    wanted = [] if report is None else [(f"--report {report}", report)]
    wanted += [(f"--export {format}:{path}", path) for format, path in targets]
    for option, path in wanted:
        place = os.path.realpath(path)
        if place in taken:
            raise InputError(f"{option}: the same command writes another file of this name")
        taken.append(place)


def _check_exports(
    recording: Recording, targets: list[tuple[SaveFormat, str]], inputs: list[str]
) -> None:
    """Refuse exports that need the size of a pixel, where only points in mm were recorded.

    And configurations of PLUS that cannot take the transform to the recording's probe.
    """
    from jaxcal.io.frame_names import probe_name
    from jaxcal.result.saved import needs_pixels

    frames = "Image", probe_name((recording.pose_frames or ("Probe",))[0])
    for format, path in targets:
        if recording.calibration.kind != "pixel" and needs_pixels(path, format):
            raise InputError(
                f"--export {format}:{path}: {recording.source} holds no pixels, but this format "
                "needs their size: calibrate with --out, then jaxcal export with --pixel-size"
            )
        if format == "plus":
            check_configuration(path, None, inputs, frames)


def _export(
    record: dict[str, Any], recording: str, targets: list[tuple[SaveFormat, str]]
) -> list[str]:
    """Write the transform for other programs; nothing of a calibration that did not converge."""
    if not targets:
        return []
    from jaxcal.io.frame_names import probe_name
    from jaxcal.result.saved import renamed, transform_from_record

    if not record["converged"] or record["wrong_frames"]:
        return ["exported: nothing, because the calibration must not be used"]
    transform = transform_from_record(record, source=recording)
    said: list[str] = []
    for format, path in targets:
        if format == "plus":
            said += patched(transform, path, None, ("Image", probe_name(transform.probe_frame)))
        else:
            said += written(transform, path, format)
        if (note := renamed(transform)) is not None and format in NAMING:
            said.append(f"- {note}")
    return said


@contextmanager
def _first_answer(
    recording: Recording, request: Request, show: Callable[[str], None]
) -> Iterator[None]:
    """Show the conventional fit while another method's program is loaded or compiled."""
    from jaxcal.report.certified import first_answer_words

    words = None
    if request.method != "conventional" and not request.robust:
        words = first_answer_words(recording.calibration, request.estimate)
    if words is None:
        yield
        return
    doing = f"Calibrating ({request.method})"
    show(f"{words} {doing} ...")

    class Compiling(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            show(f"{words} {doing}: {record.getMessage()} ...")

    # What executables says of compiling, and nothing else of it.
    log, handler = logging.getLogger("jaxcal.runtime.executables"), Compiling(logging.INFO)
    level = log.level
    log.addHandler(handler)
    log.setLevel(min(level or logging.INFO, logging.INFO))
    try:
        yield
    finally:
        log.setLevel(level)
        log.removeHandler(handler)


def _resampled(
    recording: Recording,
    request: Request,
    result: Calibration,
    cross_validate: bool,
    draws: int | None,
) -> dict[str, Any]:
    """What cross-validation and bootstrap add to the record."""
    from jaxcal.calibration import resampling
    from jaxcal.data.problem import Problem
    from jaxcal.report.resampled import bootstrap_record, cross_validation_record

    found: dict[str, Any] = {}
    if result.status not in ("converged", "max_iterations"):
        return found
    problem = Problem.from_recording(recording)
    arguments = vars(request)
    if cross_validate:
        held_out = resampling.cross_validate(problem, result=result, **arguments)
        found["cross_validation"] = cross_validation_record(held_out, result)
    if draws is not None:
        scatter = resampling.bootstrap(problem, draws, result=result, **arguments)
        found["bootstrap"] = bootstrap_record(scatter, result)
    return found


def _curves(request: Request, result: Calibration) -> list[Curve]:
    from jaxcal.report.convergence import bounded_curves, own_curve
    from jaxcal.result.calibration import data_of

    if request.method == "conventional":
        return [own_curve(result)]
    if request.method == "joint" and request.prior != "bounded":
        return []
    return bounded_curves(
        # Without the images that --robust left out.
        replace(data_of(result), mask=result.mask),
        max_elevation=request.max_elevation,
        estimate=request.estimate,
        alternating=result if request.method == "alternating" else None,
    )


def _print(record: dict[str, Any], reports: list[str]) -> None:
    from jaxcal.report.next_poses import next_poses_sentences
    from jaxcal.report.tables import calibration_table
    from jaxcal.report.verdict import verdict

    told = [*verdict(record), *next_poses_sentences(record)]
    written = [f"report: {path}" for path in reports]
    print_page(calibration_table(record), *told, *([""] if written else []), *written)
