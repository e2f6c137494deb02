"""Where every method begins: a start in closed form, and the conventional fit from it.

With r1 and r3 the lateral and axial columns of X's rotation, B_i X p_i = c of Eq. 7 is linear in
(a1, a3, t, c) with a1 = s1 r1 and a3 = s3 r3:

    R_i (u_i a1 + v_i a3 + t) + b_i - c = 0,         3 n equations, 12 unknowns,

whether the pixel scales s are known or not: unknown scales are |a1| and |a3|. The images are needed
once: the normal matrix of the 12 unknowns consists of sums of u, v, their products and the
rotations. The 3x2 matrix [a1, a3] is projected to orthonormal columns (y = z cross x completes it,
so no reflection can arise), and t and c (and unknown scales) follow from the same sums.

The system is singular where the poses or the points (all on a line in the image) determine less
than 12 unknowns, and useless where few images and much noise drown it, although X's being a
rotation may still determine it. A pivot well above rounding and columns of length near 1 (where the
scales are known) make it sound; where it is not, t and c for each of the 24 rotations of the cube
follow from the same sums, and the best of the fits from there is the answer.

References: the linear form is the hand-eye (AX = XB family) elimination used for single-point
phantoms, e.g. Melvaer et al. 2012; the projection is Schoenemann's.
"""

from __future__ import annotations

import itertools
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxcal.calibration.conventional import Start
from jaxcal.model import unrolled
from jaxcal.model.batch import Images, Iterate, barrier, choose, total
from jaxcal.model.observations import InPlane
from jaxcal.model.parameters import Blocks, Parameters
from jaxcal.model.unrolled import Matrix, Vector
from jaxcal.solvers.levenberg_marquardt import Descent, minimise

LEAST_PIVOT = 1e-10
"""Of the start's normal matrix with a unit diagonal; below it the start is called unsound."""


class ConventionalStart(eqx.Module):
    """Conventional fits, and how they began.

    Attributes:
        fit: of Eq. 7.
        start: in closed form; where that was unsound, the fit itself.
        searched: whether a start had to be searched for.
    """

    fit: Descent
    start: Iterate
    searched: Bool[Array, " lanes"]

    @property
    def place(self) -> Iterate:
        """Where methods begin that begin at the conventional fit."""
        return self.fit.place


class GivenStart(eqx.Module):
    """The same where the conventional fits were found before.

    Attributes:
        place: the conventional fits.
        searched: whether they had to be searched for.
    """

    place: Iterate
    searched: Bool[Array, " lanes"]

    @classmethod
    def of(cls, start: Start, blocks: Blocks) -> GivenStart:
        """Of starts with a leading axis."""
        nominal = jnp.zeros_like(start.sound_speed)
        parameters = Parameters(
            start.rotation, start.translation, start.point, start.scale, start.sound_speed, nominal
        )
        return cls(Iterate.of(parameters, blocks), start.searched)


class ImageSums(eqx.Module):
    """Sums over the images; points and pose origins are taken from their means.

    Attributes:
        count: used images.
        mean: of lateral position and range, mm.
        face: range of pixel row 0, mm; the mean range holds it.
        centre: of the poses' origins, mm.
        xx: of lateral squared, and so on.
        xz: see there.
        zz: see there.
        lateral: of lateral times R_i, 3x3.
        axial: of range times R_i.
        rotation: of R_i.
        pulled: of lateral, range and 1 times R_i'(centre - b_i).
    """

    count: Array
    mean: Vector
    face: Array
    centre: Vector
    xx: Array
    xz: Array
    zz: Array
    lateral: Matrix
    axial: Matrix
    rotation: Matrix
    pulled: list[Vector]

    @classmethod
    def of(cls, images: Images) -> ImageSums:
        """Two passes: the means, and the rest."""
        count = images.used
        points = [images.lateral, images.distance]
        mean = [jnp.sum(images.mask * plane, axis=1) / count for plane in points]
        centre = [jnp.sum(images.mask * plane, axis=1) / count for plane in images.origin]
        x, z = (images.mask * (p - m[:, None]) for p, m in zip(points, mean, strict=True))
        away = [c[:, None] - plane for plane, c in zip(images.origin, centre, strict=True)]
        turn = [[images.rotation[3 * i + j] for j in range(3)] for i in range(3)]
        back = unrolled.apply(unrolled.transpose(turn), away)
        flat = [entry for row in turn for entry in row]
        planes = [x * x, x * z, z * z]
        for weight in (x, z, images.mask):
            planes += [weight * entry for entry in flat] + [weight * entry for entry in back]
        sums = unrolled.rows_of(barrier(jnp.stack(total(planes))))
        parts = [sums[3 + 12 * k : 15 + 12 * k] for k in range(3)]
        lateral, axial, rotation = ([part[3 * i : 3 * i + 3] for i in range(3)] for part in parts)
        pulled = [part[9:] for part in parts]
        xx, xz, zz = sums[:3]
        return cls(count, mean, images.face, centre, xx, xz, zz, lateral, axial, rotation, pulled)


def from_rotation(rotation: Matrix, sums: ImageSums, blocks: Blocks) -> Iterate:
    """X's origin, the target and free scales by linear least squares with X's rotation held."""
    zero, count = jnp.zeros_like(sums.count), sums.count
    lateral, axial = ([row[k] for row in rotation] for k in (0, 2))
    (x, z), centre = sums.mean, sums.centre
    across = unrolled.apply(sums.lateral, lateral), unrolled.apply(sums.axial, axial)
    free = "scale" in blocks
    size = 8 if free else 6
    # Unknowns t (that of the mean point), c and, where they are free, the scales.
    matrix: Matrix = [[zero] * size for _ in range(size)]
    for i in range(3):
        matrix[i][i] = matrix[3 + i][3 + i] = count * (1 + 1e-12)
        for j in range(3):
            matrix[3 + i][j] = matrix[j][3 + i] = -sums.rotation[i][j]
    # Deviations of x and z, and of the origins, sum to nothing.
    if free:
        matrix[6][6], matrix[7][7] = sums.xx, sums.zz
        for k, column in enumerate(across):
            for i in range(3):
                matrix[3 + i][6 + k] = matrix[6 + k][3 + i] = -column[i]
        drawn = [
            unrolled.dot(lateral, sums.pulled[0]),
            unrolled.dot(axial, sums.pulled[1]),
        ]
        rhs = [*sums.pulled[2], *[zero] * 3, *drawn]
    else:
        rhs = [*sums.pulled[2], *(a + b for a, b in zip(*across, strict=True))]
    length = [jnp.sqrt(jnp.where(matrix[k][k] > 0, matrix[k][k], 1.0)) for k in range(size)]
    unit = [[matrix[i][j] / (length[i] * length[j]) for j in range(size)] for i in range(size)]
    ridge = 16 * jnp.finfo(count.dtype).eps
    for k in range(size):
        unit[k][k] = unit[k][k] + ridge
    solved = unrolled.solve(unit, [value / by for value, by in zip(rhs, length, strict=True)])
    found = unrolled.rows_of(barrier(jnp.stack(solved)))
    found = [value / by for value, by in zip(found, length, strict=True)]
    one = jnp.ones_like(count)
    scale = [one, one]
    if free:
        # A negative scale means a rotation far off; its magnitude still is the best guess.
        tiny = jnp.finfo(count.dtype).tiny
        scale = [jnp.maximum(jnp.abs(value), tiny) for value in found[6:]]
    depth = scale[1] * (z - sums.face) + sums.face
    shift = [
        t - scale[0] * x * a - depth * b for t, a, b in zip(found[:3], lateral, axial, strict=True)
    ]
    nominal = {"scale": scale, "sound-speed": [one], "delay": [zero]}
    extras = [value for name, values in nominal.items() if name in blocks for value in values]
    return Iterate(
        jnp.stack([jnp.stack(row) for row in rotation]),
        jnp.stack(shift),
        jnp.stack([c + d for c, d in zip(centre, found[3:6], strict=True)]),
        jnp.stack(extras) if extras else jnp.zeros((0, *count.shape), count.dtype),
        blocks,
    )


def closed_form(images: Images, blocks: Blocks) -> tuple[Iterate, Bool[Array, " lanes"], ImageSums]:
    """The start, whether it is sound, and the sums that it is made of."""
    sums = ImageSums.of(images)
    size = 12
    full: Matrix = [[0] * size for _ in range(size)]
    products = [[sums.xx, sums.xz], [sums.xz, sums.zz]]
    for a in range(2):
        for b in range(2):
            for i in range(3):
                full[3 * a + i][3 * b + i] = products[a][b]
    for i in range(3):
        full[6 + i][6 + i] = full[9 + i][9 + i] = sums.count
        for j in range(3):
            for k, matrix in enumerate((sums.lateral, sums.axial, sums.rotation)):
                full[9 + j][3 * k + i] = full[3 * k + i][9 + j] = -matrix[j][i]
    length = [jnp.sqrt(jnp.where(full[k][k] > 0, full[k][k], 1.0)) for k in range(size)]
    inverse = [1 / value for value in length]
    unit = [
        [unrolled.times(full[i][j], inverse[i] * inverse[j]) for j in range(size)]
        for i in range(size)
    ]
    rhs = [*sums.pulled[0], *sums.pulled[1], *sums.pulled[2], *[jnp.zeros_like(sums.count)] * 3]
    rhs = [a * b for a, b in zip(rhs, inverse, strict=True)]
    factor, pivots = unrolled.cholesky(unit)
    least = 1 / jnp.max(jnp.stack(pivots), axis=0) ** 2
    solved = unrolled.backward(factor, pivots, unrolled.forward(factor, pivots, rhs))
    flat = [a * b for a, b in zip(solved[:6], inverse[:6], strict=True)]
    columns = barrier(jnp.stack([*flat, least]))
    a, b, least = columns[:3], columns[3:6], columns[6]
    long, deep = jnp.sqrt(jnp.sum(a * a, axis=0)), jnp.sqrt(jnp.sum(b * b, axis=0))
    cosine = jnp.abs(jnp.sum(a * b, axis=0)) / (long * deep)
    # Comparisons with NaN are false: whatever went wrong is not sound.
    sound = (least > LEAST_PIVOT) & (cosine < 0.5)
    for size_of in (long, deep):
        known = (size_of > 0.5) & (size_of < 2.0)
        sound = sound & ((size_of > 0) if "scale" in blocks else known)
    eye = jnp.eye(3, dtype=a.dtype)
    # The nearest orthonormal pair to two unit vectors a, b has their sum and their difference
    # (orthogonal to each other) for its diagonals.
    a = jnp.where(sound, a / long, eye[:, :1])
    b = jnp.where(sound, b / deep, eye[:, 1:2])
    plus, minus = a + b, a - b
    plus = plus / jnp.sqrt(jnp.sum(plus**2, axis=0))
    minus = minus / jnp.sqrt(jnp.sum(minus**2, axis=0))
    lateral, axial = (plus + minus) / jnp.sqrt(2.0), (plus - minus) / jnp.sqrt(2.0)
    middle = jnp.cross(axial, lateral, axis=0)
    rotation = [[lateral[i], middle[i], axial[i]] for i in range(3)]
    return from_rotation(rotation, sums, blocks), sound, sums


def conventional(
    images: Images,
    blocks: Blocks,
    *,
    max_steps: int = 100,
    undamped: bool = False,
    trace: int = 0,
) -> ConventionalStart:
    """Conventional fits from the closed-form start, or the best of many where it is unsound.

    Args:
        images: the data.
        blocks: the free unknowns.
        max_steps: most passes of each fit.
        undamped: Gauss-Newton instead of Levenberg-Marquardt.
        trace: how many values of the objective to keep.
    """
    start, sound, sums = closed_form(images, blocks)
    cubes = jnp.asarray(cube_rotations(), images.mask.dtype)
    fit_from = partial(
        minimise, damping=0.0 if undamped else 1e-3, max_steps=max_steps, trace=trace
    )
    observation = InPlane.of(images)

    # One loop whose first round starts in closed form, and which has further rounds only where a
    # lane's start was unsound: the search costs nothing where it is not needed.
    def one_round(state: tuple) -> tuple:
        index, best = state
        cube = cubes[jnp.maximum(index - 1, 0)]
        rotation = [
            [jnp.broadcast_to(cube[i, j], (images.lanes,)) for j in range(3)] for i in range(3)
        ]
        first = choose(index == 0, start, from_rotation(rotation, sums, blocks))
        fit = fit_from(barrier(first), observation, images)
        lower = (fit.cost < best.cost) | ~jnp.isfinite(best.cost)
        better = (index == 0) | (lower & ~sound)
        return index + 1, choose(better, fit, best)

    def unfinished(state: tuple) -> Bool[Array, ""]:
        return (state[0] == 0) | (jnp.any(~sound) & (state[0] <= len(cubes)))

    shapes = jax.eval_shape(fit_from, start, observation, images)
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    _, fit = jax.lax.while_loop(unfinished, one_round, (jnp.zeros((), jnp.int32), empty))
    return ConventionalStart(fit, choose(sound, start, fit.place), jnp.logical_not(sound))


def cube_rotations() -> np.ndarray:
    """The 24 rotations of the cube: no rotation is farther than 63 degrees from one of them."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return np.array(found)
