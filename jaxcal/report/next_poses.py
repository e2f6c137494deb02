"""Which images would help most after a calibration, for a program and for a person."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxcal import InputError, design
from jaxcal.data.recording import Recording
from jaxcal.report.paragraphs import listed
from jaxcal.result.calibration import Calibration

COUNT = 3
_CANDIDATES = 2000
EXACT_MM = 1e-3
"""With a smaller error no further pose is of use: no tracker and no image is as exact."""
NOT_PLANNED = "delay"
"""The unknown with which no poses are planned: it and the axial translation compensate each other.
Both then have large SDs, and an image point a small one, which a plan would predict wrongly."""


def next_poses_record(
    result: Calibration, recording: Recording, cone_deg: float | None = None
) -> dict[str, Any] | None:
    """The three images that would help most; None where nothing can be said.

    Args:
        result: of the recording.
        recording: what was calibrated.
        cone_deg: largest tilt; by default that of the images, at least 30 degrees.

    Returns:
        ``tre_now_mm`` and ``tre_then_mm`` (predicted, root mean square over the image),
        ``images_to_half`` (how many would halve the error; None: over 1000) and ``poses``. Each
        pose has ``words``, ``target_mm`` [lateral, axial] (and ``target_px`` [u, v] where the
        images are in pixels), ``pose`` (4x4, probe -> tracker),
        ``fills_space`` and ``tre_mm``, the error with this pose and those before it.
    """
    wrong = result.status == "failed" or result.wrong_frames is not None
    if wrong or result.doubtful_unit is not None or NOT_PLANNED in result.blocks:
        return None
    try:
        candidates = design.candidates_around(
            recording, result, count=_CANDIDATES, cone_deg=cone_deg
        )
        plan = design.next_poses(result, candidates, COUNT)
    except InputError:
        return None
    if not (np.isfinite(plan.tre_mm).all() and plan.tre_mm[0] >= EXACT_MM):
        return None
    try:
        half = design.images_to(result, 0.5 * float(plan.tre_mm[0]), candidates)
    except InputError:
        half = None
    return {
        "tre_now_mm": float(plan.tre_mm[0]),
        "tre_then_mm": float(plan.tre_mm[-1]),
        "images_to_half": half,
        "poses": pose_records(plan, result),
    }


def pose_records(plan: design.Plan, result: Calibration | None = None) -> list[dict[str, Any]]:
    """Each pose of a plan as plain values; targets in px, too, where ``result`` has their size."""
    model, bounds = plan.candidates.model, plan.candidates.constraints
    transform = None if result is None else result.image_transform()
    targets, pixels = plan.targets[:, [0, 2]], None
    size = None if transform is None else transform.scale_mm_per_px
    # Images that do not determine a pixel's size may make it zero.
    if transform is not None and size is not None and (size > 0).all():
        pixels = transform.image_points(targets).tolist()
    return [
        {
            "words": design.pose_in_words(pose, bounds, model.image_to_probe, model.point),
            "target_mm": target.tolist(),
            **({} if pixels is None else {"target_px": pixels[k]}),
            "pose": pose.tolist(),
            "fills_space": bool(filling),
            "tre_mm": float(tre),
        }
        for k, (pose, target, filling, tre) in enumerate(
            zip(plan.poses, targets, plan.filling, plan.tre_mm[1:], strict=True)
        )
    ]


def next_poses_sentences(record: dict[str, Any]) -> list[str]:
    """The next poses in sentences, from the record of a calibration; empty if it has none."""
    found = record.get("next_poses")
    if found is None:
        return []
    now, then = found["tre_now_mm"], found["tre_then_mm"]
    tre = record.get("tre") or {}
    stated = tre.get("rms_mm") is not None
    # More images do not help against an error that the noise model leaves out.
    beside = bool(tre.get("contradictions"))
    error = "error by the noise model alone" if beside else "predicted error"
    # As many digits as tell the two numbers apart.
    form = next((f for f in (".2f", ".3f", ".4f") if f"{now:{f}}" != f"{then:{f}}"), ".2g")
    gain = f" that reduce the {error} from {now:{form}} to {then:{form}} mm" if stated else ""
    lines = listed(
        f"Which images to add: {len(found['poses'])}{gain}. From the middle orientation, with the "
        "marker to your right",
        [pose["words"] for pose in found["poses"]],
    )
    if stated and found["images_to_half"] is not None:
        more = found["images_to_half"]
        images = "image" if more == 1 else "images"
        stays = "; what contradicts the noise model may remain" if beside else ""
        lines.append(f"Halving the {error} takes {more} more {images}, chosen like these{stays}.")
    return lines
