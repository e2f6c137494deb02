"""A batch of problems as planes: the one place where data change their layout.

Public arrays have the batch axis first and small matrices last. The solvers want the opposite, so
that XLA vectorises over images and over problems: every number of an image is a *plane*, an array
(batch, images), and all other arrays have the batch axis last.

Tracker poses are B_i = (R_i, b_i), X = (R, t), the target is c, and q_i = X^-1 B_i^-1 c is the
target in image i's frame.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcal import InputError
from jaxcal.data.problem import Problem
from jaxcal.model import unrolled
from jaxcal.model.parameters import Parameters
from jaxcal.model.unknowns import (
    FURTHER,
    RIGID_UNKNOWNS,
    Blocks,
    count_unknowns,
    free_unknowns,
    further_slice,
    step_between,
    stepped,
)
from jaxcal.model.unrolled import Matrix, Vector

_CROSS_INDICES = np.array([[0, 2, 1], [2, 0, 0], [1, 0, 0]])
_CROSS_SIGNS = np.array([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])[..., None]
"""[v]x has the entries of v at these indices with these signs."""


class ElementPlanes(eqx.Module):
    """The times of flight, as distances.

    Attributes:
        distances: one-way distances at the nominal sound speed and delay, mm.
        heard: 1 where an element's time of flight is used.
        elements: positions in the image frame [lateral, elevational, axial], mm.
    """

    distances: Float[Array, "batch n elements"]
    heard: Float[Array, "batch n elements"]
    elements: Float[Array, "3 batch elements"]


def check_batch(problems: Problem) -> None:
    """Raise InputError where these problems have not exactly one leading axis."""
    if problems.mask.ndim != 2:
        raise InputError(
            "a batch with one leading axis is needed, e.g. jaxcal.stack([problem]); this one has "
            f"the shape {problems.mask.shape[:-1]}"
        )


class ImagePlanes(eqx.Module):
    """What was measured, one plane (batch, images) for every number.

    Attributes:
        rotation: R_i, from the probe's frame to the tracker's: entry (j, k) at index 3 j + k.
        origin: b_i, the probe's origin in the tracker's frame, mm.
        lateral: lateral position of the target's image at the nominal scale, mm.
        axial: its range from pixel row 0 at the nominal scale, mm.
        face: range of pixel row 0, mm.
        mask: 1 for used images; the others hold finite values without meaning.
        channels: the times of flight, or None.
    """

    rotation: Float[Array, "9 batch n"]
    origin: Float[Array, "3 batch n"]
    lateral: Float[Array, "batch n"]
    axial: Float[Array, "batch n"]
    face: Float[Array, " batch"]
    mask: Float[Array, "batch n"]
    channels: ElementPlanes | None = None

    @classmethod
    def of(cls, problems: Problem, *, channels: bool = False) -> ImagePlanes:
        """The planes of a batch of problems (one leading axis).

        Args:
            problems: the batch.
            channels: include the times of flight.

        Raises:
            InputError: one problem, or a batch with more axes.
        """
        check_batch(problems)
        used = problems.mask > 0

        def plane(values: Array, instead: float) -> Array:
            return jnp.where(used, values, jnp.asarray(instead, problems.mask.dtype))

        points = problems.measurements * problems.spacing[:, None, :]
        # Transposed all at once: entry by entry, every plane would read all of the poses.
        entries = problems.poses.reshape(*problems.mask.shape, 16)
        entries = barrier(jnp.moveaxis(entries, -1, 0)).reshape(4, 4, *problems.mask.shape)
        rotation = [plane(entries[i, j], float(i == j)) for i in range(3) for j in range(3)]
        elements = None
        if channels and problems.channels is not None:
            known = used[..., None]
            elements = ElementPlanes(
                jnp.where(known, problems.channels.distances, 0.0),
                jnp.where(known, problems.channels.heard, 0.0),
                jnp.moveaxis(problems.channels.elements, -1, 0),
            )
        return cls(
            rotation=jnp.stack(rotation),
            origin=jnp.stack([plane(entries[i, 3], 0.0) for i in range(3)]),
            lateral=plane(points[..., 0], 0.0),
            axial=jnp.where(used, points[..., 1], 1.0 - problems.face_offset[:, None]),
            face=problems.face_offset,
            mask=problems.mask,
            channels=elements,
        )

    @property
    def distance(self) -> Float[Array, "batch n"]:
        """Range at the nominal scale, sound speed and delay, mm."""
        return self.axial + self.face[:, None]

    @property
    def used(self) -> Float[Array, " batch"]:
        """Number of used images."""
        return jnp.sum(self.mask, axis=1)

    def padded(self) -> ImagePlanes:
        """With unused images added up to whole 64-byte vectors, so that loops have no remainder."""
        if self.channels is not None:
            return self
        added = pad_images(self.mask).shape[1] - self.mask.shape[1]
        return ImagePlanes(
            pad_images(self.rotation),
            pad_images(self.origin),
            pad_images(self.lateral),
            pad_images(self.axial),
            self.face,
            jnp.pad(self.mask, [(0, 0), (0, added)]),
        )

    def repeated(self, times: int) -> ImagePlanes:
        """The same points (no times of flight), the whole batch ``times`` times over."""
        return ImagePlanes(
            jnp.tile(self.rotation, (1, times, 1)),
            jnp.tile(self.origin, (1, times, 1)),
            jnp.tile(self.lateral, (times, 1)),
            jnp.tile(self.axial, (times, 1)),
            jnp.tile(self.face, times),
            jnp.tile(self.mask, (times, 1)),
        )

    @property
    def batch_size(self) -> int:
        """Number of problems."""
        return self.mask.shape[0]


class Iterate(eqx.Module):
    """A value of the unknowns of every problem of a batch; the batch axis is last.

    Attributes:
        rotation: of X, from the image's frame to the probe's.
        translation: of X: the image's origin in the probe's frame, mm.
        point: the target c in the tracker's frame, mm.
        further_values: components of the free further unknowns, in the order of the blocks: factors
            on scale and sound speed, delay in mm.
        blocks: which unknowns are free (static).
    """

    rotation: Float[Array, "3 3 batch"]
    translation: Float[Array, "3 batch"]
    point: Float[Array, "3 batch"]
    further_values: Float[Array, "further batch"]
    blocks: Blocks = eqx.field(static=True)

    @classmethod
    def of(cls, parameters: Parameters, blocks: Blocks) -> Iterate:
        """From parameters with a leading axis.

        Raises:
            InputError: parameters of one problem, or with more axes; other unknowns than those of
                Eq. 7 and further ones, in the table's order.
        """
        blocks = free_unknowns(blocks)
        if parameters.point.ndim != 2:
            raise InputError(
                "parameters with one leading axis are needed, e.g. of jax.vmap(initial_fit); the "
                f"target of these has the shape {parameters.point.shape}"
            )
        none = jnp.zeros((0, parameters.point.shape[0]), parameters.point.dtype)
        free = [parameters.further(name).T for name in FURTHER if name in blocks]
        values = jnp.concatenate([none, *free])
        rotation = jnp.moveaxis(parameters.rotation, 0, -1)
        return cls(rotation, parameters.translation.T, parameters.point.T, values, blocks)

    @property
    def unknowns(self) -> int:
        """Number of unknowns of one problem."""
        return count_unknowns(self.blocks)

    def further(self, name: str) -> Float[Array, "k batch"] | None:
        """The values of a further unknown, one row for each component; None if it is not free."""
        if name not in self.blocks:
            return None
        return self.further_values[further_slice(self.blocks, name)]

    def parameters(self) -> Parameters:
        """The parameters, batch axis first; unknowns that are not free are nominal."""
        rotation = jnp.moveaxis(self.rotation, -1, 0)
        found = jax.vmap(Parameters.of)(rotation, self.translation.T, self.point.T)
        free = {name: self.further(name) for name in FURTHER}
        return found.with_further(
            {name: value.T for name, value in free.items() if value is not None}
        )

    def moved(self, step: Float[Array, "p batch"] | Vector) -> Iterate:
        """The iterate after a step: :func:`jaxcal.model.parameters.retract` to second order.

        It turns by Cayley's rotation, which is a rotation for any step and needs no sine.
        """
        if isinstance(step, list):
            step = jnp.stack(step)
        values = self.further_values
        if self.unknowns > RIGID_UNKNOWNS:
            named = enumerate(zip(_further_names(self.blocks), values, strict=True), RIGID_UNKNOWNS)
            parts = [stepped(name, value, step[at], jnp.exp) for at, (name, value) in named]
            values = jnp.stack(parts)
        turn = _cayley(step[3:6])
        return Iterate(
            jnp.sum(self.rotation[:, :, None] * turn, axis=1),
            self.translation + jnp.sum(self.rotation * step[:3], axis=1),
            self.point + step[6:RIGID_UNKNOWNS],
            values,
            self.blocks,
        )

    def step_to(self, other: Iterate) -> Float[Array, "p batch"]:
        """The step that :meth:`moved` takes to get from here to another iterate."""
        back = jnp.swapaxes(self.rotation, 0, 1)
        turn = jnp.sum(back[:, :, None] * other.rotation[None], axis=1)
        axis = jnp.stack(
            [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        )
        along = jnp.sum(back * (other.translation - self.translation), axis=1)
        parts = [along, 2 * axis / (1 + turn[0, 0] + turn[1, 1] + turn[2, 2])]
        parts.append(other.point - self.point)
        names = _further_names(self.blocks)
        for here, there, name in zip(self.further_values, other.further_values, names, strict=True):
            parts.append(step_between(name, here, there, jnp.log)[None])
        return jnp.concatenate(parts)


def _cayley(vector: Float[Array, "3 batch"]) -> Float[Array, "3 3 batch"]:
    """:func:`jaxcal.model.unrolled.rotation` of vectors; batch axis last."""
    half = 0.5 * vector
    square = jnp.sum(half * half, axis=0)
    cross = picked(half, _CROSS_INDICES) * _CROSS_SIGNS.astype(half.dtype)
    eye = np.eye(3, dtype=half.dtype)[..., None]
    bent = half[:, None] * half - square * eye
    return jnp.asarray(eye) + (2 / (1 + square)) * (cross + bent)


def picked(array: Float[Array, "k ..."], indices: np.ndarray) -> Float[Array, " ..."]:
    """The entries at known indices of the first axis, in one operation; the indices' axes first."""
    # Unsigned, because JAX adds the size to negative indices, in the integer type of whoever traced
    # that code first, which may have another number of bits.
    return array.at[indices.astype(np.uint32)].get(mode="promise_in_bounds")


def _further_names(blocks: Blocks) -> list[str]:
    """The block of every further unknown, in order."""
    return [name for name in FURTHER if name in blocks for _ in range(count_unknowns((name,)))]


@jax.jit
def targets(iterate: Iterate, images: ImagePlanes) -> tuple[Vector, Matrix]:
    """q_i (mm, in image i's frame), and its derivative M_i = R' R_i' by the target, as planes."""
    rotation, translation = iterate.rotation[..., None], iterate.translation[..., None]
    inverse = [[rotation[k, a] for k in range(3)] for a in range(3)]
    back = [[images.rotation[3 * j + i] for j in range(3)] for i in range(3)]
    from_probe = unrolled.rows_of(iterate.point[..., None] - images.origin)
    # q_i is not computed from M_i, so that callers of q_i alone need not have M_i in memory.
    in_probe = [
        value - shift
        for value, shift in zip(unrolled.apply(back, from_probe), translation, strict=True)
    ]
    return unrolled.apply(inverse, in_probe), unrolled.product(inverse, back)


def choose(which: Bool[Array, "*batch"], first, second):
    """One of two pytrees for every problem; their leaves have the batch axis last."""
    return jax.tree.map(lambda a, b: jnp.where(which, a, b), first, second)


def barrier(values):
    """Keep XLA from fusing across here: it would recompute a problem's values for every image."""
    return jax.lax.optimization_barrier(values)


@jax.custom_jvp
def _sums(planes: tuple[Array, ...]) -> tuple[Array, ...]:
    return _reduced(planes, jnp.zeros((), planes[0].dtype))


# A function of its own, since the same constant for every plane would be written out each time.
@jax.jit
def _reduced(planes: tuple[Array, ...], zero: Array) -> tuple[Array, ...]:
    def plus(a: tuple, b: tuple) -> tuple:
        return tuple(jax.lax.add(x, y) for x, y in zip(a, b, strict=True))

    return tuple(jax.lax.reduce(planes, (zero,) * len(planes), plus, (planes[0].ndim - 1,)))


@_sums.defjvp
def _sums_jvp(primals: tuple, tangents: tuple) -> tuple:
    # JAX cannot differentiate a reduction of several arrays at once; a sum is its own derivative.
    (planes,), (moved,) = primals, tangents
    return _sums(planes), tuple(jnp.sum(plane, axis=-1) for plane in moved)


def total(planes: Vector) -> Vector:
    """Sum every plane over its images (last), all in one reduction; structural zeros give zeros.

    XLA compiles the variadic reduction to one loop over the images, in which nothing that belongs
    to one image is stored.
    """
    given = [plane for plane in planes if not unrolled.is_zero(plane)]
    shape = jnp.broadcast_shapes(*(plane.shape for plane in given))
    found = iter(_sums(tuple(jnp.broadcast_to(plane, shape) for plane in given)))
    zero = jnp.zeros(shape[:-1], given[0].dtype)
    return [zero if unrolled.is_zero(plane) else next(found) for plane in planes]


def pad_images(planes: Float[Array, "*planes n"]) -> Float[Array, "*planes padded"]:
    """Planes padded with their last image, up to whole vectors of 64 bytes."""
    extra = -planes.shape[-1] % (64 // planes.dtype.itemsize)
    return jnp.pad(planes, [(0, 0)] * (planes.ndim - 1) + [(0, extra)], mode="edge")
