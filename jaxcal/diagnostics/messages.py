"""Diagnostics in words: weak directions, outliers, and everything that is worth a warning.

All functions take one calibration, with concrete values.
"""

from __future__ import annotations

from statistics import NormalDist
from typing import TYPE_CHECKING, Protocol, TypedDict, runtime_checkable

import numpy as np

from jaxcal.diagnostics.offset_fit import contradicted
from jaxcal.diagnostics.residual_checks import FEWEST_TO_CHECK, MISFITS
from jaxcal.diagnostics.uncertainty import TUNED
from jaxcal.model.distributions import FAMILIES
from jaxcal.model.thresholds import MINIMUM_SELF_TUNING
from jaxcal.model.unknowns import TABLE, block_slice
from jaxcal.runtime.array_types import AnyArray

if TYPE_CHECKING:
    from jaxcal.calibration.result import Calibration


class OutlierReason(TypedDict):
    """Why an image is an outlier: its most deviant component, and by how many SDs (signed)."""

    image: int
    component: str
    sds: float | None
    left_out: bool


@runtime_checkable
class HasOutliers(Protocol):
    """A result whose images may be outliers."""

    @property
    def outlier(self) -> AnyArray:
        """(n,) 1 where an image is an outlier."""
        ...

    @property
    def departure(self) -> AnyArray:
        """(n, 3) errors of each image in SDs."""
        ...

    @property
    def mask(self) -> AnyArray:
        """(n,) 1 for used images."""
        ...


COMPONENTS = ("lateral", "range", "elevational")
SUSPECTED = 0.02
"""Half of this is the share of recordings with Gaussian errors in which chance alone makes an
image suspect."""
IMPLAUSIBLE_RMS_MM = 10.0
"""Residuals with a larger root mean square do not come from a target within the beam."""

USUAL_PIXEL_MM = (0.02, 1.0)
"""Estimated pixel sizes outside this interval lead to a warning."""

STEADY = 1e-3
"""If the scaled KKT residual of a stopped alternation is larger, there is a warning."""
WEAK_MM = 1.5
"""If the SD of the weakest direction (mm at the target) is larger, there is a warning."""
WORTH = 0.7
"""A kind of further image is advised if it tells at least this share of what the best one tells."""
MISFIT_SCORE = 3.3
"""A standard normal score beyond this contradicts the noise model. Where the model holds, one data
set in 170 has such a score among its nine."""
DRIFT_SCORE = 2.8
"""The same limit for correlation in time. Without such correlation, one data set in 45 has a score
beyond this, among three scores of successive images and three of the trend."""
LARGEST_OF_GROUPS = 1.5
"""Errors with a larger kurtosis are not called two groups."""
WEAK_TRANSLATION_MM = 0.3
WEAK_SHARE = 0.7
"""If the SD of sound speed or delay exceeds this share of its prior SD, the data added little."""


def direction_in_words(vector: AnyArray, blocks: tuple[str, ...]) -> str:
    """Name a direction of the unknowns.

    Args:
        vector: components in scaled units (mm at the lever arm), in the order of ``blocks``.
        blocks: the unknowns.
    """
    parts = {}
    for block in blocks:
        parts[block] = np.asarray(vector[block_slice(blocks, block)], dtype=float)
    size = {block: float(np.linalg.norm(part)) for block, part in parts.items()}
    total = float(np.linalg.norm(vector))
    if not np.isfinite(total) or total == 0:
        return "unknown"
    # X's own blocks are named first: to a reader the target's motion is a consequence of X's.
    leading = [block for block in blocks if size[block] > 0.35 * total]
    named = (
        [block for block in leading if block != "point"]
        or leading
        or [max(size, key=lambda block: size[block])]
    )
    words = [_block_in_words(block, parts[block]) for block in named]
    if "point" in leading and "point" not in named:
        words.append("the target moving along")
    return " with ".join([words[0], " and ".join(words[1:3])] if words[1:] else words)


def _block_in_words(block: str, part: np.ndarray) -> str:
    row, unit = TABLE[block], part / np.linalg.norm(part)
    largest = int(np.argmax(np.abs(unit)))
    if abs(unit[largest]) > 0.9:
        return row.words.format(row.axes[largest])
    # Rounded before it is formatted, and without the sign of a zero.
    unit = np.round(unit * np.sign(unit[largest]), 2) + 0.0
    return row.oblique.format(*unit)


def observability(result: Calibration) -> dict[str, float | str | None]:
    """The least known direction, and the direction known only from the prior, as plain values."""
    from_prior = None
    if np.any(result.prior_direction != 0):
        from_prior = direction_in_words(result.prior_direction, result.blocks)
    return {
        "condition": _finite(result.condition),
        "weakest_direction": direction_in_words(result.weakest, result.blocks),
        "weakest_sd_mm": _finite(result.weakest_sd),
        "known_only_from_prior": from_prior,
        "advice": poses_to_add(result),
    }


_FAMILY = {
    "uniform": "uniform between edges",
    "bell": "bell-shaped between edges",
    "gaussian": "Gaussian",
    "student": "heavy-tailed",
}


def offset_law(result: Calibration) -> dict[str, object] | None:
    """What the data say about the offsets' law and the noise, as plain values and in words."""
    law = result.offset_law
    if law is None:
        return None
    weighed = bool(law.weighed)
    probability = {
        family: float(value) for family, value in zip(FAMILIES, law.probability, strict=True)
    }
    own = float(law.own_probability)
    mean_probability = float(law.mean_probability)
    words, wrong = "The laws of the offsets could not be weighed; they are taken for Gaussian", None
    if weighed:
        wrong = _contradicted(result)
        words = _law_in_words(probability, wrong)
        if mean_probability > 0.5:
            words += f", about a mean of {float(law.mean):.2f} +- {float(law.mean_sd):.2f} mm"
        noise = "each image's own covariance" if own > 0.5 else "the same SDs in all images"
        words += f". The measurements' errors have {noise}"
    words += "."
    return {
        "weighed": weighed,
        "probability": probability if weighed else None,
        "contradicted": wrong,
        "mean_mm": float(law.mean),
        "mean_sd_mm": float(law.mean_sd),
        "mean_probability": mean_probability,
        "own_covariances_probability": own,
        "words": words,
    }


def _contradicted(result: Calibration) -> list[str]:
    """The laws that the estimated offsets do not follow; none are tested with few images."""
    offsets = np.asarray(result.elevation, dtype=float)[np.asarray(result.mask) > 0]
    if len(offsets) < FEWEST_TO_CHECK or not np.std(offsets) > 0:
        return []
    return [family for family, wrong in contradicted(offsets).items() if wrong]


def _law_in_words(probability: dict[str, float], wrong: list[str]) -> str:
    ranked = sorted(probability.items(), key=lambda item: -item[1])
    named = [(name, p) for name, p in ranked if p >= 0.1]
    told = " or ".join(f"{_FAMILY[name]} ({100 * p:.0f} %)" for name, p in named)
    if not wrong or any(name not in wrong for name, _ in named):
        return f"Of the laws that were compared, the data prefer offsets that are {told}"
    fitting = [words for name, words in _FAMILY.items() if name not in wrong]
    if not fitting:
        return f"None of the laws that were compared fits the offsets; the least bad is {told}"
    return (
        f"The estimate rests on offsets that are {told}, but as they turn out they look "
        f"{' or '.join(fitting)}"
    )


def poses_to_add(result: Calibration) -> str:
    """Which further images would tell most about the weakest direction, in words."""
    gain = np.nan_to_num(np.asarray(result.inspection.gain, dtype=float))
    if not gain.max() > 0:
        return "add images with the probe tilted about each of its axes"
    worth = gain >= WORTH * gain.max()
    tilts = [name for name, good in zip(TABLE["rotation"].axes, worth[:3], strict=True) if good]
    parts = []
    if tilts:
        listed = " and ".join([", ".join(tilts[:-1]), tilts[-1]] if tilts[1:] else tilts)
        plural = "axes" if tilts[1:] else "axis"
        parts.append(f"poses tilted by 20 to 30 degrees about the {listed} {plural}")
    if worth[3]:
        parts.append("images with the target nearer and farther")
    if worth[4]:
        parts.append("images with the target farther to both sides")
    return "add " + ", and ".join(parts)


def noise_model(result: Calibration) -> dict[str, object]:
    """How well the noise model fits the residuals: scores by name, kurtosis, and complaints."""
    scores = np.asarray(result.inspection.misfit, dtype=float)
    return {
        "checked": bool(int(result.images_used) >= FEWEST_TO_CHECK),
        "kurtosis": [_finite(value) for value in result.inspection.kurtosis],
        "scores": {
            name: [_finite(value) for value in row]
            for name, row in zip(MISFITS, scores, strict=True)
        },
        "complaints": misfits(result),
    }


def misfits(result: Calibration) -> list[str]:
    """Where the residuals contradict the noise model, in words; empty where they do not."""
    scores = np.asarray(result.inspection.misfit, dtype=float)
    kurtosis = np.asarray(result.inspection.kurtosis, dtype=float)
    found = []
    for k, name in enumerate(("lateral errors", "range errors", "elevational offsets")):
        tails, skewness, depth, _, _ = scores[:, k]
        if tails > MISFIT_SCORE:
            found.append(
                f"the {name} have heavier tails than the noise model's (kurtosis "
                f"{kurtosis[k]:.1f}, Gaussian 3)"
            )
        # Offsets may have edges of their own.
        if k < 2 and in_two_groups(tails, kurtosis[k]):
            found.append(
                f"the {name} come in two groups (kurtosis {kurtosis[k]:.1f}, Gaussian 3): two "
                "targets, or a second echo?"
            )
        if abs(skewness) > MISFIT_SCORE:
            found.append(f"the {name} lean to one side")
        if depth > MISFIT_SCORE:
            found.append(f"the {name} grow with depth; the noise model takes them for equal")
        found += _in_time(name, scores[:, k], int(result.images_used))
    return found


def in_two_groups(score: float | None, kurtosis: float | None) -> bool:
    """Whether errors of one kind lie in two groups, by the score of their tails and the kurtosis.

    Equal groups have a kurtosis of 1, those of 40 and 60 % 1.17, uniform errors 1.8.
    """
    if score is None or kurtosis is None:
        return False
    return bool(score < -MISFIT_SCORE and kurtosis < LARGEST_OF_GROUPS)


def _in_time(name: str, scores: AnyArray, count: int) -> list[str]:
    """How one kind of error changes during the recording."""
    drift, trend = (float(scores[MISFITS.index(kind)]) for kind in ("drift", "trend"))
    parts = []
    if drift > DRIFT_SCORE:
        parts.append(
            f"are alike in successive images (correlation {drift / (count - 1) ** 0.5:.2f})"
        )
    if abs(trend) > DRIFT_SCORE:
        correlation = np.tanh(trend / np.sqrt(count - 3))
        parts.append(f"drift in the course of the recording (correlation {correlation:.2f})")
    if not parts:
        return []
    return [f"the {name} {' and '.join(parts)}: latency, a slipping mount or a moving target?"]


def outliers(result: Calibration) -> list[int]:
    """Images that do not fit the rest (see :mod:`jaxcal.solvers.consensus`)."""
    return images_that_stand_out(result)


def images_that_stand_out(result: HasOutliers) -> list[int]:
    """Indices of the images marked as outliers."""
    return [int(image) for image in np.flatnonzero(np.asarray(result.outlier) > 0)]


def outlier_reasons(
    result: HasOutliers, components: tuple[str, ...] = COMPONENTS
) -> list[OutlierReason]:
    """For every outlier: its most deviant component, by how many SDs, and whether it was left out.

    The keys are ``image``, ``component`` (a name from ``components``), ``sds`` (signed) and
    ``left_out``.
    """
    departure = np.asarray(result.departure, dtype=float)
    found: list[OutlierReason] = []
    for image in images_that_stand_out(result):
        worst = int(np.argmax(np.abs(departure[image])))
        reason: OutlierReason = {
            "image": image,
            "component": components[worst],
            "sds": _finite(departure[image, worst]),
            "left_out": bool(np.asarray(result.mask)[image] == 0),
        }
        found.append(reason)
    return found


def suspects(result: Calibration) -> list[OutlierReason]:
    """Images in use that deviate by less than outliers do, but by more than chance explains.

    With Gaussian errors, the largest range error of all images (in SDs taken from medians) exceeds
    the limit in one recording of a hundred. Only range errors count: lateral errors grow with the
    depth and offsets may have any law, so large ones are no sign of a wrong image.
    """
    count = int(result.images_used)
    if count < FEWEST_TO_CHECK:
        return []
    # The second factor corrects medians of few images; it is from simulated Gaussian errors.
    limit = NormalDist().inv_cdf(1 - SUSPECTED / (4 * count)) * (1 + 8 / count)
    departure = np.asarray(result.departure, dtype=float)
    departure = np.where(np.asarray(result.mask)[:, None] > 0, departure, 0.0)
    departure[:, [0, 2]] = 0.0
    departure[images_that_stand_out(result)] = 0.0
    found: list[OutlierReason] = []
    for image in np.flatnonzero((np.abs(departure) > limit).any(axis=1)):
        found.append(
            {
                "image": int(image),
                "component": COMPONENTS[1],
                "sds": _finite(departure[image, 1]),
                "left_out": False,
            }
        )
    return found


def suspects_in_words(result: Calibration) -> list[str]:
    """The suspects in words; successive ones with errors of one kind and sign are joined."""
    runs: list[list[OutlierReason]] = []
    for each in suspects(result):
        last = runs[-1][-1] if runs else None
        alike = last is not None and each["component"] == last["component"]
        one_side = last is not None and (each["sds"] or 0) * (last["sds"] or 0) > 0
        if last is not None and alike and one_side and each["image"] == last["image"] + 1:
            runs[-1].append(each)
        else:
            runs.append([each])
    told = []
    for run in runs[:10]:
        sizes = sorted(abs(each["sds"] or 0) for each in run)
        first, last = run[0]["image"], run[-1]["image"]
        if first == last:
            told.append(f"{first} ({run[0]['component']} error, {sizes[0]:.1f} SDs)")
        else:
            told.append(
                f"{first} to {last} in a row ({run[0]['component']} errors to one side, "
                f"{sizes[0]:.1f} to {sizes[-1]:.1f} SDs)"
            )
    if not told:
        return []
    listed = ", ".join(told) + (", ..." if len(runs) > 10 else "")
    return [
        f"suspicious images, too far off for chance and not far enough to be left out: {listed}; "
        "look at them"
    ]


def listed_departures(result: HasOutliers, components: tuple[str, ...] = COMPONENTS) -> str:
    """The first ten outliers with component and SDs, in words."""
    reasons = outlier_reasons(result, components)
    told = [
        f"{reason['image']} ({reason['component']}, {abs(reason['sds'] or 0):.0f} SDs)"
        for reason in reasons[:10]
    ]
    return ", ".join(told) + (", ..." if len(reasons) > 10 else "")


def _bound_not_kept(result: Calibration) -> list[str]:
    """Whether the offsets exceed the bound that should have cut off their laws."""
    law, problem = result.offset_law, result.problem
    if law is None or bool(law.weighed) or problem is None or problem.max_elevation is None:
        return []
    used = np.asarray(problem.mask) > 0
    size = np.abs(np.asarray(result.elevation))
    beyond = used & (size > np.asarray(problem.max_elevation))
    if not beyond.any():
        return []
    return [
        f"the bound on the offsets was not kept: {beyond.sum()} of {used.sum()} images are farther "
        f"from the plane, up to {size[used].max():.2g} mm; is the bound too small, or not in mm?"
    ]


def warnings(result: Calibration) -> list[str]:
    """Everything that a person should know before using the answer, most important first."""
    found: list[str] = []
    status = result.status
    sight = observability(result)
    weakest, from_prior = sight["weakest_direction"], sight["known_only_from_prior"]
    bounded = result.prior == "bounded"
    resting = int(np.sum(result.at_bound > 0))
    used = int(result.images_used)
    if status == "failed":
        found.append("the solve failed: its result holds no usable numbers")
        return found
    if result.wrong_frames is not None:
        # The answer has no meaning, so no other warning is of use.
        return [result.wrong_frames]
    if status == "unobservable":
        found.append(f"not observable: these images do not determine {weakest}; {sight['advice']}")
    if status == "max_iterations":
        found.append(
            "not converged: the iteration limit was reached "
            f"(scaled KKT residual {float(result.stationarity):.1e})"
        )
    found += result.notes
    rms = float(result.rms)
    if rms > IMPLAUSIBLE_RMS_MM:
        found.append(
            f"residuals of {rms:.1f} mm are larger than a beam is thick: either some images are "
            "far off, or the poses are wrong (order or signs of their numbers, units, direction)"
        )
    found += _weak_direction(result)
    if bounded and from_prior:
        held = f"{resting} of {used} images rest on it"
        if resting == 0:
            held = "no image rests on it, so any value in an interval fits equally well"
        found.append(f"{from_prior} is fixed by nothing but the bound on the offsets: {held}")
    if result.searched_start:
        found.append(
            "the closed-form start was unusable (degenerate poses or points, or too few images for "
            "their noise); the start was searched for among 24 rotations"
        )
    if result.method == "alternating" and result.tolerance_met and result.stationarity > STEADY:
        found.append(
            "the alternation stopped on its tolerance while its objective was still falling "
            f"(scaled KKT residual {float(result.stationarity):.1e})"
        )
    found += _bound_not_kept(result)
    if result.prior in TUNED and not result.sigma_tuned:
        found.append(
            "noise SDs were held fixed, not estimated"
            + (
                f": {used} images are fewer than the {MINIMUM_SELF_TUNING} that it takes"
                if used < MINIMUM_SELF_TUNING
                else ""
            )
        )
    if np.any(result.sigma_floored):
        names = [
            name
            for name, floored in zip(
                ("lateral", "range", "elevational"), result.sigma_floored, strict=True
            )
            if floored
        ]
        found.append(
            f"the {' and '.join(names)} error is too small to estimate; its SD rests on its floor"
        )
    if result.prior in TUNED and status == "converged":
        sd = float(np.sqrt(result.covariance[1, 1]))
        if sd > WEAK_TRANSLATION_MM:
            law = result.offset_law
            on = "a mean of the offsets that the data hardly show"
            if law is None or not law.mean_probability > 0.5:
                on = "offsets that average zero"
            found.append(
                "translation along the elevational axis is weakly seen "
                f"(SD {sd:.2f} mm) and rests on {on}"
            )
    found += _medium_warnings(result)
    found += _unusual_pixels(result)
    if status == "converged":
        found += [f"noise model: {text}" for text in misfits(result)]
    if status == "converged":
        found += suspects_in_words(result)
    named = outliers(result)
    if named and result.robust:
        found.append(
            f"left out {len(named)} of {used + len(named)} images that do not fit the rest: "
            f"{listed_departures(result)}"
        )
    elif named:
        found.append(
            f"images that do not fit the rest: {listed_departures(result)}; a robust solve "
            "(--robust) leaves them out"
        )
    return found


def _weak_direction(result: Calibration) -> list[str]:
    """A warning about the weakest direction if its SD is large, and what would help."""
    sight = observability(result)
    sd = sight["weakest_sd_mm"]
    if result.status != "converged" or not isinstance(sd, float) or sd <= WEAK_MM:
        return []
    only = ""
    if result.prior != "none" and abs(float(result.weakest @ result.prior_direction)) > 0.7:
        only = ", known only from what is believed of the offsets"
    return [
        f"weakly determined: {sight['weakest_direction']} (SD {sd:.1f} mm at the target{only}); "
        f"{sight['advice']}"
    ]


def _unusual_pixels(result: Calibration) -> list[str]:
    """A warning about estimated pixel sizes that hardly any image has."""
    if result.scale_mm_per_px is None or "scale" not in result.blocks:
        return []
    lateral, axial = (float(size) for size in np.asarray(result.scale_mm_per_px))
    least, largest = USUAL_PIXEL_MM
    if least <= min(lateral, axial) and max(lateral, axial) <= largest:
        return []
    return [
        f"pixels of {lateral:.3g} x {axial:.3g} mm are unusual for ultrasound ({least:g} to "
        f"{largest:g} mm): are the poses' translations in mm?"
    ]


def _medium_warnings(result: Calibration) -> list[str]:
    """Warnings about a sound speed or a delay that the data hardly determine."""
    found = []
    speed = (result.sound_speed_m_s, result.sound_speed_sd_m_s, result.sound_speed_prior_m_s)
    delay = (result.delay_s, result.delay_sd_s, result.delay_prior_s)
    for name, (value, sd, believed), unit in (
        ("sound speed", speed, "m/s"),
        ("delay", delay, "us"),
    ):
        if value is None or sd is None or not np.isfinite(sd):
            continue
        factor = 1e6 if unit == "us" else 1.0
        shown = f"{factor * float(value):.4g} +- {factor * float(sd):.2g} {unit}"
        if believed is not None and float(sd) > WEAK_SHARE * float(believed):
            found.append(
                f"the {name} is hardly seen in these data: {shown} is little more than what was "
                f"believed before (SD {factor * float(believed):.2g} {unit})"
            )
        elif believed is None and name == "delay":
            found.append(
                f"the delay ({shown}) is nearly a shift of the transform along the axial axis: "
                "only times of flight tell the two apart"
            )
    return found


def _finite(value: AnyArray | float) -> float | None:
    number = float(value)
    return number if np.isfinite(number) else None
