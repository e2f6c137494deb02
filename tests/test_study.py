"""Studies: specs, files, resumption, and results that depend on nothing but the spec."""

import dataclasses
import fcntl
import functools
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcal
from jaxcal import FormatError, InputError, Options
from jaxcal.calibration.calibrate import Request, check_request
from jaxcal.cli.main import main
from jaxcal.cli.study import _rate
from jaxcal.data.poses import rotation_angle
from jaxcal.diagnostics.metrics import reconstruction_precision
from jaxcal.study import load_spec, open_results, run_study
from jaxcal.study.laws import OFFSET_LAWS
from jaxcal.study.offsets import nominal_bound, standard_deviation, standard_offsets
from jaxcal.study.pipeline import (
    BATCH_SIZE,
    Block,
    _block,
    _trials,
    bound_mm,
    compile_pieces,
    compute_chunk,
    protocol,
)
from jaxcal.study.show import as_csv, as_record, mean_interval, summarise
from jaxcal.study.simulation import join_protocol, split_protocol
from jaxcal.study.spec import AXES, Spec, parse_spec
from jaxcal.study.store import Store

SPEC = """
name = "small"
seed = 11
trials = {trials}
chunk_trials = {chunk}
[conditions]
images = 20
test_images = 4
elevation_mm = [0.5, 2]
noise_mm = 0.5
[probe]
elements = 8
pitch_mm = 7.0
[[methods]]
name = "flat"
method = "conventional"
[[methods]]
name = "arcs"
method = "alternating"
max_elevation_factor = 1.5
"""
METHOD = '\n[[methods]]\nname = "a"\nmethod = "conventional"\n'
MINIMAL = 'name = "a"\nseed = 1\ntrials = 3\n'


def small(trials: int = 10, chunk: int = 4) -> str:
    return SPEC.format(trials=trials, chunk=chunk)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A study that nobody disturbed."""
    folder = tmp_path_factory.mktemp("study") / "finished"
    run_study(parse_spec(small()), folder)
    return folder


def process(arguments, before=()):
    command = [*before, sys.executable, "-m", "jaxcal.cli.main", "study", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "chunks").iterdir()}


# --- specs


def test_every_field_of_the_documentation_is_known():
    text = jaxcal.study.spec.__doc__
    example = "\n".join(line[4:] for line in text.splitlines() if line.startswith("    "))
    with pytest.raises(InputError, match=r"max_elevation_mm and .* contradict"):
        parse_spec(example)
    example = re.sub(r"^max_elevation_factor.*$", "", example, flags=re.M)
    spec = parse_spec(example)
    assert set(re.findall(r"^(\w+) =", example, flags=re.M)) >= set(AXES)
    assert spec.listed == ("elevation_mm", "noise_mm")
    # What stands there as a default is the default.
    bare = 'name = "b"\nseed = 1\ntrials = 9\n[[methods]]\nname = "alternation, 1 mm"\n'
    bare = parse_spec(bare + 'method = "alternating"\n')
    assert bare.methods == spec.methods
    assert bare.probe == spec.probe
    for name in set(AXES) - {"elevation_mm", "noise_mm"}:
        assert bare.axis(name) == spec.axis(name)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MINIMAL + "colour = 3" + METHOD, r"unknown field 'colour'"),
        (MINIMAL + "[conditions]\nnoise = 1" + METHOD, "unit is missing, write noise_mm"),
        (MINIMAL + "[conditions]\nrotation = 1" + METHOD, "unit is missing, write rotation_deg"),
        (MINIMAL + "[conditions]\nnoise_m = 1" + METHOD, "did you mean noise_mm"),
        (MINIMAL + '[conditions]\nnoise_mm = "1 mm"' + METHOD, "plain number"),
        (MINIMAL + "[conditions]\nnoise_mm = [1, 1.0]" + METHOD, "twice"),
        (MINIMAL + "[conditions]\nnoise_mm = []" + METHOD, "1 to"),
        (MINIMAL + "[conditions]\nnoise_mm = -0.1" + METHOD, "noise_mm must be between"),
        (MINIMAL + "[conditions]\nnoise_mm = nan" + METHOD, "noise_mm must be between"),
        (MINIMAL + "[conditions]\nimages = -4" + METHOD, "images must be between 4"),
        (MINIMAL + "[conditions]\nimages = 5.0" + METHOD, "whole number"),
        (MINIMAL + "[conditions]\nimages = true" + METHOD, "whole number"),
        (MINIMAL + '[conditions]\nelevation_distribution = "flat"' + METHOD, "one of uniform"),
        (MINIMAL + "[conditions]\ndepth_min_mm = 95" + METHOD, "less than"),
        ('name = "a"\nseed = 1\ntrials = -3\n' + METHOD, "trials must be between 1"),
        ('name = "a"\nseed = -1\ntrials = 3\n' + METHOD, "seed must be between 0"),
        ('name = "a"\nseed = 1\n' + METHOD, "trials is missing"),
        ('name = "../a"\nseed = 1\ntrials = 3\n' + METHOD, "name must be"),
        ('name = "a"\nseed = 1\ntrials = 4294967297\n' + METHOD, "trials must be between"),
        (MINIMAL, "methods is missing"),
        (MINIMAL + METHOD + METHOD, "same name"),
        (MINIMAL + METHOD + "tolerance_mm = 1", "only the alternating method has tolerance_mm"),
        (MINIMAL + METHOD + "max_elevation_mm = 1", "max_elevation belongs to the alternating"),
        (MINIMAL + METHOD + "max_elevation = 1", "unit is missing, write max_elevation_mm"),
        (MINIMAL + "[probe]\npitch = 1" + METHOD, "unit is missing, write pitch_mm"),
        (MINIMAL + "conditions = 3" + METHOD, "must be a table"),
        ("name = ", "not TOML"),
        (MINIMAL + "x = " + "[" * 5000 + METHOD, "not TOML"),
    ],
)
def test_bad_specs_are_refused_with_the_field_named(text, message):
    with pytest.raises(InputError, match=message) as caught:
        parse_spec(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("written", "asked"),
    [
        (
            'method = "conventional"\nprior = "uniform"',
            {"method": "conventional", "prior": "uniform"},
        ),
        (
            'method = "joint"\nprior = "bounded"\nmax_elevation_mm = -1',
            {"prior": "bounded", "max_elevation": -1.0},
        ),
        (
            'method = "joint"\nprior = "gaussian"\nmax_elevation_factor = 1',
            {"prior": "gaussian", "max_elevation": 1.0},
        ),
        ('method = "alternating"\ntolerance_mm = 0', {"tolerance_mm": 0.0}),
        ('method = "alternating"\ntolerance_mm = nan', {"tolerance_mm": float("nan")}),
        ('method = "joint"\nmax_iterations = 0', {"max_iterations": 0}),
    ],
)
def test_a_study_is_told_what_calibrate_tells(written, asked):
    given = {key: value for key, value in asked.items() if key in vars(Options())}
    rest = {key: value for key, value in asked.items() if key not in given}
    with pytest.raises(InputError) as told:
        check_request(Request(**rest, options=Options(**given)))
    with pytest.raises(InputError) as caught:
        parse_spec(f'{MINIMAL}[[methods]]\nname = "a"\n{written}\n')
    assert str(caught.value) == f"methods[0]: {told.value}"


@pytest.mark.parametrize("factor", ["-1", "0", "inf", "nan"])
def test_a_factor_of_the_bound_has_no_unit(factor):
    method = f'method = "joint"\nprior = "uniform"\nmax_elevation_factor = {factor}'
    with pytest.raises(InputError, match="max_elevation_factor must be positive") as caught:
        parse_spec(f'{MINIMAL}[[methods]]\nname = "a"\n{method}\n')
    assert "mm" not in str(caught.value)


def test_what_says_the_same_has_the_same_hash():
    spec = parse_spec(small())
    again = small().replace("seed = 11\ntrials = 10", "trials = 10 # few\nseed = 11")
    again = again.replace("noise_mm = 0.5", "test_fraction = 0.75\nnoise_mm = 0.50")
    assert parse_spec(again).sha256 == spec.sha256
    assert Spec.from_canonical(spec.canonical()) == spec
    edits = {"seed = 11": "seed = 12", "[0.5, 2]": "[0.5, 3]", "1.5": "1.6",
             "elements = 8": "elements = 9", "noise_mm = 0.5": "noise_mm = [0.5]"}  # fmt: skip
    for old, new in edits.items():
        changed = small().replace(old, new)
        assert changed != small()
        assert parse_spec(changed).sha256 != spec.sha256
    with pytest.raises(InputError):
        Spec.from_canonical(spec.canonical().replace('"seed": 11', '"seed": 11.0'))
    # A spec that is changed in Python is checked, and can be read back.
    fewer = dataclasses.replace(spec, trials=3, seed=12)
    assert Spec.from_canonical(fewer.canonical()) == fewer
    for change in ({"seed": -1}, {"trials": 0}, {"methods": ()}, {"chunk_trials": 0}):
        with pytest.raises(InputError):
            dataclasses.replace(spec, **change)


@pytest.mark.parametrize(
    ("name", "values"),
    [("images", ["fifty"]), ("noise_mm", ["loud"]), ("images", []), ("depth_min_mm", [95.0])],
)
def test_the_values_of_a_stored_spec_are_checked(name, values):
    content = json.loads(parse_spec(small()).canonical())
    content["axes"][name] = values
    with pytest.raises(InputError, match="canonical"):
        Spec.from_canonical(json.dumps(content, sort_keys=True))


def test_the_grid_is_counted_in_order():
    text = small().replace("noise_mm = 0.5", 'noise_mm = [1, 2, 3]\nimages = [6, 9]').replace(
        "images = 20\n", "", 1
    )  # fmt: skip
    spec = parse_spec(text)
    assert spec.condition_count == 12
    assert [spec.condition(k) for k in range(12)] == list(spec.conditions())
    cells = [(c.images, c.elevation_mm, c.noise_mm) for c in spec.conditions()]
    assert cells == [(i, e, s) for i in (6, 9) for e in (0.5, 2.0) for s in (1.0, 2.0, 3.0)]
    chunks = [spec.chunk(k) for k in range(spec.chunk_count)]
    covered = [(c.condition, t) for c in chunks for t in range(c.start, c.stop)]
    assert covered == [(c, t) for c in range(12) for t in range(10)]


# --- offsets


def test_every_law_can_be_simulated_in_a_study():
    laws = ", ".join(f'"{law}"' for law in OFFSET_LAWS)
    spec = parse_spec(f"{MINIMAL}[conditions]\nelevation_distribution = [{laws}]{METHOD}")
    drawn = [protocol(condition, spec.probe) for condition in spec.conditions()]
    assert tuple(each.elevation_distribution for each in drawn) == OFFSET_LAWS


@pytest.mark.parametrize("law", OFFSET_LAWS)
def test_offsets_have_their_size(law):
    drawn = np.asarray(
        jax.jit(standard_offsets, static_argnums=(1, 2))(jax.random.key(3), law, 200_000)
    )
    assert np.std(drawn) == pytest.approx(standard_deviation(law), rel=0.03)
    mean = {"one-sided": 0.5, "exponential": 1.0, "off-centre": 3.0}.get(law, 0.0)
    if law != "sometimes off-centre":
        assert np.mean(drawn) == pytest.approx(mean, abs=0.03 if law == "drifting" else 0.01)
    alike = np.corrcoef(drawn[1:], drawn[:-1])[0, 1]
    assert alike == pytest.approx(0.9 if law == "drifting" else 0.0, abs=0.01)
    if law == "two-humped":
        assert np.mean(np.abs(drawn) < 0.25) < 0.01
        return
    if law in ("uniform", "triangular", "one-sided"):
        assert np.abs(drawn).max() <= nominal_bound(law, 1.0) == 1.0
        assert np.abs(drawn).max() > 0.99
    else:
        assert nominal_bound(law, 2.0) == pytest.approx(2 * np.sqrt(3))
    kurtosis = np.mean((drawn - drawn.mean()) ** 4) / np.var(drawn) ** 2
    assert (kurtosis > 4) == (law in ("heavy-tailed", "exponential", "outlying"))


def test_one_recording_in_ten_is_off_centre():
    keys = jax.random.split(jax.random.key(5), 4000)
    draw = jax.jit(jax.vmap(lambda key: standard_offsets(key, "sometimes off-centre", 100)))
    drawn = draw(keys)
    means = np.asarray(drawn).mean(axis=1)
    # Of means N(0, 4), 80.3 % are more than half an SD away; of those of centred recordings none.
    assert np.mean(np.abs(means) > 0.5) == pytest.approx(0.1 * 0.803, abs=0.013)


def test_tracker_noise_has_its_size_and_moves_nothing_else():
    quiet = jaxcal.Protocol(images=2000, test_images=5, probe=jaxcal.LinearProbe(elements=4))

    @jax.jit
    def draw(mm, rad):
        noisy = dataclasses.replace(quiet, tracker_mm=mm, tracker_rad=rad)
        return jaxcal.simulate(jax.random.key(4), noisy)

    one, two = draw(0.0, 0.0), draw(0.2, 1e-3)
    np.testing.assert_array_equal(one.points, two.points)
    np.testing.assert_array_equal(one.test_poses, two.test_poses)
    first, second = np.asarray(one.poses), np.asarray(two.poses)
    np.testing.assert_allclose((second - first)[:, :3, 3].std(axis=0), 0.2, rtol=0.06)
    rotation = np.swapaxes(first[:, :3, :3], 1, 2) @ second[:, :3, :3]
    angle = np.linalg.norm(rotation - np.eye(3), axis=(1, 2)) / np.sqrt(2)
    assert np.sqrt(np.mean(angle**2)) == pytest.approx(1e-3 * np.sqrt(3), rel=0.05)


# --- results


def test_a_trial_is_that_of_the_public_functions(finished):
    """Oracle: draw and calibrate one trial by hand."""
    spec = load_spec_of(finished)
    data = open_results(finished)
    cell, trial = 1, 7
    condition = spec.condition(cell)
    indices = cell * spec.trials + np.arange(BATCH_SIZE["cpu"])
    block = by_public_functions(spec, condition, indices)
    experiment, problem = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[trial]), block)
    result = jaxcal.calibrate(problem, "conventional")
    at = {"elevation_mm": 2.0, "method": "flat", "trial": trial}
    rp = jaxcal.reconstruction_precision(
        result.image_to_probe, experiment.test_poses, experiment.test_points
    )
    stored = data.sel(at)
    assert float(stored.rp) == pytest.approx(float(rp), rel=1e-6)
    found, true = np.asarray(result.image_to_probe), np.asarray(experiment.image_to_probe)
    turned = rotation_angle(found, true)
    assert float(stored.rotation_error) == pytest.approx(turned, rel=1e-5)
    moved = (found - true)[:3, 3]
    assert float(stored.translation_error) == pytest.approx(np.linalg.norm(moved), rel=1e-5)
    np.testing.assert_allclose(stored.sigma, result.sigma, rtol=1e-5)
    realised = np.sqrt(np.mean(np.asarray(experiment.elevation) ** 2))
    assert float(stored.realised.sel(component="elevation")) == pytest.approx(realised)
    assert float(data.bound.sel({"elevation_mm": 2.0, "method": "arcs"})) == 3.0
    assert np.isnan(data.bound.sel({"elevation_mm": 2.0, "method": "flat"}))


def by_public_functions(spec, condition, indices):
    """The experiments of these trials, a whole block of them, and their problems."""
    shape, numbers = split_protocol(protocol(condition, spec.probe))
    return drawing(shape)(jnp.asarray(spec.seed), jnp.asarray(indices, np.uint32), numbers)


@functools.cache
def drawing(shape):
    @jax.jit
    def draw(seed, indices, numbers):
        keys = jax.vmap(lambda index: jax.random.fold_in(jax.random.key(seed), index))(indices)
        drawn = jax.vmap(lambda key: jaxcal.simulate(key, join_protocol(shape, numbers)))(keys)
        return drawn, jax.vmap(lambda experiment: experiment.problem())(drawn)

    return draw


def load_spec_of(folder):
    return Store.open(folder).spec


def test_results_are_labelled(finished):
    data = open_results(finished)
    assert data.rp.dims == ("elevation_mm", "method", "trial")
    assert data.rp.shape == (2, 2, 10)
    assert data.sigma.dims == ("elevation_mm", "method", "trial", "component")
    assert data.rp.attrs["units"] == "mm"
    assert float(data.noise_mm) == 0.5
    assert bool(np.isfinite(data.rp).all())
    assert (data.status == 0).all()
    # Another seed of the same cell, or the same draws for every cell, would show here.
    assert len(np.unique(data.realised)) == data.realised.size


def test_results_do_not_depend_on_the_chunks(finished, tmp_path):
    run_study(parse_spec(small(chunk=7)), tmp_path / "other")
    one, two = open_results(finished), open_results(tmp_path / "other")
    for name in one.data_vars:
        np.testing.assert_array_equal(one[name], two[name], err_msg=str(name))


def test_missing_and_damaged_chunks_are_computed_again(finished, tmp_path, capsys):
    folder, path = tmp_path / "copy", tmp_path / "spec.toml"
    path.write_text(small())
    run_study(parse_spec(small()), folder)
    chunks = sorted((folder / "chunks").iterdir())
    assert len(chunks) == 6
    whole = chunks[1].read_bytes()
    chunks[0].unlink()
    chunks[1].write_bytes(whole[: len(whole) // 2])
    flipped = bytearray(chunks[2].read_bytes())
    place = flipped.find(Store.open(folder).read(load_spec_of(folder).chunk(2))["rp"].tobytes()[:8])
    assert place > 0
    flipped[place] ^= 1
    chunks[2].write_bytes(bytes(flipped))
    chunks[3].write_bytes(chunks[4].read_bytes())
    with pytest.raises(FormatError, match="1 of 6 chunks are missing"):
        open_results(folder)
    again = r"chunk-000001.*; 'jaxcal study run .* computes it again"
    with pytest.raises(FormatError, match=again):
        open_results(folder, incomplete=True)
    assert main(["study", "show", str(folder)]) == 2
    assert "'jaxcal study run ... --resume' computes it again" in capsys.readouterr().err
    assert main(["study", "run", str(path), "--out", str(folder), "--resume"]) == 0
    told = capsys.readouterr()
    assert "6 chunks are done, 4 of them now" in told.out
    notes = [line for line in told.err.splitlines() if "computed again" in line]
    assert [re.search(r"chunk-\d+", line)[0] for line in notes] == [
        "chunk-000001", "chunk-000002", "chunk-000003",
    ]  # fmt: skip
    assert "checksum" in notes[1]
    assert files(folder) == files(finished)


def test_another_spec_in_the_folder_is_refused(finished, tmp_path, capsys):
    path, before = tmp_path / "spec.toml", files(finished)
    edits = {"seed": ("seed = 11", "seed = 12"), "noise_mm": ("noise_mm = 0.5", "noise_mm = 1")}
    for words, edit in edits.items():
        path.write_text(small().replace(*edit))
        for flags in ([], ["--resume"]):
            assert main(["study", "run", str(path), "--out", str(finished), *flags]) == 2
            line = capsys.readouterr().err
            assert "another spec" in line
            assert words in line
            assert line.count("\n") == 1
    path.write_text(small())
    assert main(["study", "run", str(path), "--out", str(finished)]) == 2
    assert "--resume continues it" in capsys.readouterr().err
    assert files(finished) == before


def test_show(finished, capsys, tmp_path):
    store = Store.open(finished)
    cells = summarise(store)
    data = open_results(finished)
    rp = data.rp.sel(elevation_mm=2.0).values
    row = cells[1].rows[1]
    assert row.mean_mm == pytest.approx(rp[1].mean())
    assert row.sd_mm == pytest.approx(rp[1].std(ddof=1))
    assert row.difference_mm == pytest.approx((rp[1] - rp[0]).mean())
    assert cells[1].rows[0].difference_mm is None
    record = as_record(store, cells)
    assert record["chunks_done"] == record["chunks"] == 6
    assert len(as_csv(store.spec, cells).splitlines()) == 1 + 4
    table = tmp_path / "table.csv"
    assert main(["study", "show", str(finished), "--csv", str(table)]) == 0
    out = capsys.readouterr().out
    assert f"{row.mean_mm:.4f}" in out
    assert table.read_text() == as_csv(store.spec, cells)
    assert main(["study", "show", str(finished), "--json"]) == 0
    assert capsys.readouterr().out.count("\n") == 1
    assert main(["study", "show", str(tmp_path)]) == 2
    assert "holds no study" in capsys.readouterr().err


def test_intervals_are_students():
    from scipy import stats

    values = np.random.default_rng(0).normal(size=12)
    oracle = stats.t.interval(0.95, 11, values.mean(), stats.sem(values))
    assert mean_interval(np.append(values, np.nan))[1:] == pytest.approx(oracle)
    assert mean_interval(values[:1]) is None


# --- the command line


def test_bad_specs_on_the_command_line(tmp_path, capsys):
    path = tmp_path / "bad.toml"
    for text in (small().replace("trials = 10", "trials = -10"), small() + "colour = 1\n"):
        path.write_text(text)
        assert main(["study", "run", str(path), "--out", str(tmp_path / "out")]) == 2
        line = capsys.readouterr().err
        assert line.startswith(f"jaxcal: error: {path}: ")
        assert line.count("\n") == 1
        assert not (tmp_path / "out").exists()
    assert main(["study", "run", str(tmp_path / "none.toml"), "--out", str(tmp_path / "out")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_unwritable_folder(tmp_path, capsys):
    path, occupied = tmp_path / "spec.toml", tmp_path / "file"
    path.write_text(small())
    occupied.write_text("mine")
    assert main(["study", "run", str(path), "--out", str(occupied)]) == 2
    assert f"{occupied}: is a file, not a folder\n" in capsys.readouterr().err
    places = [occupied / "below", Path("/proc/study")]
    if os.geteuid() != 0:
        locked = tmp_path / "locked"
        locked.mkdir(mode=0o500)
        places.append(locked / "study")
    for place in places:
        assert main(["study", "run", str(path), "--out", str(place)]) == 2
        line = capsys.readouterr().err
        assert "cannot be made or written to" in line
        assert line.count("\n") == 1
    assert occupied.read_text() == "mine"
    if os.geteuid() != 0:
        hidden = tmp_path / "hidden"
        hidden.mkdir(mode=0)
        assert main(["study", "run", str(path), "--out", str(hidden / "study")]) == 2
        assert f"{hidden / 'study'}" in capsys.readouterr().err
    # Somebody else's lock.
    (tmp_path / "shared" / ".lock").mkdir(parents=True)
    assert main(["study", "run", str(path), "--out", str(tmp_path / "shared")]) == 2
    assert "shared/.lock: cannot be written: Is a directory\n" in capsys.readouterr().err
    # An unset variable of a shell would be the current folder.
    assert main(["study", "run", str(path), "--out", ""]) == 2
    assert capsys.readouterr().err == "jaxcal: error: the name of a file or folder is empty\n"
    with pytest.raises(jaxcal.OutputError, match=r"cannot be made or written to: .*null"):
        run_study(parse_spec(small()), "a\0b")


@pytest.mark.slow
def test_full_disk(tmp_path):
    """No file may grow beyond 4 KiB, a real refusal by the system: nothing half is left."""
    path, folder = tmp_path / "spec.toml", tmp_path / "out"
    spec = conventional_only(small())
    path.write_text(spec)
    # First, so that JAX has cached the programs: under the limit it would leave half a program.
    run_study(parse_spec(spec), tmp_path / "undisturbed")
    run = ["run", path, "--out", folder]
    # Python would leave truncated bytecode beside our sources.
    limited = 'export PYTHONDONTWRITEBYTECODE=1; ulimit -f 4; exec "$@"'
    child = process(run, before=("bash", "-c", limited, "bash"))
    out, err = child.communicate(timeout=600)
    assert child.returncode == 2, err
    last = err.strip().splitlines()[-1]
    assert "cannot be written" in last, err
    assert "Traceback" not in err
    assert out == ""
    assert list((folder / "chunks").iterdir()) == []
    run_study(parse_spec(spec), folder, resume=True)
    assert files(folder) == files(tmp_path / "undisturbed")


def start_and_wait(run, folder, count):
    child = process(run)
    deadline = time.monotonic() + 600
    store = Store(folder, parse_spec(LONG))
    while len(store.present()) < count:
        if time.monotonic() > deadline or child.poll() is not None:
            child.kill()
            raise AssertionError(child.communicate())
        time.sleep(0.005)
    return child


def conventional_only(spec: str) -> str:
    return spec.split('\n[[methods]]\nname = "arcs"')[0]


LONG = conventional_only(small(trials=160, chunk=2))


@pytest.fixture(scope="module")
def long_study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("long") / "undisturbed"
    run_study(parse_spec(LONG), folder)
    return folder


def kill_and_resume(kills, long_study, path, folder, seed):
    """Kill it so often at random, each time further on; then finish it, and compare."""
    random = np.random.default_rng(seed)
    spec = parse_spec(LONG)
    # A chunk takes some ms; the last half is for a child that ends late.
    first, last = len(Store(folder, spec).present()) + 1, spec.chunk_count // 2
    for count in np.sort(random.choice(np.arange(first, last), kills, replace=False)):
        child = start_and_wait(["run", path, "--out", folder, "--resume"], folder, count)
        time.sleep(random.uniform(0, 0.02))
        child.kill()
        child.communicate()
        assert child.returncode == -signal.SIGKILL
    assert len(Store(folder, spec).present()) < spec.chunk_count
    assert main(["study", "run", str(path), "--out", str(folder), "--resume"]) == 0
    assert files(folder) == files(long_study)


def test_interrupted_killed_and_resumed(long_study, tmp_path):
    path, folder = tmp_path / "spec.toml", tmp_path / "out"
    path.write_text(LONG)
    child = start_and_wait(["run", path, "--out", folder], folder, 5)
    child.send_signal(signal.SIGINT)
    _, told = child.communicate(timeout=600)
    assert child.returncode == 130, told
    done = len(Store(folder, parse_spec(LONG)).present())
    again = f"jaxcal study run {path} --out {folder} --resume"
    assert told == f"jaxcal: interrupted: {done} of 160 chunks are done; continue with: {again}\n"
    kill_and_resume(1, long_study, path, folder, 1)


@pytest.mark.slow
def test_killed_three_times_and_resumed(long_study, tmp_path):
    path = tmp_path / "spec.toml"
    path.write_text(LONG)
    kill_and_resume(3, long_study, path, tmp_path / "killed", 2)


def test_two_processes_do_not_share_a_folder(finished, tmp_path, capsys):
    path = tmp_path / "spec.toml"
    path.write_text(small())
    with (finished / ".lock").open("wb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert main(["study", "run", str(path), "--out", str(finished), "--resume"]) == 2
    assert "is being computed by another process" in capsys.readouterr().err
    # One that has only just begun may have another spec, which must not be replaced.
    new = tmp_path / "new"
    new.mkdir()
    with (new / ".lock").open("wb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert main(["study", "run", str(path), "--out", str(new)]) == 2
    assert "is being computed by another process" in capsys.readouterr().err
    assert not (new / "spec.json").exists()


def test_full_file_system(long_study, tmp_path):
    """The same on a file system of 48 KiB, where the system lets us have one."""
    small_disk, kept, path = tmp_path / "disk", tmp_path / "kept", tmp_path / "spec.toml"
    small_disk.mkdir()
    path.write_text(LONG)
    mount = f"mount -t tmpfs -o size=48k tmpfs {small_disk}"
    probe = subprocess.run(["unshare", "-rm", "sh", "-c", mount], capture_output=True, check=False)
    if probe.returncode != 0:
        pytest.skip("no file system may be mounted here; test_full_disk (slow) has a limit instead")
    script = f'{mount}; "$@"; code=$?; cp -a {small_disk}/out {kept}; exit $code'
    child = process(
        ["run", path, "--out", small_disk / "out"],
        before=("unshare", "-rm", "bash", "-c", script, "bash"),
    )  # fmt: skip
    _, err = child.communicate(timeout=600)
    assert child.returncode == 2, err
    assert "No space left on device" in err.strip().splitlines()[-1]
    there = files(kept)
    assert 0 < len(there) < 160
    assert there.items() <= files(long_study).items()
    run_study(parse_spec(LONG), kept, resume=True)
    assert files(kept) == files(long_study)


@pytest.mark.slow
def test_several_devices_share_a_block(tmp_path):
    """More trials than one device takes at a time, so that both have some of each chunk."""
    trials = BATCH_SIZE["cpu"] + 6
    spec = conventional_only(small(trials, chunk=trials))
    path, folder = tmp_path / "spec.toml", tmp_path / "out"
    path.write_text(spec)
    child = process(["run", path, "--out", folder], before=("env", "JAX_NUM_CPU_DEVICES=2"))
    # In chunks for one device, whose programs are those of the other tests.
    run_study(parse_spec(conventional_only(small(trials, chunk=trials // 2))), tmp_path / "one")
    _, err = child.communicate(timeout=600)
    assert child.returncode == 0, err
    assert "2 x cpu" in Store.open(folder).versions(parse_spec(spec).chunk(0))
    one, two = open_results(tmp_path / "one"), open_results(folder)
    for name in one.data_vars:
        # Another program rounds the noise, which is drawn in float32, differently: by 1e-7 of it.
        np.testing.assert_allclose(one[name], two[name], rtol=1e-6, atol=1e-6, err_msg=str(name))


@pytest.mark.slow
def test_self_tuned_and_bounded_methods():
    """Through the pipeline; bounds are those that were asked for."""
    text = (
        conventional_only(small(trials=64, chunk=64))
        + """
[[methods]]
name = "joint"
method = "joint"
[[methods]]
name = "bounded"
method = "joint"
prior = "bounded"
max_elevation_mm = 0.25
"""
    )
    spec = parse_spec(text)
    got = compute_chunk(spec, spec.chunk(1))
    assert np.isfinite(got["rp"]).all()
    # Uniform within 2 mm: 1.15 mm, from 20 images each.
    assert np.median(got["sigma"][1, :, 2]) == pytest.approx(2 / np.sqrt(3), rel=0.1)
    assert (got["sigma"][2, :, 2] <= 0.25 + 1e-9).all()
    assert bound_mm(spec.methods[2], spec.condition(1)) == 0.25
    assert not jnp.isnan(got["rotation_error"]).any()


SELF_TUNED = """
[[methods]]
name = "self-tuned"
method = "joint"
prior = "gaussian"
"""


def blocks(text):
    """A block of each condition, and a way to what public calls say of a method on its draws."""
    spec = parse_spec(text)
    devices = tuple(jax.local_devices())
    measure = jax.jit(jax.vmap(reconstruction_precision))
    for k in range(spec.condition_count):
        condition = spec.condition(k)
        # One piece, as in the other tests: the same programs.
        indices = (k * spec.trials + np.arange(spec.trials, dtype=np.uint32)).reshape(1, -1)
        block = Block(spec, condition, indices, devices)

        def whole(method, condition=condition, indices=indices):
            bound = None if method.bound_given is None else bound_mm(method, condition)
            drawn, problems = by_public_functions(spec, condition, indices.ravel())
            found = jaxcal.calibrate_batch(
                problems, method.method, method.prior, max_elevation=bound, options=method.options
            )
            x = np.asarray(found.image_to_probe)
            away = x[:, :3, 3] - np.asarray(drawn.image_to_probe)[:, :3, 3]
            rp = measure(x, drawn.test_poses, drawn.test_points)
            return {
                "rp": rp,
                "translation_error": np.linalg.norm(away, axis=1),
                "point_error": np.linalg.norm(found.point - drawn.point, axis=1),
                "sigma": found.sigma,
                "status": found.status_code,
                "iterations": found.convergence.iterations,
            }

        yield spec, block, whole


def test_pieces_go_through_a_program_one_by_one_in_order():
    devices = tuple(jax.local_devices())[:1]
    each = compile_pieces(lambda one, other, factor: factor * one + other, devices, pieces=2)
    pieces, size = _block(parse_spec(small(trials=200, chunk=150)), devices)
    assert (pieces, size) == (3, BATCH_SIZE["cpu"])
    trials = np.arange(pieces * size * 2.0)
    cut = trials.reshape(pieces, size, 2)
    np.testing.assert_array_equal(
        _trials(each(cut, -cut, 3.0)), 2 * trials.reshape(pieces * size, 2)
    )


def test_what_a_study_computes_is_what_calibrations_say():
    """Oracle: calibrate_batch on the same draws, and everything measured from its results.

    Parallel poses leave X open: no status says otherwise. The conventional method is that of
    :func:`test_a_trial_is_that_of_the_public_functions`.
    """
    text = small(trials=BATCH_SIZE["cpu"]) + SELF_TUNED
    text = text.replace("[conditions]", "[conditions]\nrotation_deg = [0, 30]")
    text = text.replace("elevation_mm = [0.5, 2]", "elevation_mm = 2")
    for k, (spec, block, whole) in enumerate(blocks(text)):
        parallel = spec.condition(k).rotation_deg == 0
        for method in spec.methods[1:]:
            found, expected = block.measured(method), whole(method)
            assert (found["status"] == expected["status"]).all()
            assert (found["status"] == jaxcal.Status.UNOBSERVABLE).all() == parallel
            if parallel:
                continue
            # Of 64 trials some end so near to the tolerance that rounding decides on one more.
            assert (np.abs(found["iterations"] - expected["iterations"]) <= 1).all()
            assert np.median(found["iterations"]) == np.median(expected["iterations"])
            for name in ("rp", "translation_error", "point_error", "sigma"):
                np.testing.assert_allclose(
                    found[name], expected[name], rtol=2e-6, atol=1e-7, err_msg=name
                )


def test_the_rate_of_a_slow_study_is_not_zero():
    rates = [_rate(3, 60.0), _rate(1, 300.0), _rate(5000, 2.0)]
    assert rates == ["0.05 a second", "0.0033 a second", "2500 a second"]


def test_load_spec_names_the_file(tmp_path):
    path = tmp_path / "x.toml"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(FormatError, match=re.escape(str(path))):
        load_spec(path)
    # Windows' editors put a byte order mark first.
    path.write_bytes(b"\xef\xbb\xbf" + (MINIMAL + METHOD).encode())
    assert load_spec(path).sha256 == parse_spec(MINIMAL + METHOD).sha256
