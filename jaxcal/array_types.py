"""jaxtyping's array annotations, without its import where nobody checks annotations.

Importing jaxtyping takes 0.07 s of CPU (it imports ``unittest.mock`` and with it asyncio), a third
of what reading a file, or starting a small process that talks to a device, takes. Annotations are
strings that nothing evaluates at run time but a checker, and whoever checks has imported jaxtyping
before.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

__all__ = ["Bool", "Float", "Int", "Int16", "Num", "UInt8", "UInt16"]

if TYPE_CHECKING or "jaxtyping" in sys.modules:
    from jaxtyping import Bool, Float, Int, Int16, Num, UInt8, UInt16
else:

    class Array:
        """Stands for an annotation: evaluated, it is the array's type."""

        def __class_getitem__(cls, item: tuple[type, str]) -> type:
            return item[0]

    Bool = Float = Int = Int16 = Num = UInt8 = UInt16 = Array
