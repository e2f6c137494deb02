"""One trial of a study in numpy and scipy.optimize.least_squares: the peer of study_throughput.

The same protocol, objectives, starts and stopping rules as :mod:`jaxcal.study`, trial by trial, as
they are written where there is no batch: arrays over the images of a trial are vectorised, BLAS has
one thread. Three styles:

``best``: distances of all images by one vectorised Gauss-Newton iteration (the study's own five
steps); least_squares by MINPACK's Levenberg-Marquardt with the exact Jacobian, to tolerances of
1e-10, where the study's own solves stop.
``usual``: the same distance fit; least_squares as most people call it, with scipy's defaults (trust
region, Jacobian by differences, tolerances of 1e-8).
``plain``: the same, and least_squares for every image's distances, too.

In all, the alternation is numpy with the exact Jacobian (its rounds are two Gauss-Newton steps by
definition), and the variance components are updated by the same REML formula to the same change of
1e-9. Observability and status, which a study also stores, are not computed here.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares

ELEMENTS = (np.arange(128) - 63.5) * 0.45703125
"""Lateral positions of the L14-5's elements, mm."""

STAGES = ("draws", "distance fit", "conventional", "alternating", "joint self-tuned", "metric")
METHODS = ("conventional", "alternating", "joint self-tuned")
STYLES = ("best", "usual", "plain")

MAX_ROUNDS, TURN_RAD, MOVE_MM = 1000, 1e-3, 0.1
SD_CHANGE, SD_ROUNDS, SD_FLOOR = 1e-9, 60, 1e-3


@dataclass(frozen=True)
class Drawn:
    """What one experiment measures, and what is true; mm."""

    poses: np.ndarray
    distances: np.ndarray
    image_to_probe: np.ndarray
    point: np.ndarray
    test_poses: np.ndarray
    test_points: np.ndarray


@dataclass(frozen=True)
class Solution:
    """X = (rotation, translation) and the target."""

    rotation: np.ndarray
    translation: np.ndarray
    point: np.ndarray


# --- draws


def rotations(vectors: np.ndarray) -> np.ndarray:
    """Rodrigues' formula: (n, 3) rotation vectors to (n, 3, 3)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    cross = _cross(vectors)
    safe = np.where(angle > 1e-12, angle, 1.0)
    square = np.where(angle > 1e-6, 2 * (np.sin(angle / 2) / safe) ** 2, 0.5)
    return (
        np.eye(3)
        + np.where(angle > 1e-12, np.sin(angle) / safe, 1.0) * cross
        + square * (cross @ cross)
    )


def _cross(vectors: np.ndarray) -> np.ndarray:
    matrix = np.zeros((len(vectors), 3, 3))
    matrix[:, [2, 0, 1], [1, 2, 0]] = vectors
    matrix[:, [1, 2, 0], [2, 0, 1]] = -vectors
    return matrix


def _random_rotations(generator: np.random.Generator, count: int, largest: float) -> np.ndarray:
    axes = generator.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    return rotations(generator.uniform(0, largest, (count, 1)) * axes)


def draw(
    generator: np.random.Generator, elevation_mm: float, noise_mm: float, images: int = 50
) -> Drawn:
    """One experiment of the default protocol (:class:`jaxcal.study.simulation.Protocol`)."""
    half, middle = np.array([29.25, 40.0]), np.array([0.0, 50.0])
    truth = np.eye(4)
    truth[:3, :3] = _random_rotations(generator, 1, np.pi)[0]
    truth[:3, 3] = 50 * generator.normal(size=3)
    point = 100 * generator.normal(size=3)

    def poses(in_image: np.ndarray) -> np.ndarray:
        turned = _random_rotations(generator, len(in_image), np.radians(30.0))
        in_probe = in_image @ truth[:3, :3].T + truth[:3, 3]
        matrices = np.zeros((len(in_image), 4, 4))
        matrices[:, :3, :3] = turned
        matrices[:, :3, 3] = point - (turned @ in_probe[..., None])[..., 0]
        matrices[:, 3, 3] = 1
        return matrices

    lateral, depth = (middle + half * generator.uniform(-1, 1, (images, 2))).T
    elevation = elevation_mm * generator.uniform(-1, 1, images)
    tracked = poses(np.stack([lateral, elevation, depth], 1))
    exact = np.hypot(lateral[:, None] - ELEMENTS, np.hypot(elevation, depth)[:, None])
    distances = exact + noise_mm * generator.normal(size=exact.shape)
    test = middle + 0.75 * half * generator.uniform(-1, 1, (images, 2))
    flat = np.stack([test[:, 0], np.zeros(images), test[:, 1]], 1)
    return Drawn(tracked, distances, truth, point, poses(flat), test)


# --- distances to points


def fit_distances(distances: np.ndarray, *, best: bool) -> np.ndarray:
    """(n, 2) lateral position and range by least squares on Eq. 5, mm."""
    # Elements are centred: slope and mean of the straight line d^2 - e^2 over them.
    square = distances**2 - ELEMENTS**2
    x = -0.5 * (square @ ELEMENTS) / (ELEMENTS @ ELEMENTS)
    r2 = square.mean(axis=1) - x**2
    r = np.sqrt(np.where(r2 > 1e-6, r2, distances.min(axis=1) ** 2 + 1e-6))
    if not best:

        def one(row: np.ndarray, *start: float) -> np.ndarray:
            return least_squares(lambda p: np.hypot(p[0] - ELEMENTS, p[1]) - row, start).x

        return np.array([one(row, *start) for row, *start in zip(distances, x, r, strict=True)])
    for _ in range(5):
        along = x[:, None] - ELEMENTS
        model = np.sqrt(along**2 + (r**2)[:, None])
        jx, jr, residual = along / model, r[:, None] / model, distances - model
        a, b, c = (np.einsum("ij,ij->i", *pair) for pair in ((jx, jx), (jx, jr), (jr, jr)))
        gx, gr = np.einsum("ij,ij->i", jx, residual), np.einsum("ij,ij->i", jr, residual)
        determinant = a * c - b * b
        dx, dr = (c * gx - b * gr) / determinant, (a * gr - b * gx) / determinant
        x, r = x + np.clip(dx, -r, r), np.maximum(r + np.clip(dr, -0.5 * r, r), 1e-3)
    return np.stack([x, r], axis=1)


# --- the model: q_i = X^-1 B_i^-1 c and its derivatives


class Model:
    """q_i as a function of nine unknowns: X's turn about a reference, X's origin, the target."""

    def __init__(self, poses: np.ndarray, points: np.ndarray) -> None:
        self.inverse = np.ascontiguousarray(poses[:, :3, :3].swapaxes(1, 2))
        self.origin = (self.inverse @ poses[:, :3, 3:])[..., 0]
        self.points, self.poses, self.count = points, poses, len(poses)

    def target(self, u: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The points q (n, 3) and X's rotation."""
        rotation = reference @ rotations(u[None, :3])[0] if u[:3].any() else reference
        in_probe = (self.inverse.reshape(-1, 3) @ u[6:]).reshape(-1, 3) - self.origin
        return (in_probe - u[3:6]) @ rotation, rotation

    def derivative(self, u: np.ndarray, q: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """dq/du, (n, 3, 9)."""
        jacobian = np.empty((self.count, 3, 9))
        turn = _cross(q)
        if u[:3].any():
            angle, cross = np.linalg.norm(u[:3]), _cross(u[None, :3])[0]
            # Exp(w + dw) = Exp(w) Exp(J dw), J the right Jacobian of SO(3).
            right = np.eye(3) - 2 * (np.sin(angle / 2) / angle) ** 2 * cross
            if angle > 1e-4:
                right += (angle - np.sin(angle)) / angle**3 * cross @ cross
            turn = turn @ right
        jacobian[:, :, :3] = turn
        jacobian[:, :, 3:6] = -rotation.T
        jacobian[:, :, 6:] = rotation.T @ self.inverse
        return jacobian


def circle_points(points: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """p_i(y_i) of Eq. 5."""
    axial = np.sqrt(points[:, 1] ** 2 - elevation**2)
    return np.stack([points[:, 0], elevation, axial], axis=1)


def _minimise(residual: Callable, jacobian: Callable, start: np.ndarray, best: bool) -> np.ndarray:
    if not best:
        return least_squares(residual, start).x
    # As exactly as the study solves: its scaled gradients end below 1e-10.
    options: dict[str, Any] = {"method": "lm", "x_scale": "jac", "jac": jacobian}
    options |= dict.fromkeys(("ftol", "xtol", "gtol"), 1e-10)
    return least_squares(residual, start, **options).x


def _as_vector(solution: Solution) -> np.ndarray:
    return np.concatenate([np.zeros(3), solution.translation, solution.point])


# --- the three methods


def closed_form(model: Model) -> Solution:
    """The linear start (12 unknowns), projected to a rotation."""
    turned, points = model.poses[:, :3, :3], model.points
    deviation = points - points.mean(axis=0)
    eye = np.broadcast_to(np.eye(3), turned.shape)
    parts = [deviation[:, :1, None] * turned, deviation[:, 1:, None] * turned, turned, -eye]
    translations = model.poses[:, :3, 3]
    centre = translations.mean(axis=0)
    rhs = (centre - translations).ravel()
    solution = np.linalg.lstsq(np.concatenate(parts, axis=2).reshape(-1, 12), rhs)[0]
    a, b = (column / np.linalg.norm(column) for column in solution[:6].reshape(2, 3))
    plus, minus = a + b, a - b
    plus, minus = plus / np.linalg.norm(plus), minus / np.linalg.norm(minus)
    lateral, axial = (plus + minus) / np.sqrt(2), (plus - minus) / np.sqrt(2)
    known = points[:, :1] * (turned @ lateral) + points[:, 1:] * (turned @ axial)
    rows = np.concatenate([turned, -eye], axis=2).reshape(-1, 6)
    rest = np.linalg.lstsq(rows, rhs - known.ravel())[0]
    rotation = np.stack([lateral, np.cross(axial, lateral), axial], axis=1)
    return Solution(rotation, rest[:3], rest[3:] + centre)


def conventional(model: Model, *, best: bool) -> Solution:
    """Eq. 7 from the closed-form start."""
    start = closed_form(model)
    flat = circle_points(model.points, np.zeros(model.count))

    def residual(u: np.ndarray) -> np.ndarray:
        return (model.target(u, start.rotation)[0] - flat).ravel()

    def jacobian(u: np.ndarray) -> np.ndarray:
        return model.derivative(u, *model.target(u, start.rotation)).reshape(-1, 9)

    u = _minimise(residual, jacobian, _as_vector(start), best)
    return Solution(model.target(u, start.rotation)[1], u[3:6], u[6:])


def alternating(model: Model, start: Solution, bound: float = 1.0) -> Solution:
    """The paper's Fig. 4: closest points on the arcs, then two Gauss-Newton steps, and again."""
    now, distance = start, model.points[:, 1]
    limit = np.minimum(bound, 0.95 * np.abs(distance))
    for _ in range(MAX_ROUNDS):
        before = now
        q, _ = model.target(_as_vector(now), now.rotation)
        free = distance * q[:, 1] / np.hypot(q[:, 1], q[:, 2])
        free = np.where(q[:, 2] > 0, free, np.where(q[:, 1] < 0, -limit, limit))
        held = circle_points(model.points, np.clip(free, -limit, limit))
        for _ in range(2):
            u = _as_vector(now)
            q, rotation = model.target(u, now.rotation)
            jacobian = model.derivative(u, q, rotation).reshape(-1, 9)
            step = np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ (held - q).ravel())
            turned = rotation @ rotations(step[None, :3])[0]
            now = Solution(turned, u[3:6] + step[3:6], u[6:] + step[6:])
        chord = np.linalg.norm(before.rotation - now.rotation)
        turn = 2 * np.arcsin(min(chord / np.sqrt(8), 1.0))
        if turn < TURN_RAD and np.linalg.norm(before.translation - now.translation) < MOVE_MM:
            break
    return now


def self_tuned(model: Model, start: Solution, *, best: bool) -> tuple[Solution, np.ndarray]:
    """Weighted solves and REML updates of the three SDs until these stand still."""
    now, points = start, model.points

    def errors(u: np.ndarray, reference: np.ndarray) -> np.ndarray:
        q, _ = model.target(u, reference)
        far = np.hypot(q[:, 1], q[:, 2])
        return np.stack([q[:, 0] - points[:, 0], far - points[:, 1], q[:, 1]], axis=1)

    def slopes(u: np.ndarray, reference: np.ndarray) -> np.ndarray:
        q, rotation = model.target(u, reference)
        jacobian = model.derivative(u, q, rotation)
        far = np.hypot(q[:, 1], q[:, 2])
        weighted = q[:, 1, None] * jacobian[:, 1] + q[:, 2, None] * jacobian[:, 2]
        return np.stack([jacobian[:, 0], weighted / far[:, None], jacobian[:, 1]], axis=1)

    def floored(sigma: np.ndarray) -> np.ndarray:
        return np.maximum(sigma, max(SD_FLOOR * sigma.max(), 1e-6))

    sigma = floored(np.sqrt(np.mean(errors(_as_vector(now), now.rotation) ** 2, axis=0)))
    for _ in range(SD_ROUNDS):
        weight, reference = 1 / sigma, now.rotation
        u = _minimise(
            lambda u, w=weight, r=reference: (errors(u, r) * w).ravel(),
            lambda u, w=weight, r=reference: (slopes(u, r) * w[:, None]).reshape(-1, 9),
            _as_vector(now),
            best,
        )
        jacobian = (slopes(u, reference) * weight[:, None]).reshape(-1, 9)
        orthonormal = np.linalg.qr(jacobian)[0]
        leverage = (orthonormal**2).sum(axis=1).reshape(-1, 3).sum(axis=0)
        freedom = np.maximum(model.count - leverage, 0.05 * model.count)
        updated = floored(np.sqrt((errors(u, reference) ** 2).sum(axis=0) / freedom))
        now = Solution(model.target(u, reference)[1], u[3:6], u[6:])
        change = np.abs(np.log(updated / sigma)).max()
        sigma = updated
        if change <= SD_CHANGE:
            break
    return now, sigma


# --- all of it


def measure(found: Solution, drawn: Drawn) -> tuple[float, float, float, float]:
    """Reconstruction precision (Eq. 8), errors of rotation (rad), origin and target (mm)."""
    flat = circle_points(drawn.test_points, np.zeros(len(drawn.test_points)))
    in_probe = flat @ found.rotation.T + found.translation
    cloud = (drawn.test_poses[:, :3, :3] @ in_probe[..., None])[..., 0] + drawn.test_poses[:, :3, 3]
    precision = np.sqrt(cloud.var(axis=0, ddof=1).sum())
    chord = np.linalg.norm(found.rotation - drawn.image_to_probe[:3, :3])
    return (
        float(precision),
        float(2 * np.arcsin(min(chord / np.sqrt(8), 1.0))),
        float(np.linalg.norm(found.translation - drawn.image_to_probe[:3, 3])),
        float(np.linalg.norm(found.point - drawn.point)),
    )


def analyse(
    drawn: Drawn, *, style: str, clock: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Everything after the draws.

    Args:
        drawn: one experiment.
        style: one of :data:`STYLES`.
        clock: (stages,) CPU seconds to add to.

    Returns:
        (methods, 4) of :func:`measure`, and the self-tuned SDs, mm.
    """
    best = style == "best"
    times = [time.process_time()]
    points = fit_distances(drawn.distances, best=style != "plain")
    times.append(time.process_time())
    model = Model(drawn.poses, points)
    flat = conventional(model, best=best)
    times.append(time.process_time())
    arcs = alternating(model, flat)
    times.append(time.process_time())
    tuned, sigma = self_tuned(model, flat, best=best)
    times.append(time.process_time())
    measured = np.array([measure(found, drawn) for found in (flat, arcs, tuned)])
    times.append(time.process_time())
    if clock is not None:
        clock[1:] += np.diff(times)
    return measured, sigma


def run(
    seed: tuple[int, ...], trials: int, conditions: tuple[tuple[float, float], ...], style: str
) -> tuple[np.ndarray, np.ndarray, float]:
    """A worker's share: ``trials`` of each (elevation, noise) condition.

    Returns:
        (conditions, trials, methods) RP in mm, (stages,) CPU seconds, and the CPU seconds of all.
    """
    begun = time.process_time()
    generator = np.random.default_rng(seed)
    clock, precision = np.zeros(len(STAGES)), []
    for elevation, noise in conditions:
        for _ in range(trials):
            began = time.process_time()
            drawn = draw(generator, elevation, noise)
            clock[0] += time.process_time() - began
            precision.append(analyse(drawn, style=style, clock=clock)[0][:, 0])
    precision = np.array(precision).reshape(len(conditions), trials, len(METHODS))
    return precision, clock, time.process_time() - begun
