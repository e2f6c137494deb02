"""Tracked sequences: frames, the transforms that were tracked with each, and their statuses.

:mod:`jaxcal.io.sequence_files` reads and writes them. Pixels stay in their file until they
are asked for, and come frame by frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import get_args

import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.names import LengthUnit, Orientation
from jaxcal.data.poses import check_poses, inverse_poses
from jaxcal.io.columns import LENGTHS_MM
from jaxcal.io.frame_names import FramePair, path_between
from jaxcal.io.given_files import naming
from jaxcal.io.grey import grey_of, oriented
from jaxcal.io.pixel_stream import Packing, PixelStream
from jaxcal.runtime.array_types import Bool, Float, Int
from jaxcal.runtime.messages import quoted


@dataclass(frozen=True)
class Pixels:
    """Where a sequence's pixels are and how they are stored.

    Attributes:
        path: the file that holds them.
        start: their first byte.
        packing: how they are packed.
        columns: of a frame, px.
        rows: of a frame, px.
        channels: 1, or 3 for colour.
        dtype: of one number.
        orientation: of the stored pixels; None where the file does not say.
        kind: ``BRIGHTNESS`` for B-mode; PLUS's other types are RF data.
        interleaved: for each pixel the numbers of all frames, as 3D Slicer may write them.
        stated_mm: width and height of a pixel as the header states them; None where both are 1, as
            PLUS writes them whatever the image shows, or where they are missing.
    """

    path: Path
    start: int
    packing: Packing
    columns: int
    rows: int
    channels: int
    dtype: np.dtype
    orientation: Orientation | None
    kind: str = "BRIGHTNESS"
    interleaved: bool = False
    stated_mm: tuple[float, float] | None = None

    @property
    def frame_bytes(self) -> int:
        """Size of one frame, bytes."""
        return self.columns * self.rows * self.channels * self.dtype.itemsize


@dataclass(frozen=True)
class Hdf5Pixels:
    """Pixels in the dataset ``/frames`` (n, rows, columns) of uint8, MF-oriented.

    Attributes:
        path: of the HDF5 file.
        columns: of a frame, px.
        rows: of a frame, px.
    """

    path: Path
    columns: int
    rows: int


@dataclass(frozen=True)
class FolderPixels:
    """Pixels in PNG files of one folder, MF-oriented if nothing else is said.

    Attributes:
        paths: n files.
        columns: of a frame, px.
        rows: of a frame, px.
    """

    paths: tuple[Path, ...]
    columns: int
    rows: int


@dataclass(frozen=True)
class TrackedSequence:
    """A sequence of n frames.

    Attributes:
        transforms: (n, 4, 4) matrices, mm, by their frames (from, to); NaN where a frame has none.
        valid: (n,) by the same frames: the status was OK and a matrix was there.
        time: (n,) s; NaN where not stated.
        image_valid: (n,) whether a frame's pixels are there and were not marked as invalid.
        pixels: where they are; None for tracking alone.
        source: the file.
        numbers: (n,) by which other files name the frames, -1 for a frame without one; None: frames
            count from 0.
        clock: the date from which times count; None: they are seconds of a device's own clock.
        length_stated: whether the file of the transforms states their unit of length.
        time_stated: whether the unit of times is known, and not only taken for seconds.
        without_status: transforms that lack a status in some frame, where they are taken as OK.
    """

    transforms: Mapping[FramePair, Float[np.ndarray, "n 4 4"]]
    valid: Mapping[FramePair, Bool[np.ndarray, " n"]]
    time: Float[np.ndarray, " n"]
    image_valid: Bool[np.ndarray, " n"]
    pixels: Pixels | Hdf5Pixels | FolderPixels | None = None
    source: str = field(default="memory", compare=False)
    numbers: Int[np.ndarray, " n"] | None = None
    clock: datetime | None = None
    length_stated: bool = False
    time_stated: bool = True
    without_status: tuple[FramePair, ...] = ()

    def __len__(self) -> int:
        return len(self.time)

    def scaled(self, unit: LengthUnit) -> TrackedSequence:
        """The sequence of a file whose translations are in this unit."""
        factors = np.ones((4, 4))
        factors[:3, 3] = LENGTHS_MM[unit]
        transforms = {pair: matrices * factors for pair, matrices in self.transforms.items()}
        return replace(self, transforms=transforms)

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the images of a folder; empty for other sequences."""
        found = self.pixels.paths if isinstance(self.pixels, FolderPixels) else ()
        return tuple(path.name for path in found)

    def frame_name(self, row: int) -> str:
        """What a frame is called in other files, for messages."""
        if self.files:
            return quoted(self.files[row])
        return f"frame {row if self.numbers is None else self.numbers[row]}"

    @property
    def all_numbers(self) -> Int[np.ndarray, " n"]:
        """Numbers by which other files name the frames, -1 for a frame without one."""
        return np.arange(len(self)) if self.numbers is None else self.numbers

    def rows_of(
        self, numbers: Int[np.ndarray, " m"], labels: Sequence[str]
    ) -> Int[np.ndarray, " m"]:
        """Places of frames in the sequence by the numbers that other files give them.

        ``labels`` say where each number stands, for messages.

        Raises:
            InputError: a number that no frame has, or that several have.
        """
        known = self.all_numbers
        order = np.argsort(known, kind="stable")
        first, after = (
            np.searchsorted(known, numbers, side=side, sorter=order) for side in ("left", "right")
        )
        bad = np.flatnonzero(after - first != 1)
        if not len(bad):
            return order[first]
        where, number = labels[bad[0]], numbers[bad[0]]
        if after[bad[0]] > first[bad[0]]:
            raise InputError(f"{where}: several frames of {self.source} have the number {number}")
        stated = known[known >= 0]
        if not len(stated):
            raise InputError(
                f"{where}: frames of {self.source} have no numbers: name them by time, or images "
                "by a column file"
            )
        own = "" if self.numbers is None else " (the numbers in its own files)"
        raise InputError(
            f"{where}: frame {number} is not in the sequence, which has frames {stated.min()} to "
            f"{stated.max()}{own}"
        )

    def frames(self) -> list[str]:
        """Names of all coordinate frames, in the order of the transforms."""
        return list(dict.fromkeys(name for pair in self.transforms for name in pair))

    def poses(
        self, source: str, target: str
    ) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " n"]]:
        """Poses from one coordinate frame to another, through all transforms that are needed.

        Returns:
            (n, 4, 4) rigid poses, mm (the identity where not valid), and where every transform on
            the way had the status OK.

        Raises:
            InputError: no way between the frames, or a valid transform that is not rigid.
        """
        pairs = list(self.transforms)
        way = path_between(pairs, source, target)
        if not way:
            known = ", ".join(f"{a} to {b}" for a, b in pairs) or "none"
            raise InputError(
                f"{self.source}: no transforms lead from {quoted(source)} to {quoted(target)} "
                f"(there are: {known})"
            )
        valid = np.ones(len(self), bool)
        for index, _ in way:
            valid &= self.valid[pairs[index]]
        total = np.tile(np.eye(4), (len(self), 1, 1))
        for index, inverted in way:
            name = f"{self.source}: {'To'.join(pairs[index])}Transform of frame"
            step = check_poses(self.transforms[pairs[index]], valid, what=name)
            total = (inverse_poses(step) if inverted else step) @ total
        return total, valid

    def images(
        self, wanted: Sequence[int] | np.ndarray | None = None, *, orientation: str | None = None
    ) -> Iterator[np.ndarray]:
        """Frames one after another, grey, in the orientation MF (PLUS's Image frame).

        Args:
            wanted: increasing frame numbers; all by default. Others are not kept in memory.
            orientation: of the stored pixels, where the file does not say; it must not contradict
                the file.

        Yields:
            (rows, columns) arrays. Colour becomes grey by ITU-R BT.601's weights.

        Raises:
            FormatError: no pixels, an unknown orientation, RF data, or a damaged file.
        """
        pixels = self.pixels
        if pixels is None:
            raise FormatError(f"{self.source}: holds no pixels, only transforms")
        numbers = range(len(self)) if wanted is None else [int(number) for number in wanted]
        if isinstance(pixels, Hdf5Pixels):
            yield from _hdf5_images(pixels, numbers, orientation or "MF", self.source)
            return
        if isinstance(pixels, FolderPixels):
            for number in numbers:
                yield oriented(_png_image(pixels, number), orientation or "MF")
            return
        stored = pixels.orientation or orientation
        if orientation not in (None, stored):
            raise FormatError(
                f"{self.source}: says that its pixels are stored as {stored}, not {orientation}: "
                "leave --orientation out"
            )
        if pixels.kind != "BRIGHTNESS":
            raise FormatError(f"{self.source}: holds {quoted(pixels.kind)} data, not B-mode images")
        if stored is None or stored not in get_args(Orientation):
            raise FormatError(
                f"{self.source}: does not say how its pixels are oriented: say it by --orientation "
                "(MF, UF, MN or UN), as UltrasoundImageOrientation would"
            )
        size = pixels.frame_bytes
        with (
            naming(self.source),
            PixelStream(pixels.path, pixels.start, pixels.packing, size * len(self)) as stream,
        ):
            if pixels.interleaved:
                content = np.frombuffer(stream.read_at(0, size * len(self)), pixels.dtype)
                stream.check_end()
                frames = content.reshape(pixels.rows, pixels.columns, len(self))
                for number in numbers:
                    yield oriented(np.ascontiguousarray(frames[:, :, number]), stored)
                return
            for number in numbers:
                frame = np.frombuffer(stream.read_at(number * size, size), pixels.dtype)
                frame = frame.reshape(pixels.rows, pixels.columns, pixels.channels)
                yield oriented(grey_of(frame), stored)
            stream.check_end()


def _hdf5_images(
    pixels: Hdf5Pixels, numbers: Sequence[int], orientation: str, source: str
) -> Iterator[np.ndarray]:
    # h5py takes a fifth of a second to import, and other sequences do not need it.
    from jaxcal.io.untrusted import child, open_root, row

    with naming(source), open_root(pixels.path) as root:
        node = child(root, "frames")
        for number in numbers:
            if node is None:
                raise FormatError("/frames is missing")
            yield oriented(row(node, number), orientation)


def _png_image(pixels: FolderPixels, number: int) -> np.ndarray:
    # Pillow, which other sequences do not need.
    from jaxcal.io.png import read_png

    frame = read_png(pixels.paths[number])
    if frame.shape != (pixels.rows, pixels.columns):
        raise FormatError(f"{pixels.paths[number]}: has changed its size while it was being read")
    return frame
