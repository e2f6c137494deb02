"""Frozen dataclasses of arrays that JAX sees through (pytrees), without importing JAX.

The classes are registered when JAX is imported (:mod:`jaxcal.runtime.when_jax`), so problems and
answers that were made before that are trees as well.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar, dataclass_transform

from jaxcal.runtime.when_jax import when_jax_is_imported

T = TypeVar("T")

_STATIC = "static"


def static(*, default: Any = dataclasses.MISSING) -> Any:
    """A field of an array tree that is no array: part of the tree's structure, and hashable."""
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata={_STATIC: True})
    return dataclasses.field(default=default, metadata={_STATIC: True})


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(static,))
def array_tree(kind: type[T]) -> type[T]:
    """Decorate a class: a frozen dataclass, and a pytree of its fields but for :func:`static` ones.

    Instances compare by identity, as arrays have no single truth value.
    """
    kind = dataclasses.dataclass(frozen=True, eq=False)(kind)
    when_jax_is_imported(partial(_register, kind))
    return kind


def assembled(kind: type[T], values: dict[str, Any]) -> T:
    """An object of a dataclass with these fields, without its constructor.

    A constructor's annotations say what callers may pass; a tree may hold anything that JAX puts
    into it (tracers, shapes, None).
    """
    made = object.__new__(kind)
    for name, value in values.items():
        object.__setattr__(made, name, value)
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


def _register(kind: type) -> None:
    from jax.tree_util import GetAttrKey, register_pytree_with_keys

    fields = dataclasses.fields(kind)
    names = tuple(field.name for field in fields if _STATIC not in field.metadata)
    others = tuple(field.name for field in fields if _STATIC in field.metadata)
    keys = tuple(GetAttrKey(name) for name in names)

    def parts(tree: Any) -> tuple[tuple, tuple]:
        held = vars(tree)
        return tuple(held[name] for name in names), tuple(held[name] for name in others)

    def parts_with_keys(tree: Any) -> tuple[tuple, tuple]:
        arrays, rest = parts(tree)
        return tuple(zip(keys, arrays, strict=True)), rest

    def whole(rest: tuple, arrays: Any) -> Any:
        made = object.__new__(kind)
        # Not setattr: the dataclass is frozen, and trees are taken apart often.
        held = vars(made)
        held.update(zip(names, arrays, strict=True))
        held.update(zip(others, rest, strict=True))
        return made

    register_pytree_with_keys(kind, parts_with_keys, whole, parts)
