"""How certain an answer is, and which directions the data do not determine.

The information S of the shared unknowns (:class:`jaxcal.result.calibration.Linearisation`) tells
how well each direction is known: eigenvectors with small eigenvalues are directions that the images
barely determine. To compare mm with rad and log units, rotations, scales and sound speed are
multiplied by the lever arm, the root mean square distance of the measured points from the image
origin. All unknowns are then mm at the target.

An image may have an offset unknown of its own (bounded offsets, or a given tracker SD), which was
eliminated from S. Let k_i be the derivative of image i's residuals by this unknown, J_i that by the
shared unknowns, D_i = k_i'k_i and E_i = J_i'k_i. A function with the derivatives a by the shared
unknowns and b by the offset unknown has the variance

    (a - b E_i / D_i)' S^-1 (a - b E_i / D_i) + b^2 / D_i.

The conventional fit weighs lateral, elevational and axial errors equally, but offsets are usually
larger than the errors of the points. With S = sum S_k, the sum of the axes' normal matrices, and
variances v_k of the axes' errors, its unknowns have the covariance S^-1 (sum v_k S_k) S^-1
(:func:`covariance_by_axis`).

Reference: White 1980 (covariance of a fit whose weights are not those of its errors).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxcal.diagnostics.image_errors import ImageErrors, Whitened, quadratic
from jaxcal.model.arc import OnArc
from jaxcal.model.unknowns import TABLE, Blocks, block_slice, count_unknowns
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import AnyArray, Bool, Float
from jaxcal.runtime.arrays import array_module
from jaxcal.solvers.plan import DEFAULT_MAX_ELEVATION_MM, TUNED

Array = np.ndarray

SINGULAR_DESIGN = 1e-11
"""Smallest eigenvalue over the trace of the unweighted design below which poses are degenerate."""

LARGEST_SD = 0.5
"""A direction whose SD exceeds this fraction of the lever arm is not known in any useful sense."""

POOLED_SHARE = 0.5
"""How many errors of the pooled variance count with each axis's own. With four or five images an
axis may have hardly any degree of freedom left, and then has the pooled variance."""


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of a batch of calibrations (one leading axis, k).

    Attributes:
        elevation_sd: mm; NaN where an offset rests on its bound or an image is left out.
        at_bound: 1 where an offset rests on its bound.
        spectra: of the information and the design in scaled units.
        prior_direction: unit vector that the measurements alone leave open; zeros if there is none.
        scale: factors that turn every unknown's tangent into mm at the target.
    """

    elevation_sd: Float[Array, "k n"]
    at_bound: Float[Array, "k n"]
    spectra: Spectra
    prior_direction: Float[Array, "k p"]
    scale: Float[Array, "k p"]


def assess(answer: Calibration, seen: ImageErrors, eps: float) -> Uncertainty:
    """Uncertainty of calibrations with one leading axis.

    Args:
        answer: the calibrations, arrays in float64.
        seen: their images.
        eps: relative rounding of the arithmetic that solved them.
    """
    blocks, kept = answer.blocks, np.asarray(answer.mask)
    linearisation = answer.linearisation
    information = np.asarray(linearisation.information)
    variance = np.asarray(linearisation.variance)
    scale = mm_at_target(seen.lever(kept), blocks)
    both = scale[:, :, None] * scale[:, None]
    design = np.asarray(linearisation.design)
    whitened = answer.prior in TUNED
    found = Spectra.of(information / both, design / both, variance, eps, whitened=whitened)
    size = np.where(np.isnan(found.weakest_sd), np.nan, variance)
    at_bound, elevation_sd = _offsets(answer, seen, inverses(information, eps), size)
    if linearisation.average_elevation_sd is not None:
        assert answer.offset_law is not None
        better = np.asarray(answer.offset_law.weighed)[:, None] & np.isfinite(elevation_sd)
        elevation_sd = np.where(better, linearisation.average_elevation_sd, elevation_sd)
    return Uncertainty(
        elevation_sd=elevation_sd,
        at_bound=at_bound,
        spectra=found,
        prior_direction=_known_from_prior(answer, seen, scale, eps),
        scale=scale,
    )


@dataclass(frozen=True)
class Spectra:
    """Results from the spectra of a scaled information and design.

    Attributes:
        condition: largest over smallest eigenvalue of the information.
        weakest: unit eigenvector of the smallest eigenvalue; for degenerate poses a direction that
            they do not determine.
        weakest_sd: SD along ``weakest``; NaN where there is no finite SD.
    """

    condition: Float[Array, " k"]
    weakest: Float[Array, "k p"]
    weakest_sd: Float[Array, " k"]

    @classmethod
    def of(
        cls,
        information: Float[Array, "k p p"],
        design: Float[Array, "k p p"],
        variance: Float[Array, " k"],
        eps: float,
        *,
        whitened: bool = False,
    ) -> Spectra:
        """From matrices in units of mm at the target.

        Args:
            information: with the offsets eliminated.
            design: of unweighted residuals, offsets known.
            variance: of the residuals from which ``information`` was formed.
            eps: relative rounding.
            whitened: the residuals are in SDs.
        """
        values, vectors = spectrum(information)
        plain, unseen = spectrum(design)
        null = plain < threshold(eps) * plain.sum(axis=1, keepdims=True)
        unknown = degenerate = null[:, 0]
        if not whitened:
            unknown = degenerate | (values[:, 0] < threshold(eps) * values.sum(axis=1))
        smallest = np.maximum(values[:, 0], eps * values[:, -1])
        weakest = vectors[:, :, 0]
        if degenerate.any():
            weakest = np.where(degenerate[:, None], nearest_unknown(unseen, null), weakest)
        sd = np.where(unknown, np.nan, np.sqrt(variance / smallest))
        return cls(values[:, -1] / smallest, weakest, sd)


def component_freedom(used: Any, blocks: Blocks) -> Any:
    """Degrees of freedom of lateral errors, of range errors and of offsets, (*batch).

    The unknowns take a third of theirs from each of the three.

    Args:
        used: number of images, (*batch).
        blocks: the free unknowns.
    """
    return array_module(used).maximum(used - count_unknowns(blocks) / 3, 1.0)


def rounding(used: Float[AnyArray, "*batch"], lever: Float[AnyArray, "*batch"]) -> Any:
    """A sum of squared residuals up to this, mm^2, is rounding: the data are exact."""
    return used * (64 * np.finfo(lever.dtype).eps * lever) ** 2


def variances_by_axis(
    parts: Float[AnyArray, "k p p *batch"],
    squares: Float[AnyArray, " k *batch"],
    used: Float[AnyArray, "*batch"],
    inverse: Float[AnyArray, "p p *batch"],
    lever: Float[AnyArray, "*batch"],
) -> Any:
    """Variance of each axis's errors over the pooled one, in a fit with equal weights.

    Args:
        parts: S_k, the axes' normal matrices.
        squares: sums of the axes' squared residuals, mm^2.
        used: number of images.
        inverse: of S = sum S_k.
        lever: lever arm, mm.

    Returns:
        (3, *batch); ones where residuals are only rounding.
    """
    xp = array_module(parts, squares)
    # An axis's residuals have n - tr(S^-1 S_k) degrees of freedom.
    freedom = used - (inverse * parts).sum(axis=(1, 2))
    whole = squares.sum(axis=0)
    exact = whole <= rounding(used, lever)
    pooled = xp.where(exact, 1.0, whole) / xp.maximum(3 * used - len(inverse), 1.0)
    found = (squares / pooled + POOLED_SHARE) / (freedom + POOLED_SHARE)
    return xp.where(exact, 1.0, found)


def covariance_by_axis(
    parts: Float[AnyArray, "k p p *batch"],
    variances: Float[AnyArray, " k *batch"],
    inverse: Float[AnyArray, "p p *batch"],
) -> Any:
    """S^-1 (sum v_k S_k) S^-1, (p, p, *batch): in units of the pooled variance, as v_k are.

    Args:
        parts: S_k.
        variances: v_k, from :func:`variances_by_axis`.
        inverse: S^-1.
    """
    middle = (variances[:, None, None] * parts).sum(axis=0)

    def product(left: Any, right: Any) -> Any:
        return (left[:, :, None] * right[None]).sum(axis=1)

    found = product(product(inverse, middle), inverse)
    return 0.5 * (found + found.swapaxes(0, 1))


def threshold(eps: float) -> float:
    """Smallest eigenvalue over the trace below which a matrix counts as singular."""
    return max(SINGULAR_DESIGN, 100 * eps)


def mm_at_target(lever: Float[AnyArray, "*batch"], blocks: Blocks) -> Any:
    """Factors that turn each unknown's tangent into mm at the target, (*batch, p).

    They are 1 or the lever arm, and a traced array if the lever arm is traced.
    """
    xp, one = array_module(lever), 0 * lever + 1
    rows = [TABLE[name] for name in blocks]
    each = [lever if row.lever else one for row in rows for _ in row.tangents]
    return xp.stack(each, axis=-1)


def spectrum(
    matrix: Float[Array, "k p p"],
) -> tuple[Float[Array, "k p"], Float[Array, "k p p"]]:
    """Eigenvalues, ascending, and eigenvectors (columns); NaN for matrices that are not finite."""
    finite = np.all(np.isfinite(matrix), axis=(1, 2))
    values, vectors = np.linalg.eigh(np.where(finite[:, None, None], matrix, np.eye(len(matrix.T))))
    lost = ~finite
    values[lost], vectors[lost] = np.nan, np.nan
    return values, vectors


def inverses(matrix: Float[Array, "k p p"], eps: float) -> Float[Array, "k p p"]:
    """Inverses of positive definite matrices; NaN for others.

    The matrices are first scaled to a unit diagonal and get a ridge at the level of rounding.
    """
    count = matrix.shape[-1]
    diagonal = np.einsum("kii->ki", matrix)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    both = scale[:, :, None] * scale[:, None]
    scaled = matrix * both + 16 * eps * np.eye(count)
    finite = np.all(np.isfinite(scaled), axis=(1, 2))
    scaled = np.where(finite[:, None, None], scaled, np.eye(count))
    try:
        found = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        found = np.full_like(scaled, np.nan)
        for row, each in enumerate(scaled):
            if np.linalg.matrix_rank(each) == count:
                found[row] = np.linalg.inv(each)
    found = 0.5 * (found + np.swapaxes(found, 1, 2)) * both
    good = finite & (np.einsum("kii->ki", found) > 0).all(axis=1)
    return np.where(good[:, None, None], found, np.nan)


def nearest_unknown(
    vectors: Float[Array, "k p p"], null: Bool[Array, "k p"]
) -> Float[Array, "k p"]:
    """The unit vector of a null space that is nearest to a single unknown; X's shift goes first.

    If the space has several dimensions, its eigenvectors are arbitrary mixtures of the unknowns.
    """
    chosen = np.where(null[:, None], vectors, 0.0)
    projector = chosen @ np.swapaxes(vectors, 1, 2)
    purity = np.einsum("kii->ki", projector)
    first = np.argmax(purity > 0.5 * purity.max(axis=1, keepdims=True), axis=1)
    picked = projector[np.arange(len(first)), :, first]
    length = np.linalg.norm(picked, axis=1, keepdims=True)
    return picked / np.where(length > 0, length, 1.0)


def _offsets(
    answer: Calibration,
    seen: ImageErrors,
    inverse: Float[Array, "k p p"],
    variance: Float[Array, " k"],
) -> tuple[Float[Array, "k n"], Float[Array, "k n"]]:
    """Which offsets rest on their bound, and the SDs of the others, mm."""
    kept = np.asarray(answer.mask) > 0
    size, at_bound = variance[:, None], np.zeros(kept.shape)
    if answer.prior == "bounded":
        given = seen.problem.max_elevation
        bound = DEFAULT_MAX_ELEVATION_MM if given is None else np.asarray(given)
        y = np.asarray(answer.elevation)
        arc = OnArc.at(y, (seen.q[..., 1], seen.q[..., 2]), seen.distance, bound)
        at_bound = (kept & arc.resting).astype(float)
        rows = seen.circle_rows(arc.axial)
        through = arc.slope[..., None] * rows[..., 2, :] - rows[..., 1, :]
        weight = 1 + arc.slope**2
        total = size * (quadratic(through, inverse) / weight + 1) / weight
        kept = kept & (at_bound == 0)
    elif answer.linearisation.tracker_sd is not None:
        whitened = Whitened.of(answer, seen)
        assert whitened.offset_rows is not None
        tau = answer.linearisation.tracker_sd[:, None]
        along = seen.rows[..., 2, :] - tau[..., None] * whitened.offset_response
        total = size * (quadratic(along, inverse) + tau**2 / whitened.offset_precision)
    else:
        total = size * quadratic(seen.rows[..., 2, :], inverse)
    return at_bound, np.where(kept, np.sqrt(np.where(kept, total, 1.0)), np.nan)


def _known_from_prior(
    answer: Calibration, seen: ImageErrors, scale: Float[Array, "k p"], eps: float
) -> Float[Array, "k p"]:
    """The direction that the measurements do not determine without a prior on the offsets."""
    found = np.zeros_like(scale)
    if answer.prior == "none":
        return found
    if answer.data == "points":
        # A turn about the element line, the lateral axis, moves no lateral position and no range.
        found[:, block_slice(answer.blocks, "rotation").start] = np.isfinite(scale).all(axis=1)
        return found
    rows = seen.channel_rows() / scale[:, None]
    values, vectors = spectrum(np.swapaxes(rows, 1, 2) @ rows)
    null = values < threshold(eps) * values.sum(axis=1, keepdims=True)
    return np.where(null[:, :1], nearest_unknown(vectors, null), found)
