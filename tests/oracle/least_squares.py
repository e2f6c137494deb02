"""Dense nonlinear least squares to the last digit, and the objectives that are such.

:func:`minimise` descends by scipy's trust region and ends with Newton's method on the exact
gradient, with second derivatives from its differences. The objectives:

- conventional: sum |q - p(0)|^2;
- joint, offsets eliminated: (lateral / s1)^2 + (range / s2)^2 + (q_y / s3)^2, the first two
  decorrelated where an image has a covariance of its own;
- joint, explicit: with an offset y_i of the target and a tracker error of SD tau on each axis, the
  squares of (q_x - x) / hypot(s1, tau), (hypot(y, q_z) - r) / hypot(s2, tau), (y - q_y) / tau and
  y / s3 (as tau goes to zero y becomes q_y, and the eliminated form is left); the first two are
  decorrelated by an image's own covariance plus tau^2 I, if it has one;
- bounded: sum |q - p(y)|^2 with |y_i| <= m_i: a minimum has vanishing derivatives by everything
  that is free, and by an offset on its bound one that pushes it outwards (KKT).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from oracle.model import (
    Data,
    Unknowns,
    channels,
    circle,
    errors,
    jacobian,
    linear_start,
    points,
    size,
    target,
)

Residual = Callable[[Unknowns], np.ndarray]


@dataclass(frozen=True)
class Fit:
    """A minimum: unknowns, cost (sum of squares), Jacobian and residuals there."""

    unknowns: Unknowns
    cost: float
    jacobian: np.ndarray
    residual: np.ndarray


def minimise(
    residual: Residual, start: Unknowns, blocks: tuple[str, ...], *, near: bool = False
) -> Fit:
    """The minimum next to a start; ``near``: so near that Gauss-Newton steps may begin there."""
    count = size(blocks)

    def at(u: Unknowns) -> tuple[np.ndarray, np.ndarray]:
        def moved(step: np.ndarray) -> np.ndarray:
            return residual(u.moved(step, blocks)).ravel()

        return moved(np.zeros(count)), jacobian(moved, count)

    def gradient(u: Unknowns) -> np.ndarray:
        value, along = at(u)
        return along.T @ value

    u = start
    if not near:

        def moved(step: np.ndarray) -> np.ndarray:
            return residual(start.moved(step, blocks)).ravel()

        def slope(step: np.ndarray) -> np.ndarray:
            return jacobian(lambda more: moved(step + more), count)

        found = least_squares(
            moved,
            np.zeros(count),
            jac=slope,
            x_scale="jac",
            xtol=1e-9,
            ftol=1e-12,
            gtol=1e-12,
            max_nfev=200,
        )
        u = start.moved(found.x, blocks)
    hessian, last = None, np.inf
    if near:
        along = at(u)[1]
        hessian = along.T @ along
    for _ in range(60):
        if hessian is None:
            hessian = second_derivatives(lambda step, u=u: gradient(u.moved(step, blocks)), count)
        step = -np.linalg.solve(hessian, gradient(u))
        u, length = u.moved(step, blocks), np.abs(step).max()
        if length < 1e-13 or (length < 1e-10 and length > 0.1 * last):
            break
        # The same matrix serves as long as it brings a digit a step.
        hessian, last = (hessian if length < 0.3 * last else None), length
    value, along = at(u)
    return Fit(u, float(value @ value), along, value)


def second_derivatives(gradient: Callable[[np.ndarray], np.ndarray], count: int) -> np.ndarray:
    """A symmetric matrix from central differences of an exact gradient."""
    columns = []
    for k in range(count):
        step = np.zeros(count)
        step[k] = 1e-5
        columns.append((gradient(step) - gradient(-step)) / 2e-5)
    matrix = np.stack(columns, axis=1)
    return 0.5 * (matrix + matrix.T)


def conventional(data: Data, blocks: tuple[str, ...], start: Unknowns | None = None) -> Fit:
    """The conventional fit, from the linear start unless told another."""
    start = linear_start(data, blocks) if start is None else start
    return minimise(lambda u: circle(data, u, np.zeros(len(data))), start, blocks)


def standardised(data: Data, u: Unknowns, sigma: np.ndarray, shape: np.ndarray | None) -> list:
    """Lateral, range and offset errors in SDs (as three arrays), decorrelated by ``shape``."""
    lateral, distance, offset = (errors(data, u) / sigma).T
    if shape is not None:
        inverse = np.linalg.inv(np.linalg.cholesky(shape))
        lateral, distance = np.einsum("nij,nj->ni", inverse, np.stack([lateral, distance], 1)).T
    return [lateral, distance, offset]


def medium(u: Unknowns, sd: np.ndarray) -> np.ndarray:
    """Sound speed (log of the factor) and delay (mm) in their prior SDs."""
    return np.array([np.log(u.speed), u.delay]) / sd


def joint(
    data: Data,
    blocks: tuple[str, ...],
    sigma: np.ndarray,
    start: Unknowns,
    shape: np.ndarray | None = None,
) -> Fit:
    """Given SDs, offsets eliminated."""
    return minimise(lambda u: np.concatenate(standardised(data, u, sigma, shape)), start, blocks)


def joint_channels(
    data: Data,
    blocks: tuple[str, ...],
    sigma: np.ndarray,
    start: Unknowns,
    medium_sd: np.ndarray | None = None,
) -> Fit:
    """Given SDs of an element's distance and of the offset."""

    def residual(u: Unknowns) -> np.ndarray:
        parts = [(channels(data, u) / sigma[0]).ravel(), target(data, u)[:, 1] / sigma[1]]
        return np.concatenate(parts if medium_sd is None else [*parts, medium(u, medium_sd)])

    return minimise(residual, start, blocks)


@dataclass(frozen=True)
class ExplicitFit(Fit):
    """A minimum with offsets as unknowns: ``jacobian`` has their n columns last.

    Attributes:
        offset: y, mm.
        free: which offsets are not on their bound.
    """

    offset: np.ndarray
    free: np.ndarray


def _explicit(
    residual: Callable[[Unknowns, np.ndarray], np.ndarray],
    u: Unknowns,
    y: np.ndarray,
    free: np.ndarray,
    blocks: tuple[str, ...],
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals and their Jacobian by the shared unknowns and the free offsets."""
    rows = np.flatnonzero(free)

    def moved(step: np.ndarray) -> np.ndarray:
        return residual(u.moved(step, blocks), y).ravel()

    def offset(step: np.ndarray) -> np.ndarray:
        other = y.astype(step.dtype)
        other[rows] += step
        return residual(u, other).ravel()

    along = jacobian(moved, size(blocks))
    if len(rows):
        along = np.concatenate([along, jacobian(offset, len(rows))], axis=1)
    return residual(u, y).ravel(), along


def _newton(
    residual: Callable[[Unknowns, np.ndarray], np.ndarray],
    u: Unknowns,
    y: np.ndarray,
    free: np.ndarray,
    blocks: tuple[str, ...],
    rounds: int,
) -> tuple[Unknowns, np.ndarray]:
    """Newton's method on the shared unknowns and the free offsets."""
    count, rows = size(blocks), np.flatnonzero(free)

    def moved(u: Unknowns, y: np.ndarray, step: np.ndarray) -> tuple[Unknowns, np.ndarray]:
        other = y.copy()
        other[rows] += step[count:]
        return u.moved(step[:count], blocks), other

    def gradient(u: Unknowns, y: np.ndarray) -> np.ndarray:
        value, along = _explicit(residual, u, y, free, blocks)
        return along.T @ value

    for _ in range(rounds):
        hessian = second_derivatives(
            lambda step, u=u, y=y: gradient(*moved(u, y, step)), count + len(rows)
        )
        for _ in range(3):
            step = -np.linalg.solve(hessian, gradient(u, y))
            u, y = moved(u, y, step)
            if np.abs(step).max() < 1e-11:
                return u, y
    return u, y


def joint_explicit(
    data: Data,
    blocks: tuple[str, ...],
    sigma: np.ndarray,
    tracker_sd: float,
    start: Unknowns,
    shape: np.ndarray | None = None,
) -> ExplicitFit:
    """Given SDs and a tracker that errs: all offsets of the target are unknowns."""
    tau = tracker_sd
    shape = np.tile(np.eye(2), (len(data), 1, 1)) if shape is None else shape
    # The measurement's own covariance, and the tracker's.
    covariance = np.outer(sigma[:2], sigma[:2]) * shape + tau**2 * np.eye(2)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))

    def residual(u: Unknowns, y: np.ndarray) -> np.ndarray:
        q = target(data, u)
        lateral, distance = points(data, u)
        away = np.stack([q[:, 0] - lateral, np.sqrt(y**2 + q[:, 2] ** 2) - distance], axis=1)
        both = np.einsum("nij,nj->in", whitening, away)
        return np.stack([*both, (y - q[:, 1]) / tau, y / sigma[2]])

    u, y = start, target(data, start)[:, 1].real / (1 + (tau / sigma[2]) ** 2)
    everything = np.ones(len(data), bool)
    for _ in range(6):
        value, along = _explicit(residual, u, y, everything, blocks)
        step = -np.linalg.lstsq(along, value, rcond=None)[0]
        u, y = u.moved(step[: size(blocks)], blocks), y + step[size(blocks) :]
    u, y = _newton(residual, u, y, everything, blocks, 2)
    value, along = _explicit(residual, u, y, everything, blocks)
    return ExplicitFit(u, float(value @ value), along, value, y, everything)


def bounded(data: Data, blocks: tuple[str, ...], bound: np.ndarray, start: Unknowns) -> ExplicitFit:
    """The least of the bounded minima that are reached from three starts.

    The starts are the given one, and turned about the lateral axis by what the bounds allow.
    """
    distance = points(data, start)[1].real
    # At the range itself the circle's tangent would turn axial.
    bound = np.minimum(bound, 0.95 * distance)
    count = size(blocks)
    fits = []
    for sign in (0.0, 1.0, -1.0):
        about = np.zeros(count)
        about[3] = sign * bound.mean() / distance.mean()
        here = start.moved(about, blocks)
        q = target(data, here)
        y = np.clip(distance * q[:, 1] / np.hypot(q[:, 1], q[:, 2]), -0.999 * bound, 0.999 * bound)
        low = np.concatenate([np.full(count, -np.inf), -bound])

        def residual(v: np.ndarray, here: Unknowns = here) -> np.ndarray:
            return circle(data, here.moved(v[:count], blocks), v[count:]).ravel()

        def along(v: np.ndarray, here: Unknowns = here) -> np.ndarray:
            u, y = here.moved(v[:count], blocks), v[count:]
            shared = jacobian(lambda step: residual(np.append(v[:count] + step, y), here), count)
            own = jacobian(lambda step: circle(data, u, y + step), len(y))
            return np.concatenate([shared, own], axis=1)

        found = least_squares(
            residual,
            np.concatenate([np.zeros(count), y]),
            jac=along,
            bounds=(low, -low),
            x_scale="jac",
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-14,
            max_nfev=500,
        )
        fits.append(
            _active_set(data, blocks, bound, here.moved(found.x[:count], blocks), found.x[count:])
        )
    return min(fits, key=lambda fit: fit.cost)


def _active_set(
    data: Data, blocks: tuple[str, ...], bound: np.ndarray, u: Unknowns, y: np.ndarray
) -> ExplicitFit:
    """From near a minimum to it: Newton on what is free, offsets held or let go by KKT."""

    def residual(u: Unknowns, y: np.ndarray) -> np.ndarray:
        return circle(data, u, y)

    free = bound - np.abs(y) > 1e-5
    for _ in range(12):
        y = np.where(free, y, np.sign(y) * bound)
        u, y = _newton(residual, u, y, free, blocks, 3)
        force = offset_gradient(data, u, y)
        held = (np.abs(y) >= bound) | (~free & (np.sign(y) * force < 0))
        if np.array_equal(held, ~free):
            break
        y, free = np.clip(y, -bound, bound), ~held
    value, along = _explicit(residual, u, y, free, blocks)
    return ExplicitFit(u, float(value @ value), along, value, y, free)


def alternate(
    data: Data,
    blocks: tuple[str, ...],
    bound: np.ndarray,
    start: Unknowns,
    tolerance_rad: float = 1e-3,
    tolerance_mm: float = 0.1,
) -> tuple[Unknowns, np.ndarray]:
    """The paper's alternation: offsets to the closest points, two Gauss-Newton steps, and again.

    Until a round turns X by less than one tolerance and moves its origin by less than the other.
    """
    u = start

    def closest(u: Unknowns) -> np.ndarray:
        q, distance = target(data, u), points(data, u)[1]
        most = np.minimum(bound, 0.95 * distance)
        return np.clip(distance * q[:, 1] / np.hypot(q[:, 1], q[:, 2]), -most, most)

    for _ in range(1000):
        before, y = u, closest(u)
        for _ in range(2):

            def moved(step: np.ndarray, u: Unknowns = u, y: np.ndarray = y) -> np.ndarray:
                return circle(data, u.moved(step, blocks), y).ravel()

            along = jacobian(moved, size(blocks))
            u = u.moved(
                -np.linalg.lstsq(along, moved(np.zeros(size(blocks))), rcond=None)[0], blocks
            )
        turned = np.linalg.norm(u.rotation - before.rotation) / np.sqrt(8)
        if (
            2 * np.arcsin(turned) < tolerance_rad
            and np.linalg.norm(u.translation - before.translation) < tolerance_mm
        ):
            break
    return u, closest(u)


def offset_gradient(data: Data, u: Unknowns, y: np.ndarray) -> np.ndarray:
    """Derivative of half the bounded objective by every offset, mm."""
    distance = points(data, u)[1]
    axial = np.sqrt(distance**2 - y**2)
    return -(target(data, u)[:, 1] - y) + (target(data, u)[:, 2] - axial) * y / axial
