"""A look at each device of a bench: what it is, what it sends, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from hw.active_echo.device import ActiveEcho
from hw.robot.identity import LOCAL
from hw.robot.rtde import state_text
from hw.robot.stream import PoseStream
from hw.runtime.clock import Clock, Waiting
from hw.runtime.errors import DeviceError, StaleError
from hw.runtime.extras import missing
from hw.setup.description import Setup
from hw.ultrasound.receiver import UltrasoundStream

_TURN_WALL_S = 0.1
_Item = TypeVar("_Item")


@dataclass(frozen=True)
class Finding:
    """What was found of one device.

    Attributes:
        device: which.
        facts: what it is and sends, a line.
        wrong: one line each; empty if all is well.
    """

    device: str
    facts: str
    wrong: tuple[str, ...] = ()


def check(setup: Setup, seconds: float = 2.0) -> list[Finding]:
    """Look at every device of a setup for some bench seconds each; nothing moves.

    Args:
        setup: where they are.
        seconds: to watch each stream.
    """
    looks = {"robot": _robot, "active echo": _active_echo}
    if setup.ultrasound is not None:
        looks["ultrasound"] = _ultrasound
    found = []
    for name, look in looks.items():
        try:
            found.append(look(setup, seconds))
        except DeviceError as error:
            found.append(Finding(name, "not usable", (error.args[0],)))
    return found


def _robot(setup: Setup, seconds: float) -> Finding:
    wrong = []
    absent = missing("rtde_control", extra="robot")
    if absent is not None:
        wrong.append(f"poses can be read, but nothing can be moved: {absent}")
    with PoseStream(setup.robot_host, clock=setup.clock, frequency_hz=setup.frequency_hz) as stream:
        identity = stream.identity()
        stream.drain()
        steady = stream.steady(seconds)
        samples = stream.drain()
        times = np.array([sample.t_device for sample in samples])
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0
        trouble = state_text(steady.sample.robot_mode, steady.sample.safety_bits)
        if trouble:
            wrong.append(trouble)
        if identity.remote is False:
            wrong.append(LOCAL)
        gaps = np.diff(times)
        if len(gaps) and gaps.max() > 5 * np.median(gaps):
            wrong.append(f"poses stopped for {gaps.max():.2f} s: look at the network")
        if steady.scatter_mm > 0.2:
            wrong.append(f"it does not rest: poses scatter by {steady.scatter_mm:.2f} mm")
        if stream.tcp_offset is None and setup.tcp_offset is None:
            wrong.append("it does not report its TCP offset: put [robot] tcp_offset into the setup")
    name = identity.name
    if not identity.identified:
        name += " (nothing identifies this arm: neither serial number nor calibration is reported)"
    return Finding("robot", f"{name}, {stream.pendant}, {rate:.0f} poses/s", tuple(wrong))


def _active_echo(setup: Setup, seconds: float) -> Finding:
    wrong = []
    with ActiveEcho(setup.active_echo_url, clock=setup.clock, lines=setup.probe.elements) as echo:
        name, hz = echo.identify(), echo.clock_hz()
        before, began = echo.trigger_count(), setup.clock.now()
        echo.stream(True)
        frames = _come(echo.read, setup.clock, seconds)
        counts = echo.statistics()
        triggers = echo.trigger_count()
        rate = (triggers[1] - before[1]) / (setup.clock.now() - began)
        if triggers[1] == before[1]:
            wrong.append("no frame triggers come: is the ultrasound machine frozen or unplugged?")
        elif not frames:
            wrong.append(
                f"triggers come but no frames of {setup.probe.elements} lines ({counts.short} of "
                "other lengths): are the line triggers connected, the number of lines right?"
            )
        if counts.crc_errors:
            wrong.append(f"{counts.crc_errors} frames arrived damaged: check its cable")
        if counts.lost:
            wrong.append(f"{counts.lost} frames were lost: look at its trigger")
        error = echo.device_error()
        if error is not None:
            wrong.append(f"it keeps an error: {error}")
    return Finding(
        "active echo", f"{name}, clock {hz / 1e6:g} MHz, {rate:.0f} frames/s", tuple(wrong)
    )


def _ultrasound(setup: Setup, seconds: float) -> Finding:
    assert setup.ultrasound is not None
    wrong = []
    with UltrasoundStream(*setup.ultrasound, clock=setup.clock) as stream:
        began = setup.clock.now()
        images = _come(stream.read, setup.clock, seconds)
        counts, watched = stream.statistics(), setup.clock.now() - began
    facts = "no images"
    if not images:
        wrong.append(
            "the server is there and sends no images"
            + (f" that are understood ({counts.reason})" if counts.unsupported else ": freeze off?")
        )
    else:
        height, width = images[-1].array.shape
        rate = counts.received / watched
        facts = f"{width} x {height} {images[-1].array.dtype}, {rate:.0f} images/s"
        if all(np.array_equal(image.array, images[0].array) for image in images[1:]):
            wrong.append("every image is the same: is the machine frozen?")
    if counts.crc_errors:
        wrong.append(f"{counts.crc_errors} messages arrived damaged: look at the network")
    return Finding("ultrasound", facts, tuple(wrong))


def _come(read: Callable[[float], _Item], clock: Clock, seconds: float) -> list[_Item]:
    """What a stream sends while it is watched for some bench seconds, or until it is lost.

    A process that is suspended or held up does not watch: what came meanwhile is still unread.

    Raises:
        DeviceError: it was lost before anything came.
    """
    items: list[_Item] = []
    waiting = Waiting(clock)
    while waiting.so_far() < seconds:
        try:
            items.append(read(_TURN_WALL_S * clock.speed))
        except StaleError:
            continue
        except DeviceError:
            if items:
                break
            raise
    return items
