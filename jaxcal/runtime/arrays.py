"""Numpy for values, jax.numpy inside somebody's jit, vmap or grad."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

from jaxcal import InputError

P = ParamSpec("P")
T = TypeVar("T")


def is_traced(*values: object) -> bool:
    """Whether one of these values (pytrees) is traced by a jit, vmap or grad."""
    # If JAX is not imported, nothing is traced.
    jax = sys.modules.get("jax")
    if jax is None:
        return False
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def real_array(value: Any, name: str) -> np.ndarray:
    """A caller's numbers as a float64 array of their own.

    Raises:
        InputError: what numpy would convert with a loss (complex numbers, masked entries), with a
            guess (texts, truth values) or not at all.
    """
    if np.ma.is_masked(value):
        raise InputError(f"{name} must not hold masked entries: leave those rows out (mask=)")
    try:
        given = np.asarray(value)
        # bfloat16 and its like are of numpy's kind V.
        other = given.dtype.kind == "V" and np.can_cast(given.dtype, np.float64)
        if given.dtype.kind in "iufO" or other:
            return np.array(given, np.float64)
    except (TypeError, ValueError, OverflowError):
        pass
    raise InputError(f"{name} must be an array of real numbers")


def is_number(value: Any) -> bool:
    """Whether a caller's value is one finite real number, not a text, truth value or array."""
    try:
        number = real_array(value, "it")
    except InputError:
        return False
    return number.ndim == 0 and bool(np.isfinite(number))


def finite_or_none(value: Any) -> float | None:
    """A number for JSON, which knows neither NaN nor infinity."""
    number = float(value)
    return number if np.isfinite(number) else None


def array_module(*values: object) -> Any:
    """What to compute with: jax.numpy where one of the values is traced, otherwise numpy."""
    return sys.modules["jax"].numpy if is_traced(*values) else np


def like(before: Any, values: np.ndarray) -> Any:
    """Values as a numpy or JAX array of the dtype of another array, like that one."""
    if isinstance(before, np.ndarray):
        return values.astype(before.dtype)
    import jax.numpy as jnp

    return jnp.asarray(values, before.dtype)


def traceable(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a user of :func:`array_module`, which then runs traced in JAX's standard modes."""

    @wraps(function)
    def in_standard_modes(*args: P.args, **kwargs: P.kwargs) -> T:
        if not is_traced(args, kwargs):
            return function(*args, **kwargs)
        from jaxcal.runtime.precision import own_modes

        with own_modes(bits_too=False):
            return function(*args, **kwargs)

    return in_standard_modes
