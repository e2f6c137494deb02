"""Transforms for ROS: tf2's static publisher and easy_handeye's YAML. Metres, scalar last.

A transform here is the pose of a child frame in its parent, which is the matrix that takes the
child's coordinates to the parent's. For the image in the probe it is the calibration itself. It is
rigid, so coordinates in the image are in *metres*, not in pixels.

Source: tf2_ros static_transform_publisher; easy_handeye2.
"""

from __future__ import annotations

import json
import os
import re
from typing import Any

import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.poses import (
    check_poses,
    matrices_from_rotations,
    quaternions_from_rotations,
    rotations_from_quaternions,
)
from jaxcal.io.lines import text_lines
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import quoted

_KEYS = ("x", "y", "z", "qx", "qy", "qz", "qw")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_/]*")
_FARTHEST_M = 2.0
"""No image is farther from the probe's markers; in mm, only one within 2 mm would pass."""
_HELD = "# jaxcal: "
"""How the comment begins that holds, as a JSON object, what a rigid transform leaves out."""


def _seven(matrix: Float[np.ndarray, "4 4"]) -> dict[str, str]:
    """x, y, z in metres and the quaternion, with every digit."""
    pose = check_poses(np.asarray(matrix, float)[None], what="transform")[0]
    numbers = [*(pose[:3, 3] / 1e3), *quaternions_from_rotations(pose[None, :3, :3])[0]]
    return {key: _digits(float(value)) for key, value in zip(_KEYS, numbers, strict=True)}


def _digits(value: float) -> str:
    """All digits and a decimal point; without the point, YAML 1.1 reads 1e-05 as text."""
    text = repr(value + 0.0)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def _checked_name(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise InputError(
            f"{quoted(name)} cannot name a frame in ROS: letters, digits, _ and / are needed "
            "(another name: jaxcal export --probe-frame, --image-frame)"
        )
    return name


def static_transform_command(
    matrix: Float[np.ndarray, "4 4"], parent: str = "probe", child: str = "us_image"
) -> str:
    """The command that publishes a transform (rigid, mm, child -> parent), in one line.

    Raises:
        InputError: a matrix that is not rigid, or names that ROS does not take.
    """
    if parent == child:
        raise InputError(
            f"a transform leads from one frame to another, not from {parent} to {child}"
        )
    stated = " ".join(f"--{key} {value}" for key, value in _seven(matrix).items())
    return (
        f"ros2 run tf2_ros static_transform_publisher {stated} "
        f"--frame-id {_checked_name(parent)} --child-frame-id {_checked_name(child)}"
    )


def range_note(
    range_factor: float,
    face_offset_mm: float,
    scale_mm_per_px: Float[np.ndarray, " 2"] | None = None,
) -> str | None:
    """What a rigid transform leaves to its user, in words; None where z is the measured range.

    Args:
        range_factor: the estimated sound speed over the nominal one.
        face_offset_mm: range of pixel row 0, mm.
        scale_mm_per_px: [lateral, axial] of a pixel; None for points in mm.
    """
    steps = []
    if scale_mm_per_px is not None:
        lateral, axial = scale_mm_per_px / 1e3
        steps.append(f"multiply u by {lateral:.9g} m and v by {axial:.9g} m (a pixel's size)")
    if range_factor != 1:
        steps.append(f"multiply ranges by {range_factor:.9g} (the estimated sound speed)")
    if face_offset_mm != 0:
        steps.append(f"add {face_offset_mm / 1e3:.9g} m (the range of row 0)")
    return f"not in this rigid transform: {', then '.join(steps)}" if steps else None


def ros_yaml(
    matrix: Float[np.ndarray, "4 4"],
    parent: str = "probe",
    child: str = "us_image",
    note: str | None = None,
    held: dict[str, Any] | None = None,
) -> str:
    """The YAML of easy_handeye2 for a transform (rigid, mm, child -> parent).

    The command of tf2 and a note, as of :func:`range_note`, are comments above it; so is ``held``,
    which :func:`read_ros_yaml` returns.

    Raises:
        InputError: a matrix that is not rigid, or names that ROS does not take.
    """
    numbers = "".join(f"  {key}: {value}\n" for key, value in _seven(matrix).items())
    noted = "" if note is None else f"# {note}\n{_HELD}{json.dumps(held)}\n"
    return (
        f"# {child} in {parent}: metres, unit quaternion with the scalar last.\n"
        f"# axes of {child}: x lateral (along u), y elevational, z depth (along v)\n"
        f"{noted}"
        f"# {static_transform_command(matrix, parent, child)}\n"
        "parameters:\n"
        "  eye_on_hand: true\n"
        f"  robot_effector_frame: {parent}\n"
        f"  tracking_base_frame: {child}\n"
        "  freehand_robot_movement: true\n"
        f"transformation:\n{numbers}"
    )


def read_ros_yaml(path: str | os.PathLike[str]) -> tuple[Float[np.ndarray, "4 4"], dict[str, Any]]:
    """The rigid transform, mm, of a file as :func:`ros_yaml` or easy_handeye writes it.

    Only the seven numbers and our comment are looked for; nothing else of YAML is understood.

    Returns:
        The transform, and the object in our comment, not checked; empty without the comment.

    Raises:
        FormatError: one of the numbers missing, twice or not a number, no unit quaternion, a
            translation that is in mm, or a comment of ours that holds no JSON object.
    """
    name = os.fspath(path)
    found: dict[str, float] = {}
    held: dict[str, Any] | None = None
    for line, content in text_lines(path, comments=True):
        if content.startswith(_HELD):
            try:
                stated = json.loads(content.removeprefix(_HELD))
            except (ValueError, RecursionError):
                stated = None
            if held is not None or not isinstance(stated, dict):
                raise FormatError(
                    f"{name}:{line}: {quoted(_HELD.strip())} must stand once, with a JSON object"
                )
            held = stated
        match = re.fullmatch(r"\s*(x|y|z|qx|qy|qz|qw):\s*([^\s#]\S*)\s*(?:\s#.*)?", content)
        if match is None:
            continue
        key, text = match.groups()
        try:
            value = float(text)
        except ValueError:
            raise FormatError(f"{name}:{line}: {key} is not a number: {quoted(text)}") from None
        if key in found or not np.isfinite(value):
            raise FormatError(f"{name}:{line}: {key} is given twice, or is not finite")
        found[key] = value
    missing = [key for key in _KEYS if key not in found]
    if missing:
        raise FormatError(f"{name}: {', '.join(missing)} missing: not a transform of easy_handeye")
    numbers = np.array([[found[key] for key in _KEYS]])
    try:
        rotations = rotations_from_quaternions(numbers[:, 3:], "xyzw")
    except InputError as error:
        raise FormatError(f"{name}: {error}") from None
    matrix = matrices_from_rotations(rotations, 1e3 * numbers[:, :3])[0]
    far = float(np.linalg.norm(matrix[:3, 3])) / 1e3
    if far > _FARTHEST_M:
        raise FormatError(
            f"{name}: puts the image {far:.4g} m from the probe's frame: x, y and z look like mm; "
            "give them in metres"
        )
    return matrix, held or {}
