"""A pose in words, for a person who holds the probe.

Directions are those of a person who holds the probe with its marker to the right and the beam away
from the hand. The marker is on the side to which the image's lateral axis points (the last element;
the marked side of PLUS). A tilt is named after the side to which the handle goes. In the image,
left is where the lateral position is smallest (u = 0 in pixels), and lower is deeper.
"""

from __future__ import annotations

import numpy as np

from jaxcal.data.poses import check_poses
from jaxcal.design.constraints import Constraints
from jaxcal.design.information import Model
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.given_values import check_made

_LEAST_TILT_DEG, _LEAST_TURN_DEG = 3.0, 5.0
_DIAGONAL = float(np.tan(np.radians(67.5)))
"""If one component is larger than the other by more than this factor, only it is named."""
_MIDDLE = 0.4
"""Places within this share of the region's half-width are in its middle."""


def pose_in_words(
    pose: Float[np.ndarray, "4 4"],
    constraints: Constraints,
    image_to_probe: Float[np.ndarray, "4 4"],
    point: Float[np.ndarray, " 3"],
) -> str:
    """How to hold the probe, from the middle orientation, and where the target should be.

    Args:
        pose: probe -> tracker, mm.
        constraints: with the middle orientation as reference.
        image_to_probe: X.
        point: the target, mm.

    Returns:
        e.g. "tilt 20 degrees towards the marker, target in the lower left corner".
    """
    pose = check_poses(np.asarray(pose)[None])
    check_made("constraints", constraints, Constraints, "jaxcal.design.Constraints")
    model = Model(image_to_probe, point)
    s1, s2, w1, w2, turn = constraints.coordinates(pose, model.image_to_probe, model.point)[0]
    parts = []
    tilt, turned = float(np.degrees(np.hypot(w1, w2))), float(np.degrees(turn))
    if tilt >= _LEAST_TILT_DEG:
        parts.append(f"tilt {_rounded(tilt)} degrees {_side(w1, w2)}")
    if abs(turned) >= _LEAST_TURN_DEG:
        sense = "clockwise" if turned > 0 else "counter-clockwise"
        parts.append(f"turn {_rounded(abs(turned))} degrees {sense}")
    if not parts:
        parts.append("hold it straight")
    return f"{', '.join(parts)}, target {_place(float(s1), float(s2))}"


def _rounded(angle_deg: float) -> int:
    return int(5 * round(angle_deg / 5))


def _side(w1: float, w2: float) -> str:
    """Where the handle goes, which is opposite to the beam.

    The beam leans by w2 along the lateral axis, which points to the marker, and by -w1 along the
    elevational one, which points to the person.
    """
    marker, person = -w2, w1
    along = "towards the marker" if marker > 0 else "away from the marker"
    across = "towards you" if person > 0 else "away from you"
    if abs(marker) > _DIAGONAL * abs(person):
        return along
    if abs(person) > _DIAGONAL * abs(marker):
        return across
    return f"{along} and {across}"


def _place(s1: float, s2: float) -> str:
    lateral = "left" if s1 < -_MIDDLE else "right" if s1 > _MIDDLE else ""
    depth = "upper" if s2 < -_MIDDLE else "lower" if s2 > _MIDDLE else ""
    if lateral and depth:
        return f"in the {depth} {lateral} corner"
    if lateral:
        return f"at the {lateral} edge"
    if depth:
        return f"in the middle of the {depth} part"
    return "in the middle of the image"
