"""How far prior ``auto`` is from the Bayes limit, the best that anybody can do on average.

The limit is told what nobody knows: the law of the offsets, its size, and the noise (with the
points' covariances). Its answer is the mean of the exact, nonlinear posterior of X and the target,

    p(X, c) ~ prod_i law(q_iy / size) N([x_i, r_i]; [q_ix, hypot(q_iy, q_iz)], covariance_i),

in the tangent of X. That mean is the best answer in squared error, and nearly so in mean RP, which
is a norm. It is taken by importance sampling, so that it is exact in the limit of many draws, edges
included. Gaussian offsets of the told SD give a first proposal; a few rounds of weighted moments,
tempered while the proposal is poor, bring its mean and covariance to the posterior's; then Student
draws from there are weighted by the exact density until they are worth ENOUGH independent ones.

``sampling_error_sd`` is the standard error of the means so found, in posterior SDs (root mean
square over unknowns and trials). It makes the limit's RP too large, and the ratios too small, by
about half its square: 0.05 is an eighth of a per cent. ``ci95_half`` is that of ``auto_over_bayes``
over the trials, paired. Data without noise are told a noise of EXACT_MM, not zero.

Seed 20261126; trial k of a cell is fold_in(root, cell * 10^6 + k), cells counted over all laws.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common import ELEVATIONS_MM, NOISES_MM, arguments, machine, results_folder, write_table
from jaxtyping import Array, Float

from jaxcal import Protocol, calibrate_batch, reconstruction_precision, simulate
from jaxcal.io.atomic import atomic_path
from jaxcal.offsets import DEGREES_OF_FREEDOM, OffsetLaw, standard_deviation

SEED = 20261126
LAWS: tuple[OffsetLaw, ...] = ("uniform", "normal", "heavy-tailed", "triangular")
FEW_IMAGES = (12, 20)
FEW_IMAGES_CELL = (2.0, 2.0)
QUICK = ((1.0, 2.0), (3.0, 6.0))
BOUND = 1.20
"""What the worst cell should stay below; the cells above it are named."""
EXACT_MM = 1e-6

UNKNOWNS = 9
ADAPTING, DRAWS, ROUNDS = 768, 1024, 6
ENOUGH, MOST_BLOCKS = 400.0, 24
TAIL = 10.0
"""Degrees of freedom of the draws: heavier tails than the posterior's keep the weights bounded."""
STEEPNESS = 30.0
"""While the proposal adapts, laws fall beyond an edge by this many e-foldings within one size."""

HEADER = [
    "elevation_distribution", "images", "elevation_mm", "noise_mm", "trials",
    "rp_conventional_mm", "rp_gaussian_mm", "rp_auto_mm", "rp_bayes_mm", "auto_over_bayes",
    "ci95_half", "gaussian_over_bayes", "conventional_over_bayes", "sampling_error_sd",
    "median_effective_draws", "least_effective_draws",
]  # fmt: skip


def log_law(law: OffsetLaw, u: Float[np.ndarray, "n draws"]) -> Float[np.ndarray, " draws"]:
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


def soft_log_law(law: OffsetLaw, u: Float[np.ndarray, "n draws"]) -> Float[np.ndarray, " draws"]:
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
        size: of the law, mm.
        position: q_i at the origin, mm.
        turn: how c moves q_i there.
        points: lateral position and range, mm.
        whitening: lower triangular inverse root of every covariance.
    """

    law: OffsetLaw
    size: float
    position: Float[np.ndarray, "n 3"]
    turn: Float[np.ndarray, "n 3 3"]
    points: Float[np.ndarray, "n 2"]
    whitening: Float[np.ndarray, "n 2 2"]

    def log_density(self, tangents: Float[np.ndarray, "draws 9"], soft: bool = False):
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
        law = soft_log_law if soft else log_law
        return law(self.law, q[:, 1] / self.size) - 0.5 * squares

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
    law: OffsetLaw,
    size: float,
    data: tuple[np.ndarray, np.ndarray, np.ndarray],
    start: tuple[np.ndarray, np.ndarray],
    random: np.random.Generator,
) -> Mean:
    """Posterior mean of X by adaptive importance sampling.

    Args:
        law: of the offsets.
        size: of the law, mm.
        data: poses (n, 4, 4), points (n, 2), covariances (n, 2, 2), mm.
        start: X and c near the solution.
        random: a generator.
    """
    x, c = (np.array(value) for value in start)
    sd = size * standard_deviation(law)
    whitening = np.linalg.inv(np.linalg.cholesky(data[2]))
    for _ in range(8):
        target = about(law, size, data, whitening, x, c)
        jacobian, errors = target.linear(sd)
        scale = 1 / np.linalg.norm(jacobian, axis=0)
        step = -scale * np.linalg.lstsq(jacobian * scale, errors, rcond=None)[0]
        x, c = moved(x, step[:6]), c + step[6:]
        if np.linalg.norm(jacobian @ step) < 1e-3:
            break
    target = about(law, size, data, whitening, x, c)
    scaled = target.linear(sd)[0] * scale
    root = scale[:, None] * np.linalg.inv(np.linalg.qr(scaled, mode="r"))
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
    for _ in range(MOST_BLOCKS):
        z = random.standard_normal((DRAWS, UNKNOWNS))
        z *= np.sqrt(TAIL / random.chisquare(TAIL, DRAWS))[:, None]
        proposed = 0.5 * (TAIL + UNKNOWNS) * np.log1p(np.einsum("dk,dk->d", z, z) / TAIL)
        draws.append(z)
        logs.append(target.log_density(centre + z @ root.T) + proposed)
        log_weight = np.concatenate(logs)
        weight = np.exp(log_weight - np.max(log_weight))
        weight /= np.sum(weight)
        if effective(weight) > ENOUGH:
            break
    z = np.concatenate(draws)
    middle = weight @ z
    apart = (z - middle) ** 2
    error = float(np.mean((weight**2 @ apart) / (weight @ apart)))
    mean = centre + root @ middle
    return Mean(moved(x, mean[:6]), effective(weight), error)


def about(law: OffsetLaw, size: float, data: tuple, whitening: np.ndarray, x, c) -> Target:
    """The posterior about X and c."""
    poses, points, _ = data
    turn = np.swapaxes(poses[:, :3, :3] @ x[:3, :3], 1, 2)
    in_probe = np.einsum("nji,nj->ni", poses[:, :3, :3], c - poses[:, :3, 3])
    return Target(law, size, (in_probe - x[:3, 3]) @ x[:3, :3], turn, points, whitening)


def moved(x: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """X moved by [v, omega] as the package's parameters are."""
    out = x.copy()
    out[:3, 3] += x[:3, :3] @ tangent[:3]
    out[:3, :3] = x[:3, :3] @ rotations(tangent[None, 3:])[0]
    return out


def effective(weight: np.ndarray) -> float:
    """How many independent draws weighted ones are worth."""
    return float(np.sum(weight) ** 2 / np.sum(weight**2))


def tempered(log_weight: np.ndarray, enough: float) -> tuple[np.ndarray, float]:
    """Normalised weights to the largest power up to 1 that leaves them worth ``enough`` draws."""

    def weights(power: float) -> np.ndarray:
        weight = np.exp(power * (log_weight - np.max(log_weight)))
        return weight / np.sum(weight)

    if effective(weights(1.0)) >= enough:
        return weights(1.0), 1.0
    low, high = 0.0, 1.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(weights(middle)) >= enough else (low, middle)
    return weights(low), low


@partial(jax.jit, static_argnums=(0, 1))
def draw(law: OffsetLaw, images: int, indices: Array, elevation: Array, noise: Array):
    """Experiments of one cell."""
    protocol = Protocol(images=images, elevation_distribution=law)
    protocol = replace(protocol, elevation_mm=elevation, noise_mm=noise)
    root = jax.random.key(SEED)
    return jax.vmap(lambda k: simulate(jax.random.fold_in(root, k), protocol))(indices)


@jax.jit
def precision(x: Array, experiments) -> Array:
    """Eq. 8 of every trial."""
    return jax.vmap(reconstruction_precision)(x, experiments.test_poses, experiments.test_points)


def limits(law: OffsetLaw, size: float, experiments, start, indices: Array) -> list[Mean]:
    """The limit's answer to every trial, from a nearby start (its ``image_to_probe``, ``point``)."""
    covariances = np.asarray(experiments.covariance)
    if not np.any(covariances):
        covariances = covariances + EXACT_MM**2 * np.eye(2)
    poses, points = np.asarray(experiments.poses), np.asarray(experiments.points)
    x, c = np.asarray(start.image_to_probe), np.asarray(start.point)
    return [
        posterior_mean(
            law, size, (poses[k], points[k], covariances[k]), (x[k], c[k]),
            np.random.default_rng([SEED, int(index)]),
        )
        for k, index in enumerate(indices)
    ]  # fmt: skip


def run_cell(
    law: OffsetLaw, images: int, elevation: float, noise: float, indices: Array
) -> list[object]:
    """One row of the table."""
    experiments = draw(law, images, indices, elevation, noise)
    plain = jax.vmap(lambda experiment: experiment.problem())(experiments)
    results = {
        "conventional": calibrate_batch(plain, "conventional", chunk=50),
        "gaussian": calibrate_batch(plain, "joint", "gaussian", chunk=50),
        "auto": calibrate_batch(
            replace(plain, covariance=experiments.covariance), "joint", chunk=50
        ),
    }
    found = limits(law, elevation, experiments, results["auto"], indices)
    answers = {name: result.image_to_probe for name, result in results.items()}
    answers["bayes"] = jnp.asarray(np.stack([mean.image_to_probe for mean in found]))
    rp = {name: np.asarray(precision(x, experiments)) for name, x in answers.items()}
    mean = {name: float(values.mean()) for name, values in rp.items()}
    ratio = mean["auto"] / mean["bayes"]
    half = 1.96 * (rp["auto"] - ratio * rp["bayes"]).std(ddof=1) / np.sqrt(len(indices))
    worth = [one.effective for one in found]
    return [
        law, images, elevation, noise, len(indices), *mean.values(), ratio,
        float(half / mean["bayes"]), mean["gaussian"] / mean["bayes"],
        mean["conventional"] / mean["bayes"],
        float(np.sqrt(np.mean([one.error for one in found]))),
        float(np.median(worth)), float(np.min(worth)),
    ]  # fmt: skip


def main() -> None:
    quick = arguments(__doc__ or "").quick
    trials = 50 if quick else 200
    grid = QUICK if quick else tuple(itertools.product(ELEVATIONS_MM[1:], NOISES_MM))
    cells = [(law, 50, *sizes) for law, sizes in itertools.product(LAWS, grid)]
    cells += [(law, images, *FEW_IMAGES_CELL) for images in FEW_IMAGES for law in LAWS]
    folder, rows, begun = results_folder(quick), [], time.perf_counter()
    for cell, (law, images, elevation, noise) in enumerate(cells):
        rows.append(run_cell(law, images, elevation, noise, cell * 1_000_000 + jnp.arange(trials)))
        shown = dict(zip(HEADER, rows[-1], strict=True))
        print(", ".join(
            f"{name} {value:.4g}" if isinstance(value, float) else str(value)
            for name, value in shown.items()
        ), flush=True)  # fmt: skip
        write_table(folder / "bayes_limit.csv", HEADER, rows)
    summary(rows)
    print(f"{time.perf_counter() - begun:.0f} s; {machine()}")
    plot(folder / "bayes_limit.png", rows)


def ratios(rows: list[list[object]], law: OffsetLaw | None, images: int) -> np.ndarray:
    """Columns elevation, noise, auto_over_bayes, ci95_half of the rows of a law and size."""
    picked = [row for row in rows if row[1] == images and law in (None, row[0])]
    return np.array([[row[2], row[3], row[9], row[10]] for row in picked], float)


def summary(rows: list[list[object]]) -> None:
    """Median, worst, and the cells above the bound."""
    for images in (50, *FEW_IMAGES):
        for law in (*LAWS, None):
            ratio = ratios(rows, law, images)[:, 2]
            print(f"n = {images}, {law or 'all'}: auto over the Bayes limit median "
                  f"{np.median(ratio):.3f}, worst {ratio.max():.3f}, above {BOUND} in "
                  f"{np.sum(ratio > BOUND)} of {len(ratio)} cells")  # fmt: skip
    for row in rows:
        if float(str(row[9])) > BOUND:
            print(f"  {row[0]}, n = {row[1]}, {row[2]:g} mm, noise {row[3]:g} mm: "
                  f"{row[9]:.3f} +- {row[10]:.3f}")  # fmt: skip


def plot(path: Path, rows: list[list[object]]) -> None:
    """Auto over the limit, a panel for each law at 50 images."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 8), layout="constrained")
    for panel, law in zip(figure.subplots(2, 2).ravel(), LAWS, strict=True):
        grid = np.full((len(ELEVATIONS_MM), len(NOISES_MM)), np.nan)
        for elevation, noise, ratio, _ in ratios(rows, law, 50):
            grid[ELEVATIONS_MM.index(elevation), NOISES_MM.index(noise)] = ratio
        panel.imshow(grid[1:], cmap="RdBu_r", vmin=0.6, vmax=1.4, origin="lower")
        for i, j in np.argwhere(np.isfinite(grid[1:])):
            panel.text(j, i, f"{grid[i + 1, j]:.2f}", ha="center", va="center", fontsize="small")
        panel.set_xticks(range(len(NOISES_MM)), [f"{noise:g}" for noise in NOISES_MM])
        panel.set_yticks(range(len(ELEVATIONS_MM) - 1), [f"{e:g}" for e in ELEVATIONS_MM[1:]])
        few = ", ".join(f"n = {n}: {ratios(rows, law, n)[0, 2]:.2f}" for n in FEW_IMAGES)
        panel.set(xlabel="noise on each distance, SD (mm)", ylabel="size of the offsets (mm)",
                  title=f"{law} ({few} at {FEW_IMAGES_CELL[0]:g}, {FEW_IMAGES_CELL[1]:g} mm)")  # fmt: skip
    figure.suptitle("Mean RP of prior auto over the Bayes limit's, 50 images")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120)


if __name__ == "__main__":
    main()
