"""The images as sums over them, made once: where a solve from far away begins.

As long as the range is taken for the depth, the error of image i is bilinear in what is sought,

    e_i = R'(u_i + R_i' d - t) - p_i,     u_i = R_i'(o - b_i),     p_i = (x_i, 0, r_i),

with the target c = o + d (:mod:`jaxcal.solvers.fused` has the other symbols). The cost
sum e_i' W e_i, with weights W that all images share, is then a polynomial in (R, t, d) whose
coefficients are sums over the images of products of (R_i, u_i, p_i): 118 of them, whatever the
number of images. A Gauss-Newton step needs these sums and no image. What they leave to passes over
the images is that a circle bends, by y_i^2 / 2 r_i, and that an objective's own weights may differ.

With w_i = u_i + R_i' d - t, q_i = R' w_i and Q = R W R', the blocks of the normal matrix are

    (v, v) = W n,    (v, w) = -W [sum q]x,    (v, d) = -W R' sum R_i',
    (w, w) = sum [q]x' W [q]x,    (w, d) = R' sum [w]x' Q R_i',    (d, d) = sum R_i Q R_i'.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.solvers import unrolled
from jaxcal.solvers.fused import PAIRS, UNKNOWNS, Guess, Images, Normal, total
from jaxcal.solvers.unrolled import Entry, Matrix, Vector

GROUP = 10
"""Sums made in one loop over the images: with more, the loop keeps its numbers on the stack."""

TURNS = [(i, j) for i in range(9) for j in range(i, 9)]
"""Places of products of two entries of R_i' (flat, by rows), in a row of 45."""


class Moments(eqx.Module):
    """Sums over the used images, lanes last; R_i' is flat, by rows, and stands for 9 numbers.

    Attributes:
        origin: o, mm. count: used images. turn: sum of R_i'. place: of u. places: of u u', upper
            triangle. moved: of u_c R_i', c major. turns: of products of two entries of R_i', in
            the order of :data:`TURNS`. point: of x and r. squares: of x^2 + r^2, apart. pointed:
            of x u and r u. turned: of x R_i' and r R_i'.
    """

    origin: Float[Array, "3 lanes"]
    count: Float[Array, " lanes"]
    turn: Float[Array, "9 lanes"]
    place: Float[Array, "3 lanes"]
    places: Float[Array, "6 lanes"]
    moved: Float[Array, "27 lanes"]
    turns: Float[Array, "45 lanes"]
    point: Float[Array, "2 lanes"]
    squares: Float[Array, "2 lanes"]
    pointed: Float[Array, "6 lanes"]
    turned: Float[Array, "18 lanes"]

    @classmethod
    def of(cls, images: Images, origin: Float[Array, "3 lanes"]) -> Moments:
        """One pass over images.

        Args:
            images: the data; the mask is 0 or 1.
            origin: o, mm; best near the target.
        """
        mask = images.mask
        back = [mask * images.rotation[3 * j + i] for i in range(3) for j in range(3)]
        apart = [origin[j][:, None] - images.origin[j] for j in range(3)]
        place = unrolled.apply([back[0:3], back[3:6], back[6:9]], apart)
        point = [mask * images.lateral, mask * images.distance]
        planes = {
            "turn": back,
            "place": place,
            "places": [place[i] * place[j] for i in range(3) for j in range(i, 3)],
            "moved": [a * b for a in place for b in back],
            "turns": [back[i] * back[j] for i, j in TURNS],
            "point": point,
            "squares": [p * p for p in point],
            "pointed": [p * a for p in point for a in place],
            "turned": [p * b for p in point for b in back],
        }
        flat = [plane for group in planes.values() for plane in group]
        sums: Vector = []
        for k in range(0, len(flat), GROUP):
            sums += total(flat[k : k + GROUP])
        parts, used = {}, 0
        for name, group in planes.items():
            parts[name] = jnp.stack(sums[used : used + len(group)])
            used += len(group)
        return cls(origin=origin, count=images.used, **parts)

    def normal(self, guess: Guess, weight: Float[Array, "3 lanes"]) -> Normal:
        """Gauss-Newton's normal equations at a guess.

        Args:
            guess: X and c.
            weight: of lateral, elevational and axial errors, 1/mm^2.
        """
        r = [unrolled.rows_of(row) for row in guess.rotation]
        inverse = unrolled.transpose(r)
        shift = unrolled.rows_of(guess.translation)
        away = unrolled.rows_of(guess.point - self.origin)
        w, n = unrolled.rows_of(weight), self.count
        turn = _square(self.turn)
        # sum w_c R_i'[b, j] for every c, b, j.
        moved: list[Matrix] = []
        for c in range(3):
            flat = [
                self.moved[9 * c + k]
                + unrolled.dot(away, [self._turns(3 * c + m, k) for m in range(3)])
                - shift[c] * self.turn[k]
                for k in range(9)
            ]
            moved.append([flat[0:3], flat[3:6], flat[6:9]])
        along = unrolled.apply(turn, away)
        mean = [self.place[k] + along[k] - n * shift[k] for k in range(3)]
        # sum w_c u_b, then sum w w'.
        reached = [
            [
                self.places[_upper(c, b)]
                + unrolled.dot(away, [self.moved[9 * b + 3 * c + m] for m in range(3)])
                - shift[c] * self.place[b]
                for b in range(3)
            ]
            for c in range(3)
        ]
        spread: Matrix = [[0] * 3 for _ in range(3)]
        for c in range(3):
            for b in range(c, 3):
                spread[c][b] = spread[b][c] = (
                    reached[c][b] + unrolled.dot(away, moved[c][b]) - mean[c] * shift[b]
                )
        q = unrolled.apply(inverse, mean)
        qq = unrolled.product(unrolled.product(inverse, spread), r)
        # q_a x and q_a r; x R_i' and r R_i'.
        pointed, turned = [], []
        for k in range(2):
            sweep = _square(self.turned[9 * k : 9 * k + 9])
            offset = unrolled.apply(sweep, away)
            in_probe = [
                self.pointed[3 * k + m] + offset[m] - shift[m] * self.point[k] for m in range(3)
            ]
            pointed.append(unrolled.apply(inverse, in_probe))
            turned.append(sweep)

        error = [q[0] - self.point[0], q[1], q[2] - self.point[1]]
        # sum q_a e_b.
        qe = [[qq[a][0] - pointed[0][a], qq[a][1], qq[a][2] - pointed[1][a]] for a in range(3)]
        ee = [
            qe[0][0] - pointed[0][0] + self.squares[0],
            qq[1][1],
            qe[2][2] - pointed[1][2] + self.squares[1],
        ]
        # R W, Q and, for every c, sum w_c Q R_i'.
        heavy = [[w[a] * r[b][a] for a in range(3)] for b in range(3)]
        spin = unrolled.product(heavy, inverse)
        weighed = [unrolled.product(spin, moved[c]) for c in range(3)]
        gradient = [-w[a] * error[a] for a in range(3)]
        gradient += [
            w[1] * qe[2][1] - w[2] * qe[1][2],
            w[2] * qe[0][2] - w[0] * qe[2][0],
            w[0] * qe[1][0] - w[1] * qe[0][1],
        ]
        for j in range(3):
            drawn = [heavy[b][2 * k] * turned[k][b][j] for k in range(2) for b in range(3)]
            gradient.append(sum(weighed[b][b][j] for b in range(3)) - sum(drawn))

        full: Matrix = [[0] * UNKNOWNS for _ in range(UNKNOWNS)]
        lever = unrolled.cross(q)
        swung = unrolled.product(inverse, turn)
        lever_in_probe = [
            [weighed[2][1][j] - weighed[1][2][j] for j in range(3)],
            [weighed[0][2][j] - weighed[2][0][j] for j in range(3)],
            [weighed[1][0][j] - weighed[0][1][j] for j in range(3)],
        ]
        mixed = unrolled.product(inverse, lever_in_probe)
        for i in range(3):
            full[i][i] = w[i] * n
            for j in range(3):
                full[i][3 + j] = unrolled.times(-w[i], lever[i][j])
                full[i][6 + j] = -w[i] * swung[i][j]
                full[3 + i][6 + j] = mixed[i][j]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            full[3 + i][3 + i] = w[j] * qq[k][k] + w[k] * qq[j][j]
            low, high = min(i, j), max(i, j)
            full[3 + low][3 + high] = -w[k] * qq[i][j]
        for i in range(3):
            for j in range(i, 3):
                full[6 + i][6 + j] = sum(
                    spin[b][c] * self._turns(3 * b + i, 3 * c + j)
                    for b in range(3) for c in range(3)
                )  # fmt: skip
        zero = jnp.zeros_like(n)
        return Normal(
            jnp.stack([unrolled.add(full[i][j], zero) for i, j in PAIRS]),
            jnp.stack(gradient),
            w[0] * ee[0] + w[1] * ee[1] + w[2] * ee[2],
        )

    def _turns(self, i: int, j: int) -> Entry:
        return self.turns[TURNS.index((min(i, j), max(i, j)))]


def _square(flat: Float[Array, "9 lanes"]) -> Matrix:
    rows = unrolled.rows_of(flat)
    return [rows[0:3], rows[3:6], rows[6:9]]


def _upper(i: int, j: int) -> int:
    i, j = min(i, j), max(i, j)
    return 3 * i - i * (i + 1) // 2 + j
