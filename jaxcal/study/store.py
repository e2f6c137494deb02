"""The folder of a study: its spec, and one HDF5 file for each chunk that is done.

    DIR/spec.json                 the canonical spec (jaxcal.study.spec.Spec.canonical)
    DIR/chunks/chunk-000000.h5    attrs format="jaxcal-study-chunk", version, spec_sha256, chunk,
                                  condition, trial_start, trial_stop, index_start, index_stop,
                                  checksum, jaxcal, jax, device
        rp, rotation_error, translation_error, point_error   (methods, trials) float64 [mm, rad]
        sigma                     (methods, trials, 3) [mm]
        status, iterations        (methods, trials) integers
        realised                  (trials, 3) [mm]

A file has its name only when it is complete. It is believed only when it belongs to the spec and
its checksum (SHA-256 of the arrays' bytes) is right, and is computed again otherwise. Files hold no
times of day: the same chunk computed twice on one machine is the same file, byte by byte.
"""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np

import jaxcal
from jaxcal import FormatError, InputError, OutputError
from jaxcal.io.atomic import atomic_path, write_text
from jaxcal.io.readable import check_readable, one_line
from jaxcal.io.untrusted import array, child, number, open_root, text
from jaxcal.study.spec import MAXIMUM_BYTES, Chunk, Spec, spec_from_canonical

FORMAT = "jaxcal-study-chunk"
VERSION = 1

UNITS = {
    "rp": "mm",
    "rotation_error": "rad",
    "translation_error": "mm",
    "point_error": "mm",
    "sigma": "mm",
    "realised": "mm",
    "status": "1",
    "iterations": "1",
}
"""Of every array of a chunk."""


class Store:
    """The files of one study.

    Attributes:
        folder: of the study.
        spec: what it computes.
    """

    def __init__(self, folder: str | os.PathLike[str], spec: Spec) -> None:
        self.folder = Path(folder)
        self.spec = spec

    @classmethod
    def create(cls, folder: str | os.PathLike[str], spec: Spec, *, resume: bool) -> Store:
        """Make the folder of a study, or take up one that is there.

        Args:
            folder: made if need be, with its parents.
            spec: the study.
            resume: whether a study that is there may be continued.

        Raises:
            InputError: another study is there, or this one and ``resume`` is false.
            OutputError: the folder cannot be made or written to. Nothing was written then.
        """
        store = cls(folder, spec)
        if store._spec_path.exists():
            found = read_spec(folder)
            if found.sha256 != spec.sha256:
                raise InputError(
                    f"{folder}: holds the results of another spec (it differs in "
                    f"{_difference(found, spec)}): choose another folder, or go back to that spec"
                )
            if not resume:
                raise InputError(f"{folder}: holds this study already: --resume continues it")
            store._make_folder()
            return store
        if any(store.folder.glob("chunks/chunk-*.h5")):
            raise InputError(f"{folder}: holds results but no spec.json: choose another folder")
        store._make_folder()
        write_text(store._spec_path, spec.canonical() + "\n")
        return store

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Store:
        """The study in a folder, for reading.

        Raises:
            FormatError: there is none.
        """
        return cls(folder, read_spec(folder))

    def path(self, chunk: Chunk) -> Path:
        """The file of a chunk."""
        return self.folder / "chunks" / f"chunk-{chunk.index:06d}.h5"

    def present(self) -> list[int]:
        """Indices of the chunks that have a file, in order; whether they are sound is not asked."""
        folder = self.folder / "chunks"
        try:
            names = os.listdir(folder)
        except FileNotFoundError:
            return []
        except OSError as error:
            raise FormatError(f"{folder}: cannot be read: {one_line(error)}") from None
        found = [re.fullmatch(r"chunk-(\d{6,7})\.h5", name) for name in names]
        indices = {int(match[1]) for match in found if match}
        return sorted(index for index in indices if index < self.spec.chunk_count)

    def write(self, chunk: Chunk, results: dict[str, np.ndarray], device: str) -> None:
        """Write the file of a chunk, whole or not at all.

        Args:
            chunk: which.
            results: of :func:`jaxcal.study.pipeline.compute_chunk`.
            device: what computed it.

        Raises:
            OutputError: the disk is full, the folder not writable.
        """
        import jax

        path = self.path(chunk)
        start = chunk.condition * self.spec.trials
        # JAX may have been told to run in 32 bits; the file's types do not depend on it.
        results = {
            name: values.astype(np.float64, copy=False) if values.dtype.kind == "f" else values
            for name, values in results.items()
        }
        with atomic_path(path) as temporary:
            # HDF5 only meets a full disk when it closes the file, and then loses the reason; a
            # file in memory that is written in one go says it.
            image = _pack(
                results,
                {
                    "format": FORMAT,
                    "version": VERSION,
                    "spec_sha256": self.spec.sha256,
                    "chunk": chunk.index,
                    "condition": chunk.condition,
                    "trial_start": chunk.start,
                    "trial_stop": chunk.stop,
                    "index_start": start + chunk.start,
                    "index_stop": start + chunk.stop,
                    "checksum": _checksum(results),
                    "jaxcal": jaxcal.__version__,
                    "jax": jax.__version__,
                    "device": device,
                },
            )
            with temporary.open("wb") as stream:
                stream.write(image)

    def read(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """The arrays of a chunk, checked; the file is not trusted.

        Raises:
            FormatError: missing, damaged, of another study: one line that starts with its path.
        """
        path = self.path(chunk)
        check_readable(path)
        try:
            return self._read(path, chunk)
        except FormatError as error:
            raise FormatError(f"{path}: {error}") from None

    def versions(self, chunk: Chunk) -> str:
        """What computed a chunk: versions and device, in words."""
        with open_root(self.path(chunk)) as root:
            parts = [text(root, name) or "?" for name in ("jaxcal", "jax", "device")]
        return f"jaxcal {parts[0]}, jax {parts[1]}, {parts[2]}"

    def _read(self, path: Path, chunk: Chunk) -> dict[str, np.ndarray]:
        with open_root(path) as root:
            if text(root, "format") != FORMAT or number(root, "version") != VERSION:
                raise FormatError(f"is not a {FORMAT} of version {VERSION}")
            if text(root, "spec_sha256") != self.spec.sha256:
                raise FormatError("belongs to another spec")
            agreed = {
                "chunk": chunk.index, "condition": chunk.condition,
                "trial_start": chunk.start, "trial_stop": chunk.stop,
            }  # fmt: skip
            for name, value in agreed.items():
                if number(root, name) != value:
                    raise FormatError(f"its {name} is not {value}")
            checksum = text(root, "checksum")
            methods, trials = len(self.spec.methods), chunk.stop - chunk.start
            results = {}
            for name in UNITS:
                node = child(root, name)
                if node is None:
                    raise FormatError(f"has no {name}")
                shape = (methods, trials)
                if name in ("sigma", "realised"):
                    shape = (methods, trials, 3) if name == "sigma" else (trials, 3)
                kinds = "i" if name in ("status", "iterations") else "f"
                results[name] = array(node, shape, kinds)
        if checksum != _checksum(results):
            raise FormatError("is damaged: its checksum is wrong")
        return results

    @property
    def _spec_path(self) -> Path:
        return self.folder / "spec.json"

    def _make_folder(self) -> None:
        chunks = self.folder / "chunks"
        made: list[Path] = []
        try:
            for place in (*reversed(self.folder.parents), self.folder, chunks):
                if not place.exists():
                    place.mkdir(exist_ok=True)
                    made.append(place)
            for place in (self.folder, chunks):
                with tempfile.TemporaryFile(dir=place):
                    pass
        except (OSError, ValueError) as error:
            for place in reversed(made):
                with suppress(OSError):
                    place.rmdir()
            raise OutputError(
                f"{self.folder}: cannot be made or written to: {one_line(error)}"
            ) from error

    def sweep(self) -> None:
        """Remove what a killed process had begun to write."""
        for place in (self.folder, self.folder / "chunks"):
            for left in place.glob(".partial-*"):
                with suppress(OSError):
                    left.unlink()


def read_spec(folder: str | os.PathLike[str]) -> Spec:
    """The spec of the study in a folder.

    Raises:
        FormatError: there is none, or it is damaged.
    """
    path = Path(folder) / "spec.json"
    if not Path(folder).is_dir():
        raise FormatError(f"{folder}: no such folder")
    if not path.exists():
        raise FormatError(f"{folder}: holds no study (no spec.json)")
    check_readable(path, maximum_bytes=8 * MAXIMUM_BYTES)
    try:
        return spec_from_canonical(path.read_text(encoding="utf-8").strip())
    except (InputError, UnicodeDecodeError):
        raise FormatError(f"{path}: is damaged, or of another version of jaxcal") from None


def _pack(results: dict[str, np.ndarray], attributes: dict[str, str | int]) -> bytes:
    # track_order and times would make two files of the same content differ.
    with h5py.File.in_memory() as file:
        file.attrs.update(attributes)
        for name, unit in UNITS.items():
            dataset = file.create_dataset(name, data=results[name], track_times=False)
            dataset.attrs["units"] = unit
        file.flush()
        return file.id.get_file_image()


def _checksum(results: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in UNITS:
        values = np.ascontiguousarray(results[name])
        values = values.astype(values.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def _difference(found: Spec, wanted: Spec) -> str:
    """Which parts of two specs differ, in words."""
    names = ("name", "seed", "trials", "chunk_trials", "probe")
    parts = [name for name in names if getattr(found, name) != getattr(wanted, name)]
    parts += [name for name, values in found.axes if wanted.axis(name) != values]
    parts += ["methods"] if found.methods != wanted.methods else []
    return ", ".join(parts) or "which conditions are lists"
