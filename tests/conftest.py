"""Shared problems and the folder of real recordings, where there is one."""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

# Nearly all of the tests' time is compilation: building each fusion with MLIR is most of that (with
# jax 0.10), optimising it with LLVM comes next. What XLA does to a program as a whole stays as it
# is for users.
QUICK = (
    "--xla_backend_optimization_level=0",
    "--xla_llvm_disable_expensive_passes=true",
    "--xla_cpu_use_fusion_emitters=false",
    # Both cores are busy anyway; programs cut in parts for several threads take longer altogether.
    "--xla_cpu_parallel_codegen_split_count=1",
)


def _known_flags() -> str:
    """Those of ``QUICK`` that this jaxlib knows.

    An unknown flag in XLA_FLAGS ends the process without a word, so they are tried in another one.
    """

    def accepted(flags: tuple[str, ...]) -> bool:
        start = [sys.executable, "-c", "import jax; jax.devices()"]
        environment = os.environ | {"XLA_FLAGS": " ".join(flags), "JAX_PLATFORMS": "cpu"}
        return not subprocess.run(start, env=environment, capture_output=True).returncode

    return " ".join(QUICK if accepted(QUICK) else [flag for flag in QUICK if accepted((flag,))])


# Read when JAX starts its backend, so first of all; workers of pytest-xdist inherit the answer.
if "JAXCAL_TEST_XLA_FLAGS" not in os.environ:
    os.environ["JAXCAL_TEST_XLA_FLAGS"] = _known_flags()
os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "") + " " + os.environ["JAXCAL_TEST_XLA_FLAGS"]
).strip()

# A thread of OpenBLAS that waits for work takes a core from the other workers.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

# A shell's background job ignores Ctrl-C, and so would every process that a test starts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# One cache of compiled programs for all workers and for every process that a test starts, ours and
# JAX's own: a program is compiled once, unless compiling it is as cheap as keeping it. It is new
# for each run, so that a run never depends on the last one; only .ci/run names one for its runs.
if "JAXCAL_TEST_CACHE" not in os.environ:
    os.environ["JAXCAL_TEST_CACHE"] = tempfile.mkdtemp(prefix="jaxcal-tests-")
    atexit.register(shutil.rmtree, os.environ["JAXCAL_TEST_CACHE"], ignore_errors=True)
os.environ["XDG_CACHE_HOME"] = os.environ["JAXCAL_TEST_CACHE"]
os.environ["JAX_COMPILATION_CACHE_DIR"] = os.path.join(os.environ["JAXCAL_TEST_CACHE"], "jax")
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"
os.environ.pop("JAXCAL_NO_CACHE", None)

# The bytecode of sources is kept: every process that a test starts would compile them anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Before jaxcal is imported, whose functions it wraps.
import checked_calls

checked_calls.install()

import gc

import hypothesis
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from held_up import pytest_runtest_protocol, pytest_terminal_summary  # noqa: F401
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.data.poses import rotation_angle
from jaxcal.runtime import executables

# Many tests look at the insides, which compute in the caller's bits; test_guest.py is about callers
# who have 32. Not by the environment: processes that the tests start are users'.
jax.config.update("jax_enable_x64", True)

# Of 1,700 programs that tests asked JAX's cache for in their own process it had none: each module
# compiles others. To keep one takes 3 % of the time of compiling it. Processes that the tests start
# share what they keep, and jaxcal's own programs are kept anyway.
jax.config.update("jax_enable_compilation_cache", False)

# An example may take as long as the machine needs. By default the examples are the same in every
# run, so that a failure comes from a change; ``--hypothesis-profile=new-examples`` draws others.
hypothesis.settings.register_profile(
    "new-examples", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.register_profile(
    "same-examples", hypothesis.settings.get_profile("new-examples"), derandomize=True
)
hypothesis.settings.load_profile("same-examples")

# Tracing makes millions of objects that die young; looking through all others takes a tenth of it.
gc.set_threshold(50_000, 20, 50)


def pytest_runtestloop(session: pytest.Session) -> object:
    """Run all tests inside a large frame, so that frames of what they call find room behind it.

    CPython 3.11 keeps frames in chunks of 16 KB and unmaps a chunk once it is empty. If a loop
    calls a function across the end of a chunk, the system maps memory for every call: of tests that
    plan poses, this was a fifth of the time. A frame of 1 MB gets a chunk of 2 MB.
    """
    rest = session.config.pluginmanager.subset_hook_caller(
        "pytest_runtestloop", [sys.modules[__name__]]
    )
    return rest(session=session)


pytest_runtestloop.__code__ = pytest_runtestloop.__code__.replace(co_stacksize=2**17 + 2**10)
pytest_runtestloop = pytest.hookimpl(tryfirst=True)(pytest_runtestloop)

REAL_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="module", autouse=True)
def _programs_of_one_module():
    """Compiled programs take memory, and mappings of it, which are limited: forget them."""
    yield
    jax.clear_caches()
    executables.forget()
    gc.collect()
    # What is left stays to the end: no later collection need look through it (0.4 s for a module).
    gc.freeze()


@pytest.fixture(autouse=True)
def _calls_are_checked():
    """Shapes of the first calls of every function, in every test."""
    checked_calls.begin_test()


@pytest.fixture(autouse=True)
def _scheduling_is_kept():
    """With real-time scheduling, this process would take a core from all that run beside it."""
    before = os.sched_getscheduler(0) if sys.platform == "linux" else None
    yield
    if sys.platform == "linux":
        assert os.sched_getscheduler(0) == before


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without run-time type checks, which take most of the time of many short calls."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(scope="session")
def real_data() -> Path:
    if not REAL_DATA.is_dir():
        pytest.skip("the real recordings (../shared/data) are not here")
    return REAL_DATA


def experiment(seed: int = 0, **protocol) -> jaxcal.Recording:
    """A simulated recording without covariances, so that common SDs apply."""
    recording = jaxcal.simulate_recording(jaxcal.Protocol(**protocol), seed)
    return replace(recording, calibration=replace(recording.calibration, covariance=None))


def problem(seed: int = 0, **protocol) -> jaxcal.Problem:
    return jaxcal.Problem.from_recording(experiment(seed, **protocol))


def select(problem: jaxcal.Problem, rows: Any) -> jaxcal.Problem:
    """The problem with only some of its images."""

    def pick(name: str) -> object:
        value = getattr(problem, name)
        # By numpy, since JAX compiles a program for every number of rows.
        return None if value is None else jnp.asarray(np.asarray(value)[rows])

    names = ("poses", "measurements", "mask", "covariance", "max_elevation")
    return replace(problem, **{name: pick(name) for name in names})


@contextmanager
def compiled_programs() -> Iterator[list[str]]:
    """The list of what JAX compiles within it."""
    compiled: list[str] = []

    def listen(event: str, _: float, **__: str | int) -> None:
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def random_poses(count: int, seed: int | np.random.Generator = 0) -> np.ndarray:
    """Poses turned in all directions, up to 200 mm from the origin along each axis."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    poses[:, :3, 3] = rng.uniform(-200, 200, (count, 3))
    return poses


def png(columns: int, rows: int, data: bytes) -> bytes:
    """A PNG file of 8 bits that claims this size, whatever its data hold."""

    def chunk(name: bytes, content: bytes) -> bytes:
        crc = zlib.crc32(name + content)
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", crc)

    head = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def angle(first: np.ndarray, second: np.ndarray) -> float:
    return rotation_angle(np.asarray(first), np.asarray(second))


LONGEST = (
    "test_acquire",
    "test_unmodelled",
    "test_cli",
    "test_guest",
    "test_study",
    "test_dependence",
    "test_free_hand",
    "test_solvers",
    "test_design",
    "test_normal_equations",
    "test_view",
    "test_oracle",
    "test_hand_held_injection",
    "test_buckets",
    "test_motion_faults",
    "test_accuracy",
    "test_joint",
    "test_report",
    "test_conventional",
    "test_segmentation",
    "test_recorder",
    "test_robust",
    "test_motion_gates",
    "test_segmentation_image",
    "test_closed_form",
    "test_pivot",
    "test_stream",
    "test_importing_frames",
    "test_observability_sets",
    "test_motion_stops",
    "test_golden",
    "test_python_answer",
    "test_simulation",
    "test_executables",
    "test_files",
)
"""Modules that take longest, which start first: no worker is left alone with one at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Every solver takes the whole suite; what repeats another's code path does so with -m slow."""
    place = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONGEST)))
    for item in items:
        parameters = getattr(item, "callspec", None)
        if parameters is None or "solver" not in parameters.params:
            continue
        solver = parameters.params["solver"].name
        large = parameters.params.get("images") == 1000
        name = getattr(item, "originalname", "")
        costly = large or name == "test_float32"
        # Self-tuning compiles longest by far.
        longest = solver == "self-tuned" and (
            costly or name.startswith(("test_batches", "test_images_left_out", "test_any_number"))
        )
        if solver in ("gauss-newton", "gradient", "gaussian", "gaussian-tracker") or (
            longest or (costly and solver in ("alternating", "bounded"))
        ):
            item.add_marker(pytest.mark.slow)
