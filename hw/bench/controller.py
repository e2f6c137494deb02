"""The program on the emulated controller: what ur_rtde's control script does with its registers.

The client writes a command into input_int_register_0 and its numbers into the double registers. The
program answers in output_int_register_0: 1 ready, 2 done; it goes back to 1 when the client has
written 0. Real-time commands are executed at every step and leave the register at 1. While a
synchronous motion runs, the program reads no commands, as on the real controller.

This loop is not read from the script that was sent; of the script, only what comes before the loop
is interpreted, as far as it concerns a watchdog (:func:`before_loop`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from hw.bench.arm import Arm

READY, DONE = 1, 2
STOPPED, PLAYING, PAUSED = 1, 2, 4
"""Values of runtime_state."""

NORMAL, REDUCED, PROTECTIVE, SAFEGUARD, SYSTEM_EMERGENCY, ROBOT_EMERGENCY = 1, 2, 3, 5, 6, 7
"""Values of safety_mode; further ones: 4 recovery, 8 violation, 9 fault."""
RUNNING = 7
"""Value of robot_mode; further ones: 2 booting, 3 power off, 4 power on, 5 idle (brakes on), 6
backdrive."""
_POWERED = frozenset({4, 5, 6, RUNNING})

_REAL_TIME = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
_START_S = 0.05
"""Time from the end of the script's upload to its first line."""
_NAMES = {
    1: "moveJ",
    2: "moveJ_IK",
    4: "moveL_FK",
    6: "forceMode",
    7: "forceModeStop",
    9: "speedJ",
    10: "speedL",
    11: "servoJ",
    12: "servoC",
    18: "teachMode",
    19: "endTeachMode",
    25: "toolContact",
    30: "getInverseKinematics",
    37: "isJointsWithinSafetyLimits",
    41: "jogStart",
    43: "getForwardKinematics",
    44: "getForwardKinematics",
    45: "movePath",
    46: "getInverseKinematics",
}
"""ur_rtde's names of commands that are not emulated: they end the program, as an unknown function
ends a real script."""
STEADY_S = 0.5
"""How long the arm must have rested to count as steady (URScript manual, is_steady)."""


_BLOCK = re.compile(r"(def|thread|while|for|if)\b")
_WATCHDOG = re.compile(r'rtde_set_watchdog\("(\w+)",\s*([\d.]+),\s*"(\w+)"\)$')


def before_loop(script: str) -> list[str] | None:
    """The statements that a script executes before its first block, e.g. its main loop.

    Definitions are not executed where they stand. Returns None if a block is not closed, so that
    the script cannot be run.
    """
    found: list[str] = []
    depth, looped = 0, False
    for line in script.splitlines():
        statement = line.partition("#")[0].strip()
        if _BLOCK.match(statement):
            looped |= depth == 1 and not statement.startswith(("def", "thread"))
            depth += 1
        elif statement == "end":
            depth -= 1
        elif statement and depth == 1 and not looped:
            found.append(statement)
    return None if depth else found


@dataclass
class Controller:
    """State of the controller; every method takes bench time (s)."""

    arm: Arm
    int_in: list[int] = field(default_factory=lambda: [0] * 48)
    double_in: list[float] = field(default_factory=lambda: [0.0] * 48)
    int_out: list[int] = field(default_factory=lambda: [0] * 48)
    double_out: list[float] = field(default_factory=lambda: [0.0] * 48)
    running: bool = False
    robot_mode: int = RUNNING
    safety_mode: int = NORMAL
    remote: bool = True
    """Whether scripts are taken (e-Series: remote control; in local control none are)."""
    paused: bool = False
    """Whether a person has paused the program."""
    foreign: bool = False
    """Whether the program that runs is another than ur_rtde's, which answers no registers."""
    log: list[tuple[float, int, tuple[float, ...]]] = field(default_factory=list)
    """Commands taken: bench time, code, double registers 0-8. The last 10,000."""
    reason: str = ""
    """Why the program last stopped."""
    payload_kg: float = 0.0
    payload_cog_m: tuple[float, ...] = (0.0, 0.0, 0.0)
    further_bits: tuple[int, int] = (0, 0)
    """Set besides those that follow from the state: of robot_status_bits, of safety_status_bits."""
    overspeed: float = 1.0
    """A fault: motions are so many times as fast as commanded."""
    heeds_stops: bool = True
    """Unless a fault: commands to stop are taken, but the arm goes on."""
    pauses_before: int | None = None
    """A command's code: the program is paused at the moment in which it would take that command."""
    speed_fraction: float = 1.0
    """Position of the speed slider, 0 to 1."""
    told: Callable[[str, bool], None] = field(default=lambda reason, fault: None, repr=False)
    """Called when a program stops: the reason, and whether it is a fault of the program."""

    _starts: float | None = None
    _first: Sequence[str] = ()
    _plays: bool = False
    _paused_move: tuple[list[float], float, float] | None = None
    _latched: bool = False
    _waits_for: float | None = None
    _finishes: float | None = None
    _watchdog_s: float | None = None
    _kicked: float = 0.0
    _operation: int = 0
    _writes: int = 0

    @property
    def runtime_state(self) -> int:
        """1 stopped, 2 playing, 4 paused."""
        if self.paused or self.safety_mode in (PROTECTIVE, SAFEGUARD):
            return PAUSED
        return PLAYING if self.running else STOPPED

    @property
    def loading(self) -> bool:
        """Whether a program was sent that does not run yet."""
        return self._starts is not None

    @property
    def fit(self) -> bool:
        """Whether the arm may move: brakes released, and no safety stop."""
        return self.robot_mode == RUNNING and self.safety_mode in (NORMAL, REDUCED)

    @property
    def robot_status_bits(self) -> int:
        """Bit 0 power, bit 1 program running."""
        return int(self.robot_mode in _POWERED) | (2 if self.running else 0) | self.further_bits[0]

    @property
    def safety_status_bits(self) -> int:
        """Bit k - 1 for safety_mode k up to robot emergency stop, bit k for 8 and 9.

        Besides: bit 7 in both emergency stops, bit 10 in every stop.
        """
        further = self.further_bits[1]
        if self.safety_mode in (NORMAL, REDUCED):
            return 1 << (self.safety_mode - 1) | further
        if self.safety_mode > ROBOT_EMERGENCY:
            return 1 << self.safety_mode | 1 << 10 | further
        emergency = self.safety_mode in (SYSTEM_EMERGENCY, ROBOT_EMERGENCY)
        return 1 << (self.safety_mode - 1) | (1 << 7 if emergency else 0) | 1 << 10 | further

    def enter(self, t: float, robot_mode: int, safety_mode: int) -> None:
        """Another state of the robot: what a person does at the pendant, a gate, or a fault does.

        A safeguard stop only pauses the program: without a reset input, the program goes on by
        itself when the stop is released. Every other state in which the robot may not move ends it.
        """
        resumes = self.safety_mode == SAFEGUARD and self.running
        self.robot_mode, self.safety_mode = robot_mode, safety_mode
        if safety_mode == SAFEGUARD and self.running:
            self._hold(t)
        elif not self.fit:
            self.halt(t, f"robot mode {robot_mode}, safety mode {safety_mode}")
        elif resumes:
            self._go_on(t)

    def pause(self, t: float, on: bool) -> None:
        """A person pauses the program, or lets it go on."""
        if self.running and on != self.paused:
            self.paused = on
            self._hold(t) if on else self._go_on(t)

    def _hold(self, t: float) -> None:
        if self._finishes is not None:
            self._paused_move = (self.double_in[:6], self.double_in[6], self.double_in[7])
        self._finishes = None
        self.arm.stop(t)

    def _go_on(self, t: float) -> None:
        self._kicked = t
        if self._paused_move is not None:
            pose, speed, acceleration = self._paused_move
            self._finishes = self.arm.move_linear(t, pose, speed, acceleration)
            self._paused_move = None

    def upload(self, t: float, first: Sequence[str] = ()) -> None:
        """A script has come: it replaces the one that runs, if the robot takes scripts now.

        Args:
            t: bench time (s).
            first: the statements before its main loop.
        """
        if not (self.remote and self.fit):
            return
        self.halt(t, "another script was sent")
        self._starts, self._plays, self._first = t + _START_S, False, first

    def play(self, t: float) -> None:
        """A person starts another program, which runs once it is loaded."""
        self.halt(t, "another program was started")
        self._starts, self._plays = t + _START_S, True

    def halt(self, t: float, reason: str, *, fault: bool = False) -> None:
        """Stop the program, and the arm with it; ``fault``: as a runtime error of the script."""
        ran, self.running = self.running, False
        self._latched = self.paused = False
        self._waits_for = self._finishes = self._watchdog_s = self._starts = None
        self._paused_move = None
        self.arm.stop(t)
        if ran:
            self.reason = reason
            self.told(reason, fault)

    def protect(self, t: float, reason: str = "protective stop") -> None:
        """A protective stop."""
        self.safety_mode = PROTECTIVE
        self.halt(t, reason)

    def kick(self, t: float) -> None:
        """input_int_register_0 was written."""
        self._kicked = t

    def step(self, t: float) -> None:
        """Do what the program would do by bench time t."""
        if self._starts is not None and t >= self._starts:
            self._start(t)
        if self.fit and self.arm.at_its_end(t):
            # A real controller stops too: for a fast joint, a singularity, the end of the reach.
            self.protect(t, "protective stop: the arm cannot follow the path")
            return
        if not self.running or self.foreign or self.paused or not self.fit:
            return
        if self._watchdog_s is not None and t - self._kicked > self._watchdog_s:
            self.halt(t, f"watchdog: nothing written for {t - self._kicked:.3f} s")
            return
        if self._finishes is not None and t >= self._finishes:
            self._finish()
        if self._waits_for is not None:
            if t < self._waits_for:
                return
            self._waits_for = None
            self.int_out[0] = DONE
        command = self.int_in[0]
        if command == self.pauses_before:
            self.pauses_before = None
            self.pause(t, True)
        elif command == 0:
            self._latched = False
            self.int_out[0] = READY
        elif command in _REAL_TIME:
            self._execute(t, command)
            self.int_out[0] = READY
        elif not self._latched:
            self._latched = True
            self._execute(t, command)
            if self.running and self._waits_for is None:
                self.int_out[0] = DONE

    def _start(self, t: float) -> None:
        self._starts = None
        self.running, self._latched, self._kicked = True, False, t
        self.foreign = self._plays
        if self.foreign:
            return
        self._operation = self._writes = 0
        self.int_in[0] = 0
        self.int_out[0] = READY
        self._progress(-1)
        for statement in self._first:
            if statement.startswith("rtde_set_watchdog"):
                self._set_watchdog(t, statement)

    def _set_watchdog(self, t: float, statement: str) -> None:
        match = _WATCHDOG.match(statement)
        if match is None or match[1] != "input_int_register_0" or match[3] != "stop":
            self.halt(t, f"{statement} is not emulated", fault=True)
        else:
            self._watch(t, float(match[2]))

    def _watch(self, t: float, least_hz: float) -> None:
        self._watchdog_s, self._kicked = (1.0 / least_hz if least_hz > 0 else None), t

    def _execute(self, t: float, command: int) -> None:
        d = self.double_in
        self.log.append((t, command, tuple(d[:9])))
        del self.log[:-10_000]
        match command:
            case 3:
                self._move(t)
            case 24:
                self.arm.servo(t, d[:6], d[8])
            case 15 | 16 | 33 | 34:
                if self.heeds_stops:
                    self._stop(t, d[0])
            case 8:
                self.arm.force = (0.0,) * 6
            case 17:
                self.payload_kg, self.payload_cog_m = d[0], tuple(d[1:4])
            case 29:
                self.arm.set_tcp_offset(d[:6])
            case 31:
                self.protect(t)
            case 35:
                self._watch(t, d[0])
            case 36:
                self.int_out[1] = int(self.arm.within_reach(d[:6]))
            case 40:
                self.double_out[:6] = self.arm.tcp_offset
            case 47:
                since = self.arm.rest_since(t)
                self.int_out[1] = int(since is not None and t - since >= STEADY_S)
            case 255:
                self.halt(t, "the client stopped the script")
            case _:
                name = _NAMES.get(command, "an unknown command")
                self.halt(t, f"{name} (command {command}) is not emulated", fault=True)

    def _move(self, t: float) -> None:
        d = self.double_in
        if not self.arm.within_reach(d[:6]) or not (d[6] > 0 and d[7] > 0):
            self.halt(t, "moveL to a pose out of reach, or without speed", fault=True)
            return
        if self._finishes is not None:
            self._finish()
        scale = self.overspeed * max(self.speed_fraction, 1e-3)
        arrival = self.arm.move_linear(t, d[:6], d[6] * scale, d[7])
        if self.int_in[1]:
            self._progress(0)
            self._finishes = arrival
        else:
            self._waits_for = arrival

    def _stop(self, t: float, deceleration: float) -> None:
        rests = self.arm.stop(t, max(deceleration, 1e-3))
        if self._finishes is not None:
            self._finish()
        if self.int_in[1]:
            self._progress(0)
            self._finishes = rests
        else:
            self._waits_for = rests

    def _finish(self) -> None:
        self._finishes = None
        self._progress(-1)

    def _progress(self, value: int) -> None:
        """Bits 24-30 operation, 16-22 writes, 15 running, 0-14 progress."""
        self._writes = (self._writes + 1) % 128
        if value == 0:
            self._operation = (self._operation + 1) % 128
        running = 0 if value < 0 else 0x8000 | value
        self.int_out[2] = self._operation << 24 | self._writes << 16 | running
