"""What has to happen once JAX is imported, without importing it.

A recording can be calibrated without JAX, whose import takes longer than the calibration. What
jaxcal sets up for JAX is therefore done when somebody imports it: by a finder in front of the
import system's own, which steps aside at the first ``import jax``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

_waiting: list[Callable[[], None]] = []


def when_jax_is_imported(action: Callable[[], None]) -> None:
    """Do something at once where JAX is imported, and otherwise when it is, in order."""
    if "jax" in sys.modules:
        action()
        return
    if not _waiting:
        sys.meta_path.insert(0, _Finder())
    _waiting.append(action)


class _Finder:
    """Lets the others find JAX, and does what waits once it is imported."""

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
            if self in sys.meta_path:
                sys.meta_path.remove(self)
            while _waiting:
                _waiting.pop(0)()

        # Of this loader only; who merely asks whether JAX is installed never runs it.
        spec.loader.exec_module = execute_and_act
        return spec
