"""Shapes in annotations mean what they say: the checks pass over those that cannot be read."""

from __future__ import annotations

import ast
from pathlib import Path

import jaxtyping
import numpy as np

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
