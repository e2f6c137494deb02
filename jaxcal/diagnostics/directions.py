"""Directions of the unknowns in words: the least known one, and which images would tell it."""

from __future__ import annotations

import numpy as np

from jaxcal.model.unknowns import TABLE, block_slice
from jaxcal.result.calibration import Calibration, check_one
from jaxcal.result.diagnostics import ADDITIONS
from jaxcal.runtime.array_types import AnyArray
from jaxcal.runtime.arrays import plain
from jaxcal.runtime.messages import enumerated

_LEADING = 0.35
"""An unknown is named if its part of a direction is longer than this share of it."""
WORTH = 0.7
"""A kind of further image is advised if it tells at least this share of what the best one tells."""


def direction_in_words(vector: AnyArray, blocks: tuple[str, ...]) -> str:
    """Name a direction of the unknowns.

    Args:
        vector: components in scaled units (mm at the lever arm), in the order of ``blocks``.
        blocks: the unknowns.
    """
    vector = np.asarray(vector, float)
    parts = {block: vector[block_slice(blocks, block)] for block in blocks}
    size = {block: float(np.linalg.norm(part)) for block, part in parts.items()}
    total = float(np.linalg.norm(vector))
    if not np.isfinite(total) or total == 0:
        return "unknown"
    # X's own blocks are named first: to a reader the target's motion is a consequence of X's.
    leading = [block for block in blocks if size[block] > _LEADING * total]
    named = (
        [block for block in leading if block != "point"]
        or leading
        or [max(size, key=lambda block: size[block])]
    )
    words = [_block_in_words(block, parts[block]) for block in named]
    if "point" in leading and "point" not in named:
        words.append("motion of the target")
    return " with ".join([words[0], " and ".join(words[1:3])] if words[1:] else words)


def _block_in_words(block: str, part: np.ndarray) -> str:
    row, unit = TABLE[block], part / np.linalg.norm(part)
    largest = int(np.argmax(np.abs(unit)))
    if abs(unit[largest]) > 0.9:
        return row.words.format(row.axes[largest])
    # Rounded before it is formatted, and without the sign of a zero.
    unit = np.round(unit * np.sign(unit[largest]), 2) + 0.0
    return row.oblique.format(*unit)


def observability(result: Calibration) -> dict[str, float | str | None]:
    """The least known direction, and the direction known only from the prior, as plain values.

    Raises:
        InputError: of a batch.
    """
    check_one(result.status_code)
    from_prior = None
    if np.any(result.prior_direction != 0):
        from_prior = direction_in_words(result.prior_direction, result.blocks)
    return {
        "condition": plain(result.condition),
        "weakest_direction": direction_in_words(result.weakest, result.blocks),
        "weakest_sd_mm": plain(result.weakest_sd),
        "known_only_from_prior": from_prior,
        "advice": poses_to_add(result),
    }


def poses_to_add(result: Calibration) -> str:
    """Which further images would tell most about the weakest direction, in words.

    Of points, a delay is a shift of X along the axial axis, whatever the poses.
    """
    weakest = np.asarray(result.weakest, float)
    if result.data == "points" and "delay" in result.blocks:
        delay = weakest[block_slice(result.blocks, "delay")]
        if np.linalg.norm(delay) > _LEADING * np.linalg.norm(weakest):
            return (
                "leave the delay out: of points, it only shifts the transform along the axial axis"
            )
    gain = np.nan_to_num(np.asarray(result.inspection.gain, dtype=float))
    if not gain.max() > 0:
        return "add images with the probe tilted about each of its axes"
    worth = dict(zip(ADDITIONS, gain >= WORTH * gain.max(), strict=True))
    tilts = [name for name in TABLE["rotation"].axes if worth[f"tilt {name}"]]
    parts = []
    if tilts:
        axes = f"{enumerated(tilts)} {'axes' if tilts[1:] else 'axis'}"
        parts.append(f"poses tilted by 20 to 30 degrees about the {axes}")
    if worth["depth"]:
        parts.append("images with the target nearer and farther")
    if worth["sideways"]:
        parts.append("images with the target farther to both sides")
    return "add " + ", and ".join(parts)
