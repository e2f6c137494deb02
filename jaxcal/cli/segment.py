"""``jaxcal segment``: times of flight, or the frames of a sequence, to points with covariances."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from jaxcal import InputError
from jaxcal.cli.common import (
    POSITIVE,
    ExitCode,
    import_engine,
    json_option,
    prepare_jax,
    print_json,
    print_page,
    progress,
)
from jaxcal.cli.sequence_options import SEARCH, TABLES, TRACKING, beside, by_hand, with_options
from jaxcal.data.names import NoiseScale, SegmentationMethod
from jaxcal.runtime.messages import counted

if TYPE_CHECKING:
    from jaxcal.data.probe import Probe
    from jaxcal.data.recording import Recording
    from jaxcal.data.segmentation.segment import Segmentation
    from jaxcal.io.importing.target_search import FrameResults


@click.command(short_help="Find the target in times of flight or in images.")
@click.argument("recording", type=click.Path(), metavar="REC")
@click.option(
    "--method",
    type=click.Choice(get_args(SegmentationMethod)),
    default="least-squares",
    show_default=True,
    help="least-squares: fit the times of all elements; shortest: use the shortest time.",
)
@click.option(
    "--robust/--no-robust",
    default=True,
    show_default=True,
    help="Give little weight to lines that do not show the target's echo (least-squares).",
)
@click.option(
    "--scale",
    type=click.Choice(get_args(NoiseScale)),
    default="frame",
    show_default=True,
    help="Estimate the noise for each frame, or one for all frames (least-squares).",
)
@click.option("--interpolate", is_flag=True, help="Interpolate between elements (shortest).")
@click.option(
    "--sound-speed",
    type=POSITIVE,
    metavar="M/S",
    help="Sound speed, m/s, instead of the recording's.",
)
@click.option(
    "--temperature",
    type=float,
    metavar="CELSIUS",
    help="Temperature of the water, which sets the sound speed.",
)
@click.option(
    "--out", type=click.Path(), metavar="OUT.h5", help="By default REC-segmented.h5, beside REC."
)
@with_options(TRACKING)
@with_options(SEARCH)
@with_options(TABLES)
@json_option
@click.pass_context
def segment(
    context: click.Context, recording: str, out: str | None, as_json: bool, **frames: Any
) -> int:
    """Segment times of flight, or the frames of a sequence, into points with covariances.

    REC is a recording with times of flight; or a tracked sequence of PLUS or Slicer (.igs.mha,
    .igs.mhd, .igs.nrrd, .seq.nrrd), or a folder of PNG with --poses: then every frame is searched
    for the target, and OUT.h5 has the frames in which it was found (options from --from on).

    For a recording, OUT.h5 holds everything that jaxcal reads from REC, including the times of
    flight, and the points in addition; "jaxcal calibrate" then uses the points. Frames with too few
    answers are masked out and counted; if these are most of all frames, the exit status is 3. The
    points of a curvilinear probe are fitted in the image
    plane; the size of the elevational offset by its times (without a sign) is written to the group
    segmentation.
    """
    from jaxcal.io.given_files import check_readable, naming

    times = {name: frames.pop(name) for name in _TIMES}
    of_frames = _is_of_frames(recording)
    if not of_frames:
        # What does not exist is not known to be a sequence, and its options are not wrong.
        check_readable(recording)
    others = times if of_frames else frames
    for parameter in context.command.params:
        given = context.get_parameter_source(parameter.name or "")
        if parameter.name in others and given is click.core.ParameterSource.COMMANDLINE:
            kind = "times of flight" if of_frames else "sequences"
            raise InputError(f"{recording}: {parameter.opts[0]} is an option for {kind}")
    if of_frames:
        return _segment_frames(recording, out, as_json, frames)
    sound_speed, temperature = times.pop("sound_speed"), times.pop("temperature")
    if sound_speed is not None and temperature is not None:
        raise InputError("--sound-speed and --temperature exclude each other")
    import_engine()
    from jaxcal.data.segmentation.segment import segment_recording
    from jaxcal.io.atomic import check_writable
    from jaxcal.io.hdf5 import load, save
    from jaxcal.io.outputs import RECORDING, check_output, is_recording

    target = _default_out(recording) if out is None else out
    # The output has no poses of frames that are masked out, so it does not take REC's place.
    check_output(target, "a recording", is_recording, [recording], endings=RECORDING)
    data = load(recording)
    check_writable(target)
    probe = _probe(data, sound_speed, temperature)
    prepare_jax()
    with progress("segmenting"), naming(recording):
        segmented, found = segment_recording(data, probe, **times)
    save(segmented, target, found)
    record = _record(found, target)
    if as_json:
        print_json(record)
    else:
        _print(record)
    return ExitCode.NOT_CONVERGED if _most_lost(found) else ExitCode.CONVERGED


_TIMES = ("method", "robust", "scale", "interpolate", "sound_speed", "temperature")
"""Options that belong to times of flight."""


def _most_lost(found: Segmentation) -> bool:
    """Whether fewer than half of the frames could be segmented."""
    return bool(2 * found.failed.sum() > found.failed.sum() + found.images.mask.sum())


def _is_of_frames(source: str) -> bool:
    from jaxcal.io.sequence_files import EXTENSIONS

    return Path(source).is_dir() or source.lower().endswith(EXTENSIONS)


def _default_out(source: str) -> str:
    """Beside the source: ``a.h5`` and ``a.igs.mha`` become ``a-segmented.h5``."""
    if _is_of_frames(source):
        return beside(source, "-segmented.h5")
    return str(Path(source).with_name(f"{Path(source).stem}-segmented.h5"))


def _segment_frames(source: str, out: str | None, as_json: bool, options: dict[str, Any]) -> int:
    """A sequence's frames; what became of each is counted and said."""
    from jaxcal.io.atomic import check_writable
    from jaxcal.io.hdf5 import save
    from jaxcal.io.importing.files import import_files
    from jaxcal.io.importing.sources import ImportOptions
    from jaxcal.io.outputs import RECORDING, check_output, is_recording

    target = _default_out(source) if out is None else out
    check_output(target, "a recording", is_recording, [source], endings=RECORDING)
    # Of a source that is not there nothing is said about the output beside it.
    if os.path.exists(source):
        check_writable(target)
    with progress("segmenting"):
        recording, notes, found, most_lost = import_files([source], ImportOptions(**options))
    assert found is not None
    save(recording, target, found)
    if as_json:
        print_json(_frames_record(target, recording, notes, found))
    else:
        unscaled = recording.calibration.spacing_mm is None
        hint = "; a pixel's size is not known: calibrate with --estimate scale" if unscaled else ""
        count = f"{len(found.found)} of {found.asked} frames segmented ({found.target})"
        told = (f"{target}: {count}{hint}", *(f"- {note}" for note in notes))
        print_page(*told, *by_hand(source, found, options))
    return ExitCode.NOT_CONVERGED if most_lost else ExitCode.CONVERGED


def _frames_record(
    target: str, recording: Recording, notes: list[str], found: FrameResults
) -> dict[str, Any]:
    from jaxcal.io.importing.target_search import FATES

    images = recording.calibration
    return {
        "out": target,
        "method": found.target,
        "frames": len(found),
        **{name.replace(" ", "_"): count for name, count in found.counts.items()},
        "reasons": found.reasons,
        "images": len(images),
        "spacing_mm": images.spacing_mm,
        "per_frame": [
            {
                **({"file": found.files[k]} if found.files else {"frame": k}),
                "fate": FATES[fate],
                "reason": found.reason[k] or None,
            }
            for k, fate in enumerate(found.fate)
        ],
        "notes": notes,
    }


def _probe(data: Recording, sound_speed: float | None, temperature: float | None) -> Probe | None:
    from jaxcal.data.sound import sound_speed_in_water

    if temperature is not None:
        sound_speed = float(sound_speed_in_water(temperature))
    if data.probe is None or sound_speed is None:
        return data.probe
    return replace(data.probe, sound_speed_m_s=sound_speed)


def _record(found: Segmentation, target: str) -> dict[str, Any]:
    import numpy as np

    kept = found.images.mask
    noise = found.noise_mm[kept & np.isfinite(found.noise_mm)]
    full = found.out_of_plane
    return {
        "out": target,
        "method": found.method,
        "images": len(kept),
        "images_used": int(kept.sum()),
        "images_failed": np.flatnonzero(found.failed),
        "missing_lines": int(found.missing.sum()),
        "rejected_lines": int(found.rejected.sum()),
        "noise_mm": float(np.median(noise)) if noise.size else None,
        "elevation_determined": None if full is None else int(full.determined.sum()),
        "warnings": list(found.warnings),
    }


def _print(record: dict[str, Any]) -> None:
    noise = "" if record["noise_mm"] is None else f", {record['noise_mm']:.3g} mm noise"
    lines = [
        f"{record['out']}: {record['images_used']} of {record['images']} images segmented "
        f"({record['method']}); {counted(record['missing_lines'], 'line')} missing, "
        f"{record['rejected_lines']} rejected{noise}"
    ]
    if record["elevation_determined"] is not None:
        lines.append(
            f"distance from the image plane (without its sign) determined in "
            f"{counted(record['elevation_determined'], 'image')}"
        )
    print_page(*lines, *(f"- {text}" for text in record["warnings"]))
