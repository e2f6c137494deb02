"""``jaxcal-hw free-hand``: images of a hand-held probe, and a calibration from them."""

from __future__ import annotations

import sys
from typing import Any, get_args

import click

from hw.cli.common import check_resumed, recording_path
from hw.runtime.choices import HAND_PLACEMENTS
from jaxcal import InputError
from jaxcal.cli.common import Server, prepare_jax, verdict_code
from jaxcal.cli.sequence_options import probe_frame_option, region_option, spacing_option
from jaxcal.data.names import Target


@click.command("free-hand", short_help="Acquire with a hand-held probe, and calibrate.")
@click.argument("server", type=Server(), metavar="HOST[:PORT]")
@click.argument("recording", type=click.Path(), required=False)
@click.option(
    "--images", type=click.IntRange(4, 1000), default=30, show_default=True, help="Images to take."
)
@probe_frame_option
@click.option(
    "--to",
    "target_frame",
    metavar="FRAME",
    help="Frame in which the target does not move, e.g. Reference.",
)
@click.option("--device", metavar="NAME", help="Device of the images, if several are sent.")
@click.option(
    "--target",
    type=click.Choice(get_args(Target)),
    default="echo",
    show_default=True,
    help="What to look for: one bright spot, or a crossing of wires.",
)
@region_option
@spacing_option
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
@click.option("--resume", is_flag=True, help="Continue RECORDING with its own options.")
def free_hand(
    server: tuple[str, int],
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
    probe still over the target: an image is taken automatically if it shows a credible target and
    the pose differs from those before. The command says which images are still missing. With
    --placement pattern-injection you slide the probe across the mid-plane, back to where the
    injected bar is longest, and accept with Enter. RECORDING is the file to write (by default named
    after the time). At the end it is calibrated, as by jaxcal calibrate.
    """
    from hw.freehand.acquire import acquire_free_hand
    from hw.freehand.guide import Rules
    from hw.freehand.request import FreeHand
    from hw.freehand.terminal import INJECTION_KEYS, KEYS, TerminalPerson

    if resume:
        check_resumed(recording, "placement", "setup_path")
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
                raise InputError(
                    f"{name} is for segmented images; it cannot be used with pattern-injection"
                )
    path = recording_path(recording, "free-hand", resume)
    rules = Rules(target="cross" if target == "cross" else "echo", region=region)
    asked = FreeHand(*server, rules=rules, **options)
    from hw.midplane.terminal_image import Screen
    from hw.runtime.keys import Keyboard, Pause

    screen = Screen(sys.stderr)
    with Keyboard(Pause(), (), screen.say) as keyboard, keyboard.asking():
        person = TerminalPerson(screen, keyboard, INJECTION_KEYS if injected else KEYS)
        if setup_path is not None:
            from hw.freehand.injection import acquire_by_injection
            from hw.setup.description import load_hand_held

            if not keyboard.there:
                raise InputError("pattern injection needs a terminal to read keys from")
            setup = load_hand_held(setup_path)
            acquire_by_injection(path, asked, setup, person, resume=resume)
        else:
            acquire_free_hand(path, asked, person, resume=resume)
        screen.clear()
    from hw.acquisition.outcome import calibrate_and_print

    prepare_jax()
    return verdict_code(calibrate_and_print(path))
