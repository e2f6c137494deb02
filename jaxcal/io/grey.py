"""Colour to grey by the weights of ITU-R BT.601, and pixels turned to the orientation MF."""

from __future__ import annotations

import numpy as np

from jaxcal.runtime.array_types import Num

_WEIGHTS = np.array([0.299, 0.587, 0.114])
"""Of red, green and blue."""


def grey_of(pixels: Num[np.ndarray, "rows columns channels"]) -> Num[np.ndarray, "rows columns"]:
    """A grey frame of the same type: the first channel of one or two, else of three colours."""
    if pixels.shape[2] < 3:
        return pixels[:, :, 0]
    grey = pixels[:, :, :3].astype(np.float64) @ _WEIGHTS
    # The weights add up to one, so no value leaves its type's range.
    return (grey if pixels.dtype.kind == "f" else np.rint(grey)).astype(pixels.dtype)


def oriented(frame: np.ndarray, stored: str) -> np.ndarray:
    """A frame that is stored in another orientation (UF, MN, UN) in MF."""
    if stored[0] == "U":
        frame = frame[:, ::-1]
    return frame[::-1] if stored[1] == "N" else frame
