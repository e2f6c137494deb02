"""What the tank's studies share: grids of conditions for the engine, problems, precisions."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from common import batch_of
from jaxtyping import Float

from jaxcal import InputError, Problem
from jaxcal.study import ArraySpec, Chunk
from jaxcal.study.store import Store

_ROOM = (60, 120)
"""Images that problems are padded to with masked ones: fewer programs to compile."""


@dataclass(frozen=True)
class Grid(ABC):
    """Conditions x trials in chunks: what the engine asks of a study.

    Attributes:
        seed: of all draws.
        trials: experiments in each condition.
        chunk_trials: experiments in one file.
        conditions: in the order of the results; of :attr:`kind`.
    """

    seed: int
    trials: int
    chunk_trials: int
    conditions: tuple[Any, ...]

    kind: ClassVar[type]

    @property
    def condition_count(self) -> int:
        """Conditions."""
        return len(self.conditions)

    @property
    def _parts(self) -> int:
        return -(-self.trials // self.chunk_trials)

    @property
    def chunk_count(self) -> int:
        """Files."""
        return self.condition_count * self._parts

    def canonical(self) -> str:
        """All of it as JSON."""
        return json.dumps({"kind": self.kind.__name__, **asdict(self)}, sort_keys=True)

    @property
    def sha256(self) -> str:
        """Of the canonical text."""
        return hashlib.sha256(self.canonical().encode()).hexdigest()

    @classmethod
    def from_canonical(cls, text: str) -> Self:
        """The study of this text.

        Raises:
            InputError: it is not one of these.
        """
        try:
            content = json.loads(text)
            conditions = tuple(cls.kind(**one) for one in content.pop("conditions"))
            if content.pop("kind") != cls.kind.__name__:
                raise TypeError("of another kind")
            return cls(conditions=conditions, **content)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise InputError(f"is not a study of this kind: {error}") from None

    def chunk(self, index: int) -> Chunk:
        """The trials of a file."""
        condition, part = divmod(index, self._parts)
        start = part * self.chunk_trials
        return Chunk(index, condition, start, min(start + self.chunk_trials, self.trials))

    @abstractmethod
    def arrays(self, chunk: Chunk) -> dict[str, ArraySpec]:
        """What a chunk's file holds; trials are the last axis of each array."""

    @abstractmethod
    def compute(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """The arrays of a chunk."""


def read_all(folder: Path, study: Grid) -> dict[str, np.ndarray]:
    """Every array with conditions as its first axis and all trials as its last."""
    store = Store(folder, study)
    by_condition: list[list[dict[str, np.ndarray]]] = [[] for _ in study.conditions]
    for index in range(study.chunk_count):
        chunk = study.chunk(index)
        by_condition[chunk.condition].append(store.read(chunk))
    return {
        name: np.array(
            [np.concatenate([part[name] for part in parts], axis=-1) for parts in by_condition]
        )
        for name in by_condition[0][0]
    }


def padded_problems(
    poses: Float[np.ndarray, "batch n 4 4"],
    points: Float[np.ndarray, "batch n 2"],
    bounds: Float[np.ndarray, "batch n"] | None = None,
) -> Problem:
    """Images as a batch of problems, with room for more that are masked.

    Args:
        poses: mm.
        points: [lateral, range], mm.
        bounds: on the offsets, mm.
    """
    count = points.shape[1]
    room = next((size for size in _ROOM if size >= count), count)
    return batch_of(list(zip(poses, points, strict=True)), room, bounds)


def interval(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Mean, and half of its 95 % interval by Student's t."""
    from scipy.stats import t

    array = np.asarray(values, float)
    half = float(t.ppf(0.975, array.size - 1)) * array.std(ddof=1) / np.sqrt(array.size)
    return float(array.mean()), float(half)
