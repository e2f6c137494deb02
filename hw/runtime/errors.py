"""Errors of the bench's devices: one clear line each, and the device that it came from.

These errors stay apart from :class:`jaxcal.CalibrationError` so that the small processes that talk
to devices start without importing JAX.
"""

from __future__ import annotations

from functools import partial
from typing import Literal

Device = Literal["robot", "active echo", "ultrasound", "tracker"]


class DeviceError(Exception):
    """Base of every error of a device; its text is one line meant for a person.

    Args:
        message: what was wrong and what to do.
        device: the device that it came from.
    """

    exit_code = 4
    """Of the command line (``jaxcal.cli.common.ExitCode.STOPPED``)."""

    def __init__(self, message: str, *, device: Device) -> None:
        super().__init__(" ".join(message.split()))
        self.device: Device = device

    def __str__(self) -> str:
        return f"{self.device}: {super().__str__()}"

    def __reduce__(self) -> tuple:
        return partial(type(self), device=self.device), (self.args[0],)


class StaleError(DeviceError):
    """Nothing new came in time; the connection may still be there."""


class LostError(DeviceError):
    """The connection is gone, or the device stopped answering."""


class RefusedError(DeviceError):
    """The safety gate, or the device, refused what was asked, or a robot's setting was changed.

    Nothing moved, unless the change came during a motion: then the robot was stopped.
    """


class StoppedError(DeviceError):
    """A motion was stopped before it arrived; the text says why."""


def refused(message: str) -> RefusedError:
    """What the robot's gate, or one of its checks, does not allow."""
    return RefusedError(message, device="robot")
