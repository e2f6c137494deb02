"""How far prior ``auto`` is from the Bayes limit, the best that anybody can do on average.

The limit is told what nobody knows: the law of the offsets, its size, and the noise (with the
points' covariances). Its answer is the mean of the exact, nonlinear posterior of X and the target,
by random-walk Metropolis from the answer of ``auto``, in coordinates whitened by the curvature
there.
The two halves of each chain tell the sampling error: half the RMS distance between their means, in
posterior SDs, adds its square to the mean square error of a posterior mean (0.1 is half a per cent
of RP).

Seed 20261126; trial k of a cell is fold_in(root, cell * 10^6 + k).
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common import arguments, machine, results_folder, write_table
from jaxtyping import Array

from jaxcal import Protocol, calibrate_batch, reconstruction_precision, simulate
from jaxcal.io.atomic import atomic_path
from jaxcal.model.parameters import RIGID, Parameters, retract
from jaxcal.model.priors import whiten
from jaxcal.model.residuals import measurement_residual
from jaxcal.offsets import DEGREES_OF_FREEDOM, OffsetLaw
from jaxcal.problem import Problem

SEED = 20261126
LAWS: tuple[OffsetLaw, ...] = ("uniform", "normal", "heavy-tailed", "triangular")
CELLS = ((0.5, 0.5), (1.0, 2.0), (2.0, 0.5), (3.0, 6.0), (5.0, 2.0), (5.0, 10.0))
STEPS = 8000
STEEPNESS = 2000.0
HEADER = [
    "elevation_distribution", "elevation_mm", "noise_mm", "trials", "rp_conventional_mm",
    "rp_gaussian_mm", "rp_auto_mm", "rp_bayes_mm", "auto_over_bayes", "gaussian_over_bayes",
    "accepted", "sampling_error_sd",
]  # fmt: skip


@partial(jax.jit, static_argnums=0)
def draw(law: OffsetLaw, indices: Array, elevation: Array, noise: Array):
    """Experiments of one cell."""
    protocol = Protocol(elevation_distribution=law)
    protocol = replace(protocol, elevation_mm=elevation, noise_mm=noise)
    root = jax.random.key(SEED)
    return jax.vmap(lambda k: simulate(jax.random.fold_in(root, k), protocol))(indices)


def log_density(law: OffsetLaw, u: Array) -> Array:
    """Of the offsets of size one, up to a constant; beyond an edge it falls within a thousandth."""
    if law == "normal":
        return -0.5 * u**2
    if law == "heavy-tailed":
        nu = DEGREES_OF_FREEDOM
        return -0.5 * (nu + 1) * jnp.log1p(u**2 / (nu - 2))
    beyond = -STEEPNESS * jnp.maximum(jnp.abs(u) - 1, 0.0)
    if law == "uniform":
        return beyond
    return jnp.log(jnp.maximum(1 - jnp.abs(u), 1e-4)) + beyond


@partial(jax.jit, static_argnums=(0, 1))
def posterior_means(
    law: OffsetLaw, steps: int, problems: Problem, begun, elevation: Array, keys: Array
) -> tuple[Array, Array, Array]:
    """Posterior mean of X, share of accepted steps, and the halves' distance in SDs."""

    def trial(arguments) -> tuple[Array, Array, Array]:
        problem, x, point, key = arguments
        start = Parameters.of(x[:3, :3], x[:3, 3], point)

        def log_posterior(tangent: Array) -> Array:
            errors = measurement_residual(retract(start, tangent, RIGID), problem)
            whitened = whiten(errors, problem.covariance)
            offsets = log_density(law, errors[:, 2] / elevation)
            return jnp.sum(offsets) - 0.5 * jnp.sum(whitened[:, :2] ** 2)

        # The curvature of the posterior with a Gaussian law: right in shape for a random walk.
        def residual(tangent: Array) -> Array:
            errors = measurement_residual(retract(start, tangent, RIGID), problem)
            whitened = whiten(errors, problem.covariance)
            return whitened.at[:, 2].set(errors[:, 2] / (0.5 * elevation)).ravel()

        jacobian = jax.jacfwd(residual)(jnp.zeros(9))
        information = jacobian.T @ jacobian
        root = square_root_of_inverse(information)

        def step(state, key):
            tangent, value, accepted, scale, count, total, second = state
            normal_key, uniform_key = jax.random.split(key)
            proposed = tangent + scale * root @ jax.random.normal(normal_key, (9,))
            new = log_posterior(proposed)
            chance = jnp.exp(jnp.minimum(new - value, 0.0))
            take = jax.random.uniform(uniform_key) < chance
            tangent = jnp.where(take, proposed, tangent)
            value = jnp.where(take, new, value)
            # The first quarter tunes the step to a quarter of acceptances, and does not count.
            burning = count < steps // 4
            scale = scale * jnp.where(burning, jnp.exp(0.05 * (chance - 0.25)), 1.0)
            half = jnp.where(count < steps // 4 + 3 * steps // 8, 0, 1)
            keep = jnp.where(burning, 0.0, 1.0) * jax.nn.one_hot(half, 2)
            total = total + keep[:, None] * tangent
            second = second + jnp.where(burning, 0.0, 1.0) * tangent**2
            accepted = accepted + jnp.where(burning, 0.0, take)
            return (tangent, value, accepted, scale, count + 1, total, second), None

        zero = jnp.zeros(9)
        state = (zero, log_posterior(zero), jnp.zeros(()), jnp.asarray(0.5), 0,
                 jnp.zeros((2, 9)), zero)  # fmt: skip
        end = jax.lax.scan(step, state, jax.random.split(key, steps))[0]
        counted = 3 * steps // 4
        halves = end[5] / (counted / 2)
        mean = halves.mean(axis=0)
        sd = jnp.sqrt(end[6] / counted - mean**2)
        apart = jnp.sqrt(jnp.mean(((halves[0] - halves[1]) / sd) ** 2)) / 2
        return retract(start, mean, RIGID).matrix(), end[2] / counted, apart

    batch = (problems, begun.image_to_probe, begun.point, keys)
    return jax.lax.map(trial, batch, batch_size=50)


def square_root_of_inverse(matrix: Array) -> Array:
    """A with A A' = matrix^-1, by plain array operations."""
    size = matrix.shape[0]
    scale = 1 / jnp.sqrt(jnp.diagonal(matrix))
    work = matrix * scale[:, None] * scale[None, :]
    lower = jnp.zeros_like(work)
    for k in range(size):
        column = work[:, k] / jnp.sqrt(work[k, k])
        column = jnp.where(jnp.arange(size) >= k, column, 0.0)
        lower = lower.at[:, k].set(column)
        work = work - column[:, None] * column[None, :]
    inverse = jnp.eye(size)
    for k in range(size):
        row = inverse[k] / lower[k, k]
        inverse = inverse.at[k].set(row)
        below = jnp.where(jnp.arange(size) > k, lower[:, k], 0.0)
        inverse = inverse - below[:, None] * row[None, :]
    return scale[:, None] * inverse.T


def run_cell(
    law: OffsetLaw, elevation: float, noise: float, cell: int, trials: int, steps: int
) -> list[object]:
    """One row of the table."""
    indices = cell * 1_000_000 + jnp.arange(trials)
    experiments = draw(law, indices, elevation, noise)
    plain = jax.vmap(lambda experiment: experiment.problem())(experiments)
    problems = replace(plain, covariance=experiments.covariance)
    results = {
        "conventional": calibrate_batch(plain, "conventional", chunk=50),
        "gaussian": calibrate_batch(problems, "joint", "gaussian", chunk=50),
        "auto": calibrate_batch(problems, "joint", chunk=50),
    }
    keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(SEED + 1)))(indices)
    x, accepted, apart = posterior_means(
        law, steps, problems, results["auto"], jnp.asarray(elevation), keys
    )
    precision = jax.vmap(reconstruction_precision)
    answers = {name: result.image_to_probe for name, result in results.items()} | {"bayes": x}
    mean = {
        name: float(precision(answer, experiments.test_poses, experiments.test_points).mean())
        for name, answer in answers.items()
    }
    row = [law, elevation, noise, trials, *mean.values(), mean["auto"] / mean["bayes"],
           mean["gaussian"] / mean["bayes"], float(accepted.mean()),
           float(jnp.sqrt(jnp.mean(apart**2)))]  # fmt: skip
    print(f"{law} {elevation:g} mm, noise {noise:g} mm: " + ", ".join(
        f"{name} {value:.4f}" for name, value in mean.items()
    ) + f" mm; auto over the limit {row[8]:.3f}, REML {row[9]:.3f}; accepted {row[10]:.2f}, "
          f"sampling error {row[11]:.3f} SD", flush=True)  # fmt: skip
    return row


def main() -> None:
    quick = arguments(__doc__ or "").quick
    trials, steps = (50, 4000) if quick else (200, STEPS)
    cells = list(itertools.product(LAWS, CELLS[1:3] if quick else CELLS))
    folder, rows = results_folder(quick), []
    for cell, (law, (elevation, noise)) in enumerate(cells):
        rows.append(run_cell(law, elevation, noise, cell, trials, steps))
        write_table(folder / "bayes_limit.csv", HEADER, rows)
    ratio = np.array([float(str(row[8])) for row in rows])
    print(f"auto over the Bayes limit: median {np.median(ratio):.3f}, worst {ratio.max():.3f}; "
          f"{machine()}")  # fmt: skip
    plot(folder / "bayes_limit.png", rows)


def plot(path: Path, rows: list[list[object]]) -> None:
    """RP over the limit, law by law."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    axes = figure.subplots()
    for k, (name, column) in enumerate(
        {"auto": 8, "gaussian (REML)": 9, "conventional": 4}.items()
    ):
        limit = np.array([float(str(row[7])) for row in rows])
        values = np.array([float(str(row[column])) for row in rows])
        axes.plot(values if column > 7 else values / limit, "os^"[k], label=name)
    axes.axhline(1, color="black", linewidth=0.8)
    axes.set(yscale="log", ylabel="mean RP over the Bayes limit")
    axes.set_yticks([1, 1.2, 1.5, 2, 3, 5], ["1", "1.2", "1.5", "2", "3", "5"])
    axes.minorticks_off()
    axes.set_xticks(
        range(len(rows)), [f"{row[0]}\n{row[1]:g}, {row[2]:g}" for row in rows], fontsize=6
    )
    axes.legend()
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=130)


if __name__ == "__main__":
    main()
