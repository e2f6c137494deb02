"""A batch shared out among devices, and arrays that are on a device already."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
from conftest import problem

import jaxcal

PROGRAM = """
import dataclasses
import jax
import numpy as np
import jaxcal
from jax.sharding import Mesh, NamedSharding, PartitionSpec

jax.config.update("jax_enable_x64", True)
first, second = jax.devices()
given = np.load("given.npz")
problems = jaxcal.stack(
    [jaxcal.Problem.from_arrays(given["poses"], points) for points in given["points"]]
)
free = jaxcal.calibrate_batch(problems, method="conventional", chunk=3)
assert free.rms.devices() == {first, second}
np.save("found.npy", free.image_to_probe)
there = jaxcal.calibrate_batch(jax.device_put(problems, second), "conventional", chunk=3)
assert there.rms.devices() == {second}, there.rms.devices()
np.testing.assert_allclose(there.image_to_probe, free.image_to_probe, atol=1e-9)
sharding = NamedSharding(Mesh(np.array([first, second]), "k"), PartitionSpec("k"))
spread = jaxcal.calibrate_batch(jax.device_put(problems, sharding), "conventional", chunk=3)
assert spread.rms.devices() == {first, second}
np.testing.assert_allclose(spread.image_to_probe, free.image_to_probe, atol=1e-9)
mesh = jax.make_mesh((2,), ("k",))
assert mesh.explicit_axes
explicit = jax.device_put(problems, NamedSharding(mesh, PartitionSpec("k")))
spread = jaxcal.calibrate_batch(explicit, "conventional", chunk=3)
np.testing.assert_allclose(spread[5].image_to_probe, free.image_to_probe[5], atol=1e-9)
with jax.set_mesh(mesh):
    try:
        jaxcal.calibrate_batch(explicit, "conventional")
    except jaxcal.InputError as error:
        print(error)
torn = jax.device_put(problems, second)
torn = dataclasses.replace(torn, poses=jax.device_put(problems.poses, first))
try:
    jaxcal.calibrate_batch(torn, "conventional")
except jaxcal.InputError as error:
    print(error)
"""


def test_results_do_not_depend_on_the_devices_and_stay_there(tmp_path):
    there = problem(1, images=12, noise_mm=0.5)
    noise = np.random.default_rng(0).normal(0, 0.5, (6, 12, 2))
    given = {"poses": np.asarray(there.poses), "points": np.asarray(there.measurements) + noise}
    np.savez(tmp_path / "given.npz", **given)
    done = subprocess.run(
        [sys.executable, "-W", "error::DeprecationWarning:__main__", "-c", PROGRAM],
        env=os.environ | {"JAX_NUM_CPU_DEVICES": "2", "JAX_PLATFORMS": "cpu"},
        capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "different devices" in done.stdout
    assert "AxisType.Auto" in done.stdout
    each = [jaxcal.Problem.from_arrays(given["poses"], points) for points in given["points"]]
    one = jaxcal.calibrate_batch(each, method="conventional")
    assert len(one.rms.devices()) == 1
    # One device runs a program that is kept, for whole chunks: other sums, the same but rounding.
    two = np.load(tmp_path / "found.npy")
    np.testing.assert_allclose(one.image_to_probe, two, rtol=0, atol=1e-11)
