"""What a study computes: a TOML file, checked field by field.

    name = "paper_tables"     # letters, digits, - and _
    seed = 20261121           # of all draws, 0 to 2^63 - 1
    trials = 400              # simulated experiments in each condition
    chunk_trials = 512        # trials in one file; at most those are lost by an interruption

    [conditions]              # a number, or a list of numbers: an axis of the grid
    images = 50               # calibration images
    test_images = 50          # noise-free in-plane test images
    elevation_mm = [0.5, 1]   # size of the elevational offsets: bound or SD (jaxcal.study.offsets)
    elevation_distribution = "uniform"  # or another of jaxcal.study.offsets; or a list
    noise_mm = [0, 2]         # SD of the noise on every element's distance
    lateral_mm = 29.25        # the target's lateral position is uniform within +- this
    depth_min_mm = 10         # its depth is uniform between this
    depth_max_mm = 90         # and this
    rotation_deg = 30         # largest rotation of the probe, about a random axis
    test_fraction = 0.75      # test positions cover this fraction of the field
    tracker_mm = 0            # SD of the tracked position, each axis
    tracker_deg = 0           # SD of the tracked rotation, about each axis

    [probe]                   # a linear array
    elements = 128
    pitch_mm = 0.45703125

    [[methods]]               # one table for each; names are unique
    name = "alternation, 1 mm"
    method = "alternating"    # or conventional, joint
    prior = "auto"            # of joint: auto, gaussian, uniform (self-tuned) or bounded
    max_elevation_mm = 1      # bound on the offsets (jaxcal.calibrate's max_elevation); or
    max_elevation_factor = 1  # ... this times the true bound (jaxcal.study.offsets.nominal_bound)
    tolerance_rad = 1e-3      # alternating: stop when X turns by less in a round
    tolerance_mm = 0.1        # ... and its origin moves by less
    max_rounds = 1000         # alternating: most rounds
    inner_steps = 2           # alternating: Gauss-Newton steps in a round
    max_iterations = 100      # of the other solvers

Everything but ``name``, ``seed``, ``trials`` and the methods' ``name`` and ``method`` has a default
(:class:`Condition`, :class:`MethodSpec`). A field that is not listed is refused. The unit of a
number is in its name, nowhere else. Two files that say the same, in another order or with the
defaults left out, are one spec: the same hash, the same study.

Trial t of condition c is drawn from ``fold_in(key(seed), c * trials + t)`` whatever the chunks,
workers and devices; conditions are counted with the last listed axis of :data:`AXES` fastest.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import math
import os
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.calibration.calibrate import ALTERNATION, Request, check_alternation, check_request
from jaxcal.data.probe import LinearProbe
from jaxcal.data.recording import MINIMUM_IMAGES, MOST_IMAGES
from jaxcal.io.given_files import naming
from jaxcal.io.toml import load_toml, parse_toml
from jaxcal.runtime.given_values import LARGEST_SEED, whole_number
from jaxcal.runtime.messages import quoted, shown
from jaxcal.solvers.names import Method, PriorName
from jaxcal.solvers.plan import DEFAULT_MAX_ELEVATION_MM, Options, Prior
from jaxcal.study.interface import ArraySpec, Chunk
from jaxcal.study.laws import LawName, check_law

MAXIMUM_EXPERIMENTS = 2**32
"""Conditions times trials: fold_in takes 32 bits."""

MAXIMUM_CHUNKS = 10**6
MAXIMUM_CONDITIONS = 10**5
MAXIMUM_METHODS = 100
MAXIMUM_DISTANCES = 2**22
"""Images times elements of one experiment: 64 of them take 2 GiB."""

MAXIMUM_CHUNK = 2**24
"""Trials times methods of one chunk, whose results are held at once."""

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
"""Unit of every array of a chunk."""

_HEAD = ("name", "seed", "trials", "chunk_trials")
_COUNTS = {"images": (MINIMUM_IMAGES, MOST_IMAGES), "test_images": (2, MOST_IMAGES)}
_LARGEST = {"rotation_deg": 180.0, "test_fraction": 10.0, "tracker_deg": 57.0}
_LARGEST_MM = 1000.0
"""Of every number of ``[conditions]`` that is in mm; the least is 0."""
_UNITS = ("_mm", "_deg", "_rad")
_FLOATS = ("max_elevation_mm", "max_elevation_factor", "tolerance_rad", "tolerance_mm")


@dataclass(frozen=True)
class Condition:
    """One cell of the grid; the fields are those of ``[conditions]``, each with one value.

    Their order is that in which the grid is counted, the last fastest.
    """

    elevation_distribution: LawName = "uniform"
    images: int = 50
    test_images: int = 50
    test_fraction: float = 0.75
    lateral_mm: float = 29.25
    depth_min_mm: float = 10.0
    depth_max_mm: float = 90.0
    rotation_deg: float = 30.0
    tracker_mm: float = 0.0
    tracker_deg: float = 0.0
    elevation_mm: float = 1.0
    noise_mm: float = 0.5


AXES = tuple(field.name for field in fields(Condition))


@dataclass(frozen=True)
class MethodSpec:
    """One method and its options.

    Attributes:
        name: how results call it.
        method: ``conventional``, ``alternating`` or ``joint``.
        prior: of the joint method: ``auto``, ``gaussian``, ``uniform`` or ``bounded``.
        max_elevation_mm: bound on |y|, where :func:`jaxcal.calibrate` takes one; None if there is
            none or if ``max_elevation_factor`` gives it. In a file without either it is the paper's
            1 mm for alternating and bounded.
        max_elevation_factor: the bound as a multiple of the true one.
        tolerance_rad: see :class:`jaxcal.Options`.
        tolerance_mm: see :class:`jaxcal.Options`.
        max_rounds: see :class:`jaxcal.Options`.
        inner_steps: see :class:`jaxcal.Options`.
        max_iterations: see :class:`jaxcal.Options`.
    """

    name: str
    method: Method
    prior: PriorName = "auto"
    max_elevation_mm: float | None = None
    max_elevation_factor: float | None = None
    tolerance_rad: float = Options.tolerance_rad
    tolerance_mm: float = Options.tolerance_mm
    max_rounds: int = Options.max_rounds
    inner_steps: int = Options.inner_steps
    max_iterations: int = Options.max_iterations

    def __post_init__(self) -> None:
        if None not in (self.max_elevation_mm, self.max_elevation_factor):
            raise InputError("max_elevation_mm and max_elevation_factor contradict each other")
        factor = self.max_elevation_factor
        if isinstance(factor, int | float) and not 0 < factor < np.inf:
            raise InputError(f"max_elevation_factor must be positive and finite, not {factor:g}")
        if np.ndim(self.bound_given or 0.0):
            raise InputError(f"max_elevation must be one number, not {shown(self.bound_given)}")
        self.assumed()

    @property
    def bound_given(self) -> float | None:
        """The bound, mm or as a multiple; None if there is none."""
        if self.max_elevation_mm is None:
            return self.max_elevation_factor
        return self.max_elevation_mm

    @property
    def options(self) -> Options:
        """The options of :func:`jaxcal.calibrate`."""
        names = (*ALTERNATION, "max_iterations")
        return Options(**{name: getattr(self, name) for name in names})

    def assumed(self) -> Prior:
        """What the method assumes about the offsets.

        Raises:
            InputError: what :func:`jaxcal.calibrate` refuses.
        """
        return check_request(
            Request(self.method, self.prior, self.bound_given, options=self.options)
        )


@dataclass(frozen=True)
class Spec:
    """A checked study.

    Attributes:
        name: of the study.
        seed: of all draws.
        trials: in each condition.
        chunk_trials: most trials in one file.
        axes: for every field of :data:`AXES`, its values.
        listed: names of the fields that were given as lists, which are the axes of the results; in
            the order of :data:`AXES`, whatever that of the file.
        probe: the transducer.
        methods: in the order of the file.
    """

    name: str
    seed: int
    trials: int
    chunk_trials: int
    axes: tuple[tuple[str, tuple[float | int | str, ...]], ...]
    listed: tuple[str, ...]
    probe: LinearProbe
    methods: tuple[MethodSpec, ...]

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and re.fullmatch(r"[A-Za-z0-9_-]{1,100}", self.name)):
            raise InputError("name must be 1 to 100 letters, digits, - and _")
        limits = {
            "seed": (0, LARGEST_SEED),
            "trials": (1, MAXIMUM_EXPERIMENTS),
            "chunk_trials": (1, 2**20),
        }
        for name, (least, most) in limits.items():
            object.__setattr__(self, name, whole_number(name, getattr(self, name), least, most))
        object.__setattr__(self, "chunk_trials", min(self.chunk_trials, self.trials))
        if not 1 <= len(self.methods) <= MAXIMUM_METHODS:
            raise InputError(f"there must be 1 to {MAXIMUM_METHODS} [[methods]]")
        if len({method.name for method in self.methods}) < len(self.methods):
            raise InputError("two [[methods]] have the same name")
        _check_size(self)

    def axis(self, name: str) -> tuple[float | int | str, ...]:
        """Values of one field of ``[conditions]``."""
        return dict(self.axes)[name]

    @property
    def condition_count(self) -> int:
        """Cells of the grid."""
        return math.prod(len(values) for _, values in self.axes)

    def condition(self, index: int) -> Condition:
        """Cell ``index`` of the grid, in counting order."""
        values: dict[str, Any] = {}
        for name, choices in reversed(self.axes):
            index, place = divmod(index, len(choices))
            values[name] = choices[place]
        return Condition(**values)

    def conditions(self) -> Iterator[Condition]:
        """All cells, in counting order."""
        return map(self.condition, range(self.condition_count))

    @property
    def chunks_per_condition(self) -> int:
        """Files of one condition."""
        return -(-self.trials // self.chunk_trials)

    @property
    def chunk_count(self) -> int:
        """Files of the study."""
        return self.condition_count * self.chunks_per_condition

    def chunk(self, index: int) -> Chunk:
        """The trials of file ``index``."""
        condition, part = divmod(index, self.chunks_per_condition)
        start = part * self.chunk_trials
        return Chunk(index, condition, start, min(start + self.chunk_trials, self.trials))

    def canonical(self) -> str:
        """The spec as one JSON text that does not depend on how the file was laid out."""
        content = asdict(self) | {"axes": dict(self.axes)}
        return json.dumps(content, sort_keys=True, allow_nan=False)

    @property
    def sha256(self) -> str:
        """Hash of :meth:`canonical`; every file of the study carries it."""
        return hashlib.sha256(self.canonical().encode()).hexdigest()

    @classmethod
    def from_canonical(cls, text: str) -> Spec:
        """The spec that :meth:`canonical` was made from (it travels to workers as this text).

        Raises:
            InputError: the text was not made by :meth:`canonical`.
        """
        try:
            content = json.loads(text)
            conditions = {
                name: values if name in content["listed"] else values[0]
                for name, values in content["axes"].items()
            }
            axes, listed = _axes(conditions)
            spec = cls(
                **{name: content[name] for name in _HEAD},
                axes=axes,
                listed=listed,
                probe=LinearProbe(**content["probe"]),
                methods=tuple(MethodSpec(**method) for method in content["methods"]),
            )
            same = spec.canonical() == text
        except (ValueError, LookupError, TypeError, AttributeError, OverflowError) as error:
            raise InputError(f"is not a study's canonical spec: {error}") from None
        if not same:
            raise InputError("is not a study's canonical spec")
        return spec

    def arrays(self, chunk: Chunk) -> dict[str, ArraySpec]:
        """What a chunk's file holds."""
        methods, trials = len(self.methods), chunk.stop - chunk.start
        shapes = {"sigma": (methods, trials, 3), "realised": (trials, 3)}
        return {
            name: ArraySpec(
                unit,
                shapes.get(name, (methods, trials)),
                "i" if name in ("status", "iterations") else "f",
            )
            for name, unit in UNITS.items()
        }

    def compute(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """All results of one chunk (:func:`jaxcal.study.pipeline.compute_chunk`)."""
        from jaxcal.study.pipeline import compute_chunk

        return compute_chunk(self, chunk)


def load_spec(path: str | os.PathLike[str]) -> Spec:
    """Read and check a spec.

    Args:
        path: a TOML file, see the head of this module.

    Raises:
        FormatError: no such file, too large, not UTF-8, not TOML.
        InputError: an unknown, missing or wrong field, which is named. Either is one line that
            starts with the path.
    """
    with naming(path):
        return _spec(load_toml(path))


def parse_spec(text: str) -> Spec:
    """:func:`load_spec` from the file's text; errors do not name the file.

    Raises:
        FormatError: not TOML.
        InputError: see :func:`load_spec`.
    """
    return _spec(parse_toml(text))


def _spec(content: dict[str, Any]) -> Spec:
    _known(content, {*_HEAD, "conditions", "probe", "methods"})
    content = {"chunk_trials": 512, **content}
    head = {name: _required(content, name) for name in _HEAD}
    axes, listed = _axes(_table(content, "conditions"))
    probe = _probe(_table(content, "probe"))
    return Spec(**head, axes=axes, listed=listed, probe=probe, methods=_methods(content))


def _known(table: dict[str, Any], names: set[str], where: str = "") -> None:
    for key in table:
        if key in names:
            continue
        shown = quoted(f"{where}{key}")
        unit = next((key + unit for unit in _UNITS if key + unit in names), None)
        if unit is not None:
            raise InputError(f"unknown field {shown}: its unit is missing, write {unit}")
        close = difflib.get_close_matches(key, sorted(names), 1)
        hint = f": did you mean {close[0]}?" if close else f"; known are {', '.join(sorted(names))}"
        raise InputError(f"unknown field {shown}{hint}")


def _required(table: dict[str, Any], key: str, where: str = "") -> Any:
    if key not in table:
        raise InputError(f"{where}{key} is missing")
    return table[key]


def _table(content: dict[str, Any], key: str) -> dict[str, Any]:
    table = content.get(key, {})
    if not isinstance(table, dict):
        raise InputError(f"{key} must be a table: [{key}]")
    return table


def _number(name: str, value: object, most: float, *, zero: bool) -> float:
    """A number up to ``most`` that is positive or, if allowed, zero."""
    if isinstance(value, str):
        raise InputError(
            f"{name} must be a plain number (its unit is in its name), not {shown(value)}"
        )
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{name} must be a number, not {shown(value)}")
    number = _float(value)
    if not 0 <= number <= most or (number == 0 and not zero):
        span = "between 0 and" if zero else "more than 0 and at most"
        raise InputError(f"{name} must be {span} {most:g}, not {shown(value)}")
    return number


def _float(value: int | float) -> float:
    """A number of the file; 1 and 1.0, and -0.0 and 0, are one."""
    return math.inf if abs(value) >= 2**1000 else float(value) + 0.0


def _axes(
    table: dict[str, Any],
) -> tuple[tuple[tuple[str, tuple[float | int | str, ...]], ...], tuple[str, ...]]:
    _known(table, set(AXES), "conditions.")
    defaults = {field.name: field.default for field in fields(Condition)}
    axes, listed = [], []
    for name in AXES:
        given = table.get(name, defaults[name])
        values = given if isinstance(given, list) else [given]
        if isinstance(given, list):
            listed.append(name)
        label = f"conditions.{name}"
        if not 1 <= len(values) <= MAXIMUM_CONDITIONS:
            raise InputError(f"{label} must hold 1 to {MAXIMUM_CONDITIONS} values")
        checked = tuple(_condition_value(name, label, value) for value in values)
        if len(set(checked)) < len(checked):
            raise InputError(f"{label} holds a value twice")
        axes.append((name, checked))
    shallowest, deepest = max(dict(axes)["depth_min_mm"]), min(dict(axes)["depth_max_mm"])
    if not shallowest < deepest:
        raise InputError("conditions.depth_min_mm must be less than conditions.depth_max_mm")
    return tuple(axes), tuple(listed)


def _condition_value(name: str, label: str, value: object) -> float | int | str:
    if name == "elevation_distribution":
        with naming("conditions"):
            check_law(value)
        return str(value)
    if name in _COUNTS:
        return whole_number(label, value, *_COUNTS[name])
    zero = name not in ("depth_min_mm", "depth_max_mm")
    return _number(label, value, _LARGEST.get(name, _LARGEST_MM), zero=zero)


def _probe(table: dict[str, Any]) -> LinearProbe:
    _known(table, {"elements", "pitch_mm"}, "probe.")
    default = LinearProbe()
    elements = whole_number("probe.elements", table.get("elements", default.elements), 2, 4096)
    pitch = _number("probe.pitch_mm", table.get("pitch_mm", default.pitch_mm), 99.0, zero=False)
    return LinearProbe(elements=elements, pitch_mm=pitch)


def _methods(content: dict[str, Any]) -> tuple[MethodSpec, ...]:
    tables = _required(content, "methods")
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise InputError("methods must be tables: [[methods]]")
    return tuple(_method(table, f"methods[{k}]") for k, table in enumerate(tables))


def _method(table: dict[str, Any], place: str) -> MethodSpec:
    where = f"{place}."
    _known(table, {field.name for field in fields(MethodSpec)}, where)
    name = _required(table, "name", where)
    _required(table, "method", where)
    if not (isinstance(name, str) and 1 <= len(name) <= 100 and name.isprintable()):
        raise InputError(f"{where}name must be 1 to 100 printable characters")
    values: dict[str, Any] = {
        key: _float(value) if key in _FLOATS and type(value) in (int, float) else value
        for key, value in table.items()
    }
    with naming(place):
        method = MethodSpec(**values)
        check_alternation((key for key in ALTERNATION if key in table), method.method)
        if method.assumed() == "bounded" and method.bound_given is None:
            method = replace(method, max_elevation_mm=DEFAULT_MAX_ELEVATION_MM)
    return method


def _check_size(spec: Spec) -> None:
    if spec.condition_count > MAXIMUM_CONDITIONS:
        raise InputError(
            f"the grid has {spec.condition_count} conditions, at most "
            f"{MAXIMUM_CONDITIONS} are computed"
        )
    if spec.condition_count * spec.trials > MAXIMUM_EXPERIMENTS:
        raise InputError(
            f"conditions times trials are {spec.condition_count * spec.trials}, at "
            f"most {MAXIMUM_EXPERIMENTS} have draws of their own"
        )
    if spec.chunk_count > MAXIMUM_CHUNKS:
        raise InputError(
            f"chunk_trials = {spec.chunk_trials} makes {spec.chunk_count} files, at "
            f"most {MAXIMUM_CHUNKS}: enlarge it"
        )
    if spec.chunk_trials * len(spec.methods) > MAXIMUM_CHUNK:
        raise InputError(
            f"chunk_trials = {spec.chunk_trials} is too large for {len(spec.methods)} "
            "methods: reduce it"
        )
    images = max(int(count) for name in _COUNTS for count in spec.axis(name))
    if images * spec.probe.elements > MAXIMUM_DISTANCES:
        raise InputError(
            f"{images} images times {spec.probe.elements} elements are too many: at "
            f"most {MAXIMUM_DISTANCES} distances are drawn"
        )
