"""Random numbers by the million: counters through Threefry, normals by Box and Muller in float32.

A simulated trial of 50 images and 128 elements needs 6,400 normals, and ``jax.random.normal`` made
them the larger part of a study. Here every number is a function of a key, a stream (which quantity)
and its place in it alone, as there: word pair i of stream s is Threefry-2x32 (20 rounds, Salmon et
al. 2011) of the counter (i, s) under the key. But both words are used, the rounds are written out,
so that they fuse with what follows, and normals come in pairs from a logarithm, a root and two
polynomials (Box and Muller 1958), evaluated in float32 and promoted.

What that costs in quality: a normal has a relative rounding of 1e-7 and never exceeds 6.7 SDs (the
chance of a larger one is 2e-11); uniforms have 32 bits. No statistic of a simulation sees either.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex64, Float, Float32, Key, UInt32

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = np.uint32(0x1BD11BDA)

_OWN = 0x6A780000
"""Added to streams: no counter here is one that ``fold_in`` or ``split`` of the same key uses."""


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
    both = jnp.concatenate(words(key, stream, (half,)))[:count]
    return (both.astype(jnp.float64) + 0.5) * 2.0**-32


def normals(key: Key[Array, ""], stream: int, count: int) -> Float[Array, " count"]:
    """Standard normals."""
    pairs = normal_pairs(key, stream, (-(-count // 2),))
    return jnp.concatenate([jnp.real(pairs), jnp.imag(pairs)])[:count].astype(jnp.float64)


def normal_pairs(
    key: Key[Array, ""], stream: int, shape: tuple[int, ...]
) -> Complex64[Array, "*shape"]:
    """Pairs of independent standard normals as real and imaginary parts.

    One complex array is one compiled loop; as two arrays the pair would be computed twice.
    """
    one, other = words(key, stream, shape)
    half = jnp.float32(2.0**-32)
    # Never 0; rounding may make it 1, whose logarithm is 0.
    radius = jnp.sqrt(-2 * jnp.log(one.astype(jnp.float32) * half + half / 2))
    turns = jax.lax.bitcast_convert_type(other, jnp.int32).astype(jnp.float32) * half
    cosine, sine = circle(turns)
    return jax.lax.complex(radius * cosine, radius * sine)


def circle(
    turns: Float[Array, "*shape"],
) -> tuple[Float32[Array, "*shape"], Float32[Array, "*shape"]]:
    """Cosine and sine of an angle within half a turn either way, to 3e-7, in float32.

    Args:
        turns: the angle over 2 pi, between -0.5 and 0.5.
    """
    turns = turns.astype(jnp.float32)
    quarter = jnp.round(4 * turns)
    angle = (turns - quarter / 4) * jnp.float32(2 * np.pi)
    square = angle * angle
    # Taylor's series within an eighth of a turn.
    sine = angle * (1 + square * (-1 / 6 + square * (1 / 120 - square / 5040)))
    cosine = 1 + square * (-1 / 2 + square * (1 / 24 + square * (-1 / 720 + square / 40320)))
    which = quarter.astype(jnp.int32)
    swap = (which & 1) != 0
    x, y = jnp.where(swap, sine, cosine), jnp.where(swap, cosine, sine)
    return jnp.where(((which + 1) & 2) != 0, -x, x), jnp.where((which & 2) != 0, -y, y)


def unit_vectors(key: Key[Array, ""], stream: int, count: int) -> Float[Array, "3 count"]:
    """Uniform on the sphere (Archimedes: height and azimuth are uniform); of length 1 to 1e-6."""
    one, other = words(key, stream, (count,))
    height = (one.astype(jnp.float32) + 0.5) * jnp.float32(2.0**-31) - 1
    across = jnp.sqrt(jnp.maximum(1 - height * height, 0))
    turns = jax.lax.bitcast_convert_type(other, jnp.int32).astype(jnp.float32)
    cosine, sine = circle(turns * jnp.float32(2.0**-32))
    return jnp.stack([across * cosine, across * sine, height]).astype(jnp.float64)
