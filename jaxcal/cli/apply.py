"""``jaxcal apply``: where pixels are, in the probe's or the tracker's frame, and how certain."""

from __future__ import annotations

from typing import Any

import click

from jaxcal import InputError
from jaxcal.cli.common import NOT_NEGATIVE, ExitCode
from jaxcal.cli.sequence_options import TABLES, with_options
from jaxcal.runtime.messages import counted

_COLUMNS = (
    "x_mm",
    "y_mm",
    "z_mm",
    "sd_x_mm",
    "sd_y_mm",
    "sd_z_mm",
    "cov_xy_mm2",
    "cov_xz_mm2",
    "cov_yz_mm2",
)
_HELD = {"pixel": "pixels", "point": "points in mm", "time_of_flight": "times of flight"}


@click.command(short_help="Take image points through a calibration, with their SDs.")
@click.argument("calibration", type=click.Path(), metavar="CAL")
@click.argument("source", type=click.Path(), metavar="[SOURCE]", required=False)
@click.option("--pixel", type=float, nargs=2, multiple=True, metavar="U V", help="A single point.")
@click.option(
    "--pixel-sd",
    type=NOT_NEGATIVE,
    default=0.0,
    metavar="PX",
    help="SD of the points in the image, px (mm without pixels).",
)
@with_options(TABLES)
@click.option(
    "--out",
    type=click.Path(),
    metavar="OUT.csv",
    help="Write to this file, not to standard output.",
)
def apply(
    calibration: str,
    source: str | None,
    pixel: tuple[tuple[float, float], ...],
    pixel_sd: float,
    out: str | None,
    **table: Any,
) -> int:
    """Map image points by the calibration CAL; prints a table with standard deviations.

    SOURCE is a table with columns u and v, and a pose (probe to tracker) if points in the tracker's
    frame are wanted; or a recording (.h5). Standard deviations and covariances include those of the
    calibration (with estimated pixel sizes) and of --pixel-sd, but not those of the pose. Those of
    the calibration are what its covariance says, times the factor for few images that the TRE of
    its report has, too (variance_factor). If its verdict expects larger errors still, that factor
    is printed on standard error. Points and SDs are rounded to 1e-6 mm. Masked images of a
    recording are left out; a last column, image, has the numbers of the others. With --skip-invalid
    a last column, line, says which row is which.
    """
    import numpy as np

    from jaxcal.io.atomic import write_text
    from jaxcal.io.outputs import begins_with, check_output
    from jaxcal.io.table import csv_text
    from jaxcal.report.differences import what_differs
    from jaxcal.result.saved import load_calibration

    if (source is None) == (not pixel):
        raise click.UsageError("name SOURCE, or points by --pixel U V")
    given = _given(table)
    if given and (source is None or _is_recording(source)):
        raise click.UsageError(f"{given}: for tables, but no table is read")
    if out is not None:
        inputs = [calibration] if source is None else [calibration, source]
        check_output(out, "such a table", begins_with(",".join(_COLUMNS).encode()), inputs)
    transform = load_calibration(calibration)
    transform.check_usable()
    points, poses, numbers = np.array(pixel), None, None
    if source is not None:
        points, poses, kind, numbers, spacing, frame, origin = _read(source, table)
        pixels = transform.scale_mm_per_px is not None
        if kind != ("pixel" if pixels else "point"):
            # A table's u and v are pixels unless its header says that they are not.
            hint = "" if pixels or kind != "pixel" else " (a table with them has u_mm and v_mm)"
            held, wanted = _HELD[kind], _HELD["pixel" if pixels else "point"]
            raise InputError(f"{source}: holds {held}, the calibration takes {wanted}{hint}")
        names, sizes = (transform.probe_frame, frame), (transform.scale_mm_per_px, spacing)
        ours = transform.face_offset_mm
        origins = ours, ours if origin is None else origin
        for note in what_differs(names, sizes, (calibration, source), origins):
            click.echo(f"- {note}", err=True)
    elif transform.scale_mm_per_px is None:
        click.echo(
            f"{calibration}: knows no pixel size, so --pixel takes points in mm: lateral, range",
            err=True,
        )
    if transform.doubtful_unit is not None:
        click.echo(f"- {calibration}: {transform.doubtful_unit}", err=True)
    if transform.tre_factor > 1:
        click.echo(
            f"- {calibration}: its verdict expects errors {transform.tre_factor:.1f} times as "
            "large as these SDs of the calibration say",
            err=True,
        )
    applied = transform.apply(points, poses, pixel_sd_px=pixel_sd)
    name, which = numbers or ("", [])
    rows: list[tuple[object, ...]] = [(*_COLUMNS, name) if which else _COLUMNS]
    formats = (".6f",) * 6 + (".6g",) * 3
    for k, (point, covariance) in enumerate(zip(applied.points, applied.covariance, strict=True)):
        values = [*point, *np.sqrt(np.diag(covariance)), *covariance[[0, 0, 1], [1, 2, 2]]]
        # Where SDs are not known, cells are empty.
        cells = [
            f"{value:{form}}" if np.isfinite(value) else ""
            for value, form in zip(values, formats, strict=True)
        ]
        rows.append((*cells, which[k]) if which else tuple(cells))
    if out is None:
        click.echo(csv_text(rows), nl=False)
    else:
        write_text(out, csv_text(rows))
        frame = "probe" if poses is None else "tracker"
        click.echo(f"{out}: {counted(len(points), 'point')} in the {frame}'s frame")
    return ExitCode.CONVERGED


def _is_recording(source: str) -> bool:
    return source.lower().endswith((".h5", ".hdf5"))


def _given(options: dict[str, Any]) -> str:
    """The options that were given, as they are typed."""
    return ", ".join(f"--{name.replace('_', '-')}" for name, value in options.items() if value)


def _read(source: str, options: dict[str, Any]):
    """Points, poses or None, the points' kind, and the images or lines that they are of.

    Then the size of a pixel (mm), the name of the probe's frame, and the range of pixel row 0 (mm),
    as far as the file knows them.
    """
    if _is_recording(source):
        from jaxcal.io.hdf5 import load

        recording = load(source)
        images = recording.calibration
        used = images.mask
        which = "image", used.nonzero()[0].tolist()
        frame = (recording.pose_frames or ("Probe",))[0]
        read = images.measurements[used], images.poses[used], images.kind, which
        return *read, images.spacing_mm, frame, images.face_offset_mm
    from jaxcal.data.recording import MetresError, check_pose_units
    from jaxcal.io.importing.sources import SEQUENCES, kind_of
    from jaxcal.io.text import read_pose_table

    if kind_of(source) in SEQUENCES:
        raise InputError(
            f"{source}: holds frames or poses, but no points: import it with points (jaxcal "
            "import), and apply the calibration to the recording"
        )
    table = read_pose_table(source, **options)
    if table.points is None:
        raise InputError(f"{source}: holds no points (columns u and v)")
    skipping = options["skip_invalid"]
    of_poses = _given(options | {"skip_invalid": False})
    if of_poses and table.poses is None:
        raise click.UsageError(f"{of_poses}: for poses, but {source} holds none")
    unit_stated = table.length_stated or options["pose_units"] is not None
    if table.poses is not None and not unit_stated:
        try:
            check_pose_units(table.poses[:, :3, 3])
        except MetresError as error:
            raise InputError(f"{source}: {error} (--pose-units m)") from None
    which = ("line", table.lines) if skipping else None
    return table.points, table.poses, table.kind, which, None, "Probe", None
