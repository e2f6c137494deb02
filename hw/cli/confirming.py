"""How a person confirms a plan of motion at the terminal."""

from __future__ import annotations

import select
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

import click

from hw.runtime.interrupts import heed_interrupt

if TYPE_CHECKING:
    from hw.acquisition.acquire import Confirm
    from hw.robot.confirmation import Confirmation
    from hw.robot.motion_plan import MotionPlan
    from hw.runtime.clock import Clock


_TURN_S = 0.1


def confirming_by(clock: Clock, emulated: bool, unattended: str | None) -> Confirm:
    """Who confirms a plan: a person, or ``--unattended``; nobody on the emulated bench."""

    def ask(plan: MotionPlan) -> Confirmation:
        from hw.robot.confirmation import Challenge, confirm, confirm_unattended

        if emulated:
            # The digest counts here, too: who tries it out should see that a wrong one is refused.
            return confirm_unattended(plan, unattended or plan.digest, clock=clock)
        for line in plan_page(plan):
            click.echo(line, err=True)
        if unattended is not None:
            return confirm_unattended(plan, unattended, clock=clock)
        challenge = Challenge(plan)
        click.echo(
            "Clear the tank, keep the emergency stop in reach, then type "
            f"{challenge.code} to let it move.",
            err=True,
        )
        return confirm(challenge, typed_code(), clock=clock)

    return ask


def typed_code() -> str:
    """What the operator types.

    Raises:
        KeyboardInterrupt: Ctrl-C.
        RefusedError: standard input is closed, or ends before anything is typed.
    """
    from hw.runtime.errors import refused

    # A terminal that is gone, or bytes that are no text.
    with suppress(OSError, ValueError):
        while sys.stdin is not None:
            click.echo("code: ", nl=False, err=True)
            # Python handles a signal that comes right before a read only after it: wait in turns.
            while (
                sys.platform != "win32"
                and sys.stdin.isatty()
                and not select.select([sys.stdin], [], [], _TURN_S)[0]
            ):
                heed_interrupt()
            line = sys.stdin.readline()
            if line.strip():
                return line
            if not line:
                break
    raise refused(
        "not confirmed: standard input ended before the code was typed; run it at a terminal, or "
        "name the plan with --unattended DIGEST"
    )


def plan_page(plan: MotionPlan) -> list[str]:
    """Everything that a person must know of a plan to confirm it."""
    from hw.robot.motion_plan import plan_lines

    lines = [
        f"{len(plan.targets)} poses for robot {plan.serial}",
        *plan_lines(plan),
        f"at the pendant: {plan.pendant}",
        f"the plan's digest begins with {plan.digest[:16]}",
    ]
    if not plan.identified:
        lines.append(
            "NOTHING IDENTIFIES THIS ARM: its controller reports neither serial number nor "
            "calibration, and only its address is known; make sure which arm it is"
        )
    return lines
