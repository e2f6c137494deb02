"""What one problem or answer and a batch of them share: parts of a batch, and its length."""

from __future__ import annotations

from typing import Any, ClassVar, TypeVar

import numpy as np

from jaxcal import InputError
from jaxcal.runtime.array_types import AnyArray
from jaxcal.runtime.arrays import is_on_one_processor, is_traced, like, map_arrays

Whole = TypeVar("Whole", bound="OneOrBatch")


class OneOrBatch:
    """One of something, or a batch of them, with an array ``mask`` of (*batch, n)."""

    mask: Any

    _one: ClassVar[str] = "one calibration"
    """What it is without batch axes, in words."""

    def __getitem__(self: Whole, index: Any) -> Whole:
        """Some parts of a batch.

        Raises:
            IndexError: beyond the batch.
            InputError: without batch axes, so that a loop over it does not end silently; a traced
                index.
        """
        self._check_batch()
        if is_traced(index):
            raise InputError("a batch is not indexed by traced numbers: index each of its arrays")
        given = index if isinstance(index, tuple) else (index,)
        # JAX takes no lists.
        given = tuple(np.asarray(each) if isinstance(each, list) else each for each in given)
        axes = self.mask.ndim - 1
        # Numpy raises an error for an index outside the batch; JAX would clip it.
        np.empty(self.mask.shape[:-1])[given]

        def taken(leaf: Any) -> AnyArray:
            near = isinstance(leaf, np.ndarray) or is_on_one_processor(leaf)
            # JAX would compile a program for every shape of a batch, and keep it.
            whole = np.asarray(leaf) if near else leaf
            # With all the other axes named, an ellipsis in the index stands for the batch's only.
            part = whole[(*given, *(slice(None),) * (leaf.ndim - axes))]
            # An element of a numpy array is a scalar, not an array.
            return like(leaf, part) if near else part

        return map_arrays(taken, self)

    def __len__(self) -> int:
        """Number of parts along the first axis of a batch.

        Raises:
            InputError: without batch axes.
        """
        self._check_batch()
        return self.mask.shape[0]

    def __bool__(self) -> bool:
        """True, also for an empty batch, and without batch axes, where there is no length."""
        return True

    def _check_batch(self) -> None:
        if self.mask.ndim == 1:
            raise InputError(f"this is {self._one}, not a batch of them: it has no parts")
