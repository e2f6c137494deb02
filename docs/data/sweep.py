"""Simulate ``sweep.igs.mha`` in the current folder: 16 B-mode frames of a bead in speckle.

The probe is tracked in the frame of a reference; in two frames it was not seen.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

import jaxcal
from jaxcal.io.sequence_files import write_sequence

SHAPE, SPACING_MM = (300, 420), (0.15, 0.14)
POINT_SPREAD = (1.2, 2.2)
"""SD of the echo along rows and columns, px."""


def frame(rng: np.random.Generator, u: float, v: float) -> np.ndarray:
    """Speckle with one bright spot, log-compressed to 60 dB."""
    noise = [gaussian_filter(rng.normal(size=SHAPE), POINT_SPREAD) for _ in range(2)]
    field = (noise[0] + 1j * noise[1]) / np.hypot(np.std(noise[0]), np.std(noise[1]))
    rows, columns = np.indices(SHAPE)
    down, along = (rows - v) / POINT_SPREAD[0], (columns - u) / POINT_SPREAD[1]
    field += 25 * np.exp(-0.5 * (down**2 + along**2))
    decibels = 20 * np.log10(np.abs(field) + 1e-6)
    return np.clip(255 * (decibels + 20) / 60, 0, 255).astype(np.uint8)


def main() -> None:
    """Write the file."""
    rng = np.random.default_rng(3)
    protocol = jaxcal.Protocol(images=16, elevation_mm=0.5, noise_mm=0.1, depth_mm=(8.0, 38.0))
    images = jaxcal.simulate_recording(protocol, seed=4).calibration
    lateral, distance = np.asarray(images.measurements).T
    frames = [
        frame(rng, x / SPACING_MM[0] + SHAPE[1] / 2, r / SPACING_MM[1])
        for x, r in zip(lateral, distance, strict=True)
    ]
    pair = ("Probe", "Reference")
    seen = np.ones(len(frames), bool)
    seen[[3, 9]] = False
    write_sequence(
        "sweep.igs.mha",
        {pair: np.asarray(images.poses)},
        0.5 * np.arange(len(frames)),
        valid={pair: seen},
        images=frames,
    )


if __name__ == "__main__":
    main()
