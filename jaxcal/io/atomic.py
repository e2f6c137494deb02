"""Files that are complete or absent, whatever happens while they are written.

The new content goes to a temporary file in the target's own folder, is flushed to the disk, and
then takes the target's name in one step. A process that is killed in between leaves the target as
it was, and at worst a hidden file ``.partial-*`` beside it.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from jaxcal import CalibrationError, InputError, OutputError
from jaxcal.io.given_files import one_line

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@contextmanager
def atomic_path(target: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path to write to; it becomes ``target`` when the block ends well.

    Args:
        target: the file to make or replace. A symbolic link is followed: the file that it names is
            replaced. An existing file keeps its permissions, a new one gets the umask's.

    Yields:
        An existing, empty file in the same folder and with the same suffix. The block must fill it
        and close it.

    Raises:
        OutputError: on any OSError (no such folder, no permission, a directory, disk full), the
            block's own included. The temporary file is then removed and the target is as it was.
            The same holds after every other exception, which is passed on.
    """
    name = os.fspath(target)
    try:
        final = Path(os.path.realpath(name))
        mode = _existing_mode(final)
        temporary = _create_beside(final, mode)
    except FileNotFoundError as error:
        raise OutputError(f"{name}: cannot be written: its folder does not exist") from error
    except (OSError, ValueError) as error:
        raise _output_error(name, error) from error

    try:
        yield temporary
        if mode is not None:
            os.chmod(temporary, mode)
        _flush(temporary, os.O_RDWR)
        os.replace(temporary, final)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and not isinstance(error, CalibrationError):
            raise _output_error(name, error) from error
        raise
    # The file has its name by now. Where folders cannot be flushed (Windows, some network file
    # systems) a power cut may still bring the old content back, never half of the new one.
    with suppress(OSError):
        _flush(final.parent, os.O_RDONLY)


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file, complete or not at all.

    Raises:
        OutputError: it could not be written; the file is as it was.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """:func:`write_bytes` of a text in UTF-8; line ends are written as they are."""
    # File names that are not UTF-8 reach us as lone surrogates, which UTF-8 cannot encode.
    write_bytes(path, text.encode("utf-8", errors="backslashreplace"))


@contextmanager
def made_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Make a folder and its missing parents, and check that files can be written to it.

    Yields:
        The folder. If the block raises an error, folders that were made here and are still empty
        are removed again.

    Raises:
        OutputError: it cannot be made or written to.
    """
    folder = Path(path)
    made: list[Path] = []
    try:
        try:
            missing = [place for place in (folder, *folder.parents) if not place.exists()]
            for place in reversed(missing):
                place.mkdir(exist_ok=True)
                made.append(place)
            if not folder.is_dir():
                raise OutputError(f"{path}: is a file, not a folder")
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OutputError:
            raise
        except (OSError, ValueError) as error:
            reason = one_line(error)
            raise OutputError(f"{path}: cannot be made or written to: {reason}") from error
        yield folder
    except BaseException:
        for place in reversed(made):
            with suppress(OSError):
                place.rmdir()
        raise


STAGED = ".partial-report*"
"""Folders inside a folder of files in which its next content is gathered."""

PATIENCE_S = 10.0
"""How long another program's change of a folder of files, which takes less, is waited for."""


def replace_files(
    folder: str | os.PathLike[str], files: Mapping[str, bytes], names: Iterable[str]
) -> None:
    """Replace a set of files that belong together: at no moment are old and new ones mixed.

    The new files are gathered in a folder :data:`STAGED` first; then the old ones are removed, and
    then the new ones take their names, the first of them last. A process that is killed in between
    leaves a folder without that file; the next call puts it right. Where the system has locks, one
    process at a time does so.

    Args:
        folder: an existing folder; other files in it are left alone.
        files: name and content; the first one says that the set is whole.
        names: of all files that such a set may have; those that are not in ``files`` are removed.

    Raises:
        OutputError: they cannot be written, or another program is writing them. Old files are as
            they were, unless the disk failed in the very moment of the change.
    """
    target = Path(folder)
    with _only_writer(target) as alone:
        if alone:
            for left in target.glob(STAGED):
                shutil.rmtree(left, ignore_errors=True)
        _replace_files(target, files, names)


def _replace_files(target: Path, files: Mapping[str, bytes], names: Iterable[str]) -> None:
    staged = target / STAGED.replace("*", f"-{secrets.token_hex(8)}")
    known = [*files, *(name for name in names if name not in files)]
    for name in known:
        try:
            _existing_mode(target / name)
        except (OSError, ValueError) as error:
            raise _output_error(os.fspath(target / name), error) from error
    try:
        staged.mkdir()
        try:
            for name, content in files.items():
                (staged / name).write_bytes(content)
                _flush(staged / name, os.O_RDWR)
        except BaseException:
            shutil.rmtree(staged, ignore_errors=True)
            raise
        for name in known:
            (target / name).unlink(missing_ok=True)
        for name in reversed(list(files)):
            os.replace(staged / name, target / name)
        staged.rmdir()
    except (OSError, ValueError) as error:
        raise _output_error(os.fspath(target), error) from error
    with suppress(OSError):
        _flush(target, os.O_RDONLY)


@contextmanager
def _only_writer(folder: Path) -> Iterator[bool]:
    """Wait until no other process replaces files of a folder; whether that is sure."""
    # The folder itself is locked: no file is left over, and the lock ends with its process.
    descriptor = None
    with suppress(OSError, ValueError):
        descriptor = os.open(folder, os.O_RDONLY)
    if descriptor is None:  # on Windows, or what is wrong with the folder is said later
        yield False
        return
    try:
        end = time.monotonic() + PATIENCE_S
        while (locked := lock(descriptor)) is False:
            if time.monotonic() >= end:
                raise OutputError(
                    f"{folder}: is being written by another program: try again, or name another "
                    "folder"
                )
            time.sleep(0.02)
        yield bool(locked)
    finally:
        os.close(descriptor)


def lock(descriptor: int, *, shared: bool = False) -> bool | None:
    """Lock an open file or folder until it is closed or the process ends.

    Args:
        descriptor: of the file or folder.
        shared: as a reader, of whom there may be several.

    Returns:
        False where another process has locked it; None where the system or the file system has no
        locks.
    """
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def check_writable(path: str | os.PathLike[str]) -> None:
    """Check that a file can be made or replaced, before other work begins.

    Raises:
        OutputError: it cannot be made or replaced.
    """
    with suppress(_Unwritten), atomic_path(path):
        raise _Unwritten


class _Unwritten(Exception):
    """Ends a check before anything is written."""


def save_figure(
    figure: Figure, path: str | os.PathLike[str], *, dpi: float | Literal["figure"] = "figure"
) -> None:
    """Write a figure, complete or not at all, in the format that the file's name ends in.

    Args:
        figure: of matplotlib.
        path: the file to make or replace; a name without an ending gets PNG content.
        dpi: of formats that consist of pixels; by default the figure's own.

    Raises:
        InputError: no figure can be written in this format.
        OutputError: it could not be written; the file is as it was.
    """
    kind = Path(path).suffix.lstrip(".").lower() or "png"
    known = figure.canvas.get_supported_filetypes()
    if kind not in known:
        endings = ", ".join(f".{each}" for each in sorted(known))
        raise InputError(
            f"{os.fspath(path)}: no figure can be written as .{kind}; these endings work: {endings}"
        )
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format=kind)


def _existing_mode(final: Path) -> int | None:
    """The permissions of the file to be replaced, or None where there is none."""
    try:
        status = final.stat()
    except FileNotFoundError:
        return None
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, "it is a directory")
    # Renaming onto a device (/dev/null, /dev/stdout) or a pipe would destroy it.
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "it is not a regular file")
    # Renaming needs the folder's permission only: a write-protected file would be lost silently.
    if not os.access(final, os.W_OK, effective_ids=os.access in os.supports_effective_ids):
        raise PermissionError(errno.EACCES, "it is write-protected")
    return stat.S_IMODE(status.st_mode) & 0o777


def partial_path(final: Path) -> Path:
    """A new name beside a file, for its content until it is whole."""
    return final.parent / f".partial-{secrets.token_hex(8)}{final.suffix}"


def _create_beside(final: Path, mode: int | None) -> Path:
    # Not mkstemp: its mode 0600 would stay after renaming, and to read the umask is to set it.
    temporary = partial_path(final)
    created = 0o666 if mode is None else (mode & 0o666) | 0o600
    os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, created))
    return temporary


def _flush(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _output_error(name: str, error: Exception) -> OutputError:
    return OutputError(f"{name}: cannot be written: {one_line(error)}")
