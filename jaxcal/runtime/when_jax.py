"""Actions for the time when JAX is imported, without importing it here.

A recording can be calibrated without JAX, whose import takes longer than the calibration. So jaxcal
sets up its parts of JAX when somebody imports it. A finder in front of the import system's own ones
does this at the first ``import jax``.

A Ctrl-C waits for the end of that import, and of those of :data:`WHOLE`. Within it, it could abort
the process in JAX's binary, and the modules that it left would be no part of the same package when
that is imported anew. So the finder is there from the import of jaxcal itself until all of them are
imported.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from functools import partial
from importlib.machinery import ModuleSpec
from threading import Lock
from types import ModuleType
from typing import Any

from jaxcal.runtime.interrupts import interrupt_held_back

WHOLE = ("jax", "jaxtyping", "equinox", "optimistix")
"""Packages whose import is not interrupted: their own module imports most of the others."""

_lock = Lock()
_waiting: list[Callable[[], None]] = []


def when_jax_is_imported(action: Callable[[], None]) -> None:
    """Run an action at once if JAX is imported, and otherwise when it is; actions run in order."""
    with _lock:
        if _waiting or "jax" not in sys.modules:
            _waiting.append(action)
            return
    action()


class _Finder:
    """Lets the other finders find a package, and runs the waiting actions once JAX is imported."""

    def find_spec(
        self, fullname: str, path: Any, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in WHOLE:
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        found = (finder.find_spec(fullname, path, target) for finder in others)
        spec = next((spec for spec in found if spec is not None), None)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_and_act(module: ModuleType) -> None:
            with interrupt_held_back(until=partial(_wait_for_import, fullname)):
                execute(module)
                if fullname == "jax":
                    _act()
                with _lock:
                    if self in sys.meta_path and sys.modules.keys() >= set(WHOLE):
                        sys.meta_path.remove(self)

        # Only this loader is changed. To ask whether JAX is installed does not run it.
        spec.loader.exec_module = execute_and_act
        return spec


def _act() -> None:
    with _lock:
        actions = _waiting.copy()
        _waiting.clear()
    for action in actions:
        action()


def _wait_for_import(name: str) -> None:
    if name in sys.modules:  # which it is not after an import that failed
        importlib.import_module(name)


if not sys.modules.keys() >= set(WHOLE):
    sys.meta_path.insert(0, _Finder())
