"""The size of a pixel, from a DICOM clip of the same ultrasound machine and depth setting.

Ultrasound regions (Sequence of Ultrasound Regions, 0018,6011; DICOM PS3.3, C.8.5.5) say how far
apart pixels are, each for a box of the image. Only the data before the pixels are read, and those
only within a bound.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal import FormatError, MissingExtraError
from jaxcal.io.given_files import check_readable, naming, one_line
from jaxcal.runtime.messages import quoted

if TYPE_CHECKING:
    from pydicom import Dataset

_MOST_BYTES = 2**24
"""Most bytes read of a file; the data before the pixels of a clip are a few KiB."""
_MOST_REGIONS = 64
_TWO_DIMENSIONAL, _CM, _MM_PER_CM = 1, 3, 10.0
_PLAUSIBLE_MM = (1e-3, 5.0)
_DEFLATED = "1.2.840.10008.1.2.1.99"
_AGREES = 1e-3
"""Regions whose pixel sizes differ by less (relative) are one picture."""


@dataclass(frozen=True)
class PixelSize:
    """Pixels of a clip's B-mode picture.

    Attributes:
        spacing_mm: [lateral, axial], mm.
        columns: of the whole image, px; None where not stated.
        rows: likewise.
        region: (first column, first row, columns, rows) of the picture in the image, px.
    """

    spacing_mm: tuple[float, float]
    columns: int | None
    rows: int | None
    region: tuple[int, int, int, int]


def read_pixel_size(path: str | os.PathLike[str]) -> PixelSize:
    """The pixel size that a DICOM clip states.

    Args:
        path: a file with ultrasound regions; needs pydicom (``jaxcal[dicom]``).

    Raises:
        MissingExtraError: pydicom is not installed.
        FormatError: no DICOM file, damaged, no two-dimensional region in cm, or several with
            different pixel sizes; one line that starts with the path.
    """
    check_readable(path)
    with naming(path):
        data = _dataset(path)
        regions = _value(data, "SequenceOfUltrasoundRegions") or []
        if len(regions) > _MOST_REGIONS:
            raise FormatError(f"claims {len(regions)} ultrasound regions")
        found = [
            _region(region, data)
            for region in regions
            if _whole(region, "RegionSpatialFormat") == _TWO_DIMENSIONAL
        ]
        if not found:
            raise FormatError(
                "states no pixel size (no two-dimensional ultrasound region in cm): measure it on "
                "the image's ruler and give it with --spacing"
            )
        if None in (found[0].columns, found[0].rows):
            raise FormatError("is damaged or cut: it does not say how large its images are")
        sizes = np.array([each.spacing_mm for each in found])
        if (np.abs(sizes / sizes[0] - 1) > _AGREES).any():
            told = "; ".join(
                "{}: {:.6g} x {:.6g} mm".format(each.region, *each.spacing_mm) for each in found
            )
            raise FormatError(
                f"has regions with different pixel sizes ({told}): choose one with --spacing"
            )
        return found[0]


def _dataset(path: str | os.PathLike[str]) -> Dataset:
    try:
        from pydicom import dcmread
    except ImportError:
        name = os.fspath(path)
        raise MissingExtraError(f"{name}: needs pydicom: pip install 'jaxcal[dicom]'") from None
    with open(path, "rb") as file:
        # Whatever length the file claims, no more than this is read.
        content = BytesIO(file.read(_MOST_BYTES))
    try:
        # A file deflated as a whole would be unpacked without a bound; real clips are not deflated.
        if _DEFLATED.encode() in content.getvalue()[:4096]:
            raise FormatError("is deflated as a whole, which is not read")
        return dcmread(content, stop_before_pixels=True)
    except FormatError:
        raise
    except Exception as error:
        # pydicom raises whatever it stumbles over.
        raise FormatError(f"is not a DICOM file: {one_line(error)[:200]}") from None


def _region(region: Dataset, data: Dataset) -> PixelSize:
    units = [_whole(region, f"PhysicalUnits{axis}Direction") for axis in "XY"]
    if units != [_CM, _CM]:
        raise FormatError(f"a region's units are of codes {units}, not cm (3)")
    spacing = []
    for axis in "XY":
        step = abs(_number(region, f"PhysicalDelta{axis}")) * _MM_PER_CM
        if not _PLAUSIBLE_MM[0] <= step <= _PLAUSIBLE_MM[1]:
            raise FormatError(f"a pixel of {step:g} mm is not plausible")
        spacing.append(float(f"{step:.12g}"))
    edges = [
        _whole(region, f"RegionLocation{edge}") for edge in ("MinX0", "MinY0", "MaxX1", "MaxY1")
    ]
    if any(edge is None for edge in edges):
        raise FormatError("a region has no location")
    left, top, right, bottom = (int(edge or 0) for edge in edges)
    return PixelSize(
        (spacing[0], spacing[1]),
        _whole(data, "Columns"),
        _whole(data, "Rows"),
        (left, top, right - left + 1, bottom - top + 1),
    )


def _value(data: Dataset, keyword: str) -> Any:
    try:
        return data.get(keyword)
    except Exception as error:
        raise FormatError(f"{keyword} cannot be read: {one_line(error)[:100]}") from None


def _whole(data: Dataset, keyword: str) -> int | None:
    value = _value(data, keyword)
    return value if isinstance(value, int) else None


def _number(data: Dataset, keyword: str) -> float:
    value = _value(data, keyword)
    if not isinstance(value, int | float) or not np.isfinite(value):
        raise FormatError(f"{keyword} is not a number: {quoted(str(value))}")
    return float(value)
