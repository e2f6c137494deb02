"""Names of coordinate frames as PLUS and Slicer write them: ``ProbeToTracker`` and the like."""

from __future__ import annotations

import re

from jaxcal import FormatError, InputError
from jaxcal.runtime.messages import quoted, shown

FramePair = tuple[str, str]
"""(from, to): the transform takes coordinates of the first frame to the second."""

_SEPARATOR = re.compile(r"(?<=.)To(?=[A-Z0-9_-])")


def split_name(name: str) -> FramePair | None:
    """The frames of ``<From>To<To>``, or None where the name has not exactly one "To"."""
    found = list(_SEPARATOR.finditer(name))
    if len(found) != 1:
        return None
    return capitalised(name[: found[0].start()]), capitalised(name[found[0].end() :])


def capitalised(name: str) -> str:
    """A frame's name with its first letter in upper case, as PLUS compares them."""
    return name[:1].upper() + name[1:]


def two_names(frames: object) -> FramePair:
    """The frames, if they are two texts; one text alone would give its letters.

    Raises:
        InputError: anything else.
    """
    if isinstance(frames, (tuple, list)) and len(frames) == 2:
        source, target = frames
        if isinstance(source, str) and isinstance(target, str):
            return source, target
    raise InputError(
        f'frames must be two names, ("Image", "Probe") for instance, not {shown(frames)}'
    )


def check_frames(frames: FramePair) -> FramePair:
    """Two different frames' names that PLUS and Slicer accept, capitalised.

    Raises:
        InputError: not two texts.
        FormatError: a name that is not letters, digits, _ and - after a first letter, or in which
            "To" stands at the end or before anything but a small letter: ``ProbeToTracker`` could
            not be split again; or one frame twice.
    """
    source, target = map(capitalised, two_names(frames))
    for name, capital in zip(frames, (source, target), strict=True):
        # PLUS joins the names, and counts a "To" at the beginning or the end, too.
        split = _SEPARATOR.search(f"X{capital}X")
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", name) or split:
            raise FormatError(
                f"{quoted(name)} cannot name a coordinate frame: letters, digits, _ and - are "
                'needed, without "To" at the end or before a capital letter'
            )
    if source == target:
        raise FormatError(
            f"a transform leads from one frame to another, not from {source} to {target}"
        )
    return source, target


def probe_name(named: str) -> str:
    """A recording's name of the probe's frame as it is written; Probe if PLUS refuses the name."""
    try:
        return check_frames(("Image", named))[1]
    except FormatError:
        return "Probe"


def path_between(pairs: list[FramePair], start: str, end: str) -> list[tuple[int, bool]] | None:
    """The shortest way from one frame to another along transforms and their inverses.

    Returns:
        (index of the pair, whether it is inverted) for each step; None where there is no way.
    """
    reached: dict[str, list[tuple[int, bool]]] = {start: []}
    pending = [start]
    while pending:
        frame = pending.pop(0)
        if frame == end:
            return reached[frame]
        for index, (source, target) in enumerate(pairs):
            for here, there, inverted in ((source, target, False), (target, source, True)):
                if here == frame and there not in reached:
                    reached[there] = [*reached[frame], (index, inverted)]
                    pending.append(there)
    return None
