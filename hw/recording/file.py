"""Writing the file of an acquisition so that it survives the death of its writer.

How it stays readable: default file format (no SWMR, which plain readers refuse), one frame a chunk,
poses in chunks of 256, a checksum on every chunk, and a flush at least once a second. Between
flushes HDF5 does not write its own structures (evictions are off), so the structures on the disk
are those of the last flush. ``complete`` is set last, then a SHA-256 sidecar is written.

A flush must not fail half-way: HDF5 would leave new structures beside old ones. So the bytes that
the next flush may need are allocated in the file before any row is taken (:meth:`_make_room`). When
the disk refuses them (full, quota, limit of a file's size), the rows taken before are flushed into
the space allocated so far, and the file is closed in order.
"""

from __future__ import annotations

import errno
import hashlib
import io
import os
import secrets
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hw.recording.check import check_resumable, stored_length
from hw.recording.layout import (
    FORMAT,
    FRAME_TYPES,
    LARGEST_SETTINGS,
    LAYOUT,
    SELECTED,
    STATIC,
    TEXT_BYTES,
    VERSION,
    Column,
    RecordingHeader,
)
from jaxcal import FormatError, OutputError, __version__
from jaxcal.io.atomic import partial_path, write_text
from jaxcal.io.given_files import one_line

RESERVE_BYTES = 2**27
"""The writer ends in order when the disk has less free than this: 128 MiB, many seconds of data."""

_STRUCTURES_BYTES = 2**21
"""More than one flush takes for HDF5's own structures and for chunks that are not yet full."""

_STEP_BYTES = 2**23
"""Bytes allocated ahead, so that not every row asks the file system."""

_LARGEST_ARRAY = 2**28
"""Bytes; an array of /plan, /test or /truth has far fewer."""

_BLOCK_BYTES = 2**22
"""Read at once for the digest."""

_END_OF_FILE = slice(40, 48)
"""Where a superblock of version 0 keeps the file's length, little endian."""


class RecordingWriter:
    """Appends rows to a recording and keeps it readable; one process at a time.

    Made by :meth:`create` or :meth:`resume`.

    Attributes:
        path: of the file.
        reserve_bytes: bytes of the disk that stay free.
        rows: how many rows each group has (groups without datasets yet are left out).
    """

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        self.reserve_bytes = RESERVE_BYTES
        self.digest_error: str | None = None
        self._file = file
        # A duplicate of HDF5's descriptor: it leads to the same file whatever becomes of the path.
        self._descriptor = os.dup(file.id.get_vfd_handle())
        self._allocated = self._pending = 0
        self._counted: dict[tuple[str, str], int] = {}
        """What was counted in earlier runs."""
        self._make_room(0)
        members = {name: _columns(file, name) for name in LAYOUT}
        self.rows = {
            name: len(next(iter(found.values()))) for name, found in members.items() if found
        }

    @classmethod
    def create(cls, path: str | os.PathLike[str], header: RecordingHeader) -> RecordingWriter:
        """A new recording; the file appears with its whole skeleton, so that it always opens.

        Args:
            path: the file to make.
            header: what is known from the start.

        Raises:
            OutputError: the file is there already, or cannot be written.
        """
        final = check_new(path)
        temporary = partial_path(final)
        try:
            # Built in memory: HDF5 crashes on a full disk.
            image = io.BytesIO()
            with h5py.File(image, "w") as file:
                _write_skeleton(file, header)
            temporary.write_bytes(image.getvalue())
            _take_name(temporary, final)
        except FileExistsError:
            raise _existing(final) from None
        except OSError as error:
            raise OutputError(f"{final}: cannot be written: {one_line(error)}") from None
        finally:
            with suppress(OSError):
                temporary.unlink()
        return cls(final, _open_for_writing(final))

    @classmethod
    def resume(cls, path: str | os.PathLike[str]) -> RecordingWriter:
        """Go on with a recording whose writer ended early, as far as it is whole.

        After a power cut some pages of the file may be older than others. Then what is whole is
        copied into a new file of this name, and the damaged one is kept as ``<file>.damaged``.

        Raises:
            FormatError: not a recording of an acquisition, damaged, or complete already.
            OutputError: it cannot be opened for writing.
        """
        check_resumable(path)
        length = stored_length(path)
        if length is not None:
            os.truncate(path, length)
        damaged = _salvaged(Path(path))
        file = _open_for_writing(Path(path))
        # It may have come to its end without all images: its digest no longer holds.
        file.attrs["complete"] = False
        _sidecar(Path(path)).unlink(missing_ok=True)
        writer = cls(Path(path), file)
        if damaged is not None:
            writer.note("salvaged", f"what was whole; the damaged file is {damaged.name}")
        writer._match_placements()
        return writer

    def _match_placements(self) -> None:
        """Give each selected image one row of /placement: those to come must belong together.

        The writer may have ended between the two rows, or one of them was damaged. What is lost is
        NaN.
        """
        placement = _columns(self._file, "placement")
        if not placement or "max_elevation" not in _columns(self._file, "calibration"):
            return  # images of a free-hand acquisition are not placed
        images, rows = self.rows["calibration"], self.rows["placement"]
        if rows < images:
            self.append("placement", {key: np.full(images - rows, np.nan) for key in placement})
        for column in placement.values():
            column.resize(images, axis=0)
        self.rows["placement"] = images

    def note(self, kind: str, text: str) -> None:
        """Append an event without a host time."""
        said = text.encode(errors="backslashreplace")[:TEXT_BYTES]
        row = {"t_host": np.nan, "utc": utc_now().encode(), "kind": kind.encode(), "text": said}
        self.append("events", {key: np.array([value]) for key, value in row.items()})

    def append(self, name: str, columns: Mapping[str, np.ndarray]) -> None:
        """Append rows to a group.

        Args:
            name: the group.
            columns: an array for each of its datasets, with rows along the first axis; frames
                after the first must have the first one's size and type.

        Raises:
            FormatError: columns that do not fit the layout; nothing is appended.
        """
        target = self._prepare(name, columns)
        counts = {len(values) for values in columns.values()}
        if len(counts) != 1 or set(columns) != set(target):
            raise FormatError(f"/{name}: needs one row in each of {', '.join(target)}")
        arrays = {key: _fitting(name, key, values, target[key]) for key, values in columns.items()}
        self._make_room(sum(values.nbytes for values in arrays.values()))
        start = self.rows.get(name, 0)
        stop = start + counts.pop()
        for key, values in arrays.items():
            dataset = target[key]
            dataset.resize(stop, axis=0)
            dataset[start:stop] = values
        self.rows[name] = stop

    def leave_out(self, row: int) -> None:
        """Mask a selected image.

        Raises:
            FormatError: there is no such row.
        """
        mask = _columns(self._file, "calibration")["mask"]
        if not 0 <= row < len(mask):
            raise FormatError(f"/calibration has no row {row}")
        mask[row] = False

    def put(self, name: str, key: str, values: np.ndarray, unit: str) -> None:
        """Write an array of /plan, /test or /truth, once; the same name again replaces it."""
        if name not in STATIC:
            raise FormatError(f"/{name} is not among {', '.join(STATIC)}")
        self._make_room(values.nbytes)
        target = self._file.require_group(name)
        if key in target:
            del target[key]
        target.create_dataset(key, data=values).attrs["units"] = unit

    def copy(self, name: str, key: str, to_name: str, to_key: str) -> None:
        """Copy a whole column into an array of /plan, /test or /truth."""
        column = _columns(self._file, name)[key]
        self.put(to_name, to_key, column[()], str(column.attrs["units"]))

    def attributes(self, name: str, values: Mapping[str, object]) -> None:
        """Set attributes of a group of the layout."""
        for key, value in values.items():
            self._file.require_group(name).attrs[key] = _plain(value)

    def counts(self, name: str, values: Mapping[str, int]) -> None:
        """Set attributes that count something since the file was opened: over all runs together."""
        attributes = self._file.require_group(name).attrs
        for key, count in values.items():
            held = attributes.get(key)
            known = int(held) if isinstance(held, np.integer) else 0
            attributes[key] = self._counted.setdefault((name, key), known) + count

    def flush(self, *, durable: bool = False) -> None:
        """Bring the file on the disk up to date; ``durable``: also past the system's cache.

        Raises:
            OutputError: the disk is nearly full; the file has been closed and can be resumed.
        """
        self._file.flush()
        if durable:
            os.fsync(self._descriptor)
        # The file may have been moved by now; Windows asks by a path, and lets nobody move it.
        place = self.path if os.name == "nt" else self._descriptor
        if shutil.disk_usage(place).free < self.reserve_bytes:
            self.close()
            raise OutputError(f"{self.path}: the disk is nearly full: free some space")
        # HDF5 has cut the file to its own length, so the bytes allocated ahead are gone.
        self._allocated, self._pending = os.fstat(self._descriptor).st_size, 0
        self._check_place()
        self._make_room(0)

    def close(self) -> None:
        """Flush and close; the recording stays marked incomplete and can be resumed.

        Raises:
            OutputError: the disk refused it; the file was mended as far as possible, to open again.
        """
        try:
            self._close_file()
        finally:
            self._forget()

    def _close_file(self) -> None:
        if not self._file.id.valid:
            return
        try:
            self._file.flush()
            length = self._file.id.get_filesize()
            os.fsync(self._descriptor)
            self._file.close()
            if os.fstat(self._descriptor).st_size > length:
                os.ftruncate(self._descriptor, length)
        except Exception as error:
            self._mend()
            raise OutputError(f"{self.path}: cannot be written: {one_line(error)}") from None

    def _forget(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _make_room(self, size: int) -> None:
        """Allocate what the next flush needs when ``size`` more bytes are to be written.

        Raises:
            OutputError: the disk has no room; the rows taken before are in the closed file.
        """
        # Chunks with a checksum get their place in the file only when they are flushed.
        self._pending += size
        needed = self._file.id.get_filesize() + self._pending + _STRUCTURES_BYTES
        if needed <= self._allocated:
            return
        try:
            try:
                self._allocate(needed + _STEP_BYTES)
            except OSError:
                self._allocate(needed)
        except OSError as error:
            self._close_file()
            raise OutputError(
                f"{self.path}: the disk cannot be written any more: {one_line(error)}: free some "
                "space"
            ) from None

    def _allocate(self, end: int) -> None:
        try:
            os.posix_fallocate(self._descriptor, self._allocated, end - self._allocated)
        except AttributeError:  # not on this system
            pass
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS):
                raise
        self._allocated = end

    def _mend(self) -> None:
        """Make a file whose last flush failed open again: match its length and its superblock's."""
        with suppress(OSError):
            size = os.fstat(self._descriptor).st_size
            # Windows cannot read at a place without going there, and HDF5 counts on where it was.
            before = os.lseek(self._descriptor, 0, os.SEEK_CUR)
            try:
                os.lseek(self._descriptor, 0, os.SEEK_SET)
                start = os.read(self._descriptor, _END_OF_FILE.stop)
                length = int.from_bytes(start[_END_OF_FILE], "little")
                if start[8] != 0 or length <= size:
                    return
                try:
                    os.ftruncate(self._descriptor, length)
                except OSError:
                    os.lseek(self._descriptor, _END_OF_FILE.start, os.SEEK_SET)
                    os.write(self._descriptor, size.to_bytes(8, "little"))
            finally:
                os.lseek(self._descriptor, before, os.SEEK_SET)

    def _check_place(self) -> None:
        """Check that the path still leads to the file that is being written.

        Raises:
            OutputError: it does not; the file has been closed in order, wherever it is now.
        """
        if not self._in_place():
            what = "replaced by another file" if self.path.exists() else "removed"
            self._close_file()
            raise OutputError(f"{self.path}: was {what} while it was being recorded")

    def _in_place(self) -> bool:
        try:
            return os.path.samestat(os.stat(self.path), os.fstat(self._descriptor))
        except OSError:
            return False

    def rescue(self) -> Path:
        """Close the file whatever has failed, and return where it is.

        A file that was moved stays where it is now. A file that was removed is copied back to its
        path, or to a new name beside it if another file is there.
        """
        if self._descriptor < 0:
            return self.path
        with suppress(OutputError):
            self._close_file()
        try:
            if self._in_place():
                return self.path
            if os.fstat(self._descriptor).st_nlink == 0:
                return self._copied()
            return Path(os.readlink(f"/proc/self/fd/{self._descriptor}"))
        except OSError:  # no such folder on this system
            return self.path
        finally:
            self._forget()

    def _copied(self) -> Path:
        temporary = partial_path(self.path)
        try:
            with open(temporary, "xb") as copy:
                os.lseek(self._descriptor, 0, os.SEEK_SET)
                with open(os.dup(self._descriptor), "rb") as source:
                    shutil.copyfileobj(source, copy, 2**20)
                copy.flush()
                os.fsync(copy.fileno())
            final = self.path
            while True:
                try:
                    _take_name(temporary, final)
                    return final
                except FileExistsError:
                    name = f"{self.path.stem}.{secrets.token_hex(4)}{self.path.suffix}"
                    final = self.path.with_name(name)
        finally:
            with suppress(OSError):
                temporary.unlink()

    def finish(self, busy: Callable[[], None] = lambda: None) -> str:
        """Mark the recording complete, close it, and write its SHA-256 beside it.

        Args:
            busy: called again and again while a large file is read.

        Returns:
            The hexadecimal digest of the file that was written; ``sha256sum -c`` reads the sidecar
            ``<file>.sha256``. If that cannot be written, ``digest_error`` says why.

        Raises:
            OutputError: the disk is full, or the path leads to another file.
        """
        self.flush(durable=True)
        self._file.attrs["complete"] = True
        self._close_file()
        with open(os.dup(self._descriptor), "rb") as file:
            file.seek(0)
            digest = hashlib.sha256()
            while block := file.read(_BLOCK_BYTES):
                digest.update(block)
                busy()
        self._check_place()
        self._forget()
        try:
            write_text(_sidecar(self.path), f"{digest.hexdigest()}  {self.path.name}\n")
        except OutputError as error:
            # The recording itself is complete: there is nothing to resume.
            self.digest_error = str(error)
        return digest.hexdigest()

    def _prepare(self, name: str, columns: Mapping[str, np.ndarray]) -> dict[str, h5py.Dataset]:
        if name not in LAYOUT:
            raise FormatError(f"/{name} cannot be appended to")
        target = self._file.require_group(name)
        if name == "us" and "frames" not in target and "frames" in columns:
            shape, dtype = columns["frames"].shape, columns["frames"].dtype
            if len(shape) != 3 or dtype.name not in FRAME_TYPES:
                raise FormatError(f"/us/frames: {dtype.name} of shape {shape} is not (n, H, W)")
            sizes = {"height": shape[1], "width": shape[2], "frame": dtype.name}
            _make_columns(target, LAYOUT["us"], sizes)
        return _columns(self._file, name)


def _take_name(temporary: Path, final: Path) -> None:
    """Give a file a name that nothing has: somebody may have made such a file in the meantime.

    Raises:
        FileExistsError: something has it.
    """
    try:
        os.link(temporary, final)
    except FileExistsError:
        raise
    except OSError:
        # A USB stick (exFAT) or a shared folder may have no hard links.
        with open(final, "xb"):
            pass
        os.replace(temporary, final)


def _sidecar(path: Path) -> Path:
    return path.with_name(path.name + ".sha256")


def utc_now() -> str:
    """The time of day for a file's reader: ISO 8601, UTC, milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _existing(path: Path) -> OutputError:
    """The error for a path that something has already, with what to do."""
    if path.is_dir():
        return OutputError(f"{path}: is a directory, not a file")
    try:
        check_resumable(path)
    except FormatError:
        return OutputError(f"{path}: exists already: give another name")
    return OutputError(f"{path}: exists already: resume it, or give another name")


def check_new(path: str | os.PathLike[str]) -> Path:
    """The path of a recording that can be made.

    Raises:
        OutputError: it is there already, or its folder is missing.
    """
    final = Path(path)
    if final.exists():
        raise _existing(final)
    if not final.parent.is_dir():
        raise OutputError(f"{final}: there is no folder {final.parent}")
    return final


def _write_skeleton(file: h5py.File, header: RecordingHeader) -> None:
    file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
    file.attrs["complete"] = False
    file.attrs["created_utc"] = utc_now()
    file.attrs["software"] = f"jaxcal {__version__}"
    file.attrs["transform_convention"] = (
        "4x4, row-major, mm; pose maps the probe (the robot's tool centre point, or the tracked "
        "frame) to the robot base or the tracker"
    )
    if header.probe:
        file.create_group("probe")
    for key, value in header.probe.items():
        file["probe"].attrs[key] = value
    sizes = {"lines": header.lines, "elements": int(header.probe.get("elements", 0))}
    for name, columns in LAYOUT.items():
        target = file.create_group(name)
        kept = SELECTED[header.kind] if name == "calibration" else columns
        wanted = {key: column for key, column in columns.items() if key in kept}
        # The size of the frames is known when the first one comes; without active echo: no lines.
        if name != "us" and (name != "ae" or header.lines):
            _make_columns(target, wanted, sizes)
    file["us"].attrs["orientation"] = "MF"
    settings = header.settings.encode()
    if len(settings) > LARGEST_SETTINGS:
        raise OutputError(f"the settings are too long: {len(settings)} bytes")
    plan = file.require_group("plan")
    plan.create_dataset("settings", data=np.frombuffer(settings, np.uint8)).attrs["units"] = "1"


def _make_columns(
    target: h5py.Group, columns: Mapping[str, Column], sizes: Mapping[str, int | str]
) -> None:
    for key, column in columns.items():
        tail = tuple(int(sizes[n]) if isinstance(n, str) else n for n in column.tail)
        dtype = np.dtype(str(sizes["frame"])) if column.dtype == "frame" else np.dtype(column.dtype)
        dataset = target.create_dataset(
            key,
            shape=(0, *tail),
            maxshape=(None, *tail),
            dtype=dtype,
            chunks=(column.chunk, *tail),
            fletcher32=True,
        )
        dataset.attrs["units"] = column.unit


def _open_for_writing(path: Path) -> h5py.File:
    try:
        file = h5py.File(path, "r+")
        # Without this HDF5 may write its own structures at any time, in the middle of a change.
        cache = file.id.get_mdc_config()
        cache.set_initial_size, cache.initial_size = True, 2**23
        cache.incr_mode, cache.flash_incr_mode, cache.decr_mode = 0, 0, 0
        cache.evictions_enabled = False
        file.id.set_mdc_config(cache)
    except BlockingIOError:
        raise OutputError(f"{path}: is open in another program: close it there") from None
    except OSError as error:
        raise OutputError(f"{path}: cannot be opened for writing: {one_line(error)}") from None
    return file


def _columns(file: h5py.File, name: str) -> dict[str, h5py.Dataset]:
    """The growing datasets of a group, in the layout's order; empty where it has none yet."""
    target = file.require_group(name)
    found = {key: target[key] for key in LAYOUT[name] if key in target}
    return {key: member for key, member in found.items() if isinstance(member, h5py.Dataset)}


def _salvaged(path: Path) -> Path | None:
    """Replace a recording that is not whole by a copy of what is; where the damaged one is then.

    HDF5 cannot be asked to cut such a file back: it would follow the structures that are damaged.

    Raises:
        FormatError: what every recording has cannot be read.
        OutputError: it is open elsewhere, or the disk refused the copy.
    """
    final = Path(os.path.realpath(path))
    temporary = partial_path(final)
    kept = final.with_name(f"{final.name}.damaged")
    if kept.exists():
        kept = final.with_name(f"{final.name}.{secrets.token_hex(4)}.damaged")
    try:
        with h5py.File(final, "r") as file:
            if all(_is_whole(_columns(file, name)) for name in LAYOUT):
                return None
            with h5py.File(temporary, "w") as copy:
                _copy_whole(file, copy)
        shutil.copymode(final, temporary)
        with open(temporary, "rb+") as written:
            os.fsync(written.fileno())
        _take_name(final, kept)
        os.replace(temporary, final)
        return kept
    except BlockingIOError:
        raise OutputError(f"{path}: is open in another program: close it there") from None
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS):
            raise OutputError(f"{path}: cannot be copied: {one_line(error)}") from None
        raise FormatError(f"{path}: is truncated or damaged: {one_line(error)}") from None
    except Exception as error:
        raise FormatError(f"{path}: is truncated or damaged: {one_line(error)}") from None
    finally:
        with suppress(OSError):
            temporary.unlink()


def _is_whole(columns: Mapping[str, h5py.Dataset]) -> bool:
    """Whether all columns have as many rows, every chunk is there, and the last can be read."""
    if len({len(column) for column in columns.values()}) > 1:
        return False
    try:
        for column in columns.values():
            step = _step(column)
            starts = range(0, len(column), step)
            if column.id.get_num_chunks() != len(starts):
                return False
            for start in starts[-2:]:
                column[start : start + step]
    except (OSError, RuntimeError, ValueError):
        return False
    return True


def _copy_whole(file: h5py.File, copy: h5py.File) -> None:
    """Copy attributes and arrays, and the leading rows that every column of a group has whole."""
    copy.attrs.update(file.attrs)
    for name in ("probe", *STATIC, *LAYOUT):
        if name not in file:
            continue
        source, target = file.require_group(name), copy.require_group(name)
        target.attrs.update(source.attrs)
        if name not in LAYOUT:
            for key, member in source.items():
                if member.nbytes > _LARGEST_ARRAY:
                    raise ValueError(f"{member.name} claims {member.nbytes} bytes")
                target.create_dataset(key, data=member[()]).attrs.update(member.attrs)
            continue
        columns = _columns(file, name)
        rows = min((_whole_rows(column) for column in columns.values()), default=0)
        for key, column in columns.items():
            made = target.create_dataset(
                key,
                shape=(rows, *column.shape[1:]),
                maxshape=column.maxshape,
                dtype=column.dtype,
                chunks=column.chunks,
                fletcher32=True,
            )
            made.attrs["units"] = LAYOUT[name][key].unit
            step = _step(column)
            for start in range(0, rows, step):
                stop = min(start + step, rows)
                made[start:stop] = column[start:stop]


def _step(column: h5py.Dataset) -> int:
    return (column.chunks or (1,))[0]


def _whole_rows(column: h5py.Dataset) -> int:
    """How many leading rows are in the file, and can be read."""
    step, tail = _step(column), (0,) * (column.ndim - 1)
    for start in range(0, len(column), step):
        try:
            # Rows of a chunk that is not in the file would be read as zeros.
            column.id.read_direct_chunk((start, *tail))
            column[start : start + step]
        except (OSError, RuntimeError, ValueError):
            return start
    return len(column)


def _fitting(name: str, key: str, values: np.ndarray, dataset: h5py.Dataset) -> np.ndarray:
    if key == "frames" and (values.shape[1:], values.dtype) != (dataset.shape[1:], dataset.dtype):
        raise FormatError(
            f"an ultrasound frame of {_frame_words(values)} does not fit this recording, whose "
            f"frames have {_frame_words(dataset)}: set the machine as before"
        )
    if values.shape[1:] != dataset.shape[1:]:
        raise FormatError(
            f"/{name}/{key}: a row of shape {values.shape[1:]} does not fit {dataset.shape[1:]}"
        )
    return values.astype(dataset.dtype)


def _frame_words(frames: np.ndarray | h5py.Dataset) -> str:
    _, rows, columns = frames.shape
    return f"{columns} x {rows} px of {frames.dtype}"


def _plain(value: object) -> Any:
    return np.asarray(value, dtype=np.float64) if isinstance(value, list | tuple) else value
