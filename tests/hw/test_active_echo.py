"""The active-echo driver with the real pyserial: ptys, socket://, a socat pair, and every fault."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from waiting import exhaust, until

from hw.active_echo import ActiveEcho, EchoFrame, EchoStatistics
from hw.active_echo.codec import EchoPacket, decode_line, encode_echo, encode_line, encode_reply
from hw.active_echo.transport import open_transport
from hw.bench.active_echo import AuspisEmulator
from hw.midplane.pattern_injection import BAR_DELAY_S
from hw.runtime.clock import Clock
from hw.runtime.errors import DeviceError, LostError, RefusedError, StaleError

pytest.importorskip("serial", reason="pyserial, for ports and ptys")

LINES = 128
PATIENCE_S = 1200.0
"""Bench time for what must come: minutes on the wall, as the machine may have other work."""


def echo(t: float, threshold: int) -> tuple[np.ndarray, np.ndarray]:
    """Something that tells time and threshold from one another; every fourth line hears nothing."""
    seconds = 20e-6 + 1e-7 * np.arange(LINES) + 1e-6 * (t % 1)
    seconds[::4] = np.nan
    return seconds, np.full(LINES, 100.0 + threshold)


@pytest.fixture(params=["pty", "tcp"])
def emulator(request: pytest.FixtureRequest) -> Iterator[AuspisEmulator]:
    """At ten times the real time, 300 frames/s on the wall."""
    with AuspisEmulator(echo, clock=Clock(speed=10.0), link=request.param) as device:
        yield device


@pytest.fixture
def pty_emulator() -> Iterator[AuspisEmulator]:
    """The same, for what does not depend on the kind of line."""
    with AuspisEmulator(echo, clock=Clock(speed=10.0)) as device:
        yield device


def opened(device: AuspisEmulator, **options) -> ActiveEcho:
    return ActiveEcho(device.path, clock=device._clock, **options)


def frames_of(device: ActiveEcho, count: int) -> list[EchoFrame]:
    return [device.read(PATIENCE_S) for _ in range(count)]


def test_commands(emulator: AuspisEmulator) -> None:
    with opened(emulator) as device:
        for streaming in (False, True):
            device.stream(streaming)
            assert device.identify().count(",") == 3
            assert device.clock_hz() == 100e6
            device.set_threshold(1234)
            assert device.threshold() == emulator.threshold == 1234
            lines, frames = device.trigger_count()
            assert lines == LINES * frames
            assert device.device_error() is None
        assert not emulator.injection.on
        pattern = bytes(range(LINES))
        device.load_pattern(pattern)
        device.inject(True, 4e-7)
        assert (emulator.injection.on, emulator.injection.delay_ticks) == (True, 40)
        assert emulator.injection.pattern == pattern
        device.inject(False)
        assert not emulator.injection.on
        device.inject(True)
        device.stream(True)
        frames_of(device, 1)
    # Closing waits until the element is silent.
    assert not emulator.injection.on
    assert not emulator._streaming


def test_frames_are_what_the_element_heard(emulator: AuspisEmulator) -> None:
    with opened(emulator) as device:
        device.set_threshold(77)
        device.stream(True)
        frames = frames_of(device, 30)
    numbers = [frame.frame for frame in frames]
    assert numbers == list(range(numbers[0], numbers[0] + 30))
    for frame in frames:
        assert frame.threshold == 77
        assert np.isfinite(frame.tof_s).sum() == 96
        seconds, amplitude = echo(frame.ticks / 100e6, 77)
        np.testing.assert_array_equal(np.isnan(frame.tof_s), np.isnan(seconds))
        heard = np.isfinite(seconds)
        # Whole ticks of 10 ns; the frame's own tick moves the time of the echo by 1e-14 s.
        error = seconds[heard] - frame.tof_s[heard]
        assert error.min() > -1e-12
        assert error.max() < 10.001e-9
        np.testing.assert_array_equal(frame.amplitude, amplitude)
        assert (frame.tof_ticks[~heard] == 0xFFFF).all()
    host = np.array([frame.t_host for frame in frames])
    assert (np.diff(host) >= 0).all()
    ticks = np.diff([frame.ticks for frame in frames])
    assert (np.abs(ticks - 100e6 / 30) < 3).sum() > 20


def test_a_threshold_takes_effect_in_the_frames_that_say_so(pty_emulator: AuspisEmulator) -> None:
    with opened(pty_emulator) as device:
        device.stream(True)
        for threshold in (5, 900, 12):
            device.set_threshold(threshold)
            device.drain()
            assert all(frame.threshold == threshold for frame in frames_of(device, 5))


@pytest.mark.skipif(shutil.which("socat") is None, reason="socat, for a pair of ptys")
def test_a_socat_pair(tmp_path: Path) -> None:
    """Another program's pty between driver and device."""
    with AuspisEmulator(echo, link="tcp") as emulator:
        path = tmp_path / "port"
        address = emulator.path.removeprefix("socket://")
        with subprocess.Popen(
            ["socat", f"PTY,link={path},rawer", f"TCP:{address}"], stdin=subprocess.DEVNULL
        ) as socat:
            try:
                until(path.exists)
                with ActiveEcho(str(path)) as device:
                    device.stream(True)
                    numbers = [frame.frame for frame in frames_of(device, 10)]
                    assert numbers == list(range(numbers[0], numbers[0] + 10))
                    socat.terminate()
                    with pytest.raises(LostError, match="unplugged"):
                        exhaust(device, PATIENCE_S)
            finally:
                socat.kill()


def test_unplugged_and_back(emulator: AuspisEmulator) -> None:
    with opened(emulator) as device:
        device.stream(True)
        frames_of(device, 3)
        emulator.unplug()
        with pytest.raises(LostError, match=r"active echo: .* is gone: was it unplugged"):
            exhaust(device, PATIENCE_S)
        with pytest.raises(LostError):
            device.drain()
        with pytest.raises(LostError):
            device.threshold()
    with pytest.raises(DeviceError, match="cannot open"):
        opened(emulator)
    emulator.replug()
    with opened(emulator) as device:
        assert device.threshold() == 0
        device.stream(True)
        frames_of(device, 3)


def test_a_second_program_is_refused() -> None:
    with (
        AuspisEmulator(echo) as emulator,
        ActiveEcho(emulator.path),
        pytest.raises(DeviceError, match="another program uses it"),
    ):
        ActiveEcho(emulator.path)
    with pytest.raises(DeviceError, match=r"no-such-port: there is no such port, .* are (/|no)"):
        open_transport("/dev/no-such-port")
    for url in ("socket://localhost", "socket://localhost:99999", "socket://:9"):
        with pytest.raises(DeviceError, match=f"cannot open {url}: write it as socket://host:port"):
            open_transport(url)
    # Of these pyserial says so by a KeyError, and by an error of re.
    for url in ("loop://?x=1", "hwgrep://["):
        with pytest.raises(DeviceError, match="cannot open "):
            open_transport(url)


def test_mute_devices(pty_emulator: AuspisEmulator) -> None:
    pty_emulator.fault(mute=True)
    with pytest.raises(StaleError, match=r"did not answer STRM within 1 s"):
        opened(pty_emulator)
    pty_emulator.recover()
    with opened(pty_emulator) as device:
        device.stream(True)
        frames_of(device, 2)
        pty_emulator.fault(mute=True)
        with pytest.raises(StaleError, match="did not answer"):
            device.threshold()


def test_no_frame_triggers(emulator: AuspisEmulator) -> None:
    with opened(emulator) as device:
        device.stream(True)
        frames_of(device, 3)
        emulator.fault(stale=True)
        with pytest.raises(StaleError, match="no frame from"):
            exhaust(device, 2.0)
        assert device.threshold() == 0
        emulator.recover()
        frames_of(device, 3)
        assert device.statistics().lost == 0


@pytest.mark.parametrize("fault", ["missed_triggers", "crc_errors"])
def test_lost_frames_are_counted_and_never_filled(pty_emulator: AuspisEmulator, fault: str) -> None:
    with opened(pty_emulator, queue=2000) as device:
        device.stream(True)
        first = device.read(PATIENCE_S).frame
        pty_emulator.fault(**{fault: 0.3})
        frames = frames_of(device, 100)
        pty_emulator.recover()
        frames += frames_of(device, 2)
        while more := device.drain():
            frames += more
        numbers = [frame.frame for frame in frames]
        seen = device.statistics()
    assert (np.diff(numbers) > 0).all()
    missing = numbers[-1] - first - len(numbers)
    assert 10 < missing <= seen.lost
    assert seen.received + seen.lost >= numbers[-1] - first + 1
    assert seen.dropped == seen.short == seen.restarts == 0
    if fault == "crc_errors":
        assert missing <= seen.crc_errors + 1
        assert seen.resynchronised > 5
    else:
        assert seen.crc_errors == 0


def test_missed_line_triggers(pty_emulator: AuspisEmulator) -> None:
    """Nothing tells which line was missed, so the frame is not handed on; it is not lost either."""
    with opened(pty_emulator) as device:
        device.stream(True)
        pty_emulator.fault(missed_lines=0.5)
        frames = frames_of(device, 40)
        seen = device.statistics()
        lines, triggers = device.trigger_count()
    assert all(len(frame.tof_s) == LINES for frame in frames)
    assert seen.short > 5
    assert seen.lost == 0
    assert triggers * LINES - lines >= seen.short


def test_full_queue(pty_emulator: AuspisEmulator) -> None:
    """The oldest go, and are counted."""
    with opened(pty_emulator, queue=4) as device:
        device.stream(True)
        until(lambda: device.statistics().received > 30)
        device.stream(False)
        seen = device.statistics()
        frames = device.drain()
        assert device.drain() == []
    assert len(frames) == 4
    assert seen.received == 4 + seen.dropped
    assert np.diff([frame.frame for frame in frames]).tolist() == [1, 1, 1]


def test_counters_wrap_and_restart() -> None:
    with AuspisEmulator(
        echo, clock=Clock(speed=10.0), first_frame=2**32 - 20
    ) as emulator, opened(emulator) as device:  # fmt: skip
        device.stream(True)
        until(lambda: device.statistics().received > 40)
        frames = device.drain()
        assert {0, 2**32 - 1} < {frame.frame for frame in frames}
        assert device.statistics().lost == 0
        until(lambda: emulator._frames > 2**32 + 50)
        emulator.restart_counter()
        until(lambda: device.statistics().restarts > 0)
        assert device.statistics().lost == 0


def test_left_streaming(emulator: AuspisEmulator) -> None:
    """As by a program that was killed: the next one finds its way in."""
    transport = open_transport(emulator.path)
    transport.write(encode_line("THR 9") + encode_line("PATT:STAT ON") + encode_line("STRM ON"))
    until(lambda: emulator.sent > 20)
    transport.close()
    assert emulator.injection.on
    # A pty keeps what nobody reads until it is full.
    until(lambda: emulator.refused or emulator.path.startswith("socket"))
    with opened(emulator) as device:
        assert not emulator.injection.on
        assert device.threshold() == 9
        assert device.statistics() == EchoStatistics()
        device.stream(True)
        frames_of(device, 3)
        assert device.statistics().lost == 0


def test_a_delay_is_the_same_time_with_any_clock() -> None:
    """In ticks, the injected bar was at another depth where the clock is another one."""
    with (
        AuspisEmulator(echo, clock=Clock(speed=10.0), clock_hz=10e6) as emulator,
        opened(emulator) as device,
    ):
        device.inject(True, BAR_DELAY_S)
        assert emulator.injection.delay_ticks == 40


def test_an_error_that_nobody_expected_ends_the_stream(pty_emulator, monkeypatch) -> None:
    """It ended the reader's thread alone: every later frame was only late."""
    with opened(pty_emulator) as device:
        device.stream(True)
        monkeypatch.setattr(device, "_recent", None)
        with pytest.raises(LostError, match="TypeError"):
            exhaust(device, PATIENCE_S)


def test_refusals(pty_emulator: AuspisEmulator) -> None:
    with opened(pty_emulator, lines=64) as device:
        with pytest.raises(RefusedError, match="refused PATT:LOAD: 4,value out of range"):
            device.load_pattern(bytes(64))
        assert device.device_error() == "4,value out of range"
        assert device.device_error() is None
        for call in (
            lambda: device.set_threshold(4096),
            lambda: device.set_threshold(-1),
            lambda: device.inject(True, 65536 * 1e-8),
            lambda: device.load_pattern(bytes(65)),
        ):
            with pytest.raises(DeviceError, match=r"active echo: (threshold|delay|a pattern)"):
                call()
    with pytest.raises(DeviceError, match="lines must be"):
        opened(pty_emulator, lines=0)


def test_bad_commands_are_not_obeyed(pty_emulator: AuspisEmulator) -> None:
    transport = open_transport(pty_emulator.path)
    bad = encode_line("THR 5")
    transport.write(bad.replace(b"5", b"7") + b"\x80\xff\n" + b"FLY 3\n" + b"x" * 9000 + b"\n")
    transport.write(b"THR 21\n")
    until(lambda: pty_emulator.threshold == 21)
    transport.close()
    with opened(pty_emulator) as device:
        errors = []
        while error := device.device_error():
            errors.append(error)
    assert {text[0] for text in errors} == {"1", "2", "3"}


@contextlib.contextmanager
def scripted(answer: Callable[[str, int], bytes]) -> Iterator[str]:
    """A device on a pty that says what it is told, to the first, second, ... command of a word."""
    master, slave = os.openpty()
    tty.setraw(slave)
    counts: dict[str, int] = {}

    def run() -> None:
        inbox = b""
        while True:
            try:
                inbox += os.read(master, 4096)
            except OSError:
                return
            *lines, inbox = inbox.split(b"\n")
            for line in lines:
                text, _ = decode_line(line)
                if text == "END":
                    return
                counts[text] = counts.get(text, 0) + 1
                os.write(master, answer(text, counts[text]))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        os.write(slave, b"END\n")
        thread.join()
        os.close(master)
        os.close(slave)


def usual(text: str) -> bytes:
    return encode_line("CLK? 1000000" if text == "CLK?" else text)


def test_queries_are_repeated_when_the_answer_is_spoilt() -> None:
    def answer(text: str, count: int) -> bytes:
        good = usual(f"{text} 12") if text == "THR?" else usual(text)
        return good.replace(b"1", b"3") if text == "THR?" and count < 3 else good

    with scripted(answer) as path, ActiveEcho(path, clock=Clock(speed=10.0)) as device:
        assert device.threshold() == 12
        assert device.statistics().crc_errors == 2


def test_a_spoilt_change_of_mode() -> None:
    """The device is silent again, and its frame that said so was damaged."""

    def answer(text: str, count: int) -> bytes:
        if text == "STRM OFF" and count == 2:
            return encode_reply(text).replace(b"OFF", b"OFG")
        return usual(text)

    with scripted(answer) as path, ActiveEcho(path, clock=Clock(speed=10.0)) as device:
        device.stream(True)
        device.stream(False)
        assert device.identify() == ""
        assert device.statistics().crc_errors == 1


def test_what_changes_something_is_asked_once() -> None:
    asked = []

    def answer(text: str, count: int) -> bytes:
        asked.append(text)
        return b"" if text == "SYST:ERR?" else usual(text)

    with (
        scripted(answer) as path,
        ActiveEcho(path, clock=Clock(speed=10.0)) as device,
        pytest.raises(StaleError),
    ):
        device.device_error()
    assert asked.count("SYST:ERR?") == 1


def test_late_answers_are_not_taken_for_others() -> None:
    """An answer to the command before, and one to the same command with another number."""

    def answer(text: str, count: int) -> bytes:
        if text == "THR?":
            return usual("CLK? 7") + usual("THR? 300")
        if text == "THR 200":
            return usual("THR 100") + usual("THR 200")
        return usual(text)

    with scripted(answer) as path, ActiveEcho(path, clock=Clock(speed=10.0)) as device:
        assert device.threshold() == 300
        device.set_threshold(200)


def test_a_device_that_does_something_else() -> None:
    def answer(text: str, count: int) -> bytes:
        return usual({"THR 200": "THR 100", "THR?": "THR? many", "TRIG:COUN?": "TRIG:COUN? 3"}
                     .get(text, text))  # fmt: skip

    with scripted(answer) as path, ActiveEcho(path, clock=Clock(speed=10.0)) as device:
        with pytest.raises(DeviceError, match="was set to THR 200, but reports 100"):
            device.set_threshold(200)
        with pytest.raises(DeviceError, match=r"answered THR. by 'many'"):
            device.threshold()
        with pytest.raises(DeviceError, match=r"answered TRIG:COUN. by '3'"):
            device.trigger_count()
    with (
        scripted(lambda text, _: encode_line("CLK? 0" if text == "CLK?" else text)) as path,
        pytest.raises(DeviceError, match="a clock of '0' Hz"),
    ):
        ActiveEcho(path, clock=Clock(speed=10.0))


def test_another_device_on_the_port() -> None:
    """Something that talks as fast as the line goes, and not our protocol."""
    master, slave = os.openpty()
    tty.setraw(slave)
    stop = threading.Event()
    noise = np.random.default_rng(1).bytes(997)

    def talk() -> None:
        os.set_blocking(master, False)
        while not stop.wait(0.01):
            with contextlib.suppress(BlockingIOError):
                os.write(master, noise)

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        with pytest.raises(StaleError, match="right port"):
            ActiveEcho(os.ttyname(slave), clock=Clock(speed=10.0))
    finally:
        stop.set()
        thread.join()
        os.close(master)
        os.close(slave)


def test_a_device_that_takes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its line is full: commands fail in time, and so does closing."""
    monkeypatch.setattr("hw.active_echo.transport._WRITE_TIMEOUT_S", 0.2)
    master, slave = os.openpty()
    tty.setraw(slave)
    transport = open_transport(os.ttyname(slave))
    try:
        with pytest.raises(StaleError, match="takes no commands"):
            transport.write(bytes(1_000_000))
    finally:
        transport.close()
        os.close(master)
        os.close(slave)


def test_how_late_frames_are_is_known_for_minutes() -> None:
    """After 60 s nothing counted as late any more, as within one slow motion."""
    device = object.__new__(ActiveEcho)
    device._asked, device._anchor, device._tick_s = None, (0.0, 0, 0.01), 1e-8
    silent = np.full(LINES, 0xFFFF, np.uint16)
    for now in (50.0, 70.0, 300.0):
        packet = EchoPacket(1, round((now - 2.0) / 1e-8), 0, silent, silent)
        assert 2.01 <= device._late(packet, now) <= 2.01 + 1e-3 + 1e-4 * now


def test_fuzz_through_the_driver() -> None:
    """Damaged frames over a real pty: the driver hands on only what was sent, and goes on."""
    rng = np.random.default_rng(4)
    sent: dict[int, np.ndarray] = {}
    parts = []
    for number in range(600):
        ticks, amplitude = rng.integers(0, 0x10000, (2, LINES), dtype=np.uint16)
        sent[number] = ticks
        data = bytearray(encode_echo(EchoPacket(number, number, 0, ticks, amplitude)))
        if number % 3 == 1:
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        elif number % 31 == 2:
            data = data[: rng.integers(len(data))] + rng.bytes(40)
        parts.append(bytes(data))
    stream = b"".join(parts)

    def answer(text: str, count: int) -> bytes:
        return usual(text) + (stream if text == "STRM ON" else b"")

    with scripted(answer) as path, ActiveEcho(path, clock=Clock(speed=10.0), queue=600) as device:
        device.stream(True)
        until(lambda: device._last_frame == 599 or device._last_frame == 597)
        frames = device.drain()
        seen = device.statistics()
    for frame in frames:
        np.testing.assert_array_equal(frame.tof_ticks, sent[frame.frame])
    assert len(frames) == seen.received > 350
    assert seen.received + seen.lost == frames[-1].frame - frames[0].frame + 1
    assert seen.crc_errors > 150
