"""jaxtyping's array annotations at no cost: those of :mod:`jaxcal.runtime.array_types`."""

from __future__ import annotations

from jaxcal.runtime.array_types import Bool, Float, Int, Int16, UInt8, UInt16

__all__ = ["Bool", "Float", "Int", "Int16", "UInt8", "UInt16"]
