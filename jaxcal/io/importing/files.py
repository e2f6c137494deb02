"""Recordings from other programs' files: poses from one, points from another, or from pixels.

A sequence (:mod:`jaxcal.io.sequence`) has the poses and perhaps the frames. The target's position
in the frames comes from a table, from points placed in Slicer, or from segmenting the frames.
Frames whose tracking was not OK are left out and counted, as are those without a point. Notes say
in words what was assumed.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

from jaxcal.io.importing.imported import Imported
from jaxcal.io.importing.sequences import from_sequence
from jaxcal.io.importing.sources import SEQUENCES, ImportOptions, kind_of
from jaxcal.io.importing.tables import from_tables


def import_files(
    sources: Sequence[str | os.PathLike[str]], options: ImportOptions | None = None
) -> Imported:
    """Make a recording from other programs' files.

    Args:
        sources: one of: a table with poses and points; a sequence, a folder of PNG or a tracker's
            export with points (a table or Slicer's markups); a sequence or folder with frames,
            which are segmented; the cross-wire pair POSES POINTS.
        options: what is asked for.

    Returns:
        The recording, with notes, and with results for every frame if frames were segmented.

    Raises:
        InputError: files that cannot be read or do not belong together; one line that names the
            file, and where possible the line.
    """
    options = options or ImportOptions()
    kinds = [kind_of(source) for source in sources]
    tracked = [source for source, kind in zip(sources, kinds, strict=True) if kind in SEQUENCES]
    if tracked:
        return from_sequence(sources, tracked, options)
    return from_tables(sources, options)
