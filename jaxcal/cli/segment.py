"""``jaxcal segment``: times of flight to points with covariances."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from jaxcal import InputError
from jaxcal.cli.common import (
    POSITIVE,
    ExitCode,
    import_engine,
    print_json,
    print_page,
    progress,
)

if TYPE_CHECKING:
    from jaxcal.data.probe import Probe
    from jaxcal.data.recording import Recording
    from jaxcal.data.segmentation.segment import Segmentation


@click.command()
@click.argument("recording", type=click.Path(), metavar="REC")
@click.option(
    "--method",
    type=click.Choice(["least-squares", "shortest"]),
    default="least-squares",
    show_default=True,
    help="least-squares: on every element's time; shortest: the first element to answer.",
)
@click.option(
    "--robust/--no-robust",
    default=True,
    show_default=True,
    help="Weights against lines that are not the target's echo (least-squares).",
)
@click.option(
    "--scale",
    type=click.Choice(["frame", "pooled"]),
    default="frame",
    show_default=True,
    help="Noise of each frame by itself, or one for all (least-squares).",
)
@click.option("--interpolate", is_flag=True, help="Between elements (shortest).")
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
    "--out",
    type=click.Path(),
    metavar="OUT.h5",
    help="By default REC-segmented.h5, beside REC. The name of REC itself replaces it.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")
def segment(
    recording: str,
    method: Literal["least-squares", "shortest"],
    robust: bool,
    scale: Literal["frame", "pooled"],
    interpolate: bool,
    sound_speed: float | None,
    temperature: float | None,
    out: str | None,
    as_json: bool,
) -> int:
    """Segment the times of flight of REC into points with covariances.

    OUT.h5 holds everything jaxcal reads from REC, the times of flight included, with the points
    beside them; "jaxcal calibrate" then uses the points. Frames with too few answers are masked out
    and counted. The points of a curvilinear probe are the in-plane fit; what its times say of the
    elevation, which has no sign, is written to the group segmentation.
    """
    if interpolate and method != "shortest":
        raise InputError("--interpolate needs --method shortest")
    if method == "shortest" and scale != "frame":
        raise InputError("--scale needs --method least-squares")
    if sound_speed is not None and temperature is not None:
        raise InputError("--sound-speed and --temperature exclude each other")
    import_engine()
    from jaxcal.cli.cache import enable_compilation_cache
    from jaxcal.data.segmentation.segment import segment_recording
    from jaxcal.io.hdf5 import load, save

    data = load(recording)
    probe = _probe(data, sound_speed, temperature)
    enable_compilation_cache()
    options: dict[str, Any] = {"method": method, "robust": robust, "scale": scale}
    with progress("segmenting"):
        try:
            segmented, found = segment_recording(data, probe, interpolate=interpolate, **options)
        except InputError as error:
            raise type(error)(f"{recording}: {error}") from None
    source = Path(recording)
    target = str(source.with_name(f"{source.stem}-segmented.h5")) if out is None else out
    save(segmented, target, found)
    record = _record(found, target)
    if as_json:
        print_json(record)
    else:
        _print(record)
    return ExitCode.CONVERGED


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
        "images_failed": np.flatnonzero(found.failed).tolist(),
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
        f"({record['method']}); {record['missing_lines']} lines missing, "
        f"{record['rejected_lines']} rejected{noise}"
    ]
    if record["elevation_determined"] is not None:
        lines.append(
            f"distance from the image plane (without its sign) determined in "
            f"{record['elevation_determined']} images"
        )
    print_page(*lines, *(f"- {text}" for text in record["warnings"]))
