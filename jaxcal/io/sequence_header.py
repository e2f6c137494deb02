"""What the headers of MetaImage and NRRD sequences have in common: fields of frames, and bounds.

Every frame has fields ``Seq_Frame0000_<Name>``: the transforms ``<From>To<To>Transform``, 16
numbers, row by row, in mm, the status of each, and a time stamp in seconds. Headers are not
trusted: their length is bounded, and sizes are compared with the file before anything is allocated.

Format: IGSIO, vtkIGSIOMetaImageSequenceIO and vtkIGSIONrrdSequenceIO.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast, get_args

import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.names import Orientation
from jaxcal.data.recording import MOST_IMAGES
from jaxcal.io.frame_names import FramePair, check_frames, split_name
from jaxcal.io.given_files import one_line
from jaxcal.io.pixel_stream import Packing, PixelStream
from jaxcal.io.sequence import Pixels, TrackedSequence
from jaxcal.io.table import finite_numbers
from jaxcal.runtime.messages import quoted

MAXIMUM_HEADER = 64 * 2**20
"""Largest header, bytes: some 60,000 frames."""
MOST_MATRICES = 1_000_000
"""Of all transforms in all frames: 128 MB."""
LARGEST_FRAME = 2**26
"""Most bytes of one frame."""
_MOST_INTERLEAVED = 2**29
"""Most bytes of frames that cannot be read one by one."""

_LONGEST_LINE = 2**16
_FRAME_FIELD = re.compile(r"Seq_Frame(\d{1,18})_(.+)", re.DOTALL)


@dataclass
class SequenceHeader:
    """Lines of a header: its own fields, those of frames, and where the pixels begin."""

    fields: dict[str, str] = field(default_factory=dict)
    frames: dict[int, dict[str, tuple[str, int]]] = field(default_factory=dict)
    end: int = 0

    def take(self, key: str, value: str, line: int) -> None:
        """Keep a field of a frame, or one of the header's own."""
        if not key.startswith("Seq_Frame"):
            if self.fields.setdefault(key, value) != value:
                raise FormatError(
                    f"line {line}: {quoted(key)} is given twice, with different values"
                )
            return
        found = _FRAME_FIELD.fullmatch(key)
        if found is None:
            raise FormatError(f"line {line}: {quoted(key)} does not name a frame and a field")
        number = int(found[1])
        if number >= MOST_IMAGES:
            raise FormatError(f"line {line}: frame {number}; at most {MOST_IMAGES} frames are read")
        of_frame = self.frames.setdefault(number, {})
        if found[2] in of_frame:
            raise FormatError(f"line {line}: {quoted(key)} is given twice")
        of_frame[found[2]] = (value, line)


def header_lines(path: Path) -> Iterator[tuple[int, str, int]]:
    """(number, text without its end, byte after its end) of a header's lines."""
    position = 0
    try:
        with path.open("rb") as file:
            for number in range(1, 2**31):
                line = file.readline(_LONGEST_LINE)
                if not line:
                    return
                position += len(line)
                if not line.endswith(b"\n") and len(line) >= _LONGEST_LINE:
                    raise FormatError(f"line {number} is too long: not a sequence file, or damaged")
                if position > MAXIMUM_HEADER:
                    raise FormatError(f"its header is longer than {MAXIMUM_HEADER} bytes")
                yield number, line.decode("utf-8", "replace").rstrip("\r\n"), position
    except OSError as error:
        raise FormatError(f"cannot be read: {one_line(error)}") from None


def whole_numbers(text: str, what: str) -> list[int]:
    """Whole numbers that are not negative, separated by blanks."""
    numbers = text.split()
    if not numbers or not all(re.fullmatch(r"\d{1,18}", number) for number in numbers):
        raise FormatError(f"{what} must be whole numbers, not {quoted(text)}")
    return [int(number) for number in numbers]


def checked_pixels(pixels: Pixels, count: int) -> Pixels:
    """The pixels, after their sizes were compared with bounds and with the file."""
    if pixels.channels not in (1, 3, 4):
        raise FormatError(f"{pixels.channels} channels a pixel; 1, 3 or 4 are read")
    if pixels.frame_bytes > LARGEST_FRAME:
        raise FormatError(
            f"a frame of {pixels.columns} x {pixels.rows} pixels is larger than "
            f"{LARGEST_FRAME} bytes"
        )
    if pixels.interleaved and pixels.frame_bytes * count > _MOST_INTERLEAVED:
        raise FormatError(
            "lists its frames along the first axis, and is too large to be read at once: list "
            "them along the last one"
        )
    # Opening the stream compares the size with the file.
    with PixelStream(pixels.path, pixels.start, pixels.packing, pixels.frame_bytes * count):
        return pixels


def stated_pixel_size(axes: Iterable[str]) -> tuple[float, float] | None:
    """Width and height of a pixel, mm, of texts that state each axis' spacing or direction.

    None where both are 1, which means that nobody set them, or where they cannot be read.
    """
    sizes = []
    for text in axes:
        try:
            sizes.append(float(np.linalg.norm([float(each) for each in text.split(",")])))
        except ValueError:
            sizes.append(np.nan)
    width, height = (*sizes, np.nan, np.nan)[:2]
    stated = np.isfinite([width, height]).all() and width > 0 and height > 0
    return (width, height) if stated and (width, height) != (1.0, 1.0) else None


def check_count(count: int, header: SequenceHeader) -> None:
    """Refuse absurd numbers of frames, and fields of frames that do not exist."""
    if count > MOST_IMAGES:
        raise FormatError(f"claims {count} frames; at most {MOST_IMAGES} are read")
    if count < 1:
        raise FormatError("holds no frames")
    beyond = [number for number in header.frames if number >= count]
    if beyond:
        raise FormatError(f"has fields of frame {min(beyond)}, but only {count} frames")


def orientation_and_kind(text: str, kind: str) -> tuple[Orientation | None, str]:
    """How pixels lie in their file, and what they are.

    Args:
        text: the orientation that a header states.
        kind: the type of images that it states.

    Returns:
        The first two letters of the orientation, None for XX, ?? and nothing; ``BRIGHTNESS``, or
        PLUS's name of another type. PLUS writes other orientations (``FM``) for RF data alone,
        which are refused as such when asked for.
    """
    # Missing means B-mode; Slicer writes the word twice. PLUS names B-mode in colour RGB_COLOR.
    kind = kind.strip()
    if kind in ("", "XX", "RGB_COLOR") or kind.startswith("BRIGHTNESS"):
        kind = "BRIGHTNESS"
    stated = text.strip().upper()
    # The third letter, the direction of a volume's planes, follows from the others.
    if stated[:2] in get_args(Orientation) and stated[2:] in ("", "A", "D"):
        return cast(Orientation, stated[:2]), kind
    if stated not in ("", "XX", "??") and kind == "BRIGHTNESS":
        raise FormatError(
            f"orientation {quoted(text)} is not read: only MF, UF, MN and UN (write XX where it is "
            "not known)"
        )
    return None, kind


def sequence_of(
    header: SequenceHeader, count: int, pixels: Pixels | None, image_status: str
) -> TrackedSequence:
    """The sequence of a header; ``image_status`` is how the format names that field."""
    transforms: dict[FramePair, np.ndarray] = {}
    valid: dict[FramePair, np.ndarray] = {}
    without_status: dict[FramePair, None] = {}
    time = np.full(count, np.nan)
    image_valid = np.full(count, pixels is not None)
    for number, fields in header.frames.items():
        if "Timestamp" in fields:
            value, line = fields["Timestamp"]
            time[number] = finite_numbers(value, 1, f"line {line}: the time stamp")[0]
        if image_status in fields and fields[image_status][0].upper() != "OK":
            image_valid[number] = False
        for field_name, (value, line) in fields.items():
            pair = split_name(field_name.removesuffix("Transform"))
            if pair is None or not field_name.endswith("Transform"):
                continue
            if pair not in transforms:
                if (len(transforms) + 1) * count > MOST_MATRICES:
                    raise FormatError(
                        f"line {line}: more than {MOST_MATRICES // count} transforms in {count} "
                        "frames"
                    )
                transforms[pair] = np.full((count, 4, 4), np.nan)
                valid[pair] = np.zeros(count, bool)
            status = fields.get(f"{field_name}Status")
            if status is None:
                without_status[pair] = None
            if status is None or status[0].upper() == "OK":
                what = f"line {line}: a transform with status OK"
                transforms[pair][number] = finite_numbers(value, 16, what).reshape(4, 4)
                valid[pair][number] = True
    lacking = tuple(without_status)
    return TrackedSequence(transforms, valid, time, image_valid, pixels, without_status=lacking)


def check_written(transforms: Mapping[FramePair, np.ndarray], time: np.ndarray) -> None:
    """Refuse shapes, names and times that cannot be written."""
    if time.ndim != 1 or not 0 < len(time) <= MOST_IMAGES:
        raise InputError(f"1 to {MOST_IMAGES} time stamps are needed, not shape {time.shape}")
    if not np.isfinite(time).all():
        raise InputError(f"time stamp {np.flatnonzero(~np.isfinite(time))[0]} is NaN or Inf")
    milliseconds = np.round(time * 1e3)
    order = np.argsort(milliseconds, kind="stable")
    same = np.flatnonzero(np.diff(milliseconds[order]) == 0)
    if len(same):
        first, second = order[same[0]], order[same[0] + 1]
        raise InputError(
            f"frames {first} and {second} have the same time stamp to the millisecond; Slicer "
            "would keep one of them"
        )
    for (source, target), matrices in transforms.items():
        check_frames((source, target))
        if np.shape(matrices) != (len(time), 4, 4):
            raise InputError(
                f"{source}To{target} has shape {np.shape(matrices)}, ({len(time)}, 4, 4) is needed"
            )


def stacked(images: Iterable[np.ndarray] | None, count: int) -> np.ndarray:
    """Images as one array; a dummy pixel a frame where there are none."""
    if images is None:
        return np.zeros((count, 1, 1), np.uint8)
    stack = np.asarray(list(images))
    if len(stack) != count or stack.ndim not in (3, 4) or (stack.ndim == 4 and stack.shape[3] != 3):
        raise InputError(f"images have shape {stack.shape}, ({count}, rows, columns) is needed")
    if stack.dtype not in (np.uint8, np.int16):
        raise InputError(f"images must be uint8 or int16, not {stack.dtype}")
    return stack


def packed_pixels(stack: np.ndarray, packing: Packing) -> bytes:
    """The bytes of pixels, packed frame by frame."""
    content = stack.astype(stack.dtype.newbyteorder("<"), copy=False)
    if packing == "raw":
        return content.tobytes()
    packer = zlib.compressobj(wbits=31 if packing == "gzip" else 15)
    return b"".join([*(packer.compress(frame.tobytes()) for frame in content), packer.flush()])


def frame_fields(
    transforms: Mapping[FramePair, np.ndarray],
    valid: Mapping[FramePair, np.ndarray] | None,
    time: np.ndarray,
    image_status: str | None,
) -> Iterator[tuple[str, str]]:
    """Keys and values of all frames; the status of images, where they have one, under this name."""
    for index in range(len(time)):
        start = f"Seq_Frame{index:04d}_"
        for pair, matrices in transforms.items():
            good = valid is None or pair not in valid or bool(valid[pair][index])
            matrix = np.asarray(matrices[index], dtype=np.float64)
            if good and not np.isfinite(matrix).all():
                raise InputError(f"{'To'.join(pair)} of frame {index} holds NaN or Inf")
            numbers = matrix if np.isfinite(matrix).all() else np.eye(4)
            key = f"{start}{'To'.join(pair)}Transform"
            yield key, " ".join(map(repr, numbers.ravel().tolist()))
            yield f"{key}Status", "OK" if good else "INVALID"
        yield f"{start}Timestamp", repr(float(time[index]))
        if image_status is not None:
            yield f"{start}{image_status}", "OK"


def written_orientation(orientation: str) -> str:
    """The orientation with its third letter; right-handed images leave no choice for it."""
    third = {"MF": "A", "UF": "D", "UN": "A", "MN": "D"}
    if orientation not in third:
        raise InputError(f"orientation must be MF, UF, MN or UN, not {quoted(orientation)}")
    return orientation + third[orientation]
