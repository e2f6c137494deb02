"""Reading HDF5 that somebody else wrote: by name, inside the file, and never more than was agreed.

HDF5 lets a file point at other files (external links, external storage, virtual datasets), claim
sizes that it does not hold, and inflate to a thousand times its size. Everything here looks before
it reads, and reads only what is asked for by name (:func:`members` lists at most a stated number
of names). Messages name the object but not the file: the caller puts the file's name in front.
"""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5l, h5o, h5s, h5t, h5z  # pyright: ignore[reportAttributeAccessIssue]

from jaxcal import CalibrationError, FormatError
from jaxcal.io.given_files import one_line
from jaxcal.io.heap import CheckedFile
from jaxcal.runtime.messages import quoted

MAXIMUM_BYTES = 2**28
"""Largest array, and largest chunk of one, that is read: 256 MiB."""

_MAXIMUM_STEPS = 64
_MAXIMUM_TEXT = 1024
_MOST_ATTRIBUTES = 100
_FILTERS = (h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32)
# Inflating is at most 1032-fold: a chunk stored in 64 KiB cannot ask for more than 66 MiB.
_HARMLESS_CHUNK = 2**16


@dataclass(frozen=True)
class UpTo:
    """An axis of any length up to a limit, e.g. ``UpTo(4096, "elements")``."""

    limit: int
    name: str


@dataclass(frozen=True)
class Node:
    """A group or dataset and the name under which it was asked for ("" for the root)."""

    item: h5py.Group | h5py.Dataset
    name: str

    def __str__(self) -> str:
        return self.name or "/"


@contextmanager
def open_root(
    source: str | os.PathLike[str] | object, *, length: int | None = None
) -> Iterator[Node]:
    """Open a file for reading and give its root group.

    Args:
        source: a path (checked by :func:`jaxcal.io.given_files.check_readable`) or a binary file
            object.
        length: bytes that the file is to have, with zeros beyond its end; None: its own length.

    Raises:
        FormatError: not HDF5, truncated, damaged, or being written.
    """
    try:
        checked = CheckedFile(source, length)
    except BlockingIOError:
        raise FormatError("is being written: close it in the program that writes it") from None
    except OSError as error:
        raise FormatError(f"cannot be opened: {one_line(error)}") from None
    try:
        with _opened(checked, source) as file:
            yield Node(file, "")
    except FormatError:
        # HDF5's own error for a heap that it did not get says nothing to a person.
        if checked.damage is not None:
            raise checked.damage from None
        raise
    finally:
        checked.close()


@contextmanager
def _opened(checked: CheckedFile, source: object) -> Iterator[h5py.File]:
    try:
        file = h5py.File(checked, "r")
    except Exception as error:
        if isinstance(source, str | os.PathLike) and not h5py.is_hdf5(source):
            raise FormatError("is not an HDF5 file") from None
        raise FormatError(f"is truncated or damaged: {one_line(error)}") from None
    try:
        with _reading("the file"):
            if file.id.get_create_plist().get_sizes() != (8, 8):
                raise FormatError("has addresses or lengths of other than 8 bytes")
        yield file
    finally:
        with _reading("the file"):
            file.close()


def child(parent: Node, name: str) -> Node | None:
    """The member of a group with this name, or None where there is none.

    Soft links are followed one component at a time, so that a link which leaves the file is seen
    before HDF5 opens the file that it names. (``h5py.Group.get`` and ``in`` would open it.)

    Raises:
        FormatError: an external, dangling, circular or user-defined link; a damaged member.
    """
    location = f"{parent.name}/{name}"
    root = parent.item.file
    current: h5py.Group | h5py.Dataset = parent.item
    pending = [name.encode()]
    for step in range(_MAXIMUM_STEPS):
        while pending and pending[0] in (b"", b"."):
            pending.pop(0)
        if not pending:
            return Node(current, location)
        component = pending.pop(0)
        if not isinstance(current, h5py.Group):
            raise FormatError(f"{location} is a link that leads nowhere")
        with _reading(location):
            if not current.id.links.exists(component):
                if step == 0:
                    return None
                raise FormatError(f"{location} is a link that leads nowhere")
            kind = current.id.links.get_info(component).type
            if kind == h5l.TYPE_HARD:
                current = _open(current, component, location)
            elif kind == h5l.TYPE_SOFT:
                target = current.id.links.get_val(component)
                if target.startswith(b"/"):
                    current = root
                pending = target.split(b"/") + pending
            else:
                raise FormatError(
                    f"{location} is a link to outside the file: recordings must hold their data"
                )
    raise FormatError(f"{location} is a circular or too deep chain of links")


def group(parent: Node, name: str) -> Node | None:
    """The group with this name, or None; a dataset of that name raises FormatError."""
    node = child(parent, name)
    if node is not None and not isinstance(node.item, h5py.Group):
        raise FormatError(f"{node} must be a group")
    return node


def members(node: Node, most: int) -> list[Node]:
    """The members of a group, of any name; FormatError where there are more than ``most``."""
    assert isinstance(node.item, h5py.Group)
    with _reading(str(node)):
        if len(node.item) > most:
            raise FormatError(f"{node} has {len(node.item)} members; at most {most} are read")
        names = list(node.item)
    found = [child(node, name) for name in names]
    return [member for member in found if member is not None]


def check_attributes(node: Node) -> None:
    """Check all attributes; their text is read, so that its heaps are walked.

    Raises:
        FormatError: too many, neither text nor numbers, or damaged.
    """
    with _reading(str(node)):
        count = h5a.get_num_attrs(node.item.id)
        if count > _MOST_ATTRIBUTES:
            raise FormatError(f"{node} has {count} attributes")
        for index in range(count):
            attribute = h5a.open(node.item.id, index=index)
            kind = attribute.get_type().get_class()
            name = attribute.name.decode()
            if kind == h5t.STRING:
                text(node, name)
            elif kind not in (h5t.INTEGER, h5t.FLOAT, h5t.ENUM):
                raise FormatError(f"{node}: attribute {quoted(name)} is neither text nor a number")


def check_rows(node: Node, axes: int, most_bytes: int, kinds: str) -> tuple[int, ...]:
    """Check a dataset that will be read row by row because it is too large for :func:`array`.

    It must have so many axes, rows of at most ``most_bytes``, and a type of ``kinds`` (numpy's
    letters).

    Returns:
        Its shape.

    Raises:
        FormatError: anything else, virtual, stored elsewhere, or packed by an unknown filter.
    """
    with _reading(str(node)):
        dataset, layout = stored_here(node)
        shape = dataset.shape or ()
        if dataset.dtype.kind not in kinds or len(shape) != axes:
            raise FormatError(f"{node} has type {quoted(str(dataset.dtype))} and shape {shape}")
        if math.prod(shape[1:]) * dataset.dtype.itemsize > most_bytes:
            raise FormatError(f"{node} has rows of more than {most_bytes} bytes")
        if layout.get_layout() == h5d.CHUNKED:
            _check_chunks(node, dataset, layout)
        elif math.prod(shape) * dataset.dtype.itemsize > dataset.id.get_storage_size():
            raise FormatError(f"{node} claims more than the file holds")
        return shape


def row(node: Node, index: int) -> np.ndarray:
    """One row of a dataset that :func:`check_rows` has looked at; FormatError where damaged."""
    with _reading(str(node)):
        assert isinstance(node.item, h5py.Dataset)
        return np.asarray(node.item[index])


def array(node: Node, shape: tuple[int | UpTo, ...], kinds: str = "iuf") -> np.ndarray:
    """The values of a dataset of the agreed shape.

    Args:
        node: the dataset.
        shape: what is agreed for each axis: a length, or a limit.
        kinds: numpy's letters of the types that are taken ("b" bool, "i" and "u" integer, "f").

    Returns:
        float64, or bool or integers where ``kinds`` has no "f".

    Raises:
        FormatError: anything else: a group, virtual, stored elsewhere, of another type or shape,
            too large, packed by an unknown filter, or damaged.
    """
    with _reading(str(node)):
        dataset, layout = stored_here(node)
        dtype = dataset.dtype
        if dtype.kind not in kinds or h5py.check_enum_dtype(dtype) is not None:
            raise FormatError(
                f"{node} has type {quoted(str(dtype))}, numbers"
                f"{' or booleans' if 'b' in kinds else ''} are needed"
            )
        _check_shape(node, dataset.shape, shape)
        _check_bytes(node, dataset.shape or (), dtype.itemsize)
        if layout.get_layout() == h5d.CHUNKED:
            _check_chunks(node, dataset, layout)
        values = np.asarray(dataset[()])
    if "f" not in kinds:
        return values
    with np.errstate(over="ignore"):
        return values.astype(np.float64)


def string(node: Node) -> str:
    """The one short text of a dataset; FormatError for anything else."""
    with _reading(str(node)):
        dataset, _ = stored_here(node)
        kind = dataset.id.get_type()
        if kind.get_class() != h5t.STRING or dataset.shape not in ((), (1,)):
            raise FormatError(f"{node} must be one text")
        if kind.get_size() > _MAXIMUM_TEXT:
            raise FormatError(f"{node} is too long")
        return _decoded(np.ravel(dataset[()])[0], str(node))


def text(node: Node, name: str) -> str | None:
    """A text attribute, or None where there is none; FormatError for anything but short text."""
    value = _attribute(node, name, (h5t.STRING,), "text", 1)
    return None if value is None else _decoded(value[0], f"{node}: attribute {name}")


def _decoded(value: object, what: str) -> str:
    decoded = value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
    if len(decoded) > _MAXIMUM_TEXT:
        raise FormatError(f"{what} is too long")
    return decoded


def number(node: Node, name: str) -> float | None:
    """A number attribute, or None where there is none; FormatError for anything else."""
    values = numbers(node, name, 1)
    return None if values is None else float(values[0])


def numbers(node: Node, name: str, count: int) -> np.ndarray | None:
    """An attribute of ``count`` numbers as float64 (count,), or None where there is none.

    Raises:
        FormatError: another length or type.
    """
    values = _attribute(node, name, (h5t.INTEGER, h5t.FLOAT), "a number", count)
    if values is None:
        return None
    with np.errstate(over="ignore"):
        return values.astype(np.float64)


def flag(node: Node, name: str) -> bool | None:
    """A yes-or-no attribute, or None where there is none; FormatError for anything else."""
    values = _attribute(node, name, (h5t.INTEGER, h5t.ENUM), "true or false", 1)
    if values is None:
        return None
    if values[0] not in (0, 1):
        raise FormatError(f"{node}: attribute {name} must be true or false")
    return bool(values[0])


@contextmanager
def _reading(what: str) -> Iterator[None]:
    try:
        yield
    except CalibrationError:
        raise
    # A damaged file makes h5py raise OSError, RuntimeError, KeyError, ValueError, TypeError and
    # more, without a common base. These blocks contain only its calls and our own checks.
    except Exception as error:
        raise FormatError(f"{what} cannot be read: {one_line(error)}") from None


def stored_here(node: Node) -> tuple[h5py.Dataset, Any]:
    """A dataset that holds its own data, and HDF5's plan of how they are stored.

    Raises:
        FormatError: anything else.
    """
    dataset = node.item
    if not isinstance(dataset, h5py.Dataset):
        raise FormatError(f"{node} must be a dataset")
    layout = dataset.id.get_create_plist()
    # The shape of a virtual dataset comes from its source files: ask for nothing before this.
    if layout.get_layout() == h5d.VIRTUAL:
        raise FormatError(f"{node} is a virtual dataset: recordings must hold their data")
    if layout.get_external_count():
        raise FormatError(f"{node} is stored in another file: recordings must hold their data")
    _check_numbers(str(node), dataset.id.get_type())
    return dataset, layout


def _check_numbers(label: str, kind: h5t.TypeID) -> None:
    """Refuse integers and floating point numbers of another layout than numpy has.

    HDF5 would convert them. It trusts their description, which may be damaged, and can end the
    process: Debian's build checks it by assertions.
    """
    if kind.get_class() == h5t.ENUM:
        kind = kind.get_super()
    numbers = kind.get_class() in (h5t.INTEGER, h5t.FLOAT)
    if numbers and not kind.equal(h5t.py_create(kind.dtype)):
        raise FormatError(f"{label} holds numbers of an unusual or damaged type")


def _open(parent: h5py.Group, component: bytes, location: str) -> h5py.Group | h5py.Dataset:
    identifier = h5o.open(parent.id, component)
    if isinstance(identifier, h5g.GroupID):
        return h5py.Group(identifier)
    if isinstance(identifier, h5d.DatasetID):
        return h5py.Dataset(identifier)
    raise FormatError(f"{location} is neither a group nor a dataset")


def _attribute(
    node: Node, name: str, classes: tuple[int, ...], needed: str, count: int
) -> np.ndarray | None:
    """An attribute's values (count,), looked at before they are read; or None."""
    label = f"{node}: attribute {name}"
    with _reading(label):
        if not h5a.exists(node.item.id, name.encode()):
            return None
        attribute = h5a.open(node.item.id, name.encode())
        kind, space = attribute.get_type(), attribute.get_space()
        if kind.get_class() not in classes:
            raise FormatError(f"{label} must be {needed}")
        _check_numbers(label, kind)
        # MATLAB and others write a scalar as an array of one element.
        shapes = ((), (1,)) if count == 1 else ((count,),)
        if space.get_simple_extent_type() == h5s.NULL or attribute.shape not in shapes:
            raise FormatError(f"{label} must be {needed}, {count} of it")
        if kind.get_class() == h5t.STRING and kind.get_size() > _MAXIMUM_TEXT:
            raise FormatError(f"{label} is too long")
        return np.asarray(node.item.attrs[name]).reshape(count)


def _check_shape(node: Node, found: tuple[int, ...] | None, agreed: tuple[int | UpTo, ...]) -> None:
    needed = ", ".join(axis.name if isinstance(axis, UpTo) else str(axis) for axis in agreed)
    needed = f"({needed}{',' if len(agreed) == 1 else ''})"
    if found is None or len(found) != len(agreed):
        raise FormatError(f"{node} has shape {found}, {needed} is needed")
    for length, axis in zip(found, agreed, strict=True):
        if isinstance(axis, UpTo):
            if length > axis.limit:
                raise FormatError(
                    f"{node} claims {length} {axis.name}; at most {axis.limit} are read"
                )
        elif length != axis:
            raise FormatError(f"{node} has shape {found}, {needed} is needed")


def _check_bytes(node: Node, shape: tuple[int, ...], itemsize: int) -> None:
    if math.prod(shape) * itemsize > MAXIMUM_BYTES:
        raise FormatError(
            f"{node} claims {math.prod(shape) * itemsize} bytes for an array or chunk of shape "
            f"{shape}; at most {MAXIMUM_BYTES} are read"
        )


def _check_chunks(node: Node, dataset: h5py.Dataset, layout) -> None:
    """Refuse chunks that are too many, too large, or inflate beyond their size."""
    chunk, shape = dataset.chunks or (), dataset.shape or ()
    _check_bytes(node, chunk, dataset.dtype.itemsize)
    if math.prod(-(-length // step) for length, step in zip(shape, chunk, strict=True)) > 2**17:
        raise FormatError(f"{node} is cut into too many chunks of shape {chunk}")
    position = _check_filters(node, layout)
    if position is None:
        return
    nominal = math.prod(chunk) * dataset.dtype.itemsize
    stored = []
    dataset.id.chunk_iter(lambda info: stored.append((info.size, info.chunk_offset)))
    for size, offset in stored:
        if size > nominal + nominal // 64 + 1024:
            raise FormatError(f"{node} has a compressed chunk larger than its contents")
        if size > _HARMLESS_CHUNK:
            skipped, packed = dataset.id.read_direct_chunk(offset)
            if skipped & (1 << position):
                continue
            # HDF5's own inflation grows its buffer without a bound.
            inflate = zlib.decompressobj()
            inflate.decompress(packed, nominal + 64)
            if not inflate.eof:
                raise FormatError(f"{node} has a chunk that inflates beyond its size")


def _check_filters(node: Node, layout) -> int | None:
    """Refuse filters that may load code or are repeated; returns the place of gzip among them."""
    codes = []
    for index in range(layout.get_nfilters()):
        code, _, _, name = layout.get_filter(index)
        if code not in _FILTERS:
            raise FormatError(
                f"{node} is compressed by filter {code} ({quoted(name.decode(errors='replace'))}), "
                "which is not read: write it with gzip or uncompressed"
            )
        codes.append(code)
    if len(set(codes)) < len(codes):
        raise FormatError(f"{node} is compressed twice by the same filter")
    if h5z.FILTER_DEFLATE not in codes:
        return None
    position = codes.index(h5z.FILTER_DEFLATE)
    if set(codes[position + 1 :]) - {h5z.FILTER_FLETCHER32}:
        raise FormatError(f"{node} is compressed by filters in an order that is not supported")
    return position
