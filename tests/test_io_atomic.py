"""Files are complete or absent, whatever happens while they are written."""

import fcntl
import os
import resource
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import jaxcal.io.atomic
from jaxcal import OutputError
from jaxcal.io.atomic import atomic_path, replace_files, write_text

ROOT = Path(__file__).parents[1]


def run_python(code, *arguments):
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


@pytest.mark.parametrize("text", ["", "one\ntwo\r\nµ°\n", "x" * 100_000])
def test_write_text_writes_exactly_the_text(tmp_path, text):
    target = tmp_path / "report.txt"
    write_text(target, text)
    assert target.read_bytes() == text.encode()
    assert os.listdir(tmp_path) == ["report.txt"]


def test_write_text_takes_undecodable_file_names(tmp_path):
    write_text(tmp_path / "a", os.fsdecode(b"\xff.h5"))
    assert (tmp_path / "a").read_text() == r"\udcff.h5"


def test_replaces_an_old_file_and_accepts_a_bare_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_text("name", "old")
    write_text("name", "new")
    assert Path("name").read_text() == "new"


def test_temporary_is_beside_the_target_with_its_suffix(tmp_path):
    with atomic_path(tmp_path / "figure.svg") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".svg"
        assert not (tmp_path / "figure.svg").exists()
    assert os.listdir(tmp_path) == ["figure.svg"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("old", [None, "old"])
def test_exception_leaves_the_target_as_it_was(tmp_path, error, old):
    target = tmp_path / "out"
    if old is not None:
        target.write_text(old)

    def interrupted():
        with atomic_path(target) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        interrupted()
    assert os.listdir(tmp_path) == ([] if old is None else ["out"])
    assert old is None or target.read_text() == old


def test_oserror_in_the_block_is_an_output_error(tmp_path):
    target = tmp_path / "out"
    with pytest.raises(OutputError, match="No space left on device"), atomic_path(target):
        Path("/dev/full").write_text("x" * 100_000)
    assert os.listdir(tmp_path) == []


def test_output_error_of_the_block_passes_unchanged(tmp_path):
    with pytest.raises(OutputError, match=r"^inner$"), atomic_path(tmp_path / "out"):
        raise OutputError("inner")


def test_too_long_a_file_is_an_output_error(tmp_path):
    target = tmp_path / "out"
    target.write_text("old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OutputError, match="out: cannot be written: File too large"):
            write_text(target, "x" * 100_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["out"]


def test_missing_folder(tmp_path):
    with pytest.raises(OutputError, match="none/out: cannot be written: its folder does not"):
        write_text(tmp_path / "none" / "out", "x")


def test_folder_that_is_a_file(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="Not a directory"):
        write_text(tmp_path / "file" / "out", "x")


def test_target_that_is_a_directory(tmp_path):
    with pytest.raises(OutputError, match="it is a directory"):
        write_text(tmp_path, "x")


@pytest.mark.parametrize("name", ["x" * 256, "zero\0byte"])
def test_impossible_name(tmp_path, name):
    with pytest.raises(OutputError, match="cannot be written"):
        write_text(tmp_path / name, "x")


def test_devices_and_pipes_are_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for target in (Path("/dev/null"), tmp_path / "pipe"):
        with pytest.raises(OutputError, match="not a regular file"):
            write_text(target, "x")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)
    assert stat.S_ISFIFO(os.stat(tmp_path / "pipe").st_mode)


@pytest.mark.parametrize(
    ("existing", "reason"), [(False, "Permission denied"), (True, "it is write-protected")]
)
def test_no_permission(existing, reason):
    # Not tmp_path: its parents are closed to the ordinary user that a superuser becomes here.
    folder = Path(tempfile.mkdtemp())
    target = folder / "out"
    if existing:
        target.write_text("old")
        target.chmod(0o444)
    folder.chmod(0o777 if existing else 0o555)
    superuser = os.geteuid() == 0
    if superuser:
        os.seteuid(65534)
    try:
        with pytest.raises(OutputError, match=f"out: cannot be written: {reason}"):
            write_text(target, "x")
    finally:
        if superuser:
            os.seteuid(0)
        left = os.listdir(folder)
        folder.chmod(0o755)
        shutil.rmtree(folder)
    assert left == (["out"] if existing else [])


@pytest.mark.parametrize("mask", [0o022, 0o027, 0o077])
def test_new_file_gets_the_umask(tmp_path, mask):
    before = os.umask(mask)
    try:
        write_text(tmp_path / "out", "x")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == 0o666 & ~mask


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o666, 0o755])
def test_existing_file_keeps_its_permissions_all_along(tmp_path, mode):
    target = tmp_path / "out"
    target.write_text("old")
    target.chmod(mode)
    with atomic_path(target) as temporary:
        assert stat.S_IMODE(temporary.stat().st_mode) & ~mode == 0
        temporary.write_text("new")
    assert target.read_text() == "new"
    assert stat.S_IMODE(target.stat().st_mode) == mode


def test_symbolic_link_stays_and_its_file_is_replaced(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "real").write_text("old")
    (tmp_path / "link").symlink_to("data/real")
    write_text(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "data" / "real").read_text() == "new"


@pytest.mark.parametrize("old", [None, "old"])
def test_killed_writer_leaves_the_target_as_it_was(tmp_path, old):
    target = tmp_path / "out"
    if old is not None:
        target.write_text(old)
    code = (
        "import sys, time\n"
        "from jaxcal.io.atomic import atomic_path\n"
        "with atomic_path(sys.argv[1]) as temporary:\n"
        "    temporary.write_text('half')\n"
        "    print('writing', flush=True)\n"
        "    time.sleep(60)\n"
    )
    with run_python(code, target) as process:
        assert process.stdout.readline() == "writing\n"
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert target.exists() == (old is not None)
    assert old is None or target.read_text() == old
    write_text(target, "new")
    assert target.read_text() == "new"


def test_a_set_of_files_is_never_a_mix(tmp_path):
    """Killed at every step of the change, and then done: the first file says that all are new."""
    code = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from jaxcal.io.atomic import replace_files\n"
        "names = ['whole', 'a', 'b', 'stale']\n"
        "old, new = ({k: v for k in names} for v in (b'old', b'new'))\n"
        "del new['stale']\n"
        "steps, last = 0, None\n"
        "def hook(event, _):\n"
        "    global steps\n"
        "    if last is not None and event in ('os.remove', 'os.rename', 'os.mkdir', 'os.rmdir'):\n"
        "        if steps == last:\n"
        "            os.kill(os.getpid(), signal.SIGKILL)\n"
        "        steps += 1\n"
        "sys.addaudithook(hook)\n"
        "killed = 0\n"
        "for k in range(100):\n"
        "    folder = Path(sys.argv[1]) / str(k)\n"
        "    folder.mkdir()\n"
        "    (folder / 'mine').write_bytes(b'mine')\n"
        "    replace_files(folder, old, names)\n"
        "    child = os.fork()\n"
        "    if child == 0:\n"
        "        last = k\n"
        "        replace_files(folder, new, names)\n"
        "        os._exit(0)\n"
        "    done = os.waitpid(child, 0)[1]\n"
        "    left = {f.name: f.read_bytes() for f in folder.iterdir() if f.is_file()}\n"
        "    assert left.pop('mine') == b'mine'\n"
        "    assert len(set(left.values())) <= 1, left\n"
        "    assert 'whole' not in left or left in (old, new), left\n"
        "    replace_files(folder, new, names)\n"
        "    assert {f.name for f in folder.iterdir()} == {*new, 'mine'}\n"
        "    if done == 0:\n"
        "        break\n"
        "print(k)\n"
    )
    with run_python(code, tmp_path) as process:
        said, _ = process.communicate()
    assert process.returncode == 0
    assert int(said) > 5


def test_two_processes_do_not_mix_their_sets(tmp_path):
    """Both at once, again and again: the folder holds one's files or the other's."""
    code = (
        "import multiprocessing, os, sys\n"
        "from pathlib import Path\n"
        "from jaxcal.io.atomic import replace_files\n"
        "folder, names = Path(sys.argv[1]), ['whole', *'abcdef']\n"
        "barrier = multiprocessing.get_context('fork').Barrier(2, timeout=20)\n"
        "me = b'one' if os.fork() else b'two'\n"
        "for k in range(20):\n"
        "    barrier.wait()\n"
        "    replace_files(folder, {name: me for name in names}, [])\n"
        "    barrier.wait()\n"
        "    left = {f.name: f.read_bytes() for f in folder.iterdir()}\n"
        "    assert set(left) == set(names) and len(set(left.values())) == 1, left\n"
        "assert me == b'two' or os.wait()[1] == 0\n"
    )
    with run_python(code, tmp_path) as process:
        process.communicate()
    assert process.returncode == 0


def test_a_set_that_another_program_is_writing(tmp_path, monkeypatch):
    monkeypatch.setattr(jaxcal.io.atomic, "PATIENCE_S", 0)
    replace_files(tmp_path, {"a": b"old"}, [])
    held = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    with pytest.raises(OutputError, match="is being written by another program: try again"):
        replace_files(tmp_path, {"a": b"new"}, [])
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]
    os.close(held)
    replace_files(tmp_path, {"a": b"new"}, [])


def test_a_set_that_cannot_be_written_is_as_it_was(tmp_path):
    replace_files(tmp_path, {"a": b"old", "b": b"old"}, [])
    with pytest.raises(OutputError, match="cannot be written"):
        replace_files(tmp_path, {"a": b"new", "no/b": b"new"}, ["b"])
    (tmp_path / "c").mkdir()
    with pytest.raises(OutputError, match="is a directory"):
        replace_files(tmp_path, {"a": b"new"}, ["b", "c"])
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b", "c"}
    assert (tmp_path / "a").read_bytes() == b"old"
