"""Sizes that problems are padded to, so that a few programs serve any number of images.

A padded problem has additional masked images, on which no answer depends. Arrays of the result with
an axis of images are cut to the original number. This axis is found by an array's annotation, where
every class of jaxcal names it ``n``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, TypeVar

from jaxcal.runtime.trees import assembled

T = TypeVar("T")

SMALLEST = 8
"""Images of the smallest bucket."""

_SHAPE = re.compile(r"""\[[^\[\]]*["']([^"']*)["']\]""")


def size(count: int) -> int:
    """The bucket of a number of images or problems: 8, 12, 16, 24, 32, 48, 64, 96, 128, ..."""
    bucket = SMALLEST
    while bucket < count:
        # Powers of two, and 1.5 times each of them.
        bucket = bucket * 3 // 2 if bucket & (bucket - 1) == 0 else bucket * 4 // 3
    return bucket


def each_image(tree: Any, change: Callable[[Any, int], Any]) -> Any:
    """The tree with ``change`` applied to every array that has an axis of images."""
    changed: dict[str, Any] = {}
    for field in fields(tree):
        value = getattr(tree, field.name)
        axis = _axis_of_images(str(field.type))
        if is_dataclass(value):
            value = each_image(value, change)
        elif value is not None and axis is not None:
            value = change(value, axis)
        changed[field.name] = value
    return assembled(type(tree), changed)


def cut(result: T, images: int) -> T:
    """A result for the first images only.

    Args:
        result: a :class:`jaxcal.Calibration` in numpy arrays, or what it holds.
        images: how many there were before padding.
    """

    def first(values: Any, axis: int) -> Any:
        rows: list[slice] = [slice(None)] * values.ndim
        rows[axis] = slice(0, images)
        return values[tuple(rows)]

    return each_image(result, first)


@cache
def _axis_of_images(annotation: str) -> int | None:
    """Counted from the last axis, since leading ones are a batch's; None where there is none."""
    shape = _SHAPE.search(annotation)
    names = shape[1].split() if shape else []
    return names.index("n") - len(names) if "n" in names else None
