"""A calibration as one JSON object: plain values with units in their names, finite or null."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

import jaxcal
from jaxcal import InputError
from jaxcal.data.poses import rotation_angle
from jaxcal.data.recording import Images, Recording, Truth, shared_images
from jaxcal.diagnostics.intervals import beside_scale
from jaxcal.diagnostics.metrics import reconstruct, reconstruction_precision
from jaxcal.diagnostics.misfits import noise_model
from jaxcal.diagnostics.offset_fit import offset_law
from jaxcal.diagnostics.outliers import outlier_reasons, outliers, suspects
from jaxcal.model.unknowns import (
    TABLE,
    block_slice,
    measured,
    split_further,
    tangent_names,
    with_prior,
)
from jaxcal.report.accuracy import accuracy_record, as_solved, settle
from jaxcal.report.certified import certificate_record
from jaxcal.report.differences import what_differs
from jaxcal.result.calibration import Calibration
from jaxcal.result.saved import FORMAT, VERSION
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.arrays import plain
from jaxcal.runtime.messages import quoted

CONVENTION = {
    "units": "lengths in mm; rotations in rad where no unit is in the name",
    "image_frame": "x lateral along the elements, y elevational (z cross x), z axial away from the "
    "transducer; pixels: lateral = scale u, range = scale v + face offset",
    "image_plane_to_probe": "4x4, row-major, rigid; maps the image frame, in mm, to the probe's "
    "(tracked) frame. It is not PLUS's ImageToProbe",
    "plus_image_to_probe": "4x4, row-major; PLUS's and Slicer's ImageToProbe: maps (u, v, 0, 1) in "
    "pixels to the probe's frame; null for points in mm",
    "pose_frames": "names of the two frames of the poses, which are called the probe's (from) and "
    "the tracker's (to) here; null where the recording does not state them",
    "point_mm": "target in the tracker's frame",
    "elevation_mm": "estimated distance of the target from the image's mid-plane, along y; 0 where "
    "an image was left out",
    "covariance": "of image_plane_to_probe under the right perturbation X Exp([v, omega]): v in "
    "mm, then omega in rad, along and about the image's axes",
    "image_covariance": "of image_unknowns: those of covariance, and the logarithms of estimated "
    "pixel sizes and sound speed, and the delay in mm",
    "degrees_of_freedom": "of Student's distribution of the errors, with covariance as its "
    "scale; null where the SDs were given",
    "variance_factor": "mean square errors over what covariance says: Student's variance where the "
    "SDs that were tuned to the images are their weights, else 1; apply and tre include it",
    "further_unknowns": "every unknown that was estimated beside X and the target: values "
    "(factors on the nominal ones where a tangent is log_..., else in the tangent's unit), SDs and "
    "prior SDs of the tangents; prior_sd is null without a prior",
    "face_offset_mm": "range of pixel row 0, or of a measured range of 0; range_factor: estimated "
    "sound speed over the nominal one",
    "tre": "target registration error: distance between the true and the calibrated place of an "
    "image point; rms_mm over the region and in points with 95 % intervals, stated_* as the "
    "covariance has them, larger by factor where the data contradict it; null where the "
    "calibration is not to be used",
    "objective": "the minimised sum of squares: mm^2, or in SDs with the gaussian prior; with auto "
    "and uniform that of the Gaussian fit before the distributions are weighed",
    "certified": "no transform fits Eq. 7 better (one part in 1e9), which is proved: of the answer "
    "for the conventional method, of the conventional fit of the same images for the others; "
    "Eq. 7's minimum is at most gap_mm2 lower; null where no proof is tried",
    "wrong_frames": "what is wrong with the data's frames or units, in words: the calibration is "
    "not to be used; null where nothing seems wrong",
    "doubtful_unit": "why the poses may be in another unit than mm, in words: all lengths may be "
    "in that unit, and the error is not known; null where nothing speaks for it",
    "test_residual_mm": "of every test image, from its point to the mean of all: lateral, "
    "elevational, axial; null where it is not used",
    "date": "when the calibration was written: ISO 8601, UTC; not in the record of a calibration "
    "in memory",
    "offset_law": "which distribution the elevational offsets follow, with what probability, their "
    "mean, and which noise model is in use; null where no distributions were weighed",
}


def calibration_record(
    result: Calibration,
    recording: Recording,
    test: Recording | None = None,
    tre_points: tuple[tuple[float, float], ...] = (),
) -> dict[str, Any]:
    """Everything about one calibration that goes into ``calibration.json`` and ``--json``.

    Args:
        result: of one problem (not a batch), with concrete values.
        recording: what was calibrated; its truth and test set are used where it has them.
        test: another recording whose calibration images are the test set instead.
        tre_points: further image points, in the images' unit, for which to give the error.

    Returns:
        A dictionary that ``json.dumps(..., allow_nan=False)`` accepts.

    Raises:
        InputError: times of flight, or test images that cannot be brought to mm (see
            :func:`check_test_images`).
    """
    if recording.calibration.kind == "time_of_flight":
        raise InputError(
            f"{recording.source}: the images hold times of flight, not points: give the recording "
            "that jaxcal.segment_recording makes of them"
        )
    answer = result.numpy()
    solved, tested = as_solved(recording, answer), check_test_images(recording, test)
    images = solved.calibration if tested is None else tested
    scale = answer.scale_mm_per_px
    transform = answer.image_transform()
    known = transform.covariance is not None
    frames = recording.pose_frames
    record: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "method": result.method,
        "prior": result.prior,
        "converged": bool(result.converged),
        "status": result.status,
        "iterations": int(answer.convergence.iterations),
        "variance_rounds": int(answer.convergence.variance_rounds),
        "images": len(answer.mask),
        "images_used": int(result.images_used),
        "frame": recording.calibration.frame,
        "pose_frames": frames and {"from": frames[0], "to": frames[1]},
        "image_plane_to_probe": answer.image_to_probe,
        "plus_image_to_probe": None if scale is None else transform.plus_matrix(),
        "point_mm": answer.point,
        "elevation_mm": answer.elevation,
        "elevation_sd_mm": answer.elevation_sd,
        "offset_law": offset_law(answer),
        "sigma_lateral_mm": answer.sigma[0],
        "sigma_range_mm": answer.sigma[1],
        "sigma_elevation_mm": answer.sigma[2],
        "tracker_sd_mm": answer.linearisation.tracker_sd,
        "covariance": transform.covariance,
        "image_unknowns": tangent_names(transform.unknowns),
        "image_covariance": transform.image_covariance,
        "degrees_of_freedom": transform.degrees_of_freedom,
        "variance_factor": transform.variance_factor,
        "point_covariance_mm2": answer.point_covariance if known else None,
        "observability": result.observability,
        "rms_mm": answer.rms,
        **certificate_record(answer),
        "reconstruction_precision_mm": _precision(answer, images),
        "reconstruction_precision_set": "calibration" if tested is None else "test",
        "reconstruction_precision_images": int(np.sum(images.mask)),
        "test_residual_mm": None if tested is None else _test_residual(answer, tested),
        "test_frame": None if tested is None else tested.frame,
        "scale_mm_per_px": answer.scale_mm_per_px,
        "face_offset_mm": transform.face_offset_mm,
        "range_factor": transform.range_factor,
        "further_unknowns": further_unknowns(answer),
        "data": result.data,
        "channel_sigma_mm": answer.channel_sigma,
        "sound_speed_m_s": answer.medium.sound_speed_m_s,
        "sound_speed_sd_m_s": answer.medium.sound_speed_sd_m_s,
        "delay_s": answer.medium.delay_s,
        "delay_sd_s": answer.medium.delay_sd_s,
        "objective": answer.convergence.cost,
        "scaled_kkt_residual": answer.convergence.stationarity,
        "robust": result.robust,
        "wrong_frames": None if result.status == "failed" else result.wrong_frames,
        "doubtful_unit": None if result.status == "failed" else result.doubtful_unit,
        "noise_model": noise_model(answer),
        "outliers": outliers(answer),
        "outlier_reasons": outlier_reasons(answer),
        "suspects": suspects(answer),
        "warnings": result.warnings,
        **accuracy_record(result, solved, tre_points),
    }
    if tested is not None:
        record["warnings"] += _other_test_images(
            tested, recording.calibration, None if scale is None else np.asarray(scale)
        )
    if recording.truth is not None:
        record["truth_error"] = truth_error(answer, recording.truth)
    record |= {"source": recording.source, "convention": CONVENTION}
    record["jaxcal_version"] = jaxcal.__version__
    found = plain(record)
    settle(found)
    return found


def _other_test_images(
    tested: Images, images: Images, scale: Float[np.ndarray, " 2"] | None
) -> list[str]:
    """What test images should have in common with those to calibrate with, and have not."""
    whose = "the calibration", "the test images"
    found = what_differs(("Probe", "Probe"), (scale, tested.spacing_mm), whose)
    if tested.kind != images.kind:
        found.append(
            f"The test images hold {tested.kind}s, those to calibrate with {images.kind}s: do both "
            "count from one place? Pixels count from the image's corner, points in mm mostly from "
            "the middle of the transducer."
        )
    return found


def further_unknowns(answer: Calibration) -> dict[str, dict[str, Any]]:
    """Values, SDs and prior SDs of the unknowns that were estimated beside X and the target.

    Args:
        answer: one calibration in numpy arrays.
    """
    found, blocks = answer.linearisation, answer.blocks
    sd = np.sqrt(np.diagonal(answer.unknowns_covariance))
    prior: dict[str, Any] = {}
    if found.prior_sd is not None:
        prior = dict(zip(with_prior(blocks), found.prior_sd, strict=True))
    return {
        name: {
            "tangents": TABLE[name].tangents,
            "values": np.array(values),
            "sd": sd[block_slice(blocks, name)],
            "prior_sd": prior.get(name),
        }
        for name, values in split_further(found.further, blocks).items()
    }


def truth_error(result: Calibration, truth: Truth) -> dict[str, float]:
    """How far a calibration is from a simulation's truth.

    Returns:
        ``rotation_deg`` and ``translation_mm`` of X, ``point_mm`` of the target.
    """
    transform = np.asarray(result.image_to_probe)
    moved = transform[:3, 3] - truth.image_to_probe[:3, 3]
    return {
        "rotation_deg": math.degrees(rotation_angle(truth.image_to_probe, transform)),
        "translation_mm": float(np.linalg.norm(moved)),
        "point_mm": float(np.linalg.norm(np.asarray(result.point) - truth.point)),
    }


def check_test_images(recording: Recording, test: Recording | None = None) -> Images | None:
    """The images of the independent test set, checked; None if there is no test set.

    They are the calibration images of ``test``; without it, the recording's own test set.

    Raises:
        InputError: times of flight, pixels without a spacing beside points in mm or in frames of
            another size, poses of another frame than the probe's, or images that are among those to
            calibrate with.
    """
    images = recording.test if test is None else test.calibration
    source = recording.source if test is None else test.source
    if images is None:
        return None
    if images.kind == "time_of_flight":
        raise InputError(f"{source}: test images must hold points or pixels, not times of flight")
    unscaled = images.kind == "pixel" and images.spacing_mm is None
    if unscaled and recording.calibration.kind != "pixel":
        raise InputError(
            f"{source}: test images are pixels without spacing_mm: their mm are unknown"
        )
    ours, theirs = recording.calibration.frame_size, images.frame_size
    if unscaled and ours and theirs and ours != theirs:
        raise InputError(
            f"{source}: its frames have {theirs[0]} x {theirs[1]} px, those to calibrate with "
            f"{ours[0]} x {ours[1]}: a pixel's size, which is estimated, would be another one"
        )
    named, other = recording.pose_frames, None if test is None else test.pose_frames
    if named and other and named[0] != other[0]:
        raise InputError(
            f"{source}: its poses are those of {quoted(other[0])}, not of {quoted(named[0])} as in "
            f"{recording.source} (import with --from)"
        )
    if shared := shared_images(images, recording.calibration):
        raise InputError(
            f"{source}: {shared} of {int(images.mask.sum())} test images are among the images to "
            "calibrate with: a test set is independent, recorded apart"
        )
    return images


def _precision(result: Calibration, images: Images) -> float | None:
    if images.mask.sum() < 2:
        return None
    value = reconstruction_precision(
        np.asarray(result.image_to_probe), images.poses, _points_mm(images, result), images.mask
    )
    return float(value)


def _test_residual(result: Calibration, images: Images) -> list[np.ndarray | None] | None:
    """Of every test image: from its point to the mean of all, along the image's axes, mm.

    The root of the sum of their squares over n - 1 is the reconstruction precision. None for an
    image that is not used, and for all if there is no calibration.
    """
    transform, used = np.asarray(result.image_to_probe), images.mask
    if not (used.any() and np.isfinite(transform).all()):
        return None
    cloud = reconstruct(transform, images.poses, _points_mm(images, result))
    missed = cloud[used].mean(axis=0) - cloud
    axes = images.poses[:, :3, :3] @ transform[:3, :3]
    along = np.einsum("nji,nj->ni", axes, missed)
    return [row if kept else None for row, kept in zip(along, used, strict=True)]


def _points_mm(images: Images, result: Calibration) -> Float[np.ndarray, "n 2"]:
    """[lateral, range] in mm, at the pixel sizes, sound speed and delay of the calibration."""
    scale = np.ones(2)
    if images.kind == "pixel":
        # An estimated scale replaces any given one; if it is not estimated, each set uses its own.
        scale = result.scale_mm_per_px
        if images.spacing_mm is not None and "scale" not in result.blocks:
            scale = images.spacing_mm
    lateral, axial = (images.measurements * np.asarray(scale)).T
    points = measured(lateral, axial, images.face_offset_mm, beside_scale(result))
    return np.stack(points, axis=1)
