"""JAX's own cache of compiled programs, in this user's cache folder.

It holds what :mod:`jaxcal.runtime.executables` does not keep. Only the command line and its worker
processes turn it on; whoever calls the library may have one of their own.
"""

from __future__ import annotations

import os
import re
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

from jaxcal.runtime import program_cache
from jaxcal.runtime.when_jax import when_jax_is_imported

KEPT_PROGRAMS = 256
"""Newest programs to keep; one is about 0.4 MB."""

_TROUBLE = re.compile(r"Error (?:read|writ)ing persistent compilation cache entry for '([^']+)'")

_wanted = False


def is_wanted() -> bool:
    """Whether this process has asked for it."""
    return _wanted


def folder() -> Path:
    """Where it is; raises what :func:`jaxcal.runtime.program_cache.private_folder` does."""
    return program_cache.private_folder("xla")


def enable_compilation_cache() -> None:
    """Let JAX keep what :mod:`jaxcal.runtime.executables` does not, and silence its compiler.

    Both are done when JAX is imported, which not every calibration needs. If there can be no
    folder, nothing is kept and nothing is said.

    The compiler's alarms ("Very slow compile?") ask users of XLA to file bugs. The only option for
    them is the level of XLA's log, which is that of the whole process. So the command line sets it
    and the library does not; and not by an environment variable, which other programs inherit.
    """
    global _wanted
    _wanted = True
    when_jax_is_imported(_enable_compilation_cache)


def _enable_compilation_cache() -> None:
    # "1" is what importing JAX puts there; anything else is somebody's wish.
    wished = os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") != "1"
    if not wished and "JAX_LOGGING_LEVEL" not in os.environ:
        from jaxlib import utils  # pyright: ignore[reportAttributeAccessIssue]

        with suppress(AttributeError):  # not part of jaxlib's public interface
            utils.absl_set_min_log_level(3)
    if not program_cache.is_on():
        return
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    try:
        place = folder()
        prune(place)
    except (OSError, RuntimeError):
        return
    import jax

    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    _remove_damaged(place)


def _remove_damaged(place: Path) -> None:
    """Remove an entry that JAX warns of; its user cannot mend it, and need not read of it.

    JAX writes an entry in place, so that a full disk leaves half of it, and never replaces one that
    is there: its program would be compiled in every run. The warning names the program alone.
    """
    show = warnings.showwarning

    def remove_or_show(message: Warning | str, *about: Any, **more: Any) -> None:
        found = _TROUBLE.match(str(message))
        if found is None:
            show(message, *about, **more)
            return
        for path in place.glob("*-cache"):
            if path.name.startswith(f"{found[1]}-"):
                with suppress(OSError):
                    path.unlink()

    warnings.showwarning = remove_or_show
    # Each time, though the text be the same.
    warnings.filterwarnings("always", message=_TROUBLE.pattern)


def prune(place: Path, kept: int = KEPT_PROGRAMS) -> None:
    """Remove all but the newest entries."""
    programs = []
    for path in place.iterdir():
        with suppress(FileNotFoundError):  # another process prunes as well
            # Not stat: a link that leads nowhere would end it, and nothing would be removed any
            # more.
            programs.append((path.lstat().st_mtime, path))
    for _, path in sorted(programs)[: max(len(programs) - kept, 0)]:
        path.unlink(missing_ok=True)
