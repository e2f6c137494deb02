"""Recordings as HDF5 files: format "jaxcal-recording", version 1.

    /            attrs format, version; complete (false is refused)
    /probe       optional; attrs kind ("linear" or "curvilinear"), elements, pitch_mm (curvilinear:
                 along the arc), radius_mm (curvilinear: of the arc of elements), sound_speed_m_s,
                 optional delay_s: time of flight = distance / sound speed + delay
    /calibration pose (n, 4, 4) [mm] probe -> tracker, and one of
                 point (n, 2) [mm: lateral, range], pixel (n, 2) [px: u lateral, v axial],
                 time_of_flight (n, elements) [s, one-way, NaN = no response; needs /probe];
                 optional covariance (n, 2, 2) [mm^2, px^2 for pixels], amplitude (n,),
                 mask (n,) bool, time (n,) [s], velocity (n, 6) [mm/s, rad/s; in the probe's frame;
                 NaN where it is not known], max_elevation (n,) [mm],
                 frame (n,): numbers of the frames in the file that the images came from;
                 pixel has attrs spacing_mm [lateral, axial], face_offset_mm and frame_size
                 [columns, rows], point has face_offset_mm, all optional;
                 optional attrs pose_from, pose_to: names of the poses' frames
    /test        optional, as /calibration
    /truth       optional; image_to_probe (4, 4), point (3,), elevation (n,) [mm]
    /segmentation  where the points came from, for other programs; not read (see _write_fate,
                 _write_frames)

If a group has both ``point`` and ``time_of_flight``, the points were segmented from the times. The
points are then the measurements, and the times are kept beside them. Datasets may have a ``units``
attribute; one that differs is refused.
"""

from __future__ import annotations

import io
import os
from typing import TYPE_CHECKING, get_args

import h5py
import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.names import ProbeKind
from jaxcal.data.poses import check_poses
from jaxcal.data.probe import CurvilinearProbe, LinearProbe, Probe
from jaxcal.data.recording import (
    MINIMUM_IMAGES,
    MOST_IMAGES,
    UNIT_OF,
    Images,
    Kind,
    Recording,
    Truth,
    check_recording,
    make_images,
)
from jaxcal.io.atomic import write_bytes
from jaxcal.io.columns import SPELLINGS
from jaxcal.io.given_files import check_readable, naming, path_name
from jaxcal.io.importing.target_search import FATES, FrameResults
from jaxcal.io.untrusted import (
    Node,
    UpTo,
    array,
    child,
    flag,
    group,
    members,
    number,
    numbers,
    open_root,
    text,
)
from jaxcal.runtime.messages import quoted

if TYPE_CHECKING:
    from jaxcal.data.segmentation.segment import Segmentation

FORMAT = "jaxcal-recording"
VERSION = 1
IMAGES = UpTo(MOST_IMAGES, "images")
ELEMENTS = UpTo(4096, "elements")
"""Largest sizes of a recording, also of one that an acquisition resumes."""
GROUPS = ("probe", "calibration", "test", "truth", "segmentation")
"""All that :func:`save` writes."""

_MOST_GROUPS = 1000

_VELOCITY = "mm/s, rad/s"
_SPELLINGS = {
    **{unit: (unit, *SPELLINGS[unit]) for unit in ("mm", "px", "s")},
    "mm^2": ("mm^2", "mm2", "mm**2", "mm²"),
    _VELOCITY: (_VELOCITY,),
    "px^2": ("px^2", "px2", "px**2", "px²"),
}
# Dimensionless, or of any unit: written as "1" and not compared.
_FREE = "1"
_PER_IMAGE = {"amplitude": _FREE, "time": "s", "max_elevation": "mm", "frame": _FREE}
"""Optional numbers, one an image, and their units."""
_POSE_FRAMES = ("pose_from", "pose_to")


def load(path: str | os.PathLike[str]) -> Recording:
    """Read a recording; the file is not trusted.

    Args:
        path: an HDF5 file of format "jaxcal-recording", version 1.

    Returns:
        The checked recording.

    Raises:
        MissingFileError: there is none of this name.
        FormatError: not HDF5, truncated or damaged, another format, a newer version, incomplete,
            wrong units, shapes or types, data that lie outside the file, absurd sizes.
        InputError: well-formed but unusable: NaN, a reflection, metres, fewer than 4 images.
            The message of each is one line that starts with the path.
    """
    check_readable(path)
    if not h5py.is_hdf5(path):
        raise FormatError(
            f"{os.fspath(path)}: is not an HDF5 file (jaxcal import makes one from other programs' "
            "files)"
        )
    return _read(path, os.fspath(path))


def save(
    recording: Recording,
    path: str | os.PathLike[str],
    segmentation: Segmentation | FrameResults | None = None,
) -> None:
    """Write a recording, complete or not at all; what it writes is what :func:`load` reads.

    Args:
        recording: what to write.
        path: the file to make or replace.
        segmentation: where the calibration points came from, as a group of its own.

    Raises:
        InputError: the recording is one that ``load`` would refuse (its arrays were not checked by
            :func:`jaxcal.make_images`, or are too large).
        OutputError: the file could not be written; it is as it was.
    """
    check_recording(recording, "jaxcal.save")
    name = path_name(path)
    # Built in memory: HDF5 handles a full disk badly, but an ordinary write reports it.
    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        _write(file, recording)
        if isinstance(segmentation, FrameResults):
            _write_frames(file.create_group("segmentation"), segmentation)
        elif segmentation is not None:
            _write_fate(file.create_group("segmentation"), segmentation)
    _read(io.BytesIO(image.getvalue()), name)
    write_bytes(path, image.getvalue())


def raw_data(root: Node) -> str | None:
    """What a recording has that :func:`save` would not write again: an acquisition's raw data.

    Returns:
        The names of the groups, or that its writer has not finished; None where there is nothing.
    """
    if flag(root, "complete") is False:
        return "not complete"
    known = {f"/{name}" for name in GROUPS}
    return ", ".join(sorted({str(each) for each in members(root, _MOST_GROUPS)} - known)) or None


def _read(source: str | os.PathLike[str] | io.BytesIO, name: str) -> Recording:
    with naming(name), open_root(source) as root:
        _check_header(root)
        probe = _read_probe(root)
        calibration, test, truth = (group(root, part) for part in ("calibration", "test", "truth"))
        if calibration is None:
            raise FormatError("has no /calibration: there are no images to calibrate with")
        selected = _read_images(calibration, probe, MINIMUM_IMAGES)
        start, end = (text(calibration, attribute) for attribute in _POSE_FRAMES)
        return Recording(
            calibration=selected,
            test=None if test is None else _read_images(test, probe, minimum=1),
            truth=None if truth is None else _read_truth(truth, len(selected)),
            probe=probe,
            source=name,
            pose_frames=None if start is None or end is None else (start, end),
        )


def _check_header(root: Node) -> None:
    found = text(root, "format")
    if found != FORMAT:
        what = "it has no attribute format" if found is None else f"its format is {quoted(found)}"
        raise FormatError(
            f"is not a recording: {what}, {FORMAT!r} is needed (jaxcal import makes one from other "
            "programs' files)"
        )
    version = number(root, "version")
    if version is None or version < 1 or not version.is_integer():
        raise FormatError("attribute version must be a whole number from 1")
    if version > VERSION:
        raise FormatError(
            f"is version {version:g} of the recording format; this jaxcal understands version "
            f"{VERSION}: update jaxcal"
        )
    if flag(root, "complete") is False:
        raise FormatError(
            "is marked incomplete (complete = false), its writer did not finish: "
            "resume it (jaxcal-hw acquire --resume, with --bench or --setup TOML as before)"
        )
    _check_units(root, "mm")


def _read_probe(root: Node) -> Probe | None:
    node = group(root, "probe")
    if node is None:
        return None
    kind = text(node, "kind")
    if kind not in get_args(ProbeKind):
        what = "missing" if kind is None else quoted(kind)
        raise FormatError(f"/probe: attribute kind is {what}, 'linear' or 'curvilinear' is needed")
    elements = _needed(node, "elements")
    if not elements.is_integer():
        raise FormatError(f"/probe: attribute elements must be a whole number, not {elements:g}")
    pitch, sound_speed = _needed(node, "pitch_mm"), _needed(node, "sound_speed_m_s")
    delay = number(node, "delay_s") or 0.0
    try:
        if kind == "curvilinear":
            radius = _needed(node, "radius_mm")
            return CurvilinearProbe(int(elements), pitch, radius, sound_speed, delay)
        return LinearProbe(int(elements), pitch, sound_speed, delay)
    except InputError as error:
        raise FormatError(f"/probe: {error}") from None


def _read_images(node: Node, probe: Probe | None, minimum: int) -> Images:
    _check_units(node, "mm")
    kind = _kind(node)
    if kind == "time_of_flight" and probe is None:
        raise FormatError(f"{node}/time_of_flight needs /probe, which is missing")
    columns = ELEMENTS if kind == "time_of_flight" else 2
    poses = _dataset(node, "pose", (IMAGES, 4, 4), "mm")
    measurements = _dataset(node, kind, (IMAGES, columns), UNIT_OF[kind])
    if poses is None or measurements is None:
        raise FormatError(f"{node}/pose is missing")
    times = measurements if kind == "time_of_flight" else None
    if kind == "point":
        times = _dataset(node, "time_of_flight", (IMAGES, ELEMENTS), "s")
    if times is not None and probe and times.shape[1] != probe.elements:
        raise FormatError(
            f"{node}/time_of_flight has {times.shape[1]} columns, /probe has "
            f"{probe.elements} elements"
        )
    spacing, offset, size = _read_scale(node, kind)
    return make_images(
        poses,
        measurements,
        kind,
        mask=_dataset(node, "mask", (IMAGES,), _FREE, kinds="biu"),
        covariance=_dataset(node, "covariance", (IMAGES, 2, 2), _area(kind)),
        velocity=_dataset(node, "velocity", (IMAGES, 6), _VELOCITY),
        spacing_mm=spacing,
        face_offset_mm=offset,
        frame_size=size,
        time_of_flight=times if kind == "point" else None,
        minimum=minimum,
        where=str(node),
        **{name: _dataset(node, name, (IMAGES,), unit) for name, unit in _PER_IMAGE.items()},
    )


def _area(kind: Kind) -> str:
    """The unit of covariances."""
    return "px^2" if kind == "pixel" else "mm^2"


def _kind(node: Node) -> Kind:
    found: list[Kind] = [kind for kind in get_args(Kind) if child(node, kind) is not None]
    if found == ["point", "time_of_flight"]:
        return "point"
    if len(found) != 1:
        what = "none" if not found else " and ".join(found)
        raise FormatError(f"{node} must hold one of point, pixel, time_of_flight; it has {what}")
    return found[0]


def _read_scale(node: Node, kind: Kind) -> tuple[np.ndarray | None, float, np.ndarray | None]:
    """Attributes spacing_mm, face_offset_mm, frame_size of the measurements or of their group."""
    if kind == "time_of_flight":
        return None, 0.0, None
    owners = [owner for owner in (child(node, kind), node) if owner is not None]

    def stated(name: str, count: int) -> np.ndarray | None:
        values = [numbers(owner, name, count) for owner in owners]
        return next((value for value in values if value is not None), None)

    offset = stated("face_offset_mm", 1)
    face = 0.0 if offset is None else float(offset[0])
    if kind == "point":
        return None, face, None
    return stated("spacing_mm", 2), face, stated("frame_size", 2)


def _read_truth(node: Node, count: int) -> Truth:
    image_to_probe = _dataset(node, "image_to_probe", (4, 4), "mm")
    point = _dataset(node, "point", (3,), "mm")
    elevation = _dataset(node, "elevation", (IMAGES,), "mm")
    if image_to_probe is None or point is None or elevation is None:
        raise FormatError(f"{node} must hold image_to_probe, point and elevation")
    if len(elevation) != count:
        raise FormatError(f"{node}/elevation has {len(elevation)} rows for {count} images")
    if not (np.isfinite(point).all() and np.isfinite(elevation).all()):
        raise FormatError(f"{node} holds NaN or Inf")
    try:
        transform = check_poses(image_to_probe[None], what="image_to_probe")[0]
    except InputError as error:
        raise type(error)(f"{node}: {error}") from None
    return Truth(transform, point, elevation)


def _dataset(
    node: Node, name: str, shape: tuple[int | UpTo, ...], unit: str, kinds: str = "iuf"
) -> np.ndarray | None:
    found = child(node, name)
    if found is None:
        return None
    _check_units(found, unit)
    return array(found, shape, kinds)


def _check_units(node: Node, unit: str) -> None:
    found = None if unit == _FREE else text(node, "units")
    if found is not None and found.strip() not in _SPELLINGS[unit]:
        raise FormatError(f"{node} is in units {quoted(found)}, {unit} is needed")


def _needed(node: Node, name: str) -> float:
    value = number(node, name)
    if value is None or not np.isfinite(value):
        raise FormatError(f"{node}: attribute {name} is missing or not finite")
    return value


def _write(file: h5py.File, recording: Recording) -> None:
    file.attrs["format"] = FORMAT
    file.attrs["version"] = VERSION
    if recording.probe is not None:
        probe = file.create_group("probe")
        for name in ("kind", "elements", "pitch_mm", "sound_speed_m_s"):
            probe.attrs[name] = getattr(recording.probe, name)
        if isinstance(recording.probe, CurvilinearProbe):
            probe.attrs["radius_mm"] = recording.probe.radius_mm
        if recording.probe.delay_s:
            probe.attrs["delay_s"] = recording.probe.delay_s
    calibration = file.create_group("calibration")
    _write_images(calibration, recording.calibration)
    if recording.pose_frames is not None:
        calibration.attrs.update(zip(_POSE_FRAMES, recording.pose_frames, strict=True))
    if recording.test is not None:
        _write_images(file.create_group("test"), recording.test)
    if recording.truth is not None:
        truth = file.create_group("truth")
        for name in ("image_to_probe", "point", "elevation"):
            _put(truth, name, getattr(recording.truth, name), "mm")
    file.attrs["complete"] = True


def _write_images(target: h5py.Group, images: Images) -> None:
    _put(target, "pose", images.poses, "mm")
    measurements = _put(target, images.kind, images.measurements, UNIT_OF[images.kind])
    if images.spacing_mm is not None:
        measurements.attrs["spacing_mm"] = images.spacing_mm
    if images.kind != "time_of_flight":
        measurements.attrs["face_offset_mm"] = images.face_offset_mm
        if images.frame_size is not None:
            measurements.attrs["frame_size"] = images.frame_size
    optional = {
        "time_of_flight": "s",
        "mask": _FREE,
        "covariance": _area(images.kind),
        "velocity": _VELOCITY,
    }
    for name, unit in (optional | _PER_IMAGE).items():
        values = getattr(images, name)
        if values is not None:
            _put(target, name, values, unit)


def _write_fate(target: h5py.Group, found: Segmentation) -> None:
    """What became of every calibration frame; curved arrays: [lateral, axial, elevation^2]."""
    target.attrs["method"] = found.method
    for name in ("missing", "rejected", "failed"):
        _put(target, name, getattr(found, name), _FREE)
    _put(target, "noise", found.noise_mm, "mm")
    if found.out_of_plane is not None:
        _put(target, "out_of_plane", found.out_of_plane.position, "mm, mm, mm^2")
        _put(target, "out_of_plane_covariance", found.out_of_plane.covariance, _FREE)
        _put(target, "elevation_determined", found.out_of_plane.determined, _FREE)


def _write_frames(target: h5py.Group, found: FrameResults) -> None:
    """What became of every frame that was searched.

    ``row`` has the places in these lists of the images in /calibration, in order;
    ``/calibration/frame`` has the numbers of their frames.
    """
    target.attrs["method"] = found.target
    target.attrs["fates"] = ", ".join(FATES)
    _put(target, "row", found.found, _FREE)
    _put(target, "fate", found.fate, _FREE)
    _put(target, "contrast", found.contrast_db, "dB")
    _put(target, "margin", found.margin_db, "dB")


def _put(target: h5py.Group, name: str, values: np.ndarray, unit: str) -> h5py.Dataset:
    dataset = target.create_dataset(name, data=values)
    dataset.attrs["units"] = unit
    return dataset
