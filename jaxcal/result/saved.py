"""Calibrations in files: our JSON, and what other programs read and write. Numpy only."""

from __future__ import annotations

import datetime
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from zipfile import ZipFile

import numpy as np

from jaxcal import FormatError, InputError, __version__
from jaxcal.io.atomic import atomic_path, write_text
from jaxcal.io.frame_names import FramePair, capitalised, probe_name, two_names
from jaxcal.io.given_files import check_readable, naming, one_line, path_name, read_bytes
from jaxcal.io.outputs import check_output
from jaxcal.model.unknowns import TABLE, tangent_names
from jaxcal.result.transform import ImageTransform, SaveFormat, transform_from_plus_matrix
from jaxcal.runtime.messages import quoted

FORMAT = "jaxcal-calibration"
VERSION = 1
MAXIMUM_BYTES = 64 * 2**20

ASKED_FOR = "asked for"
"""Name of those points of ``tre`` that a caller named; all others are of the region."""

_IN_THE_PLANE = ("scale_mm_per_px", "face_offset_mm", "range_factor")
"""What takes an image point to the image plane; no part of the rigid transform."""

_NPZ = (
    "image_plane_to_probe",
    *_IN_THE_PLANE,
    "covariance",
    "image_unknowns",
    "image_covariance",
    "rms_mm",
    "converged",
    "date",
    "degrees_of_freedom",
    "variance_factor",
    "doubtful_unit",
)
_ROUNDED = 1e-4
"""Relative difference of the columns of two matrices of a record that rounding explains."""
_ROUNDED_MM = 1e-6

_NPZ_BYTES = 65536
"""Largest size of an ``.npz``, also unpacked."""

_EXTENSIONS: dict[SaveFormat, tuple[str, ...]] = {
    "json": (".json",),
    "plus": (".xml",),
    "slicer": (".tfm", ".txt", ".h5"),
    "itk": (".tfm", ".txt", ".h5"),
    "ros": (".yaml", ".yml"),
    "tusrec": (".csv",),
    "numpy": (".npy", ".npz"),
}


def _endings(format: SaveFormat) -> tuple[str, ...]:
    """The extensions of a format's files; InputError for something that is no format."""
    if not (isinstance(format, str) and format in _EXTENSIONS):
        raise InputError(f"{quoted(str(format))} is not a format that can be written")
    return _EXTENSIONS[format]


def _format_of(name: str) -> SaveFormat:
    for chosen, extensions in _EXTENSIONS.items():
        if name.lower().endswith(extensions):
            return chosen
    known = dict.fromkeys(each for extensions in _EXTENSIONS.values() for each in extensions)
    raise FormatError(f"{name}: its extension names no format (there are {', '.join(known)})")


def check_target(
    path: str | os.PathLike[str],
    format: SaveFormat | None = None,
    inputs: Sequence[str | os.PathLike[str]] = (),
) -> SaveFormat:
    """The format in which :meth:`ImageTransform.save` writes a file, if it may be written.

    Args:
        path: the file to make or replace.
        format: by default that of the extension.
        inputs: files that must not be replaced.

    Raises:
        InputError: an extension by which the file could not be read again, one of the inputs, or
            an existing file that is no calibration in this format.
    """
    name = path_name(path)
    chosen = _format_of(name) if format is None else format
    endings, what = _endings(chosen), f"a calibration (format {chosen})"
    check_output(path, what, lambda _: _is_one(path, chosen), inputs, endings=endings)
    return chosen


def needs_pixels(path: str | os.PathLike[str], format: SaveFormat) -> bool:
    """Whether a file of this format takes pixels to the probe, and so needs the pixels' size."""
    return format not in ("json", "ros") and not os.fspath(path).lower().endswith(".npz")


def _is_one(path: str | os.PathLike[str], format: SaveFormat) -> bool:
    if format == "json":
        return is_calibration_record(path)
    load_calibration(path)
    if format != "plus":
        return True
    from jaxcal.io.xml import read_xml

    # A whole configuration is more than we write.
    return read_xml(path)[0].tag == "Transform"


def is_calibration_record(path: str | os.PathLike[str]) -> bool:
    """Whether a file is the JSON of a calibration, also of one that failed.

    Raises:
        FormatError: it is no JSON object.
    """
    return _json_object(path).get("format") == FORMAT


def save(
    transform: ImageTransform,
    path: str | os.PathLike[str],
    format: SaveFormat | None,
    *,
    frames: FramePair,
) -> None:
    """Write a calibration; see :meth:`ImageTransform.save`."""
    chosen = check_target(path, format)
    if chosen != "json":
        transform.check_usable()
    transform = replace(transform, date=transform.date or utc_now())
    if chosen in ("slicer", "itk"):
        from jaxcal.io.itk import write_itk

        write_itk(path, transform.plus_matrix())
    elif chosen == "numpy":
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            if os.fspath(path).lower().endswith(".npz"):
                known = {key: value for key, value in _record(transform).items() if key in _NPZ}
                matrix = None if transform.scale_mm_per_px is None else transform.plus_matrix()
                known |= {"plus_image_to_probe": matrix, "probe_frame": transform.probe_frame}
                known |= {"tre_factor": transform.tre_factor}
                np.savez(file, **{k: v for k, v in known.items() if v is not None})
            else:
                np.save(file, transform.plus_matrix())
    else:
        write_text(path, text_of(transform, chosen, frames=frames))


def text_of(transform: ImageTransform, format: SaveFormat, *, frames: FramePair) -> str:
    """The text of a calibration in a format; see :meth:`ImageTransform.text`."""
    _endings(format)
    if format == "json":
        try:
            return json.dumps(_record(transform), indent=2, allow_nan=False) + "\n"
        except ValueError:
            failed = f"{transform.source}: the solve had failed: there is no transform to write"
            raise InputError(failed) from None
    transform.check_usable()
    if format == "plus":
        from jaxcal.io.plus import transform_element

        return (
            transform_element(frames, transform.plus_matrix(), error_mm=transform.error_mm) + "\n"
        )
    if format in ("slicer", "itk"):
        from jaxcal.io.itk import itk_text

        return itk_text(transform.plus_matrix())
    if format == "ros":
        from jaxcal.io.ros import ros_yaml

        # ROS's own frames are in lower case; the user's are written as they are.
        child, parent = (n.lower() if n in ("Image", "Probe") else n for n in two_names(frames))
        held = {key: value for key, value in _record(transform).items() if key in _IN_THE_PLANE}
        note = _range_note(transform)
        return ros_yaml(transform.image_plane_to_probe, parent, child, note, held)
    if format == "tusrec":
        from jaxcal.io.tus_rec import calib_matrix

        matrix = transform.plus_matrix()
        scale = transform.pixel_size_mm()
        rigid = matrix.copy()
        rigid[:3, :3] /= [*scale, scale.mean()]
        return calib_matrix(rigid, scale)
    return np.array2string(transform.plus_matrix(), separator=", ", floatmode="unique") + "\n"


def utc_now() -> str:
    """The present date and time in UTC, ISO 8601, to the second."""
    now = datetime.datetime.now(datetime.UTC)
    return now.isoformat(timespec="seconds").replace("+00:00", "Z")


def dated(record: dict[str, Any]) -> dict[str, Any]:
    """A calibration's record with the present date and time, for a file or a page.

    Without them, equal calibrations have equal records.
    """
    return record | {"date": utc_now()}


def renamed(transform: ImageTransform) -> str | None:
    """That PLUS refuses the recording's name of the probe's frame, in words; else None."""
    named = transform.probe_frame
    written = probe_name(named)
    if written == capitalised(named):
        return None
    return (
        f"the recording calls the probe's frame {quoted(named)}, which PLUS refuses: written as "
        f"{written} (another name: jaxcal export --probe-frame)"
    )


def left_out(transform: ImageTransform, format: SaveFormat) -> str | None:
    """What a format cannot hold, in words; None where nothing is. ``numpy`` is the .npy here."""
    _endings(format)
    note = _range_note(transform) if format == "ros" else None
    lost = []
    if transform.covariance is not None and format != "json":
        lost.append("SDs (.json and .npz hold them)")
    if transform.probe_frame != "Probe" and format not in ("json", "plus", "ros"):
        lost.append(f"the name of the probe's frame, {quoted(transform.probe_frame)}")
    told = f"left out: {' and '.join(lost)}" if lost else None
    return "; ".join(each for each in (note, told) if each is not None) or None


def _range_note(transform: ImageTransform) -> str | None:
    from jaxcal.io.ros import range_note

    return range_note(transform.range_factor, transform.face_offset_mm, transform.scale_mm_per_px)


def _record(transform: ImageTransform) -> dict[str, Any]:
    known, probe = transform.scale_mm_per_px is not None, transform.probe_frame
    arrays = {
        "image_plane_to_probe": transform.image_plane_to_probe,
        "plus_image_to_probe": transform.plus_matrix() if known else None,
        "scale_mm_per_px": transform.scale_mm_per_px,
        "face_offset_mm": transform.face_offset_mm,
        "range_factor": transform.range_factor,
        "covariance": transform.covariance,
        "image_unknowns": tangent_names(transform.unknowns),
        "image_covariance": transform.image_covariance,
    }
    return {
        "format": FORMAT,
        "version": VERSION,
        "converged": transform.converged,
        **{k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in arrays.items()},
        "rms_mm": transform.error_mm if transform.error_is_rms else None,
        "tre": None if transform.tre_factor == 1 else {"factor": transform.tre_factor},
        "doubtful_unit": transform.doubtful_unit,
        "pose_frames": None if probe == "Probe" else {"from": probe, "to": None},
        "degrees_of_freedom": transform.degrees_of_freedom,
        "variance_factor": transform.variance_factor,
        "date": transform.date,
        "jaxcal_version": __version__,
    }


def _check_calibrated(matrix: np.ndarray) -> None:
    """Refuse the identity, which PLUS and Slicer hold before there is a calibration."""
    if np.array_equal(matrix, np.eye(4)):
        raise InputError("the transform is the identity: it was not calibrated yet")


def load_calibration(path: str | os.PathLike[str]) -> ImageTransform:
    """Read a calibration; the file is not trusted, and JAX is not needed.

    Args:
        path: our JSON (of ``jaxcal calibrate --json`` or ``--out``, of any version), a
            configuration or fCal result of PLUS (``.xml``), a transform of ITK (``.tfm``, ``.txt``,
            ``.h5``), a ``calib_matrix.csv`` of TUS-REC, a YAML of easy_handeye, our ``.npz``, or
            PLUS's matrix as ``.npy``.

    Returns:
        The calibration. Before its use look at ``converged`` and ``doubtful_unit``, which its
        ``repr`` shows.

    Raises:
        MissingFileError: there is none of this name.
        FormatError: not such a file.
        InputError: matrices that cannot be used. The message of each error is one line that starts
            with the path.
    """
    name = path_name(path)
    lower = name.lower()
    with naming(path):
        if os.path.isfile(os.path.join(name, "calibration.json")):
            raise FormatError("is a folder: name the calibration.json in it")
        if lower.endswith(_EXTENSIONS["plus"]):
            from jaxcal.io.plus import read_transform

            found = read_transform(path)
            _check_calibrated(found.matrix)
            made = transform_from_plus_matrix(found.matrix, error_mm=found.error_mm, source=name)
            return replace(made, probe_frame=found.target)
        if lower.endswith(_EXTENSIONS["itk"]):
            from jaxcal.io.itk import read_itk

            matrix = read_itk(path)
            _check_calibrated(matrix)
            return transform_from_plus_matrix(matrix, source=name)
        if lower.endswith(_EXTENSIONS["tusrec"]):
            from jaxcal.io.tus_rec import read_calib_matrix

            rigid, scale = read_calib_matrix(path)
            matrix = rigid @ np.diag([*scale, scale.mean(), 1.0])
            return transform_from_plus_matrix(matrix, source=name)
        if lower.endswith(_EXTENSIONS["ros"]):
            from jaxcal.io.ros import read_ros_yaml

            matrix, held = read_ros_yaml(path)
            record = {key: held.get(key) for key in _IN_THE_PLANE}
            record |= {"version": VERSION, "image_plane_to_probe": matrix}
            return transform_from_record(record, source=name)
        if lower.endswith(".npy"):
            return transform_from_plus_matrix(_load_npy(path), source=name)
        if lower.endswith(".npz"):
            return _load_npz(path)
        return transform_from_record(_json_object(path), source=name)


def stated_points(path: str | os.PathLike[str]) -> np.ndarray | None:
    """Middle and corners of the image, for which a JSON of ours states its error, (m, 2).

    They are in px, or mm where the calibration has no pixels; None if the file holds none. Points
    that a caller asked for are not among them: they may lie anywhere.

    Raises:
        FormatError: a ``.json`` that is no JSON object.
    """
    stated = _stated(path, "tre")
    try:
        corners = [each for each in stated["points"] if each.get("name") != ASKED_FOR]
        points = np.array([each["image"] for each in corners], dtype=np.float64)
    except (AttributeError, TypeError, KeyError, ValueError, OverflowError):
        return None
    sound = points.ndim == 2 and points.shape[1] == 2 and np.isfinite(points).all()
    return points if sound else None


def stated_source(path: str | os.PathLike[str]) -> str | None:
    """The recording that a JSON of ours says it was made from; None if it does not.

    Raises:
        FormatError: a ``.json`` that is no JSON object.
    """
    stated = _stated(path, "source")
    return stated if isinstance(stated, str) else None


def _stated(path: str | os.PathLike[str], key: str) -> Any:
    if not path_name(path).lower().endswith(".json"):
        return None
    with naming(path):
        return _json_object(path).get(key)


def _load_npy(path: str | os.PathLike[str]) -> np.ndarray:
    check_readable(path, maximum_bytes=4096)
    try:
        with open(path, "rb") as file:
            found = np.lib.format.read_array(file, allow_pickle=False)
    except Exception as error:
        # numpy hands on whatever its parser of headers stumbles over.
        raise FormatError(f"is not an array of numbers: {one_line(error)}") from None
    if found.dtype.kind not in "fiu":
        raise FormatError("is not an array of real numbers")
    return found.astype(np.float64)


def _load_npz(path: str | os.PathLike[str]) -> ImageTransform:
    """What :meth:`ImageTransform.save` writes; older files have fewer names."""
    check_readable(path, maximum_bytes=_NPZ_BYTES)
    try:
        with ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > _NPZ_BYTES:
                raise FormatError("holds more than a calibration")
        with np.load(path, allow_pickle=False) as file:
            record = {name: file[name].tolist() for name in _NPZ if name in file.files}
            if "probe_frame" in file.files:
                record["pose_frames"] = {"from": file["probe_frame"].tolist()}
            if "tre_factor" in file.files:
                record["tre"] = {"factor": file["tre_factor"].tolist()}
    except FormatError:
        raise
    except Exception as error:
        # zipfile, too, has errors of many kinds.
        raise FormatError(f"holds no arrays of numbers: {one_line(error)}") from None
    return transform_from_record({"version": VERSION} | record, source=os.fspath(path))


def _json_object(path: str | os.PathLike[str]) -> dict[str, Any]:
    content = read_bytes(path, MAXIMUM_BYTES)
    if not content.lstrip().startswith(b"{"):
        _format_of(os.fspath(path))
    try:
        record = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"is not JSON: {one_line(error)}") from None
    if not isinstance(record, dict):
        raise FormatError("is not a calibration: a JSON object is needed")
    return record


def transform_from_record(record: dict[str, Any], *, source: str = "memory") -> ImageTransform:
    """The calibration in an object of ``jaxcal calibrate --json``, of this or an older version.

    Raises:
        FormatError: another format, a newer version, or a field that is missing or no array.
        InputError: numbers that :class:`ImageTransform` refuses.
    """
    if record.get("format", FORMAT) != FORMAT:
        raise FormatError(f"is not a calibration: its format is {quoted(str(record['format']))}")
    version = record.get("version", 0)
    if type(version) is not int or not 0 <= version <= VERSION:
        raise FormatError(
            f"is version {quoted(str(version))} of the calibration format; this jaxcal understands "
            f"version {VERSION}: update jaxcal"
        )
    # Before version 1 the field had the name of PLUS's matrix, which is a different one.
    key = "image_to_probe" if version == 0 else "image_plane_to_probe"
    matrix = _array(record, key, (4, 4))
    if matrix is None:
        raise FormatError(f"is not a calibration: {key} is missing, or the solve had failed")
    usable = record.get("converged")
    if not (usable is None or isinstance(usable, bool)):
        raise FormatError("converged must be true, false or null")
    tre, frames = (
        found if isinstance(found, dict) else {}
        for found in (record.get("tre"), record.get("pose_frames"))
    )
    date, named, doubt = record.get("date"), frames.get("from"), record.get("doubtful_unit")
    if not (date is None or isinstance(date, str)):
        raise FormatError("date must be text")
    unknowns = _unknowns(record)
    size = len(tangent_names(unknowns))
    given = {
        "scale_mm_per_px": _array(record, "scale_mm_per_px", (2,)),
        "face_offset_mm": _array(record, "face_offset_mm", ()),
        "range_factor": _array(record, "range_factor", ()),
        "error_mm": _array(record, "rms_mm", ()),
        "tre_factor": _array(tre, "factor", ()),
        "degrees_of_freedom": _array(record, "degrees_of_freedom", ()),
        "variance_factor": _array(record, "variance_factor", ()),
        "covariance": _array(record, "covariance", (6, 6)),
        "image_covariance": _array(record, "image_covariance", (size, size)),
        "probe_frame": named if isinstance(named, str) else None,
        "doubtful_unit": doubt if isinstance(doubt, str) else None,
    }
    found = ImageTransform(
        matrix,
        converged=usable and not record.get("wrong_frames"),
        source=source,
        unknowns=unknowns,
        date=date,
        **{name: value for name, value in given.items() if value is not None},
    )
    whole, part = given["image_covariance"], given["covariance"]
    if not (whole is None or part is None):
        sds = np.sqrt(np.diag(part))
        if not (np.abs(whole[:6, :6] - part) <= _ROUNDED * np.outer(sds, sds)).all():
            raise FormatError(
                "image_covariance contradicts covariance: one of them was changed alone"
            )
    stated = _array(record, "plus_image_to_probe", (4, 4)) if found.converged is not False else None
    if stated is not None and not _agrees(found, stated):
        raise FormatError(
            "plus_image_to_probe contradicts image_plane_to_probe, scale_mm_per_px, face_offset_mm "
            "and range_factor: one of them was changed alone, or is missing"
        )
    return found


def _agrees(transform: ImageTransform, stated: np.ndarray) -> bool:
    """Whether PLUS's matrix in a record is that of the transform, but for rounding."""
    if transform.scale_mm_per_px is None:
        return False
    made = transform.plus_matrix()
    far = np.linalg.norm(made - stated, axis=0)
    return bool((far <= _ROUNDED * np.linalg.norm(made, axis=0) + _ROUNDED_MM).all())


def _unknowns(record: dict[str, Any]) -> tuple[str, ...]:
    """The blocks whose tangents ``image_unknowns`` names."""
    names = record.get("image_unknowns")
    if names is None:
        return ("translation", "rotation")
    known = isinstance(names, list) and all(isinstance(name, str) for name in names)
    blocks = tuple(row.name for row in TABLE.values() if known and row.tangents[0] in names)
    if not known or tangent_names(blocks) != names or blocks[:2] != ("translation", "rotation"):
        raise FormatError("image_unknowns names other unknowns than those of an image point")
    return blocks


def _array(record: dict[str, Any], key: str, shape: tuple[int, ...]) -> Any:
    """An array, a float for the shape (), or None."""
    value = record.get(key)
    if value is None:
        return None
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise FormatError(f"{key} must be numbers of shape {shape}") from None
    if array.shape != shape:
        raise FormatError(f"{key} must have shape {shape}, it has {array.shape}")
    if np.isfinite(array).all():
        return array if shape else float(array)
    # If the solve had failed, there may be NaN instead of null.
    if record.get("converged") is not False:
        raise FormatError(f"{key} holds NaN or Inf")
    return None
