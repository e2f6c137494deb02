"""One pass over the images: the normal equations of many problems in one fused reduction.

Every objective here is a sum over images of phi_i(q_i, e), with q_i = X^-1 B_i^-1 c the target in
image i's frame and e the further unknowns. An observation (:mod:`jaxcal.model.observations`)
provides only phi, its gradient g and its curvature K as functions of (q_i, e); one that is
oriented, as functions of (q_i, w, e), since it also depends on the directions M_i. The rest is the
same for all observations. With X = (R, t), B_i = (R_i, b_i), the right perturbation (v, w) of X
and the step d of c,

    q_i -> Exp(-w) (q_i - v + M_i d),     M_i = R' R_i',     q_i = M_i (c - b_i) - R' t,
    dq/dv = -1,     dq/dw = [q]x,     dq/dd = M_i,

so with J_i = (-1, [q]x, M_i) the gradient is sum J_i' g_i and the curvature sum J_i' K_i J_i, plus
second derivatives of q itself: the symmetric part of g q' - (g.q) 1 in (w, w), [g]x M in (w, d),
and [g]x in (v, w). All these sums and the cost come from one variadic reduction over the images,
which XLA compiles to one loop: images are the minor axis, so it vectorises over them; no
intermediate value of an image is stored.

An unknown y of the image itself is eliminated inside the pass: with D = phi_yy and b = phi_qy, the
Schur complement of this image is K = phi_qq - b b' / D (the shared unknowns' part of the
arrow-shaped system that X, c and all offsets make together; its cost is O(n p^2)).

The curvature is Gauss-Newton's for problems with ``exact`` 0; for those with 1 it includes the
second derivatives of the residuals. Far from the optimum the exact curvature may be indefinite;
near it Gauss-Newton is slow along directions that the data barely determine.

Reference: Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment: a modern synthesis", 2000.
"""

from __future__ import annotations

from functools import cache, reduce
from operator import add
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal import InputError
from jaxcal.model import derivatives, unrolled
from jaxcal.model.batch import ImagePlanes, Iterate, barrier, picked, targets, total
from jaxcal.model.observations import (
    Component,
    FurtherUnknowns,
    LocalUnknown,
    MediumPrior,
    Observation,
)
from jaxcal.model.unknowns import RIGID_UNKNOWNS
from jaxcal.model.unrolled import Entry, Matrix, Vector

Q_SIZE = 3
"""Number of coordinates of q."""

V_Y = 1
"""Index of v_y, the unknown that moves every q_iy by -1."""

ROTATION = (3, 4, 5)
"""Indices of w among the unknowns."""


@cache
def pairs(unknowns: int) -> list[tuple[int, int]]:
    """Row and column of every entry of a flat upper triangle, in order."""
    return [(i, j) for i in range(unknowns) for j in range(i, unknowns)]


@cache
def square_indices(unknowns: int) -> np.ndarray:
    """Index in a flat upper triangle of every entry of the full matrix."""
    indices = np.zeros((unknowns, unknowns), int)
    for index, (i, j) in enumerate(pairs(unknowns)):
        indices[i, j] = indices[j, i] = index
    return indices


def diagonal_indices(unknowns: int) -> np.ndarray:
    """Index in a flat upper triangle of every entry of the diagonal."""
    return square_indices(unknowns).diagonal()


def unknowns_of(flat: Float[Array, "*k triangle batch"]) -> int:
    """Number of rows of the matrix whose upper triangle this is."""
    return int((2 * flat.shape[-2]) ** 0.5)


def stacked(flat: Float[Array, "triangle batch"]) -> Float[Array, "p p batch"]:
    """A symmetric matrix from its upper triangle."""
    return picked(flat, square_indices(unknowns_of(flat)))


def row_of(flat: Float[Array, "triangle batch"], k: int) -> Float[Array, "p batch"]:
    """A row of a symmetric matrix from its upper triangle."""
    return picked(flat, square_indices(unknowns_of(flat))[k])


def traces(
    matrix: Float[Array, "q q batch"], flat: Float[Array, "k triangle batch"]
) -> Float[Array, "k batch"]:
    """tr(A N_k) of a symmetric A and N_k given by their upper triangles.

    Where A has more rows than N_k, its first ones count.
    """
    rows, columns = np.triu_indices(unknowns_of(flat))
    twice = np.where(rows == columns, 1, 2).astype(matrix.dtype)[:, None]
    entries = picked(matrix.reshape(-1, matrix.shape[-1]), len(matrix) * rows + columns)
    # XLA's reduction over this axis takes twice as long. Slices that keep it need no reshaping.
    terms = barrier(twice * entries) * flat
    return reduce(add, [terms[:, k : k + 1] for k in range(flat.shape[1])])[:, 0]


class Term(eqx.Module):
    """phi_i of every image: twice its value, its gradient and its curvature in (q, e).

    Attributes:
        cost: planes, or 0.
        gradient: with respect to q, then the rotation of an oriented observation, then e.
        curvature: with respect to the same, symmetric.
    """

    cost: Entry
    gradient: Vector
    curvature: Matrix


class _Derived(eqx.Module):
    """An observation's residuals with their derivatives by (q, w, e) and the image's own unknown.

    Attributes:
        unknowns: which unknowns the arguments after q are.
        components: the residuals.
        first: for every component, the rows of first derivatives.
        second: for every component, the second derivatives by (row, i, j).
        free: 1 where the image's own unknown may move; None where there is none.
    """

    unknowns: tuple[int, ...]
    components: list[Component]
    first: list[Matrix]
    second: list[dict[tuple[int, int, int], Entry]]
    free: Array | None


def _derive(
    observation: Observation,
    q: Vector,
    tracker_to_image: Matrix,
    iterate: Iterate,
    images: ImagePlanes,
    *,
    exact: bool,
) -> _Derived:
    """An observation's residuals at q, with their derivatives."""
    still = jnp.zeros((images.batch_size, 1), images.mask.dtype)
    unknowns = tuple(range(RIGID_UNKNOWNS, iterate.unknowns))
    further = [still] * len(unknowns)
    direct, free = further, None
    if observation.oriented:
        unknowns, direct = (*ROTATION, *unknowns), [still] * len(ROTATION) + further
    arguments = [*q, *direct]
    if isinstance(observation, LocalUnknown):
        local, free = observation.local(
            q, FurtherUnknowns.of(iterate, further, tracker_to_image), images
        )
        arguments.append(local)

    def evaluate(*at: Array) -> list[Component]:
        here, moved = list(at[:Q_SIZE]), list(at[Q_SIZE : Q_SIZE + len(direct)])
        rotated = None
        if observation.oriented:
            # X turns by w, so directions in its frame turn back.
            rotated = unrolled.product(unrolled.rotation([-w for w in moved[:3]]), tracker_to_image)
            moved = moved[3:]
        beside = FurtherUnknowns.of(iterate, moved, rotated)
        if isinstance(observation, LocalUnknown):
            return observation.components_at(here, at[-1], beside, images)
        return observation.components(here, beside, images)

    def errors(*at: Array) -> Vector:
        return [plane for component in evaluate(*at) for plane in component.errors]

    components = evaluate(*arguments)
    _check_components(components, observation, images)
    traced = jax.make_jaxpr(errors)(*arguments)
    rows = derivatives.first(traced, arguments)
    bent = derivatives.second(traced, arguments) if exact else {}
    first, second, start = [], [], 0
    for component in components:
        stop = start + len(component.errors)
        first.append(rows[start:stop])
        second.append(
            {(row - start, *by): bend for (row, *by), bend in bent.items() if start <= row < stop}
        )
        start = stop
    return _Derived(unknowns, components, first, second, free)


def _check_components(components: Any, observation: Observation, images: ImagePlanes) -> None:
    """Raise InputError for what is not one component of planes for each of the SDs."""
    name, sigma = type(observation).__name__, observation.sigma
    if not all(isinstance(component, Component) for component in components):
        raise InputError(f"{name}.components must return a list of backend.Component")
    if sigma.shape != (wanted := (len(components), images.batch_size)):
        raise InputError(
            f"sigma must have shape {wanted}, since {name}.components returns {wanted[0]} "
            f"components of {wanted[1]} problems, not {sigma.shape}"
        )
    for plane in (plane for component in components for plane in component.errors):
        if plane.shape[:2] != images.mask.shape:
            raise InputError(
                f"errors of {name}.components must be planes of shape {images.mask.shape}, "
                f"problems and images, not {plane.shape}"
            )


def over_elements(plane: Entry) -> Entry:
    """A plane (batch, n, elements) summed over the elements; other planes as they are."""
    return plane if unrolled.is_zero(plane) or plane.ndim < 3 else jnp.sum(plane, axis=2)


def weight_of(component: Component, images: ImagePlanes) -> Array:
    """1 where there is a residual, 0 elsewhere."""
    mask = images.mask if component.errors[0].ndim < 3 else images.mask[..., None]
    return mask if component.present is None else mask * component.present


def _gauss_newton(derived: _Derived, k: int, images: ImagePlanes) -> Term:
    """Component k alone, unweighted, with Gauss-Newton's curvature."""
    component, first = derived.components[k], derived.first[k]
    width, weight = len(first[0]), weight_of(component, images)
    cost: Entry = 0
    gradient: Vector = [0] * width
    curvature: Matrix = [[0] * width for _ in range(width)]
    for error, slope in zip(component.errors, first, strict=True):
        pull = weight * error
        heavy = [unrolled.times(weight, entry) for entry in slope]
        cost = unrolled.add(cost, over_elements(pull * error))
        for i in range(width):
            along = over_elements(unrolled.times(pull, slope[i]))
            gradient[i] = unrolled.add(gradient[i], along)
            for j in range(i, width):
                entry = over_elements(unrolled.times(heavy[i], slope[j]))
                curvature[i][j] = unrolled.add(curvature[i][j], entry)
                curvature[j][i] = curvature[i][j]
    return Term(cost, gradient, curvature)


def _second_order(derived: _Derived, k: int, images: ImagePlanes) -> Matrix:
    """What second derivatives of component k's residuals add to its curvature."""
    component, width = derived.components[k], len(derived.first[k][0])
    weight = weight_of(component, images)
    found: Matrix = [[0] * width for _ in range(width)]
    for (row, i, j), bend in derived.second[k].items():
        entry = over_elements(weight * component.errors[row] * bend)
        found[i][j] = unrolled.add(found[i][j], entry)
        found[j][i] = found[i][j]
    return found


def _summed(matrices: list[Matrix], weights: Vector) -> Matrix:
    """The sum of symmetric matrices times planes."""
    width = len(matrices[0])
    found: Matrix = [[0] * width for _ in range(width)]
    for i in range(width):
        for j in range(i, width):
            found[i][j] = found[j][i] = unrolled.add(
                *(
                    unrolled.times(weight, matrix[i][j])
                    for weight, matrix in zip(weights, matrices, strict=True)
                )
            )
    return found


def _weighted_sum(terms: list[Term], weights: list[Array]) -> Term:
    """The sum of terms times planes."""
    return Term(
        unrolled.dot(weights, [term.cost for term in terms]),
        [
            unrolled.dot(weights, [term.gradient[i] for term in terms])
            for i in range(len(terms[0].gradient))
        ],
        _summed([term.curvature for term in terms], weights),
    )


def _eliminated(term: Term, plain: Entry, free: Array) -> Term:
    """A term with the image's own unknown, which is the last, eliminated.

    Where the slope by that unknown is not zero yet, the result includes one more Newton step of it,
    to first order.

    Args:
        term: with that unknown.
        plain: Gauss-Newton's curvature by it, used where the exact one is not positive.
        free: 1 where it may move.
    """
    last = len(term.gradient) - 1
    # D and 1/D (0 where the unknown is not free), b = phi_qy, and b/D.
    own = jnp.where(term.curvature[last][last] > 0, term.curvature[last][last], plain)
    inverse = jnp.where((free > 0) & (own > 0), 1 / jnp.where(own > 0, own, 1.0), 0.0)
    coupling, slope = term.curvature[last][:last], term.gradient[last]
    scaled = [unrolled.times(inverse, entry) for entry in coupling]

    def less(entry: Entry, by: Entry, other: Entry) -> Entry:
        return unrolled.add(entry, unrolled.times(-1, unrolled.times(by, other)))

    return Term(
        less(term.cost, inverse * slope, slope),
        [less(term.gradient[i], scaled[i], slope) for i in range(last)],
        [
            [less(term.curvature[i][j], scaled[i], coupling[j]) for j in range(last)]
            for i in range(last)
        ],
    )


def _shared(term: Term) -> Term:
    """A term with the image's own unknown held fixed."""
    return Term(term.cost, term.gradient[:-1], [row[:-1] for row in term.curvature[:-1]])


def contributions(
    q: Vector,
    tracker_to_image: Matrix,
    term: Term,
    direct: tuple[int, ...],
    exact: Float[Array, "batch 1"] | int,
) -> tuple[Vector, Vector]:
    """An image's part of the curvature (upper triangle) and the gradient, as planes or 0.

    ``direct`` tells which unknowns the term's arguments after q are.

    ``exact`` is the factor on the second derivatives of q; 0 for none. They are included by using
    A = [q]x' K + exact [g]x instead of [q]x' K: A M is then all of block (w, d), and A [q]x is
    block (w, w) up to an antisymmetric part, which :func:`complete_curvature` takes from the summed
    gradient.
    """
    unknowns = RIGID_UNKNOWNS + sum(index >= RIGID_UNKNOWNS for index in direct)
    g = term.gradient[:Q_SIZE]
    k = [row[:Q_SIZE] for row in term.curvature[:Q_SIZE]]
    lever = unrolled.cross(q)
    # K [q]x and K M; A = [q]x' K + exact [g]x; A [q]x, A M and M' K M.
    across, forth = unrolled.product(k, lever), unrolled.product(k, tracker_to_image)
    inverse = unrolled.transpose(tracker_to_image)
    bent = unrolled.cross([unrolled.times(exact, value) for value in g])
    back = [
        [unrolled.add(a, b) for a, b in zip(*rows, strict=True)]
        for rows in zip(unrolled.transpose(across), bent, strict=True)
    ]
    about, mixed = unrolled.product(back, lever), unrolled.product(back, tracker_to_image)
    point = unrolled.product(inverse, forth)
    full: Matrix = [[0] * unknowns for _ in range(unknowns)]
    for i in range(3):
        for j in range(3):
            full[i][j] = k[i][j]
            full[i][3 + j] = unrolled.times(-1, across[i][j])
            full[i][6 + j] = unrolled.times(-1, forth[i][j])
            full[3 + i][3 + j] = about[i][j]
            full[3 + i][6 + j] = mixed[i][j]
            full[6 + i][6 + j] = point[i][j]

    def in_rigid(values: Vector) -> Vector:
        """J' of a vector over q."""
        found = [unrolled.times(-1, value) for value in values]
        found += unrolled.apply(unrolled.transpose(lever), values)
        return found + unrolled.apply(inverse, values)

    gradient = in_rigid(g) + [0] * (unknowns - RIGID_UNKNOWNS)
    # What depends on the unknowns directly, not through q.
    own: Vector = [0] * unknowns
    for a, index in enumerate(direct, Q_SIZE):
        own[index] = term.gradient[a]
        gradient[index] = unrolled.add(gradient[index], own[index])
        column = in_rigid([term.curvature[i][a] for i in range(Q_SIZE)])
        for i, entry in enumerate(column):
            twice = unrolled.times(2, entry) if i == index else entry
            row, col = sorted((i, index))
            full[row][col] = unrolled.add(full[row][col], twice)
        for b, other in enumerate(direct[a - Q_SIZE :], a):
            full[index][other] = unrolled.add(full[index][other], term.curvature[a][b])
    # complete_curvature takes off the skew part of the whole gradient by w. The direct part has
    # none, so add it.
    kept = unrolled.cross([unrolled.times(0.5, unrolled.times(exact, own[k])) for k in ROTATION])
    for i, j in ((0, 1), (0, 2), (1, 2)):
        full[3 + i][3 + j] = unrolled.add(full[3 + i][3 + j], kept[i][j])
    return [full[i][j] for i, j in pairs(unknowns)], gradient


def complete_curvature(flat: Vector, gradient: Vector, unknowns: int) -> Vector:
    """A flat curvature with those second derivatives of q added that the summed gradient gives.

    Args:
        flat: sums of :func:`contributions`.
        gradient: v and w parts of the summed gradient, times ``exact``. The v part is -sum g, so
            block (v, w) gets [sum g]x. The w part is sum g x q: the upper half of A [q]x has
            q_i g_j where block (w, w) needs the mean of q_i g_j and q_j g_i.
        unknowns: how many there are.
    """
    twist = unrolled.cross([-value for value in gradient[:3]])
    skew = unrolled.cross([0.5 * value for value in gradient[3:6]])
    flat, indices = list(flat), square_indices(unknowns)
    for i in range(3):
        for j in range(3):
            index = indices[i, 3 + j]
            flat[index] = unrolled.add(flat[index], twist[i][j])
            if j > i:
                index = indices[3 + i, 3 + j]
                flat[index] = unrolled.add(flat[index], unrolled.times(-1, skew[i][j]))
    return flat


class NormalEquations(eqx.Module):
    """The normal equations of every problem at an iterate; batch axis last.

    Attributes:
        curvature: upper triangle, in the order of :func:`pairs`.
        gradient: of half the cost.
        cost: sum of squared (whitened) residuals.
        column_squares: |J_k|^2 of the unknowns' columns, where images have unknowns of their own
            and eliminating these lowers the diagonal; None where the diagonal is |J_k|^2.
    """

    curvature: Float[Array, "triangle batch"]
    gradient: Float[Array, "p batch"]
    cost: Float[Array, " batch"]
    column_squares: Float[Array, "p batch"] | None = None

    def stacked(self) -> Float[Array, "p p batch"]:
        """The full matrix as one array."""
        return stacked(self.curvature)

    def diagonal(self) -> Float[Array, "p batch"]:
        """|J_k|^2 of every unknown: what damping and the gradient cosine are relative to."""
        if self.column_squares is not None:
            return self.column_squares
        return picked(self.curvature, diagonal_indices(self.gradient.shape[0]))


def accumulate(
    iterate: Iterate,
    observation: Observation,
    images: ImagePlanes,
    exact: Float[Array, " batch"] | None = None,
    medium: MediumPrior | None = None,
) -> NormalEquations:
    """One pass: the normal equations at an iterate.

    Args:
        iterate: X, c and the further unknowns of every problem.
        observation: the objective.
        images: the data.
        exact: 1 for exact second derivatives, 0 for Gauss-Newton's curvature; None for the latter
            everywhere.
        medium: prior of further unknowns, or None.

    Returns:
        The normal equations of the step of X, c and the further unknowns; an image's own unknown is
        eliminated.
    """
    q, tracker_to_image = targets(iterate, images)
    wide = 0 if exact is None else exact[:, None]
    derived = _derive(observation, q, tracker_to_image, iterate, images, exact=exact is not None)
    weights = unrolled.rows_of((1 / (observation.sigma * observation.sigma))[:, :, None])
    count = len(derived.components)
    term = _weighted_sum([_gauss_newton(derived, k, images) for k in range(count)], weights)
    plain = term
    if exact is not None:
        bent = [_second_order(derived, k, images) for k in range(count)]
        gated = [wide * weight for weight in weights]
        term = Term(term.cost, term.gradient, _summed([term.curvature, *bent], [1, *gated]))
    indices = diagonal_indices(iterate.unknowns)
    columns: Vector = []
    if derived.free is not None:
        every, _ = contributions(q, tracker_to_image, _shared(plain), derived.unknowns, 0)
        columns = [every[k] for k in indices]
        term = _eliminated(term, plain.curvature[-1][-1], derived.free)
    curvature, gradient = contributions(q, tracker_to_image, term, derived.unknowns, wide)
    cost, *sums = total([term.cost, *curvature, *gradient, *columns])
    flat, gradient = sums[: len(curvature)], sums[len(curvature) : len(curvature) + len(gradient)]
    squares = sums[len(curvature) + len(gradient) :]
    if exact is not None:
        pose_gradient = [exact * value for value in gradient[:6]]
        flat = complete_curvature(flat, pose_gradient, iterate.unknowns)
    if medium is not None:
        for k, away, precision in medium.deviations(iterate):
            flat[indices[k]] = flat[indices[k]] + precision
            gradient[k] = gradient[k] + precision * away
            cost = cost + precision * away * away
    lengths = jnp.stack(squares) if squares else None
    return NormalEquations(unrolled.as_array(flat), unrolled.as_array(gradient), cost, lengths)


class ComponentSums(eqx.Module):
    """Sums of one pass over the images for each component separately, unweighted; batch axis last.

    Attributes:
        squares: rss_k, mm^2.
        gradient: g_k.
        matrix: N_k, Gauss-Newton's, upper triangles.
        rest: C, the exact curvature with the given SDs less sum N_k / s_k^2; zeros without SDs.
        prior: what the prior of further unknowns adds to cost, gradient and diagonal of the
            curvature.
    """

    squares: Float[Array, "k batch"]
    gradient: Float[Array, "k p batch"]
    matrix: Float[Array, "k triangle batch"]
    rest: Float[Array, "triangle batch"]
    prior: tuple[Float[Array, " batch"], Float[Array, "p batch"], Float[Array, "p batch"]] | None

    def weighted(self, weight: Float[Array, "k batch"]) -> NormalEquations:
        """Gauss-Newton's normal equations with weights 1/s_k^2."""
        flat = reduce(add, unrolled.rows_of(weight[:, None] * self.matrix))
        gradient = reduce(add, unrolled.rows_of(weight[:, None] * self.gradient))
        cost = jnp.sum(weight * self.squares, axis=0)
        if self.prior is not None:
            away, slope, diagonal = self.prior
            rows, indices = unrolled.rows_of(flat), diagonal_indices(slope.shape[0])
            for index, entry in zip(indices, diagonal, strict=True):
                rows[index] = rows[index] + entry
            flat, gradient, cost = jnp.stack(rows), gradient + slope, cost + away
        return NormalEquations(flat, gradient, cost)


def component_sums(
    iterate: Iterate,
    observation: Observation,
    images: ImagePlanes,
    sigma: Float[Array, "k batch"] | None,
    medium: MediumPrior | None = None,
) -> ComponentSums:
    """One pass that keeps the components apart.

    Args:
        iterate: X, c and the further unknowns of every problem.
        observation: one without an unknown in every image.
        images: the data.
        sigma: SDs for the rest of the exact curvature, mm; None leaves it out.
        medium: prior of further unknowns, or None.
    """
    q, tracker_to_image = targets(iterate, images)
    derived = _derive(observation, q, tracker_to_image, iterate, images, exact=sigma is not None)
    weight = None if sigma is None else 1 / (sigma * sigma)
    count, unknowns = len(derived.components), iterate.unknowns
    terms = [_gauss_newton(derived, k, images) for k in range(count)]
    planes: Vector = [term.cost for term in terms]
    each = unknowns + len(pairs(unknowns))
    for term in terms:
        matrix, gradient = contributions(q, tracker_to_image, term, derived.unknowns, 0)
        planes += [*gradient, *matrix]
    if weight is not None:
        weights = unrolled.rows_of(weight[:, :, None])
        weighted = _weighted_sum(terms, weights)
        bent = _summed([_second_order(derived, k, images) for k in range(count)], weights)
        # The second derivatives of q itself follow from the weighted gradient.
        term = Term(0, weighted.gradient, bent)
        planes += contributions(q, tracker_to_image, term, derived.unknowns, 1)[0]
    sums = total(planes)
    squares, sums = sums[:count], sums[count:]
    parts = [sums[k * each : (k + 1) * each] for k in range(count)]
    gradient = jnp.stack([unrolled.as_array(part[:unknowns]) for part in parts])
    if weight is None:
        rest = [jnp.zeros_like(squares[0])] * len(pairs(unknowns))
    else:
        pose_gradient = jnp.sum(weight[:, None] * gradient[:, :6], axis=0)
        rest = complete_curvature(sums[count * each :], unrolled.rows_of(pose_gradient), unknowns)
    known = None
    if medium is not None:
        zero = jnp.zeros_like(squares[0])
        away, slope, diagonal = zero, [zero] * unknowns, [zero] * unknowns
        for k, value, precision in medium.deviations(iterate):
            away = away + precision * value * value
            slope[k], diagonal[k] = precision * value, precision + zero
        known = (away, unrolled.as_array(slope), unrolled.as_array(diagonal))
    return ComponentSums(
        jnp.stack(squares),
        gradient,
        jnp.stack([unrolled.as_array(part[unknowns:]) for part in parts]),
        unrolled.as_array(rest),
        known,
    )
