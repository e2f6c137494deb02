"""Posterior means of X by importance sampling; the offsets' distribution and noise are known.

The posterior of X and the target c is exact and nonlinear,

    p(X, c) ~ prod_i law(q_iy / size) N([x_i, r_i]; [q_ix, hypot(q_iy, q_iz)], covariance_i),

with q_i the target in image i's frame. Gaussian offsets of the told SD give a first proposal; a few
rounds of weighted moments, tempered while the proposal is poor, bring its mean and covariance to
the posterior's; then Student draws from there are weighted by the exact density, edges included,
until they are worth ENOUGH independent ones.

Plain NumPy, one trial after the other, with all draws and images in one product of matrices: a few
ms a trial and nothing to compile.

Reference: Robert and Casella 2004, sections 3.3 and 14.4 (adaptive importance sampling).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxcal.study.offsets import DEGREES_OF_FREEDOM, LawName, standard_deviation

UNKNOWNS = 9
ADAPTING, DRAWS, ROUNDS = 768, 1024, 20
ENOUGH, MOST_BLOCKS = 400.0, 24
TAIL = 10.0
"""Degrees of freedom of the draws: heavier tails than the posterior's keep the weights bounded."""
STEEPNESS = 30.0
"""While the proposal adapts, densities fall beyond an edge by this many e-foldings in a size."""


def log_law(law: LawName, u: Float[np.ndarray, "n draws"]) -> Float[np.ndarray, " draws"]:
    """Log density of all offsets together, in sizes, up to a constant; -inf beyond an edge."""
    if law == "normal":
        return -0.5 * np.einsum("nd,nd->d", u, u)
    # A product's logarithm: one for all images.
    if law == "heavy-tailed":
        nu = DEGREES_OF_FREEDOM
        return -0.5 * (nu + 1) * np.log(np.prod(1 + u * u / (nu - 2), axis=0))
    inside = 1 - np.abs(u)
    if law == "uniform":
        return np.where(np.min(inside, axis=0) >= 0, 0.0, -np.inf)
    with np.errstate(divide="ignore"):
        return np.log(np.prod(np.maximum(inside, 0.0), axis=0))


def log_uniform_untold(u: Float[np.ndarray, "n draws"]) -> Float[np.ndarray, " draws"]:
    """Log density of uniform offsets of any size a, all ln a as probable: int a^-n da / a."""
    return -len(u) * np.log(np.max(np.abs(u), axis=0))


def soft_log_law(law: LawName, u: Float[np.ndarray, "n draws"]) -> Float[np.ndarray, " draws"]:
    """The same with slopes beyond the edges, for a proposal to find its way inside."""
    if law in ("normal", "heavy-tailed"):
        return log_law(law, u)
    inside = 1 - np.abs(u)
    slope = STEEPNESS * np.sum(np.minimum(inside, 0.0), axis=0)
    if law == "uniform":
        return slope
    return slope + np.sum(np.log(np.maximum(inside, 0.01)), axis=0)


@dataclass(frozen=True)
class Target:
    """The posterior of one trial about a value of X and the target c, in its tangent.

    A tangent is [v, omega, dc], mm, rad and mm: X Exp([v, omega]) as in the package, c + dc.

    Attributes:
        law: of the offsets.
        size: of the distribution, mm.
        position: q_i at the origin, mm.
        told: the size is told; otherwise (uniform distribution only) it is one more unknown.
        turn: how c moves q_i there.
        points: lateral position and range, mm.
        whitening: lower triangular inverse root of every covariance.
    """

    law: LawName
    size: float
    told: bool
    position: Float[np.ndarray, "n 3"]
    turn: Float[np.ndarray, "n 3 3"]
    points: Float[np.ndarray, "n 2"]
    whitening: Float[np.ndarray, "n 2 2"]

    def log_density(
        self, tangents: Float[np.ndarray, "draws 9"], soft: bool = False
    ) -> Float[np.ndarray, " draws"]:
        """Exact log posterior of every tangent, up to a constant."""
        count, draws = len(self.position), len(tangents)
        rotation = rotations(tangents[:, 3:6])
        moved = np.concatenate([self.position, self.turn.reshape(count, 9)], axis=1)
        moved = np.concatenate([moved, np.ones((count, 1))], axis=1)
        # q = R' (position - v + turn dc): one product of matrices for all images and draws.
        back = np.transpose(rotation, (2, 1, 0))
        factors = np.concatenate([
            np.transpose(back, (1, 0, 2)),
            (np.transpose(back, (1, 0, 2))[:, None] * tangents[:, 6:].T[:, None])
            .reshape(9, 3, draws),
            -np.einsum("abd,db->ad", back, tangents[:, :3])[None],
        ])  # fmt: skip
        q = (moved @ factors.reshape(13, 3 * draws)).reshape(count, 3, draws)
        lateral = q[:, 0] - self.points[:, :1]
        distance = np.sqrt(q[:, 1] ** 2 + q[:, 2] ** 2) - self.points[:, 1:]
        w = self.whitening
        distance = w[:, 1, 0, None] * lateral + w[:, 1, 1, None] * distance
        lateral = w[:, 0, 0, None] * lateral
        squares = np.einsum("nd,nd->d", lateral, lateral)
        squares += np.einsum("nd,nd->d", distance, distance)
        offsets = q[:, 1] / self.size
        if not self.told:
            return log_uniform_untold(offsets) - 0.5 * squares
        law = soft_log_law if soft else log_law
        return law(self.law, offsets) - 0.5 * squares

    def linear(self, sd: float) -> tuple[Float[np.ndarray, "m 9"], Float[np.ndarray, " m"]]:
        """Jacobian and whitened residuals at the origin, offsets taken as Gaussian of this SD."""
        q = self.position
        zero = np.zeros(len(q))
        cross = np.stack([
            np.stack([zero, -q[:, 2], q[:, 1]], -1), np.stack([q[:, 2], zero, -q[:, 0]], -1),
            np.stack([-q[:, 1], q[:, 0], zero], -1),
        ], axis=1)  # fmt: skip
        slope = np.concatenate([np.broadcast_to(-np.eye(3), cross.shape), cross, self.turn], 2)
        far = np.hypot(q[:, 1], q[:, 2])
        ranging = (q[:, 1, None] * slope[:, 1] + q[:, 2, None] * slope[:, 2]) / far[:, None]
        measured = np.stack([slope[:, 0], ranging], axis=1)
        errors = np.stack([q[:, 0], far], axis=1) - self.points
        jacobian = np.concatenate([(self.whitening @ measured).reshape(-1, 9), slope[:, 1] / sd])
        return jacobian, np.concatenate(
            [np.einsum("nab,nb->na", self.whitening, errors).ravel(), q[:, 1] / sd]
        )


def rotations(turn: Float[np.ndarray, "draws 3"]) -> Float[np.ndarray, "draws 3 3"]:
    """Rotation matrices of rotation vectors, rad (Rodrigues)."""
    angle = np.linalg.norm(turn, axis=1)
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    x, y, z = turn.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    outer = turn[:, :, None] * turn[:, None, :]
    outer -= (angle**2)[:, None, None] * np.eye(3)
    return np.eye(3) + first[:, None, None] * cross + second[:, None, None] * outer


@dataclass(frozen=True)
class Mean:
    """A posterior mean of X, 4x4; draws' worth; squared standard error in posterior variances."""

    image_to_probe: Float[np.ndarray, "4 4"]
    effective: float
    error: float


def posterior_mean(
    law: LawName,
    size: float,
    data: tuple[np.ndarray, np.ndarray, np.ndarray],
    start: tuple[np.ndarray, np.ndarray],
    random: np.random.Generator,
    told: bool = True,
) -> Mean:
    """Posterior mean of X by adaptive importance sampling.

    Args:
        law: of the offsets.
        size: of the distribution, mm.
        data: poses (n, 4, 4), points (n, 2), covariances (n, 2, 2), mm.
        start: X and c near the solution.
        random: a generator.
        told: the size is told; otherwise it is only where the search begins (uniform distribution).
    """
    x, c = (np.array(value) for value in start)
    sd = size * standard_deviation(law)
    whitening = np.linalg.inv(np.linalg.cholesky(data[2]))
    for _ in range(8):
        target = about(law, (size, told), data, whitening, x, c)
        jacobian, errors = target.linear(sd)
        scale = 1 / np.linalg.norm(jacobian, axis=0)
        step = -scale * np.linalg.lstsq(jacobian * scale, errors, rcond=None)[0]
        x, c = moved(x, step[:6]), c + step[6:]
        if np.linalg.norm(jacobian @ step) < 1e-3:
            break
    target = about(law, (size, told), data, whitening, x, c)
    jacobian = target.linear(sd)[0]
    scale = 1 / np.linalg.norm(jacobian, axis=0)
    root = scale[:, None] * np.linalg.inv(np.linalg.qr(jacobian * scale, mode="r"))
    centre = np.zeros(UNKNOWNS)
    for _ in range(ROUNDS):
        z = random.standard_normal((ADAPTING, UNKNOWNS))
        log_weight = target.log_density(centre + z @ root.T, soft=True)
        log_weight += 0.5 * np.einsum("dk,dk->d", z, z)
        weight, power = tempered(log_weight, 0.15 * ADAPTING)
        middle = weight @ z
        spread = (z - middle).T @ (weight[:, None] * (z - middle))
        centre = centre + root @ middle
        root = root @ np.linalg.cholesky(spread)
        if power == 1 and effective(weight) > 0.3 * ADAPTING:
            break

    draws, logs = [], []
    weight = np.zeros(0)
    for _ in range(MOST_BLOCKS):
        z = random.standard_normal((DRAWS, UNKNOWNS))
        z *= np.sqrt(TAIL / random.chisquare(TAIL, DRAWS))[:, None]
        proposed = 0.5 * (TAIL + UNKNOWNS) * np.log1p(np.einsum("dk,dk->d", z, z) / TAIL)
        draws.append(z)
        logs.append(target.log_density(centre + z @ root.T) + proposed)
        weight = weights(np.concatenate(logs), 1.0)
        if effective(weight) > ENOUGH:
            break
    if not np.any(weight):
        raise RuntimeError("no draw has all offsets within the edges of their law")
    z = np.concatenate(draws)
    middle = weight @ z
    apart = (z - middle) ** 2
    error = float(np.mean((weight**2 @ apart) / (weight @ apart)))
    mean = centre + root @ middle
    return Mean(moved(x, mean[:6]), effective(weight), error)


def about(
    law: LawName, size: tuple[float, bool], data: tuple, whitening: np.ndarray, x, c
) -> Target:
    """The posterior about X and c."""
    poses, points, _ = data
    turn = np.swapaxes(poses[:, :3, :3] @ x[:3, :3], 1, 2)
    in_probe = np.einsum("nji,nj->ni", poses[:, :3, :3], c - poses[:, :3, 3])
    return Target(law, *size, (in_probe - x[:3, 3]) @ x[:3, :3], turn, points, whitening)


def moved(x: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """X moved by [v, omega] as the package's parameters are."""
    out = x.copy()
    out[:3, 3] += x[:3, :3] @ tangent[:3]
    out[:3, :3] = x[:3, :3] @ rotations(tangent[None, 3:])[0]
    return out


def effective(weight: np.ndarray) -> float:
    """How many independent draws normalised weights are worth; 0 for weights of zero."""
    squares = float(np.sum(weight**2))
    return 1 / squares if squares > 0 else 0.0


def weights(log_weight: np.ndarray, power: float) -> np.ndarray:
    """Weights to a power, normalised; zeros where every one is zero."""
    largest = np.max(log_weight)
    if largest == -np.inf:
        return np.zeros_like(log_weight)
    weight = np.exp(power * (log_weight - largest))
    return weight / np.sum(weight)


def tempered(log_weight: np.ndarray, enough: float) -> tuple[np.ndarray, float]:
    """Normalised weights to the largest power up to 1 that leaves them worth ``enough`` draws."""
    weight = weights(log_weight, 1.0)
    if effective(weight) >= enough:
        return weight, 1.0
    low, high = 0.0, 1.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        enough_left = effective(weights(log_weight, middle)) >= enough
        low, high = (middle, high) if enough_left else (low, middle)
    return weights(log_weight, low), low
