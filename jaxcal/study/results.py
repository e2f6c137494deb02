"""All results of a study as one labelled xarray dataset."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal import FormatError, MissingExtraError
from jaxcal.result.calibration import Status
from jaxcal.study.interface import Chunk
from jaxcal.study.pipeline import COMPONENTS, bound_mm
from jaxcal.study.spec import UNITS, Spec
from jaxcal.study.store import Store

if TYPE_CHECKING:
    import xarray

MISSING = -1
"""Status and iterations of trials that were not computed yet."""


def open_results(folder: str | os.PathLike[str], *, incomplete: bool = False) -> xarray.Dataset:
    """Read a study that a TOML file described (:class:`jaxcal.study.Spec`).

    Args:
        folder: of the study.
        incomplete: whether chunks may be missing; their trials are NaN, with status -1.

    Returns:
        A dataset in memory. Dimensions: one for every field of ``[conditions]`` that the spec gives
        as a list (the other fields are scalar coordinates), ``method``, ``trial``, ``component``.
        Variables: ``rp`` (Eq. 8, mm); ``rotation_error`` (rad), ``translation_error`` and
        ``point_error`` (mm) against the truth; ``sigma`` (mm, estimated); ``realised`` (mm, the
        root mean square errors that were drawn); ``status`` (:class:`jaxcal.Status`);
        ``iterations``; and ``bound`` (mm, what the method was told; NaN for none).

    Raises:
        MissingExtraError: xarray is not installed.
        FormatError: no such study, a damaged file, or (unless allowed) a missing one.
    """
    try:
        import xarray
    except ImportError:
        raise MissingExtraError("open_results needs xarray: pip install 'jaxcal[study]'") from None

    store = Store.open(folder)
    spec, values = store.spec, read_all(store, incomplete=incomplete)
    lengths = [len(spec.axis(name)) for name in spec.listed]
    dimensions: dict[str, tuple[str, ...]] = dict.fromkeys(UNITS, ("method", "trial"))
    dimensions |= {"sigma": ("method", "trial", "component"), "realised": ("trial", "component")}
    variables: dict[str, Any] = {}
    for name, array in values.items():
        shaped = array.reshape(*lengths, *array.shape[1:])
        variables[name] = ((*spec.listed, *dimensions[name]), shaped, {"units": UNITS[name]})
    variables["status"][2]["meaning"] = ", ".join(f"{s.value} {s.name.lower()}" for s in Status)
    bounds = np.array([[bound_mm(m, c) for m in spec.methods] for c in spec.conditions()])
    bounds = bounds.reshape(*lengths, len(spec.methods))
    variables["bound"] = ((*spec.listed, "method"), bounds, {"units": "mm"})
    coordinates: dict[str, Any] = {
        name: list(choices) if name in spec.listed else choices[0] for name, choices in spec.axes
    }
    coordinates |= {
        "method": [method.name for method in spec.methods],
        "trial": np.arange(spec.trials),
        "component": list(COMPONENTS),
    }
    attributes = {"study": spec.name, "spec": spec.canonical(), "spec_sha256": spec.sha256}
    return xarray.Dataset(variables, coordinates, attributes)


def read_all(store: Store[Spec], *, incomplete: bool = False) -> dict[str, np.ndarray]:
    """Every array of a study with the conditions (in counting order) as its first axis.

    Raises:
        FormatError: a damaged file, or (unless allowed) a missing one.
    """
    spec, present = store.spec, store.present()
    if len(present) < spec.chunk_count and not incomplete:
        raise FormatError(
            f"{store.folder}: {spec.chunk_count - len(present)} of {spec.chunk_count} chunks are "
            "missing: finish it with 'jaxcal study run ... --resume'"
        )
    whole = spec.arrays(Chunk(0, 0, 0, spec.trials))
    empty = {"status": np.int8(MISSING), "iterations": np.int32(MISSING)}
    values = {
        name: np.full((spec.condition_count, *array.shape), empty.get(name, np.nan))
        for name, array in whole.items()
    }
    for index in present:
        chunk = spec.chunk(index)
        part = slice(chunk.start, chunk.stop)
        for name, array in store.read_done(chunk).items():
            of_condition = values[name][chunk.condition]
            of_condition[part if name == "realised" else (slice(None), part)] = array
    return values
