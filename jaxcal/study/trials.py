"""The trials of a study: simulated and solved in batches, as far as their results are stored.

A study keeps X's errors, SDs, status and iterations of millions of solves. Here experiments stay in
the form of :mod:`jaxcal.model.batch`, planes of numbers with the images as the last axis. The
conventional fit is made once for all methods, and of each calibration only what is stored is
computed.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from jaxcal.calibration.calibrate import Request, prepare
from jaxcal.calibration.pipeline import solve_problems
from jaxcal.data.geometry import chord_angle
from jaxcal.data.problem import Problem
from jaxcal.data.segmentation.deviations import fit_deviations
from jaxcal.model import unrolled
from jaxcal.model.batch import ImagePlanes, Iterate, targets, total
from jaxcal.model.unknowns import RIGID
from jaxcal.solvers.names import Method, PriorName
from jaxcal.solvers.plan import Options
from jaxcal.solvers.start import ConventionalStart
from jaxcal.study.simulation import Protocol, arrange, draw, draw_noise

Kind = tuple[Method, PriorName]
"""A method and its prior."""

SEGMENTED = 16
"""Trials whose distances are fitted side by side."""


class TrialResults(eqx.Module):
    """What one method makes of a batch of experiments.

    Attributes:
        rp: point reconstruction precision on the test images (Eq. 8), mm.
        rotation_error: angle between X and the truth, rad.
        translation_error: distance between their origins, mm.
        point_error: distance of the target from the truth, mm.
        sigma: estimated SDs of lateral position, range and elevational offset, mm.
        status: a :class:`jaxcal.Status`.
        iterations: linearisations or rounds.
    """

    rp: Float[Array, " trials"]
    rotation_error: Float[Array, " trials"]
    translation_error: Float[Array, " trials"]
    point_error: Float[Array, " trials"]
    sigma: Float[Array, "trials 3"]
    status: Int[Array, " trials"]
    iterations: Int[Array, " trials"]


class Experiments(eqx.Module):
    """A batch of experiments in planes.

    Attributes:
        images: what is measured.
        test: poses and exact points of the test images.
    """

    images: ImagePlanes
    test: ImagePlanes


def experiments(
    keys: Key[Array, " trials"], protocol: Protocol
) -> tuple[Experiments, Iterate, Float[Array, "trials 3"]]:
    """Simulate a batch: its experiments, their truth, and the errors in them.

    The experiments are those of :func:`jaxcal.study.simulation.simulate`. The errors are root mean
    squares of the lateral, range and elevational errors of each trial, mm, including those that a
    tracker makes. Self-tuned SDs estimate them.
    """
    one = jax.vmap(lambda key: arrange(draw(key, protocol), protocol))(keys)
    elements = protocol.probe.element_lateral()
    size = jnp.asarray(protocol.noise_mm, one.exact.dtype)

    def segmented(group: tuple) -> tuple[Array, Array]:
        keys, exact = group
        noise = jax.vmap(lambda key: draw_noise(key, protocol))(keys)
        return fit_deviations(noise, size, exact[:, 0], exact[:, 1], elements)

    # A group is so small that its noise stays in the second-level cache until it is fitted.
    points = jax.lax.map(segmented, (_grouped(keys), _grouped(one.exact)))
    lateral, distance = (value.reshape(len(keys), -1) for value in points)
    images = _images(one.rotation, one.origin, lateral, distance)
    test = _images(one.test_rotation, one.test_origin, one.test_point[:, 0], one.test_point[:, 1])
    truth = Iterate(
        jnp.moveaxis(one.true_rotation, 0, -1),
        one.true_translation.T,
        one.target.T,
        jnp.zeros((0, len(keys)), one.target.dtype),
        RIGID,
    )
    return Experiments(images, test), truth, jnp.sqrt(_mean_squares(truth, images)).T


def _grouped(values: Array) -> Array:
    trials = len(values)
    group = SEGMENTED if trials % SEGMENTED == 0 else trials
    return values.reshape(-1, group, *values.shape[1:])


def _images(rotation: Array, origin: Array, lateral: Array, distance: Array) -> ImagePlanes:
    return ImagePlanes(
        rotation=jnp.moveaxis(rotation, 1, 0),
        origin=jnp.moveaxis(origin, 1, 0),
        lateral=lateral,
        axial=distance,
        face=jnp.zeros(len(lateral)),
        mask=jnp.ones_like(lateral),
    )


def problems_of(images: ImagePlanes) -> Problem:
    """The images as problems with a leading axis; arrays that are not read are not computed."""
    trials, count = images.mask.shape
    rotation = jnp.moveaxis(images.rotation, 0, -1).reshape(trials, count, 3, 3)
    top = jnp.concatenate([rotation, jnp.moveaxis(images.origin, 0, -1)[..., None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 0.0, 1.0]), (trials, count, 1, 4))
    return Problem(
        poses=jnp.concatenate([top, bottom], axis=-2),
        measurements=jnp.stack([images.lateral, images.distance], axis=-1),
        mask=images.mask,
        spacing=jnp.ones((trials, 2)),
        face_offset=jnp.zeros(trials),
    )


def solve(
    kind: Kind,
    options: Options,
    batch: Experiments,
    truth: Iterate,
    begun: ConventionalStart,
    bound: Array | None,
) -> TrialResults:
    """One method on a batch.

    Args:
        kind: the method.
        options: its options.
        batch: the experiments.
        truth: that of the experiments.
        begun: their conventional fits.
        bound: on the offsets, mm, for methods that take one.
    """
    images = batch.images
    problems = problems_of(images)
    options = replace(options, differentiate=False)
    request = Request(*kind, max_elevation=bound, options=options)
    problems, plan, given = prepare(problems, request)
    # Parts of the calibration that are not used are not computed.
    found = solve_problems(problems, given, plan, begun=begun)
    matrix = jnp.asarray(found.image_to_probe)
    iterate = Iterate(
        jnp.moveaxis(matrix[:, :3, :3], 0, -1),
        matrix[:, :3, 3].T,
        jnp.asarray(found.point).T,
        truth.further_values,
        truth.blocks,
    )
    return TrialResults(
        rp=_precision(iterate, truth, batch.test),
        rotation_error=chord_angle(iterate.rotation - truth.rotation),
        translation_error=jnp.linalg.norm(iterate.translation - truth.translation, axis=0),
        point_error=jnp.linalg.norm(iterate.point - truth.point, axis=0),
        sigma=jnp.asarray(found.sigma),
        status=jnp.asarray(found.status_code, jnp.int8),
        iterations=jnp.asarray(found.convergence.iterations, jnp.int32),
    )


def _mean_squares(iterate: Iterate, images: ImagePlanes) -> Float[Array, "3 batch"]:
    """Mean squares of lateral error, range error and elevational offset at an estimate, mm^2."""
    q, _ = targets(iterate, images)
    far = jnp.sqrt(q[1] * q[1] + q[2] * q[2])
    errors = [q[0] - images.lateral, far - images.distance, q[1]]
    return jnp.stack(total([images.mask * error * error for error in errors])) / images.used


def _precision(iterate: Iterate, truth: Iterate, test: ImagePlanes) -> Float[Array, " batch"]:
    """Eq. 8, as :func:`jaxcal.diagnostics.metrics.reconstruction_precision`, mm.

    Reconstructed points are taken relative to the true target. They are near it, so that one pass
    gives their mean and spread without loss of digits.
    """
    rows = [[entry[:, None] for entry in row] for row in iterate.rotation]
    flat = [test.lateral, 0, test.distance]
    in_probe = [
        value + origin[:, None]
        for value, origin in zip(unrolled.apply(rows, flat), iterate.translation, strict=True)
    ]
    poses = [[test.rotation[3 * i + j] for j in range(3)] for i in range(3)]
    away = [
        value + (test.origin[k] - truth.point[k][:, None])
        for k, value in enumerate(unrolled.apply(poses, in_probe))
    ]
    *sums, square = total([*away, away[0] ** 2 + away[1] ** 2 + away[2] ** 2])
    spread = square - sum(value * value for value in sums) / test.used
    return jnp.sqrt(jnp.maximum(spread, 0.0) / (test.used - 1))
