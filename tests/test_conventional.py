"""One conventional calibration in numpy: the engine's answer, without JAX."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pose_sets
import pytest
from conftest import experiment, problem, select

import jaxcal
from jaxcal import Options
from jaxcal.calibration.calibrate import Request, prepare
from jaxcal.calibration.conventional import closed_form_answer
from jaxcal.cli.main import main

METHOD = "conventional"
SCALE = ("scale",)


def leaves(tree, prefix=""):
    for field in fields(tree):
        value = getattr(tree, field.name)
        if is_dataclass(value):
            yield from leaves(value, f"{prefix}{field.name}.")
        elif value is not None and not isinstance(value, str | tuple | bool):
            yield prefix + field.name, np.asarray(value)


def in_pixels(problem: jaxcal.Problem) -> jaxcal.Problem:
    """The same points in pixels of 0.2 x 0.17 mm, with a nominal spacing that is a little off."""
    pixels = problem.measurements / jnp.array([0.2, 0.17])
    return replace(problem, measurements=pixels, spacing=jnp.array([0.21, 0.16]), pixels=True)


def of_18(seed: int, **protocol) -> jaxcal.Problem:
    """Of 20 drawn ones, which other tests draw too."""
    return select(problem(seed, images=20, **protocol), slice(18))


def problems(pixels: bool) -> list[jaxcal.Problem]:
    """Ordinary, few used, noisy, nearly exact, an offset of the face.

    Of 18 images: from 20 on the front door looks for errors that are alike in successive ones.
    """
    drawn = [
        of_18(k, elevation_mm=elevation, noise_mm=noise)
        for k, (elevation, noise) in enumerate([(1.0, 0.5), (2.0, 1.0), (5.0, 3.0), (0.0, 1e-4)])
    ]
    drawn = [in_pixels(each) for each in drawn] if pixels else drawn
    left_out = drawn[0].mask.at[jnp.arange(7, 18)].set(0.0)
    face = replace(drawn[1], face_offset=jnp.asarray(10.0))
    return [*drawn, replace(drawn[0], mask=left_out), face]


@pytest.mark.parametrize("estimate", [(), SCALE], ids=["points", "scale"])
def test_every_number_is_the_engines(estimate):
    """The engine solves the same problems as a batch; covariances agree to 1e-8."""
    each = problems(bool(estimate))
    engine = jaxcal.calibrate_batch(jaxcal.stack(each), METHOD, estimate=estimate)
    for k, one in enumerate(each):
        found, expected = jaxcal.calibrate(one, METHOD, estimate=estimate), engine[k]
        assert closed_form(one, estimate=estimate) is not None, "it was not the answer"
        assert found.status == expected.status == "converged"
        sd = np.sqrt(np.diagonal(expected.covariance))
        moved = np.linalg.solve(expected.image_to_probe, found.image_to_probe)
        turned = np.array([moved[2, 1], moved[0, 2], moved[1, 0]])
        # Levenberg-Marquardt stops at its tolerance, the closed form does not.
        assert np.abs(np.concatenate([moved[:3, 3], turned]) / sd).max() < 1e-6
        both = np.outer(sd, sd)
        np.testing.assert_allclose(found.covariance / both, expected.covariance / both, atol=1e-8)
        wanted = dict(leaves(expected))
        for name, value in leaves(found):
            assert value.shape == wanted[name].shape, name
            assert value.dtype == wanted[name].dtype, name
            if name.rsplit(".")[-1] in ("iterations", "stationarity"):
                continue
            # Of nearly exact data an offset is rounding: then of 0.01 mm.
            least = 0.01 if name == "elevation" else 1e-12
            size = max(least, np.abs(wanted[name]).max(initial=0.0))
            np.testing.assert_allclose(value, wanted[name], rtol=0, atol=1e-8 * size, err_msg=name)
        assert int(found.convergence.iterations) == 0
        assert float(found.convergence.stationarity) < 1e-6


def test_sound_speed_is_the_engines():
    recording = jaxcal.simulate_recording(
        jaxcal.Protocol(images=12, raw=True, elevation_mm=1.0, noise_mm=0.5), 3
    )
    one = jaxcal.Problem.from_recording(recording)
    found = jaxcal.calibrate(one, METHOD, estimate=("sound-speed",), data="points")
    batch = jaxcal.stack([one])
    expected = jaxcal.calibrate_batch(batch, METHOD, estimate=("sound-speed",), data="points")[0]
    assert int(found.convergence.iterations) == 0 < int(expected.convergence.iterations)
    for one, other, names in (
        (found, expected, ("covariance", "image_to_probe")),
        (found.medium, expected.medium, ("sound_speed_m_s", "sound_speed_sd_m_s")),
    ):
        for name in names:
            np.testing.assert_allclose(
                getattr(one, name), getattr(other, name), rtol=1e-7, atol=1e-9, err_msg=name
            )
    assert found.medium.sound_speed_prior_m_s is None


def test_the_sound_speed_of_pixels_counts_from_that_of_scanners():
    """A scanner shows depths for 1540 m/s; the target is in water of 1482 m/s."""
    drawn = of_18(3, elevation_mm=0.0, noise_mm=1e-4)
    stretched = np.asarray(drawn.measurements) * [1.0, 1540 / 1482] / 0.2
    pixels = jaxcal.Problem.from_arrays(
        np.asarray(drawn.poses), stretched, kind="pixel", spacing_mm=(0.2, 0.2)
    )
    found = jaxcal.calibrate(pixels, METHOD, estimate=("sound-speed",))
    assert found.medium.sound_speed_m_s == pytest.approx(1482.0, abs=0.1)
    assert found.image_transform().range_factor == pytest.approx(1482 / 1540, rel=1e-4)


def closed_form(one: jaxcal.Problem, **asked):
    one, plan, _ = prepare(one, Request(method=METHOD, **asked))
    return closed_form_answer(one, plan)


def test_where_the_engine_stays():
    """Another solver, a robust search, 32 bits, a delay, and whatever JAX looks at."""
    one = of_18(1, elevation_mm=1.0, noise_mm=0.5)
    assert closed_form(one) is not None
    assert closed_form(one, options=Options(solver="gauss-newton")) is None
    assert closed_form(one, options=Options(precision="float32")) is None
    assert closed_form(one, robust=True) is None
    # Under jit the closed form could not be numpy's.
    lowered = jax.jit(lambda p: jaxcal.calibrate(p, METHOD).convergence.iterations).lower(one)
    assert "while" in lowered.as_text()


@pytest.mark.parametrize("kind", ["parallel", "one-axis", "line-in-plane"])
def test_what_is_not_determined_is_left_to_the_engine(kind):
    # Noise bends a line, and then one answer is the best.
    noise = 0.0 if kind == "line-in-plane" else 0.1
    drawn = pose_sets.make(kind, seed=3, elevation=0.0, noise=noise)
    one = jaxcal.Problem.from_arrays(drawn.poses, drawn.points, mask=drawn.mask)
    assert closed_form(one) is None


def test_a_weakly_known_direction_is_said():
    """Poses that hardly differ: the SD along the weakest direction exceeds half the lever arm."""
    one = of_18(2, elevation_mm=1.0, noise_mm=1.0)
    vectors = np.random.default_rng(0).normal(size=(18, 3)) * 1e-4
    poses = np.tile(np.eye(4), (18, 1, 1))
    for pose, vector in zip(poses, vectors, strict=True):
        cross = np.cross(np.eye(3), vector)
        pose[:3, :3] = np.linalg.qr(np.eye(3) + cross)[0] * [-1, -1, -1]
        pose[:3, :3] *= np.sign(np.diag(pose[:3, :3]))
    poses[:, :3, 3] = np.random.default_rng(1).normal(size=(18, 3)) * 30
    weak = replace(one, poses=jnp.asarray(poses))
    engine = jaxcal.calibrate_batch(jaxcal.stack([weak]), METHOD)
    assert jaxcal.calibrate(weak, METHOD).status == engine.status[0] == "unobservable"


def test_the_trace_is_one_value():
    found = jaxcal.calibrate(of_18(1), METHOD, options=Options(trace=3))
    ended = found.convergence
    np.testing.assert_array_equal(np.isnan(ended.trace), [False, True, True])
    assert float(ended.trace[0]) == float(ended.cost)


def test_an_answer_does_not_change_with_the_callers_arrays():
    exact = experiment(5, images=20).calibration
    # JAX shares the memory of arrays that lie so.
    memory = np.empty(exact.measurements.size + 8)
    first = -memory.ctypes.data % 64 // 8
    points = memory[first : first + exact.measurements.size].reshape(exact.measurements.shape)
    points[:] = exact.measurements
    images = replace(exact, measurements=points)
    data = jaxcal.Problem.from_recording(images)
    held = replace(data, measurements=np.array(data.measurements))
    answers = [jaxcal.calibrate(given, METHOD) for given in (images, data, held)]
    points[3] += 20.0
    held.measurements[3] += 20.0
    for answer in answers:
        assert np.abs(answer.residual[3]).max() < 5.0
        np.testing.assert_array_equal(answer.problem.measurements, exact.measurements)


# Without JAX

ALONE = """
import importlib.util, json, sys
import numpy as np
import jaxcal
recording = jaxcal.load(sys.argv[1])
problem = jaxcal.Problem.from_recording(recording)
found = jaxcal.calibrate(problem, method="conventional")
said = [found.status, float(found.rms), found.warnings, found.observability["condition"]]
read = [found.residual, found.outlier, found.elevation_sd, found.weakest, found.inspection.misfit]
assert all(isinstance(each, np.ndarray) for each in read)
assert isinstance(problem.poses, np.ndarray) and bool(found.converged)
assert not found.image_to_probe.flags.writeable  # as a JAX array
assert found.image_transform().apply(np.ones((1, 2))).points.shape == (1, 3)
heavy = {"jax", "jaxlib", "equinox", "optimistix", "jaxtyping", "scipy.stats", "matplotlib"}
heavy |= {"jaxcal.report.plots", "jaxcal.report.page"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)

# Whoever asks whether JAX is there does not import it, and what is asked twice is found twice.
assert importlib.util.find_spec("jax") is not None and "jax" not in sys.modules
import jax
assert len(jax.tree.leaves(problem)) == 7, len(jax.tree.leaves(problem))
doubled = jax.tree.map(lambda leaf: 2 * leaf, found)
assert np.allclose(doubled.point, 2 * found.point) and doubled.method == "conventional"
assert jax.tree.structure(doubled) == jax.tree.structure(found)
path, _ = jax.tree_util.tree_leaves_with_path(problem)[0]
assert jax.tree_util.keystr(path) == ".poses", path
assert type(jax.jit(lambda p: p)(problem)) is jaxcal.Problem
import optimistix  # and with it everything that the finder is for
assert not any(type(finder).__module__.startswith("jaxcal") for finder in sys.meta_path)
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("saved") / "recording.h5"
    jaxcal.save(experiment(5, images=20, elevation_mm=1.0, noise_mm=0.5), path)
    return path


def python(*arguments: str | Path) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, arguments)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def test_a_process_without_jax(saved):
    status, rms, warnings, condition = json.loads(python("-c", ALONE, saved))
    expected = jaxcal.calibrate(jaxcal.load(saved), METHOD)
    assert status == "converged"
    assert rms == pytest.approx(float(expected.rms), rel=1e-12)
    assert warnings == expected.warnings
    assert condition == pytest.approx(expected.observability["condition"], rel=1e-9)


COMMAND = """
import sys
from jaxcal.cli.main import main
code = main(["calibrate", sys.argv[1], "--method", "conventional", *sys.argv[2:]])
heavy = {"jax", "jaxlib", "equinox", "optimistix", "jaxtyping", "scipy.stats", "matplotlib"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
sys.exit(code)
"""


def test_the_command_without_jax(saved, capsys):
    assert main(["calibrate", str(saved), "--method", METHOD]) == 0
    assert "conventional fit certified" in " ".join(capsys.readouterr().out.split())
    record = json.loads(python("-c", COMMAND, saved, "--json"))
    assert record["certified"] is True
    assert record["next_poses"] is not None


def test_times_of_flight_in_a_process_that_has_not_imported_jax(tmp_path):
    """To segment them imports JAX in the middle of the call."""
    path = tmp_path / "raw.h5"
    recording = jaxcal.simulate_recording(jaxcal.Protocol(images=12, raw=True), seed=1)
    jaxcal.save(recording, path)
    program = (
        "import sys, jaxcal; raw = jaxcal.load(sys.argv[1]); assert 'jax' not in sys.modules; "
        "print(jaxcal.calibrate(raw, 'conventional').status)"
    )
    assert python("-c", program, path) == "converged\n"


# First something, then everything


@pytest.mark.skipif(sys.platform == "win32", reason="there are no pseudo-terminals here")
def test_a_person_sees_the_conventional_fit_before_anything_is_compiled(saved, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent / "hw")
    from terminal import Terminal

    monkeypatch.setenv("XDG_CACHE_HOME", str(saved.parent / "empty"))
    expected = jaxcal.calibrate(jaxcal.load(saved), METHOD)
    origin = ", ".join(f"{value:.2f}" for value in expected.image_to_probe[:3, 3])
    arguments = [
        "-m",
        "jaxcal",
        "calibrate",
        str(saved),
        "--method",
        "alternating",
        "--require",
        "uncertain",
    ]
    with Terminal(arguments, saved.parent) as terminal:
        found = terminal.wait_for(rf"Conventional fit, certified:.*{re.escape(origin)}")
        assert f"RMS {float(expected.rms):.3f} mm" in terminal.wait_for(r"RMS \S+ mm")[0]
        terminal.wait_for(r"compiling, once", flags=re.DOTALL)
        assert "status" not in terminal.shown[: found.end()]
        assert terminal.finish() == 0
        # The compiler's own alarms do not reach the terminal, and the answer comes at the end.
        assert "slow_operation_alarm" not in terminal.shown
        assert "converged after" in terminal.shown


def test_json_is_one_object_and_nothing_else(saved, capfd, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(saved.parent / "empty"))  # of the test before
    asked = ["--method", "alternating", "--require", "uncertain", "--json"]
    assert main(["calibrate", str(saved), *asked]) == 0
    said, error = capfd.readouterr()
    assert error == ""
    assert json.loads(said)["status"] == "converged"
    assert "Conventional" not in said
