"""Everything that a person should know before using a calibration."""

from __future__ import annotations

import math

import numpy as np

from jaxcal.diagnostics.directions import observability
from jaxcal.diagnostics.image_errors import KINDS, error_sd
from jaxcal.diagnostics.misfits import misfits
from jaxcal.diagnostics.outliers import listed_outliers, outliers, suspects_in_words
from jaxcal.diagnostics.tracker_distortion import too_short
from jaxcal.model.thresholds import FALLBACK_SIGMA, MINIMUM_SELF_TUNING
from jaxcal.model.unknowns import block_slice
from jaxcal.result.calibration import Calibration, check_one
from jaxcal.runtime.messages import enumerated
from jaxcal.solvers.plan import TUNED

MISFIT = "noise model"
"""A warning of :func:`jaxcal.diagnostics.misfits.misfits` begins with this."""
IMPLAUSIBLE_RMS_MM = 10.0
"""Residuals with a larger root mean square do not come from a target within the beam."""
CARELESS_MM = 1.5
"""Errors within the image with a larger SD are not those of points placed with care."""
OTHER_THAN_GIVEN = 3.0
"""Residuals contradict given SDs if they are so many times as large, or as small."""
USUAL_PIXEL_MM = (0.02, 1.0)
"""Estimated pixel sizes outside this interval lead to a warning."""
_MILLIMETRE = 0.1
"""So do pixels whose sides are 1 mm to within this share: points in mm look like that."""
MOST_OBLONG = 3.0
"""And pixels of which one side is so many times as long as the other."""
UNLIKELY_STATED_SDS, LEAST_MISSTATED = 4.0, 0.005
"""Estimated pixels contradict their stated size if they differ from it by more than so many SDs and
by more than this share."""
FARTHEST_MM = 800.0
"""If the target is farther from the origin of the probe's frame, there is a warning. Instruments
that are tracked at their handle are half a metre long."""
STEADY = 1e-3
"""If the scaled KKT residual of a stopped alternation is larger, there is a warning."""
WEAK_MM = 1.5
"""If the SD of the weakest direction (mm at the target) is larger, there is a warning."""
WEAK_TRANSLATION_MM = 0.3
"""If the SD of the translation along the elevational axis is larger, there is a warning."""
_ALONG = 0.7
"""Two directions count as one if their cosine exceeds this."""
WEAK_SHARE = 0.7
"""If the SD of sound speed or delay exceeds this share of its prior SD, the data added little."""
UNLIKELY_SDS = 3.0
"""If one of them is farther from its nominal value than this, in the SDs that its prior expects of
an estimate, and the prior pulls it by more than its SD, there is a warning."""


def warnings(result: Calibration) -> list[str]:
    """Everything that a person should know before using the answer, most important first.

    Raises:
        InputError: of a batch.
    """
    check_one(result.status_code)
    if result.status == "failed":
        return ["the solve failed: the result holds no usable numbers"]
    if result.wrong_frames is not None:
        # The answer has no meaning, so no other warning is of use.
        return [result.wrong_frames]
    converged = result.status == "converged"
    return [
        *_without_convergence(result),
        *result.notes,
        *_implausible_residuals(result),
        *_repeated_poses(result),
        *_weak_direction(result),
        *_only_the_bound(result),
        *_odd_start_or_end(result),
        *_bound_not_kept(result),
        *_sds_not_tuned(result),
        *_other_than_given(result),
        *_weak_elevation(result),
        *_medium_warnings(result),
        *_unusual_pixels(result),
        *_other_than_stated(result),
        *_far_from_probe(result),
        *(f"{MISFIT}: {text}" for text in (misfits(result) if converged else [])),
        *(suspects_in_words(result) if converged else []),
        *_misfitting_images(result),
    ]


def _without_convergence(result: Calibration) -> list[str]:
    """Whether the images do not determine the answer, or the solver has not reached it."""
    if result.status == "unobservable":
        sight = observability(result)
        weakest, advice = sight["weakest_direction"], sight["advice"]
        return [f"not observable: these images do not determine {weakest}; {advice}"]
    if result.status == "max_iterations":
        return [
            "not converged: the iteration limit was reached "
            f"(scaled KKT residual {float(result.convergence.stationarity):.1e})"
        ]
    return []


def _implausible_residuals(result: Calibration) -> list[str]:
    """Residuals that no ultrasound beam explains."""
    rms = float(result.rms)
    if rms > IMPLAUSIBLE_RMS_MM:
        return [
            f"residuals of {rms:.1f} mm are larger than a beam is thick: either some images are "
            "far off, or the poses are wrong (order or signs of their numbers, units, direction)"
        ]
    lateral, distance = (float(size) for size in np.asarray(result.sigma)[:2])
    if not max(lateral, distance) > CARELESS_MM:
        return []
    wrong = "" if result.robust else ", or are some points wrong (--robust leaves them out)"
    return [
        f"errors within the image of {lateral:.1f} mm (lateral) and {distance:.1f} mm (range) are "
        "larger than those of points placed with care: are the poses right (order of angles, "
        f"signs, times), and is it one target{wrong}?"
    ]


def different_poses(result: Calibration) -> int | None:
    """How many of the poses in use are not exactly that of another image; None without a problem.

    A single calibration lets every pose count once, a batch does not.
    """
    if result.problem is None:
        return None
    poses = np.asarray(result.problem.poses)[np.asarray(result.mask) > 0]
    return len(np.unique(poses.reshape(len(poses), -1), axis=0))


def _repeated_poses(result: Calibration) -> list[str]:
    """Frames of one pose that were counted as independent images, as in a batch."""
    used, poses = int(result.images_used), different_poses(result)
    if poses is None or poses == used:
        return []
    return [
        f"{used} images have only {poses} different poses, and each counts as independent, as in a "
        "batch and in a jit: the stated error is too small. Solve the problem by itself "
        "(jaxcal.calibrate), which lets every pose count once"
    ]


def _only_the_bound(result: Calibration) -> list[str]:
    """A direction that only the bound on the offsets determines."""
    from_prior = observability(result)["known_only_from_prior"]
    if result.prior != "bounded" or not from_prior:
        return []
    resting = int(np.sum(result.at_bound > 0))
    held = f"{resting} of {int(result.images_used)} images are at the bound"
    if resting == 0:
        held = "no image is at the bound, so any value in an interval fits equally well"
    return [f"{from_prior} is determined by nothing but the bound on the offsets: {held}"]


def _odd_start_or_end(result: Calibration) -> list[str]:
    """A start that is not certain, and an alternation that ended before its minimum."""
    found, ended = [], result.convergence
    if ended.searched_start:
        found.append(
            "the start is not certain (degenerate poses or points, or too few images for their "
            "noise): it was found by descents from many rotations"
        )
    if result.method == "alternating" and ended.tolerance_met and ended.stationarity > STEADY:
        found.append(
            "the alternation stopped on its tolerance while its objective was still falling "
            f"(scaled KKT residual {float(ended.stationarity):.1e})"
        )
    return found


def _sds_not_tuned(result: Calibration) -> list[str]:
    """SDs that the data were not asked for, or that they could not tell."""
    found = []
    used = int(result.images_used)
    if result.prior in TUNED and not result.sigma_tuned:
        sizes = ", ".join(
            f"{kind} {size:.3g}" for kind, size in zip(KINDS, np.asarray(result.sigma), strict=True)
        )
        text = (
            f"noise SDs were held fixed ({sizes} mm), not estimated, and the stated error rests on "
            "them"
        )
        if used < MINIMUM_SELF_TUNING:
            text += (
                f": to estimate them takes at least {MINIMUM_SELF_TUNING} images, and {used} are "
                "used"
            )
        found.append(text)
    if np.any(result.convergence.sigma_floored):
        errors = zip(KINDS, result.convergence.sigma_floored, strict=True)
        names = [name for name, floored in errors if floored]
        rest = "error is" if len(names) == 1 else "errors are"
        owner = "its SD is" if len(names) == 1 else "their SDs are"
        found.append(
            f"the {enumerated(names)} {rest} too small to estimate; {owner} at the lower limit"
        )
    return found


def _other_than_given(result: Calibration) -> list[str]:
    """Given SDs that the residuals contradict, the tracker's included."""
    given, used = np.asarray(error_sd(result), float), np.asarray(result.mask) > 0
    if result.prior not in TUNED or result.sigma_tuned or result.data != "points":
        return []
    few = used.sum() < MINIMUM_SELF_TUNING
    if few and np.allclose(given, FALLBACK_SIGMA):
        return []  # they were not given
    squares = np.mean(np.asarray(result.residual, float)[used] ** 2, axis=0)[[0, 2, 1]]
    ratio = float(np.max(np.sqrt(squares) / given))
    # The fit of few images leaves little of their errors.
    if (0 if few else 1 / OTHER_THAN_GIVEN) <= ratio <= OTHER_THAN_GIVEN:
        return []
    small = "small" if ratio > 1 else "large"
    return [
        f"the residuals are {ratio:.3g} times the given SDs, so that covariance and predicted "
        f"errors are too {small}: are the SDs in mm?"
    ]


def _weak_elevation(result: Calibration) -> list[str]:
    """Translation along the elevational axis that only the offsets' law determines."""
    if result.prior not in TUNED or result.status != "converged":
        return []
    sd = float(np.sqrt(result.covariance[1, 1]))
    if not sd > WEAK_TRANSLATION_MM:
        return []
    law = result.offset_law
    on = rests_on(None if law is None else float(law.mean_probability))
    return [
        f"translation along the elevational axis is weakly determined (SD {sd:.2f} mm) and rests "
        f"on {on}"
    ]


def rests_on(mean_probability: float | None) -> str:
    """What decides where the images do not: the offsets' mean, in words.

    Args:
        mean_probability: that the offsets have another mean than zero; None if it is taken as zero.
    """
    if mean_probability is not None and mean_probability > 0.5:
        return "a mean of the offsets that the data hardly determine"
    return "the assumption that the target lay evenly on both sides of the image plane"


def _misfitting_images(result: Calibration) -> list[str]:
    """Images that were left out, or had better be."""
    named = outliers(result)
    if not named:
        return []
    listed = listed_outliers(result)
    if result.robust:
        count = len(named) + int(result.images_used)
        return [f"left out {len(named)} of {count} images that do not fit the rest: {listed}"]
    return [f"images that do not fit the rest: {listed}; a robust solve (--robust) leaves them out"]


def _bound_not_kept(result: Calibration) -> list[str]:
    """Whether the offsets exceed the bound that should have cut off their laws."""
    law, problem = result.offset_law, result.problem
    if law is None or bool(law.weighed) or problem is None or problem.max_elevation is None:
        return []
    # The problem's mask has the images that a robust solve left out.
    used = np.asarray(result.mask) > 0
    size = np.abs(np.asarray(result.elevation))
    beyond = used & (size > np.asarray(problem.max_elevation))
    if not beyond.any():
        return []
    return [
        f"the bound on the offsets was not kept: {beyond.sum()} of {used.sum()} images are farther "
        f"from the plane, up to {size[used].max():.2g} mm; is the bound too small, or not in mm?"
    ]


def _weak_direction(result: Calibration) -> list[str]:
    """A warning about the weakest direction if its SD is large, and what would help."""
    sight = observability(result)
    sd = sight["weakest_sd_mm"]
    if result.status != "converged" or not isinstance(sd, float) or sd <= WEAK_MM:
        return []
    only = ""
    if result.prior != "none" and abs(float(result.weakest @ result.prior_direction)) > _ALONG:
        only = ", known only from the assumed distribution of the offsets"
    return [
        f"weakly determined: {sight['weakest_direction']} (SD {sd:.1f} mm at the target{only}); "
        f"{sight['advice']}"
    ]


def _unusual_pixels(result: Calibration) -> list[str]:
    """A warning about estimated pixel sizes that hardly any image has, or a unit in doubt."""
    if result.doubtful_unit is not None:
        return [result.doubtful_unit]
    problem = result.problem
    if result.scale_mm_per_px is None or problem is None or problem.spacing_known:
        return []
    lateral, axial = (float(size) for size in np.asarray(result.scale_mm_per_px))
    if max(abs(lateral - 1), abs(axial - 1)) < _MILLIMETRE:
        return [
            f"pixels of {lateral:.3g} x {axial:.3g} mm are unusual for ultrasound: are u and v in "
            "mm, as on an image with a spacing? Then import them with --units mm"
        ]
    least, largest = USUAL_PIXEL_MM
    if least <= min(lateral, axial) and max(lateral, axial) <= largest:
        if max(lateral, axial) <= MOST_OBLONG * min(lateral, axial):
            return []
        return [
            f"pixels of {lateral:.3g} x {axial:.3g} mm are unusual for images that are shown: are "
            "they lines before scan conversion, or was the image stretched where u and v were read?"
        ]
    return [
        f"pixels of {lateral:.3g} x {axial:.3g} mm are unusual for ultrasound ({least:g} to "
        f"{largest:g} mm): are the poses' translations in mm?"
    ]


def _other_than_stated(result: Calibration) -> list[str]:
    """Pixels that come out larger, or smaller, than stated by the same share along both axes."""
    problem, size = result.problem, result.scale_mm_per_px
    if size is None or problem is None or not (problem.spacing_known and "scale" in result.blocks):
        return []
    axes = block_slice(result.blocks, "scale")
    sd = float(np.sqrt(result.unknowns_covariance[axes, axes].mean()))
    excess = np.log(np.asarray(size, float) / np.asarray(problem.spacing, float))
    share = too_short(-excess)
    if share is None or not abs(share) > max(UNLIKELY_STATED_SDS * sd, LEAST_MISSTATED):
        return []
    larger, long = ("smaller", "short") if share > 0 else ("larger", "long")
    off = abs(share) * float(np.linalg.norm(result.image_to_probe[:3, 3]))
    percent = f"{100 * abs(share):.1f} %"
    return [
        f"the pixels come out {percent} {larger} than stated: is the stated size wrong? If it is "
        f"right, tracked positions are too {long} by this share (check the tracker with a known "
        f"distance, and the size of its markers), and the image is off by about {off:.1f} mm"
    ]


def _far_from_probe(result: Calibration) -> list[str]:
    """A warning about poses whose origin no probe has, as of wrongly composed transforms."""
    if result.problem is None:
        return []
    positions = np.asarray(result.problem.poses)[np.asarray(result.mask) > 0, :3, 3]
    apart = float(np.median(np.linalg.norm(positions - np.asarray(result.point), axis=1)))
    if not apart > FARTHEST_MM:
        return []
    return [
        f"the target is {apart / 1000:.2g} m from the origin of the probe's frame: are the poses "
        "those of the probe's markers? With a tracked reference, a pose is the inverse pose of the "
        "reference, times that of the probe, in this order"
    ]


def _medium_warnings(result: Calibration) -> list[str]:
    """Warnings about a sound speed or a delay whose prior matters much, or that has none."""
    found, problem = [], result.problem
    assumed_speed = None if problem is None else float(problem.nominal_sound_speed)
    assumed_delay = 0.0 if problem is None or problem.delay is None else float(problem.delay)
    of = result.medium
    speed = of.sound_speed_m_s, of.sound_speed_sd_m_s, of.sound_speed_prior_m_s
    delay = of.delay_s, of.delay_sd_s, of.delay_prior_s
    for name, (value, sd, believed), nominal, unit in (
        ("sound speed", speed, assumed_speed, "m/s"),
        ("delay", delay, assumed_delay, "us"),
    ):
        if value is None or sd is None or nominal is None or not np.isfinite(sd):
            continue
        factor = 1e6 if unit == "us" else 1.0
        shown = f"{factor * float(value):.4g} +- {factor * float(sd):.2g} {unit}"
        if believed is not None and _pulled(float(value) - nominal, float(sd), float(believed)):
            found.append(
                f"the {name} ({shown}) is farther from the nominal {factor * nominal:.4g} {unit} "
                f"than its prior (SD {factor * float(believed):.2g} {unit}) expects, and the prior "
                "pulls it back: the true one may lie far beyond it. Take more images"
                + (", or estimate the scale instead" if name == "sound speed" else "")
            )
        elif believed is not None and float(sd) > WEAK_SHARE * float(believed):
            found.append(
                f"these data hardly determine the {name}: {shown} is little better than its prior "
                f"(SD {factor * float(believed):.2g} {unit})"
            )
        elif believed is None and name == "delay":
            found.append(
                f"the delay ({shown}) is nearly a shift of the transform along the axial axis: "
                "only times of flight tell the two apart"
            )
    return found


def _pulled(away: float, sd: float, prior_sd: float) -> bool:
    """Whether a prior that the data contradict moves an estimate by more than its SD.

    Args:
        away: the estimate's distance from the prior's mean.
        sd: of the estimate, the prior included.
        prior_sd: SD of the prior; all in one unit.
    """
    # If the prior is true, the estimate has this variance.
    variance = prior_sd**2 - sd**2
    if not variance > 0:
        return False
    # The likelihood alone has its maximum farther away by this.
    by = abs(away) * sd**2 / variance
    return abs(away) > UNLIKELY_SDS * math.sqrt(variance) and by > sd
