"""The phantoms of the paper's section 3.2, for the simulated tank: one file each."""

from __future__ import annotations

from hw.bench.phantoms.active_echo import ActiveEcho
from hw.bench.phantoms.cross_wire import CrossWire
from hw.bench.phantoms.hydrophone import Hydrophone
from hw.bench.phantoms.phantom import Mark, Phantom, Sensor, two_way
from jaxcal import InputError

__all__ = [
    "ActiveEcho",
    "CrossWire",
    "Hydrophone",
    "Mark",
    "Phantom",
    "Sensor",
    "phantom_named",
    "two_way",
]

_KINDS = (ActiveEcho, CrossWire, Hydrophone)


def phantom_named(name: str) -> Phantom:
    """A phantom by its name on the command line, with the paper's sizes.

    Raises:
        InputError: no such phantom.
    """
    for kind in _KINDS:
        if kind.name == name:
            return kind()
    raise InputError(f"no phantom {name!r}; there are: {', '.join(k.name for k in _KINDS)}")
