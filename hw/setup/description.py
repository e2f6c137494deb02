"""One bench as a person describes it: where its devices are, what is known of probe and target.

A TOML file, units in the names; a key that is not known is refused. ``example_setup.toml`` beside
this module has every table and key with a comment; ``jaxcal-hw setup`` writes it.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from hw.active_echo.codec import MAXIMUM_LINES
from hw.midplane.search import MOST_FRAMES, Settings
from hw.planning.poses import Extent
from hw.planning.scene import Scene
from hw.robot.kinematics import model_named
from hw.robot.limits import CALLER_S, FURTHEST_TIP_MM, Limits, hull_of, numbers
from hw.runtime.clock import REAL, Clock
from hw.runtime.errors import RefusedError, refused
from hw.runtime.hosts import check_host
from jaxcal import InputError
from jaxcal.data.poses import check_poses
from jaxcal.data.probe import LinearProbe
from jaxcal.io.given_files import naming
from jaxcal.io.openigtlink import PORT
from jaxcal.io.toml import load_toml
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import quoted

_LARGEST_BYTES = 2**18
_LEAST_TIP_MM = 5.0
_TARGET_MM = (50.0, 2000.0)
"""Distance of a target from the base: not inside the base, and not beyond the reach of any arm."""
_WIDTH_MM = (2.0, 300.0)
"""Width of an array."""
_HOUSING_MM = (25.0, 60.0)
"""Thickness and length of a housing where the setup gives none: those of a common linear probe."""
_LONGEST_OFFSET_M = 1.0
_LONGEST_SETTLE_S = 30.0
"""Given in ms, the robot would rest for minutes at every pose."""
_LEAST_POSES_HZ = 20.0
"""Until the next pose comes the newest one may be two periods old, with the bound of its latency:
at fewer a second each would become older than 0.1 s, and the robot would stop."""
_MOST_POSES_HZ = 1000.0
"""Twice as many as a controller sends."""
_TIP_TOLERANCE_MM = 0.1
_Made = TypeVar("_Made")


@dataclass(frozen=True)
class Setup:
    """Where the devices are and what is known beforehand.

    Attributes:
        robot_host: name or address of the controller.
        active_echo_url: serial port, pty or ``socket://host:port``.
        ultrasound: (host, port) of the OpenIGTLink server; None: no images.
        scene: probe and target as drawn.
        limits: fields of :class:`hw.robot.limits.Limits`, by name; those that follow from the scene
            and the probe are added by :meth:`motion_limits`.
        probe: the transducer.
        extent: what the plan covers.
        search: steps and stated accuracies of the placement.
        clock: of the bench.
        frequency_hz: of the poses; None: the controller's own.
        tcp_offset: (6,) m and rad, of a controller that does not tell it.
        settle_s: how long poses are averaged, s.
        caller_s: bench seconds that this process may be silent while the robot moves.
        frames: active-echo frames of an image.
        model: of the arm, by name; None: what the controller says.
        housing_mm: width, thickness and length of the probe's housing; None: the array's width, 25
            and 60 mm.
        source: the file that it was read from, for messages.
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
    caller_s: float = CALLER_S
    frames: int = 9
    model: str | None = None
    housing_mm: tuple[float, float, float] | None = None
    source: str = "TOML"

    def motion_limits(self, controller_model: str | None = None) -> Limits:
        """What bounds every motion of this bench.

        Args:
            controller_model: of the arm, as the controller tells it (:func:`controller_arm`).

        Raises:
            RefusedError: invalid limits, limits that contradict the scene, or a controller of
                another arm than the setup's.
        """
        tip = self.scene.tip_mm
        given = self.limits.get("tip_mm")
        if given is not None and not np.allclose(
            numbers(given, 3, "tip_mm"), tip, rtol=0.0, atol=_TIP_TOLERANCE_MM
        ):
            raise refused(
                f"tip_mm {given} contradicts [scene] image_to_probe, whose tip is "
                f"{np.round(tip, 3).tolist()} mm: leave tip_mm out"
            )
        model = self.model or self.limits.get("arm_model") or controller_model or ""
        if model and controller_model and model_named(model).name != controller_model:
            raise refused(
                f"the setup is for a {model}, but the controller is that of a {controller_model}"
            )
        housing = self.housing_mm or (self.probe.width_mm, *_HOUSING_MM)
        hull = hull_of(self.scene.image_to_probe, *housing)
        arm = {"arm_model": model} if model else {}
        return Limits.from_mapping({"hull_mm": hull, **self.limits, "tip_mm": tip.tolist(), **arm})


@dataclass(frozen=True)
class HandHeldSetup:
    """An active echo element and a probe that a person holds.

    Attributes:
        active_echo_url: serial port, pty or ``socket://host:port``.
        probe: the transducer.
        image_to_probe: (4, 4) X as drawn or measured with a ruler, mm: image frame to the tracked
            frame on the probe.
        search: stated accuracies, and the threshold of the response.
        source: the file that it was read from, for messages.
    """

    active_echo_url: str
    image_to_probe: Float[np.ndarray, "4 4"]
    probe: LinearProbe = field(default_factory=LinearProbe)
    search: Settings = field(default_factory=Settings)
    source: str = "TOML"


def load_hand_held(path: str | os.PathLike[str]) -> HandHeldSetup:
    """Read the description of a bench without a robot: [active_echo], [probe], [scene], [search].

    Of [scene] only ``image_to_probe`` is needed, to the tracked frame on the probe.

    Raises:
        FormatError: no such file, or not TOML; one line that starts with the path.
        InputError: unknown or missing keys, or invalid numbers; one line that starts with the path.
    """
    tables = load_toml(path, maximum_bytes=_LARGEST_BYTES)
    names = ("active_echo", "probe", "scene", "search")
    with naming(path):
        found = _checked(tables, names, active_echo=("url",), scene=("image_to_probe",))
        found["probe"].pop("housing_mm", None)
        drawn = _drawn(found["scene"]["image_to_probe"])
        probe = _made("probe", LinearProbe, found["probe"])
        _check_width(probe)
        return HandHeldSetup(
            found["active_echo"]["url"],
            check_poses(drawn[None])[0],
            probe,
            _made("search", Settings, found["search"]),
            os.fspath(path),
        )


def controller_arm(model: str, version: str) -> str | None:
    """The arm that a controller says it moves; None where that arm is not known.

    Args:
        model: the dashboard's answer to ``get robot model``, which has no "e" for e-Series arms.
        version: of PolyScope; e-Series controllers run version 5 and later.
    """
    name = model.strip()
    newer = version.split(".")[0].isdigit() and int(version.split(".")[0]) >= 5
    for candidate in ([f"{name}e"] if newer else []) + [name]:
        try:
            return model_named(candidate).name
        except RefusedError:
            continue
    return None


def load_setup(path: str | os.PathLike[str]) -> Setup:
    """Read a bench's description.

    Raises:
        FormatError: no such file, or not TOML; one line that starts with the path.
        InputError: unknown or missing keys, invalid numbers, or limits that do not bound every
            motion; one line that starts with the path.
    """
    tables = load_toml(path, maximum_bytes=_LARGEST_BYTES)
    with naming(path):
        setup = _setup(tables)
        try:
            limits = setup.motion_limits()
        except RefusedError as error:
            raise InputError(f"[limits] {error.args[0]}") from None
        reach = _reach_mm("reach_mm" in tables.get("search", {}), setup.search, limits)
        search = replace(setup.search, reach_mm=reach)
        return replace(setup, search=search, source=os.fspath(path))


def _reach_mm(given: bool, search: Settings, limits: Limits) -> float:
    """How far the search may go: as far as the limits allow, unless the setup says less."""
    allowed = limits.search_mm
    if given and search.reach_mm > allowed:
        raise InputError(
            f"[search] reach_mm is {search.reach_mm:g}, but [limits] search_mm allows only "
            f"{allowed:g}: such moves would be refused at the robot"
        )
    if allowed <= search.backlash_mm:
        raise InputError(
            f"[limits] search_mm of {allowed:g} leaves no room for the search, which comes to "
            f"every place from [search] backlash_mm = {search.backlash_mm:g} below"
        )
    return min(search.reach_mm, allowed)


_PLAN_SHAPES = {"depth_mm": (2,), "reach_mm": (2,), "box_mm": (2, 3)}

_TABLES = {
    "robot": {
        "host": str,
        "frequency_hz": float,
        "settle_s": float,
        "tcp_offset": list,
        "model": str,
    },
    "active_echo": {"url": str, "frames": int},
    "ultrasound": {"host": str, "port": int},
    "probe": {
        "elements": int,
        "pitch_mm": float,
        "sound_speed_m_s": float,
        "delay_s": float,
        "housing_mm": list,
    },
    "scene": {"image_to_probe": list, "point_mm": list, "looking": list, "tip_at_tcp": bool},
    "limits": None,
    "plan": {f.name: list if f.name in _PLAN_SHAPES else float for f in dataclasses.fields(Extent)},
    "search": {
        f.name: int if isinstance(f.default, int) else float for f in dataclasses.fields(Settings)
    },
}


def _setup(tables: dict[str, Any]) -> Setup:
    found = _checked(
        tables,
        _TABLES,
        robot=("host",),
        active_echo=("url",),
        scene=("image_to_probe", "point_mm", "looking"),
    )
    scene = found["scene"]
    ultrasound = _ultrasound(found["ultrasound"])
    if not found["limits"]:
        raise InputError("[limits] is missing: without it nothing may move")
    if not found["limits"].get("hull_mm", True):
        raise InputError("[limits] hull_mm must have corners: without it, it is the housing's")
    robot = _robot(found["robot"])
    housing = found["probe"].pop("housing_mm", None)
    if housing is not None:
        housing = tuple(_numbers("housing_mm", housing, (3,), "probe").tolist())
        if not all(1.0 <= value <= FURTHEST_TIP_MM for value in housing):
            raise InputError(f"[probe] housing_mm must be 1 to {FURTHEST_TIP_MM:g} mm each")
    echo = found["active_echo"]
    frames = echo.get("frames", Setup.frames)
    if not 1 <= frames <= MOST_FRAMES:
        raise InputError(f"[active_echo] frames must be 1 to {MOST_FRAMES}")
    plan = {
        key: _as_tuple(_numbers(key, value, _PLAN_SHAPES[key], "plan").tolist())
        if key in _PLAN_SHAPES
        else value
        for key, value in found["plan"].items()
    }
    setup = Setup(
        active_echo_url=echo["url"],
        frames=frames,
        ultrasound=ultrasound,
        scene=Scene(
            _drawn(scene["image_to_probe"]),
            _numbers("point_mm", scene["point_mm"], (3,)),
            _numbers("looking", scene["looking"], (3,)),
        ),
        limits=found["limits"],
        probe=_made("probe", LinearProbe, found["probe"]),
        extent=_made("plan", Extent, plan),
        search=_made("search", Settings, found["search"]),
        housing_mm=housing,
        **robot,
    )
    if not np.linalg.norm(setup.scene.looking) > 0:
        raise InputError("[scene] looking is a direction: it cannot be all zero")
    _check_lengths(setup, scene.get("tip_at_tcp", False))
    return setup


def _ultrasound(table: dict[str, Any]) -> tuple[str, int] | None:
    """Host and port of the machine; None where none is described."""
    if not table:
        return None
    if "host" not in table:
        raise InputError("[ultrasound] needs host")
    host, port = table["host"], table.get("port", PORT)
    check_host(host, "[ultrasound] host")
    if not 1 <= port <= 65535:
        raise InputError("[ultrasound] port must be 1 to 65535")
    return host, port


def _robot(table: dict[str, Any]) -> dict[str, Any]:
    """What a setup takes of the robot's table, by the names that it has there."""
    check_host(table["host"], "[robot] host")
    robot = {{"host": "robot_host"}.get(key, key): value for key, value in table.items()}
    if not 0 < robot.get("settle_s", Setup.settle_s) <= _LONGEST_SETTLE_S:
        raise InputError(f"[robot] settle_s must be positive and at most {_LONGEST_SETTLE_S:g}")
    if not _LEAST_POSES_HZ <= robot.get("frequency_hz", _MOST_POSES_HZ) <= _MOST_POSES_HZ:
        raise InputError(
            f"[robot] frequency_hz must be {_LEAST_POSES_HZ:g} to {_MOST_POSES_HZ:g} poses a second"
        )
    if "tcp_offset" in robot:
        offset = _numbers("tcp_offset", robot["tcp_offset"], (6,), "robot")
        if np.linalg.norm(offset[:3]) > _LONGEST_OFFSET_M:
            raise InputError(
                f"[robot] tcp_offset is {np.linalg.norm(offset[:3]):g} m long: is it in mm? It is "
                "in m and rad, as at the pendant"
            )
        if np.linalg.norm(offset[3:]) > 2 * np.pi:
            raise InputError(
                f"[robot] tcp_offset turns by {np.linalg.norm(offset[3:]):g} rad, more than a full "
                "turn: is it in degrees? It is in m and rad, as at the pendant"
            )
        robot["tcp_offset"] = tuple(offset.tolist())
    if "model" in robot:
        robot["model"] = _arm_name(robot["model"])
    return robot


def _check_lengths(setup: Setup, tip_at_tcp: bool) -> None:
    """Refuse lengths that are not plausible in mm: with a wrong tip the box would bound nothing."""
    tip = float(np.linalg.norm(setup.scene.tip_mm))
    if tip < _LEAST_TIP_MM and not tip_at_tcp:
        raise InputError(
            f"[scene] image_to_probe puts the probe's tip {tip:g} mm from the TCP: are its lengths "
            "in metres? They are in mm. Where the controller's TCP is the tip itself, add "
            "tip_at_tcp = true"
        )
    if tip > FURTHEST_TIP_MM:
        raise InputError(
            f"[scene] image_to_probe puts the probe's tip {tip:g} mm from the TCP, over "
            f"{FURTHEST_TIP_MM:g} mm: its lengths are in mm"
        )
    away = float(np.linalg.norm(setup.scene.point_mm))
    if not _TARGET_MM[0] <= away <= _TARGET_MM[1]:
        raise InputError(
            f"[scene] point_mm is {away:g} mm from the robot's base: it is in mm, "
            f"{_TARGET_MM[0]:g} to {_TARGET_MM[1]:g} away"
        )
    _check_width(setup.probe)


def _check_width(probe: LinearProbe) -> None:
    if probe.elements > MAXIMUM_LINES:
        raise InputError(
            f"[probe] elements must be at most {MAXIMUM_LINES}, the most lines of an active-echo "
            f"frame, not {probe.elements}"
        )
    width = probe.width_mm
    if not _WIDTH_MM[0] <= width <= _WIDTH_MM[1]:
        raise InputError(
            f"[probe] elements and pitch_mm make an array {width:g} mm wide: pitch_mm is in mm, "
            f"and the array {_WIDTH_MM[0]:g} to {_WIDTH_MM[1]:g} mm wide"
        )


def _arm_name(name: str) -> str:
    try:
        return model_named(name).name
    except RefusedError as error:
        raise InputError(f"[robot] model: {error.args[0]}") from None


def _checked(
    tables: dict[str, Any], names: Collection[str], **needed: tuple[str, ...]
) -> dict[str, dict[str, Any]]:
    """All tables by their names; an unknown one, or a missing key, is refused."""
    found = {name: _table(tables, name) for name in names}
    for name in tables:
        if name not in names:
            raise InputError(f"[{quoted(name)}] is not known; there are {', '.join(names)}")
    for name, keys in needed.items():
        for key in keys:
            if key not in found[name]:
                raise InputError(f"[{name}] needs {key}")
    return found


def _made(table: str, kind: Callable[..., _Made], values: dict[str, Any]) -> _Made:
    """What a table describes; where it cannot be, its name stands before the error."""
    try:
        return kind(**values)
    except InputError as error:
        raise InputError(f"[{table}] {error}") from None


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
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            wanted = {
                str: "text",
                int: "a whole number",
                float: "a number",
                list: "a list",
                bool: "true or false",
            }[kind]
            raise InputError(f"[{name}] {key} must be {wanted}")
        checked[key] = value
    return checked


def _numbers(name: str, value: Any, shape: tuple[int, ...], table: str = "scene") -> np.ndarray:
    try:
        array = np.array(value, dtype=object)
        # Neither text nor true or false, which numpy would take for numbers.
        if array.shape != shape or not all(type(leaf) in (int, float) for leaf in array.flat):
            raise ValueError
        array = array.astype(float)
        if not np.isfinite(array).all():
            raise ValueError
    except (ValueError, OverflowError):
        size = " x ".join(map(str, shape))
        raise InputError(f"[{table}] {name} must be {size} numbers") from None
    return array


def _as_tuple(value: Any) -> Any:
    return tuple(_as_tuple(item) for item in value) if isinstance(value, list) else value


def _drawn(value: Any) -> np.ndarray:
    """X as it stands in the file: (4, 4) mm, rigid up to rounding."""
    drawn = _numbers("image_to_probe", value, (4, 4))
    check_poses(drawn[None], what="[scene]", labels=["image_to_probe"])
    return drawn
