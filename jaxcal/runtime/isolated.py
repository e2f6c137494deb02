"""Starting Python processes of our own that run no code from the current directory.

``python -m module`` puts the current directory first on the import path, so that an ``h5py.py`` or
a ``queue.py`` among somebody's data would be run. Every helper process of jaxcal is started by
:func:`python_command` instead: isolated (``-I``: no current directory, no ``PYTHON*`` variables, no
user site), with the import path of the process that starts it handed over, less the current
directory. Helpers can import what the parent can, from the same places, including editable
installations and ``PYTHONPATH``.

The console scripts ``jaxcal`` and ``jaxcal-hw`` do not have the current directory on their path
either; ``python -m jaxcal`` does (use ``python -P -m``).
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

_ROOT = str(Path(__file__).resolve().parents[2])

_START = """\
import json, runpy, sys
sys.path[:] = json.loads(sys.argv[1])
module = sys.argv[2]
del sys.argv[1:3]
runpy.run_module(module, run_name="__main__", alter_sys=True)
"""


def python_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module of an installed package in a new, isolated interpreter.

    Args:
        module: its full name, e.g. ``hw.recording.writer_process``.
        arguments: for it, as ``sys.argv[1:]``.
    """
    return [sys.executable, "-I", "-c", _START, json.dumps(import_path()), module, *arguments]


def import_path() -> list[str]:
    """This process's import path without the current directory.

    The current directory stays where jaxcal itself was imported from it (a source tree).
    """
    here = os.path.realpath(os.getcwd())
    entries = [os.path.abspath(entry) for entry in sys.path if entry]
    return [entry for entry in entries if here == _ROOT or os.path.realpath(entry) != here]
