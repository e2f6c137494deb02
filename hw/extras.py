"""Client libraries that are optional: imported when first needed, with a line that says how."""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Literal

from hw.errors import Device, DeviceError

Extra = Literal["robot", "serial"]
_DEVICE: dict[Extra, Device] = {"robot": "robot", "serial": "active echo"}


def require(name: str, *, extra: Extra) -> ModuleType:
    """Import an optional module.

    Args:
        name: the module, e.g. ``rtde_receive`` or ``serial.tools``.
        extra: the extra of this package that installs it.

    Raises:
        DeviceError: it is not installed; the text names ``pip install "jaxcal[extra]"``.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        hint = f'{name} cannot be imported ({error}): pip install "jaxcal[{extra}]"'
        if extra == "robot":
            hint += " (ur_rtde has wheels for CPython 3.7-3.12 on Linux x86-64 and Windows only)"
        raise DeviceError(hint, device=_DEVICE[extra]) from error
