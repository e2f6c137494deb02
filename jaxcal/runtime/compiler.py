"""How our programs are traced and compiled: XLA's flags on a CPU; elsewhere its defaults apply.

Two aims contradict each other. Plain batches hold millions of problems, and their inner loops
should run as fast as the hardware allows: :func:`fast_to_run`. For one problem, a person waits for
the compiler and not for the answer: :func:`quick_to_compile`.

Flags belong to a whole program, so none are given inside somebody else's jit, vmap or grad. Flags
come and go with versions of XLA, so each is only a wish: it is tried once, and left out if the
compiler does not know it (:func:`known`).
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from jax.typing import ArrayLike

T = TypeVar("T")

SWITCH = "JAXCAL_FAST_MATH"
"""Environment variable; with 0, batches are compiled with the default flags."""

Flags = dict[str, Any]

FAST_MATH: Flags = {
    "xla_cpu_enable_fast_math": True,
    "xla_cpu_fast_math_honor_nans": True,
    "xla_cpu_fast_math_honor_infs": True,
}
"""The compiler gets all of these, or none if it does not know one of them."""

_log = logging.getLogger(__name__)


def known(platform: str, flags: Flags) -> Flags:
    """The flags that the present compiler knows.

    Args:
        platform: ``cpu``, ``gpu`` or ``tpu``, as :func:`jax.default_backend` says it.
        flags: by the names of XLA's debug options.

    Returns:
        The known ones. A flag that is not known is logged at level DEBUG and changes nothing.
    """
    items = tuple(flags.items())
    if _are_known(platform, items):
        return dict(flags)
    found = {name: value for name, value in items if _are_known(platform, ((name, value),))}
    # Fast math without NaN and Inf gives a bad problem a wrong answer, not NaN: all three or none.
    if not FAST_MATH.keys() <= found.keys():
        found = {name: value for name, value in found.items() if FAST_MATH.get(name) != value}
    return found


@cache
def _are_known(platform: str, flags: tuple[tuple[str, Any], ...]) -> bool:
    import jax

    # Tried on the smallest program; XLA refuses all flags of a call if it refuses one.
    try:
        with jax.default_device(jax.local_devices(backend=platform)[0]):
            program = jax.jit(lambda x: x, compiler_options=dict(flags))
            program.lower(np.float32(0)).compile()
    except (jax.errors.JaxRuntimeError, ValueError, TypeError) as error:
        _log.debug("compiler flags refused: %s (%s)", flags, error)
        return False
    return True


def batch_flags() -> Flags:
    """Flags for a program that solves batches on a CPU.

    Sums over images vectorise only if they may be reordered, which fast math allows. NaN and Inf
    keep their meaning. Reruns are bitwise equal, and answers are within 1e-12 mm of those with
    default flags.
    """
    if os.environ.get(SWITCH, "1") == "0":
        return {}
    return FAST_MATH | {"xla_cpu_prefer_vector_width": 512}


def fast_to_run(platform: str) -> Flags | None:
    """Those of :func:`batch_flags` that the compiler knows, or None where there are none."""
    flags = batch_flags()
    return known(platform, flags) if platform == "cpu" and flags else None


def quick_to_compile(platform: str) -> Flags | None:
    """Flags for a program that a person waits for, or None.

    With jax 0.10, building every fusion with MLIR is half of the compiler's work, and no gain in
    speed could be measured. jaxlib 0.11.2 dropped the flag.
    """
    return known(platform, {"xla_cpu_use_fusion_emitters": False}) if platform == "cpu" else None


@cache
def compiled(function: Callable[..., T], static: int, platform: str | None) -> Callable[..., T]:
    """A function compiled by JAX when it is first called.

    Args:
        function: a pure function of a module.
        static: the number of its argument that is static.
        platform: where it is a program of its own, which a person waits for; None inside another.
    """
    import jax

    flags = None if platform is None else quick_to_compile(platform)
    return jax.jit(function, static_argnums=static, compiler_options=flags)


ONE_PROBLEM: Flags = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}
"""Flags for a program that solves one problem and that a person waits for.

Measured on the joint method with 54 images (jax 0.10.2): 8.5 s of compilation instead of 17.7, 37
ms of run time instead of 20.
"""


def single_threaded(platform: str) -> Flags:
    """Flags that keep a program on one thread, for processes that share the cores among them."""
    return known(platform, {"xla_cpu_multi_thread_eigen": False}) if platform == "cpu" else {}


def computed_once(make: Callable[[], T], witness: ArrayLike) -> T:
    """The result of a function, as arrays that are not computed again where they are read.

    On a CPU, XLA copies a loop into each of the loops that read its result, unless it considers the
    loop expensive (integer rounds and polynomials are not). It drops optimization_barrier before it
    does so. It does not copy out of a branch, provided that it cannot tell that the branch is
    always taken.

    Args:
        make: without arguments; what it closes over may be traced.
        witness: a number that is not negative. To have an effect, it must be an argument of the
            program and the same for the whole batch. If it is negative or NaN, everything is NaN,
            so that a caller cannot mistake it for a result.

    Returns:
        The same arrays as ``make()``, which have to be floating or complex.
    """
    import jax
    import jax.core
    import jax.numpy as jnp

    taken = jnp.asarray(witness) >= 0
    if not isinstance(taken, jax.core.Tracer):
        return make()
    nothing = jax.eval_shape(make)
    return jax.lax.cond(
        taken, make, lambda: jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), nothing)
    )


def traced_once(function: Callable[..., T], *arguments: Any) -> tuple[Callable[..., T], T]:
    """A function as JAX traces it with these arguments, and zeros like its result.

    A loop that begins without a result needs its shapes before the loop calls the function; tracing
    it for each of the two would take twice as long.
    """
    import jax
    import jax.numpy as jnp
    from jax.extend.core import jaxpr_as_fun

    traced, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)

    def again(*arguments: Any) -> T:
        found = jaxpr_as_fun(traced)(*jax.tree.leaves(arguments))
        return jax.tree.unflatten(jax.tree.structure(shapes), found)

    return again, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
