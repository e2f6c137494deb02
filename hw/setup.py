"""One bench as a person describes it: where its devices are, what is known of probe and target.

A TOML file, units in the names; a key that is not known is refused:

    [robot]
    host = "192.168.1.10"
    frequency_hz = 125              # optional: the controller's own rate otherwise
    tcp_offset = [0, 0, 0.12, 0, 0, 0]  # m, rad; only for controllers that do not tell it
    settle_s = 0.3                  # poses are averaged for so long after a move
    [active_echo]
    url = "/dev/ttyUSB0"
    [ultrasound]                    # optional
    host = "192.168.1.20"
    port = 18944
    [probe]
    elements = 128
    pitch_mm = 0.457
    sound_speed_m_s = 1490
    [scene]                         # as drawn or measured with a ruler
    image_to_probe = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 60], [0, 0, 0, 1]]
    point_mm = [350, -250, 80]
    looking = [0, 0, -1]
    [limits]                        # of hw.robot.safety; the box bounds the probe's tip
    [plan]                          # of hw.poses.Extent
    [search]                        # of hw.midplane.search.Settings
"""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hw.clock import REAL, Clock
from hw.midplane.search import Settings
from hw.poses import Extent
from hw.scene import Scene
from jaxcal.errors import InputError
from jaxcal.io.readable import quoted
from jaxcal.io.toml import load_toml
from jaxcal.probe import LinearProbe

_LARGEST_BYTES = 2**18


@dataclass(frozen=True)
class Setup:
    """Where the devices are and what is known beforehand.

    Attributes:
        robot_host: name or address of the controller.
        active_echo_url: serial port, pty or ``socket://host:port``.
        ultrasound: (host, port) of the OpenIGTLink server; None: no images.
        scene: probe and target as drawn.
        limits: tables of :class:`hw.robot.safety.Limits`, by name.
        probe: the transducer.
        extent: what the plan covers.
        search: steps and stated accuracies of the placement.
        clock: of the bench.
        frequency_hz: of the poses; None: the controller's own.
        tcp_offset: (6,) m and rad, of a controller that does not tell it.
        settle_s: poses are averaged for so long.
        caller_s: bench seconds that this process may be silent while the robot moves.
        frames: active-echo frames of an image.
    """

    robot_host: str
    active_echo_url: str
    scene: Scene
    limits: dict[str, Any]
    ultrasound: tuple[str, int] | None = None
    probe: LinearProbe = field(default_factory=LinearProbe)
    extent: Extent = field(default_factory=Extent)
    search: Settings = field(default_factory=Settings)
    clock: Clock = REAL
    frequency_hz: float | None = None
    tcp_offset: tuple[float, ...] | None = None
    settle_s: float = 0.3
    caller_s: float = 0.15
    frames: int = 9


def load_setup(path: str | os.PathLike[str]) -> Setup:
    """Read a bench's description.

    Raises:
        FormatError: no such file, or not TOML.
        InputError: unknown or missing keys, numbers that are none; like the other one line that
            starts with the path.
    """
    tables = load_toml(path, maximum_bytes=_LARGEST_BYTES)
    try:
        return _setup(tables)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


_TABLES = {
    "robot": {"host": str, "frequency_hz": float, "settle_s": float,
              "tcp_offset": list},
    "active_echo": {"url": str, "frames": int},
    "ultrasound": {"host": str, "port": int},
    "probe": {"elements": int, "pitch_mm": float, "sound_speed_m_s": float, "delay_s": float},
    "scene": {"image_to_probe": list, "point_mm": list, "looking": list},
    "limits": None,
    "plan": {f.name: list if f.name.endswith("_mm") and f.name != "lateral_mm" else float
             for f in dataclasses.fields(Extent)},
    "search": {f.name: int if isinstance(f.default, int) else float
               for f in dataclasses.fields(Settings)},
}  # fmt: skip


def _setup(tables: dict[str, Any]) -> Setup:
    found = {name: _table(tables, name) for name in _TABLES}
    for name in tables:
        if name not in _TABLES:
            raise InputError(f"[{quoted(name)}] is not known; there are {', '.join(_TABLES)}")
    for name, key in (("robot", "host"), ("active_echo", "url")):
        if key not in found[name]:
            raise InputError(f"[{name}] needs {key}")
    scene = found["scene"]
    for key in ("image_to_probe", "point_mm", "looking"):
        if key not in scene:
            raise InputError(f"[scene] needs {key}")
    ultrasound = None
    if found["ultrasound"]:
        if "host" not in found["ultrasound"]:
            raise InputError("[ultrasound] needs host")
        ultrasound = (found["ultrasound"]["host"], found["ultrasound"].get("port", 18944))
    if not found["limits"]:
        raise InputError("[limits] is missing: without it nothing may move")
    robot = {{"host": "robot_host"}.get(key, key): value for key, value in found["robot"].items()}
    for key in ("settle_s", "frequency_hz"):
        if key in robot and not (np.isfinite(robot[key]) and robot[key] > 0):
            raise InputError(f"[robot] {key} must be a positive number")
    if "tcp_offset" in robot:
        offset = _numbers("tcp_offset", robot["tcp_offset"], (6,), "robot")
        robot["tcp_offset"] = tuple(offset.tolist())
    echo = found["active_echo"]
    if not 1 <= echo.get("frames", 9) <= 1000:
        raise InputError("[active_echo] frames must be 1 to 1000")
    plan: dict[str, Any] = {key: _tuples(key, value) for key, value in found["plan"].items()}
    return Setup(
        active_echo_url=echo["url"],
        frames=echo.get("frames", 9),
        ultrasound=ultrasound,
        scene=Scene(
            _numbers("image_to_probe", scene["image_to_probe"], (4, 4)),
            _numbers("point_mm", scene["point_mm"], (3,)),
            _numbers("looking", scene["looking"], (3,)),
        ),
        limits=found["limits"],
        probe=LinearProbe(**found["probe"]),
        extent=Extent(**plan),
        search=Settings(**found["search"]),
        **robot,
    )


def _table(tables: dict[str, Any], name: str) -> dict[str, Any]:
    table = tables.get(name, {})
    if not isinstance(table, dict):
        raise InputError(f"{name} must be a table: [{name}]")
    kinds = _TABLES[name]
    if kinds is None:
        return table
    checked = {}
    for key, value in table.items():
        if key not in kinds:
            raise InputError(f"[{name}] has no {quoted(key)}; there are {', '.join(kinds)}")
        kind = kinds[key]
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind) or isinstance(value, bool):
            wanted = {str: "text", int: "a whole number", float: "a number", list: "a list"}[kind]
            raise InputError(f"[{name}] {key} must be {wanted}")
        checked[key] = value
    return checked


def _numbers(name: str, value: Any, shape: tuple[int, ...], table: str = "scene") -> np.ndarray:
    try:
        array = np.asarray(value, float)
    except (ValueError, TypeError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"[{table}] {name} must be numbers of shape {shape}")
    return array


def _tuples(name: str, value: Any) -> Any:
    """Lists of numbers as tuples of floats, at most two deep."""
    if not isinstance(value, list):
        return value
    rows = [_tuples(name, row) if isinstance(row, list) else row for row in value]
    numbers = [row for row in rows if not isinstance(row, tuple)]
    if any(isinstance(row, bool) or not isinstance(row, int | float) for row in numbers):
        raise InputError(f"[plan] {name} must be numbers")
    lengths = {"depth_mm": 2, "reach_mm": 2, "box_mm": 2}
    if len(rows) not in (lengths.get(name, 0), 3):
        raise InputError(f"[plan] {name} has {len(rows)} values")
    return tuple(row if isinstance(row, tuple) else float(row) for row in rows)
