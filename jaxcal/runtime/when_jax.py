"""Actions for the time when JAX is imported, without importing it here.

A recording can be calibrated without JAX, whose import takes longer than the calibration. So jaxcal
sets up its parts of JAX when somebody imports it. A finder in front of the import system's own ones
does this at the first ``import jax`` and then removes itself.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec
from threading import Lock
from types import ModuleType

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
