"""The folder of a study: its spec, and one HDF5 file for each chunk that is done.

    DIR/spec.json                 the canonical spec (jaxcal.study.spec.Spec.canonical)
    DIR/chunks/chunk-000000.h5    attrs format="jaxcal-study-chunk", version, spec_sha256, chunk,
                                  condition, trial_start, trial_stop, index_start, index_stop,
                                  checksum, jaxcal, jax, device
        rp, rotation_error, translation_error, point_error   (methods, trials) float64 [mm, rad]
        sigma                     (methods, trials, 3) [mm]
        status, iterations        (methods, trials) integers
        realised                  (trials, 3) [mm]

A file gets its name only when it is complete. It is accepted only if it belongs to the spec and its
checksum (SHA-256 of the arrays' bytes) is right; otherwise it is computed again. Files hold no
times of day: the same chunk computed twice on one machine is the same file, byte by byte.
"""

from __future__ import annotations

import hashlib
import os
import re
from contextlib import suppress
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

import h5py
import numpy as np

from jaxcal import FormatError, InputError, MissingFileError
from jaxcal.io.atomic import made_folder, write_bytes, write_text
from jaxcal.io.given_files import check_readable, naming, one_line, path_name
from jaxcal.io.toml import MAXIMUM_BYTES
from jaxcal.io.untrusted import array, child, number, open_root, text
from jaxcal.study.interface import Chunk, Study
from jaxcal.study.spec import Spec

FORMAT = "jaxcal-study-chunk"
VERSION = 1

_MAKER = ("jaxcal", "jax", "device")
"""Attributes that say what computed a file."""


S = TypeVar("S", bound=Study)


class Store(Generic[S]):
    """The files of one study.

    Attributes:
        folder: of the study.
        spec: what it computes.
    """

    def __init__(self, folder: str | os.PathLike[str], spec: S) -> None:
        self.folder = Path(path_name(folder))
        self.spec = spec

    def prepare(self, *, resume: bool) -> None:
        """Make the folder of a study with its parents, if need be.

        Args:
            resume: whether an existing study may be continued.

        Raises:
            InputError: the folder holds another study, or this one while ``resume`` is false.
            OutputError: the folder cannot be made or written to. Nothing was written then.
        """
        begun = self._is_continued(resume)
        with made_folder(self.folder), made_folder(self.folder / "chunks"):
            pass
        if not begun and self.present():
            raise InputError(
                f"{self.folder}: holds results but no spec.json: choose another folder"
            )

    def begin(self, *, resume: bool) -> None:
        """Write the spec of a study that is not there yet; raises what :meth:`prepare` does.

        Other processes must be locked out: two that begin at once would replace each other's spec.
        """
        if not self._is_continued(resume):
            write_text(self._spec_path, self.spec.canonical() + "\n")

    def _is_continued(self, resume: bool) -> bool:
        if not self.is_begun():
            return False
        found = read_spec(self.folder, type(self.spec))
        if found.sha256 != self.spec.sha256:
            raise InputError(
                f"{self.folder}: holds the results of another spec (it differs in "
                f"{_difference(found, self.spec)}): choose another folder, or go back to that spec"
            )
        if not resume:
            raise InputError(
                f"{self.folder}: holds this study already: --resume continues it "
                "(in Python resume=True)"
            )
        return True

    @staticmethod
    def open(folder: str | os.PathLike[str]) -> Store[Spec]:
        """The study in a folder, for reading.

        Raises:
            FormatError: there is none.
        """
        return Store(folder, read_spec(folder))

    def is_begun(self) -> bool:
        """Whether the folder holds a study."""
        # Not Path.exists, which fails where a folder above may not be looked into.
        return os.path.exists(self._spec_path)

    def path(self, chunk: Chunk) -> Path:
        """The file of a chunk."""
        return self.folder / "chunks" / f"chunk-{chunk.index:06d}.h5"

    def present(self) -> list[int]:
        """Indices of the chunks that have a file, in order; their content is not checked."""
        folder = self.folder / "chunks"
        try:
            names = os.listdir(folder)
        except FileNotFoundError:
            return []
        except (OSError, ValueError) as error:
            raise FormatError(f"{folder}: cannot be read: {one_line(error)}") from None
        found = [re.fullmatch(r"chunk-(\d{6,7})\.h5", name) for name in names]
        indices = {int(match[1]) for match in found if match}
        return sorted(index for index in indices if index < self.spec.chunk_count)

    def write(self, chunk: Chunk, results: dict[str, np.ndarray], maker: dict[str, str]) -> None:
        """Write the file of a chunk, whole or not at all.

        Args:
            chunk: which.
            results: of :func:`jaxcal.study.interface.computed`.
            maker: what computed it, as :func:`jaxcal.study.interface.made_by` says it.

        Raises:
            OutputError: the disk is full, the folder not writable.
        """
        start = chunk.condition * self.spec.trials
        units = {name: wanted.unit for name, wanted in self.spec.arrays(chunk).items()}
        results = {name: results[name] for name in units}
        attributes = {
            "format": FORMAT,
            "version": VERSION,
            "spec_sha256": self.spec.sha256,
            **_place(chunk),
            "index_start": start + chunk.start,
            "index_stop": start + chunk.stop,
            "checksum": _checksum(results),
            **maker,
        }
        # HDF5 notices a full disk only when it closes the file, and then loses the reason. A file
        # that is made in memory and written in one go reports it.
        write_bytes(self.path(chunk), _pack(results, attributes, units))

    def read(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """The arrays of a chunk, checked; the file is not trusted.

        Raises:
            FormatError: missing, damaged, of another study: one line that starts with its path.
        """
        path = self.path(chunk)
        check_readable(path)
        with naming(path), open_root(path) as root:
            if text(root, "format") != FORMAT or number(root, "version") != VERSION:
                raise FormatError(f"is not a {FORMAT} of version {VERSION}")
            if text(root, "spec_sha256") != self.spec.sha256:
                raise FormatError("belongs to another spec")
            for name, value in _place(chunk).items():
                if number(root, name) != value:
                    raise FormatError(f"its {name} is not {value}")
            results = {}
            for name, wanted in self.spec.arrays(chunk).items():
                node = child(root, name)
                if node is None:
                    raise FormatError(f"has no {name}")
                results[name] = array(node, wanted.shape, wanted.kind)
            if text(root, "checksum") != _checksum(results):
                raise FormatError("is damaged: its checksum is wrong")
            return results

    def read_done(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """As :meth:`read`, of a chunk that is taken for done; the error says what helps."""
        try:
            return self.read(chunk)
        except FormatError as error:
            raise FormatError(
                f"{error}; 'jaxcal study run ... --resume' computes it again"
            ) from error

    def versions(self, chunk: Chunk) -> str:
        """What computed a chunk: versions and device, in words."""
        with open_root(self.path(chunk)) as root:
            return versions_in_words({name: text(root, name) or "?" for name in _MAKER})

    @property
    def _spec_path(self) -> Path:
        return self.folder / "spec.json"

    def sweep(self) -> None:
        """Remove what a killed process had begun to write."""
        for place in (self.folder, self.folder / "chunks"):
            for left in place.glob(".partial-*"):
                with suppress(OSError):
                    left.unlink()


@overload
def read_spec(folder: str | os.PathLike[str]) -> Spec: ...
@overload
def read_spec(folder: str | os.PathLike[str], kind: type[Study]) -> Study: ...
def read_spec(folder: str | os.PathLike[str], kind: type[Any] = Spec) -> Any:
    """The spec of the study in a folder.

    Args:
        folder: of the study.
        kind: its class.

    Raises:
        FormatError: there is none, it is damaged, or of another class.
    """
    path = Path(path_name(folder)) / "spec.json"
    if not os.path.isdir(folder):
        raise MissingFileError(f"{folder}: no such folder")
    if not os.path.exists(path):
        raise FormatError(f"{folder}: holds no study (no spec.json)")
    check_readable(path, maximum_bytes=8 * MAXIMUM_BYTES)
    try:
        return kind.from_canonical(path.read_text(encoding="utf-8").strip())
    except (InputError, UnicodeDecodeError):
        raise FormatError(
            f"{path}: is no {kind.__name__}: damaged, of another version of jaxcal, or a study of "
            "another class"
        ) from None


def versions_in_words(maker: dict[str, str]) -> str:
    """What computed a chunk (:func:`jaxcal.study.interface.made_by`), in words."""
    jaxcal, jax, device = (maker[name] for name in _MAKER)
    return f"jaxcal {jaxcal}, jax {jax}, {device}"


def _place(chunk: Chunk) -> dict[str, int]:
    """The attributes that say which trials a file has."""
    return {
        "chunk": chunk.index,
        "condition": chunk.condition,
        "trial_start": chunk.start,
        "trial_stop": chunk.stop,
    }


def _pack(
    results: dict[str, np.ndarray], attributes: dict[str, str | int], units: dict[str, str]
) -> bytes:
    # track_order and times would make two files of the same content differ.
    with h5py.File.in_memory() as file:
        file.attrs.update(attributes)
        for name, unit in units.items():
            dataset = file.create_dataset(name, data=results[name], track_times=False)
            dataset.attrs["units"] = unit
        file.flush()
        return file.id.get_file_image()


def _checksum(results: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in results:
        values = np.asarray(results[name], order="C")
        values = values.astype(values.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def _difference(found: Study, wanted: Study) -> str:
    """Which parts of two specs differ, in words."""
    if not (isinstance(found, Spec) and isinstance(wanted, Spec)):
        return "its description"
    names = ("name", "seed", "trials", "chunk_trials", "probe")
    parts = [name for name in names if getattr(found, name) != getattr(wanted, name)]
    parts += [name for name, values in found.axes if wanted.axis(name) != values]
    parts += ["methods"] if found.methods != wanted.methods else []
    return ", ".join(parts) or "which conditions are lists"
