"""jaxtyping's array annotations, without its import where nobody checks annotations.

Importing jaxtyping takes 0.07 s of CPU (it imports ``unittest.mock`` and with it asyncio). That is
a third of the time to read a file, or to start a small process that talks to a device. Its
``Array`` imports JAX. Annotations are strings; at run time only a type checker evaluates them, and
that has imported jaxtyping before.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

__all__ = [
    "AnyArray",
    "Array",
    "Bool",
    "Float",
    "HeldArray",
    "Int",
    "Int16",
    "Num",
    "UInt8",
    "UInt16",
]

if TYPE_CHECKING or "jaxtyping" in sys.modules:
    from jaxtyping import Bool, Float, Int, Int16, Num, UInt8, UInt16
else:

    class Annotation:
        """Stands in for an annotation; it evaluates to the array's type."""

        def __class_getitem__(cls, item: tuple[type, str]) -> type:
            return item[0]

    Bool = Float = Int = Int16 = Num = UInt8 = UInt16 = Annotation

if TYPE_CHECKING or ("jaxtyping" in sys.modules and "jax" in sys.modules):
    import numpy as np
    from jaxtyping import Array

    AnyArray = Array | np.ndarray
    """JAX's or numpy's: public functions of arrays take both."""
else:
    Array = AnyArray = Any

if TYPE_CHECKING:
    HeldArray = Array
else:
    HeldArray = AnyArray
    """What a tree of arrays holds: JAX's for the type checker, numpy's too at run time."""
