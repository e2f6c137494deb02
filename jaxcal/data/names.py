"""Names of units and orders of poses and pixels; the command line reads them, so import nothing."""

from typing import Literal

QuaternionOrder = Literal["xyzw", "wxyz"]
"""Whether the scalar comes last (ROS, Motive, scipy) or first (NDI)."""

LengthUnit = Literal["mm", "cm", "m", "in"]

Orientation = Literal["MF", "UF", "MN", "UN"]
"""Orientation of stored pixels. M or U: a row ends at the marked or the unmarked side. F or N: a
column ends far from or near to the transducer."""
