"""What the recording of an acquisition holds: groups, datasets, shapes and units.

A superset of the smallest valid recording (:mod:`jaxcal.io.hdf5`): once ``complete`` is true,
``jaxcal calibrate`` takes it as it is.

    /            attrs format, version, complete, created_utc, software, transform_convention
    /probe       attrs as in jaxcal.io.hdf5
    /tracker     t_host t_device [s], pose (N,4,4) [mm] tool centre point -> robot base,
                 raw_pose (N,6) [m, rad], safety_bits, status (robot mode), runtime_state
    /us          t_host t_device [s], frame_id, frames (N,H,W)
    /ae          t_host [s], frame_id, clock_ticks, tof_ticks (N,lines), amplitude (N,lines),
                 threshold
                 attrs of /us and /ae: frames lost, damaged (crc_errors), ..., in all
                 runs that were not killed
    /events      t_host [s], utc, kind, text
    /clock       device, offset, drift, reference, residual: t_host = t_device + offset
                 + drift (t_device - reference) [s]; t_host of the fit
    /calibration the selected images: pose, time_of_flight or point, max_elevation, amplitude, mask,
                 time; target: the row of /plan that the image belongs to. Free-hand: pose, pixel,
                 covariance, mask, time
    /placement   one row for each selected image: the target's elevational offset lies in [low,
                 high], centre, sd; offset of the probe from the plan's pose; true_elevation
                 (emulated bench, else NaN) [mm]; seconds that the placement took
    /estimate    the calibration so far, after every image: t_host, images, image_to_probe,
                 covariance, point, sigma, rms, status
    /plan        targets (n,4,4) [mm] tool centre point -> robot base; settings (JSON text, bytes)
    /test /truth optional (emulated bench), as in jaxcal.io.hdf5
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from jaxcal.io.openigtlink import MAXIMUM_BODY

FORMAT, VERSION = "jaxcal-recording", 1
TEXT_BYTES = 480
"""Events are text of a fixed size: HDF5's heaps of variable text are what a crash damages most."""

LARGEST_SETTINGS = 60_000
_POSES_A_CHUNK = 256


@dataclass(frozen=True)
class Column:
    """One dataset that grows: ``tail`` is a row's shape; names stand for sizes fixed per file."""

    tail: tuple[int | str, ...]
    dtype: str
    unit: str
    chunk: int = _POSES_A_CHUNK


def _text(size: int) -> Column:
    return Column((), f"S{size}", "1", 1)


_TIME = Column((), "f8", "s")
_COUNT = Column((), "i8", "1")
# One row a chunk for data that are few but precious: a torn write then damages no earlier row.
_MM = Column((), "f8", "mm", 1)
_POSE = Column((4, 4), "f8", "mm", 1)

LAYOUT: dict[str, dict[str, Column]] = {
    "tracker": {
        "t_host": _TIME,
        "t_device": _TIME,
        "pose": Column((4, 4), "f8", "mm"),
        "raw_pose": Column((6,), "f8", "m, rad"),
        "safety_bits": _COUNT,
        "status": _COUNT,
        "runtime_state": _COUNT,
    },
    "us": {
        "t_host": _TIME,
        "t_device": _TIME,
        "frame_id": _COUNT,
        "frames": Column(("height", "width"), "frame", "1", 1),
    },
    "ae": {
        "t_host": _TIME,
        "frame_id": _COUNT,
        "clock_ticks": Column((), "u8", "1"),
        "tof_ticks": Column(("lines",), "u2", "1", 64),
        "amplitude": Column(("lines",), "u2", "1", 64),
        "threshold": _COUNT,
    },
    "events": {
        "t_host": Column((), "f8", "s", 1),
        "utc": _text(32),
        "kind": _text(32),
        "text": _text(TEXT_BYTES),
    },
    "clock": {
        "t_host": Column((), "f8", "s", 1),
        "device": _text(32),
        "offset": Column((), "f8", "s", 1),
        "drift": Column((), "f8", "1", 1),
        "reference": Column((), "f8", "s", 1),
        "residual": Column((), "f8", "s", 1),
    },
    "calibration": {
        "pose": _POSE,
        "time_of_flight": Column(("elements",), "f8", "s", 1),
        "point": Column((2,), "f8", "mm", 1),
        "pixel": Column((2,), "f8", "px", 1),
        "covariance": Column((2, 2), "f8", "px^2", 1),
        "max_elevation": _MM,
        "amplitude": Column((), "f8", "1", 1),
        "mask": Column((), "?", "1", 1),
        "time": Column((), "f8", "s", 1),
        "target": Column((), "i8", "1", 1),
    },
    "placement": {
        "centre": _MM,
        "low": _MM,
        "high": _MM,
        "sd": _MM,
        "offset": _MM,
        "true_elevation": _MM,
        "seconds": Column((), "f8", "s", 1),
    },
    "estimate": {
        "t_host": Column((), "f8", "s", 1),
        "images": Column((), "i8", "1", 1),
        "image_to_probe": _POSE,
        "covariance": Column((6, 6), "f8", "mm^2, mm rad, rad^2", 1),
        "point": Column((3,), "f8", "mm", 1),
        "sigma": Column((3,), "f8", "mm", 1),
        "rms": _MM,
        "status": Column((), "i8", "1", 1),
    },
}
"""Groups that may be appended to; a row is appended to all columns of its group, or to none."""

_PLACED = ("max_elevation", "amplitude", "mask", "time", "target")
SELECTED = {
    "time_of_flight": ("pose", "time_of_flight", *_PLACED),
    "point": ("pose", "point", *_PLACED),
    "pixel": ("pose", "pixel", "covariance", "mask", "time"),
}
"""Columns of /calibration by what the selected images hold."""

STATIC = ("plan", "test", "truth")
"""Groups of arrays that are written once."""

FRAME_TYPES = ("uint8", "int16")
LARGEST_ROW = MAXIMUM_BODY
"""Bytes: as much as a message with an image may have."""


@dataclass(frozen=True)
class RecordingHeader:
    """What a recording holds from the start.

    Attributes:
        kind: what the selected images hold, one of :data:`SELECTED`.
        probe: attributes of /probe (kind, elements, pitch_mm, sound_speed_m_s, ...); empty: no
            /probe.
        lines: transmitted lines of the active echo element (times of flight in a frame); 0: there
            is none.
        settings: JSON text of how the acquisition was asked for; ``--resume`` uses it.
    """

    kind: str
    probe: Mapping[str, float | int | str]
    lines: int = 128
    settings: str = "{}"
