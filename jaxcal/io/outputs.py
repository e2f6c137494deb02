"""What may be replaced: no file that is read, and only a file of the kind that is written.

So a command may be run again over its own earlier output, and a name in the wrong place destroys
nothing.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterable

from jaxcal import CalibrationError, FormatError, InputError
from jaxcal.io.given_files import path_name
from jaxcal.io.lines import HDF5_BEGINNING

Path = str | os.PathLike[str]


class NotReplacedError(InputError):
    """Why a file is not replaced although it may be of the kind that is written."""


RECORDING = (".h5", ".hdf5")
"""Endings of the names of recordings."""


def check_output(
    path: Path,
    what: str,
    is_one: Callable[[Path], bool],
    inputs: Iterable[Path] = (),
    *,
    endings: tuple[str, ...] = ("",),
) -> None:
    """See that writing a file replaces nothing but an earlier one of its kind, and is named so.

    Args:
        path: the file to write. Where there is none yet, an empty one or no ordinary file, only its
            name is checked: whoever writes it says what is wrong.
        what: the kind in words, for messages.
        is_one: whether a file is of this kind; an error of jaxcal's means no, with a reason of its
            own where it is a :class:`NotReplacedError`.
        inputs: files that are read, which must not be replaced whatever they are.
        endings: of the names of files of this kind, in small letters; by default any.

    Raises:
        InputError: its name ends otherwise, or it is one of the inputs, or of another kind.
    """
    name = path_name(path)
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        status = None
    if status is not None and any(_same(status, each) for each in inputs):
        raise InputError(
            f"{name}: is an input of this command and is not replaced: name another output"
        )
    if not name.lower().endswith(endings):
        raise InputError(f"{name}: {what} is named {' or '.join(endings)}")
    if status is None or not stat.S_ISREG(status.st_mode) or status.st_size == 0:
        return
    try:
        replaceable = is_one(path)
    except NotReplacedError as error:
        raise InputError(f"{name}: {error}") from None
    except (CalibrationError, OSError):
        replaceable = False
    if not replaceable:
        raise InputError(f"{name}: exists and is not {what}: name another file, or remove it first")


def begins_with(*starts: bytes) -> Callable[[Path], bool]:
    """Whether a file begins with one of these bytes."""

    def is_one(path: Path) -> bool:
        with open(path, "rb") as file:
            return file.read(max(map(len, starts))).startswith(starts)

    return is_one


def is_hdf5_recording(path: Path) -> bool:
    """Whether a file is in our format, of an acquisition or not."""
    from jaxcal.io.hdf5 import FORMAT
    from jaxcal.io.untrusted import open_root, text

    if not (os.path.isfile(path) and begins_with(HDF5_BEGINNING)(path)):
        return False
    with open_root(path) as root:
        return text(root, "format") == FORMAT


def is_recording(path: Path) -> bool:
    """Whether a file is one of our recordings, with nothing that would be lost by writing another.

    Raises:
        NotReplacedError: it is an acquisition, with more than :func:`jaxcal.save` writes or to be
            resumed; or it is HDF5 that cannot be read: damaged, or open in another program.
    """
    from jaxcal.io.hdf5 import FORMAT, raw_data
    from jaxcal.io.untrusted import open_root, text

    try:
        with open_root(path) as root:
            if text(root, "format") != FORMAT:
                return False
            found = raw_data(root)
    except FormatError as error:
        if begins_with(HDF5_BEGINNING)(path):
            raise NotReplacedError(f"{error} (not replaced: name another file)") from None
        raise
    if found is not None:
        raise NotReplacedError(
            f"is an acquisition with its raw data ({found}): choose another name"
        )
    return True


def is_simulated(path: Path) -> bool:
    """Whether a file is a recording that holds the truth, as simulations do."""
    from jaxcal.io.hdf5 import load

    return is_recording(path) and load(path).truth is not None


def _same(status: os.stat_result, other: Path) -> bool:
    try:
        return os.path.samestat(status, os.stat(other))
    except (OSError, ValueError):
        return False
