"""What an image measures: its residuals, as functions of where the target is in it.

With q = (q_x, q_y, q_z) the target in the image's frame (lateral, elevational, axial; mm), (x, r)
the measured lateral position and range, the target lies on a circle about the element line (the
paper's Eq. 5):

    p(y) = (x, y, sqrt(r^2 - y^2)).

An *observation* turns q, and further unknowns such as the pixels' scale, into residual planes, in
groups (*components*) that share one SD. The solvers know residuals from here only: derivatives
follow from these functions (:mod:`jaxcal.model.derivatives`),
:mod:`jaxcal.solvers.normal_equations` sums over the images, and every method is a loop on those
sums. A new observation needs one class here and one line in :mod:`jaxcal.solvers.methods`.
Diagnostics, which need no JAX, have the errors of points in numpy as well
(:mod:`jaxcal.diagnostics.image_errors`).

- :class:`Points`: errors of lateral position and range, and the offset itself (y_i = q_y), each
  with its SD; :class:`OwnCovariances`: the same with a covariance for every image.
- :class:`ChannelDistances`: predicted less measured distance of each element (Eqs. 5 and 6).
- :class:`InPlane`: q - p(0), equally weighted: the conventional Eq. 7.
- :class:`HeldOffsets`: q - p(y) with given y: a half-round of the alternation.
- :class:`BoundedOffsets`: q - p(y) with |y| <= bound unknown: what the alternation descends.
- :class:`TrackedPoints`: points whose tracker has errors of its own.

The last two have one more unknown in each image, which is eliminated there.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxcal import InputError
from jaxcal.data.problem import Problem
from jaxcal.model.arc import arc_limit
from jaxcal.model.batch import ImagePlanes, Iterate, check_batch, targets
from jaxcal.model.unknowns import (
    FURTHER,
    TABLE,
    Blocks,
    block_slice,
    further_slice,
    measured,
    predicted_distance,
    step_between,
    stepped,
    with_prior,
)
from jaxcal.model.unrolled import Matrix, Vector, add, inverse_root, root
from jaxcal.runtime.array_types import AnyArray
from jaxcal.runtime.arrays import each_image, is_traced
from jaxcal.runtime.given_values import real_array

TRACKER_STEPS = 4
"""Newton steps for a tracker's elevational error; the range curves so little that two would do."""


class FurtherUnknowns(eqx.Module):
    """What residuals may depend on beside q: the free further unknowns, and the rotation M_i.

    Attributes:
        values: by name (:mod:`jaxcal.model.unknowns`), a plane (batch, 1) for each component.
        tracker_to_image: M_i = R' R_i', the rotation of directions from the tracker's frame to the
            image's, three rows of three planes (batch, n); None unless the observation is
            :attr:`Observation.oriented`.
    """

    values: dict[str, Vector]
    tracker_to_image: Matrix | None = None

    @classmethod
    def of(
        cls, iterate: Iterate, tangent: Vector, tracker_to_image: Matrix | None = None
    ) -> FurtherUnknowns:
        """The iterate's further unknowns, moved by a step, and the tracker's axes."""
        values = {}
        for name in FURTHER:
            components = iterate.further(name)
            if components is not None:
                steps = tangent[further_slice(iterate.blocks, name)]
                values[name] = [
                    stepped(name, value[:, None], step, jnp.exp)
                    for value, step in zip(components, steps, strict=True)
                ]
        return cls(values, tracker_to_image)

    @classmethod
    def at(cls, iterate: Iterate, tracker_to_image: Matrix | None = None) -> FurtherUnknowns:
        """The iterate's further unknowns as they are."""
        still = jnp.zeros_like(iterate.point[0])[:, None]
        return cls.of(iterate, [still] * iterate.further_values.shape[0], tracker_to_image)

    def points(self, images: ImagePlanes) -> tuple[Array, Array]:
        """Lateral position and range of every image, mm."""
        return measured(images.lateral, images.axial, images.face[:, None], self.values)

    def predicted_distance(self, distance: Array) -> Array:
        """What elements would measure of targets at distances (batch, n, elements), mm."""
        planes = {name: [v[..., None] for v in value] for name, value in self.values.items()}
        return predicted_distance(distance, planes)


class Component(eqx.Module):
    """Residual planes that share one SD.

    Attributes:
        errors: planes (batch, n), or (batch, n, elements), mm.
        present: 1 where there is a residual, in addition to the images' mask; None: everywhere.
    """

    errors: Vector
    present: Array | None = None


class Observation(eqx.Module):
    """What every observation provides.

    Solvers add images that do not count, up to whole vectors of 64 bytes. So an array of an
    observation that has an axis of images names it ``n`` in its annotation, for example
    ``Float[Array, "batch n"]`` of jaxtyping.

    Attributes:
        sigma: SD of each component, mm; ones where residuals are not in SDs.

    Raises:
        InputError: an SD that is not positive; inf stands for nothing known.
    """

    sigma: eqx.AbstractVar[Float[Array, "components batch"]]
    whitened: ClassVar[bool] = True
    """Whether residuals are divided by their SDs; else their variance is estimated from them."""
    oriented: ClassVar[bool] = False
    """Whether residuals depend on the image's orientation other than through q."""
    error_sd: ClassVar[tuple[int, int, int]] = (0, 1, 2)
    """Where in ``sigma`` the SDs of lateral position, range and offset are, if whitened."""

    def __check_init__(self) -> None:
        _check_values("sigma", self.sigma)

    @abc.abstractmethod
    def components(
        self, q: Vector, further: FurtherUnknowns, images: ImagePlanes
    ) -> list[Component]:
        """The residuals of every image.

        Args:
            q: the target in every image's frame [lateral, elevational, axial], mm: three planes
                (batch, n).
            further: the free further unknowns; for an ``oriented`` observation also M_i.
            images: the data.

        Returns:
            One component for each SD in ``sigma``, in the same order.
        """

    def count(self, images: ImagePlanes) -> Float[Array, "components batch"]:
        """How many residuals each component has."""
        return jnp.broadcast_to(images.used, self.sigma.shape)

    def with_sigma(self, sigma: Float[Array, "components batch"]) -> Observation:
        """The same with other SDs."""
        return eqx.tree_at(lambda observation: observation.sigma, self, sigma)

    def largest_weight(self) -> Float[Array, " batch"]:
        """Largest change of a whitened residual for a mm of error, 1/mm."""
        return 1 / jnp.min(self.sigma, axis=0)

    def geometry(self, images: ImagePlanes, blocks: Blocks) -> Observation:
        """The observation whose unweighted residuals show which unknowns the poses determine.

        Args:
            images: the data.
            blocks: the free unknowns.
        """
        del images, blocks
        return self

    def padded(self, images: ImagePlanes) -> Observation:
        """The same for images that :meth:`ImagePlanes.padded` has added some to."""
        count = images.mask.shape[1]

        def longer(values: Array, axis: int) -> Array:
            # Those added repeat the last one, in its range as in all that belongs to it.
            added = [(0, 0)] * values.ndim
            added[axis] = (0, count - values.shape[axis])
            return jnp.pad(values, added, mode="edge")

        return each_image(self, longer)

    def in_units(self, sigma: Float[Array, "components batch"]) -> Observation:
        """The same, with residuals formed with these SDs where they depend on the ratio of SDs."""
        del sigma
        return self

    def growth(
        self,
        before: Float[Array, "components batch"],
        now: Float[Array, "components batch"],
        squares: Float[Array, "components batch"],
    ) -> Float[Array, " batch"] | float:
        """Largest growth of half the cost that is due to :meth:`in_units` alone, not to a step.

        Args:
            before: the SDs with which the residuals were formed before.
            now: the SDs with which they are formed now.
            squares: of the whitened residuals, summed over the images.
        """
        del before, now, squares
        return 0.0


def _check_values(name: str, values: Any, *, zero: bool = False, unit: str = "mm") -> None:
    """Refuse NaN and what is below zero (or is zero), where the values are known already."""
    if is_traced(values):
        return
    known = real_array(values, name)
    if not (known >= 0 if zero else known > 0).all():
        raise InputError(f"{name} must be {'zero or ' if zero else ''}positive, {unit}")


class Points(Observation):
    """Lateral position, range and elevational offset, each with its SD; y_i is q_y itself.

    Attributes:
        sigma: SDs of lateral position, range and offset, mm.
    """

    sigma: Float[Array, "3 batch"]

    def components(
        self, q: Vector, further: FurtherUnknowns, images: ImagePlanes
    ) -> list[Component]:
        lateral, distance = errors(q, further, images)
        return [Component([lateral]), Component([distance]), Component([q[1]])]

    def geometry(self, images: ImagePlanes, blocks: Blocks) -> Observation:
        # Of points a delay only shifts X; what offsets tell it apart by is far below their errors.
        return InPlane.of(images) if "delay" in blocks else self


def errors(q: Vector, further: FurtherUnknowns, images: ImagePlanes) -> tuple[Array, Array]:
    """Error of lateral position and of range, mm, of every image."""
    lateral, distance = further.points(images)
    square = q[1] * q[1] + q[2] * q[2]
    return q[0] - lateral, root(square) - distance


def factor_of(shape: Float[Array, "3 batch n"]) -> tuple[Array, Array, Array]:
    """Cholesky factors of 2x2 matrices: first, off-diagonal and last entry."""
    first = jnp.sqrt(shape[0])
    mixed = shape[1] / first
    return first, mixed, jnp.sqrt(shape[2] - mixed * mixed)


class OwnCovariances(Observation):
    """Points whose errors have a covariance of their own in every image.

    Attributes:
        sigma: SDs of lateral position, range and offset, mm; with ``tied``, the measurements'
            common factor and the SD of the offset.
        shape: lateral variance, covariance, range variance of every image; without ``tied`` their
            mean variances are 1, with it they are in mm^2 up to one factor.
        ratio: range SD over lateral SD, for whitening.
        tied: whether one factor is the SD of both measurements (static).
    """

    sigma: Float[Array, "components batch"]
    shape: Float[Array, "3 batch n"]
    ratio: Float[Array, " batch"]
    tied: bool = eqx.field(static=True, default=False)

    def components(
        self, q: Vector, further: FurtherUnknowns, images: ImagePlanes
    ) -> list[Component]:
        lateral, distance = errors(q, further, images)
        first, mixed, second = factor_of(self.shape)
        white_lateral = lateral / first
        # A mm of lateral error counts as ``ratio`` mm of range error.
        white_distance = (distance - self.ratio[:, None] * mixed * white_lateral) / second
        if self.tied:
            return [Component([white_lateral, white_distance]), Component([q[1]])]
        return [Component([white_lateral]), Component([white_distance]), Component([q[1]])]

    def count(self, images: ImagePlanes) -> Float[Array, "components batch"]:
        used = images.used
        return jnp.stack([2 * used, used] if self.tied else [used] * 3)

    def in_units(self, sigma: Float[Array, "components batch"]) -> OwnCovariances:
        if self.tied:
            return self
        ratio = sigma[1] / sigma[0]
        # Before the first pass SDs are infinite, and say nothing of their ratio.
        ratio = jnp.where(jnp.isfinite(ratio), ratio, self.ratio)
        return eqx.tree_at(lambda o: o.ratio, self, ratio)

    def growth(
        self,
        before: Float[Array, "components batch"],
        now: Float[Array, "components batch"],
        squares: Float[Array, "components batch"],
    ) -> Float[Array, " batch"] | float:
        if self.tied:
            return 0.0
        # The second residual contains at most this share of the first; then Cauchy-Schwarz.
        _, mixed, second = factor_of(self.shape)
        part = jnp.max(jnp.abs(mixed) / second, axis=1)
        change = jnp.abs(jnp.log(now[1] / now[0]) - jnp.log(before[1] / before[0]))
        # Before the first pass SDs are infinite: nothing can be compared.
        change = jnp.where(jnp.isfinite(change), change, jnp.inf)
        growth = change * part * jnp.sqrt(squares[0] * squares[1])
        return jnp.where(part > 0, growth, 0.0)

    def with_sigma(self, sigma: Float[Array, "components batch"]) -> Observation:
        return super().with_sigma(sigma).in_units(sigma)

    def geometry(self, images: ImagePlanes, blocks: Blocks) -> Observation:
        return InPlane.of(images)


def variance_planes(covariance: Float[Array, "batch n 2 2"]) -> Float[Array, "3 batch n"]:
    """Lateral variance, covariance and range variance as planes."""
    return jnp.stack([covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]])


def unit_shape(
    variances: Float[Array, "3 batch n"], images: ImagePlanes
) -> tuple[Float[Array, "3 batch n"], Float[Array, "2 batch"]]:
    """Covariances scaled so that the used images' mean variances are 1, and those means, mm^2.

    Covariances of zero (exact data) have no shape: they become unit matrices of mean 1.
    """
    mean = jnp.sum(images.mask * variances[::2], axis=2) / images.used
    known = jnp.all(mean > 0, axis=0)
    mean = jnp.where(known, mean, 1.0)
    return rescaled(variances, 1 / jnp.sqrt(mean), known[:, None] & (images.mask > 0)), mean


def rescaled(
    variances: Float[Array, "3 batch n"],
    factors: Float[Array, "2 batch"],
    where: Bool[Array, "batch n"],
) -> Float[Array, "3 batch n"]:
    """Covariances of errors that are multiplied by factors; unit matrices elsewhere."""
    lateral, axial = factors
    by = jnp.stack([lateral * lateral, lateral * axial, axial * axial])
    unit = jnp.asarray([1.0, 0.0, 1.0], variances.dtype)[:, None, None]
    return jnp.where(where, variances * by[..., None], unit)


class ChannelDistances(Observation):
    """Distance of the target from every element that heard it, and the elevational offset.

    With the sound speed s times the nominal one, and a delay worth d mm, an element at distance
    |q - e| measures |q - e| / s + d. On a curvilinear probe an image's distances give information
    about |y_i|, through Eq. 6, but not about the sign of y_i. The poses, which share one X and one
    target, determine the sign.

    Attributes:
        sigma: SDs of an element's distance and of the offset, mm.
    """

    sigma: Float[Array, "2 batch"]
    # Lateral position and range both come from the elements' distances.
    error_sd: ClassVar[tuple[int, int, int]] = (0, 0, 1)

    def components(
        self, q: Vector, further: FurtherUnknowns, images: ImagePlanes
    ) -> list[Component]:
        channels = images.channels
        if channels is None:
            raise InputError("the problem has no times of flight")
        square = 0.0
        for value, element in zip(q, channels.elements, strict=True):
            square = square + (value[..., None] - element[:, None, :]) ** 2
        exact = further.predicted_distance(root(square))
        return [Component([exact - channels.distances], channels.heard), Component([q[1]])]

    def count(self, images: ImagePlanes) -> Float[Array, "2 batch"]:
        assert images.channels is not None
        heard = jnp.sum(images.mask[..., None] * images.channels.heard, axis=(1, 2))
        return jnp.stack([heard, images.used])


def _unit(images: ImagePlanes) -> Float[Array, "1 batch"]:
    return jnp.ones((1, images.batch_size), images.mask.dtype)


def on_circle(q: Vector, y: Array, further: FurtherUnknowns, images: ImagePlanes) -> Vector:
    """Residuals q - p(y) of Eq. 7 at a given offset, mm; NaN where it exceeds the range."""
    lateral, distance = further.points(images)
    return [q[0] - lateral, q[1] - y, q[2] - root(distance * distance - y * y)]


class InPlane(Observation):
    """q - p(0), every target taken to lie in the image plane: the conventional Eq. 7, mm.

    Attributes:
        sigma: ones, for all axes together or for each of them; the residuals stay in mm.
    """

    sigma: Float[Array, "components batch"]
    whitened: ClassVar[bool] = False

    @classmethod
    def of(cls, images: ImagePlanes) -> InPlane:
        """For these images."""
        return cls(_unit(images))

    def by_axis(self) -> InPlane:
        """The same with the axes as components of their own: lateral, elevational, axial."""
        return InPlane(jnp.repeat(self.sigma[:1], 3, axis=0))

    def components(
        self, q: Vector, further: FurtherUnknowns, images: ImagePlanes
    ) -> list[Component]:
        lateral, distance = further.points(images)
        errors = [q[0] - lateral, q[1], q[2] - distance]
        together = len(self.sigma) == 1
        return [Component(errors)] if together else [Component([error]) for error in errors]


class HeldOffsets(Observation):
    """q - p(y) with the offsets y held, mm.

    Attributes:
        sigma: ones; the residuals stay in mm.
        offset: y_i, mm.
    """

    sigma: Float[Array, "1 batch"]
    offset: Float[Array, "batch n"]
    whitened: ClassVar[bool] = False

    @classmethod
    def of(cls, offset: Float[Array, "batch n"], images: ImagePlanes) -> HeldOffsets:
        """For these images."""
        return cls(_unit(images), offset)

    def components(
        self, q: Vector, further: FurtherUnknowns, images: ImagePlanes
    ) -> list[Component]:
        return [Component(on_circle(q, self.offset, further, images))]


class LocalUnknown(Observation):
    """An observation with one more unknown in every image, which is eliminated there."""

    @abc.abstractmethod
    def local(
        self, q: Vector, further: FurtherUnknowns, images: ImagePlanes
    ) -> tuple[Array, Array]:
        """The image's own unknown at its best for given q, and 1 where it is free (0 on a bound).

        Both are planes (batch, n). The arguments are those of :meth:`Observation.components`.
        """

    @abc.abstractmethod
    def components_at(
        self, q: Vector, local: Array, further: FurtherUnknowns, images: ImagePlanes
    ) -> list[Component]:
        """:meth:`Observation.components` at a value of the image's own unknown."""

    def components(
        self, q: Vector, further: FurtherUnknowns, images: ImagePlanes
    ) -> list[Component]:
        return self.components_at(q, self.local(q, further, images)[0], further, images)

    def geometry(self, images: ImagePlanes, blocks: Blocks) -> Observation:
        return InPlane.of(images)


def local_unknowns(
    iterate: Iterate, observation: LocalUnknown, images: ImagePlanes
) -> Float[Array, "batch n"]:
    """Every image's own unknown at its best; 0 for images left out."""
    q, tracker_to_image = targets(iterate, images)
    return (
        images.mask * observation.local(q, FurtherUnknowns.at(iterate, tracker_to_image), images)[0]
    )


class BoundedOffsets(LocalUnknown):
    """|y_i| <= bound_i and equal weights: the objective that the paper's alternation descends.

    Attributes:
        sigma: ones; the residuals stay in mm.
        bound: m_i, mm; at most 0.95 of the image's range is used.

    Raises:
        InputError: a bound below zero.
    """

    sigma: Float[Array, "1 batch"]
    bound: Float[Array, "batch n"]
    whitened: ClassVar[bool] = False

    def __check_init__(self) -> None:
        _check_values("bound", self.bound, zero=True)

    @classmethod
    def of(cls, bound: Float[Array, "batch n"], images: ImagePlanes) -> BoundedOffsets:
        """For these images."""
        return cls(_unit(images), bound)

    def limit(self, further: FurtherUnknowns, images: ImagePlanes) -> Array:
        """The largest |y_i|, mm."""
        return arc_limit(self.bound, further.points(images)[1])

    def local(
        self, q: Vector, further: FurtherUnknowns, images: ImagePlanes
    ) -> tuple[Array, Array]:
        """The y_i of the point closest to q_i on the arc |y| <= bound (section 2.4), mm.

        On the circle the distance grows with the angle away from q_i. So the closest point of the
        arc is the circle's closest point if that lies on the arc, else the arc's nearer end.
        """
        limit, distance = self.limit(further, images), further.points(images)[1]
        square = q[1] * q[1] + q[2] * q[2]
        closest = distance * q[1] * inverse_root(square)
        # Behind the transducer the arc's nearer end is the one on q's side.
        behind = jnp.where(q[1] < 0, -limit, limit)
        free = jnp.where(q[2] > 0, closest, behind)
        return jnp.clip(free, -limit, limit), jnp.where(jnp.abs(free) < limit, 1.0, 0.0)

    def components_at(
        self, q: Vector, local: Array, further: FurtherUnknowns, images: ImagePlanes
    ) -> list[Component]:
        return [Component(on_circle(q, local, further, images))]


class TrackedPoints(LocalUnknown):
    """Points whose tracker has isotropic errors of SD tau beside those of the measurements.

    The tracker's error moves the target along all three axes. Along the lateral axis and the range
    it adds to the SDs. Along the elevational axis it makes the offset differ from q_y:
    y_i = q_y + tau u_i. The image's own unknown is u_i ~ N(0, 1), which stays well scaled as tau
    goes to 0.

    Attributes:
        sigma: SDs of lateral position, range and offset, mm.
        tracker_sd: tau, mm.
        shape: as in :class:`OwnCovariances`, or None.

    Raises:
        InputError: an SD that is not positive, or a ``tracker_sd`` below zero.
    """

    sigma: Float[Array, "3 batch"]
    tracker_sd: Float[Array, " batch"]
    shape: Float[Array, "3 batch n"] | None = None

    def __check_init__(self) -> None:
        _check_values("tracker_sd", self.tracker_sd, zero=True)

    def components_at(
        self, q: Vector, local: Array, further: FurtherUnknowns, images: ImagePlanes
    ) -> list[Component]:
        # Scaled so that division by the component's SD, which leaves out the tracker, whitens each.
        tau = self.tracker_sd[:, None]
        offset = q[1] + tau * local
        lateral, distance = errors([q[0], offset, q[2]], further, images)
        sigma = [value[:, None] for value in self.sigma]
        if self.shape is None:
            white_lateral = lateral / jnp.hypot(sigma[0], tau)
            white_distance = distance / jnp.hypot(sigma[1], tau)
        else:
            # The tracker's error has one size, whatever the image's own covariance is.
            mixed = sigma[0] * sigma[1] * self.shape[1]
            variances = [sigma[k] ** 2 * self.shape[2 * k] + tau**2 for k in (0, 1)]
            first, mixed, last = factor_of(jnp.stack([variances[0], mixed, variances[1]]))
            white_lateral = lateral / first
            white_distance = (distance - mixed * white_lateral) / last
        return [
            Component([white_lateral * sigma[0]]),
            Component([white_distance * sigma[1]]),
            Component([offset, local * sigma[2]]),
        ]

    def local(
        self, q: Vector, further: FurtherUnknowns, images: ImagePlanes
    ) -> tuple[Array, Array]:
        def halved(local: Array) -> Array:
            parts = self.components_at(q, local, further, images)
            weighed = [
                (error / sd[:, None]) ** 2
                for part, sd in zip(parts, self.sigma, strict=True)
                for error in part.errors
            ]
            return 0.5 * add(*weighed)

        def slope(local: Array) -> Array:
            return jax.jvp(halved, (local,), (jnp.ones_like(local),))[1]

        # Start where the offset alone would put it; the range changes that only a little.
        tau, across = self.tracker_sd[:, None], self.sigma[2][:, None]
        local = -tau * q[1] / (across * across + tau * tau)
        for _ in range(TRACKER_STEPS):
            force, bend = jax.jvp(slope, (local,), (jnp.ones_like(local),))
            local = local - force / jnp.maximum(bend, 1.0)
        return local, jnp.ones_like(local)


class MediumPrior(eqx.Module):
    """Gaussian prior of sound speed and delay, about their nominal values; :meth:`of` makes one.

    Attributes:
        sd: SDs of the steps of those that are free: of the logarithm of the sound speed, and of the
            delay in mm at the nominal speed.
        blocks: the free unknowns (static).
    """

    sd: Float[Array, "k batch"]
    blocks: Blocks = eqx.field(static=True)

    @classmethod
    def of(
        cls, problems: Problem, blocks: Blocks, **prior_sd: Float[AnyArray, ""] | float
    ) -> MediumPrior | None:
        """The prior of those of sound speed and delay that are free; None where neither is.

        Args:
            problems: a batch (one leading axis), for its nominal sound speeds.
            blocks: the free unknowns.
            **prior_sd: ``sound_speed_sd``, m/s, and ``delay_sd``, s, as :func:`jaxcal.calibrate`
                takes them.

        Raises:
            TypeError: another name.
            InputError: an SD that is not positive; one problem, or a batch with more axes.
        """
        check_batch(problems)
        rows = [TABLE[name] for name in with_prior(FURTHER)]
        for name in prior_sd.keys() - {row.prior_name for row in rows}:
            raise TypeError(f"MediumPrior.of() got an unexpected keyword argument {name!r}")
        speed, steps = problems.nominal_sound_speed, []
        for row in rows:
            if row.name in blocks:
                sd = prior_sd.get(row.prior_name, row.prior_sd)
                _check_values(row.prior_name, sd, unit=row.prior_unit)
                steps.append(jnp.broadcast_to(sd * row.per_unit(speed), speed.shape))
        return cls(jnp.stack(steps), blocks) if steps else None

    def deviations(self, iterate: Iterate) -> list[tuple[int, Array, Array]]:
        """Index, deviation from nominal and precision of every component that has a prior.

        Raises:
            InputError: the prior is of other unknowns than the iterate's.
        """
        names = with_prior(iterate.blocks)
        if names != with_prior(self.blocks):
            raise InputError(
                f"this MediumPrior is for the unknowns {self.blocks}, not for {iterate.blocks}"
            )
        found = []
        for name, sd in zip(names, self.sd, strict=True):
            values = iterate.further(name)
            assert values is not None
            for index, value in enumerate(values, block_slice(iterate.blocks, name).start):
                away = step_between(name, TABLE[name].nominal, value, jnp.log)
                found.append((index, away, 1 / (sd * sd)))
        return found
