"""The program that ur_rtde runs on the controller, and a watchdog as its first statement.

ur_rtde would send its program without a watchdog and set one by a command afterwards. A process
that is killed in between leaves the program on the robot, running, and nobody watches it. Here the
program watches itself from its first statement: it ends if no command has come for so long.

The text is ur_rtde's own for this controller. ur_rtde gives it to the External Control URCap, over
a port that it opens for as long as it is connected, on every network. So a short-lived child asks
for the text; it sends nothing to the robot.
"""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Callable
from typing import Any

from hw.robot.mover.controller import said
from hw.robot.rtde import SCRIPT_PORT
from hw.runtime.errors import LostError
from hw.runtime.processes import be_prompt

_LAST_LINE = b"# NODE_CONTROL_LOOP_ENDS\n"
_PATIENCE_S = 10.0


def guarded_program(module: Any, host: str, watchdog_hz: float) -> bytes:
    """The program for the controller at ``host``; it stops unless it hears a command that often.

    Args:
        module: ``rtde_control``.
        host: the controller's address.
        watchdog_hz: least frequency of commands, also before the first one.

    Raises:
        LostError: ur_rtde cannot connect, or its text is not as expected.
    """
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            # A silent controller would hold it for ever, and the parent may be killed.
            signal.setitimer(signal.ITIMER_REAL, _PATIENCE_S)
            be_prompt(0)
            try:
                text = _text_of(module, host)
            except (RuntimeError, OSError) as error:
                text = (said(error) if isinstance(error, RuntimeError) else str(error)).encode()
            except Exception as error:
                text = f"{type(error).__name__}: {error}".encode()
            with open(write, "wb") as out:
                out.write(text)
        finally:
            # Whatever it meets, it must not go on as a second process that moves the robot.
            os._exit(0)
    os.close(write)
    with open(read, "rb") as source:
        text = source.read()
    os.waitpid(child, 0)
    if not text.endswith(_LAST_LINE):
        why = " ".join(text[:200].decode("utf-8", "replace").split()) or "no answer"
        raise LostError(f"no program to send to the controller: {why}", device="robot")
    watch = f'    rtde_set_watchdog("input_int_register_0", {watchdog_hz:g}, "stop")\n'
    return b"def rtde_control():\n" + watch.encode() + text + b"end\n"


def _text_of(module: Any, host: str) -> bytes:
    interface = module.RTDEControlInterface
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    flags = interface.FLAG_USE_EXT_UR_CAP | interface.FLAG_NO_WAIT
    connected = interface(host, -1.0, flags, port)
    text = b""
    with socket.create_connection(("127.0.0.1", port), timeout=_PATIENCE_S) as source:
        source.sendall(b"request_program\n")
        while not text.endswith(_LAST_LINE) and (data := source.recv(1 << 16)):
            text += data
    # Its destructor disconnects and waits for half a second: the controller may need a moment to
    # free the input registers, which the next connection uses.
    del connected
    return text


def send_program(
    connect: Callable[[tuple[str, int], float], socket.socket], host: str, program: bytes
) -> socket.socket:
    """Send a program to the controller, which starts it.

    Args:
        connect: to an address, within so many wall s.
        host: the controller's.
        program: its text.

    Returns:
        The connection. Close it when the program runs: the controller sends data, too, and closing
        a connection with unread data may discard what was sent.

    Raises:
        LostError: the controller does not take it.
    """
    try:
        sent = connect((host, SCRIPT_PORT), _PATIENCE_S)
        sent.sendall(program)
    except OSError as error:
        raise LostError(f"the controller took no program: {error}", device="robot") from None
    return sent
