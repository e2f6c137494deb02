"""``jaxcal pivot``: a tracked tool's tip from poses taken while it turns about its tip."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from jaxcal.cli.common import (
    exit_code,
    import_engine,
    json_option,
    print_json,
    print_page,
    progress,
)

if TYPE_CHECKING:
    from jaxcal.calibration.pivot import Pivot


@click.command()
@click.argument("poses", type=click.Path(), metavar="POSES")
@click.option("--no-robust", is_flag=True, help="Use every pose, those that do not fit as well.")
@json_option
def pivot(poses: str, no_robust: bool, as_json: bool) -> int:
    """Find the tip of a tracked tool that was turned about its tip.

    POSES is a text file with a row for each pose, tool -> tracker, mm: x y z qx qy qz qs, or the
    matrix row by row (12 or 16 numbers). Poses that do not fit the rest are left out and named.
    """
    import_engine()
    from jaxcal.calibration.pivot import calibrate_pivot
    from jaxcal.io.text import read_poses
    from jaxcal.runtime.jax_cache import enable_compilation_cache

    measured = read_poses(poses)
    enable_compilation_cache()
    with progress("calibrating the pivot"):
        record = _record(calibrate_pivot(measured, robust=not no_robust))
    if as_json:
        print_json(record)
    else:
        _print(record)
    return exit_code([record])


def _record(result: Pivot) -> dict[str, Any]:
    import numpy as np

    from jaxcal.calibration.pivot import AXES
    from jaxcal.diagnostics.outliers import outlier_reasons, outliers
    from jaxcal.report.record import plain

    mask, covariance = np.asarray(result.mask), np.asarray(result.covariance)
    return plain(
        {
            "converged": bool(result.converged),
            "status": result.status,
            "poses": len(mask),
            "poses_used": int((mask > 0).sum()),
            "tip_mm": np.asarray(result.tip),
            "point_mm": np.asarray(result.point),
            "covariance": covariance if np.isfinite(covariance).all() else None,
            "sigma_mm": float(result.sigma),
            "rms_mm": float(result.rms),
            "robust": result.robust,
            "outliers": outliers(result),
            "outlier_reasons": outlier_reasons(result, AXES),
            "repeated": int(((mask <= 0) & (np.asarray(result.outlier) <= 0)).sum()),
            "wrong_frames": result.wrong_frames,
            "warnings": result.warnings,
        }
    )


def _print(record: dict[str, Any]) -> None:
    def three(name: str) -> str:
        return ", ".join("-" if value is None else f"{value:.3f}" for value in record[name])

    lines = [f"{record['status']}: {record['poses_used']} of {record['poses']} poses used"]
    if record["status"] != "failed":
        lines.append(f"tip in the tool's frame (mm): {three('tip_mm')}")
        lines.append(f"pivot point in the tracker's frame (mm): {three('point_mm')}")
        lines.append(f"RMS of the errors: {record['rms_mm']:.3f} mm")
    if record["covariance"] is not None:
        spread = [record["covariance"][axis][axis] ** 0.5 for axis in range(3)]
        lines.append("SD of the tip (mm): " + ", ".join(f"{value:.3f}" for value in spread))
    if record["repeated"]:
        lines.append(f"{record['repeated']} poses repeat an earlier one exactly and are not used")
    print_page(*lines, *(f"- {text}" for text in record["warnings"]))
