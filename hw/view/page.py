"""What the page shows: arm, box, image plane, target, poses, and the running estimate in words.

Places are in the robot's base frame; one unit of the scene is 100 mm. The arm is drawn with the
joints that the controller sends with the pose or, where it sends none, with joints that bring the
flange to the pose (:mod:`hw.robot.kinematics`).
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from hw.planning.poses import box_edges
from hw.robot.kinematics import (
    MODELS,
    ArmModel,
    flange_of,
    inverse,
    link_frames,
    model_named,
    nearest,
)
from hw.runtime.rigid import looking_rotation
from jaxcal.data.poses import quaternions_from_rotations
from jaxcal.runtime.array_types import Float, UInt8

UNIT_MM = 100.0
_CHI_95 = 7.8147
"""95 % point of chi squared with three degrees of freedom."""
_SHOWN_MM = 4.0
"""The target's ellipsoid is enlarged by powers of ten until its largest half axis is this long."""
_MOST_MAGNIFIED = 1000
_UNKNOWN_MM = 50.0
_LABEL_MM = 70.0
# Poses that differ by less (mm, or in a rotation matrix) look the same.
_MOVED = 1e-4
_PANEL_EVERY = 3
"""Every third frame goes into the panel too; compressing pictures is the page's main cost."""
_PANEL_ROWS, _PANEL_COLUMNS = 240, 320
_GREY, _ARM, _DONE, _NOW, _MISSED = (
    (150, 150, 150),
    (120, 140, 165),
    (0, 120, 40),
    (240, 110, 0),
    (200, 0, 0),
)
_TARGET = (200, 0, 120)
_LINK_RADIUS_MM = (45.0, 38.0, 30.0, 26.0, 26.0, 24.0, 12.0, 8.0)
_LEGEND = (
    "<small>green: poses done · grey: to come · **orange: now** · red: given up · blue: box for "
    "the probe (tip and housing) · magenta: target</small>"
)


def quaternion(rotation: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 4"]:
    """Unit quaternions (w, x, y, z) of rotation matrices."""
    return np.roll(quaternions_from_rotations(rotation), 1, axis=-1)


def ellipsoid(
    covariance: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"], int]:
    """Half axes (mm) of the 95 % ellipsoid as drawn, its axes, and how much larger it is drawn."""
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    half = np.sqrt(_CHI_95 * np.maximum(variances, 0.0))
    magnified = 1
    while half.max() * magnified < _SHOWN_MM and magnified < _MOST_MAGNIFIED:
        magnified *= 10
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return np.maximum(half * magnified, 0.2), axes, magnified


def to_scale(
    frame: UInt8[np.ndarray, "r c"], spacing_mm: tuple[float, float]
) -> UInt8[np.ndarray, "rows columns 3"]:
    """A frame in the middle of a panel's picture; a mm has the same length across and down."""
    across, down = (size * step for size, step in zip(frame.shape[::-1], spacing_mm, strict=True))
    scale = max(across / _PANEL_COLUMNS, down / _PANEL_ROWS)
    columns, rows = max(round(across / scale), 1), max(round(down / scale), 1)
    picked = frame[np.arange(rows) * frame.shape[0] // rows]
    picked = picked[:, np.arange(columns) * frame.shape[1] // columns]
    canvas = np.full((_PANEL_ROWS, _PANEL_COLUMNS, 3), 255, np.uint8)
    top, left = (_PANEL_ROWS - rows) // 2, (_PANEL_COLUMNS - columns) // 2
    canvas[top : top + rows, left : left + columns] = picked[:, :, None]
    return canvas


class Page:
    """The page of one server.

    Args:
        server: a ``viser.ViserServer``.
    """

    def __init__(self, server: Any) -> None:
        self._server, self._scene = server, server.scene
        self._told: dict[str, Any] = {}
        self._joints: np.ndarray | None = None
        self._drawn, self._lengths = np.zeros((4, 4)), np.zeros(0)
        self._pose: np.ndarray | None = None
        self._frame: np.ndarray | None = None
        self._spacing = (0.1, 0.1)
        server.gui.configure_theme(
            control_layout="fixed", control_width="large", show_logo=False, show_share_button=False
        )
        # Shadows and reflections are slow where there is no graphics processor.
        server.scene.configure_default_lights(cast_shadow=False)
        server.scene.configure_environment_map(hdri=None)
        server.scene.add_light_ambient("/light", intensity=2.5)
        server.gui.set_panel_label("jaxcal: acquisition")
        self._state = server.gui.add_markdown("Waiting for the plan.", order=0)
        self._picture: Any = None
        self._pictures = 0
        self._text = server.gui.add_markdown("", order=2)
        server.gui.add_markdown(_LEGEND, order=3)
        self._parts: dict[str, Any] = {}

    def show(self, told: dict[str, Any], frame: UInt8[np.ndarray, "r c"] | None) -> None:
        """Take a message of the feed, and redraw what it changes."""
        pose, spacing = told.pop("pose", None), told.pop("spacing", None)
        joints = told.pop("joints", None)
        trouble = told.pop("trouble", None)
        changed = bool(told) or trouble != self._told.get("trouble")
        self._told.update(told, trouble=trouble)
        with self._server.atomic():
            if "plan" in told:
                self._draw_plan()
            if "plan" not in self._told:
                return
            if told.keys() & {"plan", "done", "given_up", "row"}:
                self._draw_poses()
            if told.keys() & {"plan", "estimate"}:
                self._draw_target()
            if frame is not None and spacing is not None:
                self._frame, self._spacing = frame, tuple(spacing)
            moved = "estimate" in told
            if pose is not None:
                self._pose = np.vstack([np.reshape(pose, (3, 4)), [0, 0, 0, 1]])
                moved |= bool(np.abs(self._pose - self._drawn).max() > _MOVED)
            if moved and self._pose is not None:
                self._drawn = self._pose
                self._draw_arm(self._pose, joints)
            if moved or frame is not None:
                self._draw_image(frame is not None)
            if changed:
                self._state.content = state_words(self._told)
                self._text.content = estimate_words(self._told)

    # Once for a plan

    def _draw_plan(self) -> None:
        scene, told = self._scene, self._told
        for part in self._parts.values():
            part.remove()
        self._parts.clear()
        self._joints = self._frame = None
        self._drawn, self._lengths = np.zeros((4, 4)), np.zeros(0)
        low, high = box = np.array(told["box"]) / UNIT_MM
        middle = np.array(told["point"]) / UNIT_MM
        scene.add_grid(
            "/floor", width=12.0, height=12.0, cell_size=1.0, section_size=5.0, infinite_grid=False
        )
        self._parts["box"] = scene.add_line_segments(
            "/box", box_edges(box), (60, 110, 220), thickness=2.0, thickness_units="screen"
        )
        self._parts["box label"] = scene.add_label(
            "/box/label",
            "box for the probe",
            position=(high[0], low[1], high[2]),
            anchor="bottom-left",
        )
        camera = self._server.initial_camera
        # Look from beyond the target and from the side, so that the arm does not hide it.
        away = np.array([*middle[:2], 0.0]) / max(float(np.hypot(*middle[:2])), 1e-9)
        aside = np.cross(away, [0.0, 0.0, 1.0])
        camera.look_at = tuple(middle + np.array([0.0, 0.0, 1.0]) - 0.9 * away)
        camera.position = tuple(middle + 3.2 * away + 2.6 * aside + np.array([0.0, 0.0, 2.2]))
        camera.up = (0.0, 0.0, 1.0)
        arm = model_named(told["arm"]) if told["arm"] in MODELS else None
        for number, radius in enumerate(_LINK_RADIUS_MM):
            self._parts[f"link {number}"] = scene.add_cylinder(
                f"/arm/link{number}", radius=radius / UNIT_MM, height=1.0, color=_ARM, visible=False
            )
            self._parts[f"joint {number}"] = scene.add_icosphere(
                f"/arm/joint{number}",
                radius=1.15 * radius / UNIT_MM,
                color=_GREY,
                subdivisions=2,
                visible=False,
            )
        self._arm = arm

    def _draw_poses(self) -> None:
        """Draw a short stroke from each tip along the image's axial axis."""
        told = self._told
        poses = np.reshape(told["plan"], (-1, 3, 4))
        x = np.reshape(told["image_to_probe"], (4, 4))
        tips = poses[:, :, :3] @ x[:3, 3] + poses[:, :, 3]
        ends = tips + 15.0 * poses[:, :, :3] @ x[:3, 2]
        colours = np.tile(np.array(_GREY, np.uint8), (len(poses), 1))
        colours[told["done"]] = _DONE
        colours[told["given_up"]] = _MISSED
        if told.get("row") is not None:
            colours[told["row"]] = _NOW
        self._parts["poses"] = self._scene.add_line_segments(
            "/poses",
            np.stack([tips, ends], axis=1) / UNIT_MM,
            np.stack([colours] * 2, axis=1),
            thickness=4.0,
            thickness_units="screen",
        )

    def _draw_target(self) -> None:
        scene, told, estimate = self._scene, self._told, self._told.get("estimate")
        point, half, axes = np.array(told["point"]), np.full(3, 3.0), np.eye(3)
        text = "target, as the setup says"
        if estimate is not None:
            point = np.array(estimate["point"])
            text = "target, not determined yet"
            if estimate["point_covariance"] is not None:
                covariance = np.reshape(estimate["point_covariance"], (3, 3))
                half, axes, magnified = ellipsoid(covariance)
                text = "target, 95 % ellipsoid" + (f" x {magnified}" if magnified > 1 else "")
                if half.max() / magnified > _UNKNOWN_MM:
                    half, text = np.full(3, 3.0), "target, not determined yet"
        self._parts["target"] = scene.add_icosphere(
            "/target",
            radius=1.0,
            color=_TARGET,
            opacity=0.55,
            scale=tuple(half / UNIT_MM),
            wxyz=quaternion(axes),
            position=point / UNIT_MM,
            cast_shadow=False,
        )
        self._parts["target label"] = scene.add_label(
            "/target_label",
            text,
            position=(point - [0, 0, _LABEL_MM]) / UNIT_MM,
            anchor="top-center",
        )

    # At every message

    def _draw_arm(self, pose: Float[np.ndarray, "4 4"], measured: list[float] | None) -> None:
        told = self._told
        flange = flange_of(pose, tuple(told["tcp_offset"]))
        x = self._image_to_probe()
        tip = (pose @ x)[:3, 3]
        points = [np.zeros(3), flange[:3, 3], pose[:3, 3], tip]
        joints = None if measured is None else np.array(measured)
        if self._arm is not None and joints is None:
            joints = self._joints_for(self._arm, flange)
        if self._arm is not None and joints is not None:
            points = [*link_frames(self._arm, joints)[:, :3, 3], pose[:3, 3], tip]
        points = np.array(points)
        ways = np.diff(points, axis=0)
        lengths = np.linalg.norm(ways, axis=1)
        middles = (points[:-1] + 0.5 * ways) / UNIT_MM
        # Links shorter than a mm are not shown; any direction will do for them.
        directions = np.where(lengths[:, None] > 1.0, ways, [0.0, 0.0, 1.0])
        turns = quaternion(np.array([looking_rotation(way) for way in directions]))
        if len(lengths) != len(self._lengths) or np.abs(lengths - self._lengths).max() > 0.1:
            self._lengths = lengths
            for number in range(len(_LINK_RADIUS_MM)):
                link, joint = self._parts[f"link {number}"], self._parts[f"joint {number}"]
                length = float(lengths[number]) if number < len(lengths) else 0.0
                link.visible = joint.visible = length > 1.0
                link.scale = (1.0, 1.0, max(length, 1.0) / UNIT_MM)
        for number, (start, middle, turn) in enumerate(zip(points, middles, turns, strict=False)):
            link = self._parts[f"link {number}"]
            link.position, link.wxyz = middle, turn
            self._parts[f"joint {number}"].position = start / UNIT_MM

    def _joints_for(
        self, arm: ArmModel, flange: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, " 6"] | None:
        """Joints near the last ones drawn; at first those that keep the arm highest."""
        if self._joints is not None:
            found = nearest(arm, flange, self._joints)
        else:
            solutions = inverse(arm, flange)
            ways = solutions.joints[solutions.reached]
            lowest = [link_frames(arm, way)[2:, 2, 3].min() for way in ways]
            found = ways[int(np.argmax(lowest))] if len(ways) else None
        if found is not None:
            self._joints = found
        return found

    def _draw_image(self, fresh: bool) -> None:
        """Draw the newest frame as a textured plane, placed by the tracked probe and X."""
        if self._frame is None or self._pose is None:
            return
        rows, columns = self._frame.shape
        across, down = self._spacing
        x = self._pose @ self._image_to_probe()
        # The plane's first row is at its smallest y.
        rotation = np.stack([x[:3, 0], x[:3, 2], -x[:3, 1]], axis=1)
        middle = x[:3, 3] + 0.5 * rows * down * x[:3, 2]
        if "image" not in self._parts:
            rgb = np.repeat(self._frame[:, :, None], 3, axis=2)
            self._parts["image"] = self._scene.add_image(
                "/image",
                rgb,
                columns * across / UNIT_MM,
                rows * down / UNIT_MM,
                format="jpeg",
                jpeg_quality=70,
                cast_shadow=False,
                receive_shadow=False,
            )
            if self._picture is None:
                self._picture = self._server.gui.add_image(
                    to_scale(self._frame, self._spacing),
                    label="B-mode, newest frame",
                    format="jpeg",
                    jpeg_quality=70,
                    order=1,
                )
        elif fresh:
            rgb = np.repeat(self._frame[:, :, None], 3, axis=2)
            self._parts["image"].image = rgb
            self._pictures += 1
            if self._pictures % _PANEL_EVERY == 0:
                self._picture.image = to_scale(self._frame, self._spacing)
        plane = self._parts["image"]
        plane.wxyz, plane.position = quaternion(rotation), middle / UNIT_MM

    def _image_to_probe(self) -> Float[np.ndarray, "4 4"]:
        estimate = self._told.get("estimate")
        usable = estimate is not None and estimate["status"] == "converged"
        source = estimate if estimate is not None and usable else self._told
        return np.reshape(source["image_to_probe"], (4, 4)).astype(float)


def state_words(told: dict[str, Any]) -> str:
    """How far the acquisition is, as markdown."""
    total, done = told["images"], len(told["done"])
    first = f"**{done} of {total} images**"
    if told.get("row") is not None and done < total:
        first += f", now pose {told['row'] + 1}"
    if told["given_up"]:
        first += f", {len(told['given_up'])} given up"
    lines = [first]
    if told.get("trouble"):
        lines.append(f"**{_as_it_is(told['trouble'])}**")
    if told.get("stop") is not None:
        offset, amplitude, threshold = told["stop"]
        lines.append(f"search: {offset:+.2f} mm, amplitude {amplitude:.0f}, threshold {threshold}")
    if told.get("bracket") is not None:
        centre, low, high = told["bracket"]
        lines.append(f"last offset: {centre:+.2f} mm in [{low:+.2f}, {high:+.2f}]")
    return "\n\n".join(lines)


def estimate_words(told: dict[str, Any]) -> str:
    """The running estimate and what was said last, as markdown."""
    lines = _estimate_words(told.get("estimate"))
    lines += [f"<small>{_as_it_is(line)}</small>" for line in told["said"][-2:]]
    return "\n\n".join(lines)


def _as_it_is(text: str) -> str:
    """Text in markdown: a browser would load what a device that is named ``![](http:...)`` says."""
    return re.sub(r"[^\w\s]|_", lambda sign: f"&#{ord(sign[0])};", text)


def _estimate_words(estimate: dict[str, Any] | None) -> list[str]:
    if estimate is None:
        return ["no estimate yet: it takes four images"]
    transform = np.reshape(estimate["image_to_probe"], (4, 4))
    point, covariance = estimate["point"], estimate["covariance"]
    rows = ["| running estimate | mm | SD (mm) |", "| --- | --- | --- |"]
    spread = ["?"] * 3
    if covariance is not None:
        # The covariance is in the image's axes, the origin's position in the probe's.
        rotation = transform[:3, :3]
        spread = _sds(rotation @ np.reshape(covariance, (6, 6))[:3, :3] @ rotation.T)
    for axis, value, sd in zip("xyz", transform[:3, 3], spread, strict=True):
        rows.append(f"| image's origin {axis} (probe) | {value:.2f} | {sd} |")
    spread = ["?"] * 3
    if estimate["point_covariance"] is not None:
        spread = _sds(np.reshape(estimate["point_covariance"], (3, 3)))
    for axis, value, sd in zip("xyz", point, spread, strict=True):
        rows.append(f"| target {axis} (base) | {value:.2f} | {sd} |")
    text = f"{estimate['status']}, RMS {estimate['rms']:.2f} mm"
    if covariance is not None:
        turns = np.degrees(np.sqrt(np.diag(np.reshape(covariance, (6, 6)))[3:]))
        text += ", rotation SD " + ", ".join(f"{turn:.2f}" for turn in turns) + " degrees"
    return ["\n".join(rows), text]


def _sds(covariance: Float[np.ndarray, "3 3"]) -> list[str]:
    return [f"{sd:.2f}" for sd in np.sqrt(np.diag(covariance))]
