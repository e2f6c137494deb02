"""A calibration in use, without the data: applied to pixels, and as PLUS's matrix. Numpy only.

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

import datetime
import math
import os
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import check_affine, check_poses, matrices_from_rotations
from jaxcal.data.recording import LARGEST, check_spacing_unit
from jaxcal.io.frame_names import FramePair, probe_name
from jaxcal.io.given_files import naming
from jaxcal.model.image_points import point_jacobian
from jaxcal.model.unknowns import TABLE, tangent_names
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.arrays import outline
from jaxcal.runtime.given_values import check_flag, real_array, shaped_array
from jaxcal.runtime.messages import shown

SaveFormat = Literal["json", "plus", "slicer", "itk", "ros", "tusrec", "numpy"]

_ROUNDING = 1e-13
_LARGEST_PIXEL = 1e9
"""Largest pixel; beyond it nothing is an image, and squares overflow."""
_LENGTHS = ("image_plane_to_probe", "scale_mm_per_px", "face_offset_mm", "range_factor")
"""What PLUS's matrix is made of, whose numbers other programs take as float32."""
_UNEQUAL = 1e-6
"""Largest difference between a covariance's two halves, as a share of the SDs' product."""
_NO_SIZE = 1e-5
"""How near 1 mm a pixel's sides are in a rigid matrix. Estimated sizes are not so near."""
_SKEWED = 1e-3
"""Largest cosine between two columns of a matrix that count as orthogonal."""


@dataclass(frozen=True, eq=False)
class AppliedPoints:
    """Positions of pixels.

    Attributes:
        points: (n, 3), mm, in the tracker's frame if a pose was given, else in the probe's.
        covariance: (n, 3, 3), mm^2; NaN where the calibration's is not known.
    """

    points: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]

    __repr__ = outline


@dataclass(frozen=True, eq=False)
class ImageTransform:
    """A calibration without the data from which it was made.

    Attributes:
        image_plane_to_probe: (4, 4) X, rigid, mm, from (lateral, elevational, axial); the
            ``image_to_probe`` of :class:`jaxcal.Calibration`, and not PLUS's (:meth:`plus_matrix`).
        scale_mm_per_px: [lateral, axial]; None where points were in mm.
        face_offset_mm: range of pixel row 0, or of a measured range of 0, mm.
        covariance: (6, 6) of X's right perturbation X Exp([v, omega]), mm and rad; None if unknown.
        range_factor: estimated sound speed over the nominal one; ranges are multiplied by it.
        unknowns: blocks of estimated unknowns that move an image point, X's first.
        image_covariance: (q, q) of all ``unknowns`` (mm, rad, log units); if it is None, only
            ``covariance`` counts.
        error_mm: root mean square residual of the calibration, mm; None if unknown. See
            ``error_is_rms``.
        converged: whether the calibration can be used; None if unknown.
        source: the file, for messages.
        date: when the calibration was made, ISO 8601 with its time zone; None if unknown.
        probe_frame: name of the probe's frame, for programs that name frames; ``Probe`` is written
            for a name that PLUS refuses.
        tre_factor: how many times larger than the covariance and ``variance_factor`` say the
            calibration's verdict expects the errors of image points to be; 1 where no verdict is
            known.
        degrees_of_freedom: of the SDs behind the covariance, which were estimated from the same
            images; None where the SDs were given, or where a file does not say.
        variance_factor: how many times larger the mean square errors are than the covariance says,
            because of these SDs (:func:`jaxcal.predicted_tre` includes it); 1 where that is
            not known.
        error_is_rms: False where ``error_mm`` is what a file of PLUS states, which for fCal is the
            mean of the lowest 95 % of its errors.
        doubtful_unit: why all lengths may be in another unit than mm, in words; None where nothing
            is known to speak for it.

    Raises:
        InputError: wrong shapes, ``unknowns`` or ``date``, a ``source``, ``probe_frame`` or
            ``doubtful_unit`` that is no text; and, unless ``converged`` is False, NaN or Inf,
            lengths beyond :data:`~jaxcal.data.recording.LARGEST`, a matrix that is not rigid, sizes
            or a ``range_factor`` or ``tre_factor`` that are not positive, a negative ``error_mm``,
            ``degrees_of_freedom`` or a ``variance_factor`` below 1, a covariance that is not
            symmetric or has negative variances.
    """

    image_plane_to_probe: Float[np.ndarray, "4 4"]
    scale_mm_per_px: Float[np.ndarray, " 2"] | None = None
    face_offset_mm: float = 0.0
    covariance: Float[np.ndarray, "6 6"] | None = None
    error_mm: float | None = None
    converged: bool | None = None
    source: str = "memory"
    range_factor: float = 1.0
    unknowns: tuple[str, ...] = ("translation", "rotation")
    image_covariance: Float[np.ndarray, "q q"] | None = None
    date: str | None = None
    probe_frame: str = "Probe"
    tre_factor: float = 1.0
    degrees_of_freedom: float | None = None
    variance_factor: float = 1.0
    error_is_rms: bool = True
    doubtful_unit: str | None = None

    def __post_init__(self) -> None:
        moving = [name for name in TABLE if TABLE[name].in_image]
        blocks = tuple(self.unknowns) if isinstance(self.unknowns, tuple | list) else ()
        known = tuple(name for name in moving if name in blocks)
        if blocks[:2] != ("translation", "rotation") or blocks != known:
            raise InputError(
                f"unknowns must be translation, rotation and others of {moving}, in this order"
            )
        size = len(tangent_names(blocks))
        numbers = ("face_offset_mm", "range_factor", "tre_factor", "error_mm")
        shapes: dict[str, tuple[int, ...]] = {
            "image_plane_to_probe": (4, 4),
            "scale_mm_per_px": (2,),
            **dict.fromkeys((*numbers, "degrees_of_freedom", "variance_factor"), ()),
            "covariance": (6, 6),
            "image_covariance": (size, size),
        }
        for name in ("source", "probe_frame", "doubtful_unit"):
            value = getattr(self, name)
            if not (isinstance(value, str) or (value is None and name == "doubtful_unit")):
                raise InputError(f"{name} must be text, not {shown(value)}")
        if self.converged is not None:
            check_flag("converged", self.converged)
        if self.date is not None:
            _check_date(self.date)
        given = {name: getattr(self, name) for name in shapes}
        if given["image_plane_to_probe"] is None:
            raise InputError("image_plane_to_probe must be an array of real numbers")
        checked = {
            name: shaped_array(value, name, shapes[name])
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

    def __repr__(self) -> str:
        """The transform, the pixel size and the SDs; not the covariances."""
        shown = np.array2string(self.image_plane_to_probe, precision=4, suppress_small=True)
        lines = [f"ImageTransform of {self.source}", f"image_plane_to_probe (mm):\n{shown}"]
        if self.scale_mm_per_px is not None:
            lateral, axial = self.scale_mm_per_px
            lines.append(f"pixels (mm): {lateral:.6g} lateral, {axial:.6g} axial")
        if self.covariance is not None:
            sd = np.sqrt(self.covariance.diagonal())
            along = ", ".join(f"{each:.3g}" for each in sd[:3])
            about = ", ".join(f"{each:.3g}" for each in np.degrees(sd[3:]))
            lines.append(f"SDs along and about the image's axes: {along} mm; {about} deg")
        if self.tre_factor > 1:
            lines.append(f"errors expected by its verdict: {self.tre_factor:.1f} times as large")
        if self.doubtful_unit is not None:
            lines.append(f"uncertain: {self.doubtful_unit}")
        if self.converged is False:
            lines.append("must not be used")
        return "\n".join(lines)

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
            InputError: the calibration knows no pixel size: it was made from points in mm, or read
                from a file that holds none.
        """
        s_u, s_v = self.pixel_size_mm()
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

        Raises:
            InputError: the calibration has pixels already; a size that is not positive or not in
                mm; an origin that is NaN or over 1e9.
        """
        if self.scale_mm_per_px is not None:
            raise InputError("the calibration has pixels of its own: no other size is needed")
        scale, origin = real_array(size_mm, "size_mm"), real_array(origin_px, "origin_px")
        good = scale.shape == origin.shape == (2,)
        if not (good and (scale > 0).all() and (np.abs(origin) <= _LARGEST_PIXEL).all()):
            raise InputError(
                "a pixel's size must be two positive numbers, its origin two numbers up to "
                f"{_LARGEST_PIXEL:g}"
            )
        check_spacing_unit(scale)
        moved = self.image_plane_to_probe.copy()
        moved[:3, 3] -= moved[:3, 0] * scale[0] * origin[0]

        def shifted(covariance: np.ndarray | None) -> np.ndarray | None:
            if covariance is None:
                return None
            # X' = X T with T a shift by d along lateral moves the perturbation to the new origin.
            adjoint = np.eye(len(covariance))
            adjoint[1, 5], adjoint[2, 4] = -scale[0] * origin[0], scale[0] * origin[0]
            return adjoint @ covariance @ adjoint.T

        return replace(
            self,
            image_plane_to_probe=moved,
            scale_mm_per_px=scale,
            face_offset_mm=self.face_offset_mm - self.range_factor * float(scale[1] * origin[1]),
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
            estimated pixel sizes, sound speed and delay), times ``variance_factor``, so that their
            traces are the squares of :func:`jaxcal.predicted_tre`; and the points' own. They do not
            include the pose's, nor the verdict's ``tre_factor``.

        Raises:
            InputError: shapes that do not agree, NaN or numbers over 1e9, a negative SD, or a pose
                that is not rigid.
        """
        own = real_array(pixel_sd_px, "pixel_sd_px")
        if own.shape not in ((), (2,)):
            raise InputError(f"pixel_sd_px must be one number or two, not of shape {own.shape}")
        # Written so that NaN is refused, too.
        if not ((own >= 0) & (own <= _LARGEST_PIXEL)).all():
            raise InputError(f"pixel_sd_px must be from 0 to {_LARGEST_PIXEL:g}")
        plane = self.in_plane(pixels)
        count, rotation = len(plane), self.image_plane_to_probe[:3, :3]
        points = plane @ rotation.T + self.image_plane_to_probe[:3, 3]
        factor = self.error_factor(pixels)
        spread = np.zeros(3)
        spread[[0, 2]] = own * self._mm_per_px()
        covariance = self.variance_factor * factor @ factor.swapaxes(1, 2)
        covariance = covariance + rotation @ np.diag(spread**2) @ rotation.T
        if pose is None:
            return AppliedPoints(points, covariance)
        given = real_array(pose, "pose")
        given = check_poses(given[None] if given.ndim == 2 else given)
        if len(given) not in (1, count):
            raise InputError(f"{count} pixels but {len(given)} poses: one, or as many, are needed")
        poses = np.broadcast_to(given, (count, 4, 4))
        turn = poses[:, :3, :3]
        points = np.einsum("nij,nj->ni", turn, points) + poses[:, :3, 3]
        return AppliedPoints(points, turn @ covariance @ turn.swapaxes(1, 2))

    def error_factor(self, pixels: np.ndarray) -> Float[np.ndarray, "n 3 q"]:
        """F with F z the errors of image points in the probe's frame, mm; z are standard normals.

        The errors of all points come from the same z: those of the calibration's unknowns. F F' of
        a point, times ``variance_factor``, is its covariance in :meth:`apply`; NaN where the
        calibration's is not known.

        Args:
            pixels: as in :meth:`apply`.

        Raises:
            InputError: as :meth:`apply`.
        """
        plane = self.in_plane(pixels)
        covariance, blocks = self.image_covariance, self.unknowns
        if covariance is None:
            covariance, blocks = self.covariance, ("translation", "rotation")
        if covariance is None:
            return np.full((len(plane), 3, 6), np.nan)
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        jacobian = point_jacobian(plane[:, [0, 2]], blocks, self.face_offset_mm, self.range_factor)
        return self.image_plane_to_probe[:3, :3] @ jacobian @ root

    def _mm_per_px(self) -> Float[np.ndarray, " 2"]:
        """Size of a pixel at the estimated sound speed; 1 across where points are in mm."""
        scale = np.ones(2) if self.scale_mm_per_px is None else self.scale_mm_per_px
        return scale * np.array([1.0, self.range_factor])

    def in_plane(self, pixels: np.ndarray) -> Float[np.ndarray, "n 3"]:
        """Image points in the image frame, [lateral, 0, axial] mm.

        Args:
            pixels: as in :meth:`apply`.

        Raises:
            InputError: another shape, NaN or numbers over 1e9.
        """
        measured = _image_points(pixels, "pixels")
        # Written so that NaN is refused, too.
        if not (np.abs(measured) <= _LARGEST_PIXEL).all():
            raise InputError(f"pixels must be numbers up to {_LARGEST_PIXEL:g}, not NaN or Inf")
        plane = np.zeros((len(measured), 3))
        plane[:, [0, 2]] = self._mm_per_px() * measured + np.array([0.0, self.face_offset_mm])
        return plane

    def image_points(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Image points as measured, the inverse of :meth:`in_plane`.

        Args:
            places: (n, 2) [lateral, axial] in the image frame, mm.

        Returns:
            (n, 2) [u, v] px, or [lateral, range] mm where there are no pixels.

        Raises:
            InputError: another shape, or what are no numbers.
        """
        places = _image_points(places, "places")
        return (places - np.array([0.0, self.face_offset_mm])) / self._mm_per_px()

    def pixel_size_mm(self) -> Float[np.ndarray, " 2"]:
        """[lateral, axial] size of a pixel at the estimated sound speed, mm.

        Raises:
            InputError: the calibration knows no pixel size.
        """
        if self.scale_mm_per_px is None:
            raise InputError(
                f"{self.source}: no pixel size is known, so there is no Image frame in pixels: "
                "give the size of a pixel and the pixel of lateral 0, range 0 (jaxcal export with "
                "--pixel-size and --origin; in Python with_pixels)"
            )
        return self._mm_per_px()

    def save(
        self,
        path: str | os.PathLike[str],
        format: SaveFormat | None = None,
        *,
        frames: FramePair | None = None,
    ) -> None:
        """Write the calibration, complete or not at all.

        Args:
            path: the file to make; only a calibration in the same format is replaced.
            format: ``json`` (ours), ``plus`` (a ``<Transform>`` to paste), ``slicer`` or ``itk``
                (``.tfm``, ``.txt`` or ``.h5``), ``ros`` (YAML, metres), ``tusrec``
                (``calib_matrix.csv``) or ``numpy`` (``.npy``: PLUS's matrix; ``.npz``: all). By
                default that of the extension.
            frames: names of the image's and the probe's frame; by default Image and
                ``probe_frame`` (Probe if PLUS refuses that).

        Raises:
            InputError: an extension of another or no format, an existing file of another kind, an
                unknown pixel size, or a calibration that must not be used, in any format but
                ``json``, which says so.
            OutputError: the file could not be written and is unchanged.
        """
        from jaxcal.result import saved

        saved.save(self, path, format, frames=self._frames(frames))

    def text(self, format: SaveFormat, *, frames: FramePair | None = None) -> str:
        """The text that :meth:`save` writes in a format; for ``numpy`` it is PLUS's matrix.

        Raises:
            InputError: an unknown format, an unknown pixel size, or a calibration that must not be
                used, in any format but ``json``.
        """
        from jaxcal.result import saved

        return saved.text_of(self, format, frames=self._frames(frames))

    def _frames(self, frames: FramePair | None) -> FramePair:
        return ("Image", probe_name(self.probe_frame)) if frames is None else frames

    def left_out(self, format: SaveFormat) -> str | None:
        """What a format cannot hold and its user must do, in words; None if it holds everything.

        Raises:
            InputError: an unknown format.
        """
        from jaxcal.result import saved

        return saved.left_out(self, format)


def _image_points(value: Any, name: str) -> Float[np.ndarray, "n 2"]:
    """One point of an image or many, as rows."""
    points = np.atleast_2d(real_array(value, name))
    if points.ndim != 2 or points.shape[1] != 2:
        raise InputError(f"{name} must have shape (n, 2), not {np.shape(value)}")
    return points


def _checked(values: dict[str, np.ndarray]) -> Float[np.ndarray, "4 4"]:
    """Check the numbers of a calibration that is to be used; its matrix, which is then rigid."""
    for name, array in values.items():
        if name not in ("image_plane_to_probe", "error_mm") and not np.isfinite(array).all():
            raise InputError(f"{name} holds NaN or Inf")
        if name in _LENGTHS and (np.abs(array) > LARGEST).any():
            raise InputError(f"{name} holds a number beyond {LARGEST:g}: that cannot be a measure")
        if name in ("scale_mm_per_px", "range_factor", "tre_factor") and not (array > 0).all():
            raise InputError(f"{name} must be positive")
        if name == "error_mm" and array < 0:
            raise InputError("error_mm must not be negative")
        if name in ("degrees_of_freedom", "variance_factor") and array < 1:
            raise InputError(f"{name} must be at least 1")
        if name in ("covariance", "image_covariance") and (np.diag(array) < 0).any():
            raise InputError(f"{name} holds a negative variance")
        if name in ("covariance", "image_covariance") and not _is_symmetric(array):
            raise InputError(f"{name} is not symmetric")
    matrix = values["image_plane_to_probe"]
    rigid = check_poses(matrix[None], what="the matrix", labels=["image_plane_to_probe"])[0]
    # What was rigid keeps every digit.
    return matrix if np.abs(rigid - matrix).max() < _ROUNDING else rigid


def _check_date(value: object) -> None:
    """Refuse what is no date with a time zone."""
    try:
        if isinstance(value, str) and datetime.datetime.fromisoformat(value).tzinfo is not None:
            return
    except ValueError:
        pass
    raise InputError(f"date must be ISO 8601 with a time zone, not {shown(value)}")


def _is_symmetric(covariance: Float[np.ndarray, "q q"]) -> bool:
    """Whether a covariance is symmetric as far as its SDs matter."""
    sd = np.sqrt(np.diag(covariance))
    return bool((np.abs(covariance - covariance.T) <= _UNEQUAL * np.outer(sd, sd)).all())


def transform_from_plus_matrix(
    matrix: Float[np.ndarray, "4 4"], *, error_mm: float | None = None, source: str = "memory"
) -> ImageTransform:
    """The calibration of a PLUS ImageToProbe; its third column is checked but not used.

    Args:
        matrix: (u, v, 0, 1), px, to the probe, mm.
        error_mm: the error that the file states, mm; it is not taken for a root mean square.
        source: the file, for messages.

    Raises:
        InputError: NaN, a last row other than 0 0 0 1, a reflection, pixels without a size or of
            one that is not in mm, a rigid matrix, or columns that are not orthogonal to 1e-3, which
            a rigid transform with a pixel size cannot have.
    """
    with naming(source):
        matrix = check_affine(matrix)
    scale = np.linalg.norm(matrix[:3, :2], axis=0)
    if not (scale > 1e-9).all():
        raise InputError(f"{source}: a column of the matrix is zero: the pixels have no size")
    with naming(source):
        check_spacing_unit(scale)
        if (np.abs(scale - 1) < _NO_SIZE).all():
            raise InputError(
                "the matrix is rigid, as if a pixel measured exactly 1 mm by 1 mm: one that takes "
                "pixels to mm holds the size of a pixel in its columns. If it is jaxcal's "
                "image_plane_to_probe, save the calibration itself (.json): its columns are others"
            )
    lateral, axial = (matrix[:3, :2] / scale).T
    if abs(lateral @ axial) > _SKEWED:
        # Rounding may leave a cosine beyond 1.
        apart = math.degrees(np.arccos(np.clip(lateral @ axial, -1.0, 1.0)))
        raise InputError(
            f"{source}: rows and columns of pixels are {apart:.3f} degrees apart: fCal fitted the "
            "matrix without a constraint (OptimizationMethod NONE), or it was rounded, so that it "
            "is no rigid transform and pixel size"
        )
    # The nearest orthonormal pair, then y = z cross x.
    u, _, vt = np.linalg.svd(np.stack([lateral, axial], axis=1), full_matrices=False)
    lateral, axial = (u @ vt).T
    turn = np.stack([lateral, np.cross(axial, lateral), axial], axis=1)
    transform = matrices_from_rotations(turn, matrix[:3, 3])
    return ImageTransform(
        transform, scale, error_mm=error_mm, source=source, error_is_rms=error_mm is None
    )
