"""PLUS: device-set configurations, read and patched, and results of fCal.

PLUS's ``Image`` frame is in pixels: origin at the first pixel, x along the rows towards the marked
side, y along the columns away from the transducer, z = x cross y, which is *minus* jaxcal's
elevational axis. Its ImageToProbe carries the pixel size in its columns.

Source: PlusLib, vtkPlusConfig and IGSIO's vtkIGSIOTransformRepository.
"""

from __future__ import annotations

import datetime
import os
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from jaxcal import FormatError
from jaxcal.data.poses import check_affine
from jaxcal.io.atomic import write_bytes
from jaxcal.io.frame_names import FramePair, capitalised, check_frames, path_between, split_name
from jaxcal.io.given_files import naming
from jaxcal.io.table import finite_numbers
from jaxcal.io.xml import Element, parse_xml, read_xml
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import quoted

_ROOT = "PlusConfiguration"
_COORDINATES = "CoordinateDefinitions"

PIXELS_AGREE = 2e-3
"""Relative tolerance: fCal's own two statements of the pixel size differ by up to 7e-4."""


class PlusTransform(NamedTuple):
    """A transform as a file states it: mm, or mm per px where it begins in Image.

    ``error_mm`` is what an fCal result states for the calibration as a whole (mean of the lowest
    95 % of its errors), and what a configuration states beside the transform; None without.
    ``target`` is the frame to which it leads.
    """

    matrix: Float[np.ndarray, "4 4"]
    error_mm: float | None
    target: str


def read_transform(
    path: str | os.PathLike[str], source: str = "Image", target: str | None = None
) -> PlusTransform:
    """Read the transform between two frames; the file is not trusted.

    It is a configuration, an fCal result, or a Transform element alone. As in PLUS, transforms may
    be inverted and chained. If no target is named, it is ``Probe``, or the only frame of another
    name to which a transform leads from the source (the transducer's own frames do not count).

    Raises:
        FormatError: not such a file, a DTD, a transform that is not 16 finite numbers, no such
            transform, several between the same frames, or one that is marked as not valid; one line
            with path and line.
    """
    root, _ = read_xml(path)
    wanted = capitalised(source), capitalised(target or "Probe")
    with naming(path):
        of_result = root.tag == "ProbeCalibrationResult"
        if of_result:
            elements = list(root.all("CalibrationResults/Transform"))
        elif root.tag == "Transform":
            elements = [root]
        else:
            _check_root(root)
            elements = _transforms(root)
        # All are looked at: a file with a damaged transform is not to be trusted.
        stated = [(_matrix(e), _frames(e), _stated_error(e, "Error")) for e in elements]
        pairs = [frames for _, frames, _ in stated]
        ends = {to for start, to in pairs if start == wanted[0]}
        ends = {to for to in ends if not to.startswith("TransducerOrigin")}
        if target is None and path_between(pairs, *wanted) is None and len(ends) == 1:
            wanted = wanted[0], *ends
        way = path_between(pairs, *wanted)
        if not way:
            raise FormatError(f"holds no transform from {' to '.join(wanted)}")
        total, error_mm = np.eye(4), None
        for index, inverted in way:
            _between(elements, pairs[index])
            _check_status(elements[index])
            matrix, _, error_mm = stated[index]
            total = (np.linalg.inv(check_affine(matrix)) if inverted else matrix) @ total
        if of_result:
            errors = root.all("ErrorReport/ReprojectionError3DStatistics")
            error_mm = _stated_error(next(errors, None), "CalibrationMeanMm")
        return PlusTransform(total, error_mm if len(way) == 1 else None, wanted[1])


def _check_root(root: Element) -> None:
    if root.tag != _ROOT:
        raise FormatError(f"is not a configuration of PLUS: its root is {quoted(root.tag)}")


def _transforms(root: Element) -> list[Element]:
    """A configuration's transforms; PLUS compares their tag without regard to case."""
    each = (element for place in root.all(_COORDINATES) for element in place.children)
    return [element for element in each if element.tag.lower() == "transform"]


def _between(elements: list[Element], frames: FramePair) -> list[Element]:
    """The transform between two frames, in either direction; PLUS takes no second one."""
    between = [element for element in elements if set(_frames(element)) == set(frames)]
    if len(between) > 1:
        lines = " and ".join(str(element.line) for element in between)
        raise FormatError(
            f"lines {lines}: {len(between)} transforms between {frames[0]} and {frames[1]}; PLUS "
            "takes one: remove the others"
        )
    return between


def _matrix(element: Element) -> Float[np.ndarray, "4 4"]:
    matrix = _numbers(element, "Matrix", 16).reshape(4, 4)
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise FormatError(f"line {element.line}: the matrix's last row is not 0 0 0 1")
    return matrix


def _check_status(element: Element) -> None:
    """Refuse a transform that is not valid; PLUS reads ``Status``, and writes ``Valid``."""
    for name in ("Status", "Valid"):
        stated = element.attributes.get(name, "OK")
        if stated.upper() not in ("OK", "TRUE"):
            source, target = _frames(element)
            raise FormatError(
                f"line {element.line}: the transform from {source} to {target} is marked as "
                f"{quoted(stated)}: calibrate again, or mark it as OK if it is right"
            )


def _frames(element: Element) -> FramePair:
    return capitalised(_attribute(element, "From")), capitalised(_attribute(element, "To"))


def _attribute(element: Element, name: str) -> str:
    if name not in element.attributes:
        raise FormatError(f"line {element.line}: <{element.tag}> has no {name}")
    return element.attributes[name]


def _numbers(element: Element, name: str, count: int) -> Float[np.ndarray, " count"]:
    what = f"line {element.line}: {name} of <{element.tag}>"
    return finite_numbers(_attribute(element, name), count, what)


def _stated_error(element: Element | None, name: str) -> float | None:
    """An error, mm; None where there is none, or a negative number in its place."""
    if element is None or name not in element.attributes:
        return None
    error = float(_numbers(element, name, 1)[0])
    return error if error >= 0 else None


# What is written.


def transform_element(
    frames: FramePair,
    matrix: Float[np.ndarray, "4 4"],
    *,
    error_mm: float | None = None,
    date: datetime.datetime | None = None,
    others: dict[str, str] | None = None,
    newline: str = "\n",
) -> str:
    """A ``<Transform>`` to paste into CoordinateDefinitions, with every digit.

    Args:
        frames: (from, to).
        matrix: finite, last row 0 0 0 1.
        error_mm: stated where it is positive.
        date: stated in PLUS's form.
        others: further attributes.
        newline: between the lines, with the indentation of all but the first.

    Raises:
        InputError: a matrix or names that PLUS would not accept.
    """
    matrix = check_affine(matrix)
    source, target = check_frames(frames)
    # Minus zero would be written as -0.0.
    rows = [" ".join(repr(value + 0.0) for value in row) for row in matrix.tolist()]
    first, *further, last = rows
    lines = [f'<Transform From="{source}" To="{target}"', f'  Matrix="{first}']
    lines += [f"          {row}" for row in [*further, f'{last}"']]
    stated = dict(others or {})
    if error_mm is not None and error_mm > 0:
        stated["Error"] = f"{error_mm:.6g}"
    if date is not None:
        stated["Date"] = date.strftime("%Y.%m.%d %X")
    if stated:
        lines.append(" " + "".join(f" {key}={quoteattr(text)}" for key, text in stated.items()))
    return newline.join(lines) + " />"


def patched_configuration(
    content: bytes,
    frames: FramePair,
    matrix: Float[np.ndarray, "4 4"],
    *,
    error_mm: float | None = None,
    date: datetime.datetime | None = None,
) -> tuple[bytes, list[str]]:
    """A configuration with one transform replaced; every other byte stays as it is.

    The element between the two frames, in either direction, is replaced (PLUS refuses a file with
    both). If there is none, the transform is added at the end of CoordinateDefinitions. The
    arguments are those of :func:`transform_element`.

    Returns:
        The new content, and notes for the user, with lines of the new content.

    Raises:
        FormatError: not a configuration, or a new one that PLUS would refuse: several transforms
            between the frames, or another path from one to the other.
        InputError: a matrix or names that cannot be written.
    """
    wanted = check_frames(frames)
    new = _replaced(content, wanted, matrix, error_mm, date)
    # The notes name lines of the new content, which is what their reader opens.
    root = parse_xml(new)
    others = [each for each in _transforms(root) if set(_frames(each)) != set(wanted)]
    notes = _stale_scale(others, wanted, matrix) + _other_sources(root, others, wanted)
    added = not _between(_transforms(parse_xml(content)), wanted)
    return new, notes + (_other_names(root, others, wanted) if added else [])


def _replaced(
    content: bytes,
    wanted: FramePair,
    matrix: Float[np.ndarray, "4 4"],
    error_mm: float | None,
    date: datetime.datetime | None,
) -> bytes:
    """The content of :func:`patched_configuration`."""
    root = parse_xml(content)
    _check_root(root)
    places = list(root.all(_COORDINATES))
    if len(places) > 1:
        raise FormatError(
            f"lines {places[0].line} and {places[1].line}: two {_COORDINATES}; PLUS reads one: put "
            "the transforms together"
        )
    elements = _transforms(root)
    between = _between(elements, wanted)
    _check_other_paths([element for element in elements if element not in between], wanted)
    newline = "\r\n" if b"\r\n" in content else "\n"

    def element(indent: str, others: dict[str, str] | None = None) -> str:
        return transform_element(
            wanted, matrix, error_mm=error_mm, date=date, others=others, newline=newline + indent
        )

    def put(start: int, text: str, end: int) -> bytes:
        # For a file of any encoding, characters beyond ASCII are written by number.
        return content[:start] + text.encode("ascii", "xmlcharrefreplace") + content[end:]

    if between:
        old = between[0]
        ours = ("From", "To", "Matrix", "Error", "Date", "Valid", "Status")
        others = {key: value for key, value in old.attributes.items() if key not in ours}
        return put(old.start, element(_indent(content, old.start), others), old.end)
    parent = places[0] if places else root
    closed = parent.content_end == parent.end  # <CoordinateDefinitions/> has no end tag
    if closed and not places:
        raise FormatError(f"line {parent.line}: <{parent.tag}/> is empty: there is no device in it")
    outer = _indent(content, parent.start if closed else parent.content_end)
    inner = outer + "  "
    if closed:
        start = parent.start + len(content[parent.start : parent.end].removesuffix(b"/>").rstrip())
        text = f">{newline}{inner}{element(inner)}{newline}{outer}</{_COORDINATES}>"
        return put(start, text, parent.end)
    if places:
        parts = [f"  {element(inner)}", outer]
    else:
        deeper = inner + "  "
        parts = [
            f"  <{_COORDINATES}>",
            deeper + element(deeper),
            f"{inner}</{_COORDINATES}>",
            outer,
        ]
    return put(parent.content_end, newline.join(parts), parent.content_end)


def patch_configuration(
    path: str | os.PathLike[str],
    frames: FramePair,
    matrix: Float[np.ndarray, "4 4"],
    *,
    out: str | os.PathLike[str] | None = None,
    error_mm: float | None = None,
    date: datetime.datetime | None = None,
) -> list[str]:
    """:func:`patched_configuration` of a file, in place or into ``out``; returns its notes.

    Raises:
        FormatError: see :func:`patched_configuration`; one line that starts with the path.
        OutputError: the file could not be written; it is as it was.
    """
    _, content = read_xml(path)
    with naming(path):
        new, notes = patched_configuration(content, frames, matrix, error_mm=error_mm, date=date)
    write_bytes(path if out is None else out, new)
    return notes


def _check_other_paths(others: list[Element], wanted: FramePair) -> None:
    pairs = [_frames(element) for element in others]
    way = path_between(pairs, *wanted)
    if way is not None:
        steps = ", ".join(
            f"{pairs[index][0]} to {pairs[index][1]} (line {others[index].line})"
            for index, _ in way
        )
        raise FormatError(
            f"{wanted[0]} and {wanted[1]} are connected already, by {steps}; PLUS refuses a second "
            "path: take one of these out"
        )


def _indent(content: bytes, position: int) -> str:
    line = content[content.rfind(b"\n", 0, position) + 1 : position]
    return "" if line.strip() else line.decode("ascii", "replace")


def _stale_scale(
    elements: list[Element], wanted: FramePair, matrix: Float[np.ndarray, "4 4"]
) -> list[str]:
    """A note if PLUS's second statement of the pixel size, for the transducer, differs."""
    if wanted[0] != "Image":
        return []
    scale = np.linalg.norm(np.asarray(matrix)[:3, :2], axis=0)
    for element in elements:
        if _frames(element) == ("TransducerOriginPixel", "TransducerOrigin"):
            kept = np.linalg.norm(_matrix(element)[:3, :2], axis=0)
            if np.abs(kept / scale - 1).max() > PIXELS_AGREE:
                return [
                    f"line {element.line}: TransducerOriginPixel to TransducerOrigin still has "
                    f"pixels of {kept[0]:.6g} x {kept[1]:.6g} mm, the new transform "
                    f"{scale[0]:.6g} x {scale[1]:.6g} mm: change it as well"
                ]
    return []


def _other_sources(root: Element, others: list[Element], wanted: FramePair) -> list[str]:
    """Notes on transforms of the first frame that PLUS gets only while it runs, and that conflict.

    Source: PlusLib, vtkPlusUsDevice; IGSIO, vtkIGSIOTransformRepository::SetTransform.
    """
    notes = []
    pairs = [_frames(element) for element in others]
    for device in root.all("DataCollection/Device"):
        name = device.attributes.get("ImageToTransducerTransformName", "")
        sent = split_name(name)
        if sent is None or sent[0] != wanted[0]:
            continue
        if sent == wanted:
            what = f"overwrites this {wanted[0]} to {wanted[1]}"
        elif path_between(pairs, sent[1], wanted[1]) is not None:
            what = f"is a second path from {wanted[0]}, which PLUS refuses with every frame"
        else:
            continue
        notes.append(
            f"line {device.line}: while it runs, the device sends {name} by itself, which {what}: "
            "take ImageToTransducerTransformName out, or give it another name"
        )
    for element in others:
        source, target = _frames(element)
        if source != wanted[0] or target.startswith("Transducer"):
            continue
        # Any other frame is tracked as the new one is: the probe under its old name, or another.
        when = f"the tracker sends {wanted[1]}"
        if target not in ("Reference", "Tracker"):
            when += f" and {target}"
        notes.append(
            f"line {element.line}: {source} to {target} is a second path from {source} as soon as "
            f"{when}: take it out then"
        )
    return notes


def _other_names(root: Element, others: list[Element], wanted: FramePair) -> list[str]:
    """Notes where image or probe seem to have other names than those of an added transform."""
    notes, name = [], "(jaxcal export --image-frame, --probe-frame)"
    for element in others:
        source, target = _frames(element)
        if source.startswith("Image") and source != wanted[0]:
            notes.append(
                f"line {element.line}: {source} to {target} is kept, and {' to '.join(wanted)} "
                f"added beside it: if it should have been replaced, name these frames {name}"
            )
    sources = root.all("DataCollection/Device/DataSources/DataSource")
    known = {frame for element in others for frame in _frames(element)}
    tools = [each for each in sources if each.attributes.get("Type", "").lower() == "tool"]
    sent = [capitalised(each.attributes.get("Id", "")) for each in tools]
    if sent and wanted[1] not in (*sent, *known):
        notes.append(
            f"no tool is called {wanted[1]}, there are {', '.join(map(quoted, sent))}: name the "
            f"one on the probe {name}"
        )
    return notes


def update_transform_command(
    frames: FramePair, matrix: Float[np.ndarray, "4 4"], *, error_mm: float | None = None
) -> str:
    """PlusServer's command that sets a transform while it runs, as XML.

    Source: PlusLib, vtkPlusUpdateTransformCommand.
    """
    source, target = check_frames(frames)
    numbers = " ".join(repr(value) for value in np.asarray(matrix, float).ravel().tolist())
    stated = "" if not error_mm else f' TransformError="{error_mm:.6g}"'
    return (
        f'<Command Name="UpdateTransform" TransformName="{source}To{target}" '
        f'TransformValue="{numbers}" TransformPersistent="TRUE"{stated}/>'
    )
