"""Whether JAX is imported, and actions for the time when it is, without importing it here.

A recording can be calibrated without JAX, whose import takes longer than the calibration. So jaxcal
sets up its parts of JAX when somebody imports it. A finder in front of the import system's own ones
does this at the first ``import jax`` and then removes itself.

Any thread may import JAX at any moment. Until the import ends, its module is there without its
contents, so whoever needs them waits. A calculation that began without JAX ends without it: it has
entered none of JAX's modes.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from contextvars import ContextVar, copy_context
from importlib.machinery import ModuleSpec
from threading import Lock
from types import ModuleType
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

_numpy_alone: ContextVar[bool] = ContextVar("jaxcal_numpy_alone", default=False)


def imported(name: str) -> Any:
    """A module that somebody has imported, or None; an import that is under way is waited for."""
    return importlib.import_module(name) if name in sys.modules else None


def jax_in_use() -> Any:
    """JAX if it is imported and this calculation uses it, otherwise None."""
    return None if _numpy_alone.get() else imported("jax")


def decided(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function for which :func:`jax_in_use` is now decided, until it returns.

    Whatever it calls through this function is decided anew.
    """
    context = copy_context()  # and no variable to set back, which a Ctrl-C could prevent
    context.run(_numpy_alone.set, "jax" not in sys.modules)
    return context.run(function, *args, **kwargs)


_lock = Lock()
_waiting: list[Callable[[], None]] = []


def when_jax_is_imported(action: Callable[[], None]) -> None:
    """Run an action at once if JAX is imported, and otherwise when it is; actions run in order."""
    with _lock:
        if _waiting or "jax" not in sys.modules:
            if not _waiting:
                sys.meta_path.insert(0, _Finder())
            _waiting.append(action)
            return
    action()


class _Finder:
    """Lets the other finders find JAX, and runs the waiting actions once it is imported."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "jax":
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        found = (finder.find_spec(fullname, path, target) for finder in others)
        spec = next((spec for spec in found if spec is not None), None)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_and_act(module: ModuleType) -> None:
            execute(module)
            with _lock:
                if self in sys.meta_path:
                    sys.meta_path.remove(self)
                actions = _waiting.copy()
                _waiting.clear()
            for action in actions:
                action()

        # Only this loader is changed. To ask whether JAX is installed does not run it.
        spec.loader.exec_module = execute_and_act
        return spec
