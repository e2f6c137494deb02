"""The loop over a batch that every solver runs: until no problem is active any more.

All problems of a batch take the same passes, so the batch waits for its slowest problem. A small
batch on a CPU does not mind. On an accelerator a batch has many thousand problems, and of these a
few take ten times as many passes as most. So a large batch is left when few problems are still
active, and these go on alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

State = TypeVar("State")

LARGE_BATCH = 4096
"""Batches of fewer problems stay whole, since the second loop has to be compiled, too. A CPU solves
far fewer side by side."""

PROBLEMS_PER_STRAGGLER = 16
"""At most one problem in so many goes on alone. On an H100, a pass over a sixteenth of 65,536
problems of 20 images takes little longer than one over a single problem."""


def until_done(
    step: Callable[[State, Any], State],
    state: State,
    data: Any,
    active: Callable[[State], Bool[Array, " batch"]],
    *,
    together: bool = False,
) -> State:
    """Take a step again and again, until no problem is active.

    Args:
        step: from the state and the data to the state after one more pass; it leaves problems that
            are not active as they are.
        state: before the first pass. Its leaves have the batch axis last.
        data: what stays the same. The batch is the first axis of a leaf that is as long as the
            batch; of a large batch no other axis of that size may come before it. A leaf without
            such an axis is the same for all problems.
        active: which problems are not finished.
        together: whether a large batch stays whole, too.
    """

    def more_than(few: int) -> Callable[[State], Bool[Array, ""]]:
        return lambda state: jnp.sum(active(state)) > few

    batch = jax.eval_shape(active, state).shape[0]
    few = batch // PROBLEMS_PER_STRAGGLER if batch >= LARGE_BATCH and not together else 0
    state = jax.lax.while_loop(more_than(few), lambda state: step(state, data), state)
    if not few:
        return state
    # Places that are not needed hold the last problem, and are dropped in the end.
    rows = jnp.flatnonzero(active(state), size=few, fill_value=batch)

    def of_few(leaf: Array, axis: int) -> Array:
        return jnp.take(leaf, rows, axis, mode="clip")

    some = jax.tree.map(lambda leaf: of_few(leaf, -1), state)
    theirs = jax.tree.map(
        lambda leaf: of_few(leaf, leaf.shape.index(batch)) if batch in leaf.shape else leaf, data
    )
    some = jax.lax.while_loop(more_than(0), lambda state: step(state, theirs), some)
    return jax.tree.map(lambda all, of: all.at[..., rows].set(of, mode="drop"), state, some)
