"""A batch shared out among devices."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np

PROGRAM = """
import sys
import jax
import numpy as np
import jaxcal
from jaxcal.study.simulation import Protocol, simulate

jax.config.update("jax_enable_x64", True)
root, protocol = jax.random.key(1), Protocol(images=12, noise_mm=0.5)
draw = jax.jit(jax.vmap(lambda k: simulate(jax.random.fold_in(root, k), protocol).problem()))
problems = draw(np.arange(70))
found = jaxcal.calibrate_batch(problems, method="conventional")
np.save(sys.argv[1], np.concatenate([[len(jax.devices())], found.image_to_probe.ravel()]))
"""


def test_results_do_not_depend_on_the_number_of_devices(tmp_path):
    for count in (1, 2):
        environment = os.environ | {"JAX_NUM_CPU_DEVICES": str(count), "JAX_PLATFORMS": "cpu"}
        environment.pop("XLA_FLAGS")  # the tests' own; programs shall be those of users
        command = [sys.executable, "-c", PROGRAM, str(tmp_path / f"{count}.npy")]
        subprocess.run(command, env=environment, check=True)
    one, two = (np.load(tmp_path / f"{count}.npy") for count in (1, 2))
    assert (one[0], two[0]) == (1, 2)
    # One device runs a program that is kept, for whole chunks: other sums, the same but rounding.
    np.testing.assert_allclose(one[1:], two[1:], rtol=0, atol=1e-11)
