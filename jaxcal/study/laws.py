"""Names of the laws of the elevational offset; :mod:`jaxcal.study.offsets` says what each one is.

Specifications of studies are read without JAX, which drawing from a law needs.
"""

from __future__ import annotations

from typing import Literal, get_args

from jaxcal import InputError
from jaxcal.runtime.messages import shown

LawName = Literal[
    "uniform",
    "normal",
    "one-sided",
    "heavy-tailed",
    "triangular",
    "exponential",
    "two-humped",
    "drifting",
    "outlying",
    "off-centre",
    "sometimes off-centre",
]

OFFSET_LAWS: tuple[LawName, ...] = get_args(LawName)


def check_law(law: object, name: str = "elevation_distribution") -> None:
    """Raise InputError, which names the argument, for something that is no law's name."""
    if not (isinstance(law, str) and law in OFFSET_LAWS):
        raise InputError(f"{name} must be one of {', '.join(OFFSET_LAWS)}, not {shown(law)}")
