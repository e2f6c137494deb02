"""Checking the file of an acquisition before it is resumed; the file is not trusted."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from hw.recording.layout import (
    FORMAT,
    FRAME_TYPES,
    LARGEST_ROW,
    LARGEST_SETTINGS,
    LAYOUT,
    STATIC,
    VERSION,
    Column,
)
from jaxcal import FormatError, InputError
from jaxcal.data.poses import check_poses
from jaxcal.io.given_files import check_readable, naming
from jaxcal.io.hdf5 import ELEMENTS, IMAGES
from jaxcal.io.lines import HDF5_BEGINNING
from jaxcal.io.untrusted import (
    Node,
    UpTo,
    array,
    check_attributes,
    child,
    flag,
    group,
    members,
    number,
    open_root,
    stored_here,
    text,
)

_PAUSE_S = 1.0
"""Between the last host time of a recording and the first one after it is resumed."""
_LATEST_S = 1e9
"""Host times count from the start of a program, or go on from there."""
_MOST_MEMBERS = 100
"""Arrays in a group that is written once: ten times what an acquisition writes."""


def check_resumable(path: str | os.PathLike[str]) -> bool:
    """Check a file before it is opened for writing; it is not trusted, and not changed.

    A file that is shorter than its own superblock says (:func:`stored_length`) is read as if zeros
    were at its end. Text that the writer may touch is read, so that its heaps are checked too.

    Returns:
        Whether it came to its end before, without an image of every pose.

    Raises:
        FormatError: missing, not a recording, complete with all images, of another layout, with
            links or data outside of it. One line that starts with the path.
    """
    with opened(path) as root:
        if text(root, "format") != FORMAT or number(root, "version") != VERSION:
            raise FormatError("is not a recording of this version")
        complete = flag(root, "complete")
        if complete is not False and not _lacks_images(root):
            raise FormatError("is complete: there is nothing to resume; jaxcal calibrate reads it")
        for name, columns in LAYOUT.items():
            node = _existing(root, name)
            for key, column in columns.items():
                dataset = child(node, key)
                if dataset is not None:
                    _check_column(dataset, column)
                    check_attributes(dataset)
            check_attributes(node)
        check_attributes(root)
        for name in ("probe", *STATIC):
            node = group(root, name)
            if node is not None:
                check_attributes(node)
                for member in members(node, _MOST_MEMBERS):
                    stored_here(member)
                    check_attributes(member)
    return complete is True


def _lacks_images(root: Node) -> bool:
    """Whether poses of the plan were skipped or given up when the run came to its end."""
    plan = group(root, "plan")
    return plan is not None and (number(plan, "without_image") or 0) > 0


@dataclass(frozen=True)
class Progress:
    """What the recording of an interrupted acquisition holds, checked.

    Attributes:
        settings: how it was asked for.
        targets: (n, 4, 4) plan of poses, mm.
        poses: (k, 4, 4) of the selected images.
        measurements: (k, elements) times of flight, s, or (k, 2) [lateral, range], mm.
        max_elevation: (k,) mm.
        taken: (k,) row of the plan of every image.
        true_elevation: (k,) mm, NaN on a real bench, or where the placement was lost.
        last_s: latest host time in the file.
        probe: numbers of /probe: elements, pitch_mm, sound_speed_m_s, delay_s.
        electronics: ``clock_hz`` and ``identity``, as far as it has them.
        ended: whether a run came to its end before, with poses skipped or given up.
    """

    settings: dict[str, object]
    targets: np.ndarray
    poses: np.ndarray
    measurements: np.ndarray
    max_elevation: np.ndarray
    taken: np.ndarray
    true_elevation: np.ndarray
    last_s: float
    probe: dict[str, float]
    electronics: dict[str, object]
    ended: bool


def read_progress(path: str | os.PathLike[str]) -> Progress:
    """What an acquisition's recording holds so far; the file is not trusted.

    Raises:
        FormatError: not such a file; one line that starts with the path.
    """
    with opened(path) as root:
        taken = read_column(root, "calibration", "target", (IMAGES,), "i")
        targets = read_column(root, "plan", "targets", (IMAGES, 4, 4))
        # Checked but not changed in any digit: the plan's digest must be the same again.
        try:
            check_poses(targets)
        except InputError as error:
            raise FormatError(str(error)) from None
        if taken.size and not (taken.min() >= 0 and taken.max() < len(targets)):
            raise FormatError("/calibration/target names a pose that the plan does not have")
        return Progress(
            settings=_settings(root),
            targets=targets,
            poses=read_column(root, "calibration", "pose", (IMAGES, 4, 4)),
            measurements=_measurements(root),
            max_elevation=read_column(root, "calibration", "max_elevation", (IMAGES,)),
            taken=taken,
            true_elevation=read_column(root, "placement", "true_elevation", (IMAGES,)),
            last_s=_last_host_time(root),
            probe=_probe(root),
            electronics=_electronics(root),
            ended=_lacks_images(root),
        )


def resumed_offset_s(last_s: float, now_s: float) -> float:
    """What is added to host times so that they go on a second after the last one of a file, s.

    Args:
        last_s: latest host time in the file.
        now_s: by the clock of the run that goes on with it.
    """
    return max(last_s + _PAUSE_S - now_s, 0.0)


def last_host_time(path: str | os.PathLike[str]) -> float:
    """Latest host time in a recording, s; 0 where it has none. The file is not trusted.

    Raises:
        FormatError: not an acquisition's recording; one line that starts with the path.
    """
    with opened(path) as root:
        return _last_host_time(root)


def _last_host_time(root: Node) -> float:
    last = [0.0]
    for name in ("tracker", "us", "ae", "events"):
        node = group(root, name)
        # Free-hand recordings lack some groups, and /us has no columns before the first frame.
        if node is not None and child(node, "t_host") is not None:
            times = read_column(root, name, "t_host", (UpTo(2**27, "rows"),))
            last.append(float(np.nanmax(times, initial=0.0)))
    if max(last) > _LATEST_S:
        # Added to all times to come, it would leave nothing of them.
        raise FormatError(f"has a host time of {max(last):g} s: no computer runs for so long")
    return max(last)


def settings_of(path: str | os.PathLike[str]) -> dict[str, object]:
    """How the acquisition of a recording was asked for; the file is not trusted.

    Raises:
        FormatError: not an acquisition's recording, or settings that are not a JSON object.
    """
    with opened(path) as root:
        return _settings(root)


def devices_of(path: str | os.PathLike[str]) -> tuple[dict[str, float], dict[str, object]]:
    """Probe and electronics of a recording, as in :class:`Progress`; the file is not trusted.

    Raises:
        FormatError: not an acquisition's recording.
    """
    with opened(path) as root:
        return _probe(root), _electronics(root)


@contextmanager
def opened(path: str | os.PathLike[str]) -> Iterator[Node]:
    """Open a recording to read it, also one whose writer ended early; the file is not trusted.

    Yields:
        The root, within which errors get the path in front.

    Raises:
        FormatError: not a file of HDF5.
    """
    check_readable(path)
    with naming(path), open_root(path, length=stored_length(path)) as root:
        yield root


def _existing(root: Node, name: str) -> Node:
    node = group(root, name)
    if node is None:
        raise FormatError(f"has no /{name}: it was not made by an acquisition")
    return node


def _probe(root: Node) -> dict[str, float]:
    node = _existing(root, "probe")
    names = ("elements", "pitch_mm", "sound_speed_m_s", "delay_s")
    found = {name: number(node, name) for name in names}
    return {name: value for name, value in found.items() if value is not None}


def _electronics(root: Node) -> dict[str, object]:
    node = _existing(root, "ae")
    found = {"clock_hz": number(node, "clock_hz"), "identity": text(node, "identity")}
    return {name: value for name, value in found.items() if value is not None}


def _settings(root: Node) -> dict[str, object]:
    values = read_column(root, "plan", "settings", (UpTo(LARGEST_SETTINGS, "bytes"),), "u")
    try:
        found = json.loads(values.astype(np.uint8).tobytes().decode())
    except (ValueError, RecursionError):
        raise FormatError("has settings that are not JSON") from None
    if not isinstance(found, dict):
        raise FormatError("has settings that are not a JSON object")
    return found


def _measurements(root: Node) -> np.ndarray:
    """Points where the recording has them, else times of flight."""
    node = group(root, "calibration")
    if node is not None and child(node, "point") is not None:
        return read_column(root, "calibration", "point", (IMAGES, 2))
    return read_column(root, "calibration", "time_of_flight", (IMAGES, ELEMENTS))


def read_column(
    root: Node, name: str, key: str, shape: tuple[int | UpTo, ...], kinds: str = "iuf"
) -> np.ndarray:
    """One whole column of a recording; the file is not trusted.

    Args:
        root: of the file (:func:`opened`).
        name: of the group.
        key: of the dataset.
        shape: see :func:`jaxcal.io.untrusted.array`.
        kinds: of numpy's dtypes that it may have.

    Raises:
        FormatError: it is not there, or has another shape or type.
    """
    node = group(root, name)
    dataset = None if node is None else child(node, key)
    if dataset is None:
        raise FormatError(f"has no /{name}/{key}: it was not made by an acquisition")
    return array(dataset, shape, kinds)


def stored_length(path: str | os.PathLike[str]) -> int | None:
    """The length in a file's superblock if the file is a little shorter; None otherwise.

    HDF5 refuses a file that is shorter than its superblock (version 0) says.
    """
    with open(path, "rb") as file:
        start = file.read(48)
    if start[:9] != HDF5_BEGINNING + b"\0":
        return None
    length = int.from_bytes(start[40:48], "little")
    return length if 0 < length - os.path.getsize(path) <= LARGEST_ROW else None


def _check_column(node: Node, column: Column) -> None:
    dataset, _ = stored_here(node)
    wanted = (len(column.tail) + 1, FRAME_TYPES if column.dtype == "frame" else (column.dtype,))
    names = (dataset.dtype.name, dataset.dtype.str[1:])
    if dataset.ndim != wanted[0] or not set(names) & {np.dtype(d).str[1:] for d in wanted[1]}:
        raise FormatError(f"{node} is {dataset.dtype} of shape {dataset.shape}: not this layout")
    if dataset.chunks is None or (dataset.maxshape or (0,))[0] is not None:
        raise FormatError(f"{node} cannot grow")
    if int(np.prod(dataset.shape[1:], dtype=object)) * dataset.dtype.itemsize > LARGEST_ROW:
        raise FormatError(f"{node} claims rows of shape {dataset.shape[1:]}")
