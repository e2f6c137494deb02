"""A picture of each phantom in the emulated tank, as the bench's camera draws it.

Rows: active echo element, cross-wire, hydrophone. Columns: a whole frame with the target in the
mid-plane of a good image; the part about the target; the same 1 mm beside the plane; and in the
plane of an image as in the paper's experiment 1 (fixed focus, multiple reflections, short delay
between lines). Circles: what ``jaxcal.data.segmentation.image`` finds; ticks at the borders: the
truth. Writes docs/images/phantoms.png. Seed 4; seconds.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import save_figure

from hw.bench.frames import DEPTH_MM, Camera
from hw.bench.tank import Look
from hw.bench.world import World, make_world
from hw.runtime.choices import PHANTOMS
from jaxcal.data.poses import rotations_from_vectors
from jaxcal.data.segmentation.image import Target, localise

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "phantoms.png"
LATERAL_MM, RANGE_MM = 6.0, 55.0
GOOD = Look(speckle_db=46.0, face=0.8)
POOR = Look(focus_mm=25.0, ghost=0.35, ghost_share=1.0, speckle_db=28.0, face=0.8)
COLUMNS = (
    ("in the mid-plane", 0.0, GOOD, False),
    ("about the target", 0.0, GOOD, True),
    ("1 mm beside the plane", 1.0, GOOD, True),
    ("in the plane, poor image", 0.0, POOR, True),
)
NEAR_MM = (9.0, 11.0)
"""Half width and half height of the part about the target."""


def placed(world: World, elevation_mm: float) -> np.ndarray:
    """A pose of the probe, turned a little, that has the target at its place in the image."""
    pose = np.eye(4)
    x = world.image_to_probe
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ rotations_from_vectors(np.array([0.2, 0.1, 0.3]))
    pose[:3, :3] = pose[:3, :3] @ x[:3, :3].T
    axial = float(np.sqrt(RANGE_MM**2 - elevation_mm**2))
    place = x[:3, :3] @ [LATERAL_MM, elevation_mm, axial] + x[:3, 3]
    pose[:3, 3] = world.point_mm - pose[:3, :3] @ place
    return pose


def main() -> None:
    """Draw the picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 12.5), layout="constrained")
    panels = figure.subplots(len(PHANTOMS), len(COLUMNS))
    for row, name in zip(panels, PHANTOMS, strict=True):
        world = make_world(0, phantom=name)
        target: Target = "cross" if name == "cross-wire" else "echo"
        for panel, (title, elevation, look, near) in zip(row, COLUMNS, strict=True):
            camera = Camera(world, look)
            frame = camera.frame(placed(world, elevation), np.random.default_rng(4))
            half = world.probe.width_mm / 2
            extent = (-half, half, DEPTH_MM, 0.0)
            panel.imshow(frame, cmap="gray", vmin=0, vmax=255, extent=extent)
            expected = camera.pixel(LATERAL_MM, RANGE_MM)
            found = localise(frame, target, near=expected, within_px=80.0)
            told = "found" if found.found[0] else found.reason[0].split(":")[0]
            panel.set_title(f"{name}, {title}:\n{told}", fontsize=9)
            if not near:
                panel.set(xlabel="lateral (mm)", ylabel="range (mm)")
                continue
            panel.set_xlim(LATERAL_MM - NEAR_MM[0], LATERAL_MM + NEAR_MM[0])
            panel.set_ylim(RANGE_MM + NEAR_MM[1], RANGE_MM - NEAR_MM[1])
            panel.set_xticks([LATERAL_MM], ["truth"])
            panel.set_yticks([RANGE_MM], ["truth"], rotation=90, va="center")
            if found.found[0]:
                u, v = found.position[0]
                across, down = camera.spacing_mm
                place = (u - camera.pixel(0.0, 0.0)[0]) * across, v * down
                panel.plot(*place, "o", ms=30, mfc="none", mec="C1")
    save_figure(figure, PICTURE, dpi=80)
    print(PICTURE)


if __name__ == "__main__":
    main()
