"""The live view: a page on loopback that shows the bench, and cannot do anything to it."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from html import unescape
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed (jaxcal[view])")

import msgspec
import viser
from browser import addresses, browsing, pixels
from motions import PLAN
from waiting import until
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from hw.midplane.bracket import Bracket, Placement
from hw.planning.poses import Extent, plan_poses
from hw.planning.scene import Scene
from hw.recording.layout import RecordingHeader
from hw.recording.recorder import Recorder
from hw.recording.session import Session
from hw.robot.confirmation import confirm_unattended
from hw.robot.motion import Motion
from hw.robot.motion_plan import MotionPlan
from hw.robot.stream import PoseSample
from hw.runtime.clock import Clock
from hw.runtime.errors import LostError, StaleError
from hw.runtime.extras import missing
from hw.runtime.rigid import looking_rotation
from hw.setup.description import Setup
from hw.setup.emulated import setup_of, start
from hw.view.feed import LiveView, halved, watched
from hw.view.page import Page, ellipsoid, estimate_words, state_words, to_scale
from hw.view.server import ignore_browsers
from jaxcal.data.probe import LinearProbe

PLACEMENT = Placement(Bracket(0.1, -0.7, 0.9, 0.3), 0.1, 3, np.zeros((0, 3)))
ROOT = Path(__file__).parents[2]
LIMITS = replace(PLAN.limits, arm_model="")
SCENE = Scene(np.eye(4), np.array([400.0, -100.0, 0.0]), np.array([0.0, 0.0, -1.0]))
SETUP = Setup("127.0.0.1", "", SCENE, {}, None, probe=LinearProbe(elements=128), clock=Clock())


def listeners(port: int) -> set[str]:
    """Local addresses, in hexadecimal as the kernel writes them, that listen on a port."""
    found = set()
    for name in ("tcp", "tcp6"):
        path = Path("/proc/net", name)
        for line in path.read_text().splitlines()[1:] if path.exists() else []:
            address, state = line.split()[1], line.split()[3]
            host, _, number = address.partition(":")
            if state == "0A" and int(number, 16) == port:
                found.add(host)
    return found


def port_of(view: LiveView) -> int:
    return int(view.url.rsplit(":", 1)[1])


@pytest.fixture(scope="module")
def shared_view() -> Iterator[LiveView]:
    with LiveView(lambda line: None, port=8190, rate_hz=50.0) as view:
        yield view


def a_plan(setup: Setup, serial: str = "none") -> MotionPlan:
    poses = plan_poses(5, setup.scene, setup.extent, 1).poses
    return MotionPlan(poses, setup.motion_limits(), (0.0, 0.0, 0.12, 0.0, 0.0, 0.0), serial)


@contextmanager
def a_session(setup: Setup, folder: Path) -> Iterator[Session]:
    probe = {"kind": "linear", "elements": 128, "pitch_mm": 0.457, "sound_speed_m_s": 1490.0}
    header = RecordingHeader("time_of_flight", probe, 128, settings="{}")
    with Recorder(folder / "rec.h5", header) as recorder, Session(setup, recorder) as session:
        yield session


def travel(session: Session, plan: MotionPlan, pose: np.ndarray) -> PoseSample:
    """Go there; what a busy machine holds up is waited for, and confirmed anew, as by a person."""
    setup = session.setup
    deadline = time.monotonic() + 300.0
    while time.monotonic() < deadline:
        confirmation = confirm_unattended(plan, plan.digest, clock=setup.clock)
        with suppress(StaleError, LostError):
            session.wait_until_clear()
            with Motion(
                setup.robot_host, plan, confirmation,
                clock=setup.clock, dry_run=False, guard=session.trouble,
            ) as motion:  # fmt: skip
                return motion.move_to(pose)
    raise AssertionError("the bench cannot keep up with itself")


def test_a_browser_sees_the_bench_move_and_killing_the_view_changes_nothing(tmp_path):
    pytest.importorskip("serial", reason="needs jaxcal[serial]")
    pytest.importorskip("rtde_receive", reason="needs jaxcal[robot]")
    # Near one another, and far enough from where the arm waits to be seen to move.
    near = Extent(cone_deg=5.0, turn_deg=5.0, lateral_mm=5.0, depth_mm=(20.0, 25.0))
    said = []
    with (
        browsing(tmp_path / "profile") as browser,
        LiveView(said.append, port=8194) as view,
        ExitStack() as after_loading,
    ):
        browser.get(view.url)
        addresses(browser)  # those of the browser's own first page
        browser.refresh()

        def shows(words: str) -> bool:
            # In one step: a page that is being loaded may have no body yet, or soon another one.
            script = "return document.body ? document.body.innerText : ''"
            return words in browser.execute_script(script)

        # At five times its speed the bench takes a core, which the browser needs until here.
        until(lambda: shows("Waiting for the plan"), every_s=0.1)
        bench = after_loading.enter_context(start(3, 5.0))
        setup = replace(setup_of(bench), extent=near)
        session = after_loading.enter_context(a_session(setup, tmp_path))
        after_loading.enter_context(watched(view, session))
        plan = a_plan(setup, session.poses.identity().name)
        view.plan(setup, plan, plan.targets, [])
        until(lambda: shows("0 of 5 images"), every_s=0.1)
        until(lambda: shows("B-mode, newest frame"), every_s=0.1)
        before = pixels(browser)
        view.going(0)
        travel(session, plan, plan.targets[0])
        view.taken(0, PLACEMENT, None)
        until(lambda: shows("1 of 5 images"), every_s=0.1)
        after = pixels(browser)
        # The scene's part of the page: arm, image plane and poses have moved.
        scene = slice(0, int(0.6 * before.shape[1]))
        moved = np.abs(after[:, scene].astype(int) - before[:, scene]).max(axis=2) > 40
        assert moved.mean() > 0.01
        assert addresses(browser) <= {"127.0.0.1"}
        os.kill(view.pid, signal.SIGKILL)
        until(lambda: len(said) > 1)
        tracked = travel(session, plan, plan.targets[1])
        assert np.allclose(tracked.pose[:3, 3], plan.targets[1][:3, 3], atol=0.5)
        session.wait_until_clear()


def test_the_page_is_on_loopback_only(shared_view):
    assert shared_view.url.startswith("http://127.0.0.1:")
    assert listeners(port_of(shared_view)) == {"0100007F"}


def test_a_dead_viewer_is_told_once_and_holds_nothing_up():
    said = []
    with LiveView(said.append, port=8191, rate_hz=50.0) as view:
        until(lambda: view.sent > 2)
        os.kill(view.pid, signal.SIGKILL)
        until(lambda: len(said) > 1)
        for row in range(100):
            view.going(row)
            view.say("a line")
        # Ten messages more, if there were any.
        time.sleep(0.2)
    assert len(said) == 2
    assert "the acquisition goes on without it" in said[1]


def test_a_feed_that_fails_is_told():
    said = []
    with LiveView(said.append, port=8195, rate_hz=50.0) as view:
        view._session = object()  # type: ignore[assignment]
        until(lambda: len(said) > 1)
    assert said[1].startswith("view: AttributeError: ")
    assert said[1].endswith("; the acquisition goes on without it")


def test_a_viewer_that_does_not_read_costs_one_message():
    said = []
    with LiveView(said.append, port=8192, rate_hz=50.0) as view:
        until(lambda: view.sent > 2)
        os.kill(view.pid, signal.SIGSTOP)
        try:
            # More than the pipe holds, so that a message stays half handed over.
            for _ in range(20):
                view.say("x" * 50_000)
                time.sleep(0.02)
            until(lambda: view.left_out > 5)
            sent, missed = view.sent, view.left_out
            until(lambda: view.left_out > missed + 5)
            assert view.sent == sent
        finally:
            os.kill(view.pid, signal.SIGCONT)
        until(lambda: view.sent > sent + 20)
    assert len(said) == 1
    with pytest.raises(ProcessLookupError):
        os.kill(view.pid, 0)


def threads_and_children(pid: int) -> tuple[int, list[str]]:
    """Of a process: how many threads, and the ids of the processes that they started."""
    threads = list(Path(f"/proc/{pid}/task").iterdir())
    return len(threads), [child for t in threads for child in (t / "children").read_text().split()]


def settled(pid: int) -> tuple[int, list[str]]:
    """The same once it no longer changes: a server starts threads for a page a little later."""
    found, since = threads_and_children(pid), time.monotonic()
    while time.monotonic() < since + 0.5:
        time.sleep(0.02)
        if (now := threads_and_children(pid)) != found:
            found, since = now, time.monotonic()
    return found


def test_a_page_can_do_nothing(shared_view):
    """A browser's messages are dropped, those too on which viser itself would act."""
    view = shared_view
    protocol = [f"viser-v{viser.__version__}"]
    with connect(view.url.replace("http", "ws"), subprotocols=protocol) as socket:  # type: ignore
        assert isinstance(socket.recv(timeout=180.0), bytes)
        before = settled(view.pid)
        # viser would open a tunnel through a public server, in a process of its own.
        socket.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
        assert settled(view.pid) == before
        assert not before[1]
        socket.send(b"not a message")
    sent = view.sent
    until(lambda: view.sent > sent + 3)
    assert listeners(port_of(view)) == {"0100007F"}


def test_a_page_of_another_site_cannot_read_it(shared_view):
    """A browser lets any page open a socket to this machine; a name may lead here by a trick."""
    view = shared_view
    port = port_of(view)
    protocol = [f"viser-v{viser.__version__}"]
    for host, origin, good in (
        (f"127.0.0.1:{port}", None, True),
        (f"localhost:{port}", f"http://localhost:{port}", True),
        (f"localhost:{port}", "http://localhost:9000", False),
        (f"127.0.0.1:{port}", "http://evil.example", False),
        (f"127.0.0.1:{port}", "null", False),
        ("evil.example", None, False),
        ("[", None, False),
    ):
        asked = {"Host": host} | ({} if origin is None else {"Origin": origin})
        page = HTTPConnection("127.0.0.1", port, timeout=180.0)
        page.request("GET", "/", headers=asked)
        assert page.getresponse().status == (200 if good else 403), asked
        page.close()
    url = view.url.replace("http", "ws")
    with pytest.raises(InvalidStatus, match="403"):
        connect(url, subprotocols=protocol, origin="http://evil.example")  # type: ignore
    with connect(url, subprotocols=protocol, origin=view.url) as socket:  # type: ignore
        assert isinstance(socket.recv(timeout=180.0), bytes)


def test_what_is_said_is_no_markdown():
    """Electronics that named themselves so had the browser ask another machine for a picture."""
    said = "![a_b](http://192.0.2.7/p.png) <i>"
    words = estimate_words({"said": [said]}).split("\n\n")[-1]
    shown = words.removeprefix("<small>").removesuffix("</small>")
    assert not set(shown) & set("![]()_<>:/")
    assert unescape(shown) == said
    told = {"done": [], "images": 4, "given_up": [], "trouble": said}
    assert unescape(state_words(told).split("\n\n")[-1]) == f"**{said}**"
    assert said not in state_words(told)


def test_the_extra_is_named_where_viser_is_missing():
    text = missing("viser_that_is_not_there", extra="view")
    assert text is not None
    assert 'pip install "jaxcal[view]"' in text


def test_the_page_counts_images_and_not_the_poses_of_a_pool(shared_view):
    poses = np.tile(np.eye(4), (180, 1, 1))
    plan = MotionPlan(poses, LIMITS, (0.0,) * 6, "none")
    shared_view.plan(SETUP, plan, poses, list(range(12)), 60)
    assert state_words(shared_view._slow) == "**12 of 60 images**"
    shared_view.plan(SETUP, plan, poses, [])
    assert state_words(shared_view._slow) == "**0 of 180 images**"


@pytest.mark.filterwarnings("ignore:.control_layout. is deprecated:DeprecationWarning")
def test_an_unknown_arm_is_not_drawn_as_another_one(shared_view):
    """A UR5 was drawn, whatever stood there."""
    shared_view.plan(SETUP, MotionPlan(PLAN.targets, LIMITS, (0.0,) * 6, "none"), PLAN.targets, [])
    server = viser.ViserServer(host="127.0.0.1", port=8196, verbose=False)
    try:
        page = Page(server)
        pose = PLAN.targets[0][:3].ravel().tolist()
        page.show({**shared_view._slow, "pose": pose, "joints": [0.0] * 6}, None)
        shown = [page._parts[f"link {number}"].visible for number in range(8)]
    finally:
        server.stop()
    # One line to the flange, and the probe; no links of an arm.
    assert shown == [True] + [False] * 7


def test_a_viser_that_cannot_be_served_safely_is_told_with_the_version_that_can():
    allowed = re.search(r'"viser>=([\d.]+)"', (ROOT / "pyproject.toml").read_text())
    assert allowed is not None
    with pytest.raises(NotImplementedError, match=f"install viser {allowed[1]}$"):
        ignore_browsers(object())


def test_geometry_of_the_page():
    rng = np.random.default_rng(0)
    for _ in range(20):
        rotation = looking_rotation(rng.normal(size=3))
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    turned = looking_rotation(np.array([1.0, 2.0, 3.0]))
    half, axes, magnified = ellipsoid(turned @ np.diag([0.01, 0.04, 0.09]) @ turned.T)
    # 2.795 SDs hold 95 % in three dimensions.
    np.testing.assert_allclose(half / magnified, 2.7955 * np.array([0.1, 0.2, 0.3]), rtol=1e-4)
    assert magnified == 10
    assert abs(axes[:, 2] @ turned[:, 2]) == pytest.approx(1.0)


def test_pictures_keep_bars_and_proportions():
    frame = np.zeros((480, 640), np.uint8)
    frame[241, 301] = 200
    assert halved(frame)[120, 150] == 200
    tall = to_scale(np.full((240, 320), 7, np.uint8), (58.5 / 320, 90 / 240))
    columns = (tall[120, :, 0] == 7).sum()
    assert columns / 240 == pytest.approx(58.5 / 90, rel=0.02)
