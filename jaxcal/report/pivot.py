"""What a pivot calibration says: as plain values, and in words."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxcal.calibration.pivot import AXES, Pivot
from jaxcal.diagnostics.outliers import outlier_reasons, outliers
from jaxcal.runtime.arrays import plain
from jaxcal.runtime.messages import counted


def pivot_record(result: Pivot) -> dict[str, Any]:
    """What ``jaxcal pivot --json`` prints, as plain values."""
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
            "alike_for_poses": float(result.alike_for),
            "sigma_mm": float(result.sigma),
            "rms_mm": float(result.rms),
            "robust": result.robust,
            "outliers": outliers(result),
            "outlier_reasons": outlier_reasons(result, AXES),
            "repeated": int(((mask <= 0) & (np.asarray(result.outlier) <= 0)).sum()),
            "wrong_frames": result.wrong_frames,
            "uncertain": result.uncertain,
            "warnings": result.warnings,
        }
    )


def pivot_lines(record: dict[str, Any]) -> list[str]:
    """The record of a pivot calibration in words, a line each."""

    def three(name: str) -> str:
        return ", ".join("-" if value is None else f"{value:.3f}" for value in record[name])

    wrong = record["wrong_frames"]
    lines = [f"do not use: {wrong}"] if wrong else []
    lines.append(f"{record['status']}: {record['poses_used']} of {record['poses']} poses used")
    if record["status"] != "failed":
        lines.append(f"tip in the tool's frame (mm): {three('tip_mm')}")
        lines.append(f"pivot point in the tracker's frame (mm): {three('point_mm')}")
        lines.append(f"RMS of the errors: {record['rms_mm']:.3f} mm")
    if record["covariance"] is not None:
        spread = [record["covariance"][axis][axis] ** 0.5 for axis in range(3)]
        lines.append("SD of the tip (mm): " + ", ".join(f"{value:.3f}" for value in spread))
    if record["alike_for_poses"] > 1:
        alike, used = record["alike_for_poses"], record["poses_used"]
        lines.append(
            f"errors are alike for about {alike:.0f} successive poses: for the SD, {used} poses "
            f"count as {max(used / alike, 1):.0f}"
        )
    if record["repeated"]:
        again = counted(record["repeated"], "pose", "repeats", "repeat")
        lines.append(f"{again} an earlier one exactly: not used")
    return [*lines, *(f"- {text}" for text in record["warnings"] if text != wrong)]
