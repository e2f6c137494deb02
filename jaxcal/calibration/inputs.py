"""Converts what callers give as a problem, with errors that say what to do."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from jaxcal import InputError
from jaxcal.data.problem import Problem, stack
from jaxcal.data.recording import Images, Recording
from jaxcal.runtime.messages import shown

P = ParamSpec("P")
T = TypeVar("T")

_HOW = (
    "jaxcal.Problem.from_arrays(poses, measurements) makes one of arrays, jaxcal.load(path) reads "
    "a recording"
)


def as_problem(value: Any, name: str) -> Problem:
    """The problem that a caller gave; recordings and images are converted.

    Args:
        value: a problem, a recording or one set of images.
        name: of the function that was called, for messages.

    Raises:
        InputError: anything else, with what to do.
    """
    if isinstance(value, Problem):
        return value
    if isinstance(value, Recording | Images):
        return Problem.from_recording(value)
    if isinstance(value, str | os.PathLike):
        raise InputError(
            f"{name} takes a problem, not a path: {name}(jaxcal.load({os.fspath(value)!r})), or "
            "import the file first (jaxcal import)"
        )
    if isinstance(value, list | tuple) and value and _are_problems(value):
        raise InputError(
            f"{name} takes one problem, not {len(value)}: jaxcal.calibrate_batch takes a list"
        )
    kind = "a dictionary" if isinstance(value, dict) else f"{type(value).__name__}"
    raise InputError(f"{name} takes a problem or a recording, not {kind}: {_HOW}")


def converting(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a public function whose first argument is a problem: it takes recordings as well.

    Placed outside :func:`jaxcal.runtime.precision.in_own_modes`: to segment times of flight imports
    JAX, and what imports JAX within would run in the caller's modes.
    """

    @wraps(function)
    def converted(*args: P.args, **kwargs: P.kwargs) -> T:
        name = f"jaxcal.{function.__name__}"
        if args:
            return function(*(as_problem(args[0], name), *args[1:]), **kwargs)  # pyright: ignore[reportCallIssue]
        if "problem" in kwargs:
            kwargs["problem"] = as_problem(kwargs["problem"], name)
        return function(*args, **kwargs)

    return converted


def as_batch(value: Any, name: str) -> Problem:
    """The batch of problems that a caller gave; a list of problems or recordings is stacked.

    Raises:
        InputError: anything else, or problems that differ in their number of images or in parts.
    """
    if isinstance(value, list | tuple):
        if not value:
            raise InputError(f"{name} takes at least one problem; the list is empty")
        return stack([as_problem(each, name) for each in value])
    return as_problem(value, name)


def unknown_names(estimate: Any) -> tuple[str, ...]:
    """Names of further unknowns as a tuple; a text may hold one name or several with commas."""
    if isinstance(estimate, str):
        return tuple(name.strip() for name in estimate.split(","))
    if estimate is None:
        return ()
    if not isinstance(estimate, Iterable):
        raise InputError(f"estimate must be names of unknowns, not {shown(estimate)}")
    return tuple(estimate)


def _are_problems(values: Any) -> bool:
    return all(isinstance(each, Problem | Recording | Images) for each in values)
