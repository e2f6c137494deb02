"""Shapes in annotations mean what they say: the checks pass over those that cannot be read."""

from __future__ import annotations

import ast
import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import get_type_hints

import jaxtyping
import numpy as np
import optimistix as optx
import pytest
import xarray
from jaxtyping import Float
from matplotlib.figure import Figure

import jaxcal
import jaxcal.design
import jaxcal.study
from jaxcal.data.segmentation.segment import Segmentation

HOME = Path(__file__).parents[1]


def unreadable(source: str) -> list[str]:
    """Shapes that are no text (``Float[Array, 3]``), or no text that jaxtyping takes."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if not (isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name)):
            continue
        kind, parts = getattr(jaxtyping, node.value.id, None), node.slice
        if not (isinstance(kind, type) and isinstance(parts, ast.Tuple) and len(parts.elts) == 2):
            continue
        try:
            kind[np.ndarray, ast.literal_eval(parts.elts[1])]
        except (AttributeError, ValueError):
            found.append(ast.unparse(node))
    return found


def test_every_shape_can_be_read():
    for package in ("jaxcal", "hw"):
        for path in (HOME / package).rglob("*.py"):
            assert unreadable(path.read_text()) == [], path


def test_shapes_that_mean_nothing_are_found():
    wrong = "a: Float[Array, 3]\ndef f(b: Int[np.ndarray, '*k ...']) -> Float[Array, ' 3']: ..."
    assert unreadable(wrong) == ["Float[Array, 3]", "Int[np.ndarray, '*k ...']"]


def readable(value: object) -> list[object]:
    """What of a public name has annotations: a function, or a class with its methods."""
    if not inspect.isclass(value):
        return [value] if inspect.isfunction(value) else []
    named = [each for name, each in vars(value).items() if not name.startswith("_")]
    own = [getattr(each, "__func__", getattr(each, "fget", each)) for each in named]
    return [value, *filter(inspect.isfunction, own)]


@pytest.mark.parametrize("module", [jaxcal, jaxcal.design, jaxcal.study])
def test_annotations_of_public_names_can_be_evaluated(module):
    # These are imported for the type checker alone: they take long, or need not be installed.
    late = {"Figure": Figure, "Segmentation": Segmentation, "optx": optx, "xarray": xarray}
    for name in dir(module):
        for each in readable(getattr(module, name)):
            get_type_hints(each, localns=late)


def test_calls_and_results_are_checked():
    """Sizes of one name agree within a call, by place, by name, and in the result."""

    @jaxtyping.jaxtyped(typechecker=None)
    def longer(first: Float[np.ndarray, " n"], *more: int, by: int = 1) -> Float[np.ndarray, "n 2"]:
        return np.zeros((len(first) + by, 2))

    assert len(longer(np.zeros(3), by=0)) == 3
    for place, arguments, named in [
        ("the result", (np.zeros(3),), {}),
        ("first", (np.zeros((3, 1)),), {"by": 0}),
        ("an argument", (np.zeros(3), "1"), {"by": 0}),
        ("by", (), {"first": np.zeros(3), "by": 0.0}),
    ]:
        with pytest.raises(jaxtyping.TypeCheckError, match=f"longer, {place}: "):
            longer(*arguments, **named)

    @jaxtyping.jaxtyped(typechecker=None)
    @dataclass
    class Two:
        first: Float[np.ndarray, " n"]
        second: Float[np.ndarray, " n"]

    assert Two(np.zeros(2), np.zeros(2)).second.size == 2
    with pytest.raises(jaxtyping.TypeCheckError, match="__init__, second: "):
        Two(np.zeros(2), np.zeros(3))
