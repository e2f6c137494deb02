"""Detect wrong frames or units: the data fit badly as given, and well once a mistake is corrected.

A calibration does not notice wrong conventions by itself: poses from tracker to probe, rotations by
columns instead of rows, or one axis with the other sign all give a converged answer, with residuals
of millimetres. So the conventional fit (Eq. 7) is repeated with each of the common mistakes
corrected. The fit is in closed form with both scales free, so it needs no start, no JAX and only a
few tenths of a millisecond. Where a corrected fit is far better, the mistake is reported.
Rotations that were built from angles in a wrong way are in :mod:`jaxcal.diagnostics.wrong_angles`.

*Far better* means two things. Both fits have n images, p unknowns and errors of unknown size. With
f the sum of squares as given and f' the corrected one, the likelihood ratio is
(f / f')^((3 n - p) / 2). It must exceed ``ODDS``, so that chance is ruled out although some fifty
corrections and two shifts by one row are tried. And f must exceed ``FACTOR`` times f', so that
imperfect but correct data are not reported. If the images fit badly, poses and points are also
shifted by up to half the recording, as where they were stamped by two clocks. That is up to six
hundred shifts at the same ``ODDS``, so for these f must exceed ``FARTHER`` times f'.

What no fit can detect: points that are mirrored (u or v counted from the other side), or swapped
where both axes have the same or an unknown scale. Eq. 7 knows the image's lateral and axial
directions only, and such points fit as well, with these directions reversed or exchanged: every
point of *these* images goes to its correct place in the tracker's frame. Poses in a left-handed
frame (both rotations and translations) also fit as well. The calibration is then wrong only for
images with another orientation than those that it was made with.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import quaternions_from_rotations, rotations_from_quaternions
from jaxcal.data.problem import Problem
from jaxcal.diagnostics.wrong_angles import with_other_angles
from jaxcal.runtime.array_types import Float
from jaxcal.solvers.closed_form.reduced_objective import (
    CONSTRAINTS,
    ImageData,
    ReducedObjective,
    image_data,
    reduce,
)
from jaxcal.solvers.closed_form.single import descend, feasible, scalar_root

ODDS = 1e6
"""How many times more probable the data must be with a mistake corrected."""

FACTOR = 4.0
"""How many times smaller the corrected sum of squares must be: 2 times in root mean square."""

UNKNOWNS = 11
"""Number of unknowns: X, target and two scales."""

MOST_IMAGES = 150
"""Longer recordings are checked on so many images, evenly spread."""

PIXELS_MM = (0.008, 3.0)
"""Smallest and largest credible size of a pixel: with poses in inches, 0.2 mm become 0.0079."""

STATED_TWICE = 2.0
"""A pixel size that is given and estimated as well must come out within this factor."""

TINY_PIXEL_MM = 0.0125
SMALL_PIXEL_MM, SMALL_ERROR_MM = 0.045, 0.1
"""The unit of the poses is in doubt where pixels are tiny, or small (with poses in cm, 0.45 mm
become 0.045) with smaller errors within the image than these. Small pixels belong to high
frequencies, but few trackers are so precise."""

NEAR_MARKER_MM, NEAR_TRACKER_MM = 40.0, 300.0
"""With poses in cm, a target 400 mm from the probe's markers or a probe 3 m from the tracker comes
out at these distances; hardly any is farther. Whatever comes out farther is in mm."""

LIKELY_PIXEL_MM = (0.02, 0.6)
"""Points in mm that are so many times as long as given may be pixels."""

LARGE_PIXEL_MM = 1.5
"""The unit is in doubt where pixels are larger. Points in mm that are read as pixels have 1 mm."""

SAME_SCALE = 1.25
"""With a mistake corrected, known scales must come out within this factor."""

FARTHER = 16.0
"""The same factor for lists that are several rows out of step: many shifts are tried, and in slow
motion some wrong one is near to the poses by chance."""

FEWEST_IN_STEP = 20
"""Fewest images that a shift by several rows must leave, besides half of them."""

EVERY_SHIFT = 200
"""Every shift by up to so many rows is tried, and half as many larger ones in geometric steps."""

UNFIT, UNFIT_MM = 0.5, 5.0
"""Images do not fit together if their median error exceeds both this share of the target's motion
and this length. Even a third of wrong images does not raise the median so far."""

TRIMMED_FITS = 3
"""Fits to the two thirds of the images with the least errors, which show whether few are wrong."""

WRONG_TIMES = 16.0
"""Few are wrong if their errors exceed the others' median by this factor, and ``UNFIT_MM``."""

UNITS = {1000.0: "metres", 100.0: "dm", 25.4: "inches", 10.0: "cm"}
"""Units that may be mistaken for mm; the keys are their lengths in mm."""

UNIT_WITHIN = 0.05
"""A scale factor is that of a unit if their logarithms differ by less than this."""

ANISOTROPY = 1.02
"""If the two spacings differ by a smaller factor, they do not show whether u and v are swapped."""


def wrong_frames(problem: Problem, estimate: tuple[str, ...] = ()) -> str | None:
    """What is wrong with the frames or units, and what to do, in one line; None if nothing is."""
    known = problem.spacing_known
    try:
        images, _ = image_data(problem, () if known else ("scale",))
    except InputError:
        return None
    images = replace(images, face_offset=0.0)
    given = _out_of_step(images, 0)
    count = len(given.points)
    if 3 * count <= UNKNOWNS:
        return None
    fit = _free_fit(given)
    if fit is None or fit.squares <= 0:
        return None
    before = fit.squares
    apart, extent = _typical_error(given, fit)
    unfit = _is_overdetermined(count) and _is_unfit(apart, extent)
    corrected = [(words, replace(given, **changed), FACTOR) for words, changed in _mistakes(given)]
    best, told, least = before, None, FACTOR
    for words, data, factor in chain(corrected, _steps(images, farther=apart > UNFIT_MM / 2)):
        other = _free_fit(data)
        if other is None:
            continue
        squares = other.squares * count / other.reduced.images
        if not (squares < best and _credible(other.scales, images, known)):
            continue
        # What leaves the images far apart corrects nothing: gross errors of some shrink as well.
        if not _is_unfit(*_typical_error(data, other)):
            best, told, least = squares, words, factor
    if not _far_better(before, best, count, least):
        told = None
    # Where a few images spoil the fit to all, a wrong correction may seem to be right.
    if (told or unfit) and (few := _few_wrong(given, fit, best)):
        return few
    if told is not None:
        return _sentence(told, before, best, count)
    if known and not {"scale", "sound-speed"} & set(estimate):
        told = _wrong_scale(given, fit)
        if told is not None:
            return told
    if unfit:
        return (
            f"the images do not fit together (typical error {_mm(apart)}, of a target that moves "
            f"by {_mm(extent)} in them): do poses and points belong together, with times of one "
            "clock, is it one target in all images, and in which frames and conventions are the "
            "poses?"
        )
    size = fit.scales * given.spacing
    if not known and not PIXELS_MM[0] <= size.max() <= PIXELS_MM[1]:
        return (
            f"the pixels come out as {_sizes(size)}: are the poses' translations in mm? (jaxcal "
            "import --pose-units states another unit)"
        )
    if known and "scale" in estimate and _another_unit(fit.scales) and _is_overdetermined(count):
        return (
            f"the pixels come out as {_sizes(size)}, but were said to have {_sizes(given.spacing)}:"
            " are the poses' translations in mm? (else correct the spacing, or leave it out)"
        )
    return None


def _few_wrong(data: ImageData, fit: _Fit, best: float) -> str | None:
    """What to do where a few images are so wrong that none fits; None where that is not so.

    ``best`` is the least sum of squares with a mistake corrected.
    """
    count = len(data.points)
    if not _is_overdetermined(least := count - count // 3):
        return None
    found, kept = fit, np.arange(count)
    for _ in range(TRIMMED_FITS):
        kept = np.argsort(_errors(data, found)[0])[:least]
        part = {name: getattr(data, name)[kept] for name in ("rotations", "translations", "points")}
        refit = _free_fit(replace(data, **part))
        if refit is None:
            return None
        found = refit
    errors = _errors(data, found)[0]
    rest = float(np.median(errors[kept]))
    wrong = int((errors > max(UNFIT_MM, WRONG_TIMES * rest)).sum())
    if rest > UNFIT_MM / 2 or not 0 < wrong <= count // 3 or best <= FACTOR * count * rest**2:
        return None
    return (
        f"{wrong} of {count} images that were compared {'do' if wrong > 1 else 'does'} not fit the "
        f"others, which fit each other (typical error {_mm(rest)}): a tool that was not seen, "
        "another target, or mirrored images? A robust solve (--robust) leaves such images out"
    )


def doubtful_unit(problem: Problem) -> str | None:
    """Why the poses may be in another unit than mm, and what to do, in one line; None if in mm.

    Where the size of pixels is unknown, poses in cm or inches fit as well as those in mm: the
    image, the probe and all errors only come out smaller. A small probe of high frequency is
    small as well, but its tracker is no better than others.
    """
    if problem.spacing_known:
        return None
    try:
        images, _ = image_data(problem, ("scale",))
    except InputError:
        return None
    given = _out_of_step(replace(images, face_offset=0.0), 0)
    count = len(given.points)
    fit = _free_fit(given) if _is_overdetermined(count) else None
    if fit is None:
        return None
    size = fit.scales * given.spacing
    state = (
        "state their unit (jaxcal import --pose-units) or, if it is mm, the size of a pixel "
        "(--spacing; the depth scale of the image shows it)"
    )
    if size.max() > LARGE_PIXEL_MM:
        return (
            f"the poses' translations may not be in mm: the pixels come out as {_sizes(size)}, "
            f"which hardly any image has; {state}"
        )
    pixel = np.sqrt(size.prod())
    if pixel > SMALL_PIXEL_MM:
        return None
    origin, target = fit.reduced.origin_and_target(fit.x)
    axes = fit.x.reshape(2, 3)
    seen = given.points @ axes + origin
    apart = np.einsum("nji,nj->ni", given.rotations, target - given.translations) - seen
    within = np.linalg.norm(apart @ (axes / fit.scales[:, None]).T, axis=1)
    # Of a circular normal distribution, in which this is the median distance.
    error = np.median(within) / np.sqrt(2 * np.log(2)) * np.sqrt(3 * count / (3 * count - UNKNOWNS))
    if (
        (error > SMALL_ERROR_MM and pixel > TINY_PIXEL_MM)
        or np.median(np.linalg.norm(seen, axis=1)) > NEAR_MARKER_MM
        or np.median(np.linalg.norm(given.translations, axis=1)) > NEAR_TRACKER_MM
    ):
        return None
    return (
        f"the poses' translations may be in cm or inches: the pixels come out as {_sizes(size)} "
        f"and the errors within the image as {error:.2g} mm, which few probes and trackers reach; "
        f"{state}"
    )


def _is_overdetermined(count: int) -> bool:
    """Whether so many images give more than twice as many equations as there are unknowns.

    Fewer are fitted so closely that the fit says little about them.
    """
    return 3 * count > 2 * UNKNOWNS


def _another_unit(scales: Float[np.ndarray, " 2"]) -> bool:
    """Whether both axes are too long, or both too short, by more than anybody misstates them."""
    return bool((scales > STATED_TWICE).all() or (scales < 1 / STATED_TWICE).all())


def _mm(length: float) -> str:
    """Two digits, without an exponent for long ones."""
    return f"{float(f'{length:.2g}'):g} mm"


def _sizes(size: Float[np.ndarray, " 2"]) -> str:
    return f"{size[0]:.3g} x {size[1]:.3g} mm"


@dataclass(frozen=True)
class _Fit:
    """The least-squares fit of Eq. 7 with both scales free.

    Attributes:
        reduced: its objective.
        x: its minimiser (a1, a3).
    """

    reduced: ReducedObjective
    x: Float[np.ndarray, " 6"]

    @property
    def squares(self) -> float:
        """Sum of squares, mm^2; less would only be rounding."""
        return max(float(self.reduced(self.x)), self.reduced.resolution)

    @property
    def scales(self) -> Float[np.ndarray, " 2"]:
        """Factors on the points' two axes."""
        return np.linalg.norm(self.x.reshape(2, 3), axis=1)


def _free_fit(data: ImageData) -> _Fit | None:
    reduced = reduce(data, CONSTRAINTS[("scale",)])
    found = scalar_root(reduced)
    return None if found is None or not np.isfinite(reduced(found[1])) else _Fit(reduced, found[1])


def _typical_error(data: ImageData, fit: _Fit) -> tuple[float, float]:
    """Median error of the images under a fit, and the target's motion in them, mm."""
    errors, extent = _errors(data, fit)
    return float(np.median(errors)), extent


def _is_unfit(apart: float, extent: float) -> bool:
    """Whether images with these errors do not fit together (:func:`_typical_error`)."""
    return apart > max(UNFIT_MM, UNFIT * extent)


def _errors(data: ImageData, fit: _Fit) -> tuple[Float[np.ndarray, " n"], float]:
    """Error of every image under a fit, and the target's motion in them, mm."""
    origin, target = fit.reduced.origin_and_target(fit.x)
    seen = data.points @ fit.x.reshape(2, 3)
    cloud = np.einsum("nij,nj->ni", data.rotations, seen + origin) + data.translations
    extent = float(np.sqrt(np.mean(np.sum((seen - seen.mean(axis=0)) ** 2, axis=1))))
    return np.linalg.norm(cloud - target, axis=1), extent


def _far_better(before: float, after: float, count: int, factor: float = FACTOR) -> bool:
    gained = 0.5 * (3 * count - UNKNOWNS) * np.log(before / after)
    return bool(before > factor * after and gained > np.log(ODDS))


def _credible(scales: Float[np.ndarray, " 2"], images: ImageData, known: bool) -> bool:
    """Whether the scales of a corrected fit could be those of the image."""
    if known:
        return bool((np.abs(np.log(scales)) < np.log(SAME_SCALE)).all())
    size = scales * images.spacing
    return bool((size > PIXELS_MM[0]).all() and (size < PIXELS_MM[1]).all())


def _mistakes(data: ImageData) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """The common mistakes: words, and the fields of the data that are corrected."""
    rotations, shifts = data.rotations, data.translations
    turned = np.swapaxes(rotations, 1, 2)
    back = -np.einsum("nij,nj->ni", turned, shifts)
    yield (
        "the poses are from the tracker to the probe: invert them, or import with --invert-poses",
        {"rotations": turned, "translations": back},
    )
    yield (
        "the poses' rotations are transposed (columns read as rows, or conjugate quaternions): "
        "transpose the 3x3 blocks",
        {"rotations": turned},
    )
    quaternions = quaternions_from_rotations(rotations)
    for words, right, order in (
        ("first but is read as last", "wxyz", [1, 2, 3, 0]),
        ("last but is read as first", "xyzw", [3, 0, 1, 2]),
    ):
        yield (
            f"the quaternions' scalar is {words}: correct the header if it names the columns, "
            f"otherwise import with --quaternion {right}",
            {"rotations": rotations_from_quaternions(quaternions[:, order], "xyzw")},
        )
    for axis, name in enumerate("xyz"):
        signs = np.where(np.arange(3) == axis, -1.0, 1.0)
        yield (
            # Rotations mirrored in the same axis fit as well: reversed translations would then make
            # the frame left-handed, which nothing shows any more.
            f"the poses' translations have the wrong sign along {name}, or their rotations turn "
            f"the wrong way about the other two axes (a left-handed frame, only partly converted?):"
            " correct the one that is wrong",
            {"translations": shifts * signs},
        )
    for order, name in (
        ([1, 0, 2], "x and y"),
        ([2, 1, 0], "x and z"),
        ([0, 2, 1], "y and z"),
        ([1, 2, 0], "x, y and z"),
        ([2, 0, 1], "x, y and z"),
    ):
        yield (
            f"the columns {name} of the poses' translations are exchanged: put them in order",
            {"translations": shifts[:, order]},
        )
    for words, corrected in with_other_angles(rotations):
        yield words, {"rotations": corrected}


def _steps(data: ImageData, farther: bool) -> Iterator[tuple[str, ImageData, float]]:
    """Poses and points out of step by one row, or ``farther``: words, data and factor."""
    count = len(data.points)
    if count <= 5:
        return
    most = max(1, min(count // 2, count - FEWEST_IN_STEP)) if farther else 1
    near = min(most, EVERY_SHIFT)
    shifts = np.r_[1 : near + 1, np.geomspace(near, most, EVERY_SHIFT // 2)].astype(int)
    for by in np.unique(shifts).tolist():
        for words, rows_after in (("before", -by), ("after", by)):
            told = (
                f"the pose of the row {words}: the two lists are one row out of step, or one lags"
                if by == 1
                else f"the pose about {by} rows {words}: are both stamped by one clock? (else "
                "import with --lag)"
            )
            factor = FACTOR if by == 1 else FARTHER
            yield f"each point belongs to {told}", _out_of_step(data, rows_after), factor


def _out_of_step(data: ImageData, by: int) -> ImageData:
    """Points with the poses ``by`` rows after them, as many as are checked."""
    rows = np.arange(max(0, -by), len(data.points) - max(0, by))
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, MOST_IMAGES).astype(int))]
    return replace(
        data,
        rotations=data.rotations[rows + by],
        translations=data.translations[rows + by],
        points=data.points[rows],
    )


def _wrong_scale(data: ImageData, fit: _Fit) -> str | None:
    """Words if the images fit far worse with the known scales than with free ones; else None."""
    scales, free, count = fit.scales, fit.squares, len(data.points)
    if (np.abs(np.log(scales)) < np.log(1.01)).all():
        return None
    reduced = reduce(data, CONSTRAINTS[()])
    before = float(reduced(descend(reduced, feasible(fit.x, reduced.constraints)[None])))
    if not _far_better(before, free, count):
        return None
    swapped = data.spacing[::-1] / data.spacing
    if np.abs(np.log(swapped)).max() > np.log(ANISOTROPY) and np.allclose(
        scales, swapped, rtol=0.3 * (np.abs(np.log(swapped)).max())
    ):
        return _sentence(
            "u and v, or their two spacings, are exchanged: swap them", before, free, count
        )
    points = "the pixels' sizes" if data.pixels else "the points"
    least, largest = LIKELY_PIXEL_MM
    in_pixels = ""
    if not data.pixels and least < scales.min() and scales.max() < largest:
        in_pixels = ' whether the points are pixels (kind="pixel" in Python, --units px at import)'
    for unit, name in UNITS.items():
        for factor, wrong, other in ((1 / unit, "the poses", points), (unit, points, "the poses")):
            if (np.abs(np.log(scales / factor)) < UNIT_WITHIN).all():
                told = f"{wrong} are in {name}, or {other} are {unit:g} times too large: give mm"
                told += in_pixels and f", and check{in_pixels}"
                in_mm = unit if factor < 1 else 1.0
                return _sentence(told, before, in_mm**2 * free, count)
    if not data.pixels:
        told = (
            f"the points are {scales[0]:.3g} and {scales[1]:.3g} times as long as given: check "
            "what gave them their mm (pixel size, sound speed, pitch of the elements)"
        ) + (in_pixels and f", or{in_pixels}")
    else:
        size = scales * data.spacing
        told = (
            f"the pixels are {size[0]:.4g} x {size[1]:.4g} mm, not {data.spacing[0]:.4g} x "
            f"{data.spacing[1]:.4g}: correct the spacing, or estimate the scale"
        )
    return _sentence(told, before, free, count)


def _sentence(words: str, before: float, after: float, count: int) -> str:
    worse, better = np.sqrt(before / count), np.sqrt(after / count)
    return (
        f"it looks as if {words} (root mean square error {_mm(worse)} as given, {_mm(better)} once "
        "corrected)"
    )
