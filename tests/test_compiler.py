"""Compiler flags that a compiler does not know are left out, and end nothing."""

from __future__ import annotations

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from jaxcal.runtime import compiler


def test_an_unknown_flag_is_left_out_and_the_others_stay():
    flags = {"xla_cpu_enable_fast_math": False, "xla_no_such_flag": True}
    assert compiler.known("cpu", flags) == {"xla_cpu_enable_fast_math": False}


def test_a_value_that_the_compiler_refuses_is_left_out():
    assert compiler.known("cpu", {"xla_cpu_prefer_vector_width": "wide"}) == {}


@pytest.mark.parametrize("wish", [compiler.fast_to_run, compiler.quick_to_compile])
def test_every_wish_compiles_with_this_compiler(wish):
    program = jax.jit(lambda x: x + 1, compiler_options=wish("cpu"))
    assert float(program(np.float32(1))) == 2


def test_fast_math_is_never_given_without_its_nan(monkeypatch):
    def are_known(platform, flags):
        return not any("nans" in name for name, _ in flags)

    monkeypatch.setattr(compiler, "_are_known", are_known)
    assert compiler.fast_to_run("cpu") == {"xla_cpu_prefer_vector_width": 512}


def test_the_flags_of_these_tests_are_known():
    """Unknown ones in XLA_FLAGS would have ended this process at the backend's start."""
    assert jax.devices()
    code = "import jax; jax.devices()"
    environment = os.environ | {"XLA_FLAGS": os.environ["JAXCAL_TEST_XLA_FLAGS"]}
    assert subprocess.run([sys.executable, "-c", code], env=environment).returncode == 0
