"""What diagnostics are made of, against complex steps of the definitions."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import problem
from oracle import model
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.data.problem import Channels, Problem
from jaxcal.diagnostics.image_errors import ImageErrors, Unknowns
from jaxcal.diagnostics.residual_checks import medians
from jaxcal.diagnostics.uncertainty import inverses, nearest_unknown

ALL = ("translation", "rotation", "point", "scale", "sound-speed", "delay")


@pytest.fixture(scope="module")
def scene():
    """Seven images of a target up to 3 mm from the plane, at unknowns that fit them roughly."""
    rng = np.random.default_rng(4)
    count, elements = 7, 5
    x = Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3) * 50
    poses = Rotation.from_rotvec(0.5 * rng.normal(size=(count, 3))).as_matrix()
    q = np.stack(
        [rng.uniform(-20, 20, count), rng.uniform(-3, 3, count), rng.uniform(20, 80, count)], axis=1
    )
    point = rng.normal(size=3) * 100
    origin = point - np.einsum("nij,nj->ni", poses, q @ x[0].T + x[1])
    unknowns = model.Unknowns(x[0], x[1], point, np.array([1.1, 0.9]), 1.02, 0.3)
    spacing = np.array([0.2, 0.25])
    measured = np.stack([q[:, 0], np.hypot(q[:, 1], q[:, 2])], axis=1) + rng.normal(size=(count, 2))
    measured = measured / spacing / unknowns.scale
    places = np.stack(
        [np.linspace(-20, 20, elements), 0 * np.ones(elements), -np.ones(elements)], 1
    )
    heard = rng.uniform(size=(count, elements)) > 0.2
    data = model.Data(
        poses, origin, measured, spacing, None, None, rng.normal(size=heard.shape), heard, places
    )
    full = np.tile(np.eye(4), (1, count, 1, 1))
    full[0, :, :3, :3], full[0, :, :3, 3] = poses, origin
    there = Problem(
        poses=jnp.asarray(full),
        measurements=jnp.asarray(measured[None]),
        mask=jnp.ones((1, count)),
        spacing=jnp.asarray(spacing[None]),
        face_offset=jnp.zeros(1),
        channels=Channels(
            jnp.zeros((1, *heard.shape)),
            jnp.asarray(heard[None], float),
            jnp.asarray(places[None]),
        ),
        pixels=True,
    )
    there = jax.tree.map(np.asarray, there)
    further = {
        "scale": list(unknowns.scale[:, None]),
        "sound-speed": [np.array([1.02])],
        "delay": [np.array([0.3])],
    }
    mine = Unknowns(x[0][None], x[1][None], point[None], further)
    return data, unknowns, there, mine


def by_complex_steps(function, unknowns, shape):
    rows = model.jacobian(lambda step: function(unknowns.moved(step, ALL)), model.size(ALL))
    return np.asarray(rows).reshape(*shape, model.size(ALL))


def test_rows_are_the_derivatives_of_the_errors(scene):
    data, unknowns, there, mine = scene
    seen = ImageErrors.of(mine, there, ALL)
    np.testing.assert_allclose(seen.errors[0], model.errors(data, unknowns), atol=1e-12)
    expected = by_complex_steps(lambda u: model.errors(data, u), unknowns, (7, 3))
    np.testing.assert_allclose(seen.rows[0], expected, atol=1e-11)


def test_rows_of_offsets_that_are_held(scene):
    data, unknowns, there, mine = scene
    y = np.linspace(-2, 2, 7)
    seen = ImageErrors.of(mine, there, ALL)
    residual, axial = seen.from_circle(y[None])
    np.testing.assert_allclose(residual[0], model.circle(data, unknowns, y), atol=1e-12)
    expected = by_complex_steps(lambda u: model.circle(data, u, y), unknowns, (7, 3))
    np.testing.assert_allclose(seen.circle_rows(axial)[0], expected, atol=1e-11)


def test_rows_of_every_element(scene):
    data, unknowns, there, mine = scene
    seen = ImageErrors.of(mine, there, ALL)
    expected = by_complex_steps(lambda u: model.channels(data, u), unknowns, data.heard.shape)
    found = seen.channel_rows().reshape(expected.shape)
    np.testing.assert_allclose(found, expected * data.heard[..., None], atol=1e-11)


def test_images_left_out_count_for_nothing(scene):
    _, _, there, mine = scene
    rubbish = np.array(there.poses)
    rubbish[0, 2] = np.nan
    mask = np.ones((1, 7))
    mask[0, 2] = 0.0
    seen = ImageErrors.of(mine, _with(there, rubbish, mask), ALL)
    whole = ImageErrors.of(mine, there, ALL)
    assert not seen.errors[0, 2].any()
    assert not seen.rows[0, 2].any()
    np.testing.assert_array_equal(np.delete(seen.rows, 2, 1), np.delete(whole.rows, 2, 1))


def _with(there: Problem, poses: np.ndarray, mask: np.ndarray) -> Problem:
    changed = replace(
        jax.tree.map(jnp.asarray, there),
        poses=jnp.asarray(poses),
        mask=jnp.asarray(mask),
        channels=None,
    )
    return jax.tree.map(np.asarray, changed)


def test_medians_are_the_least_value_that_half_do_not_exceed():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3, 9, 2))
    weight = np.ones((3, 9))
    weight[1, 4:] = 0.0
    values[2, 1] = np.nan
    found = medians(values, weight)
    np.testing.assert_array_equal(found[0], np.sort(values[0], axis=0)[4])
    np.testing.assert_array_equal(found[1], np.sort(values[1, :4], axis=0)[1])
    np.testing.assert_array_equal(found[2], np.sort(np.delete(values[2], 1, 0), axis=0)[4])


def test_inverses_are_lost_alone():
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(4, 20, 9)) * 10.0 ** rng.uniform(-3, 3, 9)
    matrices = np.swapaxes(rows, 1, 2) @ rows
    matrices[1, 0, 0] = -1.0
    matrices[2] = np.nan
    found = inverses(matrices, np.finfo(float).eps)
    assert np.isnan(found[[1, 2]]).all()
    sound = matrices[[0, 3]] @ found[[0, 3]]
    np.testing.assert_allclose(sound, np.tile(np.eye(9), (2, 1, 1)), atol=1e-6)


def test_a_null_space_is_named_by_the_unknown_that_it_holds():
    # Two directions are open: the third unknown, and a mixture of the first two.
    basis = np.eye(4)
    mixture = np.array([0.6, 0.8, 0.0, 0.0])
    turned = np.stack([mixture + basis[2], mixture - basis[2]], axis=1) / np.sqrt(2)
    vectors = np.linalg.qr(np.concatenate([turned, basis[:, [3, 0]]], axis=1))[0]
    null = np.array([[True, True, False, False]])
    np.testing.assert_allclose(np.abs(nearest_unknown(vectors[None], null)[0]), mixture, atol=1e-12)


def test_reading_diagnostics_under_jit_is_an_error_that_says_so():
    there = problem(3, images=12)
    for name in ("warnings", "weakest_sd", "inspection", "elevation_sd"):
        with pytest.raises(jaxcal.CalibrationError, match="outside"):
            jax.eval_shape(
                lambda p, name=name: getattr(jaxcal.calibrate(p, "conventional"), name), there
            )
    found = jax.eval_shape(
        lambda p: (lambda c: (c.status_code, c.covariance, c.linearisation.information))(
            jaxcal.calibrate(p, "conventional")
        ),
        there,
    )
    assert [each.shape for each in found] == [(), (6, 6), (9, 9)]
