"""Make the small recordings of the documentation: ``python docs/data/make.py``.

One simulated experiment: 40 images of a point target by a linear probe, offsets uniform within
1 mm, 0.3 mm of noise on every element's distance, pixels of 0.15 x 0.14 mm. It is written twice:
as a cross-wire text pair, and as a table with quaternions as a robot would log it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import jaxcal

HERE = Path(__file__).parent
SPACING_MM = (0.15, 0.14)
FIRST_COLUMN = 200.0
"""Pixel column of lateral position 0."""


def main() -> None:
    """Write the files beside this one."""
    protocol = jaxcal.Protocol(images=40, elevation_mm=1.0, noise_mm=0.3)
    images = jaxcal.simulate_recording(protocol, seed=23).calibration
    poses, points = np.asarray(images.poses), np.asarray(images.measurements)
    pixels = np.column_stack(
        [points[:, 0] / SPACING_MM[0] + FIRST_COLUMN, points[:, 1] / SPACING_MM[1]]
    )
    np.savetxt(HERE / "poses.txt", poses[:, :3].reshape(-1, 4), fmt="%.6f")
    np.savetxt(HERE / "points.txt", pixels, fmt="%.2f")
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    table = np.column_stack([np.arange(len(poses)) * 0.5, poses[:, :3, 3], quaternions, pixels])
    header = "time,x,y,z,qx,qy,qz,qw,u,v"
    formats = ["%.1f", *["%.4f"] * 3, *["%.8f"] * 4, *["%.2f"] * 2]
    np.savetxt(
        HERE / "recording.csv", table, fmt=formats, delimiter=",", header=header, comments=""
    )


if __name__ == "__main__":
    main()
