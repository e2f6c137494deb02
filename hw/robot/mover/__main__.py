"""The process that moves the robot, from its first line of input to its end."""

from __future__ import annotations

import os
import signal
from types import FrameType
from typing import NoReturn

from hw.robot.gate import Gate
from hw.robot.mover.connection import Connection
from hw.robot.mover.control_loop import ControlLoop
from hw.robot.mover.controller import Controller
from hw.robot.mover.inputs import Ended, Inputs, Stop
from hw.robot.mover.messages import Caller, Setup, told
from hw.runtime.errors import DeviceError, LostError, StoppedError
from hw.runtime.interrupts import ENDING
from hw.runtime.processes import ASKS, be_prompt


def main() -> NoReturn:
    """Move until the caller closes the input, or motion ends."""
    # A caller may have signals ignored or blocked, which is inherited: no command that hangs would
    # end then.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGALRM, *ENDING))
    caller = Caller(0, os.dup(1))
    # ur_rtde prints; only answers may go to the pipe that the caller reads.
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    try:
        message = caller.first()
        be_prompt(ASKS)
        if message is not None:
            _serve(Setup.of(message), caller)
    except Exception as error:
        caller.tell("error", ended=True, **told(_cause_of(error)))
        os._exit(1)
    os._exit(0)


def _serve(setup: Setup, caller: Caller) -> NoReturn:
    """Move, and end the process: at once, so that ur_rtde can neither reconnect nor wait.

    To return would call its destructor, which takes half a second.
    """
    inputs = Inputs(caller, setup.clock)

    def end(number: int, frame: FrameType | None) -> None:
        text = f"the motion process was asked to end ({signal.Signals(number).name})"
        inputs.latch.set(Stop(StoppedError(text, device="robot"), True))

    # A system that is shut down sends them to all processes: the robot is stopped in order.
    for number in ENDING:
        signal.signal(number, end)
    gate = Gate(setup.plan, setup.confirmation, setup.clock)
    controller = Controller(setup, inputs, caller)
    connection = Connection(setup, gate, inputs, controller)
    loop = ControlLoop(setup, gate, inputs, controller, connection, caller)
    try:
        connection.open()
        caller.tell("ready", serial=controller.serial, tcp_offset=inputs.tcp_offset)
        loop.run()
        connection.close()
    except Exception as error:
        loop.let_go()
        answer = told(combined(inputs.latch.stop, _cause_of(error)))
        answer["text"] += connection.end_paused()
        caller.tell("error", ended=True, **answer)
        os._exit(1)
    caller.tell("closed")
    os._exit(0)


def _cause_of(error: Exception) -> DeviceError:
    """Why motion has ended, for the caller; anything unknown is a fault of this program."""
    if isinstance(error, Ended):
        return error.cause
    if isinstance(error, DeviceError):
        return error
    return LostError(f"{type(error).__name__}: {error}", device="robot")


def combined(stop: Stop | None, error: DeviceError) -> DeviceError:
    """Why motion has ended: the stop that was latched, if any, and what came after it."""
    if stop is None or stop.error.args == error.args:
        return error
    kind = type(error)
    # A stop for good stays one, whatever comes after it.
    if stop.for_good and kind is not StoppedError:
        kind = type(stop.error)
    return kind(f"{stop.error.args[0]}; {error.args[0]}", device="robot")


if __name__ == "__main__":
    main()
