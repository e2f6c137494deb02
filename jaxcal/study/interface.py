"""The interface between a study and the engine, and how workers find the class of a study.

:class:`jaxcal.study.spec.Spec` is the study that a TOML file describes. Any other class with the
same few members runs through the same engine: in chunks that are resumed, in this process, on
workers or on a Dask cluster.

A worker is told the class by module and name and imports it. A module that belongs to no installed
package (a file beside a script, say) is looked for in the folder where this process found it, and
nowhere else. A Dask worker on another machine must have that folder, too.
"""

from __future__ import annotations

import importlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from jaxcal import InputError, __version__


@dataclass(frozen=True)
class Chunk:
    """Trials ``start`` to ``stop`` (exclusive) of one condition; ``index`` names the file."""

    index: int
    condition: int
    start: int
    stop: int


@dataclass(frozen=True)
class ArraySpec:
    """One array of a chunk's results.

    Attributes:
        unit: of its numbers, ``1`` for none.
        shape: all axes.
        kind: ``f`` for floats, ``i`` for integers and truth values.
    """

    unit: str
    shape: tuple[int, ...]
    kind: Literal["f", "i"] = "f"


@runtime_checkable
class Study(Protocol):
    """What the engine needs of a study; results of a chunk depend on nothing but the study."""

    @property
    def trials(self) -> int:
        """Trials in each condition."""
        ...

    @property
    def condition_count(self) -> int:
        """Number of conditions."""
        ...

    @property
    def chunk_count(self) -> int:
        """Number of chunks, each of which is a file."""
        ...

    @property
    def sha256(self) -> str:
        """Hash of :meth:`canonical`."""
        ...

    def canonical(self) -> str:
        """Everything about the study as one JSON text."""
        ...

    @classmethod
    def from_canonical(cls, text: str) -> Study:
        """The study that the text was made from.

        Raises:
            InputError: the text was not made by :meth:`canonical`.
        """
        ...

    def chunk(self, index: int) -> Chunk:
        """The trials of file ``index``."""
        ...

    def arrays(self, chunk: Chunk) -> dict[str, ArraySpec]:
        """What a chunk's file holds."""
        ...

    def compute(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """The arrays of a chunk."""
        ...


def where_defined(study: Study) -> dict[str, str]:
    """How a worker finds the class of a study: module, name and, of a loose module, its folder.

    Raises:
        InputError: a class of the main script, or one inside a function.
    """
    kind = type(study)
    if kind.__module__ == "__main__":
        raise InputError(
            f"workers cannot import {kind.__qualname__}, which is defined in the script that runs: "
            "put it into a module of its own, and import it"
        )
    if "." in kind.__qualname__:
        raise InputError(
            f"workers cannot import {kind.__qualname__}: define it at the top level of its module"
        )
    found = {"module": kind.__module__, "name": kind.__name__}
    if "." not in kind.__module__:
        file = getattr(sys.modules[kind.__module__], "__file__", None)
        if file is not None:
            found["folder"] = str(Path(file).resolve().parent)
    return found


def study_from(where: dict[str, str], canonical: str) -> Study:
    """The study with this canonical text, of the class that :func:`where_defined` describes.

    Raises:
        InputError: there is no such class, or the text is not of it.
    """
    folder = where.get("folder")
    if folder is not None and folder not in sys.path:
        # At the end, so that it shadows nothing that is installed.
        sys.path.append(folder)
    try:
        kind = getattr(importlib.import_module(where["module"]), where["name"])
    except (ImportError, AttributeError, KeyError) as error:
        raise InputError(f"the study's class cannot be imported: {error}") from None
    return kind.from_canonical(canonical)


Results = tuple[dict[str, np.ndarray], dict[str, str]]
"""The arrays of a chunk, and what computed them."""


def computed(study: Study, chunk: Chunk) -> Results:
    """What a study computes of a chunk, checked: a file of anything else could not be read.

    Raises:
        InputError: it is not what the study says that a chunk holds.
    """
    results, wanted = study.compute(chunk), study.arrays(chunk)
    arrays = {name: _as_wanted(name, results.get(name), wanted[name]) for name in wanted}
    return arrays, made_by()


def made_by() -> dict[str, str]:
    """What computes in this process: versions, and the device in words."""
    import jax

    devices = jax.local_devices()
    return {
        "jaxcal": __version__,
        "jax": jax.__version__,
        "device": f"{len(devices)} x {devices[0].platform} {devices[0].device_kind}",
    }


def _as_wanted(name: str, values: object, wanted: ArraySpec) -> np.ndarray:
    found = np.asarray(values)
    if wanted.kind == "f" and found.dtype.kind in "iuf":
        # JAX may have been told to run in 32 bits; the file's types do not depend on it.
        found = found.astype(np.float64, copy=False)
    elif wanted.kind == "i" and found.dtype.kind in "bu" and np.can_cast(found.dtype, np.int64):
        found = found.astype(np.int64)
    if found.dtype.kind != wanted.kind or found.shape != wanted.shape:
        has = "is missing" if values is None else f"is {found.dtype} {found.shape}"
        raise InputError(
            f"{name} {has} in what the study's compute returned; its arrays say "
            f"{'floats' if wanted.kind == 'f' else 'integers'} {wanted.shape}"
        )
    return found
