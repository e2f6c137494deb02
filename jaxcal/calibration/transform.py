"""A calibration in use: loaded, applied to pixels, saved for other programs. Numpy only.

There are two descriptions of the same calibration. jaxcal's own is rigid and in mm: X = [a e z | t]
takes the image plane (lateral, elevational, axial) to the probe, and in this plane a pixel is
(s_u u, 0, s_v v + f). PLUS's ``ImageToProbe`` takes (u, v, 0, 1) in pixels to the probe and
includes the pixel size:

    M[:3, 0] = s_u a,  M[:3, 1] = s_v z,  M[:3, 2] = -(s_u + s_v) / 2 e,  M[:3, 3] = t + f z,

where s_v is the pixel's size at the estimated sound speed, and f the range of row 0 at this speed.

The third column is *minus* the elevational axis, since jaxcal has y = z cross x and PLUS has
z = x cross y.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal
from zipfile import ZipFile

import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.poses import check_affine, check_poses
from jaxcal.diagnostics.image_points import point_jacobian
from jaxcal.io.atomic import atomic_path, write_text
from jaxcal.io.frame_names import FramePair
from jaxcal.io.outputs import check_output
from jaxcal.io.readable import check_readable, naming, one_line, quoted
from jaxcal.model.unknowns import TABLE, tangent_names
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.arrays import real_array

FORMAT = "jaxcal-calibration"
VERSION = 1
MAXIMUM_BYTES = 64 * 2**20

_NPZ = (
    "image_plane_to_probe",
    "scale_mm_per_px",
    "face_offset_mm",
    "range_factor",
    "covariance",
    "image_unknowns",
    "image_covariance",
    "rms_mm",
    "converged",
)
_NPZ_BYTES = 65536
"""Largest size of an ``.npz``, also unpacked."""

SaveFormat = Literal["json", "plus", "slicer", "itk", "ros", "tusrec", "numpy"]

_ROUNDING = 1e-13
_LARGEST = 1e9
"""Largest pixel; beyond it nothing is an image, and squares overflow."""
_SKEWED = 1e-3
"""Largest cosine between two columns of a matrix that count as orthogonal."""


@dataclass(frozen=True)
class AppliedPoints:
    """Positions of pixels.

    Attributes:
        points: (n, 3), mm, in the tracker's frame if a pose was given, else in the probe's.
        covariance: (n, 3, 3), mm^2; NaN where the calibration's is not known.
    """

    points: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]


@dataclass(frozen=True)
class ImageTransform:
    """A calibration without the data from which it was made.

    Attributes:
        image_plane_to_probe: (4, 4) X, rigid, mm, from (lateral, elevational, axial).
        scale_mm_per_px: [lateral, axial]; None where points were in mm.
        face_offset_mm: range of pixel row 0, or of a measured range of 0, mm.
        covariance: (6, 6) of X's right perturbation X Exp([v, omega]), mm and rad; None if unknown.
        range_factor: estimated sound speed over the nominal one; ranges are multiplied by it.
        unknowns: blocks of estimated unknowns that move an image point, X's first.
        image_covariance: (q, q) of all ``unknowns`` (mm, rad, log units); if it is None, only
            ``covariance`` counts.
        error_mm: root mean square residual of the calibration, mm; None if unknown.
        converged: whether the calibration can be used; None if unknown.
        source: the file, for messages.

    Raises:
        InputError: wrong shapes or ``unknowns``; and, unless ``converged`` is False, NaN or Inf, a
            matrix that is not rigid, sizes or a factor that are not positive, negative variances.
    """

    image_plane_to_probe: Float[np.ndarray, "4 4"]
    scale_mm_per_px: Float[np.ndarray, 2] | None = None
    face_offset_mm: float = 0.0
    covariance: Float[np.ndarray, "6 6"] | None = None
    error_mm: float | None = None
    converged: bool | None = None
    source: str = field(default="memory", compare=False)
    range_factor: float = 1.0
    unknowns: tuple[str, ...] = ("translation", "rotation")
    image_covariance: Float[np.ndarray, "q q"] | None = None

    def __post_init__(self) -> None:
        moving = [name for name in TABLE if TABLE[name].in_image]
        blocks = tuple(self.unknowns)
        if blocks[:2] != ("translation", "rotation") or not set(blocks) <= set(moving):
            raise InputError(f"unknowns must be translation, rotation and others of {moving}")
        size = len(tangent_names(blocks))
        shapes = {
            "image_plane_to_probe": (4, 4),
            "scale_mm_per_px": (2,),
            "face_offset_mm": (),
            "range_factor": (),
            "covariance": (6, 6),
            "image_covariance": (size, size),
            "error_mm": (),
        }
        given = {name: getattr(self, name) for name in shapes}
        checked = {
            name: _numbers(value, name, shapes[name])
            for name, value in given.items()
            if value is not None
        }
        if self.converged is not False:
            checked["image_plane_to_probe"] = _checked(checked)
        for name, array in checked.items():
            object.__setattr__(self, name, array if shapes[name] else float(array))
        object.__setattr__(self, "unknowns", blocks)
        if self.error_mm is not None and not math.isfinite(self.error_mm):
            object.__setattr__(self, "error_mm", None)

    def check_usable(self) -> None:
        """Refuse to hand on a calibration that must not be used.

        Raises:
            InputError: ``converged`` is False.
        """
        if self.converged is False:
            raise InputError(
                f"{self.source}: must not be used: it did not converge, its images do not "
                "determine it, or their frames or units are wrong (its verdict says which)"
            )

    def plus_matrix(self) -> Float[np.ndarray, "4 4"]:
        """PLUS's ImageToProbe: (u, v, 0, 1), px, to the probe, mm.

        Raises:
            InputError: the calibration was made from points in mm, which have no pixels.
        """
        s_u, s_v = self._scale() * [1.0, self.range_factor]
        lateral, elevational, axial, origin = self.image_plane_to_probe[:3].T
        matrix = np.eye(4)
        matrix[:3, 0] = s_u * lateral
        matrix[:3, 1] = s_v * axial
        matrix[:3, 2] = -(s_u + s_v) / 2 * elevational
        matrix[:3, 3] = origin + self.face_offset_mm * axial
        return matrix

    def with_pixels(
        self, size_mm: tuple[float, float], origin_px: tuple[float, float] = (0.0, 0.0)
    ) -> ImageTransform:
        """A calibration from points in mm, converted to pixels of a known size.

        Args:
            size_mm: [lateral, axial] of a pixel.
            origin_px: [u, v] of lateral 0, range 0.
        """
        if self.scale_mm_per_px is not None:
            raise InputError("the calibration has pixels of its own: no other size is needed")
        scale = np.array(size_mm, dtype=np.float64)
        if not (np.isfinite(scale).all() and (scale > 0).all() and np.isfinite(origin_px).all()):
            raise InputError("a pixel's size must be two positive numbers, its origin two numbers")
        moved = self.image_plane_to_probe.copy()
        moved[:3, 3] -= moved[:3, 0] * scale[0] * origin_px[0]

        def shifted(covariance: np.ndarray | None) -> np.ndarray | None:
            if covariance is None:
                return None
            # X' = X T with T a shift by d along lateral moves the perturbation to the new origin.
            adjoint = np.eye(len(covariance))
            adjoint[:3, 3:6] = -_cross(np.array([-scale[0] * origin_px[0], 0.0, 0.0]))
            return adjoint @ covariance @ adjoint.T

        return replace(
            self,
            image_plane_to_probe=moved,
            scale_mm_per_px=scale,
            face_offset_mm=self.face_offset_mm - self.range_factor * float(scale[1] * origin_px[1]),
            covariance=shifted(self.covariance),
            image_covariance=shifted(self.image_covariance),
        )

    def apply(
        self,
        pixels: np.ndarray,
        pose: np.ndarray | None = None,
        *,
        pixel_sd_px: float | tuple[float, float] = 0.0,
    ) -> AppliedPoints:
        """Take image points to the probe or the tracker, with their uncertainty.

        Args:
            pixels: (n, 2) or (2,): [u, v] px, or [lateral, range] mm where there are no pixels.
            pose: (4, 4) or (n, 4, 4), probe -> tracker, mm; None: points in the probe's frame.
            pixel_sd_px: SD of the points themselves, one number or [u, v] (mm without pixels).

        Returns:
            Points and covariances. The covariances include the calibration's (also that of
            estimated pixel sizes, sound speed and delay) and the points' own, but not the pose's.

        Raises:
            InputError: shapes that do not agree, NaN or numbers over 1e9, a negative SD, or a pose
                that is not rigid.
        """
        measured = real_array(pixels, "pixels")
        measured = measured[None] if measured.ndim == 1 else measured
        if measured.ndim != 2 or measured.shape[1] != 2:
            raise InputError(f"pixels must have shape (n, 2), not {measured.shape}")
        own = real_array(pixel_sd_px, "pixel_sd_px")
        if own.shape not in ((), (2,)):
            raise InputError(f"pixel_sd_px must be one number or two, not of shape {own.shape}")
        # Written so that NaN is refused, too.
        if not (np.abs(measured) <= _LARGEST).all():
            raise InputError(f"pixels must be numbers up to {_LARGEST:g}, not NaN or Inf")
        if not ((own >= 0) & (own <= _LARGEST)).all():
            raise InputError(f"pixel_sd_px must be from 0 to {_LARGEST:g}")
        count = len(measured)
        scale = np.ones(2) if self.scale_mm_per_px is None else self.scale_mm_per_px
        plane = np.zeros((count, 3))
        plane[:, 0] = scale[0] * measured[:, 0]
        scale = scale * np.array([1.0, self.range_factor])
        plane[:, 2] = scale[1] * measured[:, 1] + self.face_offset_mm
        rotation = self.image_plane_to_probe[:3, :3]
        points = plane @ rotation.T + self.image_plane_to_probe[:3, 3]
        covariance = self._covariance(plane, rotation, scale, own)
        if pose is None:
            return AppliedPoints(points, covariance)
        given = np.asarray(pose, dtype=np.float64)
        given = given[None] if given.ndim == 2 else given
        if len(given) not in (1, count):
            raise InputError(f"{count} pixels but {len(given)} poses: one, or as many, are needed")
        poses = np.broadcast_to(check_poses(given), (count, 4, 4))
        turn = poses[:, :3, :3]
        points = np.einsum("nij,nj->ni", turn, points) + poses[:, :3, 3]
        return AppliedPoints(points, turn @ covariance @ turn.swapaxes(1, 2))

    def _covariance(
        self,
        plane: Float[np.ndarray, "n 3"],
        rotation: Float[np.ndarray, "3 3"],
        scale: Float[np.ndarray, 2],
        pixel_sd: Float[np.ndarray, "*two"],
    ) -> Float[np.ndarray, "n 3 3"]:
        """R (J C J' + S) R', in the probe's frame; J is :mod:`jaxcal.diagnostics.image_points`'."""
        covariance, blocks = self.image_covariance, self.unknowns
        if covariance is None:
            covariance, blocks = self.covariance, ("translation", "rotation")
        if covariance is None:
            return np.full((len(plane), 3, 3), np.nan)
        jacobian = point_jacobian(plane[:, [0, 2]], blocks, self.face_offset_mm, self.range_factor)
        own = np.zeros(3)
        own[[0, 2]] = pixel_sd * scale
        inner = jacobian @ covariance @ jacobian.swapaxes(1, 2) + np.diag(own**2)
        return rotation @ inner @ rotation.T

    def _scale(self) -> Float[np.ndarray, 2]:
        if self.scale_mm_per_px is None:
            raise InputError(
                f"{self.source}: was made from points in mm, so that there is no Image frame in "
                "pixels: give the size of a pixel and the pixel of lateral 0, range 0 "
                "(--pixel-size, --origin)"
            )
        return self.scale_mm_per_px

    def save(
        self,
        path: str | os.PathLike[str],
        format: SaveFormat | None = None,
        *,
        frames: FramePair = ("Image", "Probe"),
    ) -> None:
        """Write the calibration, complete or not at all.

        Args:
            path: the file to make; only a calibration in the same format is replaced.
            format: ``json`` (ours), ``plus`` (a ``<Transform>`` to paste), ``slicer`` or ``itk``
                (``.tfm``, ``.txt`` or ``.h5``), ``ros`` (YAML, metres), ``tusrec``
                (``calib_matrix.csv``) or ``numpy`` (``.npy``: PLUS's matrix; ``.npz``: all). By
                default that of the extension.
            frames: names of the image's and the probe's frame.

        Raises:
            InputError: an extension of another or no format, an existing file of another kind, an
                unknown pixel size, or a calibration that must not be used, in any format but
                ``json``, which says so.
            OutputError: the file could not be written and is unchanged.
        """
        chosen = check_target(path, format)
        if chosen != "json":
            self.check_usable()
        if chosen in ("slicer", "itk"):
            from jaxcal.io.itk import write_itk

            write_itk(path, self.plus_matrix())
        elif chosen == "numpy":
            with atomic_path(path) as temporary, temporary.open("wb") as file:
                if os.fspath(path).lower().endswith(".npz"):
                    known = {key: value for key, value in self._record().items() if key in _NPZ}
                    matrix = None if self.scale_mm_per_px is None else self.plus_matrix()
                    known["plus_image_to_probe"] = matrix
                    np.savez(file, **{k: v for k, v in known.items() if v is not None})
                else:
                    np.save(file, self.plus_matrix())
        else:
            write_text(path, self.text(chosen, frames=frames))

    def text(self, format: SaveFormat, *, frames: FramePair = ("Image", "Probe")) -> str:
        """The text that :meth:`save` writes in a format; for ``numpy`` it is PLUS's matrix.

        Raises:
            InputError: an unknown format, or an unknown pixel size.
        """
        if format == "json":
            try:
                return json.dumps(self._record(), indent=2, allow_nan=False) + "\n"
            except ValueError:
                failed = f"{self.source}: the solve had failed: there is no transform to write"
                raise InputError(failed) from None
        if format == "plus":
            from jaxcal.io.plus import transform_element

            return transform_element(frames, self.plus_matrix(), error_mm=self.error_mm) + "\n"
        if format in ("slicer", "itk"):
            from jaxcal.io.itk import itk_text

            return itk_text(self.plus_matrix())
        if format == "ros":
            from jaxcal.io.ros import ros_yaml

            # ROS's own frames are in lower case; the user's are written as they are.
            child, parent = (n.lower() if n in ("Image", "Probe") else n for n in frames)
            return ros_yaml(self.image_plane_to_probe, parent, child, self.left_out(format))
        if format == "tusrec":
            from jaxcal.io.tus_rec import calib_matrix

            matrix = self.plus_matrix()
            scale = self._scale() * [1.0, self.range_factor]
            rigid = matrix.copy()
            rigid[:3, :3] /= [*scale, scale.mean()]
            return calib_matrix(rigid, scale)
        if format == "numpy":
            return np.array2string(self.plus_matrix(), separator=", ", floatmode="unique") + "\n"
        raise InputError(f"{quoted(str(format))} is no format that is written")

    def left_out(self, format: SaveFormat) -> str | None:
        """What a format cannot hold and its user must do, in words; None where nothing is."""
        if format != "ros":
            return None
        from jaxcal.io.ros import range_note

        return range_note(self.range_factor, self.face_offset_mm)

    def _record(self) -> dict[str, Any]:
        scale, covariance, full = self.scale_mm_per_px, self.covariance, self.image_covariance
        return {
            "format": FORMAT,
            "version": VERSION,
            "converged": self.converged,
            "image_plane_to_probe": self.image_plane_to_probe.tolist(),
            "plus_image_to_probe": None if scale is None else self.plus_matrix().tolist(),
            "scale_mm_per_px": None if scale is None else scale.tolist(),
            "face_offset_mm": self.face_offset_mm,
            "range_factor": self.range_factor,
            "covariance": None if covariance is None else covariance.tolist(),
            "image_unknowns": tangent_names(self.unknowns),
            "image_covariance": None if full is None else full.tolist(),
            "rms_mm": self.error_mm,
        }


def _numbers(value: Any, name: str, shape: tuple[int, ...]) -> np.ndarray:
    array = real_array(value, name)
    if array.shape != shape:
        raise InputError(f"{name} must have shape {shape}, it has {array.shape}")
    return array


def _checked(values: dict[str, np.ndarray]) -> Float[np.ndarray, "4 4"]:
    """Check the numbers of a calibration that is to be used; its matrix, which is then rigid."""
    for name, array in values.items():
        if name not in ("image_plane_to_probe", "error_mm") and not np.isfinite(array).all():
            raise InputError(f"{name} holds NaN or Inf")
        if name in ("scale_mm_per_px", "range_factor") and not (array > 0).all():
            raise InputError(f"{name} must be positive")
        if name in ("covariance", "image_covariance") and (np.diag(array) < 0).any():
            raise InputError(f"{name} holds a negative variance")
    matrix = values["image_plane_to_probe"]
    rigid = check_poses(matrix[None], what="the matrix", labels=["image_plane_to_probe"])[0]
    # What was rigid keeps every digit.
    return matrix if np.abs(rigid - matrix).max() < _ROUNDING else rigid


def _cross(vector: np.ndarray) -> Float[np.ndarray, "3 3"]:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


_EXTENSIONS: dict[SaveFormat, tuple[str, ...]] = {
    "json": (".json",),
    "plus": (".xml",),
    "slicer": (".tfm", ".txt", ".h5"),
    "itk": (".tfm", ".txt", ".h5"),
    "ros": (".yaml", ".yml"),
    "tusrec": (".csv",),
    "numpy": (".npy", ".npz"),
}


def _format_of(name: str) -> SaveFormat:
    for chosen, extensions in _EXTENSIONS.items():
        if name.lower().endswith(extensions):
            return chosen
    known = dict.fromkeys(each for extensions in _EXTENSIONS.values() for each in extensions)
    raise FormatError(f"{name}: its extension tells no format (there are {', '.join(known)})")


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
    name = os.fspath(path)
    chosen = _format_of(name) if format is None else format
    extensions = _EXTENSIONS.get(chosen)
    if extensions is None:
        raise InputError(f"{quoted(str(chosen))} is no format that is written")
    if not name.lower().endswith(extensions):
        raise InputError(f"{name}: a file of format {chosen} is named {' or '.join(extensions)}")
    check_output(path, f"a calibration (format {chosen})", lambda _: _is_one(path, chosen), inputs)
    return chosen


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


def transform_from_plus_matrix(
    matrix: Float[np.ndarray, "4 4"], *, error_mm: float | None = None, source: str = "memory"
) -> ImageTransform:
    """The calibration of a PLUS ImageToProbe; its third column is checked but not used.

    Args:
        matrix: (u, v, 0, 1), px, to the probe, mm.
        error_mm: the error that the file states, mm.
        source: the file, for messages.

    Raises:
        InputError: NaN, a last row other than 0 0 0 1, a reflection, pixels without a size, or
            columns that are not orthogonal to 1e-3, which a rigid transform with a pixel size
            cannot have.
    """
    with naming(source):
        matrix = check_affine(matrix)
    scale = np.linalg.norm(matrix[:3, :2], axis=0)
    if not (scale > 1e-9).all():
        raise InputError(f"{source}: a column of the matrix is zero: the pixels have no size")
    lateral, axial = (matrix[:3, :2] / scale).T
    if abs(lateral @ axial) > _SKEWED:
        raise InputError(
            f"{source}: rows and columns of pixels are "
            f"{math.degrees(math.acos(lateral @ axial)):.3f} degrees apart: fCal fitted the matrix "
            "without a constraint (OptimizationMethod NONE), so that it is no rigid transform and "
            "pixel size"
        )
    # The nearest orthonormal pair, then y = z cross x.
    u, _, vt = np.linalg.svd(np.stack([lateral, axial], axis=1), full_matrices=False)
    lateral, axial = (u @ vt).T
    transform = np.eye(4)
    transform[:3, :3] = np.stack([lateral, np.cross(axial, lateral), axial], axis=1)
    transform[:3, 3] = matrix[:3, 3]
    return ImageTransform(transform, scale, error_mm=error_mm, source=source)


def load_calibration(path: str | os.PathLike[str]) -> ImageTransform:
    """Read a calibration; the file is not trusted, and JAX is not needed.

    Args:
        path: our JSON (of ``jaxcal calibrate --json`` or ``--out``, of any version), a
            configuration or fCal result of PLUS (``.xml``), a transform of ITK (``.tfm``, ``.txt``,
            ``.h5``), a ``calib_matrix.csv`` of TUS-REC, a YAML of easy_handeye, our ``.npz``, or
            PLUS's matrix as ``.npy``.

    Raises:
        FormatError: not such a file.
        InputError: matrices that cannot be used. The message of either error is one line that
            starts with the path.
    """
    name = os.fspath(path)
    lower = name.lower()
    with naming(path):
        if lower.endswith(".xml"):
            return _load_plus(path)
        if lower.endswith((".tfm", ".txt", ".h5")):
            from jaxcal.io.itk import read_itk

            return transform_from_plus_matrix(read_itk(path), source=name)
        if lower.endswith(".csv"):
            from jaxcal.io.tus_rec import read_calib_matrix

            rigid, scale = read_calib_matrix(path)
            matrix = rigid @ np.diag([*scale, scale.mean(), 1.0])
            return transform_from_plus_matrix(matrix, source=name)
        if lower.endswith((".yaml", ".yml")):
            from jaxcal.io.ros import read_ros_yaml

            return ImageTransform(read_ros_yaml(path), source=name)
        if lower.endswith(".npy"):
            return transform_from_plus_matrix(_load_npy(path), source=name)
        if lower.endswith(".npz"):
            return _load_npz(path)
        return transform_from_record(_json_object(path), source=name)


def _load_plus(path: str | os.PathLike[str]) -> ImageTransform:
    from jaxcal.io.plus import read_configuration, read_result
    from jaxcal.io.xml import read_xml

    name = os.fspath(path)
    root, _ = read_xml(path)
    found, error = None, None
    if root.tag == "ProbeCalibrationResult":
        result = read_result(path)
        found, error = result.find("Image", "Probe"), result.calibration_error_mm
    else:
        found = read_configuration(path).find("Image", "Probe")
        error = None if found is None else found.error_mm
    if found is None:
        raise FormatError("holds no transform from Image to Probe")
    return transform_from_plus_matrix(found.matrix, error_mm=error, source=name)


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
    except FormatError:
        raise
    except Exception as error:
        # zipfile, too, has errors of many kinds.
        raise FormatError(f"holds no arrays of numbers: {one_line(error)}") from None
    return transform_from_record({"version": VERSION} | record, source=os.fspath(path))


def _json_object(path: str | os.PathLike[str]) -> dict[str, Any]:
    check_readable(path, maximum_bytes=MAXIMUM_BYTES)
    try:
        content = Path(path).read_bytes()
        if not content.lstrip().startswith(b"{"):
            _format_of(os.fspath(path))
        record = json.loads(content)
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, FormatError):
            raise
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
    if not isinstance(version, int) or version > VERSION:
        raise FormatError(
            f"is version {quoted(str(version))} of the calibration format; this jaxcal understands "
            f"version {VERSION}: update jaxcal"
        )
    # Before version 1 the field had the name of PLUS's matrix, which is a different one.
    key = "image_to_probe" if version == 0 else "image_plane_to_probe"
    matrix = _array(record, key, (4, 4))
    if matrix is None:
        raise FormatError(f"is not a calibration: {key} is missing, or the solve had failed")
    scale = _array(record, "scale_mm_per_px", (2,))
    offset = _array(record, "face_offset_mm", ())
    factor = _array(record, "range_factor", ())
    error = _array(record, "rms_mm", ())
    usable = record.get("converged")
    usable = usable and not record.get("wrong_frames") if isinstance(usable, bool) else None
    unknowns = _unknowns(record)
    size = len(tangent_names(unknowns))
    return ImageTransform(
        matrix,
        scale,
        0.0 if offset is None else float(offset),
        _array(record, "covariance", (6, 6)),
        None if error is None else float(error),
        usable,
        source,
        1.0 if factor is None else float(factor),
        unknowns,
        _array(record, "image_covariance", (size, size)),
    )


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


def _array(record: dict[str, Any], key: str, shape: tuple[int, ...]) -> np.ndarray | None:
    value = record.get(key)
    if value is None:
        return None
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise FormatError(f"{key} must be numbers of shape {shape}") from None
    # If the solve had failed, there may be NaN instead of null.
    if array.shape != shape:
        raise FormatError(f"{key} must have shape {shape}, it has {array.shape}")
    return array if np.isfinite(array).all() else None
