"""An emulated PlusServer in a process of its own: a hand that holds a probe over a point.

    python plus_server.py

takes what to serve as lines of JSON, e.g. ``{"asked": {"mode": "tracked", "poses": 8}}``, and
answers each with its port, as ``{"port": 40000}``; there it streams to whoever connects, one client
after the other. It ends with its standard input. The stamps of a stream run faster than the clock
on the wall, so that a test does not take minutes.
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from jaxcal.io.message_content import Picture, Tracked, TrackedFrame
from jaxcal.io.openigtlink import Message, encode

ROWS, COLUMNS = 120, 160
SPACING_MM = (0.25, 0.2)
PERIOD_S = 0.05
HOLD, TRAVEL = 18, 6
"""Frames that a pose is held, and that the way to the next takes."""
START_S = 1_700_000_000.0


def image_to_probe() -> np.ndarray:
    """The true X, mm."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", [20, -35, 100], degrees=True).as_matrix()
    matrix[:3, 3] = [30.0, -12.0, 55.0]
    return matrix


TARGET_MM = np.array([12.0, -80.0, 140.0])
"""In the reference's frame."""


def holds(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses probe -> reference (n, 4, 4) and the target's pixels (n, 2) that a hand holds."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    cells = [(k % 3, k // 3 % 3) for k in range(count)]
    places = (np.array(cells) + rng.uniform(0.3, 0.7, (count, 2))) / 3
    pixels = 20 + places * [COLUMNS - 40, ROWS - 40]
    x = image_to_probe()
    for pose, (u, v) in zip(poses, pixels, strict=True):
        pose[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.45, 3)).as_matrix()
        point = [SPACING_MM[0] * u, rng.normal(0, 0.1), SPACING_MM[1] * v, 1.0]
        pose[:3, 3] = TARGET_MM - pose[:3, :3] @ (x @ point)[:3]
    return poses, pixels


def frame(rng: np.random.Generator, pixel: np.ndarray | None) -> np.ndarray:
    """Log-compressed speckle, with a bright echo at a pixel."""
    noise = [gaussian_filter(rng.normal(size=(ROWS, COLUMNS)), (1.2, 2.0)) for _ in range(2)]
    field = (noise[0] + 1j * noise[1]) / np.hypot(np.std(noise[0]), np.std(noise[1]))
    if pixel is not None:
        rows, columns = np.indices(field.shape)
        away = ((rows - pixel[1]) / 1.2) ** 2 + ((columns - pixel[0]) / 2.0) ** 2
        field += 30 * np.exp(-0.5 * away)
    decibels = 20 * np.log10(np.abs(field) + 1e-6)
    return np.clip(255 * (decibels + 20) / 60, 0, 255).astype(np.uint8)


def stream(asked: dict):
    """(stamp, frame, transforms) for ever: hold, travel, hold, ...

    Args:
        asked: ``poses``: how many there are; ``seed``; ``first``: the pose to begin at; ``order``:
            poses in the order in which they are held; ``lost``: poses at which the probe is out of
            view; ``hidden``: poses at which nothing is in the image; ``led``: hold each pose until
            the person who sees its frames, whose first pixel counts the poses, has said so;
            ``seen``: the count that was said last.
    """
    rng = np.random.default_rng(7)
    poses, pixels = holds(asked.get("poses", 9), asked.get("seed", 1))
    order = asked.get("order") or list(range(asked.get("first", 0), len(poses)))
    empty = frame(rng, None)
    reference = np.eye(4)
    reference[:3, :3] = Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix()
    reference[:3, 3] = [-300.0, 100.0, -1500.0]
    stamp = START_S + asked.get("seed", 1)
    count = asked.get("seen", 0)
    while True:
        for step, index in enumerate(order):
            count += 1
            hidden = index in asked.get("hidden", ())
            shown = empty.copy() if hidden else frame(rng, pixels[index])
            shown[0, 0] = count % 256
            following = poses[order[(step + 1) % len(order)]]
            number = -1
            while number < HOLD + TRAVEL - 1:
                if number != HOLD - 1 or not asked.get("led") or asked.get("seen", 0) >= count:
                    number += 1
                stamp += PERIOD_S
                # A hand is never quite at rest, and a head rests on the reference.
                reference[:3, 3] += rng.normal(0, 0.2, 3)
                pose = poses[index].copy()
                picture = shown
                if number >= HOLD:
                    part = (number - HOLD + 1) / (TRAVEL + 1)
                    pose[:3, 3] += part * (following[:3, 3] - pose[:3, 3]) + [20.0, 0, 0]
                    picture = empty
                pose[:3, 3] += rng.normal(0, 0.03, 3)
                status = "OUT_OF_VIEW" if index in asked.get("lost", ()) else "OK"
                yield (
                    stamp,
                    picture,
                    (
                        Tracked("ProbeToTracker", reference @ pose, status),
                        Tracked("ReferenceToTracker", reference.copy(), "OK"),
                        Tracked("StylusToTracker", np.eye(4), "MISSING"),
                    ),
                )


def messages(asked: dict):
    """The stream as bytes, frame by frame.

    Args:
        asked: as of :func:`stream`; ``mode``: ``tracked`` or ``separate`` messages; ``metres``:
            send translations in m; ``cut_after``: number of the frame from which on frames are
            smaller; ``deeper_after``: from which on their pixels are larger; ``back_after``: from
            which on the server's clock is an hour behind; ``frozen``: numbers of the first and the
            last frame that show the one before them; ``second``: name of a further device, whose
            images nothing shows.
    """
    number, shown = 0, None
    first, last = asked.get("frozen", (0, -1))
    for stamp, array, transforms in stream(asked):
        number += 1
        shown = array = shown if shown is not None and first <= number <= last else array
        spacing = (2.0, 2.0) if number > asked.get("deeper_after", number) else (1.0, 1.0)
        stamp -= 3600.0 if number > asked.get("back_after", number) else 0.0
        if number > asked.get("cut_after", number):
            array = array[:100, :140]
        if asked.get("metres"):
            for each in transforms:
                each.matrix[:3, 3] *= 1e-3
        if asked.get("mode") == "tracked":
            content = TrackedFrame(Picture(array, spacing), transforms)
            yield encode(Message("TRACKEDFRAME", "TrackedFrame", stamp, content, number))
            continue
        # The image first, as PlusServer sends them where its configuration names IMAGE first.
        parts = [
            encode(Message("IMAGE", "Image_Reference", stamp, Picture(array, spacing), number))
        ]
        if asked.get("second"):
            picture = Picture(np.zeros_like(array), spacing)
            parts.append(encode(Message("IMAGE", asked["second"], stamp, picture, number)))
        parts += [encode(Message("TRANSFORM", t.name, stamp, (t,), number)) for t in transforms]
        yield b"".join(parts)


def main() -> None:
    """Serve what is asked for until standard input ends, and take the poses that were seen."""
    served = {}
    for line in sys.stdin:
        told = json.loads(line)
        if "seen" in told:
            served[told["port"]]["seen"] = told["seen"]
            continue
        listener = socket.create_server(("127.0.0.1", 0))
        port = listener.getsockname()[1]
        served[port] = told["asked"]
        threading.Thread(target=serve, args=(listener, served[port]), daemon=True).start()
        print(json.dumps({"port": port}), flush=True)


def serve(listener: socket.socket, asked: dict) -> None:
    while True:
        client, _ = listener.accept()
        try:
            for index, message in enumerate(messages(asked)):
                client.sendall(message)
                time.sleep(1 / asked.get("rate_hz", 120.0))
                if index == asked.get("dies_after"):
                    client.close()
                    break
        except OSError:
            pass


if __name__ == "__main__":
    main()
