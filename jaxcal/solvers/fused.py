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

    @property
    def used(self) -> Float[Array, " lanes"]:
        """Number of used images."""
        return jnp.sum(self.mask, axis=1)


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
    translation = [value[:, None] for value in guess.translation]
    poses = [[images.rotation[3 * i + j] for j in range(3)] for i in range(3)]
    turned = unrolled.product(inverse, unrolled.transpose(poses))
    apart = [guess.point[j][:, None] - images.origin[j] for j in range(3)]
    shift = unrolled.apply(inverse, translation)
    q = [a - b for a, b in zip(unrolled.apply(turned, apart), shift, strict=True)]
    return q, turned


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

    def largest_weight(self) -> Float[Array, " lanes"] | float:
        """How much a mm of error can be in a whitened residual."""
        return 1.0


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


class Held(Belief):
    """q_i - p_i(y_i) with y_i held, all weights 1, mm; y_i = 0 is the conventional calibration.

    Attributes:
        elevation: y_i, mm.
    """

    elevation: Float[Array, "lanes n"]

    def term(self, q: Vector, images: Images, gate: Float[Array, "lanes 1"]) -> Term:
        axial = jnp.sqrt(images.distance**2 - self.elevation**2)
        errors = [q[0] - images.lateral, q[1] - self.elevation, q[2] - axial]
        pull = [images.mask * error for error in errors]
        cost = pull[0] * errors[0] + pull[1] * errors[1] + pull[2] * errors[2]
        curvature = [[images.mask if i == j else 0 for j in range(3)] for i in range(3)]
        return Term(cost, pull, curvature)


class Circle(Belief):
    """q_i - p_i(y_i), with y_i unknown: the explicit joint problem.

    Attributes:
        sigma: SDs of the lateral, elevational and axial components, mm.
        offset_sd: SD of y_i, mm; inf for none.
        bound: of |y_i|, mm; it is kept below 0.95 of the range in any case.
        steps: Newton steps on y_i.
    """

    sigma: Float[Array, "3 lanes"]
    offset_sd: Float[Array, " lanes"]
    bound: Float[Array, "lanes n"]
    steps: int = eqx.field(static=True, default=3)

    def _solve(self, q: Vector, images: Images) -> tuple[Array, ...]:
        """y_i, and the gradient, Gauss-Newton's and the exact curvature along it there."""
        across, axial = (1 / (sd * sd)[:, None] for sd in self.sigma[1:])
        prior = (1 / (self.offset_sd * self.offset_sd))[:, None]
        limit = jnp.minimum(self.bound, LARGEST_ELEVATION * jnp.abs(images.distance))
        y = jnp.clip(across * q[1] / (across + prior), -limit, limit)

        def at(y: Array) -> tuple[Array, ...]:
            inverse = jax.lax.rsqrt(images.distance**2 - y * y)
            slope = -y * inverse
            error = q[2] - (images.distance**2 - y * y) * inverse
            gradient = across * (y - q[1]) - axial * error * slope + prior * y
            plain = across + axial * slope * slope + prior
            exact = plain + axial * error * images.distance**2 * inverse**3
            return gradient, plain, exact, slope, error

        for _ in range(self.steps):
            gradient, plain, exact, _, _ = at(y)
            newton = gradient / jnp.where(exact > 0.1 * plain, exact, plain)
            y = jnp.clip(y - newton, -limit, limit)
        gradient, plain, exact, slope, error = at(y)
        held = ((y >= limit) & (gradient < 0)) | ((y <= -limit) & (gradient > 0))
        return y, gradient, plain, exact, slope, error, held

    def offset(self, q: Vector, images: Images) -> Float[Array, "lanes n"]:
        """y_i, mm."""
        return images.mask * self._solve(q, images)[0]

    def term(self, q: Vector, images: Images, gate: Float[Array, "lanes 1"]) -> Term:
        y, along, plain, exact, slope, error, held = self._solve(q, images)
        w = [images.mask * (1 / (sd * sd))[:, None] for sd in self.sigma]
        prior = images.mask * (1 / (self.offset_sd * self.offset_sd))[:, None]
        errors = [q[0] - images.lateral, q[1] - y, error]
        pull = [a * b for a, b in zip(w, errors, strict=True)]
        # Eliminate y_i with what is left of its gradient: one more Newton step, to first order.
        own = jnp.where((gate > 0) & (exact > 0), exact, plain)
        give = jnp.where(held, 0.0, 1.0 / own)
        meets = [-w[1], -w[2] * slope]
        eliminated = [give * b for b in meets]
        cost = unrolled.dot(pull, errors) + prior * y * y - images.mask * give * along * along
        return Term(
            cost=cost,
            gradient=[
                pull[0], pull[1] - eliminated[0] * along, pull[2] - eliminated[1] * along
            ],
            curvature=[
                [w[0], 0, 0],
                [0, w[1] - eliminated[0] * meets[0], -eliminated[0] * meets[1]],
                [0, -eliminated[1] * meets[0], w[2] - eliminated[1] * meets[1]],
            ],
        )  # fmt: skip

    def largest_weight(self) -> Float[Array, " lanes"]:
        return 1 / jnp.min(self.sigma, axis=0)


def contributions(
    q: Vector, turned: Matrix, term: Term, gate: Float[Array, "lanes 1"] | int
) -> tuple[Vector, Vector]:
    """An image's part of the 45 curvatures and the 9 gradients, as planes (or structural 0).

    The gate says how much of the second derivatives of q there is to be; 0 for none.
    """
    g, k = term.gradient, term.curvature
    lever = unrolled.cross(q)
    across, forth = unrolled.product(k, lever), unrolled.product(k, turned)
    back, inverse = unrolled.transpose(lever), unrolled.transpose(turned)
    about, mixed = unrolled.product(back, across), unrolled.product(back, forth)
    point = unrolled.product(inverse, forth)
    gated = [unrolled.times(gate, value) for value in g]
    inner = unrolled.dot(gated, q)
    twist = unrolled.product(unrolled.cross(gated), turned)
    full: Matrix = [[0] * UNKNOWNS for _ in range(UNKNOWNS)]
    for i in range(3):
        for j in range(3):
            bent = unrolled.add(
                unrolled.times(gated[i], 0.5 * q[j]), unrolled.times(gated[j], 0.5 * q[i])
            )
            if i == j:
                bent = unrolled.add(bent, unrolled.times(-1, inner))
            full[i][j] = k[i][j]
            full[i][3 + j] = unrolled.times(-1, across[i][j])
            full[i][6 + j] = unrolled.times(-1, forth[i][j])
            full[3 + i][3 + j] = unrolled.add(about[i][j], bent)
            full[3 + i][6 + j] = unrolled.add(mixed[i][j], twist[i][j])
            full[6 + i][6 + j] = point[i][j]
    gradient = [unrolled.times(-1, value) for value in g]
    gradient += unrolled.apply(back, g) + unrolled.apply(inverse, g)
    return [full[i][j] for i, j in PAIRS], gradient


def total(planes: Vector) -> Vector:
    """Sum every plane over its images, all in one reduction; structural zeros become zeros."""
    given = [plane for plane in planes if not unrolled.is_zero(plane)]
    none = [jnp.zeros((), plane.dtype) for plane in given]

    def plus(a: tuple, b: tuple) -> tuple:
        return tuple(x + y for x, y in zip(a, b, strict=True))

    sums = iter(jax.lax.reduce(tuple(given), tuple(none), plus, (1,)))
    zero = jnp.zeros(given[0].shape[0], given[0].dtype)
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
    flat = with_twist(sums[:45], [gate * value for value in gradient[:3]])
    return Normal(jnp.stack(flat), jnp.stack(gradient), sums[54])


def with_twist(flat: Vector, gradient: Vector) -> Vector:
    """A flat curvature with the (v, w) block of q's second derivatives, [sum g]x, added.

    It needs nothing but the summed gradient along v, which is -sum g.
    """
    twist = unrolled.cross([-value for value in gradient])
    flat = list(flat)
    for i in range(3):
        for j in range(3):
            place = PAIRS.index((i, 3 + j))
            flat[place] = unrolled.add(flat[place], twist[i][j])
    return flat
