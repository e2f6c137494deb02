"""Monte-Carlo studies: a grid of conditions x methods x trials, computed in resumable chunks.

spec.py      what is to be computed, from a TOML file
interface.py what the engine needs of a study, for studies of a caller's own
pipeline.py  one chunk: draw, segment, solve by every method, compare with the truth
trials.py    the computation of its trials, as far as their results are stored
store.py     one HDF5 file per chunk; what is there, what is missing
run.py       the missing chunks, here or on a cluster (cluster.py)
results.py   everything as one labelled xarray dataset
show.py      tables: means, confidence intervals, failures, paired differences
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxcal.study.interface import ArraySpec as ArraySpec
    from jaxcal.study.interface import Chunk as Chunk
    from jaxcal.study.interface import Study as Study
    from jaxcal.study.results import open_results as open_results
    from jaxcal.study.run import run_study as run_study
    from jaxcal.study.spec import Spec as Spec
    from jaxcal.study.spec import load_spec as load_spec

_HOME = {
    "ArraySpec": "jaxcal.study.interface",
    "Chunk": "jaxcal.study.interface",
    "Spec": "jaxcal.study.spec",
    "Study": "jaxcal.study.interface",
    "load_spec": "jaxcal.study.spec",
    "open_results": "jaxcal.study.results",
    "run_study": "jaxcal.study.run",
}

__all__ = [*_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'jaxcal.study' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return [*_HOME]
