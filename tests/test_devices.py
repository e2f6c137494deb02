"""A batch shared out among devices."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
from conftest import problem

import jaxcal

PROGRAM = """
import sys
import jax
import numpy as np
import jaxcal

jax.config.update("jax_enable_x64", True)
given = np.load("given.npz")
each = [jaxcal.Problem.from_arrays(given["poses"], points) for points in given["points"]]
found = jaxcal.calibrate_batch(each, method="conventional")
np.save("found.npy", np.concatenate([[len(found.rms.devices())], found.image_to_probe.ravel()]))
"""


def test_results_do_not_depend_on_the_number_of_devices(tmp_path):
    there = problem(1, images=12, noise_mm=0.5)
    noise = np.random.default_rng(0).normal(0, 0.5, (70, 12, 2))
    given = {"poses": np.asarray(there.poses), "points": np.asarray(there.measurements) + noise}
    np.savez(tmp_path / "given.npz", **given)
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": "2", "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", PROGRAM], env=environment, cwd=tmp_path, check=True)
    two = np.load(tmp_path / "found.npy")
    each = [jaxcal.Problem.from_arrays(given["poses"], points) for points in given["points"]]
    one = jaxcal.calibrate_batch(each, method="conventional")
    assert (len(one.rms.devices()), two[0]) == (1, 2)
    # One device runs a program that is kept, for whole chunks: other sums, the same but rounding.
    np.testing.assert_allclose(one.image_to_probe.ravel(), two[1:], rtol=0, atol=1e-11)
