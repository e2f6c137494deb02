"""The entry point ``jaxcal-hw``. Nothing numerical is imported for help."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from hw.choices import HAND_PLACEMENTS, OPERATORS, PHANTOMS, PLACEMENTS, PLACEMENTS_OF, PLANS
from hw.interrupts import as_interrupts
from jaxcal import InputError, __version__
from jaxcal.cli.common import POSITIVE, Commands, ExitCode, exit_code
from jaxcal.cli.run import run

if TYPE_CHECKING:
    from hw.acquire import Confirm, Outcome
    from hw.bench.run import Bench
    from hw.extras import Extra
    from hw.keys import Keyboard
    from hw.midplane.pattern_injection import Operator
    from hw.midplane.terminal_image import Screen
    from hw.request import AcquisitionRequest
    from hw.robot.safety import Confirmation, MotionPlan
    from hw.setup import Setup
    from hw.view.feed import LiveView

_RESUMED_BY_ITSELF = 30
_POSE_HZ = {"cb": 125, "e": 500}


@click.group(
    cls=Commands,
    no_args_is_help=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Exit status: 0 done; 2 bad usage or input, with one line that says what; 3 done, but "
    "the calibration did not converge; 4 a device failed: motion has ended, and the recording can "
    "be resumed; 5 done, but the calibration is less than fair; 130 interrupted, with motion ended "
    "as by 4.",
)
@click.version_option(__version__, prog_name="jaxcal-hw")
def commands() -> None:
    """Acquire recordings for jaxcal: robot, active echo element and ultrasound machine.

    The operator is responsible for the robot: its own safety configuration and emergency stop come
    first, and nothing here replaces them.
    """


_bench = click.option("--bench", is_flag=True, help="The emulated bench: no hardware at all.")
_setup = click.option(
    "--setup", "setup_path", type=click.Path(), metavar="TOML", help="The bench's description."
)
_speed = click.option(
    "--speed", type=POSITIVE, metavar="K", help="Emulated bench: times faster than real time."
)
_controller = click.option(
    "--controller",
    type=click.Choice(list(_POSE_HZ)),
    help="Emulated bench: series of the robot, CB (125 poses/s) or e-Series (500).  [default: cb]",
)
_bench_seed = click.option(
    "--bench-seed", type=click.IntRange(min=0), metavar="N", help="Emulated bench: which world."
)


@click.command()
@click.argument("recording", type=click.Path(), required=False)
@_bench
@_setup
@click.option("--images", type=click.IntRange(4, 1000), help="Poses of the plan.  [default: 60]")
@click.option(
    "--plan",
    type=click.Choice(PLANS),
    help="How poses are planned: spread evenly beforehand, or chosen from a confirmed pool as the "
    "images tell; then --images is the most.  [default: sobol]",
)
@click.option(
    "--until-tre",
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
    help="What is in the tank: an element that hears and answers, wires that only show in the "
    "image, or a hydrophone that only hears.  [default: active-echo]",
)
@click.option(
    "--operator",
    type=click.Choice(OPERATORS),
    help="Who follows the injected pattern: you at this terminal, you before a window, or a rule.  "
    "[default: person with --setup, simulated with --bench]",
)
@click.option(
    "--seed", type=click.IntRange(min=0), metavar="N", help="Seed of the plan.  [default: 0]"
)
@click.option("--every-frame", is_flag=True, help="Record every ultrasound frame, not one a pose.")
@click.option("--resume", is_flag=True, help="Go on with RECORDING, which ended early.")
@click.option("--move", is_flag=True, help="Move the robot, after a confirmation; else a dry run.")
@click.option(
    "--unattended",
    metavar="DIGEST",
    help="Move without asking anybody: then nobody at the robot says, just before it moves, that "
    "its way is clear. DIGEST names the plan (16 digits or more, as --move shows it); "
    "any other plan, robot, TCP offset, payload or speed slider is refused.",
)
@click.option("--preview", type=click.Path(), metavar="PNG", help="Draw the plan.")
@click.option("--view", is_flag=True, help="Show it live in the browser, on this machine only.")
@_speed
@_controller
@_bench_seed
def acquire(
    recording: str | None,
    bench: bool,
    setup_path: str | None,
    images: int | None,
    plan: str | None,
    until_tre: float | None,
    placement: str | None,
    phantom: str | None,
    operator: str | None,
    seed: int | None,
    every_frame: bool,
    resume: bool,
    move: bool,
    unattended: str | None,
    preview: str | None,
    view: bool,
    speed: float | None,
    controller: str | None,
    bench_seed: int | None,
) -> int:
    """Take the images of a plan of poses, and calibrate from them.

    RECORDING is the file to make (by default one named after the time), or to --resume.
    """
    if bench == (setup_path is not None):
        also = ", also to --resume" if resume else ""
        raise InputError(f"give either --bench or --setup TOML{also}")
    if not bench and (speed, controller, bench_seed) != (None, None, None):
        raise InputError("--speed, --controller and --bench-seed need --bench")
    given = [
        name
        for name, value in (
            ("--images", images),
            ("--plan", plan),
            ("--until-tre", until_tre),
            ("--placement", placement),
            ("--phantom", phantom),
            ("--operator", operator),
            ("--seed", seed),
            ("--every-frame", every_frame or None),
            ("--bench-seed", bench_seed),
        )
        if value is not None
    ]
    if resume:
        _check_resumed(recording, given)
    if operator is not None and not resume and placement != "pattern-injection":
        raise InputError("--operator needs --placement pattern-injection")
    if until_tre is not None and plan != "optimal" and not resume:
        raise InputError("--until-tre needs --plan optimal")
    if unattended is not None and not move:
        raise InputError("--unattended needs --move")
    if view and not (bench or move):
        raise InputError("--view needs --move: a dry run has nothing to show")
    from hw.extras import missing
    from hw.recording_check import check_resumable
    from hw.request import AcquisitionRequest, recorded_request

    if resume:
        assert recording is not None
        check_resumable(recording)
        recorded = recorded_request(recording)
        if bench != (recorded.bench is not None):
            where = "a real bench" if bench else "the emulated bench"
            raise InputError(f"the recording was begun on {where}: resume it there")
        bench_seed, phantom, operator = recorded.bench, recorded.phantom, recorded.operator
    needed: dict[str, Extra] = {"rtde_control": "robot"} if bench or move else {}
    if bench and phantom in (None, PHANTOMS[0]):
        needed |= {"cobs": "serial", "serial": "serial"}
    for module, extra in needed.items():
        # Before a file is made, and before anybody is asked to confirm a plan.
        if (cure := missing(module, extra=extra)) is not None:
            raise InputError(cure)
    path = recording or f"acquisition-{datetime.now():%Y%m%d-%H%M%S}.h5"
    from jaxcal.cli.cache import enable_compilation_cache

    enable_compilation_cache()

    request = None
    if operator is None:
        asks = placement == "pattern-injection" and not bench
        operator = "person" if asks else "simulated"
    if not resume:
        phantom = phantom or PHANTOMS[0]
        request = AcquisitionRequest(
            images or 60,
            placement or PLACEMENTS_OF[phantom][0],
            seed or 0,
            every_frame,
            (bench_seed or 0) if bench else None,
            operator,
            plan or PLANS[0],
            until_tre,
            phantom,
        )
    with ExitStack() as stack:
        emulated = _started(stack, bench, bench_seed, speed, controller, phantom)
        setup = _setup_of(setup_path, emulated)
        if not bench and not move:
            return _dry_run(setup, path, request, preview)
        if preview is not None:
            _preview(setup, request, preview)
        return _acquire(setup, path, request, emulated, unattended, operator, view)


@click.command("free-hand", short_help="Acquire with a hand-held probe, and calibrate.")
@click.argument("server", metavar="HOST[:PORT]")
@click.argument("recording", type=click.Path(), required=False)
@click.option(
    "--images", type=click.IntRange(4, 1000), default=30, show_default=True, help="To take."
)
@click.option("--from", "source", metavar="FRAME", help="Tracked frame on the probe, e.g. Probe.")
@click.option("--to", "target_frame", metavar="FRAME", help="Frame the target rests in.")
@click.option("--device", metavar="NAME", help="Of the images, where several are sent.")
@click.option(
    "--target",
    type=click.Choice(["echo", "cross"]),
    default="echo",
    show_default=True,
    help="What to look for: one bright spot, or a crossing of wires.",
)
@click.option(
    "--region",
    type=int,
    nargs=4,
    metavar="COLUMN ROW COLUMNS ROWS",
    help="Part of the frames to look in, px.",
)
@click.option(
    "--spacing",
    "spacing_mm",
    type=POSITIVE,
    nargs=2,
    metavar="LATERAL AXIAL",
    help="Size of a pixel, mm.",
)
@click.option(
    "--lag",
    "lag_s",
    type=float,
    default=0.0,
    metavar="SECONDS",
    help="An image stamped t shows what was at t - SECONDS.",
)
@click.option(
    "--placement",
    type=click.Choice(HAND_PLACEMENTS),
    default=HAND_PLACEMENTS[0],
    show_default=True,
    help="How the target is found: by segmenting the images, or by the bar that the active echo "
    "element injects and you follow (needs --setup).",
)
@click.option(
    "--setup",
    "setup_path",
    type=click.Path(),
    metavar="TOML",
    help="For pattern injection: [active_echo] url, [probe], and [scene] image_to_probe as drawn.",
)
@click.option("--resume", is_flag=True, help="Go on with RECORDING, as it was begun.")
def free_hand(
    server: str,
    recording: str | None,
    resume: bool,
    target: str,
    region: tuple[int, int, int, int] | None,
    placement: str,
    setup_path: str | None,
    **options: Any,
) -> int:
    """Acquire with a hand-held probe: images and poses of a PlusServer or any OpenIGTLink tracker.

    Connects to HOST (port 18944), which must send IMAGE and TRANSFORM, or TRACKEDFRAME. Hold the
    probe still over the target: an image is taken by itself where the target is credible and the
    pose differs from those before. What is still missing is said. With --placement
    pattern-injection you slide the probe across the mid-plane, back to where the injected bar is
    longest, and accept with Enter. RECORDING is the file to make (by default one named after the
    time); afterwards it is calibrated, as jaxcal calibrate would.
    """
    from hw.freehand.acquire import acquire_free_hand
    from hw.freehand.guide import Rules
    from hw.freehand.request import FreeHand
    from hw.freehand.terminal import INJECTION_KEYS, KEYS, TerminalPerson

    if resume:
        context = click.get_current_context()
        given = [
            option.opts[0]
            for option in context.command.params
            if isinstance(option, click.Option)
            and option.name not in ("resume", "placement", "setup_path")
            and context.get_parameter_source(str(option.name)) is ParameterSource.COMMANDLINE
        ]
        _check_resumed(recording, given)
    injected = placement == "pattern-injection"
    if injected != (setup_path is not None):
        raise InputError("--placement pattern-injection and --setup TOML go together")
    if injected:
        unused = {
            "--target": target != "echo",
            "--region": region is not None,
            "--spacing": options["spacing_mm"] is not None,
        }
        for name, given in unused.items():
            if given:
                raise InputError(f"{name} is for segmented images: not with pattern-injection")
    host, _, port = server.partition(":")
    if not host or not ((port.isdecimal() and 0 < int(port) < 65536) or not port):
        raise click.BadParameter(f"{server!r} is not HOST or HOST:PORT", param_hint="HOST[:PORT]")
    path = recording or f"free-hand-{datetime.now():%Y%m%d-%H%M%S}.h5"
    rules = Rules(target="cross" if target == "cross" else "echo", region=region)
    asked = FreeHand(host, int(port or 18944), rules=rules, **options)
    from hw.keys import Keyboard, Pause
    from hw.midplane.terminal_image import Screen

    screen = Screen(sys.stderr)
    with Keyboard(Pause(), (), screen.say) as keyboard, keyboard.asking():
        person = TerminalPerson(screen, keyboard, INJECTION_KEYS if injected else KEYS)
        if setup_path is not None:
            from hw.freehand.injection import acquire_by_injection
            from hw.setup import load_hand_held

            if not keyboard.there:
                raise InputError("pattern injection needs a terminal to read keys from")
            setup = load_hand_held(setup_path)
            acquire_by_injection(path, asked, setup, person, resume=resume)
        else:
            acquire_free_hand(path, asked, person, resume=resume)
        screen.clear()
    from hw.outcome import calibrate_and_print
    from jaxcal.cli.cache import enable_compilation_cache

    enable_compilation_cache()
    return exit_code([calibrate_and_print(path)])


def _check_resumed(recording: str | None, given: Sequence[str]) -> None:
    """Refuse --resume without a recording, or with options that the recording knows."""
    if recording is None:
        raise InputError("--resume needs the RECORDING to go on with")
    if given:
        raise InputError(f"{given[0]} does not go with --resume: the recording knows")


@click.command(short_help="Serve an emulated bench until Ctrl-C.")
@_speed
@_controller
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    metavar="N",
    help="Seed of the simulated world.",
)
def bench(speed: float | None, controller: str | None, seed: int) -> int:
    """Serve an emulated bench until Ctrl-C; prints one JSON line with its addresses."""
    from hw.bench.run import BenchOptions, serve

    pose_hz = _POSE_HZ[controller or "cb"]
    serve(BenchOptions(speed=1.0 if speed is None else speed, seed=seed, pose_hz=pose_hz))
    return ExitCode.CONVERGED


@click.command("setup", short_help="Write a commented description of a bench, to fill in.")
@click.argument("out", type=click.Path(), metavar="[OUT.toml]", required=False)
def setup_(out: str | None) -> int:
    """Write a commented description of a bench, to fill in, to OUT.toml or to standard output."""
    from importlib.resources import files

    from jaxcal.io.atomic import write_text

    text = files("hw").joinpath("example_setup.toml").read_text("utf-8")
    if out is None:
        click.echo(text, nl=False)
        return ExitCode.CONVERGED
    if Path(out).exists():
        raise InputError(f"{out}: exists; name another file")
    write_text(out, text)
    click.echo(f"{out}: written; fill it in, then jaxcal-hw check --setup {shlex.quote(out)}")
    return ExitCode.CONVERGED


@click.command()
@_bench
@_setup
@_speed
@_controller
def check(bench: bool, setup_path: str | None, speed: float | None, controller: str | None) -> int:
    """Look at each device and say what is wrong; nothing moves."""
    if bench == (setup_path is not None):
        raise InputError("give either --bench or --setup TOML")
    if (speed, controller) != (None, None) and not bench:
        raise InputError("--speed and --controller need --bench")
    from hw.check import check as look

    with ExitStack() as stack:
        found = look(_setup_of(setup_path, _started(stack, bench, None, speed or 1.0, controller)))
    for finding in found:
        click.echo(f"{finding.device}: {'wrong' if finding.wrong else 'good'}: {finding.facts}")
        for line in finding.wrong:
            click.echo(f"  {line}")
    return ExitCode.STOPPED if any(finding.wrong for finding in found) else ExitCode.CONVERGED


for _command in (setup_, check, acquire, free_hand, bench):
    commands.add_command(_command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``jaxcal-hw``; see :func:`jaxcal.cli.run.run`."""
    with as_interrupts():
        return run(commands, "jaxcal-hw", arguments)


def _started(
    stack: ExitStack,
    bench: bool,
    seed: int | None,
    speed: float | None,
    controller: str | None,
    phantom: str | None = None,
) -> Bench | None:
    if not bench:
        return None
    from hw.emulated import SPEED, start

    speed = SPEED if speed is None else speed
    return stack.enter_context(
        start(seed or 0, speed, _POSE_HZ[controller or "cb"], phantom or PHANTOMS[0])
    )


def _setup_of(path: str | None, emulated: Bench | None) -> Setup:
    from hw.emulated import setup_of
    from hw.setup import load_setup

    if emulated is not None:
        return setup_of(emulated)
    assert path is not None
    return load_setup(path)


def _acquire(
    setup: Setup,
    path: str,
    request: AcquisitionRequest | None,
    emulated: Bench | None,
    unattended: str | None,
    operator: str,
    show: bool,
) -> int:
    from hw.acquire import AcquisitionStopped
    from hw.acquire import acquire as run_acquisition
    from hw.emulated import BenchOracle
    from hw.keys import Pause, watch_keys
    from hw.midplane.terminal_image import Screen

    pause, screen = Pause(), Screen(sys.stderr)
    confirming = _confirming(setup, emulated is not None, unattended)

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
            oracle=None if emulated is None else BenchOracle(emulated),
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
                say(f"stopped: {error}")
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
    from hw.outcome import calibrate_and_print, lines_of

    lines = lines_of(path, outcome, setup.clock.speed)
    return exit_code([calibrate_and_print(path, *lines)])


def _confirming(setup: Setup, emulated: bool, unattended: str | None) -> Confirm:
    """Who confirms a plan: a person, or ``--unattended``; nobody on the emulated bench."""

    def ask(plan: MotionPlan) -> Confirmation:
        from hw.robot.safety import Challenge, confirm, confirm_unattended

        if emulated:
            return confirm_unattended(plan, plan.digest, clock=setup.clock)
        for line in _plan_page(plan):
            click.echo(line, err=True)
        if unattended is not None:
            return confirm_unattended(plan, unattended, clock=setup.clock)
        challenge = Challenge(plan)
        click.echo(
            "Clear the tank, keep the emergency stop in reach, then type "
            f"{challenge.code} to let it move.",
            err=True,
        )
        try:
            code = click.prompt("code", err=True)
        except click.Abort:
            raise KeyboardInterrupt from None
        return confirm(challenge, code, clock=setup.clock)

    return ask


def _plan_page(plan: MotionPlan) -> list[str]:
    """Everything that a person must know of a plan to confirm it."""
    from hw.robot.safety import plan_lines

    lines = [
        f"{len(plan.targets)} poses for robot {plan.serial}",
        *plan_lines(plan),
        f"at the pendant: {plan.pendant}",
        f"the plan's digest begins with {plan.digest[:16]}",
    ]
    if not plan.identified:
        lines.append(
            "NOTHING IDENTIFIES THIS ARM: its controller tells neither serial number nor "
            "calibration, only its address is known; look which arm it is"
        )
    return lines


def _dry_run(
    setup: Setup, path: str, request: AcquisitionRequest | None, preview: str | None
) -> int:
    """Everything but the motion: the plan, and the way from pose to pose, against the limits."""
    from hw.dry_run import dry_run

    for line in dry_run(setup, path, request, preview):
        click.echo(line)
    return ExitCode.CONVERGED


def _preview(setup: Setup, request: AcquisitionRequest | None, preview: str) -> None:
    from hw.dry_run import draw

    if request is None:
        raise InputError("--preview draws a new plan; it does not go with --resume")
    draw(setup, request, preview)


if __name__ == "__main__":
    sys.exit(main())
