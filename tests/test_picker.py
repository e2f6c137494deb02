"""Points placed by hand: a real browser on the page, and everybody else kept out of it."""

from __future__ import annotations

import http.client
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from conftest import random_poses

import jaxcal
from jaxcal import FormatError, InputError, OutputError
from jaxcal.cli.main import main
from jaxcal.io.folder import read_folder
from jaxcal.io.picker.frames import Frames
from jaxcal.io.picker.picks import Picks
from jaxcal.io.picker.server import Picker
from jaxcal.io.png import encode_png, read_png
from jaxcal.io.sequence_files import read_sequence, write_sequence
from jaxcal.io.text import read_pose_table

sys.path.insert(0, str(Path(__file__).parent / "hw"))
from browser import addresses, browsing, open_page, screenshot

ROWS, COLUMNS, COUNT = 60, 80, 7
PAIR = ("Probe", "Reference")
RNG = np.random.default_rng(2)
# Far from speckle: nothing here can be found without a person.
FRAMES = RNG.integers(0, 256, (COUNT, ROWS, COLUMNS), dtype=np.uint8)
PICK = [sys.executable, "-P", "-m", "jaxcal", "pick"]


@pytest.fixture
def sequence(tmp_path):
    """Seven frames without a credible target; number 2 was not tracked."""
    poses = random_poses(COUNT, 1)
    valid = {PAIR: np.arange(COUNT) != 2}
    path = tmp_path / "hard.igs.mha"
    write_sequence(path, {PAIR: poses}, np.arange(COUNT) / 10, valid=valid, images=list(FRAMES))
    return path


SHOWN = [0, 1, 3, 4, 5, 6]


def picks_of(path: Path, name: str = "hard.igs.mha") -> Picks:
    return Picks(path, name, (COLUMNS, ROWS), COUNT, SHOWN)


@contextmanager
def serving(path: Path, sequence: Path):
    with Picker(picks_of(path), Frames(read_sequence(sequence)), "hard.igs.mha") as page:
        yield page


def wait_until(browser, script: str, expected, timeout_s: float = 180.0):
    deadline = time.monotonic() + timeout_s
    while (found := browser.execute_script(script)) != expected:
        assert time.monotonic() < deadline, f"{script}: {found!r}, not {expected!r}"
        time.sleep(0.05)


SHOWN_FRAME = "return document.getElementById('frame').dataset.shown"
WHERE = "return document.getElementById('where').textContent"


def click(browser, u: float, v: float) -> None:
    """A real press of the mouse on a place of the frame, px."""
    left, top, scale = browser.execute_script(
        "const b = document.getElementById('frame').getBoundingClientRect();"
        f"return [b.left, b.top, b.width / {COLUMNS}]"
    )
    place = {"x": left + (u + 0.5) * scale, "y": top + (v + 0.5) * scale}
    for kind in ("mousePressed", "mouseReleased"):
        browser.execute_cdp_cmd(
            "Input.dispatchMouseEvent", {"type": kind, "button": "left", "clickCount": 1, **place}
        )


def press(browser, *keys: str) -> None:
    from selenium.webdriver.common.action_chains import ActionChains

    ActionChains(browser).send_keys(*keys).perform()


def test_a_person_in_a_browser(tmp_path, sequence):
    """From the command line to a recording: clicks, keys, a killed process, and on."""
    out = tmp_path / "hard-picks.csv"
    with browsing(tmp_path / "profile", (1000, 800)) as browser:
        addresses(browser)
        with picking(sequence) as (process, url):
            open_page(browser, url)
            wait_until(browser, SHOWN_FRAME, "0")
            assert "frame 0 (1 of 6)" in browser.execute_script(WHERE)
            click(browser, 12.0, 34.0)
            wait_until(browser, SHOWN_FRAME, "1")
            click(browser, 50.0, 20.0)
            wait_until(browser, SHOWN_FRAME, "3")
            press(browser, "s")
            wait_until(browser, SHOWN_FRAME, "4")
            click(browser, 70.0, 55.0)
            wait_until(browser, SHOWN_FRAME, "5")
            press(browser, "u")
            wait_until(browser, SHOWN_FRAME, "4")
            assert "2 picked, 1 skipped" in browser.execute_script(WHERE)
            (tmp_path / "picker.png").write_bytes(screenshot(browser))
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            click(browser, 1.0, 1.0)
            trouble = "return document.getElementById('trouble').textContent.slice(0, 22)"
            wait_until(browser, trouble, "jaxcal does not answer")
        with picking(sequence, "--port", str(urlsplit(url).port)) as (process, url):
            click(browser, 1.0, 1.0)  # the old page, whose token no longer holds
            trouble = "return document.getElementById('trouble').textContent.slice(0, 30)"
            wait_until(browser, trouble, "this page is of an earlier run")
            open_page(browser, url)
            wait_until(browser, SHOWN_FRAME, "4")
            from selenium.webdriver.common.action_chains import ActionChains
            from selenium.webdriver.common.keys import Keys

            press(browser, Keys.ARROW_LEFT, Keys.ARROW_LEFT)
            wait_until(browser, SHOWN_FRAME, "1")
            chain = ActionChains(browser).key_down(Keys.SHIFT)
            chain.send_keys(Keys.ARROW_RIGHT).key_up(Keys.SHIFT).perform()
            moved = "return state.points[1][0]"
            wait_until(browser, moved, pytest.approx(50.25, abs=0.13))
            press(browser, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
            for number, place in ((4, (33.0, 11.0)), (5, (66.0, 5.0)), (6, (2.0, 58.0))):
                wait_until(browser, SHOWN_FRAME, str(number))
                click(browser, *place)
            wait_until(browser, "return state.next", None)
            press(browser, "f")
            said, _ = process.communicate(timeout=300)
        hosts = addresses(browser)
    assert hosts <= {"127.0.0.1"}
    assert process.returncode == 0
    assert f"{out}: 5 points, 1 frame skipped" in said
    assert f"next: jaxcal import {sequence} {out} OUT.h5" in said
    table = np.loadtxt(out, delimiter=",", skiprows=3)
    np.testing.assert_array_equal(table[:, 0], [0, 1, 4, 5, 6])
    expected = [[12, 34], [50.25, 20], [33, 11], [66, 5], [2, 58]]
    # One pixel of the screen is a tenth of the frame's.
    assert np.abs(table[:, 1:] - expected).max() < 0.13
    assert main(["import", str(sequence), str(out), str(tmp_path / "rec.h5")]) == 0
    images = jaxcal.load(tmp_path / "rec.h5").calibration
    np.testing.assert_array_equal(images.measurements, table[:, 1:])


@contextmanager
def picking(sequence: Path, *options: str):
    """The command in a process of its own, and the address that it prints."""
    process = subprocess.Popen([*PICK, str(sequence), *options], stdout=subprocess.PIPE, text=True)
    try:
        said = ""
        while (found := re.search(r"open (http://127\.0\.0\.1:\d+/[\w-]{20,}/)", said)) is None:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line, said
            said += line
        yield process, found[1]
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def test_ctrl_c_keeps_what_was_picked(sequence):
    with picking(sequence) as (process, _):
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=300)
    assert process.returncode == 0
    assert "no points" in said


def test_the_next_command_can_be_copied(tmp_path, sequence):
    """Whatever blanks are in the names, and with the options that choose the poses."""
    renamed = sequence.rename(tmp_path / "Sonde 1.5 cm.igs.mha")
    # A name's own dots stay, so that Sonde 1.0 cm has another file of points.
    out = tmp_path / "Sonde 1.5 cm-picks.csv"
    Picks(out, renamed.name, (COLUMNS, ROWS), len(FRAMES), range(len(FRAMES))).pick(0, 1.0, 2.0)
    # Without the lag the import would take other poses.
    given = ["--poses", str(renamed), "--from", "Probe", "--to", "Reference", "--lag", "-0.05"]
    with picking(renamed, *given) as (process, _):
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=300)
    command = said.partition("next: ")[2].strip()
    assert shlex.split(command) == ["jaxcal", "import", str(renamed), str(out), "OUT.h5", *given]


def test_a_place_that_cannot_be_written_is_said_before_the_page(sequence, capsys):
    assert main(["pick", str(sequence), str(sequence.parent / "none" / "p.csv")]) == 2
    assert "p.csv: cannot be written: its folder does not exist" in capsys.readouterr().err


# Everybody else.


def request(page, method="GET", path="", body=None, **headers):
    token = page.url.rsplit("/", 2)[1]
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=180)
    sent = {
        "Host": f"127.0.0.1:{page.port}",
        **{k.replace("_", "-"): v for k, v in headers.items()},
    }
    target = path if path.startswith("//") else f"/{token}/{path}"
    try:
        connection.request(method, target.replace("//", "/", 1), body, sent)
        answer = connection.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())
    finally:
        connection.close()


def test_only_who_has_the_address(tmp_path, sequence):
    with serving(tmp_path / "p.csv", sequence) as page:
        status, body, headers = request(page)
        assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert b"http" not in body.replace(b"http-equiv", b"")
        assert request(page, path="state")[0] == 200
        for path in ("//", "//wrong/", "//wrong/state", "//state", "//" + "a" * 30_000):
            assert request(page, path=path)[0] in (404, 414)
        pick = json.dumps({"frame": 0, "u": 1, "v": 1})
        assert request(page, "POST", "//wrong/pick", pick)[0] == 404
        assert request(page, Host=f"evil.example:{page.port}")[0] == 404
        assert request(page, "POST", "pick", pick, Origin="http://evil.example")[0] == 403
        assert request(page, "POST", "pick", pick, Origin="null")[0] == 403
        assert not (tmp_path / "p.csv").exists()
        own = f"http://127.0.0.1:{page.port}"
        assert request(page, "POST", "pick", pick, Origin=own)[0] == 200
        assert (tmp_path / "p.csv").exists()
        listening = {line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]
                     if line.split()[3] == "0A"}  # fmt: skip
        assert f"0100007F:{page.port:04X}" in listening
        assert f"00000000:{page.port:04X}" not in listening


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("pick", '{"frame": 2, "u": 1, "v": 1}', 400),  # not tracked, so not shown
        ("pick", '{"frame": 99, "u": 1, "v": 1}', 400),
        ("pick", '{"frame": 0, "u": 80, "v": 1}', 400),
        ("pick", '{"frame": 0, "u": NaN, "v": 1}', 400),
        ("pick", '{"frame": 0, "u": 1e999, "v": 1}', 400),
        ("pick", '{"frame": true, "u": 1, "v": 1}', 400),
        ("pick", '{"frame": 0, "u": "1", "v": 1}', 400),
        ("pick", "[" * 3000, 400),
        ("pick", "[]", 400),
        ("pick", "\xff", 400),
        ("pick", "x" * 5000, 413),
        ("nothing", "{}", 400),
    ],
)
def test_requests_that_are_refused(tmp_path, sequence, path, body, status):
    with serving(tmp_path / "p.csv", sequence) as page:
        assert request(page, "POST", path, body)[0] == status
        for other in ("frame/2.png", "frame/-1.png", "frame/1e3.png", "frame/0.png/..", "../x",
                      "picker.py", "frame/99999999999999999999.png"):  # fmt: skip
            assert request(page, path=other)[0] == 404
        assert request(page, "PUT", "pick", body)[0] == 501
    assert not (tmp_path / "p.csv").exists()


def test_the_images_of_a_folder_are_shown_by_name(tmp_path, sequence):
    """As the table has them; numbers that count from 0 would be taken for those in the names."""
    folder = tmp_path / "images"
    folder.mkdir()
    for k in range(3):
        (folder / f"b{k + 9}.png").write_bytes(encode_png(FRAMES[k]))
    images = read_folder(folder)
    picks = Picks(tmp_path / "p.csv", "images", (COLUMNS, ROWS), 3, [0, 2], images.files)
    with Picker(picks, Frames(images), "images") as page:
        assert json.loads(request(page, path="state")[1])["files"] == ["b9.png", "b11.png"]
    with serving(tmp_path / "q.csv", sequence) as page:
        assert json.loads(request(page, path="state")[1])["files"] == []


def test_frames_come_in_any_order(tmp_path, sequence):
    frames = Frames(read_sequence(sequence))
    for number in (3, 4, 0, 6, 5, 5, 1):
        (tmp_path / "f.png").write_bytes(frames.png(number))
        np.testing.assert_array_equal(read_png(tmp_path / "f.png"), FRAMES[number])
    wide = np.array([[0.0, 4.0], [8.0, np.nan]])
    (tmp_path / "f.png").write_bytes(encode_png(wide))
    np.testing.assert_array_equal(read_png(tmp_path / "f.png"), [[0, 128], [255, 0]])


def test_the_table_goes_on_and_goes_back(tmp_path):
    path = tmp_path / "p.csv"
    picks = picks_of(path)
    assert picks.undo() is None
    picks.pick(0, 1.25, -0.5)
    picks.pick(3, 79.5, 59.5)
    picks.skip(0)
    assert picks_of(path).skipped == {0}
    assert picks.undo() == 0
    other = picks_of(path)
    assert other.points == {0: (1.25, -0.5), 3: (79.5, 59.5)}
    assert (other.skipped, other.left[0]) == (set(), 1)
    for frame, place in ((2, (1.0, 1.0)), (0, (79.6, 1.0)), (0, (float("nan"), 1.0))):
        with pytest.raises(InputError):
            picks.pick(frame, *place)
    with pytest.raises(FormatError, match="has points of"):
        picks_of(path, "other.igs.mha")
    # Points of pixels in another orientation are other points.
    with pytest.raises(FormatError, match=r"has points of .*, not of .*, orientation UF"):
        Picks(path, "hard.igs.mha", (COLUMNS, ROWS), COUNT, SHOWN, orientation="UF")
    # Of the points, only those in frames that are shown count as done.
    assert Picks(path, "hard.igs.mha", (COLUMNS, ROWS), COUNT, [1, 3, 5]).left == [1, 5]
    path.write_text("frame,u,v\n0,1,1\n")
    with pytest.raises(FormatError, match="was not made by jaxcal pick"):
        picks_of(path)
    assert path.read_text() == "frame,u,v\n0,1,1\n"


def test_a_sequence_with_any_name_goes_on(tmp_path):
    for name in ("h\udcff.igs.mha", "of\ntwo lines\u2028and a third.igs.mha"):
        path = tmp_path / f"{len(name)}.csv"
        picks_of(path, name).pick(0, 1.0, 1.0)
        assert picks_of(path, name).points == {0: (1.0, 1.0)}


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ('b "1", c.png', True),
        ("#1;2 \N{LATIN SMALL LETTER U WITH DIAERESIS}.png", True),
        ("form\ffeed.png", True),
        ("line\nbreak.png", False),
        ("return\r.png", False),
        (" blank.png", False),
        ('"quoted".png', False),
        ("back\\slash.png", False),
        ("not utf-8 \udcff.png", False),
    ],
)
def test_a_name_that_the_table_cannot_hold_is_refused_before_any_click(tmp_path, name, kept):
    path, names = tmp_path / "p.csv", ["a.png", name]
    if not kept:
        with pytest.raises(InputError, match="a table of points cannot name this image"):
            Picks(path, "images", (COLUMNS, ROWS), 2, [0, 1], names)
        return
    Picks(path, "images", (COLUMNS, ROWS), 2, [0, 1], names).pick(1, 1.0, 2.0)
    again = Picks(path, "images", (COLUMNS, ROWS), 2, [0, 1], names)
    assert again.points == {1: (1.0, 2.0)}
    assert list(read_pose_table(path).file or ()) == [name]
    again.skip(1)
    again.skip(0)
    doubled = name.replace('"', '""')
    assert f'# skipped: "a.png" "{doubled}"' in path.read_text().split("\n")
    again = Picks(path, "images", (COLUMNS, ROWS), 2, [0, 1], names)
    assert (again.points, again.skipped) == ({}, {0, 1})
    path.write_text(path.read_text().replace('"a.png"', '"another.png"'))
    with pytest.raises(FormatError, match="names a frame that the sequence has not"):
        Picks(path, "images", (COLUMNS, ROWS), 2, [0, 1], names)


def test_two_pages_do_not_lose_each_others_points(tmp_path):
    """Nor does an editor: what another program has put there is never written over."""
    path = tmp_path / "p.csv"
    first, second = picks_of(path), picks_of(path)
    first.pick(0, 1.0, 1.0)
    for change in (lambda: second.pick(1, 2.0, 2.0), lambda: second.skip(1)):
        with pytest.raises(OutputError, match=r"p\.csv: was changed by another program"):
            change()
    assert second.points == {}
    again = picks_of(path)
    again.pick(1, 2.0, 2.0)
    with pytest.raises(OutputError, match="was changed"):
        first.undo()
    assert picks_of(path).points == {0: (1.0, 1.0), 1: (2.0, 2.0)}
    # A table that was removed is written again as this page knows it.
    path.unlink()
    again.pick(3, 3.0, 3.0)
    assert list(picks_of(path).points) == [0, 1, 3]


def test_a_table_that_cannot_be_written_changes_nothing(tmp_path):
    folder = tmp_path / "gone"
    folder.mkdir()
    picks = picks_of(folder / "p.csv")
    picks.pick(0, 1.0, 1.0)
    (folder / "p.csv").unlink()
    folder.rmdir()
    for change in (lambda: picks.pick(1, 2.0, 2.0), lambda: picks.skip(0), picks.undo):
        with pytest.raises(OutputError):
            change()
    assert (picks.points, picks.skipped) == ({0: (1.0, 1.0)}, set())
