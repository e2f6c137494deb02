"""``jaxcal plan``: which poses, from nothing but a probe and a region, or to add to a recording."""

from __future__ import annotations

from dataclasses import asdict, replace
from math import inf
from typing import TYPE_CHECKING, Any, get_args

import click

from jaxcal import InputError
from jaxcal.cli.common import (
    CONE,
    POSITIVE,
    ExitCode,
    Number,
    import_engine,
    json_option,
    prepare_jax,
    print_json,
    print_page,
    progress,
    seed_option,
    segmented,
)
from jaxcal.data.names import ProbeKind
from jaxcal.design.names import Criterion
from jaxcal.model.thresholds import MINIMUM_SELF_TUNING
from jaxcal.report.paragraphs import simple_table
from jaxcal.study.laws import OFFSET_LAWS, LawName

if TYPE_CHECKING:
    from rich.table import Table

    from jaxcal.data.recording import Images
    from jaxcal.design import Candidates, Plan
    from jaxcal.design.constraints import Region
    from jaxcal.result.calibration import Calibration
    from jaxcal.result.transform import ImageTransform

_COUNTED = (0.5, 0.3, 0.2, 0.1)
"""Errors (mm) for which the images are counted, where none is asked for."""

_LEAST_LATERAL_MM, _LEAST_SIGMA_MM = 0.1, 0.01
"""What is less was given in metres; for --sigma, all three."""

_PICTURES = (
    b"\x89PNG",
    b"\xff\xd8\xff",  # JPEG
    b"GIF8",
    b"RIFF",  # WebP
    b"II*",  # TIFF, as the next
    b"MM",
    b"%PDF",
    b"%!PS",
    b"%% Creator: Matplotlib",  # PGF
    b"<?xml",  # SVG
    b"\x1f\x8b",  # SVG, compressed
)
"""How files begin that matplotlib draws."""


@click.command(short_help="Plan which poses to take images from.")
@click.argument("recording", type=click.Path(), metavar="[REC]", required=False)
@click.option(
    "--images",
    type=click.IntRange(1, 2000),
    metavar="N",
    help="Poses; without REC at least 4.  [default: 30; with REC 10]",
)
@click.option(
    "--until-tre",
    type=POSITIVE,
    metavar="MM",
    help="As many poses as are needed for this predicted error in the image; without REC at "
    f"least {MINIMUM_SELF_TUNING}, because fewer are not enough to estimate the SDs.",
)
@click.option(
    "--criterion",
    type=click.Choice(get_args(Criterion)),
    default="tre",
    show_default=True,
    help="What to minimise: target registration error, reconstruction precision, or the volume "
    "of the confidence ellipsoid.",
)
@click.option(
    "--probe",
    type=click.Choice(get_args(ProbeKind)),
    help="Transducer, if the recording names none: L14-5 or C5-2.  [default: linear; with REC "
    "where its target was]",
)
@click.option(
    "--depth",
    type=POSITIVE,
    nargs=2,
    metavar="NEAR FAR",
    help="Range of the target from the array, mm.  [default: 15 82; with REC where it was]",
)
@click.option(
    "--lateral",
    type=POSITIVE,
    metavar="MM",
    help="Largest lateral position of the target, to either side of the middle (in pixels, of the "
    "middle of where it was; of a curvilinear probe, along its arc).  [default: 0.41 of the "
    "aperture; with REC where it was]",
)
@click.option(
    "--cone",
    type=CONE,
    metavar="DEG",
    help="Largest tilt, up to 85.  [default: 40; with REC that of its images, at least 30]",
)
@click.option(
    "--turn",
    type=Number(zero=True, largest=180.0),
    metavar="DEG",
    help="Largest turn about the beam's direction, up to 180.  [default: 90; with REC that of its "
    "images, at least 60]",
)
@click.option(
    "--sigma",
    type=POSITIVE,
    nargs=3,
    metavar="LATERAL RANGE ELEVATIONAL",
    help="SDs of the errors, mm, without REC. They may be wrong by a factor of three.  [default: "
    "those that the probe's geometry gives]",
)
@click.option(
    "--estimate",
    metavar="LIST",
    help="With REC: further unknowns (scale, sound-speed), as for calibrate.",
)
@seed_option("Seed of the candidate poses.")
@click.option(
    "--simulate",
    type=click.Choice(OFFSET_LAWS),
    multiple=True,
    metavar="LAW",
    help="Calibrate 1,000 simulated recordings of the planned poses, and report their error. LAW "
    f"is the distribution of the elevational offsets: {', '.join(OFFSET_LAWS)}. May be repeated.",
)
@click.option("--figure", type=click.Path(), metavar="PNG", help="Draw the plan.")
@json_option
def plan(
    recording: str | None,
    images: int | None,
    until_tre: float | None,
    criterion: Criterion,
    probe: ProbeKind | None,
    sigma: tuple[float, float, float] | None,
    estimate: str | None,
    simulate: tuple[LawName, ...],
    figure: str | None,
    as_json: bool,
    **candidate: Any,  # depth, lateral, cone, turn, seed
) -> int:
    """Plan which poses to take images from, and how many are needed for a given error.

    Without REC, plans from a probe and a region alone; with REC, calibrates from it (joint method)
    and says which images to add. Poses are described in words for a hand-held probe; --json has
    them as matrices.
    """
    if images is not None and until_tre is not None:
        raise InputError("give either --images or --until-tre")
    if recording is None and estimate is not None:
        raise InputError("--estimate needs a recording")
    if recording is not None and sigma is not None:
        raise InputError("--sigma cannot be used with a recording: its images determine the SDs")
    for name, largest, least in (
        ("--lateral", candidate["lateral"], _LEAST_LATERAL_MM),
        ("--sigma", sigma and max(sigma), _LEAST_SIGMA_MM),
    ):
        if largest is not None and largest < least:
            raise InputError(f"{name} is in mm, and {largest:g} is too small: was it in metres?")
    import_engine()
    from jaxcal import design
    from jaxcal.design.count import plan_until
    from jaxcal.io.atomic import save_figure
    from jaxcal.io.outputs import begins_with, check_output

    prepare_jax()
    if figure is not None:
        check_output(figure, "a picture", begins_with(*_PICTURES), [recording] if recording else ())
    result, found_wrong = None, {}
    if recording is None:
        candidates = _from_nothing(probe or "linear", sigma, **candidate)
    else:
        result, candidates, found_wrong = _from_recording(recording, estimate, probe, **candidate)
    with progress("planning"):
        if until_tre is None:
            count = images or (30 if result is None else 10)
            found = design.plan(candidates, count, criterion, result)
        else:
            found = plan_until(candidates, until_tre, criterion, result)
        if figure is not None:
            save_figure(design.plan_figure(found, until_tre), figure)
        record = _record(found, recording, candidates.constraints.region, result) | found_wrong
    if simulate:
        with progress("calibrating simulated recordings"):
            record["simulated"] = [
                asdict(design.simulate_errors(found, law, candidates, seed=candidate["seed"]))
                for law in simulate
            ]
    if as_json:
        print_json(record)
    else:
        _print(found, record, figure, until_tre)
    return ExitCode.CONVERGED


def _region(
    whole: Region,
    depth: tuple[float, float] | None,
    lateral: float | None,
    middle: float = 0.0,
    edges: tuple[float, float] = (-inf, inf),
) -> Region:
    """A region, with the depths and lateral positions that were asked for in the place of its."""
    if lateral is not None:
        left, right = max(middle - lateral, edges[0]), min(middle + lateral, edges[1])
        whole = replace(whole, lateral_mm=(left, right))
    return whole if depth is None else replace(whole, depth_mm=depth)


def _columns(
    images: Images, seen: Region, transform: ImageTransform
) -> tuple[float, tuple[float, float]]:
    """The middle to which ``--lateral`` refers, and the edges of the image, lateral, mm.

    Pixels count from the image's left edge, and points in mm from the transducer's middle.
    """
    scale, size = transform.scale_mm_per_px, images.frame_size
    if scale is None:
        return 0.0, (-inf, inf)
    last = inf if size is None else float(scale[0] * (size[0] - 1))
    return sum(seen.lateral_mm) / 2, (0.0, last)


def _from_nothing(
    probe: ProbeKind,
    sigma: tuple[float, float, float] | None,
    depth: tuple[float, float] | None,
    lateral: float | None,
    cone: float | None,
    turn: float | None,
    seed: int,
) -> Candidates:
    from jaxcal import design
    from jaxcal.data.probe import PRESETS, LinearProbe

    transducer = PRESETS[probe]
    half = 0.5 * transducer.width_mm
    if lateral is not None and lateral > half:
        what = "image" if isinstance(transducer, LinearProbe) else "arc"
        raise InputError(
            f"--lateral {lateral:g}: the {what} of this probe reaches {half:.1f} mm to either side"
        )
    bounds = design.Constraints(
        region=_region(design.Region.of_probe(transducer), depth, lateral),
        cone_deg=design.Constraints.cone_deg if cone is None else cone,
        turn_deg=design.Constraints.turn_deg if turn is None else turn,
    )
    noise = design.Noise.of_probe(transducer) if sigma is None else design.Noise.constant(sigma)
    return design.make_candidates(
        transducer, constraints=bounds, model=design.Model(noise=noise), seed=seed
    )


def refuse_wrong_lengths(result: Calibration, path: str) -> None:
    """Refuse to plan in wrong frames or units: a robot would move by wrong lengths.

    Raises:
        InputError: wrong frames, or poses that may be in another unit than mm.
    """
    if told := result.wrong_frames or result.doubtful_unit:
        raise InputError(f"{path}: {told}")


def _from_recording(
    path: str,
    estimate: str | None,
    probe: ProbeKind | None,
    depth: tuple[float, float] | None,
    lateral: float | None,
    cone: float | None,
    turn: float | None,
    seed: int,
) -> tuple[Calibration, Candidates, dict[str, Any]]:
    """The calibration, the candidates, and what looks wrong with the recording."""
    from jaxcal import design
    from jaxcal.calibration.calibrate import calibrate
    from jaxcal.data.probe import PRESETS
    from jaxcal.io.given_files import naming
    from jaxcal.io.hdf5 import load
    from jaxcal.model.unknowns import unknown_names
    from jaxcal.report.next_poses import NOT_PLANNED
    from jaxcal.report.record import calibration_record

    names = unknown_names(estimate)
    if NOT_PLANNED in names:
        raise InputError(
            f"--estimate {NOT_PLANNED}: no plan is made with it, since its predictions would be "
            "wrong: leave it out here"
        )
    measured, _ = segmented(load(path))
    if probe is not None and measured.calibration.kind == "pixel":
        raise InputError(
            f"--probe {probe}: {path} holds pixels, and where the transducer is in the image is "
            "not known: leave --probe out (--depth and --lateral set the region)"
        )
    with progress("calibrating"), naming(path):
        result = calibrate(measured, estimate=names)
    if result.status == "failed":
        raise InputError(f"{path}: the calibration failed: there is nothing to plan from")
    refuse_wrong_lengths(result, path)
    record = calibration_record(result, replace(measured, test=None))
    wrong = {
        "contradictions": (record["tre"] or {}).get("contradictions", []),
        "outliers": record["outliers"],
    }
    known = measured.probe
    if probe is not None and known not in (None, PRESETS[probe]):
        raise InputError(
            f"--probe {probe}: {path} holds images of another probe ({known}): leave --probe out"
        )
    if probe is not None:
        measured = replace(measured, probe=PRESETS[probe])

    def around(region: Region | None) -> Candidates:
        return design.candidates_around(
            measured, result, region=region, cone_deg=cone, turn_deg=turn, seed=seed
        )

    candidates = around(None)
    if depth is not None or lateral is not None:
        seen = candidates.constraints.region
        middle, edges = _columns(measured.calibration, seen, result.image_transform())
        candidates = around(_region(seen, depth, lateral, middle, edges))
    return result, candidates, wrong


def _record(
    found: Plan, recording: str | None, region: Region, result: Calibration | None
) -> dict[str, Any]:
    from jaxcal.design import images_to
    from jaxcal.report.next_poses import pose_records

    counted = {}
    # As --until-tre counts: fewer are not enough to estimate the SDs.
    least = 0 if found.known.images else MINIMUM_SELF_TUNING
    for wanted in _COUNTED:
        try:
            needed = found.known.images + images_to(found, wanted)
            counted[f"{wanted:g}"] = max(needed, least)
        except InputError:
            counted[f"{wanted:g}"] = None
    return {
        "source": recording,
        "criterion": found.criterion,
        "region": {
            "depth_mm": list(region.depth_mm),
            "lateral_mm": list(region.lateral_mm),
            "radius_mm": region.radius_mm,
        },
        "images_before": found.known.images,
        "tre_mm": found.tre_mm,
        "rp_mm": found.rp_mm,
        "images_to_tre_mm": counted,
        "poses": pose_records(found, result),
    }


def _print(
    found: Plan, record: dict[str, Any], figure: str | None, until_tre: float | None
) -> None:
    print_page(
        _table(record),
        *_region_in_words(record["region"]),
        *_errors_in_words(found, record, until_tre),
        *(_simulated_in_words(errors) for errors in record.get("simulated", ())),
        *([] if figure is None else [f"figure: {figure}"]),
    )


def _table(record: dict[str, Any]) -> Table:
    """How to hold the probe for each pose, where the target then is, and the error after it."""
    pixels = "target_px" in record["poses"][0]
    where = "u, v\n(px)" if pixels else "lateral, depth\n(mm)"
    hold = "how to hold the probe"
    table = simple_table(("", hold, where, "error then\n(mm)"), (hold,))
    for k, pose in enumerate(record["poses"], start=record["images_before"] + 1):
        lateral, depth = pose["target_px" if pixels else "target_mm"]
        words = pose["words"] + " (fills space)" * pose["fills_space"]
        table.add_row(str(k), words, f"{lateral:z.0f}, {depth:z.0f}", f"{pose['tre_mm']:#.3g}")
    return table


def _region_in_words(region: dict[str, Any]) -> list[str]:
    (near, far), (left, right) = region["depth_mm"], region["lateral_mm"]
    # Of a sector, neither is what the table says of a target beside the middle.
    curved = region["radius_mm"] is not None
    extent = "from the array, in front of its arc" if curved else "deep, laterally"
    return [
        f"Target {near:.0f} to {far:.0f} mm {extent} from {left:z.0f} to {right:z.0f} mm.",
        "Tilts and turns from the middle orientation, with the marker to your right; left is where "
        "the lateral position is smallest. Take them in any order.",
    ]


def _errors_in_words(found: Plan, record: dict[str, Any], until_tre: float | None) -> list[str]:
    """The predicted errors, how many images others take, and what may be wrong with them."""
    there, told = found.known.images, []
    now = found.tre_mm[0]
    if there and until_tre is not None and now <= until_tre:
        told.append(f"The existing images reach {until_tre:g} mm already ({now:.2g} mm).")
    these = "this image" if len(found) == 1 else f"these {len(found)} images"
    before = f" added to the {there} existing ones" if there else ""
    told.append(
        # A test of real images has their own errors as well.
        f"Predicted with {these}{before}: error over the image {found.tre_mm[-1]:.2g} mm, "
        f"reconstruction precision of images without errors {found.rp_mm[-1]:.2g} mm."
    )
    counts = [
        f"{wanted} mm: "
        + ("over 1000" if count is None else "reached" if count <= there else f"{count}")
        for wanted, count in record["images_to_tre_mm"].items()
    ]
    total = ", the existing ones included," if there else ""
    least = ""
    if not there and len(found) < MINIMUM_SELF_TUNING:
        least = f" (never fewer than {MINIMUM_SELF_TUNING}, which estimating the errors' SDs takes)"
    told.append(f"Images needed{total} for an error of {'; '.join(counts)}{least}.")
    if record.get("contradictions") or record.get("outliers"):
        what = (
            "what contradicts the noise model"
            if record["contradictions"]
            else "images that do not fit the rest"
        )
        told.append(
            f"These errors are by the noise model alone. First see to the images that there are: "
            f"the verdict of jaxcal calibrate names {what}."
        )
    return told


def _simulated_in_words(errors: dict[str, Any]) -> str:
    lost = f" {errors['lost']} could not be calibrated." if errors["lost"] else ""
    return (
        f"In {errors['trials']} simulated recordings with {errors['law']} offsets: error over the "
        f"image {errors['tre_mm']:.2g} mm (below {errors['tre_95_mm']:.2g} mm in 95 of 100), "
        f"reconstruction precision of images without errors {errors['rp_mm']:.2g} mm.{lost}"
    )
