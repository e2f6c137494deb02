"""Cross-validation and bootstrap as plain values, and in words."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal.diagnostics.residual_checks import FEWEST_TO_CHECK
from jaxcal.report.accuracy import stated_at
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.arrays import map_arrays, plain

if TYPE_CHECKING:
    from jaxcal.calibration.resampling import Bootstrap, CrossValidation


def cross_validation_record(found: CrossValidation, result: Calibration) -> dict[str, Any]:
    """Cross-validation as plain values; ``result`` is the calibration of all images."""
    found = map_arrays(np.asarray, found)
    used = found.mask > 0
    return plain(
        {
            "folds": len(found.converged),
            "folds_converged": found.converged.sum(),
            "precision_mm": found.precision,
            "rms_mm": found.rms,
            "log_density": np.sum(found.log_density),
            "influence": np.where(used, found.influence, np.nan),
            "image_moved_mm": np.where(used, found.image_moved, np.nan),
            "image_points_mm": found.image_points,
            "stated_mm": stated_at(result, found.image_points),
        }
    )


def bootstrap_record(found: Bootstrap, result: Calibration) -> dict[str, Any]:
    """The bootstrap as plain values; ``result`` is the calibration of all images."""
    found = map_arrays(np.asarray, found)
    return plain(
        {
            "resamples": len(found.converged),
            "resamples_converged": found.converged.sum(),
            "translation_sd_mm": found.spread[:3],
            "rotation_sd_deg": np.degrees(found.spread[3:]),
            "image_points_mm": found.image_points,
            "reproducibility_mm": found.reproducibility,
            "rms_scatter_mm": found.rms_scatter,
            "stated_mm": stated_at(result, found.image_points),
        }
    )


def resampled_sentences(record: dict[str, Any]) -> list[str]:
    """Sentences about cross-validation and bootstrap, for the verdict."""
    lines = []
    held = record.get("cross_validation")
    if held is not None and held["precision_mm"] is not None:
        lines.append(
            f"On images that were not used for the calibration, the reconstruction precision is "
            f"{held['precision_mm']:.2f} mm ({held['folds']}-fold cross-validation)."
        )
    drawn = record.get("bootstrap")
    if drawn is not None and drawn["reproducibility_mm"][-1] is not None:
        worst = max(value for value in drawn["reproducibility_mm"] if value is not None)
        turned = math.sqrt(sum((value or 0.0) ** 2 for value in drawn["rotation_sd_deg"]))
        done, every = drawn["resamples_converged"], drawn["resamples"]
        which = f"{done} bootstrap calibrations"
        if done < every:
            which = (
                f"{done} of {every} bootstrap calibrations (the others had fewer than four "
                "different images, or did not converge)"
            )
        lines.append(
            f"In {which}, a point in the middle of the image "
            f"scatters by {drawn['reproducibility_mm'][-1]:.2f} mm, the worst corner by "
            f"{worst:.2f} mm, and the orientation by {turned:.2f} degrees."
        )
        if record["images_used"] < FEWEST_TO_CHECK:
            lines.append(
                f"Of {record['images_used']} images a resample has so few different ones that this "
                "scatter is usually larger than the error of the calibration from all of them."
            )
    return lines
