"""Search for the target in the frames of a sequence, and what became of every frame.

One frame is in memory at a time. A frame counts as ``found``; as ``not credible`` if no credible
target was found in it (the reasons are those of :mod:`jaxcal.data.segmentation.image`); as
``not tracked`` if a transform's status was not OK; as ``image not OK`` if the file marks its pixels
so; as ``not selected`` if other frames were asked for.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jaxcal import InputError
from jaxcal.io.given_files import naming
from jaxcal.io.sequence import TrackedSequence
from jaxcal.runtime.array_types import Bool, Float, Int
from jaxcal.runtime.messages import command_line

if TYPE_CHECKING:
    from jaxcal.io.importing.sources import ImportOptions

FATES = ("found", "not credible", "not tracked", "image not OK", "not selected")
FOUND, NOT_CREDIBLE, NOT_TRACKED, IMAGE_NOT_OK, NOT_SELECTED = range(5)


@dataclass(frozen=True)
class FrameResults:
    """What became of each of n frames.

    Attributes:
        target: what was looked for, ``echo`` or ``cross``.
        fate: (n,) index into :data:`FATES`.
        reason: n texts: why no target was credible; empty elsewhere.
        position: (n, 2) [u, v], px; NaN where not found.
        covariance: (n, 2, 2), px^2; NaN where not found.
        contrast_db: (n,) the target's envelope over the background, dB; NaN where not measured.
        margin_db: (n,) the target's envelope over the next brightest place, dB; NaN likewise.
        width: (n, 2) SDs of the target's spot along u and v, px; NaN where not found.
        files: names of the images of a folder; empty for a sequence.
    """

    target: str
    fate: Int[np.ndarray, " n"]
    reason: tuple[str, ...]
    position: Float[np.ndarray, "n 2"]
    covariance: Float[np.ndarray, "n 2 2"]
    contrast_db: Float[np.ndarray, " n"]
    margin_db: Float[np.ndarray, " n"]
    width: Float[np.ndarray, "n 2"]
    files: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.fate)

    @property
    def asked(self) -> int:
        """Number of frames that were asked for."""
        return int((self.fate != NOT_SELECTED).sum())

    @property
    def found(self) -> Int[np.ndarray, " m"]:
        """Numbers of the frames in which the target was found."""
        return np.flatnonzero(self.fate == FOUND)

    def of_tracked(self, tracked: Bool[np.ndarray, " n"]) -> FrameResults:
        """The results where only these frames can be used."""
        fate = np.where(tracked | (self.fate == NOT_SELECTED), self.fate, NOT_TRACKED)
        reason = tuple(why if kept else "" for why, kept in zip(self.reason, tracked, strict=True))
        return replace(self, fate=fate, reason=reason)

    @property
    def counts(self) -> dict[str, int]:
        """Number of frames by fate."""
        return {name: int((self.fate == number).sum()) for number, name in enumerate(FATES)}

    @property
    def reasons(self) -> dict[str, int]:
        """Number of frames by the reason for which no target was credible, the commonest first."""
        short = (
            self.reason[k].partition(":")[0] for k in np.flatnonzero(self.fate == NOT_CREDIBLE)
        )
        return dict(Counter(short).most_common())


def search_target(
    sequence: TrackedSequence,
    tracked: Bool[np.ndarray, " n"],
    selected: Bool[np.ndarray, " n"],
    options: ImportOptions,
) -> FrameResults:
    """Look for the target in every selected frame that was tracked.

    Raises:
        FormatError: pixels that cannot be read.
        InputError: no pixels, or a region that leaves the frames.
    """
    from jaxcal.data.segmentation.image import localise

    if sequence.pixels is None:
        raise InputError(
            f"{sequence.source}: holds no pixels: import it with a file of the target's points "
            f"({command_line(['jaxcal', 'import', sequence.source, 'POINTS.csv', 'OUT.h5'])})"
        )
    count, target = len(sequence), options.target_kind or "echo"
    fate = np.where(
        tracked, np.where(sequence.image_valid, NOT_CREDIBLE, IMAGE_NOT_OK), NOT_TRACKED
    )
    fate[~selected] = NOT_SELECTED
    reason = [""] * count
    shapes = {"position": (2,), "covariance": (2, 2), "width": (2,)}
    shapes |= {"contrast_db": (), "margin_db": ()}
    measured = {name: np.full((count, *shape), np.nan) for name, shape in shapes.items()}
    rows = np.flatnonzero(fate == NOT_CREDIBLE)
    frames = sequence.images(rows, orientation=options.orientation)
    for row, frame in zip(rows, frames, strict=True):
        with naming(f"{sequence.source}: {sequence.frame_name(int(row))}"):
            located = localise(frame, target, region=options.region)
        reason[row] = located.reason[0]
        if located.found[0]:
            fate[row] = FOUND
        for name, values in measured.items():
            values[row] = getattr(located, name)[0]
    return FrameResults(target, fate, tuple(reason), files=sequence.files, **measured)
