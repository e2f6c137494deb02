"""What files that are used together should have in common. Numpy only."""

from __future__ import annotations

import numpy as np

from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import quoted

_OTHER_PIXELS = 1.02
"""Ratio of two pixel sizes from which on the depth setting is likely to have changed."""


def what_differs(
    names: tuple[str, str],
    sizes: tuple[Float[np.ndarray, " 2"] | None, Float[np.ndarray, " 2"] | None],
    whose: tuple[str, str],
) -> list[str]:
    """What two calibrations, or one and a recording, should have in common and do not, in words.

    Args:
        names: of the probe's frame; Probe where none is known.
        sizes: [lateral, axial] of a pixel, mm.
        whose: the two in words: the first, say.
    """
    words = []
    if len({*names} - {"Probe"}) == 2:
        words.append(
            f"The frames of the probe have different names: {quoted(names[0])} in {whose[0]}, "
            f"{quoted(names[1])} in {whose[1]}."
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
