"""What files that are used together should have in common. Numpy only."""

from __future__ import annotations

import numpy as np

from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import quoted

_OTHER_PIXELS = 1.02
"""Ratio of two pixel sizes from which on the depth setting is likely to have changed."""
_OTHER_ORIGIN_MM = 0.05
"""Largest difference of two face offsets that is passed over, mm."""


def what_differs(
    names: tuple[str, str],
    sizes: tuple[Float[np.ndarray, " 2"] | None, Float[np.ndarray, " 2"] | None],
    whose: tuple[str, str],
    origins: tuple[float, float] = (0.0, 0.0),
) -> list[str]:
    """What two calibrations, or one and a recording, should have in common and do not, in words.

    Args:
        names: of the probe's frame; Probe where none is known.
        sizes: [lateral, axial] of a pixel, mm.
        whose: the two in words: the first, say.
        origins: range of pixel row 0, or of a measured range of 0, mm.
    """
    words = []
    if len({*names} - {"Probe"}) == 2:
        words.append(
            f"The frames of the probe have different names: {quoted(names[0])} in {whose[0]}, "
            f"{quoted(names[1])} in {whose[1]}."
        )
    if abs(origins[0] - origins[1]) > _OTHER_ORIGIN_MM:
        words.append(
            f"Ranges begin at {origins[0]:.6g} mm in {whose[0]} and at {origins[1]:.6g} mm in "
            f"{whose[1]} (face offset): points are computed with the first."
        )
    one, other = sizes
    if one is None or other is None or (abs(np.log(one / other)) < np.log(_OTHER_PIXELS)).all():
        return words
    told = [f"{lateral:.4f} x {axial:.4f} mm" for lateral, axial in (one, other)]
    return [
        *words,
        f"A pixel is {told[0]} in {whose[0]} and {told[1]} in {whose[1]}: were they taken at one "
        "depth setting?",
    ]
