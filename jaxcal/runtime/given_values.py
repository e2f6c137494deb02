"""Checks of single values that a caller gave, with errors that say what was given."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.runtime.arrays import array_module, is_traced
from jaxcal.runtime.messages import counted, shown

LARGEST_SEED = 2**63 - 1
_KEY_DATA = ((2,), (4,))
"""Shapes of an old-style key, by JAX's generators."""


def real_array(value: Any, name: str) -> np.ndarray:
    """A caller's numbers as a float64 array of their own.

    Raises:
        InputError: what numpy would convert with a loss (complex numbers, masked entries), with a
            guess (texts, truth values) or not at all; a traced array, which has no numbers.
    """
    refuse_masked(value, name)
    try:
        given = np.asarray(value)
        # bfloat16 and its like are of numpy's kind V.
        other = given.dtype.kind == "V" and np.can_cast(given.dtype, np.float64)
        if given.dtype.kind in "iufO" or other:
            return np.array(given, np.float64)
    except (TypeError, ValueError, OverflowError):
        pass
    if is_traced(value):
        raise InputError(f"{name} has no values inside a jit, vmap or grad: call this outside")
    raise InputError(f"{name} must be an array of real numbers")


def shaped_array(value: Any, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """:func:`real_array`; InputError where it has another shape."""
    array = real_array(value, name)
    if array.shape != shape:
        raise InputError(f"{name} must have shape {shape}, it has {array.shape}")
    return array


def traceable_array(value: Any, name: str) -> Any:
    """:func:`real_array` of values; a traced array, which has none, is only made an array."""
    return array_module(value).asarray(value) if is_traced(value) else real_array(value, name)


def refuse_masked(value: Any, name: str) -> None:
    """Raise InputError for masked entries, which numpy's functions would read as if they were not.

    In a list, they are searched for at any depth.
    """
    if np.ma.is_masked(value):
        raise InputError(f"{name} must not hold masked entries: leave those rows out (mask=)")
    if isinstance(value, list | tuple):
        for each in value:
            refuse_masked(each, name)


def truth_array(value: Any, name: str) -> np.ndarray:
    """A caller's mask as an array of booleans; a masked entry is False.

    Raises:
        InputError: other values than truth values, 0 and 1.
    """
    try:
        given = np.ma.filled(value, False)
        if given.dtype == bool or np.isin(given, (0, 1)).all():
            return given.astype(bool)
    except (TypeError, ValueError):  # lists of several lengths, or pandas' NA
        pass
    raise InputError(f"{name} must hold booleans (True = used)")


def check_enough(used: np.ndarray, minimum: int) -> None:
    """Raise InputError if fewer images are used than so many."""
    if used.sum() < minimum:
        few = counted(int(used.sum()), "used image", "is", "are")
        raise InputError(f"{few} too few: at least {minimum} are needed")


def is_number(value: Any) -> bool:
    """Whether a caller's value is one finite real number, not a text, truth value or array."""
    try:
        number = real_array(value, "it")
    except InputError:
        return False
    return number.ndim == 0 and bool(np.isfinite(number))


def whole_number(name: str, value: object, least: int, most: int) -> int:
    """A whole number that a caller gave.

    Raises:
        InputError: something else, or a number out of these bounds.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise InputError(f"{name} must be a whole number, not {shown(value)}")
    if not least <= value <= most:
        raise InputError(f"{name} must be between {least} and {most}, not {value}")
    return int(value)


def check_flag(name: str, value: object) -> None:
    """Raise InputError if what a caller gave is not True or False."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} must be True or False, not {shown(value)}")


def check_key(name: str, value: object) -> None:
    """Raise InputError if what a caller gave is not one JAX key (of the new or the old style)."""
    import jax

    if isinstance(value, jax.Array):
        if jax.numpy.issubdtype(value.dtype, jax.dtypes.prng_key):
            good = value.ndim == 0
        else:
            good = value.dtype == np.uint32 and value.shape in _KEY_DATA
        if good:
            return
        value = f"an array of {value.dtype}, shape {value.shape}"
    else:
        value = shown(value)
    raise InputError(f"{name} must be a JAX key, e.g. jax.random.key(1), not {value}")


def check_made(name: str, value: object, kind: type, by: str) -> None:
    """Raise InputError, which names what makes such an object, if a caller gave something else."""
    if not isinstance(value, kind):
        raise InputError(f"{name} must be made by {by}, not {shown(value)}")
