"""PLUS: device-set configurations, read and patched, and results of fCal.

PLUS's ``Image`` frame is in pixels: origin at the first pixel, x along the rows towards the marked
side, y along the columns away from the transducer, z = x cross y, which is *minus* jaxcal's
elevational axis. Its ImageToProbe carries the pixel size in its columns.

Source: PlusLib, vtkPlusConfig and IGSIO's vtkIGSIOTransformRepository.
"""

from __future__ import annotations

import datetime
import math
import os
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

import numpy as np

from jaxcal import FormatError
from jaxcal.data.poses import check_affine
from jaxcal.io.atomic import atomic_path
from jaxcal.io.frame_names import FramePair, capitalised, check_frames, path_between, split_name
from jaxcal.io.readable import naming
from jaxcal.io.xml import Element, parse_xml, read_xml
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import quoted

_ROOT = "PlusConfiguration"
_COORDINATES = "CoordinateDefinitions"

PIXELS_AGREE = 2e-3
"""Relative tolerance: fCal's own two statements of the pixel size differ by up to 7e-4."""


@dataclass(frozen=True)
class PlusTransform:
    """One ``<Transform>``.

    Attributes:
        frames: (from, to), capitalised.
        matrix: (4, 4), mm, or mm per px where it begins in Image.
        error_mm: as stated, or None.
        date: as stated, or None.
        line: where it stands.
        status: ``OK``, or the status that the file states instead.
    """

    frames: FramePair
    matrix: Float[np.ndarray, "4 4"]
    error_mm: float | None
    date: str | None
    line: int
    status: str = "OK"


@dataclass(frozen=True)
class PlusConfiguration:
    """What calibration needs of a device-set configuration.

    Attributes:
        transforms: of CoordinateDefinitions, in their order.
    """

    transforms: tuple[PlusTransform, ...]

    def find(self, source: str, target: str) -> PlusTransform | None:
        """The transform between two frames as it is stated, or None.

        Raises:
            FormatError: it is marked as not valid.
        """
        return _find(self.transforms, source, target)


@dataclass(frozen=True)
class PlusResult:
    """An fCal result (``ProbeCalibrationResult`` 2.0).

    Attributes:
        transforms: ``ImageToProbe`` and others, by their frames.
        calibration_error_mm: mean of the lowest 95 % of the calibration's errors, by PLUS.
    """

    transforms: tuple[PlusTransform, ...]
    calibration_error_mm: float | None

    def find(self, source: str, target: str) -> PlusTransform | None:
        """The transform between two frames, or None.

        Raises:
            FormatError: it is marked as not valid.
        """
        return _find(self.transforms, source, target)


def _find(transforms: tuple[PlusTransform, ...], source: str, target: str) -> PlusTransform | None:
    wanted = capitalised(source), capitalised(target)
    found = next((each for each in transforms if each.frames == wanted), None)
    if found is not None and found.status != "OK":
        raise FormatError(
            f"line {found.line}: the transform from {wanted[0]} to {wanted[1]} is marked as "
            f"{quoted(found.status)}: calibrate again, or mark it as OK if it is right"
        )
    return found


def read_configuration(path: str | os.PathLike[str]) -> PlusConfiguration:
    """Read a device-set configuration, or a Transform element alone; the file is not trusted.

    Raises:
        FormatError: not such a file, a DTD, a transform that is not 16 finite numbers; one line
            with path and line.
    """
    root, _ = read_xml(path)
    with naming(path):
        if root.tag == "Transform":
            return PlusConfiguration((_transform(root),))
        if root.tag != _ROOT:
            raise FormatError(f"is not a configuration of PLUS: its root is {quoted(root.tag)}")
        return PlusConfiguration(
            tuple(
                _transform(element)
                for place in root.all(_COORDINATES)
                for element in _transforms(place)
            ),
        )


def read_result(path: str | os.PathLike[str]) -> PlusResult:
    """Read a result of fCal; the file is not trusted.

    Raises:
        FormatError: not such a file or not as it should be; one line with path and line.
    """
    root, _ = read_xml(path)
    with naming(path):
        if root.tag != "ProbeCalibrationResult":
            raise FormatError(f"is not a result of fCal: its root is {quoted(root.tag)}")
        errors = root.first("ErrorReport/ReprojectionError3DStatistics")
        return PlusResult(
            tuple(_transform(element) for element in root.all("CalibrationResults/Transform")),
            _optional_number(errors, "CalibrationMeanMm"),
        )


def _transforms(coordinates: Element) -> list[Element]:
    """Its transforms; PLUS compares their tag without regard to case."""
    return [element for element in coordinates.children if element.tag.lower() == "transform"]


def _transform(element: Element) -> PlusTransform:
    matrix = _numbers(element, "Matrix", 16).reshape(4, 4)
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise FormatError(f"line {element.line}: the matrix's last row is not 0 0 0 1")
    return PlusTransform(
        _frames(element),
        matrix,
        _optional_number(element, "Error"),
        element.attributes.get("Date"),
        element.line,
        _status(element),
    )


def _status(element: Element) -> str:
    """PLUS reads ``Status``, and writes the same as ``Valid``."""
    stated = (
        element.attributes[name] for name in ("Status", "Valid") if name in element.attributes
    )
    return next((text for text in stated if text.upper() not in ("OK", "TRUE")), "OK")


def _frames(element: Element) -> FramePair:
    return capitalised(_attribute(element, "From")), capitalised(_attribute(element, "To"))


def _attribute(element: Element, name: str) -> str:
    if name not in element.attributes:
        raise FormatError(f"line {element.line}: <{element.tag}> has no {name}")
    return element.attributes[name]


def _numbers(element: Element, name: str, count: int) -> Float[np.ndarray, " count"]:
    text = _attribute(element, name)
    try:
        numbers = [float(part) for part in text.split()]
    except ValueError:
        raise FormatError(
            f"line {element.line}: {name} of <{element.tag}> is not numbers: {quoted(text)}"
        ) from None
    if len(numbers) != count:
        raise FormatError(
            f"line {element.line}: {name} of <{element.tag}> has {len(numbers)} numbers, {count} "
            "are needed"
        )
    if not all(map(math.isfinite, numbers)):
        raise FormatError(f"line {element.line}: {name} of <{element.tag}> holds NaN or Inf")
    return np.array(numbers)


def _optional_number(element: Element | None, name: str) -> float | None:
    if element is None or name not in element.attributes:
        return None
    return float(_numbers(element, name, 1)[0])


# What is written.


def transform_element(
    frames: FramePair,
    matrix: Float[np.ndarray, "4 4"],
    *,
    error_mm: float | None = None,
    date: datetime.datetime | None = None,
    others: dict[str, str] | None = None,
    indent: str = "",
    newline: str = "\n",
) -> str:
    """A ``<Transform>`` to paste into CoordinateDefinitions, with every digit.

    Args:
        frames: (from, to).
        matrix: finite, last row 0 0 0 1.
        error_mm: stated where it is positive.
        date: stated in PLUS's form.
        others: further attributes.
        indent: in front of every line but the first.
        newline: of the file.

    Raises:
        InputError: a matrix or names that PLUS would not accept.
    """
    matrix = check_affine(matrix)
    source, target = check_frames(frames)
    # Minus zero would be written as -0.0.
    rows = [" ".join(repr(value + 0.0) for value in row) for row in matrix.tolist()]
    lines = [f'<Transform From="{source}" To="{target}"', f'  Matrix="{rows[0]}']
    lines += [f"          {row}" for row in rows[1:]]
    lines[-1] += '"'
    stated = dict(others or {})
    if error_mm is not None and error_mm > 0:
        stated["Error"] = f"{error_mm:.6g}"
    if date is not None:
        stated["Date"] = date.strftime("%Y.%m.%d %X")
    tail = "".join(f" {key}={quoteattr(value)}" for key, value in stated.items())
    if tail:
        lines.append(f" {tail}")
    lines[-1] += " />"
    return (newline + indent).join(lines)


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
    both). If there is none, the transform is added at the end of CoordinateDefinitions.

    Args:
        content: of the configuration's file.
        frames: (from, to).
        matrix: of the transform.
        error_mm: stated where it is positive.
        date: stated in PLUS's form.

    Returns:
        The new content, and notes for the user, with lines of the new content.

    Raises:
        FormatError: not a configuration, or a new one that PLUS would refuse: several transforms
            between the frames, or another path from one to the other.
        InputError: a matrix or names that cannot be written.
    """
    wanted = capitalised(frames[0]), capitalised(frames[1])
    new = _replaced(content, wanted, matrix, error_mm, date)
    # The notes name lines of the new content, which is what their reader opens.
    root = parse_xml(new)
    others = [
        element
        for place in root.all(_COORDINATES)
        for element in _transforms(place)
        if set(_frames(element)) != set(wanted)
    ]
    return new, _stale_scale(others, wanted, matrix) + _other_sources(root, others, wanted)


def _replaced(
    content: bytes,
    wanted: FramePair,
    matrix: Float[np.ndarray, "4 4"],
    error_mm: float | None,
    date: datetime.datetime | None,
) -> bytes:
    """The content of :func:`patched_configuration`."""
    root = parse_xml(content)
    if root.tag != _ROOT:
        raise FormatError(f"is not a configuration of PLUS: its root is {quoted(root.tag)}")
    places = list(root.all(_COORDINATES))
    if len(places) > 1:
        raise FormatError(
            f"lines {places[0].line} and {places[1].line}: two {_COORDINATES}; PLUS reads one: put "
            "the transforms together"
        )
    elements = [] if not places else _transforms(places[0])
    between = [element for element in elements if set(_frames(element)) == set(wanted)]
    if len(between) > 1:
        lines = " and ".join(str(element.line) for element in between)
        raise FormatError(
            f"lines {lines}: {len(between)} transforms between {wanted[0]} and {wanted[1]}; PLUS "
            "takes one: remove the others"
        )
    _check_other_paths([element for element in elements if element not in between], wanted)
    newline = "\r\n" if b"\r\n" in content else "\n"
    stated = {"error_mm": error_mm, "date": date, "newline": newline}
    if between:
        old = between[0]
        others = {
            key: value
            for key, value in old.attributes.items()
            if key not in ("From", "To", "Matrix", "Error", "Date", "Valid", "Status")
        }
        indent = _indent(content, old.start)
        text = transform_element(wanted, matrix, others=others, indent=indent, **stated)
        return content[: old.start] + _ascii(text) + content[old.end :]
    parent = places[0] if places else root
    if parent.content_end == parent.end and not places:
        raise FormatError(f"line {parent.line}: <{parent.tag}/> is empty: there is no device in it")
    if parent.content_end == parent.end:
        # <CoordinateDefinitions/>: it gets an end tag.
        outer = _indent(content, parent.start)
        inner = outer + "  "
        text = transform_element(wanted, matrix, indent=inner, **stated)
        opened = content[parent.start : parent.end].removesuffix(b"/>").rstrip() + b">"
        text = f"{newline}{inner}{text}{newline}{outer}</{_COORDINATES}>"
        return content[: parent.start] + opened + _ascii(text) + content[parent.end :]
    outer = _indent(content, parent.content_end)
    inner = outer + "  "
    if places:
        text = transform_element(wanted, matrix, indent=inner, **stated)
        text = f"  {text}{newline}{outer}"
    else:
        deeper = inner + "  "
        text = transform_element(wanted, matrix, indent=deeper, **stated)
        parts = (f"  <{_COORDINATES}>", f"{deeper}{text}", f"{inner}</{_COORDINATES}>", outer)
        text = newline.join(parts)
    at = parent.content_end
    return content[:at] + _ascii(text) + content[at:]


def patch_configuration(
    path: str | os.PathLike[str],
    frames: FramePair,
    matrix: Float[np.ndarray, "4 4"],
    *,
    out: str | os.PathLike[str] | None = None,
    error_mm: float | None = None,
    date: datetime.datetime | None = None,
) -> list[str]:
    """:func:`patched_configuration` of a file, which is replaced in one step, or not at all.

    Args:
        path: the configuration.
        frames: (from, to).
        matrix: of the transform.
        out: where to write instead of in place.
        error_mm: stated where it is positive.
        date: stated in PLUS's form.

    Returns:
        Notes for the user.

    Raises:
        FormatError: see :func:`patched_configuration`; one line that starts with the path.
        OutputError: the file could not be written; it is as it was.
    """
    _, content = read_xml(path)
    with naming(path):
        new, notes = patched_configuration(content, frames, matrix, error_mm=error_mm, date=date)
    with atomic_path(path if out is None else out) as temporary:
        temporary.write_bytes(new)
    return notes


def _ascii(text: str) -> bytes:
    """An element for a file of any encoding: characters beyond ASCII are written by number."""
    return text.encode("ascii", "xmlcharrefreplace")


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
            "path"
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
            kept = np.linalg.norm(_transform(element).matrix[:3, :2], axis=0)
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
        if _frames(element) in ((wanted[0], "Reference"), (wanted[0], "Tracker")):
            notes.append(
                f"line {element.line}: {wanted[0]} to {_frames(element)[1]} is a second path from "
                f"{wanted[0]} as soon as the tracker sends {wanted[1]}: take it out then"
            )
    return notes


def update_transform_command(
    frames: FramePair,
    matrix: Float[np.ndarray, "4 4"],
    *,
    error_mm: float | None = None,
    date: datetime.datetime | None = None,
) -> str:
    """PlusServer's command that sets a transform while it runs, as XML.

    Source: PlusLib, vtkPlusUpdateTransformCommand.
    """
    source, target = check_frames(frames)
    numbers = " ".join(repr(value) for value in np.asarray(matrix, float).ravel().tolist())
    stated = "" if not error_mm else f' TransformError="{error_mm:.6g}"'
    if date is not None:
        stated += f' TransformDate="{date.strftime("%Y.%m.%d %X")}"'
    return (
        f'<Command Name="UpdateTransform" TransformName="{source}To{target}" '
        f'TransformValue="{numbers}" TransformPersistent="TRUE"{stated}/>'
    )
