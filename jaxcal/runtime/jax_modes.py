"""Which of JAX's modes jaxcal computes in, and when, as a guest in the caller's process.

A calibration loses six digits in float32, so it is computed in float64, which JAX has switched off
by default. jaxcal changes none of the process' settings. A public function that is called with
values enters the modes that it needs and leaves them when it returns (:func:`in_own_modes`):

- 64 bits. Where the caller has them switched off, results come back as numpy arrays, which keep
  their 64 bits; JAX makes 32-bit arrays of them where the caller hands them on to JAX.
- JAX's standard promotion of dtypes and ranks: strict promotion is meant for the caller's code.
- no ``debug_nans``, ``debug_infs``: a problem that has no answer holds NaN on purpose, and its
  status says so.

Inside a jit, vmap or grad of the caller, the caller decides the number of bits: arrays have lost
theirs before any function sees them. A calibration there needs 64 bits (:func:`require_float64`),
unless ``float32`` is asked for. Promotion is standard there, too.

Functions that need no JAX do not import it: if nobody has imported it, there are no modes to enter.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

from jaxcal import InputError
from jaxcal.runtime.arrays import decided, is_traced, jax_in_use, map_arrays

P = ParamSpec("P")
T = TypeVar("T")


def is_float64_on() -> bool:
    """Whether JAX makes 64-bit arrays here and now; so does numpy where JAX is not imported."""
    jax = jax_in_use()
    return jax is None or jax.numpy.result_type(float) == np.float64


def inside_transformation(*arguments: object) -> bool:
    """Whether the code that runs now is inside somebody else's jit, vmap or grad."""
    jax = jax_in_use()
    if jax is None:
        return False
    # Under jit even a constant is a tracer; under vmap and grad only what depends on an argument.
    # device_put, since jax.numpy.zeros would be compiled.
    marked = (arguments, jax.device_put(np.float32(0)))
    # JAX warns of an iterator, and what it yields cannot be looked at.
    leaves = jax.tree.leaves(marked, is_leaf=lambda node: isinstance(node, Iterator))
    return any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


@contextmanager
def own_modes(*, bits_too: bool = True) -> Iterator[None]:
    """The modes of JAX that jaxcal's code is written for, in this thread.

    Args:
        bits_too: also switch 64 bits on, and ``debug_nans`` and ``debug_infs`` off; not inside a
            transformation that began without.
    """
    import jax

    # No ExitStack: a Ctrl-C while it works, in Python, would leave the caller in these modes.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        if not bits_too:
            yield
            return
        with jax.enable_x64(True), jax.debug_nans(False), jax.debug_infs(False):
            yield


def in_own_modes(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a public function: its body runs in :func:`own_modes`.

    If it is called with values and the caller has 64 bits switched off, the JAX arrays of its
    result (a pytree) are returned as numpy arrays.
    """

    def in_modes(*args: P.args, **kwargs: P.kwargs) -> T:
        jax = jax_in_use()
        if jax is None:
            return function(*args, **kwargs)
        if inside_transformation(args, kwargs):
            with own_modes(bits_too=False):
                return function(*args, **kwargs)
        keep = is_float64_on()
        with own_modes():
            result = function(*args, **kwargs)
            return result if keep else jax.tree.map(_without_jax, result)

    @wraps(function)
    def guest(*args: P.args, **kwargs: P.kwargs) -> T:
        return decided(in_modes, *args, **kwargs)

    return guest


def importing_jax(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a public function that needs JAX; placed outside :func:`in_own_modes`.

    If the function imported JAX itself, it would run in the caller's modes.
    """

    @wraps(function)
    def after_import(*args: P.args, **kwargs: P.kwargs) -> T:
        importlib.import_module("jax")
        return function(*args, **kwargs)

    return after_import


in_standard_promotion = own_modes(bits_too=False)
"""Decorates a rule that JAX calls later, outside the public function that it belongs to.

Rules of differentiation and batching of a function that the caller compiled are traced when the
caller transforms it.
"""


def traceable(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a user of ``array_module``, which then runs traced in JAX's standard modes."""

    @wraps(function)
    def in_standard_modes(*args: P.args, **kwargs: P.kwargs) -> T:
        if not is_traced(args, kwargs):
            return function(*args, **kwargs)
        with own_modes(bits_too=False):
            return function(*args, **kwargs)

    return in_standard_modes


def require_float64(name: str) -> None:
    """Refuse to compute in 32 bits by accident.

    Args:
        name: of the function that was called.

    Raises:
        InputError: inside a transformation that began without 64 bits; it says what to do.
    """
    if not is_float64_on():
        raise InputError(
            f"{name} computes in 64 bits, and JAX's are switched off inside this jit, vmap or "
            "grad. Call the transformed function inside 'with jax.enable_x64(True):', or start "
            "Python with JAX_ENABLE_X64=1"
        )


def with_dtype(tree: T, dtype: Any) -> T:
    """A tree (:func:`map_arrays`) whose floating arrays, traced or not, have this dtype."""
    jax = jax_in_use()
    # Only JAX's functions know of bfloat16 and its like.
    xp = np if jax is None else jax.numpy

    def cast(leaf: Any) -> Any:
        other = xp.issubdtype(leaf.dtype, xp.floating) and leaf.dtype != dtype
        return leaf.astype(dtype) if other else leaf

    return map_arrays(cast, tree)


def _without_jax(leaf: Any) -> Any:
    import jax
    import jax.numpy as jnp

    # A random key cannot become a numpy array.
    is_key = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(leaf) if isinstance(leaf, jax.Array) and not is_key else leaf
