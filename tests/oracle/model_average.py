"""The model average behind priors ``auto`` and ``uniform``, from its mathematics.

Gaussian models of the errors, with a mean b of the offsets that is zero or b ~ N(0, (2 s_y)^2); the
offsets' distributions by expectation propagation (EP) on the problem linearised there, each image's
moments by quadrature; the geometric median of all their answers.

Documented constants of the method (its module heads) stand in :class:`Recipe`: how often SDs are
updated, how many sweeps EP makes, which distributions there are and with what probability. With
``exactly`` the same is done to the end: SDs and unknowns to their fixed point, EP until it stands
still. What is left between the two is what the method's few steps cost.

Two quadratures: ``exact`` is composite Gauss-Legendre with hundreds of nodes; ``documented`` the
sixteen equidistant nodes with Gregory's weights that the method describes, so that everything else
can be compared to the last digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp, roots_legendre

from oracle.model import Data, Unknowns, channels, errors, jacobian, size, target


@dataclass(frozen=True)
class Distribution:
    """One of the offsets': its family, SD in units of the tuned one, probability beforehand."""

    family: str
    stretch: float
    prior: float


UNIFORM = tuple(Distribution("uniform", np.exp(0.14 - 0.055 * k), 0.08) for k in range(5))
ALL = (
    *UNIFORM,
    Distribution("bell", 1.05, 0.2),
    Distribution("gaussian", 1.0, 0.2),
    Distribution("student", 1.10, 0.2),
)


@dataclass(frozen=True)
class Recipe:
    """Documented constants; ``exactly`` takes everything to its fixed point instead."""

    distributions: tuple[Distribution, ...] = ALL
    quadrature: str = "exact"
    exactly: bool = False
    rounds: int = 2
    updates: int = 2
    ahead: int = 3
    sweeps: int = 3
    damping: float = 0.8
    largest_change: float = 0.4
    largest_gain: float = 10.0
    median_steps: int = 12
    probability_of_mean: float = 0.1
    lags: int = 5


# --- Quadrature --------------------------------------------------------------------------------


def density(family: str, u: np.ndarray, sd: float) -> np.ndarray:
    """Of mean zero and SD ``sd``, 1/mm."""
    z = u / sd
    if family == "uniform":
        return np.where(np.abs(z) <= np.sqrt(3.0), 1 / (2 * np.sqrt(3.0)), 0.0) / sd
    if family == "bell":
        return 15 / (16 * np.sqrt(7.0)) * np.clip(1 - z**2 / 7, 0, None) ** 2 / sd
    if family == "student":
        # t with 4 degrees of freedom over sqrt(2).
        return 0.375 * np.sqrt(2.0) * (1 + z**2 / 2) ** -2.5 / sd
    return np.exp(-0.5 * z**2) / (np.sqrt(2 * np.pi) * sd)


def support(family: str, sd: float) -> float:
    """Where the density ends, mm."""
    return {"uniform": np.sqrt(3.0), "bell": np.sqrt(7.0)}.get(family, np.inf) * sd


Moments = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Log of the mass, mean (mm) and variance (mm^2) of each image."""


def exact_moments(
    family: str,
    sd: float,
    centre: np.ndarray,
    variance: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> Moments:
    """Of the density times N(u; centre, variance) between low and high, by Gauss-Legendre."""
    node, weight = roots_legendre(24)
    width = np.sqrt(variance)
    low, high = np.maximum(low, -support(family, sd)), np.minimum(high, support(family, sd))
    nearest = np.clip(centre, low, high)
    # The Gaussian falls by exp(-50) beyond these.
    far = centre - nearest
    fall = 100 * variance / (np.abs(far) + np.sqrt(far**2 + 100 * variance))
    low, high = np.maximum(low, nearest - fall), np.minimum(high, nearest + fall)
    marks = [low + (high - low) * k / 16 for k in range(17)]
    marks += [np.clip(k * sd, low, high) for k in (-6, -3, -1.5, -0.7, 0, 0.7, 1.5, 3, 6)]
    marks += [np.clip(centre + k * width, low, high) for k in (-4, -2, -1, 0, 1, 2, 4)]
    edges = np.sort(np.stack(marks), axis=0)
    half, middle = 0.5 * np.diff(edges, axis=0), 0.5 * (edges[1:] + edges[:-1])
    u = middle[:, None] + half[:, None] * node[:, None]
    reference = 0.5 * (nearest - centre) ** 2 / variance
    mass = half[:, None] * weight[:, None] * density(family, u, sd)
    mass = mass * np.exp(-0.5 * (u - centre) ** 2 / variance + reference)
    total = mass.sum(axis=(0, 1))
    # Where the cut leaves nothing of the density there is no mass, and the mean is the edge.
    shares = np.where(total > 0, mass, 1.0)
    mean = (u * shares).sum(axis=(0, 1)) / shares.sum(axis=(0, 1))
    spread = ((u - mean) ** 2 * shares).sum(axis=(0, 1)) / shares.sum(axis=(0, 1))
    return np.log(total) - reference - 0.5 * np.log(2 * np.pi * variance), mean, spread


def documented_moments(
    family: str,
    sd: float,
    centre: np.ndarray,
    variance: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> Moments:
    """The same by sixteen equidistant nodes within 4.5 SDs of the Gaussian.

    Gregory's end weights where the integrand may end abruptly: always but for an uncut Student's t.
    A Gaussian density is multiplied exactly, and what is cut of the product is flat times Gaussian.
    """
    cut = bool(np.isfinite(low).any() or np.isfinite(high).any())
    log_front = np.zeros_like(centre)
    edge, flat = support(family, sd), family == "uniform"
    if family == "gaussian":
        both = variance + sd**2
        log_front = -0.5 * (np.log(2 * np.pi * both) + centre**2 / both)
        centre, variance = centre * sd**2 / both, variance * sd**2 / both
        if not cut:
            return log_front, centre, variance
        flat, edge = True, 1e3 * sd
    low, high = np.clip(low, -edge, edge), np.clip(high, -edge, edge)
    if family == "student":
        low, high = np.clip(low, -1e3 * sd, 1e3 * sd), np.clip(high, -1e3 * sd, 1e3 * sd)
    nearest = np.clip(centre, low, high)
    far = centre - nearest
    reach = 4.5**2 * variance
    fall = reach / (np.abs(far) + np.sqrt(far**2 + reach))
    low, high = np.maximum(low, nearest - fall), np.minimum(high, nearest + fall)
    u = low + (high - low) * np.arange(16)[:, None] / 15
    weight = np.ones(16)
    if cut or family != "student":
        weight[:5] = np.array([475, 1902, 1104, 1586, 1413]) / 1440
        weight[-5:] = weight[:5][::-1]
    reference = 0.5 * far**2 / variance
    height = np.full_like(u, 1.0 if family == "gaussian" else 1 / (2 * np.sqrt(3.0) * sd))
    if not flat:
        height = density(family, u, sd)
    mass = weight[:, None] * height * np.exp(-0.5 * (u - centre) ** 2 / variance + reference)
    total = mass.sum(axis=0)
    mean = (u * mass).sum(axis=0) / total
    spread = ((u - mean) ** 2 * mass).sum(axis=0) / total
    log_mass = np.log(total * (high - low) / 15) - reference
    return log_front + log_mass - 0.5 * np.log(2 * np.pi * variance), mean, spread


QUADRATURES: dict[str, Callable[..., Moments]] = {
    "exact": exact_moments,
    "documented": documented_moments,
}


# --- The mean of the offsets -------------------------------------------------------------------


@dataclass(frozen=True)
class MeanBelief:
    """Of b = 0 and b ~ N(0, (2 s_y)^2) together."""

    mean: float
    variance: float
    probability: float
    log_gain: float


def mixture(b: float, variance: float, sd: float, trust: float, recipe: Recipe) -> MeanBelief:
    """From the belief N(b, variance) under the second alone, by its likelihood to some power.

    Args:
        b: mm.
        variance: mm^2.
        sd: of the offsets, mm.
        trust: the power.
        recipe: with the probability of a mean.
    """
    prior = (2 * sd) ** 2
    # Likelihood of b: N(b; at, spread), flattened.
    spread = 1 / (1 / variance - 1 / prior)
    at, spread = b / variance * spread, spread / trust
    # Evidences relative to the flattened likelihood's height at its maximum.
    log_without = -0.5 * at**2 / spread
    log_with = 0.5 * np.log(spread / (spread + prior)) - 0.5 * at**2 / (spread + prior)
    share = recipe.probability_of_mean
    both = np.logaddexp(np.log(share) + log_with, np.log1p(-share) + log_without)
    p = np.exp(np.log(share) + log_with - both)
    centre, within = at * prior / (prior + spread), prior * spread / (prior + spread)
    return MeanBelief(p * centre, p * (within + centre**2) - (p * centre) ** 2, p, both - log_with)


# --- Gaussian models ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Model:
    """A Gaussian model of the errors.

    Attributes:
        residuals: from unknowns to unwhitened residuals by component, the offsets q_y last.
        image: of each residual, by component, in the order in which they were taken.
        correlated: (n, 2, 2) shape of lateral and range, or None.
        sigma: SDs to start from, mm.
        tied: the measurements' SDs keep their ratio.
    """

    residuals: Callable[[Unknowns], list[np.ndarray]]
    image: list[np.ndarray]
    correlated: np.ndarray | None
    sigma: np.ndarray
    tied: bool

    def whitened(self, parts: list[np.ndarray], sigma: np.ndarray) -> list[np.ndarray]:
        """Parts (trailing axes allowed) in SDs."""
        parts = [part / s for part, s in zip(parts, sigma, strict=True)]
        if self.correlated is not None:
            inverse = np.linalg.inv(np.linalg.cholesky(self.correlated))
            both = np.einsum("nij,nj...->ni...", inverse, np.stack(parts[:2], axis=1))
            parts = [both[:, 0], both[:, 1], parts[2]]
        return parts


@dataclass(frozen=True)
class Linear:
    """Where a model was tuned, linearised: u_i = offset_i + direction_i . x, the rest Gaussian."""

    unknowns: Unknowns
    b: float
    trust: float
    sigma: np.ndarray
    log_evidence: float
    information: np.ndarray
    gradient: np.ndarray
    direction: np.ndarray
    offset: np.ndarray


def tune(
    model: Model,
    start: Unknowns,
    blocks: tuple[str, ...],
    recipe: Recipe,
    medium: Callable[[Unknowns], np.ndarray] | None,
) -> Linear:
    """Unknowns, mean and SDs from nearby ones, and the Laplace evidence there."""
    count = size(blocks)
    least = max(1e-3 * model.sigma.max(), 1e-6)

    def system(u: Unknowns, b: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Unwhitened residuals and Jacobians (unknowns, then b) by component."""
        values = model.residuals(u)
        edges = np.cumsum([0, *map(len, values)])
        whole = jacobian(lambda step: np.concatenate(model.residuals(u.moved(step, blocks))), count)
        along = [
            np.hstack([whole[edges[k] : edges[k + 1]], np.zeros((len(part), 1))])
            for k, part in enumerate(values)
        ]
        values[-1] = values[-1] - b
        along[-1][:, -1] = -1.0
        return values, along

    def prior_rows(u: Unknowns) -> tuple[np.ndarray, np.ndarray]:
        if medium is None:
            return np.zeros(0), np.zeros((0, count + 1))
        rows = jacobian(lambda step: medium(u.moved(step, blocks)), count)
        return medium(u), np.hstack([rows, np.zeros((len(rows), 1))])

    def normal(u, b, sigma, here):
        """Residuals, Jacobian, inverse of the normal matrix, and step, where there is a mean."""
        parts = model.whitened(here[0], sigma), model.whitened(here[1], sigma)
        extra, extra_along = prior_rows(u)
        residual = np.concatenate([*parts[0], extra])
        along = np.concatenate([*parts[1], extra_along])
        matrix = along.T @ along
        matrix[-1, -1] += (2 * sigma[-1]) ** -2.0
        gradient = along.T @ residual
        gradient[-1] += (2 * sigma[-1]) ** -2.0 * b
        return residual, along, matrix, gradient

    def trust_in(u, b, sigma, here) -> float:
        residual, along, matrix, gradient = normal(u, b, sigma, here)
        inverse = np.linalg.inv(matrix)
        felt = (residual - along @ inverse @ gradient) * (along @ inverse[-1])
        image = np.concatenate(model.image)
        moved = np.bincount(image, felt[: len(image)])
        known = np.bincount(image, (along @ inverse[-1])[: len(image)] ** 2) / inverse[-1, -1]
        # Bartlett's window about every image.
        apart = np.abs(np.subtract.outer(np.arange(len(moved)), np.arange(len(moved))))
        window = np.clip(1 - apart / (recipe.lags + 1), 0, None)
        moved = moved / np.maximum(1 - window @ known, 0.05)
        shown = moved @ moved
        for lag in range(1, recipe.lags + 1):
            shown += 2 * window[0, lag] * (moved[lag:] @ moved[:-lag]) if lag < len(moved) else 0
        return float(min(1.0, inverse[-1, -1] / shown))

    u, b, sigma, trust = start, 0.0, model.sigma.copy(), 1.0
    for _ in range(500 if recipe.exactly else recipe.rounds):
        here, before = system(u, b), sigma
        trust = trust_in(u, b, sigma, here)
        step = np.zeros(count + 1)
        for _ in range(1 if recipe.exactly else recipe.updates):
            residual, along, matrix, gradient = normal(u, b, sigma, here)
            inverse = np.linalg.inv(matrix)
            step = -inverse @ gradient
            belief = mixture(b + step[-1], inverse[-1, -1], sigma[-1], trust, recipe)
            follow = inverse[:, -1] / inverse[-1, -1]
            step = step + follow * (belief.mean - b - step[-1])
            inverse = inverse + np.outer(follow, follow) * (belief.variance - inverse[-1, -1])
            residual = residual + along @ step
            leverage = np.einsum("ra,ab,rb->r", along, inverse, along)
            squares, freedom, at = [], [], 0
            for part in here[0]:
                rows = slice(at, at + len(part))
                at += len(part)
                squares.append(np.sum(residual[rows] ** 2))
                freedom.append(max(len(part) - leverage[rows].sum(), 0.05 * len(part)))
            factor = np.array(squares) / np.array(freedom)
            if model.tied:
                factor[:-1] = sum(squares[:-1]) / sum(freedom[:-1])
            sigma = np.maximum(sigma * np.sqrt(factor), least)
        u, b = u.moved(step[:-1], blocks), b + step[-1]
        if np.abs(np.log(sigma / before)).max() < 1e-13 and np.abs(step).max() < 1e-11:
            break
    here = system(u, b)
    residual, along, matrix, gradient = normal(u, b, sigma, here)
    inverse = np.linalg.inv(matrix)
    precision = (2 * sigma[-1]) ** -2.0
    cost = residual @ residual + precision * b**2 - gradient @ inverse @ gradient
    evidence = 0.5 * (np.log(precision) - cost - np.linalg.slogdet(matrix)[1])
    evidence -= sum(len(part) * np.log(s) for part, s in zip(here[0], sigma, strict=True))
    if model.correlated is not None:
        evidence -= 0.5 * np.log(np.linalg.det(model.correlated)).sum()
    at = b - (inverse @ gradient)[-1]
    evidence += mixture(at, inverse[-1, -1], sigma[-1], trust, recipe).log_gain
    offset, direction = here[0][-1], here[1][-1]
    rest = matrix - direction.T @ direction / sigma[-1] ** 2
    rest_gradient = gradient - direction.T @ offset / sigma[-1] ** 2
    return Linear(u, b, trust, sigma, evidence, rest, -rest_gradient, direction, offset)


# --- Expectation propagation -------------------------------------------------------------------


@dataclass(frozen=True)
class Belief:
    """Of the unknowns under one distribution of the offsets."""

    mean: np.ndarray
    covariance: np.ndarray
    log_evidence: float
    gain: float
    change: float


def propagate(linear: Linear, sd: float, recipe: Recipe, bound: np.ndarray | None) -> list[Belief]:
    """EP under every distribution; those of one family in turn, each from the last one's sites."""
    low = np.full(len(linear.offset), -np.inf) if bound is None else -bound - linear.b
    high = np.full(len(linear.offset), np.inf) if bound is None else bound - linear.b
    moments = QUADRATURES[recipe.quadrature]
    h, o = linear.direction, linear.offset

    def belief(tau: np.ndarray, nu: np.ndarray):
        information = linear.information + (h.T * tau) @ h
        right = linear.gradient + h.T @ (nu - tau * o)
        try:
            covariance = np.linalg.inv(information)
        except np.linalg.LinAlgError:
            # Where the sites run away, rounding decides whether the matrix still has an inverse.
            covariance = np.full_like(information, np.nan)
        return covariance, covariance @ right, information, right

    def tilt(family, scale, tau, nu, covariance, mean):
        variance = np.einsum("np,pq,nq->n", h, covariance, h)
        room = 1 / np.maximum(1 - tau * variance, 1e-3)
        centre = room * (o + h @ mean - variance * nu)
        without = variance * room
        return moments(family, scale, centre, without, low, high), centre, without

    def sites(found: Moments, centre, without):
        tau = np.maximum(1 / found[2] - 1 / without, -0.2 / without)
        return tau, (tau + 1 / without) * found[1] - centre / without

    def evidence_of(family, scale, tau, nu) -> float:
        covariance, mean, information, right = belief(tau, nu)
        found, centre, without = tilt(family, scale, tau, nu, covariance, mean)
        # ln of the integral of mass_i N(u; centre, without) against the site, image by image.
        joined = 1 + tau * without
        site = found[0] + 0.5 * np.log(joined)
        site -= 0.5 * ((centre + without * nu) ** 2 / joined - centre**2) / without
        site += nu * o - 0.5 * tau * o**2
        return site.sum() + 0.5 * right @ mean - 0.5 * np.linalg.slogdet(information)[1]

    result: dict[int, Belief] = {}
    for family in dict.fromkeys(each.family for each in recipe.distributions):
        members = [k for k, each in enumerate(recipe.distributions) if each.family == family]
        scales = [sd * recipe.distributions[k].stretch for k in members]
        tau, nu = np.full(len(o), scales[0] ** -2.0), np.zeros(len(o))

        def sweep(scale, tau, nu, family=family):
            covariance, mean = belief(tau, nu)[:2]
            new = sites(*tilt(family, scale, tau, nu, covariance, mean))
            damping = recipe.damping
            return tau + damping * (new[0] - tau), nu + damping * (new[1] - nu)

        for _ in range(0 if recipe.exactly else recipe.ahead):
            tau, nu = sweep(scales[0], tau, nu)
        for k, scale in zip(members, scales, strict=True):
            for _ in range(500 if recipe.exactly else recipe.sweeps - 1):
                last = tau, nu
                tau, nu = sweep(scale, tau, nu)
                if recipe.exactly and np.abs(tau - last[0]).max() < 1e-13 * np.abs(tau).max():
                    break
            earlier = evidence_of(family, scale, *last)
            evidence = evidence_of(family, scale, tau, nu)
            covariance, before, information, _ = belief(tau, nu)
            found, centre, without = tilt(family, scale, tau, nu, covariance, before)
            crowded = bool((tau * without > 990).any())
            new = sites(found, centre, without)
            tau, nu = (tau + recipe.damping * (new[0] - tau), nu + recipe.damping * (new[1] - nu))
            covariance, mean, information, _ = belief(tau, nu)
            change = float(np.sqrt((mean - before) @ information @ (mean - before)))
            gain = evidence - earlier
            result[k] = Belief(mean, covariance, evidence, gain, np.inf if crowded else change)
    return [result[k] for k in range(len(recipe.distributions))]


# --- The average -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Average:
    """The answer of priors ``auto`` and ``uniform``.

    Attributes:
        unknowns: X, target and the rest.
        covariance: of their tangent.
        sigma: SDs in use.
        probability: of each family, by name.
        mean: of the offsets, mm.
        mean_sd: mm.
        mean_probability: that there is one.
        trust: in what the data say of it.
        own_probability: of the images' own covariances.
        changes: of the last sweep of EP under each distribution, in SDs.
    """

    unknowns: Unknowns
    covariance: np.ndarray
    sigma: np.ndarray
    probability: dict[str, float]
    mean: float
    mean_sd: float
    mean_probability: float
    trust: float
    own_probability: float
    changes: np.ndarray


def models(data: Data, sigma: np.ndarray, on_channels: bool) -> list[Model]:
    """Common SDs; and the images' own covariances, if they have any, begun with the same SDs."""
    order = np.arange(len(data))
    if on_channels:
        heard = np.asarray(data.heard) > 0
        image = [np.broadcast_to(order[:, None], heard.shape)[heard], order]

        def residuals(u: Unknowns) -> list[np.ndarray]:
            return [channels(data, u)[heard], target(data, u)[:, 1]]

        return [Model(residuals, image, None, sigma, False)]

    def errors_of(u: Unknowns) -> list[np.ndarray]:
        return list(errors(data, u).T)

    found = [Model(errors_of, [order] * 3, None, sigma, False)]
    if data.covariance is not None:
        found.append(Model(errors_of, [order] * 3, data.shape(), sigma, True))
    return found


def average(
    data: Data,
    start: Unknowns,
    sigma: np.ndarray,
    blocks: tuple[str, ...],
    recipe: Recipe | None = None,
    *,
    on_channels: bool = False,
    medium: Callable[[Unknowns], np.ndarray] | None = None,
) -> Average:
    """Weigh the models and average the distributions' answers, from the self-tuned Gaussian fit."""
    # A distribution whose edges exclude an image runs into zeros and NaN, and does not count.
    with np.errstate(all="ignore"):
        return _average(data, start, sigma, blocks, recipe or Recipe(), on_channels, medium)


def _average(
    data: Data,
    start: Unknowns,
    sigma: np.ndarray,
    blocks: tuple[str, ...],
    recipe: Recipe,
    on_channels: bool,
    medium: Callable[[Unknowns], np.ndarray] | None,
) -> Average:
    common, *others = models(data, sigma, on_channels)
    tuned = [tune(common, start, blocks, recipe, medium)]
    own = 0.0
    for other in others:
        # From where the common SDs were tuned, with one factor for both measurements.
        assert data.covariance is not None
        mean = np.einsum("nkk->nk", data.covariance).mean(axis=0)
        factor = np.mean(tuned[0].sigma[:2] ** 2 / mean)
        first = np.sqrt(np.append(factor * mean, tuned[0].sigma[2] ** 2))
        begun = replace(other, sigma=first)
        tuned.append(tune(begun, tuned[0].unknowns, blocks, recipe, medium))
        # One more SD that is tuned costs half the logarithm of the number of images.
        more = tuned[1].log_evidence + 0.5 * np.log(len(data)) - tuned[0].log_evidence
        own = float(1 / (1 + np.exp(-more)))

    prior = np.array([each.prior for each in recipe.distributions])
    means, within, weight, with_mean, changes = [], [], [], [], []
    for linear, share in zip(tuned, [1 - own, own], strict=False):
        sd = float(linear.sigma[-1])
        beliefs = propagate(linear, sd, recipe, data.bound)
        away = np.append(_apart(tuned[0].unknowns, linear.unknowns, blocks), linear.b - tuned[0].b)
        score = np.full(len(prior), -np.inf)
        for k, belief in enumerate(beliefs):
            changes.append(belief.change)
            if not np.isfinite([belief.log_evidence, belief.gain, belief.change]).all():
                means.append(np.zeros(len(away)))
                within.append(np.eye(len(away)))
                with_mean.append(0.0)
                continue
            b, variance = linear.b + belief.mean[-1], belief.covariance[-1, -1]
            found = mixture(b, variance, sd, linear.trust, recipe)
            follow = belief.covariance[:, -1] / variance
            means.append(away + belief.mean + follow * (found.mean - b))
            within.append(
                belief.covariance + np.outer(follow, follow) * (found.variance - variance)
            )
            with_mean.append(found.probability)
            settled = (belief.change / recipe.largest_change) ** 4
            settled += (belief.gain / recipe.largest_gain) ** 8
            score[k] = belief.log_evidence + found.log_gain + np.log(prior[k]) - settled
        weight.append(share * np.exp(score - logsumexp(score)))
    means, within, weight = np.stack(means), np.stack(within), np.concatenate(weight)

    metric = tuned[0].direction.T @ tuned[0].direction
    spread = (2 / np.pi) * np.einsum("pq,kpq->k", metric, within)
    share = weight
    for _ in range(2000 if recipe.exactly else recipe.median_steps):
        off = means - share @ means
        pull = weight / np.sqrt(np.einsum("kp,pq,kq->k", off, metric, off) + spread)
        share = pull / pull.sum()
    answer = share @ means
    off = means - answer
    total = np.einsum("k,kpq->pq", weight, within) + np.einsum("k,kp,kq->pq", weight, off, off)
    families = [each.family for each in recipe.distributions] * len(tuned)
    return Average(
        unknowns=tuned[0].unknowns.moved(answer[:-1], blocks),
        covariance=total[:-1, :-1],
        sigma=tuned[int(own > 0.5)].sigma,
        probability={
            name: float(
                sum(w for w, family in zip(weight, families, strict=True) if family == name)
            )
            for name in dict.fromkeys(families)
        },
        mean=float(tuned[0].b + answer[-1]),
        mean_sd=float(np.sqrt(total[-1, -1])),
        mean_probability=float(weight @ np.array(with_mean)),
        trust=tuned[0].trust,
        own_probability=own,
        changes=np.array(changes),
    )


def _apart(first: Unknowns, second: Unknowns, blocks: tuple[str, ...]) -> np.ndarray:
    """The small step from one to the other, the rotation by Cayley's vector."""
    turn = first.rotation.T @ second.rotation
    skew = turn - turn.T
    parts = {
        "translation": first.rotation.T @ (second.translation - first.translation),
        "rotation": 2 * np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / (1 + np.trace(turn)),
        "point": second.point - first.point,
        "scale": np.log(second.scale / first.scale),
        "sound-speed": np.log(np.atleast_1d(second.speed / first.speed)),
        "delay": np.atleast_1d(second.delay - first.delay),
    }
    return np.concatenate([parts[name] for name in blocks])


def uniform_only(recipe: Recipe) -> Recipe:
    """The recipe of prior ``uniform``."""
    return replace(recipe, distributions=UNIFORM)
