"""How a public name is changed: it works for one more minor version, and says what replaces it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def warn_deprecated(name: str, instead: str, removed_in: str, *, stacklevel: int = 3) -> None:
    """Tell the caller's developer that a name will go.

    Args:
        name: what was used, e.g. ``jaxcal.calibrate(data=...)``.
        instead: what to use, e.g. ``residuals=...``.
        removed_in: the version that no longer has it.
        stacklevel: whose line the warning names; 3 is the caller of this function's caller.
    """
    text = f"{name} is deprecated and will go in jaxcal {removed_in}: use {instead}"
    warnings.warn(text, DeprecationWarning, stacklevel=stacklevel)


def deprecated(instead: str, removed_in: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorate a public function that another replaces; see :func:`warn_deprecated`."""

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        @wraps(function)
        def still_there(*args: P.args, **kwargs: P.kwargs) -> T:
            name = f"{function.__module__}.{function.__qualname__}"
            warn_deprecated(name, instead, removed_in)
            return function(*args, **kwargs)

        return still_there

    return decorate
