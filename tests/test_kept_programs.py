"""Kept programs as users meet them: a batch in a second process, and ``jaxcal cache``."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from jaxcal.cli.main import main
from jaxcal.runtime import executables, program_cache

BATCH = """
import json, logging
import numpy as np
import jaxcal

said = []
class Heard(logging.Handler):
    def emit(self, record):
        said.append(record.getMessage())
log = logging.getLogger("jaxcal.runtime.executables")
log.setLevel(logging.INFO)
log.addHandler(Heard())

def problem(seed):
    draws = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(np.eye(3) + 0.3 * draws.normal(size=(8, 3, 3)))[0]
    poses[:, :3, :3] *= np.sign(np.linalg.det(poses[:, :3, :3]))[:, None, None]
    target = draws.uniform([-25, -1, 20], [25, 1, 80], (8, 3))
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], target)
    return jaxcal.Problem.from_arrays(poses, target[:, [0, 2]])

found = jaxcal.calibrate_batch([problem(1), problem(2)], method="conventional")
print(json.dumps([said, [str(s) for s in found.status], np.asarray(found.image_to_probe).tolist()]))
"""


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """A cache of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("JAXCAL_NO_CACHE", raising=False)
    executables.forget()
    yield tmp_path
    executables.forget()


def test_a_second_process_does_not_compile_a_batch():
    def run():
        # Programs of other devices are not kept.
        environment = os.environ | {"JAX_PLATFORMS": "cpu"}
        command = [sys.executable, "-c", BATCH]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    said, statuses, transforms = run()
    assert len(said) == 1
    assert "compiling" in said[0]
    assert statuses == ["converged"] * 2
    (entry,) = program_cache.entries()
    assert entry.header["label"]["method"] == "conventional"
    assert entry.header["label"]["problems"] >= 2
    assert run() == [[], statuses, transforms]
    assert [each.path for each in program_cache.entries()] == [entry.path]


def test_the_cache_is_warmed_shown_and_cleared(capsys, monkeypatch):
    def command(*words: str) -> str:
        assert main(["cache", *words]) == 0
        return capsys.readouterr().out

    warmed = command("warm", "--images", "5", "--images", "8", "--method", "alternating")
    # Both numbers are solved at one size, and so by one program.
    assert warmed.splitlines()[0].startswith("alternating, up to 64 images: ")
    assert len(warmed.splitlines()) == 1
    shown = json.loads(command("show", "--json"))
    (row,) = shown["programs"]
    assert (row["method"], row["images"], row["refused"]) == ("alternating", 64, False)
    assert row["compile_s"] > 0
    assert row["bytes"] == shown["bytes"] > 1000
    page = command("show")
    assert "alternating" in page
    assert "1 program," in page

    program_cache.entries()[0].path.chmod(0o644)
    assert json.loads(command("show", "--json"))["programs"][0]["refused"]
    assert "refused" in command("show")
    assert command("clear") == "1 program removed\n"
    assert json.loads(command("show", "--json"))["programs"] == []

    monkeypatch.setenv("JAXCAL_NO_CACHE", "1")
    assert "It is off" in command("show")
    assert main(["cache", "warm"]) == 2
    assert "the cache is off" in capsys.readouterr().err


def test_a_cache_that_cannot_be_used_is_one_line(monkeypatch, capsys):
    program_cache.private_folder().chmod(0o777)
    for words in (["show"], ["warm"], ["clear"]):
        assert main(["cache", *words]) == 2
        said = capsys.readouterr().err
        assert said.startswith("jaxcal: error: the cache cannot be ")
        assert "is not private to this user" in said
        assert said.count("\n") == 1


def test_the_command_line_starts_the_processor_only():
    """A GPU would compile one calibration for longer than it takes, and lose its memory to it."""
    script = (
        "from jaxcal.cli.common import prepare_jax; prepare_jax(); import sys; "
        "assert 'jax' not in sys.modules; import jax; print(jax.config.jax_platforms)"
    )
    plain = {name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"}
    for environment, expected in ((plain, "cpu"), (plain | {"JAX_PLATFORMS": "tpu"}, "tpu")):
        command = [sys.executable, "-c", script]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
        assert done.stdout.strip() == expected, done.stderr
