"""Studies on real Dask workers on loopback, one of which dies; no test here mocks a cluster."""

import contextlib
import gc
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import distributed
import pytest

from jaxcal import InputError, __version__
from jaxcal.cli.main import main
from jaxcal.study import run_study
from jaxcal.study.spec import parse_spec
from jaxcal.study.store import Store
from jaxcal.study.workers import core_groups

SPEC = """
name = "cluster"
seed = 3
trials = 640
chunk_trials = 8
[conditions]
images = 6
test_images = 4
elevation_mm = 1
[probe]
elements = 8
pitch_mm = 7.0
[[methods]]
name = "flat"
method = "conventional"
"""
ADDRESS = r"tcp://127\.0\.0\.1:\d+"


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """The study computed in one process."""
    folder = tmp_path_factory.mktemp("cluster") / "here"
    spec = folder.parent / "spec.toml"
    spec.write_text(SPEC)
    run = [sys.executable, "-m", "jaxcal.cli.main", "study", "run", spec, "--out", folder]
    subprocess.run(run, env=environment(), check=True, capture_output=True)
    return folder


def environment() -> dict[str, str]:
    """Of the tests' compiler flags only the one under which no bits depend on the cores."""
    return os.environ | {"XLA_FLAGS": "--xla_backend_optimization_level=0"}


@pytest.fixture
def started():
    """Start processes; those that are still there in the end are killed."""
    children = []

    def start(*arguments):
        child = subprocess.Popen(
            [sys.executable, *map(str, arguments)], stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True, env=environment(),
        )  # fmt: skip
        children.append(child)
        return child

    yield start
    for child in children:
        child.kill()
        child.communicate()


def wait_for(condition, seconds=180):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def same_files(one, two):
    first, second = ({p.name: p.read_bytes() for p in (f / "chunks").iterdir()} for f in (one, two))
    return first == second


def said(child, pattern):
    """What matches in the log of a process of Dask's, once it is there."""
    while True:
        line = child.stderr.readline()
        assert line, "the process is gone"
        if found := re.search(pattern, line):
            # Else the pipe fills up, and the process waits.
            threading.Thread(target=child.stderr.read, daemon=True).start()
            return found[1]


@pytest.fixture
def scheduler(started):
    """A process and its address."""
    child = started(
        "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
        "--no-dashboard",
    )  # fmt: skip
    return child, said(child, rf"Scheduler at:\s+({ADDRESS})")


AS_WORKER = ("--nthreads", "1", "--no-nanny", "--host", "127.0.0.1", "--no-dashboard")


@pytest.fixture
def other_worker(started, tmp_path):
    """Start a worker that can import what is installed here, and only that jaxcal, if any."""

    def start(address, version=None):
        folder = tmp_path / f"packages of {version}"
        folder.mkdir()
        for package in Path(distributed.__file__).parents[1].iterdir():
            if "jaxcal" not in package.name:
                (folder / package.name).symlink_to(package)
        if version is not None:
            (folder / "jaxcal.py").write_text(f"__version__ = {version!r}")
        code = f"import sys; sys.path.append({str(folder)!r}); "
        code += "from distributed.cli.dask_worker import main; main()"
        child = started("-I", "-S", "-c", code, address, *AS_WORKER)
        return said(child, rf"Start worker at:\s+({ADDRESS})")

    return start


def test_workers_that_cannot_compute(scheduler, other_worker, tmp_path, capfd):
    """Without jaxcal a worker cannot read what is sent to it: Dask would never answer."""
    address = scheduler[1]
    without, older = other_worker(address), other_worker(address, "0.0.9")
    spec, folder = tmp_path / "spec.toml", tmp_path / "out"
    spec.write_text(SPEC)
    with distributed.Client(address, set_as_default=False) as client:
        client.wait_for_workers(2)
    run = ["study", "run", str(spec), "--out", str(folder), "--dask", address]
    assert main(run) == 2
    line = capfd.readouterr().err
    assert line.count("\n") == 1
    assert "no worker of the cluster can compute this study: " in line
    assert f"{without} (No module named 'jaxcal')" in line
    assert f"{older} (jaxcal 0.0.9, this is {__version__})" in line
    assert "0 of 80 chunks are done; continue with: jaxcal study run" in line


@pytest.mark.slow
def test_the_other_workers_compute_and_a_killed_scheduler_is_told_of(
    here, scheduler, other_worker, started, tmp_path
):
    process, address = scheduler
    without = other_worker(address)
    started("-m", "distributed.cli.dask_worker", address, *AS_WORKER)
    with distributed.Client(address, set_as_default=False) as client:
        client.wait_for_workers(2)
    spec, folder = tmp_path / "spec.toml", tmp_path / "out"
    spec.write_text(SPEC)
    store = Store(folder, parse_spec(SPEC))
    run = ["-m", "jaxcal.cli.main", "study", "run", spec, "--out", folder]
    study = started(*run, "--dask", address)
    wait_for(lambda: len(store.present()) >= 5 or study.poll() is not None)
    process.kill()
    out, err = study.communicate(timeout=20)
    done = len(store.present())
    assert 5 <= done < 80
    assert (study.returncode, out) == (2, "")
    again = f"jaxcal study run {spec} --out {folder} --dask {address} --resume"
    assert err.splitlines() == [
        f"jaxcal: note: workers left out: {without} (No module named 'jaxcal')",
        "jaxcal: error: the cluster was lost: its scheduler no longer answers; "
        f"{done} of 80 chunks are done; continue with: {again}",
    ]
    finish = started(*run, "--resume")
    assert finish.communicate()[0].startswith(f"{folder}: 80 chunks are done, {80 - done} of them")
    assert same_files(folder, here)


@pytest.mark.slow
def test_a_scheduler_and_two_workers_of_which_one_is_killed(
    here, scheduler, started, tmp_path, capfd
):
    address = scheduler[1]
    workers = [started("-m", "distributed.cli.dask_worker", address, *AS_WORKER) for _ in range(2)]
    spec, folder = tmp_path / "spec.toml", tmp_path / "out"
    spec.write_text(SPEC)
    store, left = Store(folder, parse_spec(SPEC)), []

    def kill_one():
        wait_for(lambda: len(store.present()) >= 5)
        workers[0].send_signal(signal.SIGKILL)
        workers[0].wait()
        left.append(store.spec.chunk_count - len(store.present()))

    killer = threading.Thread(target=kill_one)
    killer.start()
    code = main(["study", "run", str(spec), "--out", str(folder), "--dask", address])
    killer.join()
    out, err = capfd.readouterr()
    assert code == 0, err
    assert left[0] > 0, "the study was over before the worker died"
    assert "80 chunks are done, 80 of them now" in out
    assert workers[1].poll() is None
    assert same_files(folder, here)


@pytest.mark.slow
def test_local_workers_of_which_one_is_killed(here, started, tmp_path):
    spec, folder = tmp_path / "spec.toml", tmp_path / "out"
    spec.write_text(SPEC)
    store = Store(folder, parse_spec(SPEC))
    study = started("-m", "jaxcal.cli.main", "study", "run", spec, "--out", folder,
                    "--workers", 2)  # fmt: skip
    wait_for(lambda: len(store.present()) >= 5 or study.poll() is not None)
    assert study.poll() is None, study.communicate()
    processes = workers_of(study.pid)
    assert len(processes) == 2
    if len(os.sched_getaffinity(0)) >= 2:
        cores = [os.sched_getaffinity(pid) for pid in processes]
        assert not cores[0] & cores[1], "each worker has cores of its own"
    os.kill(processes[0], signal.SIGKILL)
    out, err = study.communicate(timeout=300)
    assert study.returncode == 0, err
    assert "80 chunks are done, 80 of them now" in out
    assert same_files(folder, here)


def workers_of(parent):
    """Processes below ``parent`` that have loaded JAX's library: the ones that compute."""
    found = []
    for name in os.listdir("/proc"):
        if not name.isdigit() or int(name) == parent:
            continue
        try:
            with open(f"/proc/{name}/stat") as stream:
                above = int(stream.read().rsplit(")", 1)[1].split()[1])
            with open(f"/proc/{name}/maps") as stream:
                computes = "libjax" in stream.read()
        except OSError:
            continue
        if above == parent and computes:
            found.append(int(name))
    return found


def listening(pid):
    """Addresses at which a process and its children listen, as /proc tells them."""
    sockets = {}
    for table in ("tcp", "tcp6"):
        with open(f"/proc/net/{table}") as stream:
            for fields in (line.split() for line in stream.readlines()[1:]):
                if fields[3] == "0A":
                    sockets[f"socket:[{fields[9]}]"] = fields[1]
    found, family = [], {pid}
    for name in sorted((n for n in os.listdir("/proc") if n.isdigit()), key=int):
        try:
            with open(f"/proc/{name}/stat") as stream:
                above = int(stream.read().rsplit(")", 1)[1].split()[1])
            if int(name) != pid and above not in family:
                continue
            family.add(int(name))
            for descriptor in os.listdir(f"/proc/{name}/fd"):
                link = os.readlink(f"/proc/{name}/fd/{descriptor}")
                found += [sockets[link]] if link in sockets else []
        except OSError:
            continue
    return found


@pytest.mark.skipif(not os.path.exists("/proc/net/tcp"), reason="needs Linux's /proc")
def test_local_workers_open_no_port_and_run_no_file_of_the_current_folder(tmp_path):
    """On a shared machine any user could connect to a port, and run programs as this one."""
    spec, mark = tmp_path / "spec.toml", tmp_path / "ran"
    spec.write_text(SPEC)
    for name in ("queue", "pickle", "socket", "numpy", "jax", "jaxcal/__init__"):
        path = tmp_path / "data" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"open({str(mark)!r}, 'a').write(__name__ + ' ')\nraise SystemExit(9)\n")
    study = subprocess.Popen(
        [sys.executable, "-P", "-m", "jaxcal.cli.main", "study", "run", spec,
         "--out", tmp_path / "out", "--workers", "1"],
        cwd=tmp_path / "data", stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        ports = []
        while not workers_of(study.pid):
            assert study.poll() is None, study.communicate()
            assert not mark.exists(), mark.read_text()
            ports += listening(study.pid)
            time.sleep(0.05)
        assert ports + listening(study.pid) == []
        assert not mark.exists(), mark.read_text()
    finally:
        study.send_signal(signal.SIGINT)
        study.communicate()


@pytest.fixture
def junk():
    """The address of a server that answers, but is no scheduler."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            with contextlib.suppress(OSError):
                while True:
                    with server.accept()[0] as caller:
                        caller.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n" * 9)

        threading.Thread(target=answer, daemon=True).start()
        yield f"127.0.0.1:{server.getsockname()[1]}"


def test_no_scheduler(tmp_path, capfd, monkeypatch, junk):
    """Said in one line, and nothing is made, so that the right command may follow."""
    monkeypatch.setattr("jaxcal.study.cluster.CONNECT_SECONDS", 0.3)
    spec = tmp_path / "spec.toml"
    spec.write_text(SPEC)
    unreachable = "tcp://127.0.0.1:9", "nonsense://x", junk
    no_address = "foo", "tcp://foo", "tcp://foo:", "foo:bar", ""
    for address in (*unreachable, *no_address):
        run = ["study", "run", str(spec), "--out", str(tmp_path / "out")]
        assert main([*run, "--dask", address]) == 2
        gc.collect()
        line = capfd.readouterr().err
        said = "no Dask scheduler answers" if address in unreachable else "HOST:PORT is needed"
        assert said in line
        assert line.count("\n") == 1
        assert not (tmp_path / "out").exists()


def test_cores_are_shared_out():
    cores = os.sched_getaffinity(0)
    for workers in range(1, len(cores) + 1):
        groups = core_groups(workers)
        assert set().union(*groups) == cores
        assert sum(map(len, groups)) == len(cores)
        assert max(map(len, groups)) - min(map(len, groups)) <= 1
    groups = core_groups(len(cores) + 3)
    assert all(len(group) == 1 for group in groups)
    with pytest.raises(InputError):
        run_study(parse_spec(SPEC), "nowhere", workers=-1)
