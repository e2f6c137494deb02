"""Looking at the file of an acquisition before it is resumed; it is not trusted."""

from __future__ import annotations

import json
import os

import h5py
import numpy as np
from h5py import h5d  # pyright: ignore[reportAttributeAccessIssue]

from hw.recording_layout import (
    FORMAT,
    FRAME_TYPES,
    LARGEST_ROW,
    LARGEST_SETTINGS,
    LAYOUT,
    STATIC,
    VERSION,
    Column,
)
from jaxcal.errors import FormatError
from jaxcal.io.readable import check_readable
from jaxcal.io.untrusted import Node, child, flag, group, number, open_root, text


def check_resumable(path: str | os.PathLike[str]) -> None:
    """Look at a file before it is opened for writing; it is not trusted.

    A file that a full disk cut short of what it says of itself gets its length back, with zeros.

    Raises:
        FormatError: missing, not a recording, complete, of another layout, with links or data
            outside of it. One line that starts with the path.
    """
    check_readable(path)
    _mend_length(path)
    try:
        with open_root(path) as root:
            if text(root, "format") != FORMAT or number(root, "version") != VERSION:
                raise FormatError("is not a recording of this version")
            if flag(root, "complete") is not False:
                raise FormatError("is complete: there is nothing to resume")
            for name, columns in LAYOUT.items():
                node = group(root, name)
                if node is None:
                    raise FormatError(f"has no /{name}: it was not made by an acquisition")
                for key, column in columns.items():
                    dataset = child(node, key)
                    if dataset is not None:
                        _check_column(dataset, column)
            for name in STATIC:
                group(root, name)
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from None


def settings_of(path: str | os.PathLike[str]) -> dict[str, object]:
    """How the acquisition of a recording was asked for; of a file that is not trusted.

    Raises:
        FormatError: not an acquisition's recording, or settings that are not a JSON object.
    """
    check_readable(path)
    try:
        with open_root(path) as root:
            node = group(root, "plan")
            dataset = None if node is None else child(node, "settings")
            if dataset is None or not isinstance(dataset.item, h5py.Dataset):
                raise FormatError("has no /plan/settings: it was not made by an acquisition")
            _check_place(dataset)
            if dataset.item.dtype != np.uint8 or (dataset.item.size or 0) > LARGEST_SETTINGS:
                raise FormatError("has settings that cannot be read")
            found = json.loads(bytes(np.asarray(dataset.item[()])).decode())
            if not isinstance(found, dict):
                raise FormatError("has settings that are not a JSON object")
            return found
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from None
    except (ValueError, RecursionError, UnicodeDecodeError):
        raise FormatError(f"{path}: has settings that are not JSON") from None


def _mend_length(path: str | os.PathLike[str]) -> None:
    """HDF5 refuses a file shorter than its superblock (version 0) says; only its last rows are."""
    with open(path, "rb") as file:
        start = file.read(48)
    if start[:9] != b"\x89HDF\r\n\x1a\n\0":
        return
    missing = int.from_bytes(start[40:48], "little") - os.path.getsize(path)
    if 0 < missing <= LARGEST_ROW:
        os.truncate(path, os.path.getsize(path) + missing)


def _check_column(node: Node, column: Column) -> None:
    dataset = node.item
    if not isinstance(dataset, h5py.Dataset):
        raise FormatError(f"{node} must be a dataset")
    _check_place(node)
    wanted = (len(column.tail) + 1, FRAME_TYPES if column.dtype == "frame" else (column.dtype,))
    names = (dataset.dtype.name, dataset.dtype.str[1:])
    if dataset.ndim != wanted[0] or not set(names) & {np.dtype(d).str[1:] for d in wanted[1]}:
        raise FormatError(f"{node} is {dataset.dtype} of shape {dataset.shape}: not this layout")
    if dataset.chunks is None or (dataset.maxshape or (0,))[0] is not None:
        raise FormatError(f"{node} cannot grow")
    if int(np.prod(dataset.shape[1:], dtype=object)) * dataset.dtype.itemsize > LARGEST_ROW:
        raise FormatError(f"{node} claims rows of shape {dataset.shape[1:]}")


def _check_place(node: Node) -> None:
    layout = node.item.id.get_create_plist()
    if layout.get_layout() == h5d.VIRTUAL or layout.get_external_count():
        raise FormatError(f"{node} is stored in another file: recordings must hold their data")
