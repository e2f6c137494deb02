"""Names that a person chooses from; the command line reads them, so import nothing."""

from typing import Literal

QuaternionOrder = Literal["xyzw", "wxyz"]
"""Whether the scalar comes last (ROS, Motive, scipy) or first (NDI)."""

LengthUnit = Literal["mm", "cm", "m", "in"]

PointUnit = Literal["px", "mm"]
"""Unit of points in the image."""

Orientation = Literal["MF", "UF", "MN", "UN"]
"""Orientation of stored pixels. M or U: a row ends at the marked or the unmarked side. F or N: a
column ends far from or near to the transducer."""

Assignment = Literal["labels", "order"]
"""How points without a time or a frame's number are assigned to frames: by the frame's number at
the end of each point's label, or one for each frame in order."""

Target = Literal["echo", "cross"]
"""What to look for in frames: one bright spot, or a crossing of wires."""

SegmentationMethod = Literal["least-squares", "shortest"]
"""How times of flight become points: by a fit to those of all elements, or by the shortest one."""

NoiseScale = Literal["frame", "pooled"]
"""Whether the noise of times of flight is estimated for each frame, or is one for all."""

ProbeKind = Literal["linear", "curvilinear"]
