"""PNG files: grey frames in and out. Their sizes are checked before anything is unpacked."""

from __future__ import annotations

import os
import zlib
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np

from jaxcal import FormatError
from jaxcal.io.given_files import check_readable, one_line
from jaxcal.io.grey import grey_of

if TYPE_CHECKING:
    from PIL.Image import Image

MOST_PIXELS = 2**24
"""Largest image that is read, px."""
_MOST_BYTES = 2**28


def png_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Columns and rows of an image; its pixels are not read.

    Raises:
        FormatError: no PNG file, or one that is too large; one line that starts with the path.
    """
    with _opened(path) as image:
        return image.size


def read_png(path: str | os.PathLike[str]) -> np.ndarray:
    """The first picture of a PNG file in grey.

    Args:
        path: grey or colour, 8 or 16 bits; transparency is ignored.

    Returns:
        (rows, columns), uint8, or uint16 where the file has 16 bits.

    Raises:
        FormatError: no PNG file, too large, or damaged; one line that starts with the path.
    """
    with _opened(path) as image:
        try:
            if image.mode in ("I;16", "I;16B", "I"):
                return np.asarray(image, dtype=np.uint16)
            if image.mode in ("1", "L", "LA"):
                return np.array(image.convert("L"))
            return grey_of(np.asarray(image.convert("RGB")))
        except (OSError, SyntaxError, ValueError, EOFError, zlib.error) as error:
            raise FormatError(f"{os.fspath(path)}: is damaged: {one_line(error)}") from None


def encode_png(frame: np.ndarray) -> bytes:
    """A grey frame as PNG of 8 bits; other types are stretched from their least to largest value.

    Args:
        frame: (rows, columns), any real type; NaN and Inf become black.
    """
    from PIL import Image

    if frame.dtype != np.uint8:
        values = np.nan_to_num(frame.astype(np.float64), posinf=0.0, neginf=0.0)
        low, high = float(values.min()), float(values.max())
        frame = np.rint((values - low) * (255 / (high - low if high > low else 1))).astype(np.uint8)
    content = BytesIO()
    Image.fromarray(np.ascontiguousarray(frame)).save(content, "PNG", compress_level=1)
    return content.getvalue()


def _opened(path: str | os.PathLike[str]) -> Image:
    from PIL import Image

    check_readable(path, maximum_bytes=_MOST_BYTES)
    name = os.fspath(path)
    try:
        # Pillow knows fifty formats; a file that says it is a PNG is read as nothing else.
        image = Image.open(path, formats=["PNG"])
    except Image.DecompressionBombError:
        raise FormatError(f"{name}: claims too many pixels (at most {MOST_PIXELS})") from None
    except (OSError, SyntaxError, ValueError, EOFError, zlib.error):
        raise FormatError(f"{name}: is not a PNG file, or is damaged") from None
    columns, rows = image.size
    if columns * rows > MOST_PIXELS:
        image.close()
        raise FormatError(f"{name}: claims {columns} x {rows} px (at most {MOST_PIXELS} in all)")
    return image
