"""Compiled programs are kept: loaded without tracing where they can be trusted, else made anew.

The functions are tiny; what is tested is files, processes and damage.
"""

from __future__ import annotations

import gc
import hashlib
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import problem

import jaxcal
from jaxcal.runtime import executables, program_cache

X = np.arange(6.0).reshape(2, 3)
FACTOR = 3.0
FLAGS = {"xla_backend_optimization_level": 0, "xla_no_such_flag": True}

traced = []
"""A line for every time that a function below is called, which is when it is traced."""

CHILD = """
import json, os, resource, sys, time
import numpy as np
from jaxcal.runtime import executables
from jaxcal.runtime import jax_modes
traced = []
def function(x, more, plan):
    traced.append(1)
    return plan[0] * x + more[0], (x > 0, None), plan[1]
if "full" in sys.argv:
    sys.dont_write_bytecode = True  # it would be truncated, and stay
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
if "wait" in sys.argv:
    while not os.path.exists(sys.argv[-1]):
        time.sleep(0.005)
import jax
settings = dict(jax.config.values), dict(os.environ)
with jax_modes.own_modes():
    found = executables.run(
        function, (np.arange(3.0), (np.ones(3),)), (2.0, "a"), flags={}, label={"program": "child"}
    )
assert settings == (dict(jax.config.values), dict(os.environ))
assert found[1][1] is None and found[2] == "a", found
print(json.dumps([found[0].tolist(), found[1][0].tolist(), len(traced)]))
"""
ANSWER = [[1.0, 3.0, 5.0], [False, True, True]]


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """A cache of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("JAXCAL_NO_CACHE", raising=False)
    # Of JAX's own cache, which the tests share, JAX says itself where it cannot be written.
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    executables.forget()
    traced.clear()
    yield tmp_path
    executables.forget()


def scaled(x, plan):
    traced.append(plan)
    order = jnp.argsort(-x, axis=1)
    return plan * jnp.take_along_axis(x, order, axis=1), None


def run(plan: float = FACTOR, function=scaled, argument=X):
    """As a later process would: nothing is held in memory."""
    executables.forget()
    return executables.run(function, (argument,), plan, flags=FLAGS, label={"program": "scaled"})


def check(found, plan: float = FACTOR):
    np.testing.assert_array_equal(found[0], plan * X[:, ::-1])
    assert found[1] is None


def files() -> list[Path]:
    return sorted(program_cache.private_folder().iterdir())


def child(*words, **options):
    command = [sys.executable, "-c", CHILD, *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, **options)


def answer_of(process) -> int:
    """How often the function was traced; the result is right."""
    found = json.loads(process.communicate(timeout=600)[0])
    assert process.returncode == 0
    assert found[:2] == ANSWER
    return found[2]


# -- hits and misses


def test_two_processes_warm_at_once_and_a_third_loads_without_tracing(tmp_path):
    """None changes a setting."""
    start = tmp_path / "start"
    both = [child("wait", start) for _ in range(2)]
    start.touch()
    assert all(answer_of(process) <= 1 for process in both)
    (kept,) = files()
    before = kept.stat().st_mtime_ns
    os.utime(kept, ns=(0, 0))
    assert answer_of(child()) == 0
    assert files() == [kept]
    assert kept.stat().st_mtime_ns >= before  # it was used just now


def test_the_same_process_keeps_programs_in_memory():
    for _ in range(2):
        check(executables.run(scaled, (X,), FACTOR, flags=FLAGS, label={}))
    shutil.rmtree(program_cache.private_folder())
    check(executables.run(scaled, (X,), FACTOR, flags=FLAGS, label={}))
    assert traced == [FACTOR]


def test_memory_holds_a_bounded_number(monkeypatch):
    monkeypatch.setattr(executables, "LOADED", 2)
    for plan in (1.0, 2.0, 3.0, 2.0, 1.0):
        executables.run(scaled, (X,), plan, flags=FLAGS, label={})
        monkeypatch.setenv("JAXCAL_NO_CACHE", "1")  # memory alone from here on
    assert traced == [1.0, 2.0, 3.0, 1.0]


def test_threads_wait_for_the_one_that_compiles():
    found = []

    def work():
        found.append(executables.run(scaled, (X,), FACTOR, flags=FLAGS, label={}))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4
    for one in found:
        check(one)
    assert traced == [FACTOR]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this platform does not fork")
# Python 3.12 and newer warns where an earlier test has left threads.
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_forked_process_is_told_to_be_spawned():
    """It waited without end for JAX's threads, which are in its parent alone."""
    check(executables.run(scaled, (X,), FACTOR, flags=FLAGS, label={}))
    there, poses = problem(1), np.tile(np.eye(4), (9, 1, 1))
    read, write = os.pipe()
    child = os.fork()
    if not child:
        signal.alarm(60)
        try:
            for call in (
                lambda: executables.run(scaled, (X,), FACTOR, flags=FLAGS, label={}),
                # These compute before they run a program.
                lambda: jaxcal.calibrate_pivot(poses),
                lambda: jaxcal.bootstrap(there),
                lambda: jaxcal.cross_validate(there),
                # JAX would compile it.
                lambda: jax.jit(jaxcal.calibrate)(there),
            ):
                with pytest.raises(jaxcal.CalibrationError, match=r"get_context\('spawn'\)"):
                    call()
                os.write(write, b"told ")
        finally:
            os._exit(0)
    os.close(write)
    with open(read) as told:
        assert told.read() == 5 * "told "
    assert os.waitpid(child, 0)[1] == 0


def interrupted_in_a_collection(x, plan):
    def ctrl_c(phase, info):
        gc.callbacks.remove(ctrl_c)
        signal.raise_signal(signal.SIGINT)

    gc.callbacks.append(ctrl_c)
    gc.collect()
    time.sleep(5)
    return x


def test_ctrl_c_in_a_garbage_collection_is_not_lost():
    """JAX has a callback of the collection, out of which Python raises nothing."""
    before = sys.unraisablehook
    with pytest.raises(KeyboardInterrupt):
        executables.run(interrupted_in_a_collection, (X,), None, flags=FLAGS, label={})
    assert sys.unraisablehook is before


FORKING = """
import os, signal, warnings
import jax, numpy as np
warnings.simplefilter("ignore")  # JAX's, of the forks
def twice(x, plan):
    return 2.0 * x
def in_a_child():
    if not os.fork():
        signal.alarm(30)
        import jaxcal
        from jaxcal.runtime import executables
        try:
            found = executables.run(twice, (np.ones(1),), None, flags={}, label={})[0]
        except jaxcal.CalibrationError:
            found = "told"
        print(found, flush=True)
        os._exit(0)
    os.wait()
in_a_child()
jax.devices()
in_a_child()
import jaxcal
in_a_child()
"""
"""JAX is only imported; it has started; jaxcal is imported before the fork, too."""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a fork that came first")
def test_a_process_forked_from_one_that_used_jax_without_jaxcal_is_told_too():
    found = subprocess.run([sys.executable, "-c", FORKING], capture_output=True, text=True)
    assert found.stdout.split() == ["2.0", "told", "told"], found.stderr


def other_function(x, plan):
    traced.append(plan)
    return x - plan, None


@pytest.mark.parametrize(
    "other",
    [
        {"plan": 4.0},
        {"argument": np.ones((3, 2))},
        {"argument": np.ones((2, 3), np.float32)},
        {"function": other_function},
    ],
    ids=["plan", "shape", "dtype", "function"],
)
def test_what_makes_another_program(other):
    run()
    run(**other)
    assert len(traced) == len(files()) == 2
    run()
    assert len(traced) == 2


def test_numbers_of_numpy_in_a_plan_are_told_apart():
    """Each value makes a program of its own; the same value of Python's shares it."""
    for plan in (np.float64(2.0), np.float64(3.0), np.float32(4.0), 2.0):
        check(run(plan), float(plan))
    assert len(files()) == 3
    for plan in (np.ones(1), jnp.ones(())):
        assert not executables.is_describable(plan)
        with pytest.raises(executables.NotDescribableError):
            run(plan)


def test_probes_and_options_hold_numbers_of_python():
    probe = jaxcal.LinearProbe(pitch_mm=np.float64(0.4))
    options = jaxcal.Options(tolerance_mm=np.float64(0.5))
    assert type(probe.pitch_mm) is type(options.tolerance_mm) is float


def test_another_installation_has_other_programs(monkeypatch):
    run()
    monkeypatch.setattr(executables, "installation", lambda: "another jaxlib")
    check(run())
    assert len(traced) == len(files()) == 2


def test_a_change_of_the_sources_makes_another_installation(tmp_path, monkeypatch):
    home = tmp_path / "jaxcal"
    shutil.copytree(Path(executables.__file__).parents[1], home)
    monkeypatch.setattr(executables, "__file__", str(home / "runtime" / "executables.py"))
    before = executables._sources()
    (home / "cli" / "main.py").write_text("# no program comes from here")
    assert executables._sources() == before
    solver = home / "solvers" / "start.py"
    solver.write_text(solver.read_text() + "\nCHANGED = True\n")
    assert executables._sources() != before


def test_the_installation_is_found_in_milliseconds():
    executables.installation()  # modules imported, files in memory
    taken = []
    for _ in range(5):
        executables.installation.cache_clear()
        began = time.process_time()
        executables.installation()
        taken.append(time.process_time() - began)
    assert min(taken) < 0.05


@pytest.mark.skipif(not Path("/proc/cpuinfo").exists(), reason="no /proc/cpuinfo here")
def test_the_processor_is_known():
    """Its instructions, above all: a program with others would end the process."""
    known = executables._processor().splitlines()
    told = next(line for line in known if line.startswith(("flags", "Features")))
    assert told in map(str.strip, Path("/proc/cpuinfo").read_text().splitlines())
    assert len(told.split()) > 8


def test_results_are_the_compiled_function_bit_by_bit():
    x = np.random.default_rng(1).normal(size=(2, 3))
    expected = jax.jit(lambda x: scaled(x, FACTOR))(x)[0]
    for _ in range(2):
        np.testing.assert_array_equal(run(argument=x)[0], expected)


# -- what is not kept


def whitened(x, plan):
    traced.append(plan)
    return jnp.linalg.cholesky(x @ x.T + plan * jnp.eye(2))


def test_a_program_that_calls_lapack_is_not_kept():
    """A later process would jump to an address that it has not filled in."""
    for _ in range(2):
        np.testing.assert_allclose(
            run(function=whitened), np.linalg.cholesky(X @ X.T + FACTOR * np.eye(2)), rtol=1e-14
        )
    assert len(traced) == 2
    assert files() == []


def test_a_plan_with_a_function_is_refused():
    with pytest.raises(executables.NotDescribableError):
        run(plan=lambda x: x)
    assert not executables.is_describable((1, lambda x: x))
    assert executables.is_describable(((1, "a", 0.5, True, None),))


def test_classes_of_others_are_not_made_from_a_description():
    with pytest.raises(executables.NotDescribableError):
        executables.rebuild({"class": "subprocess:Popen", "fields": {"args": "true"}}, [])


def test_the_switch_turns_it_off(monkeypatch):
    monkeypatch.setenv("JAXCAL_NO_CACHE", "1")
    check(run())
    assert not (Path(os.environ["XDG_CACHE_HOME"]) / "jaxcal").exists()
    monkeypatch.delenv("JAXCAL_NO_CACHE")
    check(run())
    monkeypatch.setenv("JAXCAL_NO_CACHE", "1")
    check(run())
    assert len(traced) == 3


# -- damage, and others' files


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def of_another_plan(path: Path) -> None:
    """A whole entry under a name that is not its own."""
    run(plan=17.0)
    (other,) = [found for found in files() if found != path]
    path.write_bytes(other.read_bytes())
    other.unlink()


def forged(path: Path) -> None:
    """Garbage, with a digest that fits."""
    magic, key = program_cache.MAGIC, program_cache.entries()[0].header["key"]
    header = json.dumps({"key": key, "result": {"leaf": 0}}).encode()
    rest = program_cache._LENGTH.pack(len(header)) + header + b"not a program"
    path.write_bytes(magic + hashlib.sha256(rest).digest() + rest)


def headless(path: Path) -> None:
    path.write_bytes(program_cache.MAGIC + hashlib.sha256(b"").digest())


def writable_by_the_world(path: Path) -> None:
    path.chmod(0o606)


def readable_by_the_group(path: Path) -> None:
    path.chmod(0o640)


def foreign(path: Path) -> None:
    if os.geteuid():
        pytest.skip("only root can give a file away")
    os.chown(path, 12345, -1)


def linked(path: Path) -> None:
    other = path.with_name("other")
    path.rename(other)
    path.symlink_to(other)


def a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path, 0o600)


SPOILT = [
    truncated, emptied, flipped, of_another_plan, forged, headless, writable_by_the_world,
    readable_by_the_group, foreign, linked, a_pipe,
]  # fmt: skip


@pytest.mark.parametrize("spoil", SPOILT)
def test_an_entry_that_cannot_be_trusted_is_compiled_anew(spoil, caplog, capfd):
    check(run())
    (kept,) = files()
    good = kept.read_bytes()
    spoil(kept)
    traced.clear()
    with caplog.at_level(logging.DEBUG, "jaxcal"):
        check(run())
    assert traced == [FACTOR]
    said = [record for record in caplog.records if record.name == "jaxcal.runtime.program_cache"]
    assert [record.levelname for record in said] == ["DEBUG"]
    assert capfd.readouterr() == ("", "")
    # It was replaced by a good one.
    assert kept.lstat().st_mode & 0o777 == 0o600
    assert not kept.is_symlink()
    assert len(kept.read_bytes()) == pytest.approx(len(good), rel=0.05)
    check(run())
    assert traced == [FACTOR]


def open_to_the_world(folder: Path) -> None:
    folder.chmod(0o777)


def with_an_open_parent(folder: Path) -> None:
    folder.parent.chmod(0o770)


def a_link(folder: Path) -> None:
    elsewhere = folder.parent.parent / "elsewhere"
    folder.rename(elsewhere)
    folder.symlink_to(elsewhere)


def a_file(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.write_text("")


@pytest.mark.parametrize("spoil", [open_to_the_world, with_an_open_parent, a_link, a_file])
def test_a_folder_that_cannot_be_trusted_is_not_used(spoil, caplog):
    check(run())
    spoil(program_cache.private_folder())
    with caplog.at_level(logging.DEBUG, "jaxcal"):
        check(run())
        check(run())
    assert traced == [FACTOR] * 3
    said = [record for record in caplog.records if record.name == program_cache.__name__]
    assert {record.levelname for record in said} == {"DEBUG"}


@pytest.mark.parametrize("nowhere", ["/proc/nope", "/dev/null"])
def test_no_folder_costs_nothing_but_time(nowhere, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", nowhere)
    check(run())
    assert traced == [FACTOR]


def test_where_the_folder_lies(tmp_path, monkeypatch):
    folder = program_cache.private_folder()
    assert folder == tmp_path / "jaxcal" / "programs"
    assert folder.stat().st_mode & 0o777 == folder.parent.stat().st_mode & 0o777 == 0o700
    # The XDG specification: relative paths are to be ignored.
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    inside = "Library/Caches" if sys.platform == "darwin" else ".cache"
    assert program_cache.private_folder() == tmp_path / inside / "jaxcal" / "programs"


def test_programs_of_jaxs_own_cache_are_not_kept_as_ours(tmp_path):
    """An executable that JAX loaded from its cache cannot be serialised once more."""
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "xla"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    assert answer_of(child(env=environment)) == 1
    assert program_cache.clear() == 1
    assert answer_of(child(env=environment)) == 1
    assert answer_of(child(env=environment)) == 0
    # Nor ours there as JAX's: under a name of its own nothing would find it again.
    assert not list((tmp_path / "xla").glob("jit_kept_*"))


def test_a_program_that_loads_and_does_not_run_is_compiled_anew():
    """It is the program of larger arrays, under the key of these: sound, and of no use."""
    run(argument=np.zeros((4, 3)))
    (other,) = program_cache.entries()
    check(run())
    (own,) = [entry for entry in program_cache.entries() if entry.path != other.path]
    found = program_cache.read(other.header["key"])
    assert found is not None
    program_cache.write(own.header["key"], own.header, found[1])
    check(run())
    check(run())
    assert traced == [FACTOR] * 3


# -- disks and deaths


def test_a_full_disk_gives_an_answer_without_a_cache():
    program_cache.private_folder()
    assert answer_of(child("full")) == 1
    assert files() == []


WRITER = """
import os, resource, signal
from jaxcal.runtime import program_cache
# The system kills it at this size, without a word and in the middle of the file.
signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, 2**20))
program_cache.write("key", {}, os.urandom(2**21))
"""


def test_killed_while_writing():
    folder = program_cache.private_folder()
    # Bytecode that is written meanwhile would be cut off too, and stay.
    writer = subprocess.run([sys.executable, "-B", "-c", WRITER], check=False)
    assert writer.returncode == -signal.SIGXFSZ
    (left,) = folder.iterdir()
    assert left.name.startswith(".partial-")
    assert left.stat().st_size == 2**20
    assert program_cache.entries() == []
    assert program_cache.read("key") is None
    assert program_cache.write("key", {"label": 1}, b"program")
    assert program_cache.read("key") == ({"label": 1, "key": "key"}, b"program")
    assert left.exists()  # its writer could be alive
    os.utime(left, (0, 0))
    program_cache.write("key", {}, b"program")
    assert [path.name.startswith(".partial-") for path in folder.iterdir()] == [False]


def test_the_least_recently_used_give_way(monkeypatch):
    content = [os.urandom(1000) for _ in range(4)]
    for age, name in ((3, "a"), (2, "b"), (1, "c")):
        program_cache.write(name, {}, content[age])
        path = program_cache.private_folder() / program_cache._name(name)
        os.utime(path, (time.time() - 60 * age,) * 2)
    assert program_cache.read("a") is not None  # used just now
    monkeypatch.setattr(program_cache, "LIMIT_BYTES", 3500)
    program_cache.write("d", {}, content[0])
    kept = {name for name in "abcd" if program_cache.read(name) is not None}
    assert kept == {"a", "c", "d"}
    assert [entry.header["key"] for entry in program_cache.entries()] == ["d", "c", "a"]
    assert program_cache.clear() == 3
    assert program_cache.entries() == []
