"""What OpenIGTLink messages (:mod:`jaxcal.io.openigtlink`) hold: images, transforms, statuses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxcal.runtime.array_types import Float, Int16, UInt8


class ContentError(ValueError):
    """A body whose CRC is right and whose content cannot be used; says why."""


ImageArray = UInt8[np.ndarray, "height width"] | Int16[np.ndarray, "height width"]


@dataclass(frozen=True)
class Picture:
    """Content of an IMAGE: a plane of pixels.

    Attributes:
        array: (height, width), rows downwards; not writable.
        spacing_mm: [lateral, axial] mm per pixel.
    """

    array: ImageArray
    spacing_mm: tuple[float, float]


@dataclass(frozen=True)
class Tracked:
    """A TRANSFORM, or one element of a TDATA.

    Attributes:
        name: by the convention ``<From>To<To>``, e.g. ``ProbeToTracker``.
        matrix: (4, 4), mm, as sent: nothing says that it is rigid.
        status: as PlusServer says it (``OK``, ``OUT_OF_VIEW``...); empty where nothing is said.
    """

    name: str
    matrix: Float[np.ndarray, "4 4"]
    status: str = ""


@dataclass(frozen=True)
class StatusMessage:
    """Content of a STATUS: code 1 means OK, the others are listed in the protocol."""

    code: int
    subcode: int
    name: str
    text: str


@dataclass(frozen=True)
class TrackedFrame:
    """Content of PlusServer's TRACKEDFRAME (:mod:`jaxcal.io.tracked_frame`).

    Attributes:
        picture: the image, turned to the orientation MF; its pixel size is not known (1, 1).
        transforms: with their statuses.
    """

    picture: Picture
    transforms: tuple[Tracked, ...]


Content = Picture | tuple[Tracked, ...] | TrackedFrame | StatusMessage | None
