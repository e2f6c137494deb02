"""Random numbers of simulations, and the distance fit in deviations from the truth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxcal.data.segmentation.deviations import fit_deviations, halves
from jaxcal.data.segmentation.time_of_flight import fit_in_plane
from jaxcal.study import draws

KEY = jax.random.key(20261121)

# Compiled as a whole, not operation by operation.
words = jax.jit(draws.words, static_argnums=(1, 2))
normals = jax.jit(draws.normals, static_argnums=(1, 2))
uniforms = jax.jit(draws.uniforms, static_argnums=(1, 2))
unit_vectors = jax.jit(draws.unit_vectors, static_argnums=(1, 2))


@pytest.mark.parametrize(
    ("key", "counter", "answer"),
    [
        ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        ((0xFFFFFFFF,) * 2, (0xFFFFFFFF,) * 2, (0x1CB996FC, 0xBB002BE7)),
        ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
    ],
)
def test_threefry_gives_the_known_answers(key, counter, answer):
    """Of its authors (Random123, threefry2x32, 20 rounds)."""
    numbers = [jnp.uint32(value) for value in (*key, *counter)]
    assert tuple(int(word) for word in draws._threefry(*numbers)) == answer


def test_numbers_depend_on_key_stream_and_place_alone():
    one, other = words(KEY, 3, (5, 4))
    longer, _ = words(KEY, 3, (40,))
    np.testing.assert_array_equal(np.ravel(one), longer[:20])
    keys = jax.random.split(KEY, 3)
    batch = jax.jit(jax.vmap(lambda key: draws.normals(key, 3, 7)))(keys)
    np.testing.assert_allclose(batch[1], normals(keys[1], 3, 7), rtol=1e-5)
    every = np.concatenate([np.ravel(v) for s in (3, 4) for v in words(KEY, s, (40,))])
    # 160 words of 32 bits: a repetition would be no accident.
    assert len(np.unique(every)) == every.size
    assert np.asarray(one).dtype == np.asarray(other).dtype == np.uint32


def test_normals_are_normal_and_independent():
    pairs = np.asarray(jax.jit(lambda: draws.normal_pairs(KEY, 0, (400_000,)))())
    one, other = pairs.real.astype(float), pairs.imag.astype(float)
    for values in (one, other, (one + other) / np.sqrt(2), (one - other) / np.sqrt(2)):
        assert stats.kstest(values, "norm").pvalue > 1e-3
    # Pairs are independent, and so are neighbours, in size as well.
    for a, b in ((one, other), (one[1:], one[:-1])):
        for power in (1, 2):
            assert abs(np.corrcoef(a**power, b**power)[0, 1]) < 4 / np.sqrt(len(a))
    expected = 2 * len(one) * stats.norm.sf(4) * 2
    assert abs((np.abs(pairs.view(np.float32)) > 4).sum() - expected) < 5 * np.sqrt(expected)


def test_uniforms_and_directions():
    values = np.asarray(uniforms(KEY, 1, 100_001))
    assert values.shape == (100_001,)
    assert 0 < values.min() < 1e-3
    assert 1 - 1e-3 < values.max() < 1
    assert stats.kstest(values, "uniform").pvalue > 1e-3
    vectors = np.asarray(unit_vectors(KEY, 2, 50_000))
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=0), 1, atol=1e-15)
    for component in vectors:
        assert stats.kstest(component, "uniform", (-1, 2)).pvalue > 1e-3
    np.testing.assert_allclose(np.cov(vectors), np.eye(3) / 3, atol=0.01)


@pytest.mark.parametrize(("dtype", "within"), [(np.float32, 5e-7), (np.float64, 5e-16)])
def test_circle(dtype, within):
    turns = np.linspace(-0.5, 0.5, 2001).astype(dtype)
    cosine, sine = draws.circle(jnp.asarray(turns))
    assert np.asarray(cosine).dtype == np.asarray(sine).dtype == dtype
    angle = 2 * np.pi * turns.astype(float)
    np.testing.assert_allclose(cosine, np.cos(angle), atol=within)
    np.testing.assert_allclose(sine, np.sin(angle), atol=within)


@pytest.mark.parametrize(("count", "noise_mm", "within"), [(128, 2.0, 3e-6), (33, 0.5, 1e-6)])
def test_fit_in_deviations_is_the_plain_fit(count, noise_mm, within):
    """Oracle: the plain fit in float64, with steps enough, of the same distances."""
    generator = np.random.default_rng(5)
    elements = (np.arange(count) - (count - 1) / 2) * 58.5 / count
    lateral = generator.uniform(-29, 29, (3, 50))
    distance = generator.uniform(10, 90, (3, 50))
    pairs = jax.vmap(lambda key: draws.normal_pairs(key, 0, (50, -(-count // 2))))
    noise = jax.jit(pairs)(jax.random.split(KEY, 3))
    fit = jax.jit(lambda *given: fit_deviations(*given, elements))
    found = fit(noise, jnp.asarray(noise_mm), jnp.asarray(lateral), jnp.asarray(distance))
    drawn = np.concatenate(halves(noise, count), axis=-1)
    exact = np.hypot(lateral[..., None] - elements, distance[..., None])
    positions = np.stack([elements, np.zeros(count), np.zeros(count)], axis=-1)
    plainly = jax.jit(lambda distances: fit_in_plane(distances, positions, steps=25).position)
    plain = plainly(exact + noise_mm * drawn.astype(float))
    np.testing.assert_allclose(np.stack(found, axis=-1), plain, rtol=0, atol=within)
    exactly = fit(noise, jnp.asarray(0.0), jnp.asarray(lateral), jnp.asarray(distance))
    np.testing.assert_array_equal(np.stack(exactly), np.stack([lateral, distance]))
