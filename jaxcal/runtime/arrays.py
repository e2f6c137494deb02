"""Arrays, numpy's or JAX's, and trees of them, without importing JAX.

Code for both computes with numpy, and with jax.numpy inside somebody's jit, vmap or grad
(:func:`array_module`).

Any thread may import JAX at any moment. Until the import ends, its module is there without its
contents, so whoever needs them waits (:func:`imported`). A calculation that began without JAX ends
without it, since it has entered none of JAX's modes (:func:`jax_in_use`).

A tree is a frozen dataclass of arrays that JAX sees through (a pytree). The classes are registered
when JAX is imported (:mod:`jaxcal.runtime.when_jax`), so problems and answers that were made before
that are trees as well. An array with an axis of images is found by its annotation, where every
class of jaxcal names this axis ``n``.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
import re
import sys
from collections.abc import Callable
from contextvars import ContextVar, copy_context
from functools import cache, partial
from typing import Any, ParamSpec, TypeVar, dataclass_transform

import numpy as np

from jaxcal.runtime.when_jax import when_jax_is_imported

P = ParamSpec("P")
T = TypeVar("T")

_STATIC = "static"

_SHAPE = re.compile(r"""\[[^\[\]]*["']([^"']*)["']\]""")

_LONGEST_SHOWN = 16
"""Numbers in an array that a ``repr`` writes out: a 4x4 transform."""

_numpy_alone: ContextVar[bool] = ContextVar("jaxcal_numpy_alone", default=False)
"""Whether the calculation that runs here began without JAX."""


def imported(name: str) -> Any:
    """A module that somebody has imported, or None; an import that is under way is waited for."""
    return importlib.import_module(name) if name in sys.modules else None


def jax_in_use() -> Any:
    """JAX if it is imported and this calculation uses it, otherwise None."""
    return None if _numpy_alone.get() else imported("jax")


def decided(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function for which :func:`jax_in_use` is now decided, until it returns.

    Whatever it calls through this function is decided anew.
    """
    context = copy_context()  # and no variable to set back, which a Ctrl-C could prevent
    context.run(_numpy_alone.set, "jax" not in sys.modules)
    return context.run(function, *args, **kwargs)


def is_traced(*values: object) -> bool:
    """Whether one of these values (pytrees) is traced by a jit, vmap or grad."""
    jax = jax_in_use()
    if jax is None:
        return False
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def array_module(*values: object) -> Any:
    """What to compute with: jax.numpy where one of the values is traced, otherwise numpy."""
    return jax_in_use().numpy if is_traced(*values) else np


def like(before: Any, values: Any) -> Any:
    """Values as a numpy or JAX array of the dtype of another array, where that one is."""
    values = np.asarray(values, before.dtype)
    if isinstance(before, np.ndarray):
        return values
    import jax

    place = before.sharding if before.committed and len(before.devices()) == 1 else None
    with jax.enable_x64(True):  # the caller may have made it in 64 bits, and left them
        return jax.device_put(values, place)


def is_on_one_processor(leaf: Any) -> bool:
    """Whether this is a JAX array whose values numpy reads where they are."""
    jax = jax_in_use()
    if jax is None or not isinstance(leaf, jax.Array) or is_traced(leaf):
        return False
    return [device.platform for device in leaf.devices()] == ["cpu"]


def static(*, default: Any = dataclasses.MISSING) -> Any:
    """A field of an array tree that is no array: part of the tree's structure, and hashable."""
    return dataclasses.field(default=default, metadata={_STATIC: True})


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(static,))
def array_tree(kind: type[T]) -> type[T]:
    """Decorate a class: a frozen dataclass, and a pytree of its fields but for :func:`static` ones.

    Instances compare by identity, as arrays have no single truth value. Their ``repr`` has the
    shapes of long arrays instead of the numbers.
    """
    kind = dataclasses.dataclass(frozen=True, eq=False, repr=False)(kind)
    if "__repr__" not in vars(kind):
        kind.__repr__ = outline  # pyright: ignore[reportAttributeAccessIssue]
    kind.__getstate__ = _state
    when_jax_is_imported(partial(_register, kind))
    return kind


def _state(self: Any) -> dict[str, Any]:
    """What a pickle holds: numpy's arrays, as JAX's would be cut to 32 bits where that is all."""
    jax = imported("jax")

    def kept(value: Any) -> Any:
        held = jax is not None and isinstance(value, jax.Array) and not is_traced(value)
        return np.asarray(value) if held else value

    return {name: kept(value) for name, value in vars(self).items()}


def outline(self: Any) -> str:
    """The ``repr`` of a dataclass; long arrays, and those without values (jit), by their shape."""

    def short(value: Any) -> str:
        small = has_values(value) and np.size(value) <= _LONGEST_SHOWN
        if small or not hasattr(value, "shape"):
            return repr(value)
        return f"{value.dtype}[{','.join(map(str, value.shape))}]"

    names = (field.name for field in dataclasses.fields(self) if field.repr)
    told = ", ".join(f"{name}={short(getattr(self, name))}" for name in names)
    return f"{type(self).__name__}({told})"


def has_values(*arrays: Any) -> bool:
    """False while traced, and if ``jax.tree.map`` or ``jax.eval_shape`` replaced the arrays."""
    return all(hasattr(each, "__array__") for each in arrays) and not is_traced(*arrays)


def assembled(kind: type[T], values: dict[str, Any]) -> T:
    """An object of a dataclass with these fields, without its constructor.

    A constructor's annotations say what callers may pass; a tree may hold anything that JAX puts
    into it (tracers, shapes, None).
    """
    made = object.__new__(kind)
    vars(made).update(values)  # the dataclass is frozen
    return made


def map_arrays(function: Callable[[Any], Any], tree: T) -> T:
    """The tree with a function applied to every array; like ``jax.tree.map``, without JAX.

    Args:
        function: of one array.
        tree: of :func:`array_tree` classes, arrays and None.
    """
    if tree is None:
        return tree
    if not dataclasses.is_dataclass(tree) or isinstance(tree, type):
        return function(tree)
    changed = {
        field.name: value if _STATIC in field.metadata else map_arrays(function, value)
        for field in dataclasses.fields(tree)
        for value in [getattr(tree, field.name)]
    }
    return assembled(type(tree), changed)


def read_only(tree: T) -> T:
    """The tree with copies of numpy's arrays, which nobody writes to; JAX's are so already.

    Args:
        tree: as of :func:`map_arrays`.
    """

    def copied(leaf: Any) -> Any:
        if isinstance(leaf, np.ndarray):
            leaf = leaf.copy()
            leaf.flags.writeable = False
        return leaf

    return map_arrays(copied, tree)


def batch_of_one(tree: T) -> T:
    """The tree as a batch of one: numpy arrays with a leading axis; float64 if they are floating.

    Args:
        tree: as of :func:`map_arrays`, with concrete values.
    """

    def alone(leaf: Any) -> np.ndarray:
        values = np.asarray(leaf)
        return (values.astype(float) if values.dtype.kind == "f" else values)[None]

    return map_arrays(alone, tree)


def each_image(tree: Any, change: Callable[[Any, int], Any]) -> Any:
    """The tree with ``change`` applied to every array that has an axis of images."""
    changed: dict[str, Any] = {}
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        axis = _axis_of_images(str(field.type))
        if dataclasses.is_dataclass(value):
            value = each_image(value, change)
        elif value is not None and axis is not None:
            value = change(value, axis)
        changed[field.name] = value
    return assembled(type(tree), changed)


def first_images(result: T, images: int) -> T:
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


def plain(value: Any) -> Any:
    """For JSON: numpy's arrays as lists, its scalars as Python's, None for what is not finite."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _register(kind: type) -> None:
    from jax import tree_util

    fields = dataclasses.fields(kind)
    names = tuple(field.name for field in fields if _STATIC not in field.metadata)
    others = tuple(field.name for field in fields if _STATIC in field.metadata)
    keys = tuple(tree_util.GetAttrKey(name) for name in names)

    def parts(tree: Any) -> tuple[tuple, tuple]:
        held = vars(tree)
        return tuple(held[name] for name in names), tuple(held[name] for name in others)

    def parts_with_keys(tree: Any) -> tuple[tuple, tuple]:
        arrays, rest = parts(tree)
        return tuple(zip(keys, arrays, strict=True)), rest

    def whole(rest: tuple, arrays: Any) -> Any:
        return assembled(kind, dict(zip(names + others, (*arrays, *rest), strict=True)))

    tree_util.register_pytree_with_keys(kind, parts_with_keys, whole, parts)
