"""jaxcal as a guest: the settings of a process stay, its modes and devices are lived with."""

from __future__ import annotations

import importlib
import os
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from conftest import compiled_programs, experiment, problem
from golden import corpus

import jaxcal
from jaxcal import Options
from jaxcal.runtime.jax_modes import in_own_modes

DOCS = Path(__file__).parents[1] / "docs"


def run_fresh(code: str, folder: Path, **variables: str) -> str:
    """Run a program in a fresh interpreter as a user's; returns what it printed.

    It finds two problems of 12 images in the folder, as ``k-poses.npy`` and ``k-points.npy``.
    """
    for k in range(2):
        there = problem(k, images=12)
        np.save(folder / f"{k}-poses.npy", there.poses)
        np.save(folder / f"{k}-points.npy", there.measurements)
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "JAXTYPING"))}
    environment["XLA_FLAGS"] = os.environ["JAXCAL_TEST_XLA_FLAGS"]
    done = subprocess.run(
        [sys.executable, "-W", "error::DeprecationWarning:__main__", "-c", code],
        env=environment | variables,
        capture_output=True,
        text=True,
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


PROCESS = """
import os, subprocess, sys
import numpy as np
show = ["env"]
jax_first = {jax_first}
if jax_first:
    import jax, jax.numpy as jnp
    jax.devices()
    settings = dict(jax.config.values)
    assert jnp.ones(2).dtype == "float32"
before = subprocess.check_output(show)
import jaxcal
jaxcal.calibrate, jaxcal.simulate, jaxcal.segment, jaxcal.bootstrap, jaxcal.predicted_tre
import jax, jax.numpy as jnp
assert jnp.ones(2).dtype == "float32"
if jax_first:
    assert dict(jax.config.values) == settings, "importing changed a setting"
    problem = jaxcal.Problem.from_arrays(np.load("0-poses.npy"), np.load("0-points.npy"))
    result = jaxcal.calibrate(problem, "conventional")
    print(result.status, type(result.image_to_probe).__name__, result.image_to_probe.dtype)
    assert result.warnings is not None and result.observability["condition"] > 1
    assert jaxcal.predicted_tre(result, np.zeros((1, 2))).dtype == "float64"
    assert jnp.ones(2).dtype == "float32"
    assert dict(jax.config.values) == settings, "calibrating changed a setting"
    assert subprocess.check_output(show) == before, "a child's environment changed"
else:
    changed = set(subprocess.check_output(show).splitlines()) ^ set(before.splitlines())
    assert not any(b"X64" in line for line in changed), changed
"""


THREADS = """
import sys, time
from concurrent.futures import ThreadPoolExecutor
import numpy as np
import jaxcal

sys.setswitchinterval(1e-4)  # an import waits for its turn often
problem = jaxcal.make_images(np.load("0-poses.npy"), np.load("0-points.npy"))
begun, over, answers = [], False, []

def solve():
    while not over:
        begun.append(over)
        found = jaxcal.calibrate(problem, "conventional")
        assert str(found)
        answers.append(np.asarray(found.image_to_probe))

with ThreadPoolExecutor() as pool:
    working = [pool.submit(solve) for _ in range(2)]
    while len(begun) < 8 and not working[0].done():
        time.sleep(0.01)
    import jax
    over = True
for each in working:
    each.result()
assert len(answers) == len(begun)
print({answer.dtype.name for answer in answers}, len({answer.tobytes() for answer in answers}))
"""


def test_another_thread_may_import_jax_meanwhile(tmp_path):
    """JAX was looked into before it was there, and answers that began without it had 32 bits."""
    assert run_fresh(THREADS, tmp_path) == "{'float64'} 1\n"


@pytest.mark.parametrize("jax_first", [True, False])
def test_importing_and_calibrating_change_nothing_of_the_process(jax_first, tmp_path):
    said = run_fresh(PROCESS.format(jax_first=jax_first), tmp_path)
    assert said == ("converged ndarray float64\n" if jax_first else "")


def test_answers_do_not_depend_on_the_callers_bits():
    there = problem(3, images=12)
    wide = jaxcal.calibrate(there, "conventional")
    with jax.enable_x64(False):
        recording = experiment(3, images=12)
        here = jaxcal.Problem.from_recording(recording)
        assert isinstance(here.poses, np.ndarray)
        narrow = jaxcal.calibrate(here, "conventional")
        # What JAX made 32 bits of has lost digits of the data, but is not solved in 32 bits.
        rounded = jaxcal.calibrate(jax.tree.map(jnp.asarray, here), "conventional")
        assert jnp.ones(2).dtype == jnp.float32
    assert isinstance(wide.image_to_probe, jax.Array)
    assert isinstance(narrow.image_to_probe, np.ndarray)
    assert rounded.image_to_probe.dtype == np.float64
    np.testing.assert_array_equal(narrow.image_to_probe, wide.image_to_probe)
    np.testing.assert_allclose(rounded.image_to_probe, wide.image_to_probe, atol=1e-3)


def test_a_pickle_keeps_64_bits_where_jax_has_32():
    with jax.enable_x64(True):
        result = jaxcal.calibrate(experiment(3, images=12), "conventional")
        assert isinstance(result.image_to_probe, jax.Array)
        held = pickle.dumps(result)
    with jax.enable_x64(False):
        again = pickle.loads(held)
    pairs = zip(jax.tree.leaves(result), jax.tree.leaves(again), strict=True)
    for before, after in pairs:
        assert after.dtype == before.dtype
        np.testing.assert_array_equal(after, np.asarray(before))


def test_a_float64_problem_inside_a_transformation_without_64_bits_gets_one_clear_line():
    there = problem(3, images=12)
    for transformed in (
        jax.jit(jaxcal.calibrate),
        jax.grad(lambda p: jaxcal.calibrate(p, "conventional").rms),
        jax.vmap(jaxcal.calibrate_batch),
    ):
        batch = jax.tree.map(lambda leaf: leaf[None, None], there)
        data = batch if "batch" in str(transformed) else there
        with jax.enable_x64(False), pytest.raises(jaxcal.InputError, match="enable_x64") as error:
            transformed(data)
        assert "\n" not in str(error.value)


def test_32_bits_where_they_are_asked_for():
    """As near to the recorded answers in 64 bits as it promises."""
    single = Options(precision="float32")
    family, answers = corpus.load("covariances24")
    there = family.problems(np.arange(1))[0]
    own = jaxcal.calibrate(there, options=single)
    reference = answers["auto", "batch"]["image_to_probe"][0]
    assert own.image_to_probe.dtype == own.elevation.dtype == jnp.float32
    np.testing.assert_allclose(own.image_to_probe[:3], reference, atol=0.02)
    there = problem(3, images=12)
    wide = jaxcal.calibrate(there, "conventional")
    with jax.enable_x64(False):
        inside = jax.jit(lambda p: jaxcal.calibrate(p, "conventional", options=single))(there)
    assert inside.image_to_probe.dtype == jnp.float32
    np.testing.assert_allclose(inside.image_to_probe, wide.image_to_probe, atol=5e-3)


STRICT = {
    "jax_numpy_dtype_promotion": ("standard", "strict"),
    "jax_numpy_rank_promotion": ("allow", "raise"),
    "jax_debug_nans": (False, True),
}


def within_jax(frame) -> bool:
    """Whether JAX runs this frame, or anything that called it."""
    while frame is not None:
        if f"{os.sep}jax{os.sep}" in frame.f_code.co_filename:
            return True
        frame = frame.f_back
    return False


def test_an_interrupt_leaves_the_modes_of_the_caller():
    """Ctrl-C may arrive before any line; what JAX runs is its own matter.

    So are the lines that it calls: Python 3.11's ``cached_property`` holds a lock, which it would
    keep for ever where an exception comes before the last line of its ``with``. No signal does.
    """
    guest, before = in_own_modes(lambda: None), sys.gettrace()
    left = 0

    def interrupt(frame, event, _):
        nonlocal left
        if event == "call":
            return None if within_jax(frame) else interrupt
        if event == "line":
            left -= 1
            if left < 0:
                raise KeyboardInterrupt
        return interrupt

    with jax.enable_x64(False):
        guest()
        for first in range(10_000):
            left = first
            sys.settrace(interrupt)
            try:
                guest()
                break
            except KeyboardInterrupt:
                pass
            finally:
                sys.settrace(before)
            assert not jax.config.jax_enable_x64, first
    assert first > 20


@pytest.fixture
def strict():
    """All strict modes at once, for everybody in the process."""
    for name, (_, strictest) in STRICT.items():
        jax.config.update(name, strictest)
    yield
    for name, (usual, _) in STRICT.items():
        jax.config.update(name, usual)


@pytest.mark.usefixtures("strict")
def test_strict_modes_of_a_call_with_values():
    there = problem(3, images=12)
    result = jaxcal.calibrate(there, "conventional")
    assert result.status == "converged"
    with jax.debug_nans(False):
        bad = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), there)
    both = jaxcal.calibrate_batch(jaxcal.stack([there, bad]), "conventional")
    assert list(both.status) == ["converged", "failed"]
    assert np.isfinite(jaxcal.predicted_tre(result, np.zeros((1, 2)))).all()


@pytest.mark.usefixtures("strict")
def test_strict_modes_of_a_compiled_function_that_is_differentiated_and_batched_later():
    there = problem(3, images=12)

    @jax.jit
    def rms(p):
        return jaxcal.calibrate(p, "conventional").rms

    two = jaxcal.stack([there, there])
    found, gradient = jax.vmap(jax.value_and_grad(rms))(two)
    assert np.isfinite(gradient.measurements).all()
    assert np.abs(gradient.measurements).max() > 0
    np.testing.assert_allclose(found, [jaxcal.calibrate(there, "conventional").rms] * 2, rtol=1e-9)


def blocks_of(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", (DOCS / page).read_text(), re.M | re.S)


def test_the_documentations_examples_with_another_solver_and_on_another_problem():
    dogleg, pieces, circle, decay, own = blocks_of("how-to/own-solver.md")
    names: dict[str, object] = {}
    exec(compile(dogleg, "own-solver.md", "exec"), names)
    assert names["result"].status == "converged"
    assert names["result"].convergence.stationarity < 1e-8
    exec(compile(pieces, "own-solver.md", "exec"), names)

    def cost(tangent):
        return jnp.sum(names["residual"](tangent, names["problem"]) ** 2)

    both = jax.jit(jax.value_and_grad(cost))
    value, slope = both(names["solution"].value)
    assert value < both(jnp.zeros(9))[0]
    assert np.abs(slope).max() < 1e-5 * value
    exec(compile(circle, "own-solver.md", "exec"), names)
    np.testing.assert_allclose(names["circle"]["centre"], [3, 1], atol=0.02)
    np.testing.assert_allclose(names["circle"]["radius"], 5, atol=0.02)
    exec(compile(decay, "own-solver.md", "exec"), names)
    np.testing.assert_allclose([names["decay"][k] for k in ("size", "rate")], [3, 1.5], rtol=1e-9)
    exec(compile(own, "own-solver.md", "exec"), names)
    check_the_documentations_own_observation(names)


def check_the_documentations_own_observation(names: dict) -> None:
    """Against scipy on residuals that are written out again; its derivative against its answers."""
    from scipy.optimize import least_squares

    from jaxcal import backend

    fit, problems = names["fit"], names["problems"]
    assert np.all(fit.converged)
    problem = problems[0]
    found = jax.tree.map(lambda leaf: leaf[0], fit.iterate.parameters())
    depth = np.asarray(problem.measurements)[:, 1]
    assert float(problem.face_offset) == 0

    def residual(step):
        errors = backend.measurement_residual(backend.retract(found, step, backend.RIGID), problem)
        return (errors / jnp.stack([0.3 + 0 * depth, 0.01 * depth, 0.6 + 0 * depth], 1)).ravel()

    peer = least_squares(
        jax.jit(residual), 0.05 * np.ones(9), jax.jit(jax.jacfwd(residual)), xtol=1e-15, gtol=1e-15
    )
    np.testing.assert_allclose(2 * peer.cost, fit.cost[0], rtol=1e-9)
    np.testing.assert_allclose(peer.x, 0, atol=1e-5)
    images = names["images"]
    with compiled_programs() as compiled:  # the second call of the same kind
        backend.minimise(names["begin"], names["relative"], images)
    assert compiled == []
    step = jnp.zeros_like(images.lateral).at[0, 3].set(1e-4)

    @jax.jit
    def solved(lateral):
        moved = replace(images, lateral=lateral)
        return jnp.sum(backend.minimise(fit.iterate, names["relative"], moved).iterate.translation)

    difference = (solved(images.lateral + step) - solved(images.lateral - step)) / 2e-4
    np.testing.assert_allclose(names["by_lateral"][0, 3], difference, rtol=1e-5)


def test_our_solver_on_another_problem_equals_a_dense_one_and_differentiates():
    from scipy.optimize import least_squares

    from jaxcal import backend

    rng = np.random.default_rng(1)
    x = np.linspace(0, 1, 12)
    data = np.stack([x, 2 + 3 * x**2], 1) + 0.05 * rng.normal(size=(12, 2))

    def residual(curve, local, data):
        return jnp.stack([local, curve[0] + curve[1] * local**2], 1) - data

    def fit(data):
        return backend.arrow_least_squares(residual, jnp.ones(2), data[:, 0], data).value[0]

    def dense(v):
        return np.asarray(residual(v[:2], v[2:], data)).ravel()

    peer = least_squares(dense, np.concatenate([np.ones(2), data[:, 0]]), xtol=1e-15, ftol=1e-15)
    found = fit(jnp.asarray(data))
    np.testing.assert_allclose(found, peer.x[:2], atol=1e-6)
    slope = jax.jacobian(fit)(jnp.asarray(data))[:, 3, 1]
    step = np.zeros_like(data)
    step[3, 1] = 1e-5
    difference = (fit(jnp.asarray(data + step)) - fit(jnp.asarray(data - step))) / 2e-5
    np.testing.assert_allclose(slope, difference, rtol=1e-5)


def test_another_solver_is_refused_where_it_cannot_do_it():
    other = Options(solver=optx.LevenbergMarquardt(1e-8, 1e-8))
    for arguments in ({"method": "alternating"}, {"prior": "bounded"}):
        with pytest.raises(jaxcal.InputError, match="bounds"):
            jaxcal.calibrate(problem(1, images=12), options=other, **arguments)
    with pytest.raises(jaxcal.InputError, match="plain numbers"):
        Options(solver=optx.LevenbergMarquardt(jnp.asarray([1e-8]), 1e-8))
    # optimistix keeps its learning rate in an array, which has no hash.
    given = [Options(solver=optx.GaussNewton(1e-8, 1e-8)) for _ in range(2)]
    assert given[0] == given[1]
    assert hash(given[0]) == hash(given[1])


def test_without_derivatives_the_answer_is_a_constant():
    there = problem(3, images=12)
    still = Options(differentiate=False)

    def rms(p, options):
        result = jaxcal.calibrate(p, "conventional", options=options)
        return result.rms, result.differentiable

    gradient, flag = jax.grad(rms, has_aux=True)(there, still)
    assert not flag
    assert not np.any(gradient.measurements)
    assert jaxcal.calibrate(there, "conventional").differentiable


def test_an_alternation_that_stops_short_has_no_derivative():
    """It returned NaN, or a wrong number; values, also of batches inside jit, are not affected."""
    there = problem(3, images=12)
    batch = jaxcal.stack([there, there])

    def rms(p, options):
        return jnp.sum(jaxcal.calibrate_batch(p, "alternating", options=options).rms)

    for options in (Options(), Options(tolerance_mm=1e-8)):
        with pytest.raises(jaxcal.InputError, match='method="joint" with prior="bounded"'):
            jax.grad(rms)(batch, options)
    jax.eval_shape(lambda p: rms(p, Options()), batch)
    both = jax.jit(jax.value_and_grad(rms), static_argnums=1)
    value, constant = both(batch, Options(differentiate=False))
    assert np.isfinite(value)
    assert not np.any(constant.measurements)


@pytest.mark.parametrize("module", ["jaxcal", "jaxcal.study", "jaxcal.design"])
def test_a_star_imports_every_public_name(module):
    names: dict[str, object] = {}
    exec(f"from {module} import *", names)
    public = {name for name in dir(importlib.import_module(module)) if not name.startswith("_")}
    assert public <= set(names)


def test_public_names_are_there_and_listed():
    import jaxcal.backend
    import jaxcal.study

    for module, names in (
        (jaxcal, dir(jaxcal)),
        (jaxcal.study, dir(jaxcal.study)),
        (jaxcal.backend, jaxcal.backend.__all__),
    ):
        assert all(getattr(module, name) is not None for name in names)


INTERRUPTED_IMPORT = """
import signal, sys, time
import numpy as np, jaxcal
class CtrlC:
    def find_spec(self, name, path=None, target=None):
        if name == "jax.numpy":
            sys.meta_path.remove(self)
            signal.raise_signal(signal.SIGINT)
poses = np.eye(4)[None]
handler = signal.getsignal(signal.SIGINT)
sys.meta_path.insert(0, CtrlC())
try:
    try:
        jaxcal.calibrate_pivot(poses)
    except jaxcal.InputError:  # too few poses
        time.sleep(60)
except KeyboardInterrupt:
    print("interrupted")
assert signal.getsignal(signal.SIGINT) is handler
try:
    jaxcal.calibrate_pivot(poses)
except jaxcal.InputError:
    print("answers")
"""


def test_ctrl_c_while_jax_is_imported_comes_and_leaves_jax_whole(tmp_path):
    """JAX's modules that stayed were no part of the next JAX, for the rest of the process."""
    assert run_fresh(INTERRUPTED_IMPORT, tmp_path).split() == ["interrupted", "answers"]
