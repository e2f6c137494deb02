"""One pass over the images: the normal equations of many problems in one fused reduction.

Every objective here is a sum over images of phi_i(q_i), q_i = X^-1 B_i^-1 c, the target in image
i's frame. What is particular to a belief (which residuals, an offset y_i to eliminate) ends at
q_i: it gives phi, its gradient g (3) and curvature K (3x3). What remains is the same for all. With
X = (R, t), B_i = (R_i, b_i), the right perturbation (v, w) of X and the step d of c,

    q_i -> Exp(-w) (q_i - v + M_i d),     M_i = R' R_i',     q_i = M_i (c - b_i) - R' t,
    dq/dv = -1,     dq/dw = [q]x,     dq/dd = M_i,

so with J_i = (-1, [q]x, M_i) the gradient is sum J_i' g_i and the curvature sum J_i' K_i J_i, plus
second derivatives of q itself: the symmetric part of g q' - (g.q) 1 in (w, w), [g]x M in (w, d),
and [g]x in (v, w). These 9 + 45 sums and the cost come from one variadic reduction over the images,
which XLA compiles to one loop: images are the minor axis, so it vectorises over them; nothing that
belongs to an image is ever stored.

Beliefs, all with the offset y_i eliminated inside the pass:

- :class:`Measured`: lateral position, range and q_y itself, each with its SD (the Gaussian belief,
  for which y_i = q_iy);
- :class:`Circle`: q_i - p_i(y_i), p_i(y) = (x_i, y, sqrt(r_i^2 - y^2)), y_i Gaussian and bounded.
  For given q the scalar problem in y is solved by Newton's method; with D = phi_yy and b = phi_qy
  its elimination leaves K = phi_qq - b b' / D, the Schur complement (:mod:`arrow`) of this image;
- :class:`Held`: q_i - p_i(y_i) with y_i held; y_i = 0 is the conventional Eq. 7.

The curvature is Gauss-Newton's where a lane's ``gate`` is 0, and exact where it is 1: far from the
optimum the exact one is indefinite, and near it Gauss-Newton crawls along what the data barely see.

The loop around the pass is :mod:`jaxcal.solvers.lanes`; the readable reference of both, to which
they are held by the tests, is :mod:`jaxcal.solvers.least_squares`.
"""

from __future__ import annotations

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.model.parameters import Parameters
from jaxcal.model.residuals import LARGEST_ELEVATION
from jaxcal.problem import Problem
from jaxcal.solvers import unrolled
from jaxcal.solvers.unrolled import Matrix, Vector

UNKNOWNS = 9
PAIRS = [(i, j) for i in range(UNKNOWNS) for j in range(i, UNKNOWNS)]
"""Places of the upper triangle in a flat row of 45."""


class Images(eqx.Module):
    """What an image says, one plane (lanes, images) for every number.

    Attributes:
        rotation: R_i by rows. origin: b_i, mm. lateral, distance: x_i and r_i, mm. mask: 1 for
            used images; the others hold harmless numbers.
    """

    rotation: Float[Array, "9 lanes n"]
    origin: Float[Array, "3 lanes n"]
    lateral: Float[Array, "lanes n"]
    distance: Float[Array, "lanes n"]
    mask: Float[Array, "lanes n"]

    @classmethod
    def of(cls, problems: Problem) -> Images:
        """The planes of a batch of problems (one leading axis) at their nominal scale."""
        used = problems.mask > 0

        def plane(values: Array, instead: float) -> Array:
            return jnp.where(used, values, jnp.asarray(instead, problems.mask.dtype))

        poses, points = problems.poses, problems.measurements * problems.spacing[:, None, :]
        rotation = [plane(poses[..., i, j], float(i == j)) for i in range(3) for j in range(3)]
        return cls(
            rotation=jnp.stack(rotation),
            origin=jnp.stack([plane(poses[..., i, 3], 0.0) for i in range(3)]),
            lateral=plane(points[..., 0], 0.0),
            distance=plane(points[..., 1] + problems.face_offset[:, None], 1.0),
            mask=problems.mask,
        )

    def padded(self) -> Images:
        """With unused images up to whole vectors of 64 bytes: a loop over them leaves no rest."""
        unit = [whole(self.rotation[k], float(k % 4 == 0)) for k in range(9)]
        return Images(
            jnp.stack(unit), whole(self.origin, 0.0), whole(self.lateral, 0.0),
            whole(self.distance, 1.0), whole(self.mask, 0.0),
        )  # fmt: skip

    @property
    def used(self) -> Float[Array, " lanes"]:
        """Number of used images."""
        return jnp.sum(self.mask, axis=1)


def whole(planes: Float[Array, "*planes n"], value: float) -> Float[Array, "*planes padded"]:
    """Planes with their images continued by a value, up to whole vectors of 64 bytes."""
    extra = -planes.shape[-1] % (64 // planes.dtype.itemsize)
    widths = [(0, 0)] * (planes.ndim - 1) + [(0, extra)]
    return jnp.pad(planes, widths, constant_values=value) if extra else planes


class Guess(eqx.Module):
    """X and the target of every lane, lanes last.

    Attributes:
        rotation: of X. translation: of X, mm. point: c, mm.
    """

    rotation: Float[Array, "3 3 lanes"]
    translation: Float[Array, "3 lanes"]
    point: Float[Array, "3 lanes"]

    @classmethod
    def of(cls, parameters: Parameters) -> Guess:
        """From parameters with a leading axis."""
        return cls(
            jnp.moveaxis(parameters.rotation, 0, -1), parameters.translation.T, parameters.point.T
        )

    def parameters(self) -> Parameters:
        """With a leading axis, at nominal scale, sound speed and delay."""
        rotation = jnp.moveaxis(self.rotation, -1, 0)
        return jax.vmap(Parameters.of)(rotation, self.translation.T, self.point.T)

    def moved(self, step: Vector) -> Guess:
        """The step (v, w, d) taken, as :func:`jaxcal.model.parameters.retract` takes it."""
        here = [unrolled.rows_of(row) for row in self.rotation]
        turned = unrolled.product(here, unrolled.rotation(step[3:6]))
        along = unrolled.apply(here, step[:3])
        return Guess(
            jnp.stack([jnp.stack(row) for row in turned]),
            self.translation + jnp.stack(along),
            self.point + jnp.stack(step[6:9]),
        )


def targets(guess: Guess, images: Images) -> tuple[Vector, Matrix]:
    """q_i and M_i as planes."""
    inverse = [[guess.rotation[k, a][:, None] for k in range(3)] for a in range(3)]
    back = [[images.rotation[3 * j + i] for j in range(3)] for i in range(3)]
    apart = [guess.point[j][:, None] - images.origin[j] for j in range(3)]
    # Not by M_i: who needs q_i alone shall not have to wait for it in memory.
    in_probe = [
        value - shift[:, None]
        for value, shift in zip(unrolled.apply(back, apart), guess.translation, strict=True)
    ]
    return unrolled.apply(inverse, in_probe), unrolled.product(inverse, back)


class Term(eqx.Module):
    """phi_i of every image: twice its value, its gradient and its curvature (planes or 0)."""

    cost: Float[Array, "lanes n"]
    gradient: Vector
    curvature: Matrix


class Belief(eqx.Module):
    """What an image's residuals are: a function of q_i alone."""

    @abc.abstractmethod
    def term(self, q: Vector, images: Images, gate: Float[Array, "lanes 1"]) -> Term:
        """phi_i; exact second derivatives where the gate is 1, else Gauss-Newton's."""

    def padded(self) -> Belief:
        """For images that are padded."""
        return self

    def largest_weight(self) -> Float[Array, " lanes"] | float:
        """How much a mm of error can be in a whitened residual."""
        return 1.0

    def planar_weight(self) -> Float[Array, "3 lanes"] | None:
        """Weights of q - (x, 0, r), 1/mm^2, with which the belief is nearly this; None for none."""
        return None


class Measured(Belief):
    """Lateral position, range and elevational offset, each with its SD; no offset unknown is left.

    Attributes:
        sigma: the SDs, mm.
    """

    sigma: Float[Array, "3 lanes"]

    def term(self, q: Vector, images: Images, gate: Float[Array, "lanes 1"]) -> Term:
        weight = [images.mask * (1 / (sd * sd))[:, None] for sd in self.sigma]
        square = q[1] * q[1] + q[2] * q[2]
        inverse = jax.lax.rsqrt(square)
        along = [q[1] * inverse, q[2] * inverse]
        errors = [q[0] - images.lateral, square * inverse - images.distance, q[1]]
        pull = [w * e for w, e in zip(weight, errors, strict=True)]
        # Along the circle the range curves: (rho - r) / rho of what it has across.
        bend = gate * pull[1] * inverse
        mixed = (weight[1] - bend) * along[0] * along[1]
        first = weight[1] * along[0] ** 2 + bend * along[1] ** 2 + weight[2]
        second = weight[1] * along[1] ** 2 + bend * along[0] ** 2
        return Term(
            cost=pull[0] * errors[0] + pull[1] * errors[1] + pull[2] * errors[2],
            gradient=[pull[0], pull[1] * along[0] + pull[2], pull[1] * along[1]],
            curvature=[[weight[0], 0, 0], [0, first, mixed], [0, mixed, second]],
        )

    def largest_weight(self) -> Float[Array, " lanes"]:
        return 1 / jnp.min(self.sigma, axis=0)

    def planar_weight(self) -> Float[Array, "3 lanes"]:
        lateral, axial, across = self.sigma
        return 1 / jnp.stack([lateral**2, across**2, axial**2])


class Held(Belief):
    """q_i - p_i(y_i) with y_i held, all weights 1, mm; y_i = 0 is the conventional calibration.

    Attributes:
        elevation: y_i, mm.
    """

    elevation: Float[Array, "lanes n"]

    def padded(self) -> Held:
        return Held(whole(self.elevation, 0.0))

    def term(self, q: Vector, images: Images, gate: Float[Array, "lanes 1"]) -> Term:
        axial = jnp.sqrt(images.distance**2 - self.elevation**2)
        errors = [q[0] - images.lateral, q[1] - self.elevation, q[2] - axial]
        pull = [images.mask * error for error in errors]
        cost = pull[0] * errors[0] + pull[1] * errors[1] + pull[2] * errors[2]
        curvature = [[images.mask if i == j else 0 for j in range(3)] for i in range(3)]
        return Term(cost, pull, curvature)


class _OnCircle(NamedTuple):
    """Where on its circle an image's point is: r, sin and cos of theta, and F there."""

    radius: Array
    sine: Array
    cosine: Array
    slope: Array
    plain: Array
    exact: Array
    held: Array


class Circle(Belief):
    """q_i - p_i(y_i), with y_i unknown: the explicit joint problem.

    In the angle theta along the circle, y = r sin(theta), half the terms of an image with y_i are r
    F(theta) and what does not depend on theta: with weights w (across, axial) and u (prior),

        F = -a s - b c + k s^2 / 2,    a = w_y q_y,  b = w_z q_z,  k = (w_y + u - w_z) r,

    s and c sine and cosine. A step of Halley's from tan(theta) = a / (b + k) needs one root, two
    divisions and no trigonometry; where it leaves a slope, eliminating theta takes the rest to
    first order. The Schur complement of theta is that of y.

    Attributes:
        sigma: SDs of the lateral, elevational and axial components, mm.
        offset_sd: SD of y_i, mm; inf for none.
        bound: of |y_i|, mm, or None; it is kept below 0.95 of the range in any case.
    """

    sigma: Float[Array, "3 lanes"]
    offset_sd: Float[Array, " lanes"]
    bound: Float[Array, "lanes n"] | None = None

    def padded(self) -> Circle:
        if self.bound is None:
            return self
        return Circle(self.sigma, self.offset_sd, whole(self.bound, 0.0))

    def _solve(self, q: Vector, images: Images) -> _OnCircle:
        """The point of every image's circle that belongs to q."""
        across, axial = (1 / (sd * sd)[:, None] for sd in self.sigma[1:])
        prior = (1 / (self.offset_sd * self.offset_sd))[:, None]
        radius = jnp.abs(images.distance)
        a, b, k = across * q[1], axial * q[2], (across + prior - axial) * radius

        def at(s: Array, c: Array) -> tuple[Array, Array, Array]:
            slope = (b + k * c) * s - a * c
            exact = a * s + b * c + k * (c * c - s * s)
            plain = radius * ((across + prior) * (c * c) + axial * (s * s))
            return slope, plain, exact

        # Exact where k = 0, and nearly where theta is small; at 90 degrees behind the probe.
        ahead = jnp.maximum(b + k, jnp.finfo(a.dtype).tiny ** 0.25)
        inverse = jax.lax.rsqrt(a * a + ahead * ahead)
        s, c = a * inverse, ahead * inverse
        slope, plain, exact = at(s, c)
        third = a * c - (b + 4 * k * c) * s
        convex = exact > 0.1 * plain
        up = slope * jnp.where(convex, exact, 1)
        down = 2 * jnp.where(convex, exact * exact, plain) - jnp.where(convex, slope * third, 0)
        # tan(half the turn) = -up / down, by the half-angle formulae.
        keep, turn, inverse = down * down - up * up, -2 * up * down, 1 / (down * down + up * up)
        s, c = (s * keep + c * turn) * inverse, (c * keep - s * turn) * inverse
        # Within the limit the angle has its cosine; only the limit's own takes another root.
        limit, beside = self._limit(radius)
        above, below = s >= limit, s <= -limit
        bounded = above | below
        s = jnp.where(above, limit, jnp.where(below, -limit, s))
        c = jnp.where(bounded | (c < beside), beside, c)
        slope, plain, exact = at(s, c)
        held = (above & (slope < 0)) | (below & (slope > 0))
        return _OnCircle(radius, s, c, slope, plain, exact, held)

    def _limit(self, radius: Array) -> tuple[Array | float, Array | float]:
        """Sine and cosine of the largest theta."""
        if self.bound is None:
            return LARGEST_ELEVATION, (1 - LARGEST_ELEVATION**2) ** 0.5
        sine = jnp.minimum(self.bound / radius, LARGEST_ELEVATION)
        return sine, jnp.sqrt(1 - sine * sine)

    def offset(self, guess: Guess, images: Images) -> Float[Array, "lanes n"]:
        """y_i at a guess, mm."""
        count, images = images.mask.shape[1], images.padded()
        q, _ = targets(guess, images)
        there = self.padded()._solve(q, images)
        # One more Newton step from a place that is as good as exact.
        steep = jnp.where(there.exact > 0, there.exact, there.plain)
        turn = jnp.where(there.held, 0.0, -there.slope / steep)
        sine = there.sine * (1 - 0.5 * turn * turn) + there.cosine * turn
        return (images.mask * there.radius * sine)[:, :count]

    def term(self, q: Vector, images: Images, gate: Float[Array, "lanes 1"]) -> Term:
        there = self._solve(q, images)
        w = [images.mask * (1 / (sd * sd))[:, None] for sd in self.sigma]
        across, axial = (1 / (sd * sd)[:, None] for sd in self.sigma[1:])
        prior = images.mask * (1 / (self.offset_sd * self.offset_sd))[:, None]
        y, slope = there.radius * there.sine, there.slope
        errors = [q[0] - images.lateral, q[1] - y, q[2] - there.radius * there.cosine]
        pull = [a * b for a, b in zip(w, errors, strict=True)]
        # Eliminate theta_i with what is left of its slope: one more Newton step, to first order.
        own = jnp.where((gate > 0) & (there.exact > 0), there.exact, there.plain)
        give = jnp.where(there.held, 0.0, images.mask * there.radius / own)
        meets = [-across * there.cosine, axial * there.sine]
        eliminated = [give * b for b in meets]
        cost = unrolled.dot(pull, errors) + prior * y * y - give * slope * slope
        mixed = -eliminated[0] * meets[1]
        return Term(
            cost=cost,
            gradient=[
                pull[0], pull[1] - eliminated[0] * slope, pull[2] - eliminated[1] * slope
            ],
            curvature=[
                [w[0], 0, 0],
                [0, w[1] - eliminated[0] * meets[0], mixed],
                [0, mixed, w[2] - eliminated[1] * meets[1]],
            ],
        )  # fmt: skip

    def largest_weight(self) -> Float[Array, " lanes"]:
        return 1 / jnp.min(self.sigma, axis=0)

    def planar_weight(self) -> Float[Array, "3 lanes"]:
        lateral, across, axial = self.sigma
        loose = 1 / self.offset_sd**2
        if self.bound is not None:
            # A uniform law's variance.
            loose = loose + 3 / jnp.max(self.bound, axis=1) ** 2
        return 1 / jnp.stack([lateral**2, across**2 + 1 / loose, axial**2])


def contributions(
    q: Vector, turned: Matrix, term: Term, gate: Float[Array, "lanes 1"] | int
) -> tuple[Vector, Vector]:
    """An image's part of the 45 curvatures and the 9 gradients, as planes (or structural 0).

    The gate says how much of the second derivatives of q there is to be; 0 for none. They come
    with A = [q]x' K + [g]x in the place of [q]x' K: A M has all of (w, d), and A [q]x has (w, w)
    but for an antisymmetric part that :func:`with_twist` takes from the summed gradient.
    """
    g, k = term.gradient, term.curvature
    lever = unrolled.cross(q)
    across, forth = unrolled.product(k, lever), unrolled.product(k, turned)
    inverse = unrolled.transpose(turned)
    bent = unrolled.cross([unrolled.times(gate, value) for value in g])
    back = [
        [unrolled.add(a, b) for a, b in zip(*rows, strict=True)]
        for rows in zip(unrolled.transpose(across), bent, strict=True)
    ]
    about, mixed = unrolled.product(back, lever), unrolled.product(back, turned)
    point = unrolled.product(inverse, forth)
    full: Matrix = [[0] * UNKNOWNS for _ in range(UNKNOWNS)]
    for i in range(3):
        for j in range(3):
            full[i][j] = k[i][j]
            full[i][3 + j] = unrolled.times(-1, across[i][j])
            full[i][6 + j] = unrolled.times(-1, forth[i][j])
            full[3 + i][3 + j] = about[i][j]
            full[3 + i][6 + j] = mixed[i][j]
            full[6 + i][6 + j] = point[i][j]
    gradient = [unrolled.times(-1, value) for value in g]
    gradient += unrolled.apply(unrolled.transpose(lever), g) + unrolled.apply(inverse, g)
    return [full[i][j] for i, j in PAIRS], gradient


def total(planes: Vector) -> Vector:
    """Sum every plane over its images (last), all in one reduction; structural zeros are zeros."""
    given = [plane for plane in planes if not unrolled.is_zero(plane)]
    none = [jnp.zeros((), plane.dtype) for plane in given]

    def plus(a: tuple, b: tuple) -> tuple:
        return tuple(x + y for x, y in zip(a, b, strict=True))

    sums = iter(jax.lax.reduce(tuple(given), tuple(none), plus, (given[0].ndim - 1,)))
    zero = jnp.zeros(given[0].shape[:-1], given[0].dtype)
    return [zero if unrolled.is_zero(plane) else next(sums) for plane in planes]


class Normal(eqx.Module):
    """The normal equations of every lane at a guess, lanes last.

    Attributes:
        curvature: upper triangle, in the order of :data:`PAIRS`.
        gradient: of half the cost.
        cost: sum of squared (whitened) residuals.
    """

    curvature: Float[Array, "45 lanes"]
    gradient: Float[Array, "9 lanes"]
    cost: Float[Array, " lanes"]

    def matrix(self) -> Matrix:
        """The full matrix, as rows of lanes."""
        return unrolled.symmetric(unrolled.rows_of(self.curvature))

    def diagonal(self) -> Float[Array, "9 lanes"]:
        """Its diagonal."""
        return jnp.stack([self.curvature[PAIRS.index((k, k))] for k in range(UNKNOWNS)])


def accumulate(
    guess: Guess, belief: Belief, images: Images, gate: Float[Array, " lanes"]
) -> Normal:
    """One pass: the normal equations at a guess.

    Args:
        guess: X and c of every lane.
        belief: whose residuals.
        images: the data.
        gate: 1 for exact second derivatives, 0 for Gauss-Newton's.
    """
    wide = gate[:, None]
    q, turned = targets(guess, images)
    term = belief.term(q, images, wide)
    curvature, gradient = contributions(q, turned, term, wide)
    sums = total([*curvature, *gradient, term.cost])
    gradient = sums[45:54]
    flat = with_twist(sums[:45], [gate * value for value in gradient[:6]])
    return Normal(jnp.stack(flat), jnp.stack(gradient), sums[54])


def with_twist(flat: Vector, gradient: Vector) -> Vector:
    """A flat curvature completed by what the summed gradient knows of q's second derivatives.

    Args:
        flat: sums of :func:`contributions`.
        gradient: summed along v and w, times the gate. The first is -sum g: (v, w) gets [sum g]x.
            The second is sum g x q: the upper half of A [q]x has q_i g_j where (w, w) has the mean
            of that and q_j g_i.
    """
    twist = unrolled.cross([-value for value in gradient[:3]])
    lean = unrolled.cross([0.5 * value for value in gradient[3:6]])
    flat = list(flat)
    for i in range(3):
        for j in range(3):
            place = PAIRS.index((i, 3 + j))
            flat[place] = unrolled.add(flat[place], twist[i][j])
            if j > i:
                place = PAIRS.index((3 + i, 3 + j))
                flat[place] = unrolled.add(flat[place], unrolled.times(-1, lean[i][j]))
    return flat
