"""The operator's permission for one plan: typed by a person, or given beforehand by its digest."""

from __future__ import annotations

import hashlib
import secrets
import threading
from dataclasses import dataclass, field
from functools import cached_property

from hw.robot.motion_plan import MotionPlan
from hw.robot.path_checks import check_plan
from hw.runtime.clock import Clock, asleep_s
from hw.runtime.errors import refused

_VALID_S = 600.0
"""Bench seconds within which motion must be started."""
LEAST_DIGEST_DIGITS = 16


@dataclass(frozen=True)
class Confirmation:
    """Permission for one plan on one robot over one connection, which must be made in time.

    Attributes:
        digest: of the plan.
        serial: of the robot.
        issued_s: bench time.
        expires_s: bench time by which the connection must be made; later motions are not limited.
        asleep_s: reading of :func:`hw.runtime.clock.asleep_s` when it was issued.
        unattended: whether it was given without asking a person.
        use: the only one, taken when motion is started; every start needs a new confirmation.
    """

    digest: str
    serial: str
    issued_s: float
    expires_s: float
    asleep_s: float
    unattended: bool = False
    use: threading.Semaphore = field(default_factory=threading.Semaphore, compare=False, repr=False)


@dataclass(frozen=True)
class Challenge:
    """A code for a person to type. It confirms one plan, once; the next challenge has another code.

    Attributes:
        plan: the plan to confirm; it is checked first.
        nonce: random.
        use: the only one, taken by the right answer.

    Raises:
        RefusedError: the plan is not allowed.
    """

    plan: MotionPlan
    nonce: bytes = field(default_factory=lambda: secrets.token_bytes(16))
    use: threading.Semaphore = field(default_factory=threading.Semaphore, compare=False, repr=False)

    def __post_init__(self) -> None:
        check_plan(self.plan)

    @cached_property
    def code(self) -> str:
        """What must be typed: eight hexadecimal digits."""
        return hashlib.sha256(self.nonce + self.plan.digest.encode()).hexdigest()[:8]


def confirm(challenge: Challenge, answer: str, *, clock: Clock) -> Confirmation:
    """Take the operator's confirmation of a plan.

    Args:
        challenge: the one that the operator was shown.
        answer: what the operator typed; must be ``challenge.code``.
        clock: bench time.

    Raises:
        RefusedError: another answer, or a challenge that was answered before.
    """
    if answer.strip().lower() != challenge.code:
        raise refused("not confirmed: the code typed is not the one shown")
    if not challenge.use.acquire(blocking=False):
        raise refused("this code was typed before; each run has a code of its own")
    return _confirmation(challenge.plan, clock, unattended=False)


def confirm_unattended(plan: MotionPlan, digest: str, *, clock: Clock) -> Confirmation:
    """Confirm a plan that somebody has named beforehand; nobody is asked, now or later.

    What is lost: no person who sees the robot says, just before it moves, that nobody and nothing
    is in its way. What is kept: only the plan that was named can move the robot.

    Args:
        plan: the plan to confirm; it is checked first.
        digest: the plan's, at least its first :data:`LEAST_DIGEST_DIGITS` digits.
        clock: bench time.

    Raises:
        RefusedError: the plan is not allowed, or is not the one named.
    """
    check_plan(plan)
    given = digest.strip().lower()
    if len(given) < LEAST_DIGEST_DIGITS:
        raise refused(f"name the plan by at least {LEAST_DIGEST_DIGITS} digits of its digest")
    if not plan.digest.startswith(given):
        raise refused(
            f"another plan was named: this one's digest begins with "
            f"{plan.digest[:LEAST_DIGEST_DIGITS]} (poses, limits, robot, TCP offset, payload and "
            "speed slider are part of it)"
        )
    return _confirmation(plan, clock, unattended=True)


def _confirmation(plan: MotionPlan, clock: Clock, *, unattended: bool) -> Confirmation:
    now = clock.now()
    return Confirmation(plan.digest, plan.serial, now, now + _VALID_S, asleep_s(), unattended)
