"""Errors that are alike in successive images, and how much they widen the covariance.

A least-squares answer moves by dx = S^-1 sum_k J_k' e_k, with J_k the rows of all images for one
kind k of error (lateral, range, elevational), e_k these errors, both in SDs, and S the sum of
J_k' J_k. If the errors of kind k have the covariance C_k over the images, that of the answer is

    S^-1 (sum_k J_k' C_k J_k) S^-1

instead of S^-1. How much larger this is depends on the order of the poses: where the poses change
at random, a drift matters only through the mean of the errors, which shifts X; where they change as
slowly as the errors, it dominates.

A share a of the variance of each kind is correlated by rho^|i - j| between images i and j, the rest
is independent. The residuals do not show C_k as it is, since the fit absorbs slow errors more than
quick ones. So every pair (rho, a) of a grid is weighed by its restricted likelihood given those
residuals (profiled over the variance), times a prior: half for no correlation, the other half
spread evenly over the grid, and less where the variance would be very large. The other kinds enter
with their mean weights, in turn. C_k is then the weighed mean, which is the law of total variance,
since every pair has the same estimate. So SDs grow by one to three percent where errors look
independent and the poses change at random; nothing decides whether errors are correlated. The
correction makes no answer more certain. The information P of priors on sound speed and delay is
added to both sums.

*Slow paths.* Where the probe was placed anew for every image, errors have little reason to stay
alike for long. Where it moved slowly all the time, whatever depends on its motion did so, too, and
few images along such a path cannot tell a drift from a movement. Offsets that follow the movement
change about as quickly as the probe does. So there is another grid for such paths, and most of it
has spectra that are flat up to a cut-off near the path's own frequency and fall steeply behind it.
(A grid of all periods from a few images on gives most of the prior to errors that would be seen,
and too little to those that the fit absorbs.) The rest of it has correlations of the usual kind,
but of times up to a third of the recording. The share of this grid in the prior follows from the
size of the steps (:func:`slowness`).

Errors without frequencies above 1/P have about 2 n/P degrees of freedom in n images, with P in
images, however many these are. So after one or two periods of the movement the size of errors that
follow it is known from few values, as an SD from few measurements, and Student's t has to take the
place of the normal law. Their variance grows by the square of the ratio of both quantiles, in
proportion to the weight of their models.

The cosine transform of a stationary series has nearly independent coefficients, whose variances are
the spectral density. So no matrix of all images is formed: C_k is diagonal there.

References: Patterson and Thompson 1971 (restricted likelihood); White 1980 and Liang and Zeger 1986
(covariances under dependent errors); Ahmed, Natarajan and Rao 1974 (cosine transform of such
series); Slepian 1983 (degrees of freedom of band-limited series); Student 1908.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxcal.calibration.dependence import probe_points, step_share
from jaxcal.diagnostics.image_errors import further_prior
from jaxcal.diagnostics.influence import WhitenedErrors, whitened_errors
from jaxcal.model.unknowns import block_slice
from jaxcal.result.calibration import Calibration, Medium
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.arrays import batch_of_one, like

CORRELATIONS = np.arange(0.04, 1.0, 0.08)
"""Correlations of the correlated part of successive errors that are weighed."""

SLOW_SHARE, RANDOM_SHARE = 0.2, 0.4
"""Steps between images, as shares of the distance of poses half a recording apart: up to the first
one a path is slow, and from the second one on poses change at random."""

FOLLOWING = 0.9
"""Along a slow path: prior probability that errors that are alike follow the movement."""

PERIODS, LONGEST_PERIOD = (0.7, 1.0, 1.4, 2.0), 2.0
"""Periods at the cut-off of errors that follow the movement, relative to its own, and the longest
one relative to the number of images, that of the slowest wave. (What does not change at all is the
mean of the errors, whose doubt is included elsewhere.)"""

SHORTEST_PERIOD, OTHER_PERIODS = 4.0, 9
"""Along a slow path: the shortest period (images) of errors that do not follow the movement, and
the number of periods from this one to the longest one."""

ORDER = 16
"""Power of the squared frequency by which these spectra fall behind the cut-off."""

SHARES = np.array([1 / 3, 2 / 3, 1.0])
"""Shares of the variance that are correlated."""

FOLLOWING_SHARES = 1 - np.array([0.1, 0.03, 0.01, 0.003, 0.001, 1e-12])
"""Those of errors that follow the movement, of which the fit absorbs most. (The last one is all,
but for rounding.)"""

INDEPENDENT = 0.5
"""Prior probability that errors of one kind are independent."""

FEWEST_SUCCESSIVE, FEWEST_SLOW = 20, 10
"""With fewer used images the correlation is not estimated; the second number is for slow paths."""

ROUNDING_MM = 1e-9
"""Errors with smaller SDs are rounding."""

NEGLIGIBLE = 0.01
"""Errors with less than this share of the variance that they are given tell of no correlation."""

PRIOR_VARIANCE = 10_000.0
"""Mean of the exponential prior of a variance, relative to the one under independence. The fit
absorbs nearly all of smooth errors that last longer than the recording, so that they may have any
size, and the mean of the variances would be that of the least likely model."""

ROUNDS, STEPS = 3, 3
"""Rounds over the kinds of error, and steps to the variance in each."""


def widens(channels: bool, prior: str) -> bool:
    """Whether :func:`widened` changes anything: not from channels or with bounded offsets."""
    return not channels and prior != "bounded"


def widened(result: Calibration) -> Calibration:
    """The calibration with its covariance widened for errors that are alike in successive images.

    Args:
        result: of one problem, with concrete values.

    Returns:
        Calibrations from channels, with bounded offsets, too few images (:data:`FEWEST_SUCCESSIVE`;
        :data:`FEWEST_SLOW` on slow paths), rounding errors alone or without a finite covariance are
        returned unchanged.
    """
    if not widens(result.data == "channels", result.prior) or result.problem is None:
        return result
    covariance = np.asarray(result.unknowns_covariance)
    # Counted by numpy, since JAX would compile the count anew for every number of images.
    if not np.isfinite(covariance).all():
        return result
    used = np.asarray(result.mask) > 0
    poses = np.asarray(result.problem.poses, float)[used]
    slow = slowness(poses)
    if used.sum() < (FEWEST_SLOW if slow else FEWEST_SUCCESSIVE):
        return result
    if np.max(np.asarray(result.sigma)) < ROUNDING_MM:
        return result
    answer = batch_of_one(result)
    whitened = whitened_errors(answer)
    (precision,), _ = further_prior(answer)
    before, after = _covariances(whitened, precision, slow, movement_period(poses))
    linearisation = result.linearisation
    # The information about all unknowns changes in the same proportion.
    variance = float(linearisation.variance)
    whole = variance * np.linalg.inv(np.asarray(linearisation.information, float))
    information = variance * np.linalg.inv(_stretched(whole, before, after))
    wider = _stretched(covariance, before, after)
    return replace(
        result,
        unknowns_covariance=like(result.unknowns_covariance, wider),
        medium=_wider_medium(result, covariance, wider),
        linearisation=replace(
            linearisation, information=like(linearisation.information, information)
        ),
    )


def _wider_medium(
    result: Calibration, covariance: Float[np.ndarray, "p p"], wider: Float[np.ndarray, "p p"]
) -> Medium:
    """Sound speed and delay with the SDs of the wider covariance."""
    medium, changed = result.medium, {}
    for name, field in (("sound-speed", "sound_speed_sd_m_s"), ("delay", "delay_sd_s")):
        if name in result.blocks:
            at = block_slice(result.blocks, name).start
            sd = getattr(medium, field)
            by = np.sqrt(wider[at, at] / covariance[at, at])
            changed[field] = like(sd, np.asarray(sd * by))
    return replace(medium, **changed)


def slowness(poses: Float[np.ndarray, "n 4 4"]) -> float:
    """How slow a path is, by the size of its steps: 1 for a slow path, 0 for poses at random.

    It falls linearly between :data:`SLOW_SHARE` and :data:`RANDOM_SHARE`, and is 0 for fewer than
    :data:`FEWEST_SLOW` images.

    Args:
        poses: of the images in use, in the order in which they were taken, probe -> tracker, mm.
    """
    if len(poses) < FEWEST_SLOW:
        return 0.0
    return float(np.interp(step_share(poses), [SLOW_SHARE, RANDOM_SHARE], [1.0, 0.0]))


def movement_period(poses: Float[np.ndarray, "n 4 4"]) -> float:
    """The period of a sine that changes as quickly as the probe moves, in images.

    The mean square step of a sine with period P is 4 sin^2(pi / P) times its variance.

    Args:
        poses: of successive images, probe -> tracker, mm.
    """
    places = probe_points(poses)
    variance = np.sum(np.var(places, axis=1))
    step = np.mean(np.sum(np.diff(places, axis=1) ** 2, axis=0))
    return float(np.pi / np.arcsin(np.sqrt(min(1.0, step / max(4 * variance, 1e-300)))))


def _covariances(
    whitened: WhitenedErrors,
    precision: Float[np.ndarray, " p"],
    slow: float = 0.0,
    period: float = np.inf,
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p p"]]:
    """Covariances of the unknowns without and with the correlation.

    Args:
        whitened: the errors and their rows.
        precision: information of the unknowns' priors.
        slow: :func:`slowness` of the path.
        period: its :func:`movement_period`.
    """
    errors, rows, prior = whitened.errors, whitened.rows, np.diag(precision)
    inverse, before = whitened.covariances(precision)
    spectra, belief, doubt = _models(len(errors), slow, period)
    waves = _cosine_transform(np.concatenate([rows, errors[..., None]], axis=2))
    middle = prior
    for k, factor in enumerate(_factors(waves, spectra, belief, doubt, prior)):
        along = waves[:, k, :-1]
        middle = middle + whitened.variances[k] * (along.T * (factor @ spectra)) @ along
    lower = _lower(before)
    inner = np.linalg.solve(lower, inverse @ middle @ inverse)
    values, vectors = np.linalg.eigh(np.linalg.solve(lower, inner.T))
    turned = lower @ vectors
    return before, (turned * np.maximum(values, 1.0)) @ turned.T


def _cosine_transform(values: Float[np.ndarray, "n k q"]) -> Float[np.ndarray, "n k q"]:
    """The orthonormal cosine transform (DCT-II) along the first axis."""
    # That of scipy.fft is the same, but importing it takes longer than a calibration.
    count = len(values)
    turn = np.exp(-0.5j * np.pi * np.arange(count) / count)[:, None, None]
    mirrored = np.concatenate([values, values[::-1]])
    found = (turn * np.fft.rfft(mirrored, axis=0)[:count]).real / np.sqrt(2 * count)
    found[0] /= np.sqrt(2)
    return found


def _models(
    count: int, slow: float, period: float
) -> tuple[Float[np.ndarray, "g n"], Float[np.ndarray, " g"], Float[np.ndarray, " g"]]:
    """Variances of the cosine transform of errors with variance 1, for each model.

    Returns:
        Besides, the models' prior probabilities, and the shares by which their variance grows since
        it is known from few values.
    """
    grids = []
    if slow < 1 and count >= FEWEST_SUCCESSIVE:
        grids.append((1 - slow, 0.0, _usual_spectra(count)))
    if slow > 0:
        longest = LONGEST_PERIOD * count
        own = np.minimum(period * np.array(PERIODS), longest)
        following = _partly(_low_pass(count, own, ORDER), FOLLOWING_SHARES)
        grids.append((FOLLOWING * slow, _known_from(2 * count / period), following))
        others = np.geomspace(SHORTEST_PERIOD, longest, OTHER_PERIODS)
        grids.append(((1 - FOLLOWING) * slow, 0.0, _partly(_low_pass(count, others, 1), SHARES)))
    spectra, belief, doubt = [np.ones((1, count))], [np.ones(1)], [np.zeros(1)]
    for share, grows, grid in grids:
        spectra.append(grid)
        belief.append(np.full(len(grid), (1 - INDEPENDENT) * share / len(grid)))
        doubt.append(np.full(len(grid), grows))
        belief[0] -= belief[-1].sum()
    return np.concatenate(spectra), np.concatenate(belief), np.concatenate(doubt)


def _known_from(freedom: float) -> float:
    """The share by which a variance grows that is known from so many values, at least one."""
    # scipy.special takes longer to import than a calibration of poses at random.
    from scipy import special

    from jaxcal.diagnostics.intervals import LEVEL

    end = 0.5 + 0.5 * LEVEL
    return float((special.stdtrit(max(freedom, 1.0), end) / special.ndtri(end)) ** 2 - 1)


def _usual_spectra(count: int) -> Float[np.ndarray, "g n"]:
    """Of a correlation rho^|i - j|."""
    rho = CORRELATIONS[:, None]
    return _partly(1 / (1 + rho**2 - 2 * rho * np.cos(_frequencies(count))), SHARES)


def _low_pass(count: int, periods: Float[np.ndarray, " r"], order: int) -> Float[np.ndarray, "r n"]:
    """Flat up to a cut-off, where they have fallen to half; periods in images."""
    cut_off = np.sin(np.pi / periods)[:, None] ** 2
    above = np.sin(0.5 * _frequencies(count)) ** 2 / cut_off
    # Of order 1 it is that of rho^|i - j|; of others, of so many filters one after another.
    return (1 + (2 ** (1 / order) - 1) * above) ** -float(order)


def _frequencies(count: int) -> Float[np.ndarray, " n"]:
    """Those of the cosine transform, rad an image."""
    return np.pi * np.arange(count) / count


def _partly(
    density: Float[np.ndarray, "r n"], shares: Float[np.ndarray, " s"]
) -> Float[np.ndarray, "g n"]:
    """Spectra of errors of which each of the shares is correlated so."""
    share = shares[:, None]
    density = (density / density.mean(axis=-1, keepdims=True))[:, None]
    return (1 - share + share * density).reshape(-1, density.shape[-1])


def _factors(
    waves: Float[np.ndarray, "n 3 q"],
    spectra: Float[np.ndarray, "g n"],
    belief: Float[np.ndarray, " g"],
    doubt: Float[np.ndarray, " g"],
    prior: Float[np.ndarray, "p p"],
) -> Float[np.ndarray, "3 g"]:
    """Weight of every model times the variance under it, for every kind of error.

    Args:
        waves: cosine transforms of the unknowns' rows and, last, of the errors.
        spectra: of all models of the correlation.
        belief: their prior probabilities.
        doubt: shares by which their variances grow, in proportion to the weight of such models.
        prior: (q - 1, q - 1) information about the unknowns.

    Returns:
        Variances are relative to the one under independence. So a row is (1, 0, 0, ...) where
        independence is certain.
    """
    count, kinds, size = waves.shape
    weighed = np.array(
        [
            1 / spectra @ (wave[:, :, None] * wave[:, None]).reshape(count, -1)
            for wave in waves.transpose(1, 0, 2)
        ]
    ).reshape(kinds, len(spectra), size, size)
    whole = np.zeros((size, size))
    whole[:-1, :-1] = prior
    log_det = np.log(spectra).sum(axis=1)
    weight = np.tile(np.eye(1, len(spectra)), (kinds, 1))
    variance = np.ones((kinds, len(spectra)))

    for _ in range(ROUNDS):
        for k in range(kinds):
            precision = weight / variance
            precision[k] = 0.0
            others = whole + np.tensordot(precision, weighed, 2)
            for _ in range(STEPS):
                joint = others + weighed[k] / variance[k][:, None, None]
                leverage, squares = _leverage_and_squares(joint, weighed[k])
                freedom = count - leverage / variance[k]
                variance[k] = squares / np.maximum(freedom, 0.1 * count)
                if not variance[k][0] > NEGLIGIBLE:
                    break
            if not variance[k][0] > NEGLIGIBLE:
                variance[k] = 1.0
                continue
            cost = _restricted_cost(others + weighed[k] / variance[k][:, None, None])
            twice = cost + count * np.log(variance[k]) + log_det
            twice += 2 * variance[k] / (PRIOR_VARIANCE * variance[k][0])
            likelihood = belief * np.exp(-0.5 * (twice - twice.min()))
            weight[k] = likelihood / likelihood.sum()
    variance *= 1 + doubt * (weight @ (doubt > 0))[:, None]
    return weight * variance / variance[:, :1]


def _leverage_and_squares(
    joint: Float[np.ndarray, "g q q"], own: Float[np.ndarray, "g q q"]
) -> tuple[Float[np.ndarray, " g"], Float[np.ndarray, " g"]]:
    """tr(S^-1 J_k' C_k^-1 J_k) and r' C_k^-1 r of one kind, r its errors after the fit.

    ``joint`` has products of the unknowns' rows and, last, of the errors, of all kinds, and ``own``
    those of this kind; S is the part of ``joint`` without the errors.
    """
    right = np.concatenate([own[:, :-1, :-1], joint[:, :-1, -1:]], axis=2)
    solved = np.linalg.solve(joint[:, :-1, :-1], right)
    with_error = np.concatenate([-solved[..., -1], np.ones((len(own), 1))], axis=1)
    squares = np.einsum("gp,gpq,gq->g", with_error, own, with_error)
    return np.trace(solved[..., :-1], axis1=1, axis2=2), squares


def _restricted_cost(joint: Float[np.ndarray, "g q q"]) -> Float[np.ndarray, " g"]:
    """The sum of ln det S and the squares after the fit, ``joint`` as above."""
    information, gradient = joint[:, :-1, :-1], joint[:, :-1, -1]
    step = np.linalg.solve(information, gradient[..., None])[..., 0]
    squares = joint[:, -1, -1] - np.sum(gradient * step, axis=1)
    return np.linalg.slogdet(information)[1] + squares


def _lower(covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """The Cholesky factor of a covariance that may be singular to rounding."""
    try:
        return np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        pass
    size = np.sqrt(np.diagonal(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    least = 4 * len(size) * np.finfo(float).eps
    return size[:, None] * np.linalg.cholesky((vectors * np.maximum(values, least)) @ vectors.T)


def _stretched(
    covariance: Float[np.ndarray, "p p"],
    before: Float[np.ndarray, "p p"],
    after: Float[np.ndarray, "p p"],
) -> Float[np.ndarray, "p p"]:
    """A covariance changed in the same proportion as another one, from before to after.

    What it has beyond ``before`` does not come from the errors of single images (the doubt about
    the mean of the offsets, say), and stays as it is.
    """
    lower = _lower(before)
    values, vectors = np.linalg.eigh(np.linalg.solve(lower, np.linalg.solve(lower, covariance).T))
    own = _lower(after) @ vectors
    beyond = lower @ vectors
    found = (own * np.minimum(values, 1.0)) @ own.T
    return found + (beyond * np.maximum(values - 1.0, 0.0)) @ beyond.T
