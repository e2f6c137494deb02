"""A study of one's own runs through the engine: here, on workers, resumed; its class is found."""

from __future__ import annotations

import importlib
import json
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest

from jaxcal import CalibrationError, FormatError, InputError
from jaxcal.runtime import jax_cache
from jaxcal.runtime.isolated import python_command
from jaxcal.study import open_results, run_study
from jaxcal.study.interface import Study, study_from, where_defined
from jaxcal.study.run import Silence
from jaxcal.study.store import Store

MODULE = """
import dataclasses, hashlib, json
import numpy as np
from jaxcal import InputError
from jaxcal.study import ArraySpec, Chunk


@dataclasses.dataclass(frozen=True)
class Squares:
    seed: int = 3
    trials: int = 5
    condition_count: int = 3

    chunk_count = property(lambda self: self.condition_count)

    def canonical(self):
        return json.dumps(dataclasses.asdict(self), sort_keys=True)

    @property
    def sha256(self):
        return hashlib.sha256(self.canonical().encode()).hexdigest()

    @classmethod
    def from_canonical(cls, text):
        try:
            return cls(**json.loads(text))
        except TypeError:
            raise InputError("is not of this study") from None

    def chunk(self, index):
        return Chunk(index, index, 0, self.trials)

    def arrays(self, chunk):
        return {"square": ArraySpec("mm", (2, self.trials)), "count": ArraySpec("1", (), "i")}

    def compute(self, chunk):
        rng = np.random.default_rng([self.seed, chunk.index])
        return {"count": np.array(chunk.index), "square": rng.normal(size=(2, self.trials)) ** 2}
"""


@pytest.fixture(scope="module")
def squares(tmp_path_factory):
    """A class in a loose module, as a script has it."""
    folder = tmp_path_factory.mktemp("loose")
    (folder / "loose_squares.py").write_text(MODULE)
    sys.path.insert(0, str(folder))
    yield importlib.import_module("loose_squares").Squares
    sys.path.remove(str(folder))


def test_the_engine_takes_it_here_and_on_workers_and_resumes(squares, tmp_path):
    study = squares()
    assert isinstance(study, Study)
    run_study(study, tmp_path / "here")
    summary = run_study(study, tmp_path / "workers", workers=2)
    assert (summary.chunks, summary.computed, summary.trials) == (3, 3, 15)
    here, workers = (Store(tmp_path / name, study) for name in ("here", "workers"))
    for index in here.present():
        chunk = study.chunk(index)
        first, second = here.read(chunk), workers.read(chunk)
        assert list(first) == ["square", "count"]
        np.testing.assert_array_equal(first["square"], study.compute(chunk)["square"])
        np.testing.assert_array_equal(first["square"], second["square"])
        assert int(first["count"]) == index
    kind = type("Flag", (squares,), {"compute": lambda *g: squares.compute(*g) | {"count": True}})
    run_study(kind(), tmp_path / "flags")
    assert Store(tmp_path / "flags", kind()).read(kind().chunk(0))["count"] == 1
    here.path(study.chunk(1)).unlink()
    assert run_study(study, tmp_path / "here", resume=True).computed == 1
    with pytest.raises(InputError, match="differs in its description"):
        run_study(squares(seed=4), tmp_path / "here", resume=True)


def test_a_file_of_other_arrays_is_refused(squares, tmp_path):
    study = squares()
    run_study(study, tmp_path / "study")
    other = squares(trials=6)
    with pytest.raises(FormatError, match="another spec"):
        Store(tmp_path / "study", other).read(other.chunk(0))
    with pytest.raises(FormatError, match=r"is no Spec: .*, or a study of another class"):
        open_results(tmp_path / "study")


def test_the_class_of_a_script_is_refused_before_anything_starts(tmp_path, squares):
    """A worker's traceback followed the error, which told to do what had been done."""
    script = tmp_path / "script.py"
    script.write_text(
        "from loose_squares import Squares\nfrom jaxcal.study import run_study\n"
        "class Mine(Squares):\n    pass\nrun_study(Mine(), 'out', workers=2)\n"
    )
    folder = Path(where_defined(squares())["folder"])
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, env=os.environ | {"PYTHONPATH": f"{folder}"},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith(
        "workers cannot import Mine, which is defined in the script that runs: put it into a "
        "module of its own, and import it"
    )
    assert not (tmp_path / "out").exists()


def test_the_class_must_be_one_that_a_worker_can_import(squares):
    where = where_defined(squares())
    assert where["module"] == "loose_squares"
    assert study_from(where, squares().canonical()) == squares()

    class Inside(squares):
        pass

    with pytest.raises(InputError, match="define it at the top level of its module"):
        where_defined(Inside())
    with pytest.raises(InputError, match="cannot be imported"):
        study_from({"module": "no_such_module", "name": "Squares"}, "{}")
    with pytest.raises(InputError, match="not of this study"):
        study_from(where, '{"colour": 1}')


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"square": np.zeros((1, 5))}, r"square is float64 \(1, 5\) in what .* floats \(2, 5\)"),
        ({"square": np.full((2, 5), None)}, r"square is object \(2, 5\)"),
        ({"count": np.array(1.5)}, r"count is float64 \(\) in what .* integers \(\)"),
        ({"count": None}, "count is missing"),
    ],
)
def test_a_chunk_of_other_arrays_is_not_written(squares, tmp_path, change, said):
    """It could not be read, which would be found out when all is computed."""
    kind = type("Wrong", (squares,), {"compute": lambda *given: squares.compute(*given) | change})
    with pytest.raises(InputError, match=said):
        run_study(kind(), tmp_path / "study")
    assert not list((tmp_path / "study" / "chunks").iterdir())


def test_a_class_instead_of_a_study_is_refused(squares, tmp_path):
    with pytest.raises(InputError, match="run_study takes a study, not <class"):
        run_study(squares, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_study_that_could_not_be_resumed_is_not_begun(squares, tmp_path):
    kind = type("Forgetful", (squares,), {"from_canonical": classmethod(lambda kind, _: kind())})
    with pytest.raises(InputError, match="does not give back the study"):
        run_study(kind(seed=4), tmp_path / "study")
    assert not (tmp_path / "study").exists()


def test_a_module_that_a_worker_cannot_import_is_told_of(tmp_path, monkeypatch, capfd):
    begin = f"import os\nif os.getpid() != {os.getpid()}: raise RuntimeError('no licence here')\n"
    (tmp_path / "loose_licensed.py").write_text(begin + MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    study = importlib.import_module("loose_licensed").Squares(condition_count=1)
    with pytest.raises(CalibrationError, match=r"chunk 0 could not be computed: .*no licence here"):
        run_study(study, tmp_path / "study", workers=1)
    assert capfd.readouterr().err == ""


FOLDERS = """

class Folders(Squares):
    def compute(self, chunk):
        import jax

        folder = str(jax.config.jax_compilation_cache_dir)
        return super().compute(chunk) | {"count": np.array(int(folder.endswith("xla")))}
"""


@pytest.mark.parametrize("wanted", [True, False])
def test_workers_keep_programs_where_the_command_line_does(wanted, tmp_path, monkeypatch):
    """Though the command line itself need not import JAX."""
    (tmp_path / "loose_folders.py").write_text(MODULE + FOLDERS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setattr(jax_cache, "_wanted", wanted)
    study = importlib.import_module("loose_folders").Folders(condition_count=1)
    run_study(study, tmp_path / "study", workers=1)
    found = Store(tmp_path / "study", study).read(study.chunk(0))["count"]
    assert bool(found) is wanted


def test_a_worker_whose_parent_is_gone_ends_without_a_word(squares):
    command = python_command("jaxcal.study.workers")
    worker = subprocess.Popen(command, stdin=PIPE, stdout=PIPE, stderr=PIPE, text=True)
    study = squares(trials=100_000)
    given = {"spec": study.canonical(), "where": where_defined(study), "cores": [], "cache": False}
    worker.stdout.close()
    worker.stdin.write(f'{json.dumps(given)}\n{{"chunk": 0}}\n')
    worker.stdin.flush()
    assert worker.wait(timeout=600) == 1
    assert worker.stderr.read() == ""
    worker.stdin.close()
    worker.stderr.close()


ENDLESS = """

class Endless(Squares):
    def compute(self, chunk):
        print("computing", flush=True)
        import time
        time.sleep(10_000)
"""


@pytest.mark.skipif(not hasattr(select, "poll"), reason="Windows does not tell of a pipe's end")
def test_a_worker_does_not_finish_the_chunk_of_a_parent_that_is_gone(tmp_path, monkeypatch):
    """A killed study's workers would compute on, for minutes, beside its resumption."""
    (tmp_path / "loose_endless.py").write_text(MODULE + ENDLESS)
    monkeypatch.syspath_prepend(tmp_path)
    study = importlib.import_module("loose_endless").Endless()
    given = {"spec": study.canonical(), "where": where_defined(study), "cores": [], "cache": False}
    command = python_command("jaxcal.study.workers")
    with subprocess.Popen(command, stdin=PIPE, stdout=PIPE, stderr=PIPE, text=True) as worker:
        try:
            worker.stdin.write(f'{json.dumps(given)}\n{{"chunk": 0}}\n')
            worker.stdin.flush()
            assert worker.stderr.readline() == "computing\n"
            worker.stdin.close()
            assert worker.wait(timeout=60) == 1
        finally:
            worker.kill()


def test_a_file_names_the_versions_that_computed_it_not_those_that_wrote_it(tmp_path, squares):
    """A worker of a cluster may have others."""
    study = squares()
    store = Store(tmp_path / "study", study)
    store.prepare(resume=False)
    chunk = study.chunk(0)
    maker = {"jaxcal": "9.9.9", "jax": "8.8.8", "device": "4 x gpu"}
    store.write(chunk, study.compute(chunk), maker)
    assert store.versions(chunk) == "jaxcal 9.9.9, jax 8.8.8, 4 x gpu"


def test_chunks_of_another_version_are_told_of_when_they_are_continued(tmp_path, squares, caplog):
    """Not only by the next run, which may never come."""
    study, notes = squares(), []
    store = Store(tmp_path / "study", study)
    run_study(study, store.folder)
    maker = {"jaxcal": "9.9.9", "jax": "8.8.8", "device": "4 x gpu"}
    for index in (0, 1):
        store.write(study.chunk(index), store.read(study.chunk(index)), maker)
    store.path(study.chunk(2)).unlink()

    class Notes(Silence):
        def note(self, message):
            notes.append(message)

    assert run_study(study, store.folder, resume=True, watcher=Notes()).computed == 1
    assert run_study(study, store.folder, resume=True).computed == 0
    assert caplog.messages == notes  # where nobody watches
    assert len(notes) == 1
    assert "2 different set-ups: " in notes[0]
    for versions in ("jaxcal 9.9.9, jax 8.8.8, 4 x gpu", store.versions(study.chunk(2))):
        assert versions in notes[0]


def test_ctrl_c_in_a_destructor_interrupts_a_study_called_from_python(squares, tmp_path):
    """Python drops what destructors raise; the study is interrupted all the same, and resumed."""

    class Interrupted:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    class Watcher(Silence):
        def advance(self, trials):
            Interrupted()
            # Waiting is ended.
            time.sleep(60)

    with pytest.raises(KeyboardInterrupt):
        run_study(squares(), tmp_path / "out", watcher=Watcher())
    assert len(Store(tmp_path / "out", squares()).present()) == 1
    assert run_study(squares(), tmp_path / "out", resume=True).computed == 2
