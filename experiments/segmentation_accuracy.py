"""Segmentation of times of flight: bias, covariance, missing and outlier lines, elevation.

10,000 frames a cell at 0.05, 0.5 and 2 mm of noise on every element's distance: linear array by
the shortest time of flight (Eqs. 2 and 3) and by least squares (Eq. 5), plain and robust, on
complete frames, with 20 % of the lines missing and with 10 % of outliers (half of them reflections
3 to 40 mm late, half the echoes of lines up to 20 elements away); curvilinear array (Eq. 6) with
elevations uniform to 1, 3, 5 and 15 mm. Reported: bias over SD, SD, mean normalised squared error
(2 for the linear array; 1 for a single unknown) and the growth of the error over complete frames.
Seed 20261121.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import arguments, machine, save_figure, write_table

from jaxcal.data.probe import C5_2, L14_5, Probe
from jaxcal.data.recording import make_images
from jaxcal.data.segmentation.segment import Segmentation, segment

SEED = 20261121
NOISES = (0.05, 0.5, 2.0)
ELEVATIONS = (1.0, 3.0, 5.0, 15.0)
MISSING, OUTLIERS = 0.2, 0.1
METHODS: tuple[tuple[str, dict], ...] = (
    ("shortest", {"method": "shortest"}),
    ("shortest, interpolated", {"method": "shortest", "interpolate": True}),
    ("least squares", {"robust": False}),
    ("least squares, robust", {"robust": True}),
)


def field(probe: Probe, frames: int, elevation: float, generator) -> np.ndarray:
    """Targets [lateral, elevational, axial], mm, uniform over the field of view."""
    depth, y = generator.uniform(10, 90, frames), elevation * generator.uniform(-1, 1, frames)
    if probe.kind == "linear":
        lateral, axial = generator.uniform(-29.25, 29.25, frames), depth
    else:
        angle = 0.9 * probe.half_angle_rad * generator.uniform(-1, 1, frames)
        lateral, axial = probe.polar_to_cartesian(angle, depth).T
    return np.stack([lateral, y, axial], axis=1)


def measure(probe: Probe, truth: np.ndarray, noise: float, generator) -> np.ndarray:
    exact = np.linalg.norm(truth[:, None] - probe.element_positions(), axis=-1)
    return exact + noise * generator.normal(size=exact.shape)


def spoil(distances: np.ndarray, data: str, generator) -> np.ndarray:
    """Distances with lines missing or wrong."""
    shape = distances.shape
    if data == "missing":
        return np.where(generator.random(shape) < MISSING, np.nan, distances)
    if data == "outliers":
        late = distances + generator.uniform(3, 40, shape)
        line = np.clip(np.arange(shape[1]) + generator.integers(-20, 21, shape), 0, shape[1] - 1)
        echo = np.take_along_axis(distances, line, axis=1)
        wrong = np.where(generator.random(shape) < 0.5, late, echo)
        return np.where(generator.random(shape) < OUTLIERS, wrong, distances)
    return distances


def segmented(probe: Probe, distances: np.ndarray, options: dict) -> Segmentation:
    poses = np.tile(np.eye(4), (len(distances), 1, 1))
    # The poses play no part; they only must not look like metres.
    poses[:, 0, 3] = np.linspace(-50, 50, len(distances))
    # A distance that noise made negative was never heard.
    times = probe.time_of_flight_s(np.where(distances > 0, distances, np.nan))
    return segment(make_images(poses, times, "time_of_flight"), probe, **options)


def squared_error(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error).mean())


def linear_rows(frames: int) -> list[list[object]]:
    rows: list[list[object]] = []
    for noise in NOISES:
        generator = np.random.default_rng([SEED, round(1000 * noise)])
        truth = field(L14_5, frames, 0.0, generator)
        clean = measure(L14_5, truth, noise, generator)
        sets = {data: spoil(clean, data, generator) for data in ("complete", "missing", "outliers")}
        for name, options in METHODS:
            complete = np.ones(2)
            for data, distances in sets.items():
                found = segmented(L14_5, distances, options)
                kept = found.images.mask
                error = (found.images.measurements - truth[:, [0, 2]])[kept]
                covariance = found.images.covariance
                rms = np.sqrt((error**2).mean(axis=0))
                complete = rms if data == "complete" else complete
                rows.append(
                    [name, data, noise, int(kept.sum()),
                     *(error.mean(axis=0) / error.std(axis=0)).tolist(),
                     *error.std(axis=0).tolist(), *rms.tolist(),
                     "" if covariance is None else squared_error(error, covariance[kept]),
                     *(rms / complete).tolist(),
                     float(found.missing[kept].mean()), float(found.rejected[kept].mean())]
                )  # fmt: skip
                print(*[f"{v:.4g}" if isinstance(v, float) else v for v in rows[-1]])
    return rows


def curvilinear_rows(frames: int) -> list[list[object]]:
    rows: list[list[object]] = []
    for noise in NOISES:
        for elevation in ELEVATIONS:
            for data in ("complete", "missing"):
                generator = np.random.default_rng([SEED, round(1000 * noise), round(elevation)])
                truth = field(C5_2, frames, elevation, generator)
                distances = spoil(measure(C5_2, truth, noise, generator), data, generator)
                found = segmented(C5_2, distances, {"robust": True})
                full, kept = found.out_of_plane, found.images.mask
                assert full is not None
                exact = np.stack([truth[:, 0], truth[:, 2], truth[:, 1] ** 2], axis=1)
                error, covariance = (full.position - exact)[kept], full.covariance[kept]
                square = error[:, 2] ** 2 / covariance[:, 2, 2]
                # In (lateral, axial, lateral^2 + axial^2 + y^2) the problem is all but linear.
                jacobian = np.tile(np.eye(3), (len(error), 1, 1))
                jacobian[:, 2, :2] = 2 * full.position[kept, :2]
                bent = error.copy()
                bent[:, 2] += (full.position[kept, :2] ** 2 - exact[kept, :2] ** 2).sum(axis=1)
                turned = jacobian @ covariance @ jacobian.swapaxes(1, 2)
                # Where the *true* square is large there is no selection by the noise itself.
                sd = np.sqrt(covariance[:, 2, 2])
                large = exact[kept, 2] > 6 * sd
                off = full.elevation[kept] - np.abs(truth[kept, 1])
                spread = sd / (2 * np.maximum(full.elevation[kept], 1e-9))
                many = large.sum() >= 100
                rows.append(
                    [noise, elevation, data, int(kept.sum()), *error.std(axis=0).tolist(),
                     float(error[:, 2].mean() / error[:, 2].std()), float(square.mean()),
                     squared_error(bent, turned), float((full.position[kept, 2] <= 0).mean()),
                     float(full.determined.sum() / kept.sum()), int(large.sum()),
                     float(off[large].mean() / off[large].std()) if many else "",
                     float(off[large].std()) if many else "",
                     float((off[large] ** 2 / spread[large] ** 2).mean()) if many else ""]
                )  # fmt: skip
                print(*[f"{v:.4g}" if isinstance(v, float) else v for v in rows[-1]])
    return rows


def main() -> None:
    quick, folder = arguments(__doc__)
    frames = 1000 if quick else 10_000
    linear, curved = linear_rows(frames), curvilinear_rows(frames)
    foot = [f"{frames} frames a row, seed {SEED}", machine()]
    write_table(
        folder / "segmentation_accuracy.csv",
        ["method", "data", "noise_mm", "frames", "bias_over_sd_lateral", "bias_over_sd_range",
         "sd_lateral_mm", "sd_range_mm", "rms_lateral_mm", "rms_range_mm",
         "mean_normalised_squared_error", "growth_lateral", "growth_range",
         "missing_lines_a_frame", "rejected_lines_a_frame"],
        [*linear, foot],
    )  # fmt: skip
    write_table(
        folder / "segmentation_accuracy_curvilinear.csv",
        ["noise_mm", "elevation_bound_mm", "data", "frames", "sd_lateral_mm", "sd_axial_mm",
         "sd_elevation_squared_mm2", "bias_over_sd_elevation_squared",
         "normalised_squared_error_elevation_squared", "normalised_squared_error_all_three",
         "share_not_positive", "share_determined", "frames_true_square_above_6_sd",
         "bias_over_sd_elevation", "sd_elevation_mm", "normalised_squared_error_elevation"],
        [*curved, foot],
    )  # fmt: skip
    plot(folder / "segmentation_accuracy.png", linear, curved)


def plot(path: Path, linear: list[list[object]], curved: list[list[object]]) -> None:
    """Error against noise, the covariance's verdict, and what is known of the elevation."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.8), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    styles = {"complete": "-", "missing": "--", "outliers": ":"}
    for index, (name, _) in enumerate(METHODS):
        for data, style in styles.items():
            rows = [row for row in linear if row[0] == name and row[1] == data]
            rms = [np.hypot(float(str(row[8])), float(str(row[9]))) for row in rows]
            left.loglog(NOISES, rms, style, marker="o", ms=3, color=f"C{index}",
                        label=name if data == "complete" else None)  # fmt: skip
            if name.startswith("least squares") and not (index == 2 and data == "outliers"):
                values = [float(str(row[10])) for row in rows]
                middle.semilogx(NOISES, values, style, marker="o", ms=3, color=f"C{index}",
                                label=f"{name.split(', ')[-1]}, {data}")  # fmt: skip
    left.set(xlabel="noise on each distance (mm)", ylabel="RMS error of the point (mm)",
             title="linear; -- 20 % missing, ··· 10 % outliers")  # fmt: skip
    middle.axhspan(1.9, 2.1, color="0.9")
    middle.set(xlabel="noise on each distance (mm)", ylabel="mean normalised squared error",
               title="linear: is the covariance right? (2)")  # fmt: skip
    for index, elevation in enumerate(ELEVATIONS):
        rows = [row for row in curved if row[1] == elevation and row[2] == "complete"]
        right.semilogx(NOISES, [float(str(row[11])) for row in rows], "-o", ms=3, color=f"C{index}",
                       label=f"|y| to {elevation:g} mm")  # fmt: skip
    right.set(xlabel="noise on each distance (mm)", ylabel="share of frames", ylim=(0, 1),
              title="curvilinear: |y| determined (3 SD)")  # fmt: skip
    for axes in (left, middle, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    save_figure(figure, path, dpi=150)


if __name__ == "__main__":
    main()
