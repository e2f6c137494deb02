"""Is the Bayes limit's importance sampler right? Against long random walks, once.

The same posterior means by random-walk Metropolis on the package's own residuals, which share no
code with the sampler of ``bayes_limit``: one chain a trial, steps shaped by the curvature of the
posterior with Gaussian offsets and tuned during the first fifth, which does not count. The halves
of every chain tell its own error. Two correct samplers differ by their errors together. Both begin
at the truth.

Seed 20261127; the trials are fold_in(root, condition * 10^6 + k) of ``bayes_limit``'s seed plus
10^9.
"""

from __future__ import annotations

from functools import partial

import bayes_limit
import jax
import jax.numpy as jnp
import numpy as np
from common import arguments, machine, precision, problems_of, rms, show, write_table
from jaxtyping import Array

from jaxcal.backend import RIGID, Parameters, measurement_residual, retract
from jaxcal.study.offsets import DEGREES_OF_FREEDOM, LawName, standard_deviation

SEED = 20261127
CONDITIONS: tuple[tuple[LawName, int], ...] = (
    ("uniform", 50), ("triangular", 50), ("heavy-tailed", 50), ("uniform", 12),
)  # fmt: skip
SIZE_MM, NOISE_MM = 2.0, 2.0
HEADER = [
    "elevation_distribution", "images", "trials", "steps", "accepted", "walk_error_sd",
    "sampler_error_sd", "apart_sd", "largest_apart_sd", "rp_walk_mm", "rp_sampler_mm",
]  # fmt: skip


def log_law(law: LawName, u: Array) -> Array:
    """Log density of offsets in sizes, up to a constant; -inf beyond an edge."""
    if law == "normal":
        return -0.5 * u**2
    if law == "heavy-tailed":
        nu = DEGREES_OF_FREEDOM
        return -0.5 * (nu + 1) * jnp.log1p(u**2 / (nu - 2))
    inside = jnp.abs(u) < 1
    height = jnp.where(inside, 1 - jnp.abs(u), 1.0) if law == "triangular" else jnp.ones_like(u)
    return jnp.where(inside, jnp.log(height), -jnp.inf)


def whitened(start: Parameters, tangent: Array, problem) -> tuple[Array, Array]:
    """Whitened lateral and range residuals, and the offsets in mm."""
    errors = measurement_residual(retract(start, tangent, RIGID), problem)
    # The inverse Cholesky factor of each image's 2x2 covariance.
    covariance = problem.covariance
    first = jnp.sqrt(covariance[:, 0, 0])
    mixed = covariance[:, 1, 0] / first
    second = jnp.sqrt(covariance[:, 1, 1] - mixed**2)
    lateral = errors[:, 0] / first
    distance = (errors[:, 1] - mixed * lateral) / second
    return jnp.concatenate([lateral, distance]), errors[:, 2]


@jax.jit
def shapes(starts: Parameters, problems) -> Array:
    """Jacobians of the whitened residuals with Gaussian offsets of SD one mm, of every trial."""

    def one(start: Parameters, problem) -> Array:
        residual = lambda tangent: jnp.concatenate(whitened(start, tangent, problem))  # noqa: E731
        return jax.jacfwd(residual)(jnp.zeros(9))

    return jax.vmap(one)(starts, problems)


@partial(jax.jit, static_argnums=(0, 1))
def walk(law: LawName, steps: int, starts: Parameters, origins, roots: Array, problems):
    """Means of the two halves of every chain, second moments, and the share of accepted steps."""
    burning = steps // 5
    half = (steps - burning) // 2

    @jax.vmap
    def log_posterior(start: Parameters, tangent: Array, problem) -> Array:
        errors, offsets = whitened(start, tangent, problem)
        return jnp.sum(log_law(law, offsets / SIZE_MM)) - 0.5 * jnp.sum(errors**2)

    def step(count, state):
        tangent, value, scale, total, second, accepted = state
        key = jax.random.fold_in(jax.random.key(SEED), count)
        normal = jax.random.normal(key, tangent.shape)
        proposed = tangent + scale[:, None] * jnp.einsum("tab,tb->ta", roots, normal)
        new = log_posterior(starts, proposed, problems)
        chance = jnp.exp(jnp.minimum(new - value, 0.0))
        take = jax.random.uniform(jax.random.fold_in(key, 1), chance.shape) < chance
        tangent = jnp.where(take[:, None], proposed, tangent)
        value = jnp.where(take, new, value)
        scale = scale * jnp.where(count < burning, jnp.exp(0.02 * (chance - 0.25)), 1.0)
        counts = (count >= burning).astype(value.dtype)
        part = jax.nn.one_hot((count - burning) // half, 2) * counts
        total = total + part[:, None, None] * tangent
        return tangent, value, scale, total, second + counts * tangent**2, accepted + counts * take

    zero = jnp.zeros((roots.shape[0], 9))
    value = log_posterior(starts, origins, problems)
    state = (origins, value, jnp.full(len(value), 0.4), jnp.stack([zero, zero]), zero, 0 * value)
    end = jax.lax.fori_loop(0, burning + 2 * half, step, state)
    return end[3] / half, end[4] / (2 * half), end[5] / (2 * half)


def run(condition: int, trials: int, steps: int) -> list[object]:
    """One row of the table."""
    law, images = CONDITIONS[condition]
    indices = 1_000_000_000 + condition * 1_000_000 + jnp.arange(trials)
    experiments = bayes_limit.draw(law, images, indices, SIZE_MM, NOISE_MM)
    problems = problems_of(experiments, covariances=True)
    # Both begin at the truth: a walk must, for there every offset is within the edges.
    found = bayes_limit.limits(law, SIZE_MM, experiments, experiments, indices)
    starts = jax.vmap(lambda x, c: Parameters.of(x[:3, :3], x[:3, 3], c))(
        experiments.image_to_probe, experiments.point
    )
    jacobian = np.array(shapes(starts, problems))
    jacobian[:, 2 * images :] /= SIZE_MM * standard_deviation(law)
    information = np.swapaxes(jacobian, 1, 2) @ jacobian
    roots = jnp.asarray(np.swapaxes(np.linalg.inv(np.linalg.cholesky(information)), 1, 2))
    halves, second, accepted = walk(
        law, steps, starts, jnp.zeros((trials, 9)), roots, problems
    )  # fmt: skip
    mean = halves.mean(axis=0)
    sd = np.asarray(jnp.sqrt(second - mean**2))
    walked = jax.vmap(lambda start, tangent: retract(start, tangent, RIGID).matrix())(starts, mean)
    sampled = np.stack([one.image_to_probe for one in found])
    # Where the sampler's mean lies in the walk's tangent.
    there = [tangent_of(np.asarray(x), y) for x, y in
             zip(experiments.image_to_probe, sampled, strict=True)]  # fmt: skip
    apart = (np.stack(there) - np.asarray(mean)[:, :6]) / sd[:, :6]
    own = np.asarray(halves[0] - halves[1])[:, :6] / 2 / sd[:, :6]
    tests = experiments.test_poses, experiments.test_points
    rp = [float(precision(x, *tests).mean()) for x in (walked, sampled)]
    return [
        law, images, trials, steps, float(accepted.mean()), float(rms(own)),
        float(np.sqrt(np.mean([one.error for one in found]))), float(rms(apart)),
        float(np.max(np.abs(apart))), *rp,
    ]  # fmt: skip


def tangent_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[v, omega] that moves X to Y; the turns are small, so first the skew part is enough."""
    turn = x[:3, :3].T @ y[:3, :3]
    sine = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0],
                           turn[1, 0] - turn[0, 1]])  # fmt: skip
    length = np.linalg.norm(sine)
    angle = np.arcsin(length) / length if length > 0 else 1.0
    return np.concatenate([x[:3, :3].T @ (y[:3, 3] - x[:3, 3]), angle * sine])


def main() -> None:
    quick, folder = arguments(__doc__)
    rows = []
    for condition in range(1 if quick else len(CONDITIONS)):
        rows.append(run(condition, 20, 20_000 if quick else 200_000))
        show(rows[-1])
        write_table(folder / "bayes_limit_check.csv", HEADER, rows)
    print(machine())


if __name__ == "__main__":
    main()
