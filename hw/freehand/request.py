"""What a free-hand run is asked for, who it is asked by, and how it tells that it ended early."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from hw.freehand.guide import Rules
from hw.recording.check import settings_of
from hw.runtime.hosts import check_host
from jaxcal import CalibrationError, InputError
from jaxcal.cli.common import ExitCode
from jaxcal.data.recording import MINIMUM_IMAGES, check_spacing_unit
from jaxcal.io.frame_names import FramePair
from jaxcal.io.openigtlink import PORT

_ENOUGH = 30
"""Default number of images to take."""
_LONGEST_LAG_S = 5.0


@dataclass(frozen=True)
class FreeHand:
    """What to acquire, and from where.

    Attributes:
        host: of the OpenIGTLink server.
        port: of it.
        images: to take.
        source: tracked frame on the probe; None: found from the stream.
        target_frame: frame that the target rests in; None: found from the stream.
        device: that sends the images; None: any.
        lag_s: an image stamped t shows what was at t - lag.
        spacing_mm: [lateral, axial] mm per px, when known.
        rules: when an image is taken.

    Raises:
        InputError: a host, a number of images, a lag or a spacing that cannot be.
    """

    host: str
    port: int = PORT
    images: int = _ENOUGH
    source: str | None = None
    target_frame: str | None = None
    device: str | None = None
    lag_s: float = 0.0
    spacing_mm: tuple[float, float] | None = None
    rules: Rules = field(default_factory=Rules)

    def __post_init__(self) -> None:
        check_host(self.host)
        if not MINIMUM_IMAGES <= self.images <= 1000:
            raise InputError(f"images must be {MINIMUM_IMAGES} to 1000, not {self.images}")
        if not abs(self.lag_s) <= _LONGEST_LAG_S:
            raise InputError(
                f"the lag must be -{_LONGEST_LAG_S:g} to {_LONGEST_LAG_S:g} s, not {self.lag_s:g}"
            )
        if self.spacing_mm is not None:
            check_spacing_unit(np.array(self.spacing_mm))

    def settings(self, pair: FramePair) -> dict[str, Any]:
        """What a recording keeps of it, for :func:`recorded_request`.

        Args:
            pair: the frames that the poses lead from and to.
        """
        return {**asdict(self), "source": pair[0], "target_frame": pair[1]}


def recorded_request(
    path: str | os.PathLike[str], kind: str, asked: FreeHand
) -> tuple[FreeHand, Mapping[str, Any]]:
    """What a recording was begun with; the file is not trusted.

    Args:
        path: of a recording that ended early.
        kind: of the run: its key in the recording's settings.
        asked: of which only host and port are taken.

    Returns:
        The request, and everything that the settings have under ``kind``.

    Raises:
        FormatError: not a recording of an acquisition.
        InputError: begun with another kind of run, or settings that cannot be.
    """
    told = settings_of(path).get(kind)
    try:
        if not isinstance(told, dict):
            raise TypeError
        if not all(isinstance(told[name], str) for name in ("source", "target_frame")):
            raise TypeError
        if not isinstance(told["device"], str | None):
            raise TypeError
        spacing = told["spacing_mm"]
        return FreeHand(
            asked.host,
            asked.port,
            int(told["images"]),
            told["source"],
            told["target_frame"],
            told["device"],
            float(told["lag_s"]),
            None if spacing is None else (float(spacing[0]), float(spacing[1])),
            Rules(**{**told["rules"], "region": _four(told["rules"]["region"])}),
        ), told
    except (TypeError, KeyError, ValueError, IndexError, OverflowError):
        raise InputError(
            f"{path}: has no settings of a {kind} run: was it begun by another command?"
        ) from None


def _four(region: object) -> tuple[int, int, int, int] | None:
    if region is None:
        return None
    if not isinstance(region, list) or len(region) != 4:
        raise ValueError
    left, top, wide, high = (int(value) for value in region)
    return left, top, wide, high


class FreeHandStopped(CalibrationError):
    """A run that ended early; one line with what happened and what to do next.

    Args:
        message: the line.
        interrupted: by the person.
    """

    def __init__(self, message: str, *, interrupted: bool) -> None:
        super().__init__(message)
        self.exit_code = ExitCode.INTERRUPTED if interrupted else ExitCode.STOPPED


@runtime_checkable
class Person(Protocol):
    """The person who holds the probe: what they are shown, and the keys that they press."""

    def show(self, frame: np.ndarray, words: str, advice: str) -> None:
        """The newest frame, what is said of it, and what is missing."""
        ...

    def say(self, line: str) -> None:
        """A line that stays."""
        ...

    def key(self) -> str | None:
        """The next key that was pressed; None where there was none."""
        ...
