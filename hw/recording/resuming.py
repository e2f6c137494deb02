"""Whether a recording that is resumed fits the bench as it is now.

Images taken with another probe or another mounting do not fit together with those in the recording:
such a difference is refused by name. Other limits, or an edited plan, change what the robot does
but not what the images mean: they are reported, and the plan is confirmed with them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from hw.recording.check import Progress
from hw.robot.stream import offset_changed
from hw.runtime.errors import RefusedError, refused
from hw.setup.description import Setup
from jaxcal import InputError
from jaxcal.runtime.messages import quoted

if TYPE_CHECKING:
    from hw.active_echo.device import ActiveEcho

_SAME = 1e-9
"""Relative difference below which two numbers are the same."""
_LONGEST_IDENTITY = 200


def described(setup: Setup, targets: np.ndarray) -> dict[str, Any]:
    """What a recording keeps of its bench, ready for JSON: probe, scene, limits, plan."""
    content = {
        "probe": asdict(setup.probe),
        "scene": {name: value.tolist() for name, value in vars(setup.scene).items()},
        "limits": dict(setup.limits),
        "plan_sha256": hashlib.sha256(np.ascontiguousarray(targets, float).tobytes()).hexdigest(),
    }
    return json.loads(json.dumps(content))


def check_same(table: str, kept: object, now: Mapping[str, Any]) -> None:
    """Refuse a bench after which the images would not fit together.

    Args:
        table: of the setup.
        kept: what the recording has of it; what it lacks is not compared.
        now: what the bench has.

    Raises:
        InputError: a value differs; table and key are named.
    """
    for name, value in now.items():
        if isinstance(kept, dict) and name in kept and not _same(kept[name], value):
            raise InputError(
                f"was recorded with [{table}] {name} = {_shown(kept[name])}, this bench has "
                f"{_shown(value)}: the images would not fit together"
            )


def compare(progress: Progress, setup: Setup) -> list[str]:
    """Differences between a recording and the bench that do not change what its images mean.

    Args:
        progress: what the recording holds.
        setup: the bench now.

    Returns:
        One line for each difference that a person has to confirm.

    Raises:
        InputError: a difference after which the images would not fit together.
    """
    now = described(setup, progress.targets)
    before = progress.settings.get("bench")
    before = before if isinstance(before, dict) else {}
    # The calibration uses the file's own /probe; recordings older than this check have it too.
    check_same("probe", progress.probe, now["probe"])
    for table in ("probe", "scene"):
        check_same(table, before.get(table), now[table])
    changes = []
    limits = before.get("limits")
    if isinstance(limits, dict):
        for name in sorted({*limits, *now["limits"]}):
            old, new = limits.get(name), now["limits"].get(name)
            if not _same(old, new):
                changes.append(
                    f"[limits] {quoted(name)} was {_shown(old)}, is {_shown(new)} from here on"
                )
    if before.get("plan_sha256") not in (None, now["plan_sha256"]):
        changes.append("the plan in the file is not the one that it was begun with: it was edited")
    return changes


def check_same_robot(before: object, serial: str, tcp_offset: Sequence[float]) -> None:
    """Refuse a robot, or a TCP offset, other than those of the images taken so far."""
    if before is None:
        return
    try:
        known, numbers = before["serial_number"], before["tcp_offset"]  # pyright: ignore[reportIndexIssue]
        offset = np.array(numbers, dtype=np.float64).reshape(6)
    except (TypeError, KeyError, ValueError):
        raise refused("the recording does not say with which robot it began") from None
    if known != serial:
        what = f"the recording was begun with robot {known}, this one is {serial}"
    elif offset_changed(offset.tolist(), tcp_offset):
        what = (
            f"the recording was begun with the TCP offset {offset.tolist()} (m, rad), it is "
            f"{list(tcp_offset)} now"
        )
    else:
        return
    raise refused(f"{what}: its images would not fit together")


def described_electronics(echo: ActiveEcho) -> dict[str, float | str]:
    """What a recording keeps of its electronics, as attributes of /ae."""
    # A device may say anything, but HDF5 takes no text with zeros in it.
    identity = ascii(echo.identify())[1:-1][:_LONGEST_IDENTITY]
    return {"clock_hz": echo.clock_hz(), "identity": identity}


def compare_electronics(kept: Mapping[str, object], now: Mapping[str, float | str]) -> list[str]:
    """Whether the electronics are those of a recording.

    Args:
        kept: what the recording has of :func:`described_electronics`.
        now: of the electronics at hand.

    Returns:
        A line that says so if they are another unit, or have another firmware: with the same clock
        their frames mean the same.

    Raises:
        RefusedError: they have another clock: all ticks of a recording are of one clock.
    """
    clock, unit = kept.get("clock_hz"), kept.get("identity")
    if clock is not None and not _same(clock, now["clock_hz"]):
        raise RefusedError(
            f"the recording was begun with electronics that count {_shown(clock)} ticks a second, "
            f"these count {_shown(now['clock_hz'])}: their frames would not fit together",
            device="active echo",
        )
    if unit in (None, now["identity"]):
        return []
    return [f"the electronics were {_shown(unit)}, are {_shown(now['identity'])} from here on"]


def _same(old: Any, new: Any) -> bool:
    try:
        first, second = np.asarray(old, float), np.asarray(new, float)
    except (TypeError, ValueError, OverflowError):
        return old == new
    return first.shape == second.shape and np.allclose(first, second, _SAME, _SAME)


def _shown(value: Any) -> str:
    return "not given" if value is None else quoted(json.dumps(value), 120).strip("'")
