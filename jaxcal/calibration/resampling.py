"""Cross-validation and bootstrap: one problem is solved many times, as one batch.

Cross-validation masks images out and calibrates from the rest; the precision of Eq. 8 is then that
of images that the calibration has not used. Leaving out one image at a time also shows how much
each image moves the answer (its influence). The bootstrap draws the images anew with replacement
and shows how the answer scatters (reproducibility).

Both run :func:`jaxcal.calibrate_batch` on masks or rows of the same problem: pure functions of
arrays (and a key), which work under jit. Outside of it the rest is computed by numpy, since JAX
would compile it for every number of images, folds and resamples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxcal import InputError
from jaxcal.calibration.calibrate import Request, calibrate, calibrate_batch, prepare
from jaxcal.calibration.dependence import independent
from jaxcal.calibration.engine import as_jax_holds
from jaxcal.calibration.serial_correlation import widens
from jaxcal.data.problem import Problem, as_problem
from jaxcal.data.recording import MINIMUM_IMAGES, Images, Recording
from jaxcal.diagnostics.image_errors import noise_covariance
from jaxcal.diagnostics.intervals import range_of_row_zero
from jaxcal.diagnostics.metrics import distance_from_mean, reconstruct, rms_from_mean
from jaxcal.model.image_points import rms_distance, stretched
from jaxcal.model.thresholds import MAD
from jaxcal.model.unknowns import measured, split_further, unknown_names
from jaxcal.result.calibration import Calibration
from jaxcal.runtime import executables
from jaxcal.runtime.array_types import AnyArray
from jaxcal.runtime.arrays import array_module, each_image, is_traced, map_arrays
from jaxcal.runtime.given_values import LARGEST_SEED, check_key, check_made, whole_number
from jaxcal.runtime.jax_modes import in_own_modes
from jaxcal.runtime.messages import shown
from jaxcal.solvers import dense
from jaxcal.solvers.plan import SolvePlan

T = TypeVar("T")

LARGEST_RESAMPLES = 100_000
"""Most resamples of a bootstrap."""
MOST_FOLDS = 100
"""With more images than this, cross-validation holds out several at a time by default."""
MOST_TOGETHER = 200_000
"""Most images, over all calibrations, that are solved in one batch: about 1 GiB."""


class CrossValidation(eqx.Module):
    """Errors of images under calibrations that did not use them.

    Attributes:
        residual: (n, 3) lateral, range and elevational errors of each held-out image, mm; 0 where
            not used.
        cloud: (n, 3) the target as reconstructed from each held-out image (in the plane), less the
            target of the calibration that held the image out, mm.
        precision: norm of the SD of ``cloud`` (Eq. 8 for images that were not used), mm.
        rms: root mean square length of ``cloud``, mm.
        log_density: (n,) log predictive density of each image's three errors under the noise model
            of the calibration that held the image out: Gaussian, offsets about their mean, with the
            tracker's errors and, where that calibration weighs by them, the images' own
            covariances; 0 where not used.
        moved: (n, 6) [v, omega] by which leaving the image (its fold) out moves X, right
            perturbation, mm and rad.
        influence: (n,) length of ``moved`` in SDs of X: sqrt(moved' Cov^-1 moved / 6); NaN without
            a covariance.
        image_to_probe: (folds, 4, 4) X of each fold.
        converged: (folds,) whether the solve of each fold converged.
        fold_cost: (n,) minimised objective of the calibration that held the image out.
        mask: (n,) 1 for used images.
        image_moved: (n,) how far leaving the image (its fold) out moves ``image_points``, as a root
            mean square over these points, estimated pixel sizes, sound speed and delay included,
            mm.
        image_points: (m, 2) [lateral, axial] of those points, mm: corners and middle of the box
            that the measured points fill.
    """

    residual: Float[AnyArray, "n 3"]
    cloud: Float[AnyArray, "n 3"]
    precision: Float[AnyArray, ""]
    rms: Float[AnyArray, ""]
    log_density: Float[AnyArray, " n"]
    moved: Float[AnyArray, "n 6"]
    influence: Float[AnyArray, " n"]
    image_to_probe: Float[AnyArray, "folds 4 4"]
    converged: Bool[AnyArray, " folds"]
    fold_cost: Float[AnyArray, " n"]
    mask: Float[AnyArray, " n"]
    image_moved: Float[AnyArray, " n"]
    image_points: Float[AnyArray, "m 2"]


class Bootstrap(eqx.Module):
    """How the answer scatters when the images are drawn anew.

    Attributes:
        image_to_probe: (k, 4, 4) X of each resample.
        converged: (k,) whether the resample has at least four different images, as every
            calibration needs, and its solve converged; the following use only those.
        spread: (6,) robust scale of X about the X of all images, [v, omega], mm and rad: 1.4826
            times the median magnitude of each component of the moves. It is their SD where they are
            Gaussian and scatter about the X of all images; with heavier tails it is smaller than
            the SD, so a few resamples that hardly determine X do not spoil it. A move that most
            resamples share counts, too.
        reproducibility: (m,) mean distance of an image point from its mean over the resamples, mm,
            estimated pixel sizes, sound speed and delay included.
        rms_scatter: (m,) root mean square of the same distances, mm.
        image_points: (m, 2) [lateral, axial] of those points, mm: corners and middle of the box
            that the measured points fill.
    """

    image_to_probe: Float[AnyArray, "k 4 4"]
    converged: Bool[AnyArray, " k"]
    spread: Float[AnyArray, " 6"]
    reproducibility: Float[AnyArray, " m"]
    rms_scatter: Float[AnyArray, " m"]
    image_points: Float[AnyArray, "m 2"]


@in_own_modes
def cross_validate(
    problem: Problem | Recording | Images,
    *,
    folds: int | None = None,
    result: Calibration | None = None,
    **arguments: Any,
) -> CrossValidation:
    """Hold out each image (or fold of images) in turn, and calibrate from the others.

    Args:
        problem: one problem, a recording, or one set of images.
        folds: the images in use are dealt to so many folds in turn; by default every image is a
            fold of its own, up to :data:`MOST_FOLDS`. Inside a transformation,
            where it is not known which images are in use, all are dealt.
        result: the calibration of all images, if it exists already: by the same method, with the
            same prior, data and unknowns. Images that it left out as outliers are neither used nor
            held out.
        arguments: as for :func:`jaxcal.calibrate`.

    Returns:
        Errors of the held-out images, and how much each image moves X: a :class:`CrossValidation`.

    Raises:
        InputError: too few images, folds that are not from 2 to the number of images in use,
            options that contradict each other, or a result by another method than they ask for.
        CalibrationError: this process was forked from one in which JAX had started.
    """
    problem, plan, arguments = _one_problem(problem, arguments, "jaxcal.cross_validate")
    count = problem.images
    if folds is not None:
        folds = whole_number("folds", folds, 2, count)
    given, result = problem, _full_calibration(problem, result, plan, arguments)
    problem, xp = _used(problem, result)
    used = problem.mask > 0 if xp is np else np.ones(count, bool)
    several = int(used.sum())
    folds = min(several, MOST_FOLDS) if folds is None else whole_number("folds", folds, 2, several)
    # Images that are not in use belong to the fold of the one before them, and change nothing.
    fold = np.maximum(np.cumsum(used) - 1, 0) % folds
    rest = fold != np.arange(folds)[:, None]
    _check_remaining(problem.mask, rest)

    def without(some: Int[np.ndarray, " k"]) -> Problem:
        many = map_arrays(lambda leaf: xp.broadcast_to(leaf, (len(some), *leaf.shape)), problem)
        return _placed(replace(many, mask=problem.mask * rest[some]), given)

    fits = _in_batches(without, folds, count, arguments)
    compared = _compared if xp is np else jax.jit(_compared)
    return _placed(compared(problem, result, fits, fold), given)


def _compared(
    problem: Problem, result: Calibration, fits: Calibration, fold: Int[AnyArray, " n"]
) -> CrossValidation:
    """The calibrations of the folds against that of all images, and against the held-out images."""
    problem, result, fits, xp = _plain(problem, result, fits)
    # Arrays of all images for each image would need memory by the square of their number.
    few = replace(
        fits,
        mask=fits.mask[:, :1],
        elevation=fits.elevation[:, :1],
        problem=None,
        linearisation=replace(fits.linearisation, average_elevation_sd=None),
    )
    held = map_arrays(lambda leaf: leaf[fold], few)
    errors, cloud = _held_out_errors(held, problem)
    mask = problem.mask
    used = xp.sum(mask)
    mean = xp.sum(mask[:, None] * cloud, axis=0) / used
    whole = result.image_to_probe
    moved = mask[:, None] * relative_twist(whole, held.image_to_probe)
    points = _box_points(problem, result)
    image_moved = rms_distance(_from_full_image(held, result, problem), whole, points) * mask
    noise = noise_covariance(fits, problem)[fold, np.arange(len(fold))]
    return CrossValidation(
        residual=errors,
        cloud=cloud,
        precision=xp.asarray(xp.sqrt(xp.sum(mask[:, None] * (cloud - mean) ** 2) / (used - 1))),
        rms=xp.asarray(xp.sqrt(xp.sum(cloud**2) / used)),
        log_density=mask * _log_density(held, noise, errors),
        moved=moved,
        influence=_length_in_sds(moved, result.covariance),
        image_to_probe=fits.image_to_probe,
        converged=xp.asarray(fits.converged),
        fold_cost=held.convergence.cost,
        mask=mask,
        image_moved=image_moved,
        image_points=points,
    )


@in_own_modes
def bootstrap(
    problem: Problem | Recording | Images,
    resamples: int = 200,
    key: Key[Array, ""] | int = 0,
    *,
    result: Calibration | None = None,
    **arguments: Any,
) -> Bootstrap:
    """Calibrate samples of the used images that are drawn with replacement.

    Args:
        problem: one problem, a recording, or one set of images.
        resamples: how many draws.
        key: of the draws, or a seed; draw k is fold_in(key, k).
        result: the calibration of all images, if it exists already: by the same method, with the
            same prior, data and unknowns. Images that it left out as outliers are not drawn.
        arguments: as for :func:`jaxcal.calibrate`.

    Returns:
        X of every resample and its scatter: a :class:`Bootstrap`.

    Raises:
        InputError: fewer than 2 resamples or 5 images, options that contradict each other, or a
            result by another method than they ask for.
        CalibrationError: this process was forked from one in which JAX had started.
    """
    problem, plan, arguments = _one_problem(problem, arguments, "jaxcal.bootstrap")
    resamples = whole_number("resamples", resamples, 2, LARGEST_RESAMPLES)
    if isinstance(key, jax.Array):
        check_key("key", key)
        root = key
    else:
        root = jax.random.key(whole_number("key", key, 0, LARGEST_SEED))
    given, result = problem, _full_calibration(problem, result, plan, arguments)
    problem, xp = _used(problem, result)
    cumulative = xp.cumsum(problem.mask)
    if xp is np and cumulative[-1] <= MINIMUM_IMAGES:
        raise InputError(
            f"a bootstrap needs more than {MINIMUM_IMAGES} images: with {int(cumulative[-1])} the "
            "only draws that determine a calibration have all of them"
        )
    different = []

    def drawn(some: Int[np.ndarray, " k"]) -> Problem:
        uniform = _uniform(root, some, problem.images, problem.mask.dtype)
        # The first image at which the count of used images exceeds the draw is always a used one.
        chosen = xp.searchsorted(cumulative, xp.asarray(uniform) * cumulative[-1], side="right")
        rows = xp.minimum(chosen, problem.images - 1)
        in_order = xp.sort(xp.where(problem.mask > 0, rows, -1), axis=1)
        first = (in_order[:, 1:] != in_order[:, :-1]).sum(axis=1) + (in_order[:, 0] >= 0)
        different.append(first)
        # Each draw has as many images as were used, since the mask leaves out the other rows.
        mask = xp.broadcast_to(problem.mask, rows.shape)
        return _placed(_with_rows(problem, rows, mask), given)

    fits = _in_batches(drawn, resamples, problem.images, arguments)
    scatter = _scatter if xp is np else jax.jit(_scatter)
    enough = xp.concatenate(different) >= MINIMUM_IMAGES
    return _placed(scatter(problem, result, fits, enough), given)


@partial(jax.jit, static_argnums=(2, 3))
def _uniform(
    root: Key[Array, ""], resamples: Int[AnyArray, " k"], images: int, dtype: Any
) -> Float[Array, "k n"]:
    """Uniform random numbers, those of a resample from a key of its own."""
    return jax.vmap(
        lambda index: jax.random.uniform(jax.random.fold_in(root, index), (images,), dtype)
    )(resamples)


def _in_batches(
    make: Callable[[Int[np.ndarray, " k"]], Problem],
    count: int,
    images: int,
    arguments: dict[str, Any],
) -> Calibration:
    """Calibrations of ``count`` versions of a problem, without their data.

    ``make`` returns the versions of given numbers; each has as many ``images``.
    """
    # Outliers were found with all images.
    arguments = {**arguments, "robust": False}
    size, parts = max(MOST_TOGETHER // images, 1), []
    for start in range(0, count, size):
        some = np.arange(start, min(start + size, count))
        fits = calibrate_batch(make(some), **arguments)
        short = replace(fits.linearisation, average_elevation_sd=None)
        parts.append(replace(fits, problem=None, linearisation=short))
    if len(parts) == 1:
        return parts[0]
    xp = array_module(parts)
    return jax.tree.map(lambda *leaves: xp.concatenate(leaves), *parts)


def _scatter(
    problem: Problem, result: Calibration, fits: Calibration, enough: Bool[AnyArray, " k"]
) -> Bootstrap:
    """How the calibrations of the resamples scatter about that of all images.

    Args:
        problem: all images.
        result: their calibration.
        fits: those of the resamples.
        enough: whether a resample has as many different images as a calibration needs. With fewer
            it may fit perfectly far from the truth.
    """
    problem, result, fits, xp = _plain(problem, result, fits)
    converged = xp.asarray(fits.converged & enough)
    weight = converged.astype(problem.mask.dtype)
    whole, drawn = result.image_to_probe, fits.image_to_probe
    moved = xp.where(converged[:, None], xp.abs(relative_twist(whole, drawn)), xp.nan)
    # Where none converged, numpy would warn.
    unknown = xp is np and not converged.any()
    spread = moved[0] if unknown else xp.nanmedian(moved, axis=0)
    points = _box_points(problem, result)
    # A resample that did not converge may hold NaN, which a weight of zero does not remove.
    found = _from_full_image(fits, result, problem)
    transforms = xp.where(converged[:, None, None], found, whole)
    return Bootstrap(
        image_to_probe=drawn,
        converged=converged,
        spread=MAD * spread,
        reproducibility=distance_from_mean(transforms, points, weight),
        rms_scatter=rms_from_mean(transforms, points, weight),
        image_points=points,
    )


def relative_twist(
    first: Float[AnyArray, "4 4"], second: Float[AnyArray, "*k 4 4"]
) -> Float[AnyArray, "*k 6"]:
    """The step [v, omega] from the first transform to the second, mm and rad.

    It is the step of :func:`jaxcal.model.parameters.retract`, exact for v. The error of omega is of
    third order; a calibration moves by fractions of a degree, so it does not count.
    """
    xp = array_module(first, second)
    back = first[:3, :3].T
    rotation = back @ second[..., :3, :3]
    shift = (second[..., :3, 3] - first[:3, 3]) @ back.T
    turn = 0.5 * xp.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        axis=-1,
    )
    return xp.concatenate([shift, turn], axis=-1)


def _from_full_image(
    fits: Calibration, result: Calibration, problem: Problem
) -> Float[AnyArray, "k 4 4"]:
    """Transforms from the image of the full calibration, in that calibration's mm, to the probe.

    Another calibration has pixels of another size, another sound speed and another delay, and puts
    the same pixel at another place z' = a (z - o) + o' of its image, with o the range of row 0.
    """
    origin, speed = range_of_row_zero(replace(result, problem=problem))
    origins, speeds = range_of_row_zero(replace(fits, problem=problem))
    xp = array_module(speed, speeds)
    lateral, axial = xp.ones_like(speeds), speeds / speed
    if fits.scale_mm_per_px is not None and result.scale_mm_per_px is not None:
        ratio = fits.scale_mm_per_px / result.scale_mm_per_px
        lateral, axial = ratio[:, 0], axial * ratio[:, 1]
    return stretched(fits.image_to_probe, lateral, axial, origins - axial * origin)


def _full_calibration(
    problem: Problem, result: Calibration | None, plan: SolvePlan, arguments: dict[str, Any]
) -> Calibration:
    """The calibration of all images: the caller's, checked, or a new one."""
    if result is None:
        return calibrate(problem, **arguments)
    check_made("result", result, Calibration, "jaxcal.calibrate")
    if np.shape(result.mask) != (problem.images,):
        raise InputError(
            f"result must be the calibration of these {problem.images} images; its mask has shape "
            f"{np.shape(result.mask)}"
        )
    for name, own in (
        ("method", plan.method),
        ("prior", plan.reported_prior),
        ("data", "channels" if plan.channels else "points"),
        ("blocks", plan.blocks),
    ):
        given = getattr(result, name)
        if given != own:
            raise InputError(
                f"result has {name} {shown(given)}, and the arguments ask for {shown(own)}: give "
                "those that the result was made with, or no result"
            )
    return result


def _one_problem(
    problem: Problem | Recording | Images, arguments: dict[str, Any], name: str
) -> tuple[Problem, SolvePlan, dict[str, Any]]:
    """One problem with its bounds, how it is solved, and the arguments without the bounds.

    If its values are concrete, every pose counts once.
    """
    executables.refuse_after_fork()
    problem = as_problem(problem, name)
    if problem.batch_shape:
        raise InputError("resampling takes one problem at a time, not a batch")
    for argument in arguments.keys() - {field.name for field in fields(Request)}:
        raise TypeError(f"{name}() got an unexpected keyword argument {argument!r}")
    estimate = unknown_names(arguments.get("estimate", ()))
    problem, plan, _ = prepare(problem, Request(**{**arguments, "estimate": estimate}), name)
    arguments = {name: value for name, value in arguments.items() if name != "max_elevation"}
    if any(is_traced(leaf) for leaf in jax.tree.leaves(problem)):
        return problem, plan, arguments
    joined = independent(problem, estimate, widened=widens(plan.channels, plan.prior))[0]
    return as_jax_holds(joined, problem), plan, arguments


def _plain(*trees: Any) -> tuple[Any, ...]:
    """These in numpy's arrays, and numpy; as they are, and jax.numpy, if one is traced."""
    xp = array_module(*trees)
    if xp is np:
        trees = tuple(map_arrays(np.asarray, tree) for tree in trees)
    return (*trees, xp)


def _used(problem: Problem, result: Calibration) -> tuple[Problem, Any]:
    """The images that a calibration used, of :func:`_plain` arrays, and what to compute with."""
    problem, result, xp = _plain(problem, result)
    mask = xp.asarray(result.mask, problem.mask.dtype)
    return replace(problem.cleared(mask), mask=mask), xp


def _placed(tree: T, given: Problem) -> T:
    """The tree in JAX's arrays on the problem's device; as it is while traced."""
    return tree if is_traced(tree) else as_jax_holds(tree, given)


def _check_remaining(mask: AnyArray, rest: Bool[np.ndarray, "folds n"]) -> None:
    """Refuse folds without which too few images remain; ``rest`` is False in each fold."""
    if is_traced(mask):
        return
    least = int(np.min(np.sum(np.asarray(mask) * rest > 0, axis=1)))
    if least < MINIMUM_IMAGES:
        raise InputError(
            f"holding out a fold leaves {least} images: at least {MINIMUM_IMAGES} are needed"
        )


def _with_rows(problem: Problem, rows: AnyArray, mask: Float[AnyArray, "k n"]) -> Problem:
    """The problem with other rows of images in each of k copies."""
    xp = array_module(problem, rows)
    many = map_arrays(lambda leaf: xp.broadcast_to(leaf, (len(rows), *leaf.shape)), problem)
    each = np.arange(len(rows))[:, None]
    return replace(each_image(many, lambda values, axis: values[each, rows]), mask=mask)


def _points(problem: Problem, result: Calibration) -> tuple[AnyArray, AnyArray]:
    """Lateral position and range of every image by its calibration, or by one for all, mm."""
    scaled = problem.measurements * problem.spacing
    values = split_further(result.linearisation.further, result.blocks)
    return measured(scaled[:, 0], scaled[:, 1], problem.face_offset, values)


def _held_out_errors(
    held: Calibration, problem: Problem
) -> tuple[Float[AnyArray, "n 3"], Float[AnyArray, "n 3"]]:
    """Errors and reconstructed target of image i through calibration i, mm."""
    xp = array_module(held, problem)
    x, target = held.image_to_probe, held.point
    lateral, distance = _points(problem, held)
    turned, origin = problem.poses[:, :3, :3], problem.poses[:, :3, 3]

    def back(rotations: Any, vectors: Any) -> Any:
        return xp.einsum("nji,nj->ni", rotations, vectors)

    q = back(x[:, :3, :3], back(turned, target - origin) - x[:, :3, 3])
    far = xp.hypot(q[:, 1], q[:, 2])
    errors = xp.stack([q[:, 0] - lateral, far - distance, q[:, 1]], axis=1)
    in_plane = xp.stack([lateral, distance], axis=1)
    there = reconstruct(x, problem.poses, in_plane)
    return problem.mask[:, None] * errors, problem.mask[:, None] * (there - target)


def _log_density(
    held: Calibration, noise: Float[AnyArray, "n 3 3"], errors: Float[AnyArray, "n 3"]
) -> Float[AnyArray, " n"]:
    """Of the errors of image i under the noise model of calibration i, with that covariance."""
    xp = array_module(held, noise, errors)
    lateral, distance, offset = errors.T
    if held.offset_law is not None:
        offset = offset - held.offset_law.mean
    first = xp.sqrt(noise[:, 0, 0])
    mixed = noise[:, 1, 0] / first
    second = xp.sqrt(noise[:, 1, 1] - mixed * mixed)
    third = xp.sqrt(noise[:, 2, 2])
    one = lateral / first
    squares = one**2 + ((distance - mixed * one) / second) ** 2 + (offset / third) ** 2
    return -0.5 * squares - xp.log(first * second * third) - 1.5 * np.log(2 * np.pi)


def _length_in_sds(
    moved: Float[AnyArray, "n 6"], covariance: Float[AnyArray, "6 6"]
) -> Float[AnyArray, " n"]:
    """sqrt(m' C^-1 m / 6) of every move m of X with the covariance C."""
    xp = array_module(moved, covariance)
    scale = xp.sqrt(xp.diagonal(covariance))
    # In SDs of the unknowns the matrix is a correlation matrix, well scaled for elimination.
    unit, matrix = moved / scale, covariance / (scale[:, None] * scale)
    if xp is np:
        try:
            half = np.linalg.solve(np.linalg.cholesky(matrix), unit.T)
        except np.linalg.LinAlgError:
            half = np.full_like(unit.T, np.nan)
        return np.sqrt(np.sum(half**2, axis=0) / 6)
    solved = dense.solve_positive(matrix, unit.T)
    return xp.sqrt(xp.sum(unit.T * solved, axis=0) / 6)


def _box_points(problem: Problem, result: Calibration) -> Float[AnyArray, "5 2"]:
    """Corners and middle of the box that the used points fill, [lateral, axial], mm."""
    xp = array_module(problem, result)
    points = xp.stack(_points(problem, result), axis=1)
    seen = problem.mask[:, None] > 0
    low = xp.min(xp.where(seen, points, xp.inf), axis=0)
    high = xp.max(xp.where(seen, points, -xp.inf), axis=0)
    share = xp.asarray([[0, 0], [1, 0], [0, 1], [1, 1], [0.5, 0.5]], low.dtype)
    return (1 - share) * low + share * high
