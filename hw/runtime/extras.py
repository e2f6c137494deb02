"""Client libraries that are optional: imported when first needed, with a line that says how."""

from __future__ import annotations

import importlib
import importlib.util
import platform
import sys
from types import ModuleType
from typing import Literal

from hw.runtime.errors import Device, DeviceError

Extra = Literal["robot", "serial", "view"]
_DEVICE: dict[str, Device] = {"robot": "robot", "serial": "active echo"}


def require(name: str, *, extra: Extra) -> ModuleType:
    """Import an optional module.

    Args:
        name: the module, e.g. ``rtde_receive`` or ``serial.tools``.
        extra: the extra of this package that installs it.

    Raises:
        DeviceError: it is not installed; the text says how to install it, or that it cannot be.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        text = f"{name} cannot be imported ({error}): {_cure(extra)}"
        raise DeviceError(text, device=_DEVICE[extra]) from error


def missing(name: str, *, extra: Extra) -> str | None:
    """What to do if an optional module is not installed, or None if it is; imports nothing.

    Args:
        name: the module, not within a package.
        extra: the extra of this package that installs it.
    """
    if importlib.util.find_spec(name) is not None:
        return None
    return f"{name} is not installed: {_cure(extra)}"


def robot_wheels() -> bool:
    """Whether ur_rtde has wheels for this Python and processor, on a system that moves robots.

    The same condition stands at the extra ``robot`` in pyproject.toml.
    """
    system = sys.platform == "linux" and platform.machine() == "x86_64"
    return system and sys.version_info < (3, 13)


def _cure(extra: Extra) -> str:
    if extra == "robot" and not robot_wheels():
        here = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
        return (
            f'"jaxcal[robot]" installs nothing for {here}: robots are moved by ur_rtde and from '
            "Linux. Use CPython 3.11 or 3.12 on Linux x86-64, or build ur_rtde from source there"
        )
    return f'pip install "jaxcal[{extra}]"'
