"""Does an integral along the weak direction remove the steps of prior ``auto`` with 12 images?

With 12 images the restricted likelihood of X, target and three SDs can have two maxima: small
errors of the range with large offsets, or the opposite. They lie along the direction of X that the
images determine least. A solver stops at one of them, so the answer steps where that maximum
vanishes or another one attracts the start (``continuity.py`` counts such paths). Here the place
along this direction is integrated over in place of being maximised:

1. The origin is the conventional fit, moved by Gauss-Newton with SDs of 0.5, 0.5 and 2 mm; w is the
   eigenvector of its information with the least eigenvalue 1/s^2.
2. At each of 17 nodes t_k = -6 s ... 6 s along w, the other eight unknowns and the three SDs are
   those of REML (Gauss-Newton and Helmert's update by turns).
3. The nodes have the weights exp(ln Z_k) of their restricted likelihoods; the answer is the mean,
   its covariance the nodes' own plus their spread.

*Steps.* The same paths as in ``continuity.py`` (12 images, towards a mean of the offsets, and an
image that moves away), at the same 41 places, a thousandth of the path apart: all on which the
default steps by more than a tenth of an SD, and 100 others. The integral takes the offsets to be
Gaussian with mean zero; the default weighs their distributions.

*Error.* Simulated recordings with 8, 12 and 20 images: median and mean target registration error in
the middle of the image of REML's maximum (prior ``gaussian``) and of the integral.

Seed of the paths: that of ``continuity.py``. Recordings: 20261125, trial k of a condition is
fold_in(root, condition * 10^6 + k).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import continuity
import jax
import jax.numpy as jnp
import numpy as np
from common import arguments, experiments, machine, write_rows
from jaxtyping import Array, Float

from jaxcal import Problem, Protocol, calibrate_batch

SEED = 20261125
NODES, REACH = 17, 6.0
"""Number of nodes, and where the outermost are, in SDs along the weak direction."""
LONGEST_MM = 3.0
"""Longest step of a round."""
ROUNDS = 100
"""Rounds of Gauss-Newton and Helmert's update at a node."""
STARTING_SDS_MM = (0.5, 0.5, 2.0)
LEVER_MM = 50.0
"""Turns count as the arc at this distance, so that all unknowns are in mm."""
MIDDLE_MM = np.array([0.0, 0.0, 50.0])
"""Lateral, elevational, axial."""
LEAST_RATIO = 1e-3
"""Of an SD to the largest."""
AT_ONCE = 2048
"""Problems in one call."""


class Integral(NamedTuple):
    """The answer integrated along the weak direction.

    Attributes:
        image_to_probe: X of the mean.
        covariance: of the nine unknowns about the mean, in mm (turns: arcs at ``LEVER_MM``).
    """

    image_to_probe: Float[Array | np.ndarray, "*batch 4 4"]
    covariance: Float[Array | np.ndarray, "*batch 9 9"]


def turned(vector: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """Exp of a rotation vector, rad."""
    square = vector @ vector + 1e-30
    angle = jnp.sqrt(square)
    x, y, z = vector
    cross = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return (
        jnp.eye(3) + jnp.sin(angle) / angle * cross + (1 - jnp.cos(angle)) / square * cross @ cross
    )


def placed(x: Float[Array, "4 4"], step: Float[Array, " 9"]) -> Float[Array, "4 4"]:
    """X after a step of translation (probe frame), turn and target."""
    rotation = x[:3, :3] @ turned(step[3:6] / LEVER_MM)
    return x.at[:3, :3].set(rotation).at[:3, 3].add(step[:3])


def errors(
    step: Float[Array, " 9"],
    x: Float[Array, "4 4"],
    point: Float[Array, " 3"],
    poses: Float[Array, "n 4 4"],
    measured: Float[Array, "n 2"],
) -> Float[Array, "3 n"]:
    """Lateral error, range error and offset of every image, mm."""
    moved = placed(x, step)
    in_probe = jnp.einsum("nji,nj->ni", poses[:, :3, :3], point + step[6:] - poses[:, :3, 3])
    q = (in_probe - moved[:3, 3]) @ moved[:3, :3]
    return jnp.stack(
        [q[:, 0] - measured[:, 0], jnp.hypot(q[:, 1], q[:, 2]) - measured[:, 1], q[:, 1]]
    )


@jax.jit
@jax.vmap
def integrate(
    x: Float[Array, "4 4"],
    point: Float[Array, " 3"],
    poses: Float[Array, "n 4 4"],
    measured: Float[Array, "n 2"],
) -> Integral:
    """Integrate over the weak direction.

    Args:
        x: the conventional X.
        point: its target, mm.
        poses: probe to tracker, mm.
        measured: lateral position and range, mm.
    """
    at = partial(errors, x=x, point=point, poses=poses, measured=measured)
    slopes = jax.jacfwd(at)

    def sums(step: Array) -> tuple[Array, Array, Array]:
        value, slope = at(step), slopes(step)
        matrix = jnp.einsum("kni,knj->kij", slope, slope)
        return jnp.sum(value**2, axis=1), jnp.einsum("kni,kn->ki", slope, value), matrix

    given = jnp.asarray(STARTING_SDS_MM) ** -2

    def descend(_: Array, step: Array) -> Array:
        _, gradient, matrix = sums(step)
        information = jnp.tensordot(given, matrix, 1)
        return step - jnp.linalg.solve(information, given @ gradient)

    origin = jax.lax.fori_loop(0, 8, descend, jnp.zeros(9))
    value, vectors = jnp.linalg.eigh(jnp.tensordot(given, sums(origin)[2], 1))
    weak, others, sd = vectors[:, 0], vectors[:, 1:], value[0] ** -0.5

    def node(place: Array) -> tuple[Array, Array, Array]:
        def once(_: Array, state: tuple) -> tuple:
            step, log_sd = state
            weight = jnp.exp(-2 * log_sd)
            squares, gradient, matrix = sums(step)
            information = others.T @ jnp.tensordot(weight, matrix, 1) @ others
            inverse = jnp.linalg.inv(information)
            change = -others @ (inverse @ (others.T @ (weight @ gradient)))
            change = change * jnp.minimum(1.0, LONGEST_MM / jnp.linalg.norm(change))
            within = others @ inverse @ others.T
            freedom = measured.shape[0] - weight * jnp.einsum("kij,ij->k", matrix, within)
            left = (
                squares + 2 * gradient @ change + jnp.einsum("i,kij,j->k", change, matrix, change)
            )
            updated = 0.5 * jnp.log(left / jnp.maximum(freedom, 0.5))
            return step + change, jnp.maximum(updated, jnp.max(updated) + np.log(LEAST_RATIO))

        start = origin + place * sd * weak, jnp.log(jnp.asarray(STARTING_SDS_MM))
        step, log_sd = jax.lax.fori_loop(0, ROUNDS, once, start)
        weight = jnp.exp(-2 * log_sd)
        squares, _, matrix = sums(step)
        information = others.T @ jnp.tensordot(weight, matrix, 1) @ others
        evidence = (
            -measured.shape[0] * jnp.sum(log_sd)
            - 0.5 * weight @ squares
            - 0.5 * jnp.linalg.slogdet(information)[1]
        )
        return step, others @ jnp.linalg.inv(information) @ others.T, evidence

    steps, within, evidence = jax.vmap(node)(jnp.linspace(-REACH, REACH, NODES))
    good = jnp.isfinite(evidence) & jnp.isfinite(steps).all(axis=1)
    steps, within = (
        jnp.where(good[:, None], steps, 0.0),
        jnp.where(good[:, None, None], within, 0.0),
    )
    weight = jax.nn.softmax(jnp.where(good, evidence, -jnp.inf))
    mean = weight @ steps
    off = steps - mean
    covariance = jnp.einsum("k,kij->ij", weight, within + off[:, :, None] * off[:, None])
    return Integral(placed(x, mean), covariance)


def integrals(problems: Problem) -> Integral:
    """The integrals of a batch."""
    start = calibrate_batch(problems, "conventional")
    data = start.image_to_probe, start.point, problems.poses, problems.measurements
    parts = []
    for k in range(0, len(problems.mask), AT_ONCE):
        x, point, poses, measured = (jnp.asarray(part[k : k + AT_ONCE]) for part in data)
        parts.append(jax.tree.map(np.asarray, integrate(x, point, poses, measured)))
    return Integral(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def paths_row(kind: str, count: int, others: int) -> dict[str, object]:
    """Steps of the paths of one kind on which the default steps, and of some others."""
    first, second = continuity.ends(
        kind, 12, continuity.keys_of(continuity.CONDITIONS.index((kind, 12)), count)
    )
    fine = continuity.fine_places(first, second)
    default, sound = continuity.steps(continuity.on_the_way(first, second, fine), count)
    largest = np.where(sound, default.max(axis=1), 0.0)
    stepping = largest > continuity.LARGEST_STEP
    quiet = np.flatnonzero(sound & ~stepping)[:others]
    stepping = np.flatnonzero(stepping)
    chosen = np.concatenate([stepping, quiet])
    first, second = (jax.tree.map(lambda leaf: leaf[chosen], end) for end in (first, second))
    found = integrals(continuity.on_the_way(first, second, fine[chosen]))
    sd = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))[:, :6]
    sd[:, 3:] /= LEVER_MM
    x = np.asarray(found.image_to_probe)
    integral = continuity.largest_steps(x, sd, len(chosen)).max(axis=1)
    row: dict[str, object] = {"path": kind, "images": 12, "paths_converged": int(sound.sum())}
    for name, steps in (
        ("default", largest[stepping]),
        ("integral", integral[: len(stepping)]),
        ("other_default", largest[quiet]),
        ("other_integral", integral[len(stepping) :]),
    ):
        row |= {
            f"{name}_paths": len(steps),
            f"{name}_above_a_tenth": int((steps > continuity.LARGEST_STEP).sum()),
            f"{name}_largest_step_sds": float(steps.max(initial=0.0)),
        }
    return row


def error_row(condition: int, images: int, trials: int) -> dict[str, object]:
    """Errors in the middle of the image of both answers."""
    protocol = Protocol(images=images, elevation_mm=4.0, noise_mm=0.5)
    drawn = experiments(SEED, condition * 10**6 + jnp.arange(trials), protocol)
    problems = jax.jit(jax.vmap(lambda experiment: experiment.problem()))(drawn)
    row: dict[str, object] = {"images": images, "trials": trials}
    truth = np.asarray(drawn.image_to_probe)
    answers = {
        "gaussian": calibrate_batch(problems, prior="gaussian").image_to_probe,
        "integral": integrals(problems).image_to_probe,
    }
    for name, x in answers.items():
        off = np.asarray(x) - truth
        error = np.linalg.norm(off[:, :3, :3] @ MIDDLE_MM + off[:, :3, 3], axis=1)
        row |= {
            f"{name}_median_mm": float(np.median(error)),
            f"{name}_mean_mm": float(error.mean()),
        }
    return row


def main() -> None:
    quick, folder = arguments(__doc__)
    count, others, trials = (100, 3, 50) if quick else (continuity.PATHS, 100, 2000)
    for name, found in (
        ("weak_direction", (paths_row(kind, count, others) for kind in ("mean", "outlier"))),
        ("weak_direction_error", (error_row(k, n, trials) for k, n in enumerate((8, 12, 20)))),
    ):
        rows: list[dict[str, object]] = []
        for row in found:
            rows.append(row)
            print(row, flush=True)
            write_rows(folder / f"{name}.csv", rows)
    print(machine())


if __name__ == "__main__":
    main()
