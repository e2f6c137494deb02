"""Whether JAX's threads are in this process; a fork leaves them in the parent, where they started.

A compiled program would wait for them without end. A fork before JAX has started does no harm. This
module is imported with jaxcal itself, because the state has to be noted at the fork.
"""

from __future__ import annotations

import os
import sys


def _jax_has_started() -> bool:
    # JAX has no public way to ask without starting, and its private one takes a lock, which a
    # thread that is not here may hold.
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bool(getattr(bridge, "_backends", None))


def _is_one_thread() -> bool:
    """Whether this process has no thread but one; False where the system does not say."""
    try:
        return len(os.listdir("/proc/self/task")) == 1
    except OSError:
        return False


# jaxcal may be imported after the fork only. JAX that has started has threads of its own.
threads_left_behind = _jax_has_started() and _is_one_thread()
"""Whether this process was forked from one in which JAX had started."""


def _note() -> None:
    global threads_left_behind
    threads_left_behind = threads_left_behind or _jax_has_started()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note)
