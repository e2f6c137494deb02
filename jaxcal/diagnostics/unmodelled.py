"""Would an error that the model leaves out explain the residuals better?

Eight are looked for with a few parameters theta, linearised at the answer:

    scale   the pixels' sizes or the sound speed: x and r are too long by a share of themselves
    lateral the same of x alone, where the sound speed is estimated: a wrong width of the pixels, or
            a curved array, in whose images a wrong sound speed stretches x as well
    slip    X moves within the image plane, steadily in the course of the recording (elevational
            offsets may drift for other reasons, and do not count)
    step    X moves so at once, between two images
    skew    the lateral position is too large by a share of the depth: a steered beam, or clicks
            beside the target
    curve   ranges are too long by the square of the lateral position: an image of a curved array
            taken for that of a straight one, or delays that are wrong towards the sides
    lag     images show what was earlier than their poses, of a probe in motion; where the probe's
            velocities are known. Offsets do not count here either: a hand that moves the target
            towards the image plane may stop too early every time
    beside  the target lies beside the image plane by m in all images, so ranges are too long by
            m^2 / (2 r), which hardly any other error imitates; theta = m^2

With e the whitened errors, J their derivatives by the unknowns and K those by theta, the fit of
e + J d + K theta gives the likelihood ratio LR. The SDs of the three kinds of errors are tuned
again, as they were for the answer: 2 ln LR is the sum over the kinds of f ln(before / after), with
f the kind's degrees of freedom after the fit. By Wilks it is chi squared if theta is zero. It must
exceed what chance exceeds once in a thousand recordings. That of a step is the largest of all
places where the step may be. Its limit was found by simulation: Gaussian errors of equal size
exceed 22 once in a thousand recordings, and errors that grow with depth 26 as often as they exceed
the limit of a slip. An answer within bounds is first moved to the optimum of Gaussian offsets.

A ninth, a distortion of the tracked positions, has a random field instead of few parameters
(:mod:`jaxcal.diagnostics.tracker_distortion`). Its limit is from simulations with errors that grow
with depth as well. Half of it must be exceeded without any neighbourhood, too: a few neighbours
with an error in common imitate a distortion. A tenth, a second target
or a second origin of the images (:mod:`jaxcal.diagnostics.second_target`), has a parameter for each
image, which says which of the two it has. It goes first if it is the clearest in spite of the
n ln 2 that these choices cost.

References: Wilks 1938; Andrews 1993 (a change at an unknown place).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaxcal.diagnostics import tracker_distortion
from jaxcal.diagnostics.gaussian_offsets import GaussianOffsets, in_sds, shortened, tuned
from jaxcal.diagnostics.image_errors import ImageErrors
from jaxcal.diagnostics.second_target import FEWEST as FEWEST_OF_TWO
from jaxcal.diagnostics.second_target import two_groups
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Bool, Float
from jaxcal.runtime.arrays import batch_of_one
from jaxcal.solvers.plan import TUNED

Array = np.ndarray

FEWEST = 12
"""With fewer images in use nothing is looked for."""
_FEWEST_CONVENTIONAL = 15
"""The same for conventional fits: of 300 clean ones of 12 images, 9 would be reported."""

_OF_POINTS = ("scale", "lateral", "skew", "curve")
"""Errors of the measured points (:func:`_excess`); the others are of the poses or the target."""
_BY_CHANCE = {
    "scale": 13.8,
    "lateral": 10.8,
    "slip": 16.3,
    "lag": 10.8,
    "step": 26.0,
    "skew": 10.8,
    "curve": 10.8,
    "beside": 9.5,
    "distortion": 12.0,
}
"""What 2 ln LR exceeds by chance in one of a thousand recordings: chi squared, for m^2, which is
never negative, that of two in a thousand, and for a step and a distortion the limits of the
module's head."""
_MOST_STEPS = 16
"""Most places at which a step is tried, evenly spread."""
_BESIDE_STEP = 3
"""Least number of images before and after a step."""
SIDE_MM = 20.0
"""The lateral position at which a curve is stated."""
_WITHIN = (0, 2, 4)
"""Parameters of X that move the image within its plane: laterally, axially, and about y."""


@dataclass(frozen=True)
class Unmodelled:
    """An error that the model leaves out, and that the residuals show.

    Attributes:
        kind: ``scale``, ``lateral``, ``slip``, ``step``, ``skew``, ``curve``, ``lag``, ``beside``,
            ``distortion``, ``targets`` or ``origins``.
        values: its parameters: by which shares lateral positions and ranges are too long; by which
            lateral positions alone; motion of X from the first image to the last (lateral and
            axial, mm; about y, rad); by which share of the depth lateral positions are too large;
            by how many mm ranges are too long 20 mm to the side; the lag of images behind poses in
            s; the distance m in mm; the root mean square distortion in mm; the distance between
            two targets in mm; by how much the points of ``images`` are off laterally and axially,
            mm.
        statistic: 2 ln LR.
        step: by how much the unknowns would change if it were corrected; of a distortion, by one SD
            of each of its coefficients.
        image: the first one after a step, or None.
        images: those of the second target or the second origin.
    """

    kind: str
    values: Float[Array, " k"]
    statistic: float
    step: Float[Array, " p *k"]
    image: int | None = None
    images: tuple[int, ...] = ()

    def moved(
        self, points: Float[Array, "m 2"], jacobian: Float[Array, "m 3 p"], face_mm: float
    ) -> tuple[float, float]:
        """Root mean square motion of image points, mm: if it is corrected, and of a slip.

        Args:
            points: [lateral, axial], mm.
            jacobian: their derivatives by the unknowns.
            face_mm: range of pixel row 0.
        """
        by = jacobian @ self.step
        if self.kind in _OF_POINTS:
            lateral, axial = points.T
            by -= (_excess(self.kind, lateral, axial, face_mm) @ self.values)[:, [0, 2, 1]]
        if self.kind == "beside":
            by[:, 1] += self.values[0]
        slip = np.zeros_like(by)
        if self.kind in ("slip", "step"):
            slip = jacobian[..., _WITHIN] @ self.values
            # At the end of the recording.
            by = by + 0.5 * slip
        size = [float(np.sqrt(np.sum(each**2) / len(points))) for each in (by, slip)]
        return size[0], size[1]


def unmodelled(
    calibration: Calibration, velocity: Float[Array, "n 6"] | None = None
) -> list[Unmodelled]:
    """What the residuals of one calibration with concrete values show, the clearest first.

    Only fits of points are looked at; ``velocity`` is that of a recording's images.
    """
    used = np.asarray(calibration.mask) > 0
    fewest = _FEWEST_CONVENTIONAL if calibration.method == "conventional" else FEWEST
    points = calibration.data == "points"
    if calibration.problem is None or not points or used.sum() < fewest:
        return []
    answer = batch_of_one(calibration.numpy())
    if calibration.prior in TUNED:
        seen = ImageErrors.of_answer(answer).centred(answer)
    else:
        # Offsets that are free within a bound absorb much of an error, above all a step; and
        # the conventional fit, which has none, weighs them like the other errors.
        seen = GaussianOffsets.of(answer).seen
    images, known = int(used.sum()), seen.rows.shape[-1]
    columns = _columns(seen, used)
    if velocity is not None:
        columns += _lag(answer, seen, used, velocity)
    with np.errstate(all="ignore"):
        errors, rows = shortened(*_in_sds(answer, seen, used, [each for _, _, each in columns]))
        before, _ = tuned(errors, rows[..., :known], images)
        tried, at = [], known
        for kind, image, own in columns:
            after = at + own.shape[-1]
            tried.append((kind, image, rows[..., np.r_[:known, at:after]]))
            at = after
        steps = [each for each in tried if each[0] == "step"]
        gains = _gains(errors, np.stack([part for _, _, part in steps]), before)
        tried = [each for each in tried if each[0] != "step"] + [steps[int(np.argmax(gains))]]
        fits = [
            (image, _fit(kind, errors, part, known, before, images)) for kind, image, part in tried
        ]
        found = [replace(each, image=image) for image, each in fits if each is not None]
        found += _distortion(answer, seen, used)
        found.sort(key=lambda each: -each.statistic / _BY_CHANCE[each.kind])
        two = _two_groups(answer, seen, used)
    if two is None:
        return found
    after = two.statistic - 2 * np.log(2) * used.sum()
    first = all(after > each.statistic for each in found)
    return [two, *found] if first else [*found, two]


def _columns(
    seen: ImageErrors, used: Bool[Array, " n"]
) -> list[tuple[str, int | None, Float[Array, "n 3 k"]]]:
    """Derivatives of every image's three errors (prediction less measurement) by theta.

    With each kind, and the first image after a step.
    """
    distance = seen.distance[0]
    face = float(np.asarray(seen.problem.face_offset)[0])
    zero = np.zeros_like(distance)
    order = (np.cumsum(used) - 1) / (used.sum() - 1) - 0.5
    within = seen.rows[0][..., _WITHIN] * [[1.0], [1.0], [0.0]]
    found: list[tuple[str, int | None, Array]] = [
        ("slip", None, order[:, None, None] * within),
        ("beside", None, np.stack([zero, 0.5 / distance, zero], axis=-1)[..., None]),
    ]
    # An estimated sound speed is the scale of the ranges, so that only the other one can be wrong.
    lengths = {"lateral"} if "sound-speed" in seen.blocks else {"scale"}
    looked_for = {"skew", "curve"} | (set() if "scale" in seen.blocks else lengths)
    for kind in _OF_POINTS:
        if kind in looked_for:
            # A measurement without its excess is smaller; the prediction less it is larger.
            found.append((kind, None, _excess(kind, seen.lateral[0], distance, face)))
    images = np.flatnonzero(used)
    places = np.linspace(_BESIDE_STEP, len(images) - _BESIDE_STEP, _MOST_STEPS)
    for image in images[np.unique(np.round(places).astype(int))]:
        after = np.where(np.arange(len(used)) < image, -0.5, 0.5)
        found.append(("step", int(image), after[:, None, None] * within))
    return [(kind, image, np.where(used[:, None, None], each, 0.0)) for kind, image, each in found]


def _lag(
    answer: Calibration, seen: ImageErrors, used: Bool[Array, " n"], velocity: Float[Array, "n 6"]
) -> list[tuple[str, int | None, Float[Array, "n 3 1"]]]:
    """The same by the lag of images behind their poses, s, where the probe moved.

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
    rows = seen.rows[0][..., :6] * [[1.0], [1.0], [0.0]]
    return [("lag", None, -np.einsum("nki,ni->nk", rows, motion)[..., None])]


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


def _gains(
    errors: Float[Array, "m 3"], rows: Float[Array, "s m 3 q"], variance: Float[Array, " 3"]
) -> Float[Array, " s"]:
    """By how much each set of rows lowers the sum of squares, with the SDs as they are."""
    weight = 1 / np.sqrt(variance)[:, None]
    design = (rows * weight).reshape(len(rows), -1, rows.shape[-1])
    scale = np.sqrt(np.maximum(np.sum(design**2, axis=1, keepdims=True), 1e-300))
    basis = np.linalg.qr(design / scale)[0]
    return np.sum((np.swapaxes(basis, 1, 2) @ (errors * weight[:, 0]).ravel()) ** 2, axis=1)


def _fit(
    kind: str,
    errors: Float[Array, "m 3"],
    rows: Float[Array, "m 3 q"],
    known: int,
    before: Float[Array, " 3"],
    images: int,
) -> Unmodelled | None:
    """The parameters of the columns after the ``known`` unknowns, if the residuals show them.

    ``before`` are the mean squared errors of each kind without them.
    """
    after, step = tuned(errors, rows, images)
    # Every kind gives a third of the unknowns' degrees of freedom, and its part of theta's.
    touched = np.any(rows[..., known:] != 0, axis=(0, 2))
    further = rows.shape[-1] - known
    freedom = images - known / 3 - touched * (further / touched.sum())
    statistic = float(np.sum(freedom * np.log(before / after)))
    if not statistic > _BY_CHANCE[kind]:
        return None
    values, step = step[known:], step[:known]
    if kind == "beside":
        if not values[0] > 0:
            return None
        values = np.sqrt(values)
    return Unmodelled(kind, values, statistic, step)


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


def _distortion(
    answer: Calibration, seen: ImageErrors, used: Bool[Array, " n"]
) -> list[Unmodelled]:
    """A distortion of the tracked positions, if the residuals of the images show it."""
    positions = np.asarray(seen.problem.poses)[0, :, :3, 3]
    errors, rows = _in_sds(answer, seen, used, [tracker_distortion.columns(seen, used)])
    start = float(np.mean(seen.errors[0][used][:, :2] ** 2))
    found = tracker_distortion.fit(errors, rows, start)
    if found is None or not found.statistic > _BY_CHANCE["distortion"]:
        return []
    for near in tracker_distortion.neighbourhoods(positions[used]):
        rest = tracker_distortion.fit(errors[~near], rows[~near], start)
        if rest is None or not rest.statistic > _BY_CHANCE["distortion"] / 2:
            return []
    size = tracker_distortion.size(positions, used, found.variance)
    step = np.sqrt(found.variance) * found.response
    return [Unmodelled("distortion", np.array([size]), found.statistic, step)]
