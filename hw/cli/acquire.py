"""``jaxcal-hw acquire``: the images of a plan of poses, and a calibration from them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hw.cli.common import (
    bench_option,
    bench_seed_option,
    check_resumed,
    controller_option,
    recording_path,
    setup_of,
    setup_option,
    speed_option,
    started,
)
from hw.cli.confirming import confirming_by
from hw.runtime.choices import OPERATORS, PHANTOMS, PLACEMENTS, PLACEMENTS_OF, PLANS
from jaxcal import InputError
from jaxcal.cli.common import POSITIVE, ExitCode, prepare_jax, verdict_code

if TYPE_CHECKING:
    from hw.acquisition.acquire import Outcome
    from hw.acquisition.request import AcquisitionRequest
    from hw.bench.run import Bench
    from hw.midplane.pattern_injection import Operator
    from hw.midplane.terminal_image import Screen
    from hw.robot.confirmation import Confirmation
    from hw.robot.motion_plan import MotionPlan
    from hw.runtime.extras import Extra
    from hw.runtime.keys import Keyboard
    from hw.setup.description import Setup
    from hw.view.feed import LiveView

_ALSO_RESUMED = ("bench", "setup_path", "move", "unattended", "view", "speed", "controller")
"""Options that go with --resume."""
_RESUMED_BY_ITSELF = 30
"""How often an acquisition on the emulated bench is resumed without a person."""


@click.command()
@click.argument("recording", type=click.Path(), required=False)
@bench_option
@setup_option
@click.option("--images", type=click.IntRange(4, 1000), help="Poses of the plan.  [default: 60]")
@click.option(
    "--plan",
    type=click.Choice(PLANS),
    help="How poses are planned: spread evenly beforehand, or chosen during the run from a "
    "confirmed pool, given the images so far; --images is then the maximum.  [default: sobol]",
)
@click.option(
    "--until-tre",
    "until_tre_mm",
    type=POSITIVE,
    metavar="MM",
    help="With --plan optimal: stop once the predicted error over the image is this small.",
)
@click.option(
    "--placement",
    type=click.Choice(PLACEMENTS),
    help="How the target is brought into the mid-plane.  [default: amplitude-scan; image-scan with "
    "a cross-wire]",
)
@click.option(
    "--phantom",
    type=click.Choice(PHANTOMS),
    help="What is in the tank: an element that receives and answers, wires that are only seen in "
    "the image, or a hydrophone that only receives.  [default: active-echo]",
)
@click.option(
    "--operator",
    type=click.Choice(OPERATORS),
    help="Who follows the injected pattern: you at this terminal, you in a window, or a rule.  "
    "[default: person with --setup, simulated with --bench]",
)
@click.option(
    "--seed", type=click.IntRange(min=0), metavar="N", help="Seed of the plan.  [default: 0]"
)
@click.option(
    "--every-frame", is_flag=True, help="Record every ultrasound frame, not only one for each pose."
)
@click.option("--resume", is_flag=True, help="Continue RECORDING, which ended early.")
@click.option(
    "--move", is_flag=True, help="Move the robot, after a confirmation; without it, a dry run."
)
@click.option(
    "--unattended",
    metavar="DIGEST",
    help="Move without asking: then nobody at the robot confirms, just before it moves, that its "
    "way is clear. DIGEST names the plan (16 digits or more, as --move shows it); any other plan, "
    "robot, TCP offset, payload or speed slider is refused.",
)
@click.option("--preview", type=click.Path(), metavar="PNG", help="Draw the plan.")
@click.option(
    "--view", is_flag=True, help="Show the run live in the browser, on this machine only."
)
@speed_option
@controller_option
@bench_seed_option
def acquire(
    recording: str | None,
    bench: bool,
    setup_path: str | None,
    resume: bool,
    move: bool,
    unattended: str | None,
    preview: str | None,
    view: bool,
    speed: float | None,
    controller: str | None,
    bench_seed: int | None,
    **wanted: Any,
) -> int:
    """Take the images of a plan of poses, and calibrate from them.

    RECORDING is the file to write (by default named after the time), or to --resume.
    """
    if bench == (setup_path is not None):
        also = ", also to --resume" if resume else ""
        raise InputError(f"give either --bench or --setup TOML{also}")
    if not bench and (speed, controller, bench_seed) != (None, None, None):
        raise InputError("--speed, --controller and --bench-seed need --bench")
    if resume and preview is not None:
        raise InputError("--preview draws a new plan; it cannot be used with --resume")
    if resume:
        check_resumed(recording, *_ALSO_RESUMED)
    if wanted["operator"] and not resume and wanted["placement"] != "pattern-injection":
        raise InputError("--operator needs --placement pattern-injection")
    if wanted["until_tre_mm"] is not None and wanted["plan"] != "optimal" and not resume:
        raise InputError("--until-tre needs --plan optimal")
    if unattended is not None and not move:
        raise InputError("--unattended needs --move")
    if view and not (bench or move):
        raise InputError("--view needs --move: a dry run has nothing to show")
    if resume:
        assert recording is not None
        request = _recorded(recording, bench)
        bench_seed = request.bench
    else:
        wanted["controller"] = controller
        request = _requested((bench_seed or 0) if bench else None, wanted)
    phantom, operator = request.phantom, request.operator
    controller = controller or request.controller
    path = recording_path(recording, "acquisition", resume)
    _check_installed(bench, move)

    prepare_jax()
    with ExitStack() as stack:
        emulated = started(stack, bench, bench_seed, speed, controller, phantom)
        setup = setup_of(setup_path, emulated)
        if not bench and not move:
            from hw.acquisition.dry_run import dry_run

            for line in dry_run(setup, path, None if resume else request, preview):
                click.echo(line)
            return ExitCode.CONVERGED
        if preview is not None:
            from hw.acquisition.request import planned
            from hw.planning.poses import preview as draw

            draw(planned(setup, request), Path(preview))
        new = None if resume else request
        return _acquire(setup, path, new, emulated, unattended, operator, view)


def _requested(bench: int | None, wanted: dict[str, Any]) -> AcquisitionRequest:
    """What the options ask for; those that were not given are chosen here."""
    from hw.acquisition.request import AcquisitionRequest

    given = {name: value for name, value in wanted.items() if value is not None}
    placement = given.setdefault("placement", PLACEMENTS_OF[given.get("phantom", PHANTOMS[0])][0])
    by_person = placement == "pattern-injection" and bench is None
    given.setdefault("operator", "person" if by_person else "simulated")
    return AcquisitionRequest(**given, bench=bench)


def _recorded(recording: str, bench: bool) -> AcquisitionRequest:
    """What was asked for of a recording that is to be resumed.

    Raises:
        InputError: it cannot be resumed, or not on this bench.
    """
    from hw.acquisition.request import recorded_request
    from hw.recording.check import check_resumable

    check_resumable(recording)
    recorded = recorded_request(recording)
    if bench != (recorded.bench is not None):
        where = "a real bench" if bench else "the emulated bench"
        raise InputError(f"the recording was begun on {where}: resume it there")
    return recorded


def _check_installed(bench: bool, move: bool) -> None:
    """Refuse to begin without the drivers: before a file is made, and before anybody confirms."""
    from hw.runtime.extras import missing

    if not (bench or move):
        return
    needed: dict[str, Extra] = {"rtde_control": "robot", "cobs": "serial", "serial": "serial"}
    for module, extra in needed.items():
        if (cure := missing(module, extra=extra)) is not None:
            raise InputError(cure)


def _acquire(
    setup: Setup,
    path: str,
    request: AcquisitionRequest | None,
    emulated: Bench | None,
    unattended: str | None,
    operator: str,
    show: bool,
) -> int:
    from hw.acquisition.acquire import AcquisitionStopped
    from hw.acquisition.acquire import acquire as run_acquisition
    from hw.midplane.terminal_image import Screen
    from hw.runtime.keys import Pause, watch_keys

    pause, screen = Pause(), Screen(sys.stderr)
    confirming = confirming_by(setup.clock, emulated is not None, unattended)

    def say(line: str) -> None:
        screen.say(line)
        if view is not None:
            view.say(line)

    def attempt(request: AcquisitionRequest | None) -> Outcome:
        def confirm(plan: MotionPlan) -> Confirmation:
            with keyboard.lines():
                return confirming(plan)

        return run_acquisition(
            setup,
            path,
            request,
            confirm,
            say=say,
            emulated=emulated,
            operator=_operators(operator, keyboard, screen),
            pause=pause,
            view=view,
        )

    # A person's Enter accepts a place.
    pause_keys = ("p",) if operator == "person" else ("enter", "p")
    with ExitStack() as stack:
        view: LiveView | None = None
        if show:
            from hw.view.feed import LiveView

            view = stack.enter_context(LiveView(screen.say))
        keyboard = stack.enter_context(watch_keys(pause, screen.say, pause_keys))
        for _ in range(_RESUMED_BY_ITSELF if emulated is not None else 0):
            try:
                return _finished(path, attempt(request), setup)
            except AcquisitionStopped as error:
                if error.exit_code == ExitCode.INTERRUPTED or not error.by_itself:
                    raise
                # A busy machine trips the emulated controller's watchdog: resume without a person.
                say(f"stopped, and resumed: {error.reason}")
                request = None
        return _finished(path, attempt(request), setup)


def _operators(operator: str, keyboard: Keyboard, screen: Screen) -> Callable[[], Operator]:
    """Who follows the injected pattern at each pose.

    Raises:
        InputError: a person without a terminal, or without a display for the window.
    """
    from hw.midplane.live_view import TerminalOperator, WindowOperator
    from hw.midplane.pattern_injection import SteadyOperator

    match operator:
        case "person":
            if not keyboard.there:
                raise InputError(
                    "pattern injection by a person needs a terminal to read keys from; "
                    "--operator simulated follows a rule instead"
                )
            return lambda: TerminalOperator(keyboard, screen)
        case "window":
            window = WindowOperator()
            return lambda: window
    return SteadyOperator


def _finished(path: str, outcome: Outcome, setup: Setup) -> int:
    from hw.acquisition.outcome import calibrate_and_print, lines_of

    lines = lines_of(path, outcome, setup.clock.speed)
    return verdict_code(calibrate_and_print(path, *lines))
