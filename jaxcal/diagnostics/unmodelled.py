"""Would an error that the model leaves out explain the residuals better?

Ten are looked for with a few parameters theta, linearised at the answer:

    scale   the pixels' sizes or the sound speed: x and r are too long by a share of themselves
    lateral the same of x alone, where the sound speed is estimated: a wrong width of the pixels, or
            a curved array, in whose images a wrong sound speed stretches x as well
    slip    X moves within the image plane, steadily in the course of the recording (elevational
            offsets may drift for other reasons, and do not count)
    step    X moves so at once, between two images
    displaced  the target moves in the tracker's frame at once, between two images: it was touched,
            or the tracker or its reference was
    skew    the lateral position is too large by a share of the depth: a steered beam, or clicks
            beside the target
    curve   ranges are too long by the square of the lateral position: an image of a curved array
            taken for that of a straight one, or delays that are wrong towards the sides
    lag     images show what was earlier than their poses, of a probe in motion; where the probe's
            velocities are known. Offsets do not count here either: a hand that moves the target
            towards the image plane may stop too early every time
    speed   the sound speed, where every element's time of flight is fitted: all distances are too
            long by a share of themselves
    beside  the target lies beside the image plane by m in all images, so ranges are too long by
            m^2 / (2 r), which hardly any other error imitates; theta = m^2

With e the whitened errors, J their derivatives by the unknowns and K those by theta, the fit of
e + J d + K theta gives the likelihood ratio LR. The SDs of the three kinds of errors are tuned
again, as they were for the answer. 2 ln LR is the sum over the kinds of f ln(before / after), with
f the number of images less the kind's leverage in the fit. By Wilks it is chi squared if theta is
zero. It must exceed what chance exceeds once in a thousand recordings. That of a step, of X or of
the target, is the largest of all places where the step may be. Its limit was found by simulation:
Gaussian errors of equal size exceed 22 once in a thousand recordings, and errors that grow with
depth 26 as often as they exceed the limit of a slip. An answer within bounds is first moved to the
optimum of Gaussian offsets.

An eleventh, a distortion of the tracked positions, has a random field instead of few parameters
(:mod:`jaxcal.diagnostics.tracker_distortion`). Its limit is from simulations with errors that grow
with depth as well. Half of it must be exceeded without any neighbourhood, too: a few neighbours
with an error in common imitate a distortion. And without the elevational errors: offsets that
change slowly along a path move the answer, and then errors in the plane change with the pose. The
same holds for a step.
A twelfth, markers that are wrong from some sides, has a random field of the orientations and the
same limits. A thirteenth, a second target or a second origin of the images
(:mod:`jaxcal.diagnostics.second_target`), has a parameter for each image, which says which of the
two it has. It goes first if it is the clearest in spite of the n ln 2 that these choices cost.

All but the thirteenth must exceed their limits also if errors are alike in successive images, as
far as what is left of them shows it (:mod:`jaxcal.diagnostics.serial_errors`).

Where times of flight are fitted, the points that they say are looked at
(:mod:`jaxcal.diagnostics.channel_points`).

Reference: Wilks 1938.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from jaxcal.diagnostics import tracker_distortion
from jaxcal.diagnostics.change_point import change_point
from jaxcal.diagnostics.channel_points import as_points, excess_of_points
from jaxcal.diagnostics.gaussian_offsets import (
    GaussianOffsets,
    in_sds,
    leverage,
    shortened,
    tuned,
)
from jaxcal.diagnostics.image_errors import ImageErrors
from jaxcal.diagnostics.second_target import FEWEST as FEWEST_OF_TWO
from jaxcal.diagnostics.second_target import two_groups
from jaxcal.diagnostics.serial_errors import correlation, independent
from jaxcal.diagnostics.tracker_distortion import WITHIN, RandomField
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Bool, Float
from jaxcal.runtime.arrays import batch_of_one
from jaxcal.solvers.plan import TUNED

Array = np.ndarray

FEWEST = 10
"""With fewer images in use nothing is looked for."""

_OF_POINTS = ("scale", "lateral", "skew", "curve")
"""Errors of the measured points (:func:`_excess`); not looked for in times of flight."""
_BY_CHANCE = {
    "scale": 13.8,
    "lateral": 10.8,
    "slip": 16.3,
    "lag": 10.8,
    "step": 26.0,
    "displaced": 26.0,
    "skew": 10.8,
    "curve": 10.8,
    "speed": 10.8,
    "beside": 9.5,
    "distortion": 12.0,
    "marker": 12.0,
}
"""What 2 ln LR exceeds by chance in one of a thousand recordings: chi squared, for m^2, which is
never negative, that of two in a thousand, and for steps and random fields the limits of the
module's head."""
SMALLEST_FIELD_MM = 0.05
"""A smaller distortion, or motion on the probe, is not named: every tracker has one, and in data
without noise what the linearisation leaves out looks like one."""
_AT_ONCE = ("step", "displaced")
"""Errors that begin with one image; where is looked for."""
MOTIONS = {"slip", *_AT_ONCE}
"""Motions of the image on the probe, or of the target."""
_PLACES = 16
"""As so many places that are independent of one another count all at which a step may be."""
SIDE_MM = 20.0
"""The lateral position at which a curve is stated."""


@dataclass(frozen=True)
class Unmodelled:
    """An error that the model leaves out, and that the residuals show.

    Attributes:
        kind: ``scale``, ``lateral``, ``slip``, ``step``, ``displaced``, ``skew``, ``curve``,
            ``lag``, ``speed``, ``beside``, ``distortion``, ``marker``, ``targets`` or ``origins``.
        values: its parameters: by which shares lateral positions and ranges are too long; by which
            lateral positions alone; motion of X from the first image to the last (lateral and
            axial, mm; about y, rad); motion of the target in the tracker's frame, mm; by which
            share of the depth lateral positions are too large; by how many mm ranges are too long
            20 mm to the side; the lag of images behind poses in s; by which share all distances are
            too long; the distance m in mm; the root mean square distortion, or motion of the image
            on the probe, in mm; the distance between two targets in mm; by how much the points of
            ``images`` are off laterally and axially, mm.
        statistic: 2 ln LR.
        step: by how much the unknowns would change if it were corrected (from times of flight: X
            and the target alone); of a distortion or a marker, by one SD of each of its
            coefficients.
        image: the first one after a step of X or the target, or None.
        images: those of the second target or the second origin.
    """

    kind: str
    values: Float[Array, " k"]
    statistic: float
    step: Float[Array, " p *k"]
    image: int | None = None
    images: tuple[int, ...] = ()

    @property
    def tracker_share(self) -> float | None:
        """By which share tracked positions are too short, if that explains a scale as well."""
        return tracker_distortion.too_short(self.values) if self.kind == "scale" else None

    def moved(
        self, points: Float[Array, "m 2"], jacobian: Float[Array, "m 3 p"], answer: Calibration
    ) -> tuple[float, float]:
        """Root mean square motion of image points, mm: if it is corrected, and of a slip.

        Of a scale, the larger one of correcting the points or the tracked positions.

        Args:
            points: [lateral, axial], mm.
            jacobian: their derivatives by the unknowns.
            answer: the calibration, with its problem.
        """
        problem = answer.problem
        assert problem is not None
        by = jacobian[..., : len(self.step)] @ self.step
        if self.kind in _OF_POINTS:
            lateral, axial = points.T
            face = float(np.asarray(problem.face_offset))
            by -= (_excess(self.kind, lateral, axial, face) @ self.values)[:, [0, 2, 1]]
        if self.kind == "speed":
            assert problem.channels is not None
            excess = excess_of_points(points, np.asarray(problem.channels.elements))
            by[:, [0, 2]] -= self.values * excess
        if self.kind == "beside":
            by[:, 1] += self.values[0]
        slip = np.zeros_like(by)
        if self.kind in ("slip", "step"):
            slip = jacobian[..., WITHIN] @ self.values
            # At the end of the recording.
            by = by + 0.5 * slip
        corrected = [by]
        if self.tracker_share is not None:
            # Longer positions put the image farther from the probe's origin by the same share.
            transform = np.asarray(answer.image_to_probe)
            place = np.insert(points, 1, 0.0, axis=1) + transform[:3, 3] @ transform[:3, :3]
            corrected.append(by + self.tracker_share * place)
        size = [float(np.sqrt(np.sum(each**2) / len(points))) for each in (*corrected, slip)]
        return max(size[:-1]), size[-1]


def unmodelled(
    calibration: Calibration, velocity: Float[Array, "n 6"] | None = None
) -> list[Unmodelled]:
    """What the residuals of one calibration with concrete values show, the clearest first.

    Times of flight are looked at as the points that all elements of an image say; ``velocity`` is
    that of a recording's images.
    """
    if calibration.problem is None or np.sum(np.asarray(calibration.mask) > 0) < FEWEST:
        return []
    answer, speed = batch_of_one(calibration.numpy()), None
    if calibration.data == "channels":
        answer, seen, speed = as_points(answer)
        if "sound-speed" in calibration.blocks:
            speed = np.zeros_like(speed)
    elif calibration.prior in TUNED:
        seen = ImageErrors.of_answer(answer).centred(answer)
    else:
        # Offsets that are free within a bound absorb much of an error, above all a step; and
        # the conventional fit, which has none, weighs them like the other errors.
        seen = GaussianOffsets.of(answer).seen
    used = np.asarray(answer.mask)[0] > 0
    if used.sum() < FEWEST:
        return []
    candidates = _candidates(seen, used, speed)
    with np.errstate(all="ignore"):
        candidates += _steps(answer, seen, used)
        if velocity is not None:
            candidates += _lag(answer, seen, used, velocity)
        found = _explained(answer, seen, used, candidates) + _random_fields(answer, seen, used)
        found = _clearest_first(found)
        two = _two_groups(answer, seen, used)
    if two is None:
        return found
    after = two.statistic - 2 * np.log(2) * used.sum()
    first = all(after > each.statistic for each in found)
    return [two, *found] if first else [*found, two]


def _clearest_first(found: list[Unmodelled]) -> list[Unmodelled]:
    """In the order of how far they exceed their limits, but of motions the likelier first.

    A step has a higher limit, since some of its places fit by chance; that choice costs 2 ln of
    their number where a slip explains the same motion, too.
    """
    ordered = sorted(found, key=lambda each: -each.statistic / _BY_CHANCE[each.kind])
    cost = {"slip": 0.0, **dict.fromkeys(_AT_ONCE, 2 * math.log(_PLACES))}
    motions = [k for k, each in enumerate(ordered) if each.kind in MOTIONS]
    likelier = sorted((ordered[k] for k in motions), key=lambda e: cost[e.kind] - e.statistic)
    for k, each in zip(motions, likelier, strict=True):
        ordered[k] = each
    return ordered


class Candidate(NamedTuple):
    """An error of a few parameters theta that may have been left out.

    Attributes:
        kind: as in :class:`Unmodelled`.
        columns: derivatives by theta of every image's three errors, prediction less measurement.
        image: the first one after a step of X or the target.
    """

    kind: str
    columns: Float[Array, "n 3 k"]
    image: int | None = None


def _explained(
    answer: Calibration, seen: ImageErrors, used: Bool[Array, " n"], candidates: list[Candidate]
) -> list[Unmodelled]:
    """What the candidates explain of the residuals."""
    images, known = int(used.sum()), seen.rows.shape[-1]
    columns = [each.columns for each in candidates]
    errors, rows = _in_sds(answer, seen, used, columns)
    fewer, of_fewer = shortened(errors, rows)
    found: list[Unmodelled] = []
    at = known
    for each in candidates:
        after = at + each.columns.shape[-1]
        # The columns of the unknowns and its own.
        part = np.r_[:known, at:after]
        at = after
        fitted = _fit(each, fewer, of_fewer[..., part], known, images)
        if fitted is not None:
            rho = correlation(errors, rows[..., part], fitted[1], np.zeros(len(part)))
            if rho.any():
                apart = shortened(independent(errors, rho), independent(rows[..., part], rho))
                fitted = _fit(each, *apart, known, images)
        if fitted is not None:
            found.append(fitted[0])
    return found


def _candidates(
    seen: ImageErrors, used: Bool[Array, " n"], speed: Float[Array, "n 2"] | None
) -> list[Candidate]:
    """All that can be looked for without velocities or a place, in mm.

    Args:
        seen: the errors.
        used: the images that count.
        speed: by how much points are off if all distances of their elements are too long by their
            own size; zeros where the sound speed is estimated, None for calibrations from points.
    """
    distance = seen.distance[0]
    face = float(np.asarray(seen.problem.face_offset)[0])
    zero = np.zeros_like(distance)
    order = (np.cumsum(used) - 1) / (used.sum() - 1) - 0.5
    within = seen.in_plane(WITHIN)
    found = [
        Candidate("slip", order[:, None, None] * within),
        Candidate("beside", np.stack([zero, 0.5 / distance, zero], axis=-1)[..., None]),
    ]
    if speed is not None:
        looked_for: set[str] = set()
        if speed.any():
            found.append(Candidate("speed", np.stack([*speed.T, zero], axis=-1)[..., None]))
    else:
        # An estimated sound speed is the scale of the ranges, so that only the other one can be
        # wrong.
        lengths = {"lateral"} if "sound-speed" in seen.blocks else {"scale"}
        looked_for = {"skew", "curve"} | (set() if "scale" in seen.blocks else lengths)
    for kind in _OF_POINTS:
        if kind in looked_for:
            # A measurement without its excess is smaller; the prediction less it is larger.
            excess = _excess(kind, seen.lateral[0], distance, face)
            found.append(Candidate(kind, excess))
    counted = used[:, None, None]
    return [each._replace(columns=np.where(counted, each.columns, 0.0)) for each in found]


def _steps(answer: Calibration, seen: ImageErrors, used: Bool[Array, " n"]) -> list[Candidate]:
    """A step of X and one of the target, in mm, each at its clearest place."""
    moved = seen.in_plane(WITHIN), tracker_distortion.by_target(seen)
    images = np.flatnonzero(used)
    found: list[Candidate] = []
    for kind, columns in zip(_AT_ONCE, moved, strict=True):
        errors, rows = _in_sds(answer, seen, used, [columns])
        known, own = np.split(rows, [-columns.shape[-1]], axis=-1)
        before, _ = tuned(*shortened(errors, known), len(images))
        place = images[change_point(errors, known, own, before)]
        after = np.where(np.arange(len(used)) < place, -0.5, 0.5) * used
        found.append(Candidate(kind, after[:, None, None] * columns, int(place)))
    return found


def _lag(
    answer: Calibration, seen: ImageErrors, used: Bool[Array, " n"], velocity: Float[Array, "n 6"]
) -> list[Candidate]:
    """The lag of images behind their poses, s; none where the probe did not move.

    An image shows what was earlier by the lag, at the pose times Exp(-lag [v, omega]).
    """
    transform = np.asarray(answer.image_to_probe)[0]
    known = used & np.isfinite(velocity).all(axis=1)
    v, omega = np.hsplit(np.where(known[:, None], velocity, 0.0), 2)
    # Of the image, along and about its own axes.
    v = (v + np.cross(omega, transform[:3, 3])) @ transform[:3, :3]
    motion = np.hstack([v, omega @ transform[:3, :3]])
    if not motion.any():
        return []
    rows = seen.in_plane(slice(6))
    return [Candidate("lag", -np.einsum("nki,ni->nk", rows, motion)[..., None])]


def _excess(
    kind: str, lateral: Float[Array, " n"], distance: Float[Array, " n"], face_mm: float
) -> Float[Array, "n 3 k"]:
    """By how much an error makes points too large: lateral position, range, offset (0), mm.

    Args:
        kind: one of :data:`_OF_POINTS`; the last axis has its parameters, of which each is 1.
        lateral: mm.
        distance: range, mm.
        face_mm: range of pixel row 0.
    """
    zero = np.zeros_like(lateral)
    along = {
        "scale": [(lateral, zero, zero), (zero, distance - face_mm, zero)],
        "lateral": [(lateral, zero, zero)],
        "skew": [(distance, zero, zero)],
        "curve": [(zero, (lateral / SIDE_MM) ** 2, zero)],
    }
    return np.stack([np.stack(each, axis=-1) for each in along[kind]], axis=-1)


def _in_sds(
    answer: Calibration,
    seen: ImageErrors,
    used: Bool[Array, " n"],
    columns: list[Float[Array, "n 3 _"]],
) -> tuple[Float[Array, "m 3"], Float[Array, "m 3 q"]]:
    """Errors of the images in use, and their derivatives by the unknowns and by ``columns``.

    In SDs where the answer has them, else in mm; ``columns`` are of one recording's errors in mm.
    """
    rows = np.concatenate([seen.rows[0], *columns], axis=-1)[None]
    whitened = in_sds(answer, replace(seen, rows=rows))
    return whitened.errors[0][used], whitened.rows[0][used]


def _fit(
    tried: Candidate,
    errors: Float[Array, "m 3"],
    rows: Float[Array, "m 3 q"],
    known: int,
    images: int,
) -> tuple[Unmodelled, Float[Array, " 3"]] | None:
    """The parameters of the columns after the ``known`` unknowns, if the residuals show them.

    With the mean squared errors that they leave of each kind.
    """
    statistic, after, step = likelihood_ratio(errors, rows, known, images)
    limit = _BY_CHANCE[tried.kind]
    if not statistic > limit:
        return None
    if tried.kind in _AT_ONCE:
        in_plane, *_ = likelihood_ratio(errors[:, :2], rows[:, :2], known, images)
        if not in_plane > limit / 2:
            return None
    values, step = step[known:], step[:known]
    if tried.kind == "beside":
        if not values[0] > 0:
            return None
        values = np.sqrt(values)
    return Unmodelled(tried.kind, values, statistic, step, tried.image), after


def likelihood_ratio(
    errors: Float[Array, "m kinds"], rows: Float[Array, "m kinds q"], known: int, images: int
) -> tuple[float, Float[Array, " kinds"], Float[Array, " q"]]:
    """2 ln LR of the columns after the ``known`` unknowns, what they leave, and the step of all."""
    before, _ = tuned(errors, rows[..., :known], images)
    after, step = tuned(errors, rows, images)
    freedom = images - leverage(rows, after)
    return float(np.sum(freedom * np.log(before / after))), after, step


def _two_groups(
    answer: Calibration, seen: ImageErrors, used: Bool[Array, " n"]
) -> Unmodelled | None:
    """A second target or a second origin, the clearer one that the residuals of the images show."""
    if used.sum() < FEWEST_OF_TWO:
        return None
    within = np.broadcast_to(np.eye(3, 2), (len(used), 3, 2))
    found: list[Unmodelled] = []
    for kind, columns in (("targets", tracker_distortion.by_target(seen)), ("origins", within)):
        errors, rows = _in_sds(answer, seen, used, [columns])
        size = columns.shape[-1]
        before, _ = tuned(*shortened(errors, rows[..., :-size]), len(errors))
        two = two_groups(errors, rows, size, before)
        if two is not None:
            apart = np.array([np.linalg.norm(two.apart)]) if kind == "targets" else two.apart
            images = tuple(np.flatnonzero(used)[two.other].tolist())
            found.append(Unmodelled(kind, apart, two.statistic, two.step, images=images))
    return max(found, key=lambda each: each.statistic, default=None)


def _random_fields(
    answer: Calibration, seen: ImageErrors, used: Bool[Array, " n"]
) -> list[Unmodelled]:
    """A distortion of the tracked positions or wrong markers, if the images' residuals show it."""
    fields = {
        "distortion": RandomField.of_positions(seen, used),
        "marker": RandomField.of_orientations(seen, used),
    }
    start = float(np.mean(seen.errors[0][used][:, :2] ** 2))
    found: list[Unmodelled] = []
    for kind, field in fields.items():
        columns = field.columns()
        errors, rows = _in_sds(answer, seen, used, [columns])
        best = _fit_field(kind, field.places[used], errors, rows, start, columns.shape[-1])
        size = 0.0 if best is None else field.size(used, best.variance)
        if best is not None and size >= SMALLEST_FIELD_MM:
            step = np.sqrt(best.variance) * best.response
            found.append(Unmodelled(kind, np.array([size]), best.statistic, step))
    return found


def _fit_field(
    kind: str,
    places: Float[Array, "m 3"],
    errors: Float[Array, "m 3"],
    rows: Float[Array, "m 3 q"],
    start: float,
    coefficients: int,
) -> tracker_distortion.Distortion | None:
    """A random field of the places that the errors show.

    Also without any neighbourhood, and without the elevational errors.
    """
    limit = _BY_CHANCE[kind]
    found = tracker_distortion.fit(errors, rows, start, coefficients)
    if found is not None and found.statistic > limit:
        precision = np.zeros(rows.shape[-1])
        precision[-coefficients:] = 1 / found.variance
        rho = correlation(errors, rows, found.kinds, precision)
        if rho.any():
            errors, rows = independent(errors, rho), independent(rows, rho)
            found = tracker_distortion.fit(errors, rows, start, coefficients)
    if found is None or not found.statistic > limit:
        return None
    parts = [np.s_[:, :2], *(~near for near in tracker_distortion.neighbourhoods(places))]
    for part in parts:
        rest = tracker_distortion.statistic(errors[part], rows[part], start, coefficients)
        if not rest > limit / 2:
            return None
    return found
