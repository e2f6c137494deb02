"""Random numbers by the million: counters through Threefry, normals by Box and Muller in float32.

A simulated trial of 50 images and 128 elements needs 6,400 normals. With ``jax.random.normal``,
drawing them took the larger part of a study's time. Here, as there, every number depends only on a
key, a stream (which quantity) and its place in the stream: word pair i of stream s is Threefry-2x32
(20 rounds, Salmon et al. 2011) of the counter (i, s) under the key. The differences: both words are
used; the rounds are written out, so that they fuse with later operations; and normals come in pairs
from a logarithm, a root and two polynomials (Box and Muller 1958).

The measurements' noise, nearly all of the numbers, is evaluated in float32 and promoted. Its
relative rounding of 1e-7 has no effect on the statistics of a simulation. Everything else is
evaluated in float64, since it is read in several places (a target both as the truth and in every
pose): compiled loops that compute a number again may round it differently, and numbers that belong
together would agree to seven digits only. No normal exceeds 6.8 SDs (the chance of a larger one is
1e-11), and uniforms have 32 bits. Words are the same wherever they are computed; the noise may
differ in its last digit between programs that are compiled differently (for another number of
devices, say).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Complex64, Float, Key, UInt32

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = np.uint32(0x1BD11BDA)

_OWN = 0x6A780000
"""Added to streams, so that ``fold_in`` and ``split`` of the same key use other counters."""


def words(
    key: Key[Array, ""], stream: int, shape: tuple[int, ...]
) -> tuple[UInt32[Array, "*shape"], UInt32[Array, "*shape"]]:
    """Two arrays of random words.

    Args:
        key: a JAX key.
        stream: a small number that says what is drawn.
        shape: of either array.
    """
    data = jax.random.key_data(key)
    if data.shape != (2,):
        data = jax.random.bits(key, (2,), jnp.uint32)
    count = int(np.prod(shape))
    first = jax.lax.iota(jnp.uint32, count).reshape(shape)
    return _threefry(data[0], data[1], first, jnp.full((), _OWN + stream, jnp.uint32))


def _threefry(one: Array, other: Array, first: Array, second: Array) -> tuple[Array, Array]:
    keys = (one, other, one ^ other ^ _PARITY)
    x, y = first + one, second + other
    for group in range(5):
        for by in _ROTATIONS[group % 2]:
            x = x + y
            y = x ^ ((y << np.uint32(by)) | (y >> np.uint32(32 - by)))
        x = x + keys[(group + 1) % 3]
        y = y + keys[(group + 2) % 3] + np.uint32(group + 1)
    return x, y


def uniforms(key: Key[Array, ""], stream: int, count: int) -> Float[Array, " count"]:
    """Uniform on (0, 1), in steps of 2^-32."""
    half = -(-count // 2)
    return _open(jnp.concatenate(words(key, stream, (half,)))[:count])


def normals(key: Key[Array, ""], stream: int, count: int) -> Float[Array, " count"]:
    """Standard normals."""
    one, other = words(key, stream, (-(-count // 2),))
    radius = jnp.sqrt(-2 * jnp.log(_open(one)))
    cosine, sine = circle(_turns(other, jnp.result_type(float)))
    return jnp.concatenate([radius * cosine, radius * sine])[:count]


def normal_pairs(
    key: Key[Array, ""], stream: int, shape: tuple[int, ...]
) -> Complex64[Array, "*shape"]:
    """Pairs of independent standard normals as real and imaginary parts, in float32.

    One complex array is one compiled loop; as two arrays the pair would be computed twice.
    """
    one, other = words(key, stream, shape)
    half = jnp.float32(2.0**-32)
    # Never 0; rounding may make it 1, whose logarithm is 0.
    radius = jnp.sqrt(-2 * jnp.log(one.astype(jnp.float32) * half + half / 2))
    cosine, sine = circle(_turns(other, jnp.float32))
    return jax.lax.complex(radius * cosine, radius * sine)


def unit_vectors(key: Key[Array, ""], stream: int, count: int) -> Float[Array, "3 count"]:
    """Uniform on the sphere (Archimedes: height and azimuth are uniform)."""
    one, other = words(key, stream, (count,))
    height = 2 * _open(one) - 1
    across = jnp.sqrt((1 - height) * (1 + height))
    cosine, sine = circle(_turns(other, jnp.result_type(float)))
    return jnp.stack([across * cosine, across * sine, height])


def circle(turns: Float[Array, "*shape"]) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Cosine and sine of an angle within half a turn either way, to a few units of rounding.

    Args:
        turns: the angle over 2 pi, between -0.5 and 0.5, in float32 or float64.
    """
    quarter = jnp.round(4 * turns)
    angle = (turns - quarter / 4) * turns.dtype.type(2 * np.pi)
    square = angle * angle
    # Taylor's series within an eighth of a turn.
    terms = 4 if turns.dtype == jnp.float32 else 9
    sine, cosine = jnp.ones_like(square), jnp.ones_like(square)
    for k in range(terms, 0, -1):
        cosine = 1 - square * cosine / ((2 * k - 1) * (2 * k))
        if k < terms or terms > 4:
            sine = 1 - square * sine / ((2 * k) * (2 * k + 1))
    sine = angle * sine
    which = quarter.astype(jnp.int32)
    swap = (which & 1) != 0
    x, y = jnp.where(swap, sine, cosine), jnp.where(swap, cosine, sine)
    return jnp.where(((which + 1) & 2) != 0, -x, x), jnp.where((which & 2) != 0, -y, y)


def _open(word: UInt32[Array, "*shape"]) -> Float[Array, "*shape"]:
    """A word as a number in (0, 1)."""
    return (word.astype(jnp.result_type(float)) + 0.5) * 2.0**-32


def _turns(word: UInt32[Array, "*shape"], dtype: DTypeLike) -> Float[Array, "*shape"]:
    """A word as a part of a turn, between -0.5 and 0.5."""
    return jax.lax.bitcast_convert_type(word, jnp.int32).astype(dtype) * 2.0**-32
