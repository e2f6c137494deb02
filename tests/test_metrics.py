from __future__ import annotations

import numpy as np
import pytest
from conftest import random_poses

from jaxcal import (
    InputError,
    Problem,
    Protocol,
    calibrate,
    calibration_reproducibility,
    reconstruction_precision,
    simulate_recording,
)


def test_reconstruction_precision_is_the_norm_of_unbiased_sds():
    rng = np.random.default_rng(0)
    poses, transform = random_poses(9, 0), random_poses(1, 1)[0]
    points = rng.normal(size=(9, 2)) * 30
    cloud = np.stack(
        [(b @ transform @ [x, 0, r, 1])[:3] for b, (x, r) in zip(poses, points, strict=True)]
    )
    expected = np.linalg.norm(np.std(cloud, axis=0, ddof=1))
    np.testing.assert_allclose(reconstruction_precision(transform, poses, points), expected)
    full = np.stack([points[:, 0], np.zeros(9), points[:, 1]], axis=1)
    np.testing.assert_allclose(reconstruction_precision(transform, poses, full), expected)
    mask = np.array([1, 1, 0, 1, 1, 0, 1, 1, 1.0])
    masked = reconstruction_precision(transform, poses, points, mask)
    expected = np.linalg.norm(np.std(cloud[mask > 0], axis=0, ddof=1))
    np.testing.assert_allclose(masked, expected)
    # Images left out may hold anything.
    poses[2], points[5] = np.nan, np.inf
    masked = reconstruction_precision(transform, poses, points, mask > 0)
    np.testing.assert_allclose(masked, expected)


def test_the_precision_of_a_calibration_is_that_of_its_transform():
    images = simulate_recording(Protocol(images=8), seed=1).calibration
    result = calibrate(Problem.from_arrays(images.poses, images.measurements), "conventional")
    given = images.poses, images.measurements
    expected = reconstruction_precision(result.image_to_probe, *given)
    np.testing.assert_array_equal(reconstruction_precision(result, *given), expected)


def test_a_single_image_has_no_scatter():
    pose, points = random_poses(3, 0), np.full((3, 2), 20.0)
    for mask in ([1.0, 0.0, 0.0], np.zeros(3)):
        with pytest.raises(InputError, match="at least two images"):
            reconstruction_precision(np.eye(4), pose, points, np.array(mask))


def test_reproducibility_of_shifted_calibrations():
    transforms = np.tile(np.eye(4), (2, 1, 1))
    transforms[1, 1, 3] = 4.0
    corners = np.array([[-20.0, 0], [20, 0], [-20, 80], [20, 80], [0, 40]])
    np.testing.assert_allclose(calibration_reproducibility(transforms, corners), 2.0)
    turned = random_poses(3, 5)
    spread = calibration_reproducibility(turned, corners)
    points = np.stack([corners[:, 0], 0 * corners[:, 0], corners[:, 1]], axis=1)
    images = np.einsum("kij,mj->kmi", turned[:, :3, :3], points) + turned[:, None, :3, 3]
    expected = np.linalg.norm(images - images.mean(axis=0), axis=-1).mean(axis=0)
    np.testing.assert_allclose(spread, expected)
