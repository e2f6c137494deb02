"""Compiled programs kept between runs of the command line, in the user's own cache folder.

A calibration takes milliseconds and its compilation seconds, so the second run is much faster. What
lies in the folder is loaded as machine code: it is used only where nobody else can write to it.
Importing the library never does this; ``JAXCAL_NO_CACHE=1`` turns it off.
"""

from __future__ import annotations

import os
import stat
import warnings
from contextlib import suppress
from pathlib import Path

KEPT_PROGRAMS = 256
"""Newest programs to keep; one is about 0.4 MB."""


def enable_compilation_cache() -> None:
    """Let JAX keep compiled programs on disk; silently without where that cannot be."""
    if os.environ.get("JAXCAL_NO_CACHE", "0") not in ("", "0"):
        return
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    try:
        folder = _private_folder()
        _prune(folder)
    except (OSError, RuntimeError):
        return
    import jax

    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    # A damaged entry is compiled anew; that is nothing that a user of the command line can mend.
    warnings.filterwarnings("ignore", message=".*persistent compilation cache.*")


def _private_folder() -> Path:
    """~/.cache/jaxcal/xla, made if need be; OSError where it is not ours alone."""
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not base.is_absolute():  # the XDG specification: relative paths are to be ignored
        base = Path.home() / ".cache"
    base.mkdir(parents=True, exist_ok=True)
    folder = base / "jaxcal" / "xla"
    for place in (folder.parent, folder):
        with suppress(FileExistsError):
            place.mkdir(mode=0o700)
        found = place.lstat()
        if not stat.S_ISDIR(found.st_mode):
            raise NotADirectoryError(place)
        # Windows keeps its profile folders private by other means.
        if os.name == "posix" and (found.st_uid != os.geteuid() or found.st_mode & 0o077):
            raise PermissionError(place)
    return folder


def _prune(folder: Path) -> None:
    programs = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime)
    for path in programs[:-KEPT_PROGRAMS]:
        path.unlink(missing_ok=True)
