"""Shapes and types are checked in the first calls of every function in each test.

jaxtyping checks every call, which takes up to half of the time of tests that call small functions
thousands of times; and it prepares the check of each function when the function is defined, also of
those that are never called and, again and again, of functions inside functions. Here the check is
prepared at the first call, and a function that passed it often enough is called without it until
the next test. Classes are left to jaxtyping.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable
from types import CodeType, FunctionType
from typing import Any

import jaxtyping

CHECKED_CALLS = 10
"""In each test so many calls of every function are checked."""

_checked: Counter[CodeType] = Counter()
_jaxtyped = jaxtyping.jaxtyped


def begin_test() -> None:
    """Check every function again."""
    _checked.clear()


def install() -> None:
    """Take jaxtyping's place in modules that its import hook loads from now on."""
    jaxtyping.jaxtyped = _sparing


def _sparing(*, typechecker: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def decorated(checkable: Any) -> Any:
        if not isinstance(checkable, FunctionType):
            return _jaxtyped(checkable, typechecker=typechecker)
        code, checks = checkable.__code__, None

        @functools.wraps(checkable)
        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal checks
            if _checked[code] >= CHECKED_CALLS:
                return checkable(*args, **kwargs)
            _checked[code] += 1
            if checks is None:
                checks = _jaxtyped(checkable, typechecker=typechecker)
            return checks(*args, **kwargs)

        return call

    return decorated
