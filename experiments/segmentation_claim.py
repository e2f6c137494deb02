"""Is automatic segmentation by time of flight as good as manual segmentation, as the paper says?

The claim (abstract, sections 3.2 and 4.2, Table 4; N = 60): calibrations from automatically and
from manually segmented active echo points reconstruct the hydrophone's points alike: 0.85 and
0.85 mm in experiment 3, 0.78 and 0.77 mm in experiment 4, 0.76 and 0.75 mm with out-of-plane
compensation.

Here the same simulated experiments (poses, offsets, test images) are segmented in turn

- exactly;
- by time of flight, the clock counting whole ticks of the one-way time at 100 or 20 MHz (15 or 75
  um) or without a clock, on top of Gaussian noise on each element's distance of 0.01 (7 ns), 0.05,
  0.5 or 2 mm: by the shortest time of flight (the paper's Eqs. 2 and 3) and by least squares on
  Eq. 5;
- by hand: Gaussian clicks, rounded to whole pixels of 0.15 mm (9 cm in 600 rows). SD 0.5, 1 (the
  cursor placement error assumed by Goldstein, Ultrasound Med. Biol. 26, 2000,
  doi:10.1016/S0301-5629(00)00249-0) and 2 px, and 0.35 mm lateral by 0.44 mm axial: what the
  self-tuned calibration finds on a public cross-wire recording of 54 hand-picked points. The last
  holds whatever else is wrong in the image plane, so it is an upper bound of what hands do;
- by computer on B-mode frames: a Gaussian point spread (SD 0.45 mm lateral, 0.18 mm axial) in fully
  developed speckle, 18 and 30 dB above it, 60 dB log-compressed to 8 bits.

Reconstruction precision (Eq. 8) of conventional and self-tuned joint calibration is judged on exact
in-plane test points, and, as the paper's was, on test points that were themselves picked by hand
(0.35 by 0.44 mm). Differences are paired; "equal" means that the 95 % interval of the mean
difference lies within +- 0.05 mm, a margin set beforehand.

Not simulated: the size of the active element (2 mm), wrong sound speed and delay, missing lines, a
user's habit of clicking off centre, a beam that narrows and widens with depth, other image quality.

Evidence (full run, see results/segmentation_claim.csv):
- Least squares on Eq. 5: the claim holds. Against clicks as measured its RP is equal (33 cells) or
  better (15) in all 48 cells of noise, clock, offsets and method. Against 1 px clicks it is equal
  or better up to 0.5 mm of noise on each distance, worse by 0.05 mm in 6 of the 12 cells at 2 mm.
- The clock hardly matters to it: 100 MHz changes no mean RP by more than 0.001 mm; 20 MHz none by
  more than 0.01 mm (joint at 0.01 mm of noise, 0.018 to 0.028 mm), 0.001 mm from 0.05 mm on.
- The shortest time of flight, which is what the paper's Eqs. 2 and 3 say: equal or better for
  timing noise of 0.01 mm; at 0.05 mm worse in 3 of 8 cells than 1 px clicks and in 1 of 8 than
  clicks as measured; from 0.5 mm on worse in every cell (conventional 0.50 to 1.30 mm against 0.10
  to 0.23 mm as measured by hand, joint 0.25 to 1.07 against 0.10 to 0.19 mm). The least of 128
  noisy distances is short by 0.9 mm at 0.5 mm of noise, and its element 3 mm off. There the claim
  does not hold.
- Test points picked by hand hide most of it: RP is then at least 0.56 mm however the calibration
  images were segmented, and every cell of least squares is "equal". Conventional calibration from
  clicks as measured and from times of flight (0.05 mm), 0.098 and 0.052 mm on exact test points,
  then differ by 0.007 mm: agreement within 0.01 mm at 0.75 to 0.85 mm, as in the paper's Table 4,
  does not show that two ways of segmenting are equally good.
- The computer on B-mode frames is equal to or better than both kinds of click in every cell, about
  like least squares with 0.05 to 0.2 mm of noise: user independence does not need times of flight.
  This is for a spot of known shape in ideal speckle; real echoes wander with the angle of
  incidence.

Seed 20261122; trial k is fold_in(root, k) for every way of segmenting.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import arguments, half_95, machine, problems_of, save_figure, write_table
from jaxtyping import Float

from jaxcal import Problem, Protocol, calibrate_batch, reconstruction_precision, simulate
from jaxcal.data.segmentation.image import localise
from jaxcal.data.segmentation.time_of_flight import fit_in_plane

SEED = 20261122
IMAGES = 60
"""As in the paper's Table 4."""
ELEVATIONS_MM = (0.5, 2.0)
NOISES_MM = (0.01, 0.05, 0.5, 2.0)
CLOCKS_MHZ = (None, 100.0, 20.0)
PIXEL_MM = 0.15
PICKED_MM = (0.347, 0.438)
"""Lateral and axial SD of hand-picked cross-wire points (joint, scales estimated)."""
CLICKS_MM = {
    "0.5 px": (0.5 * PIXEL_MM, 0.5 * PIXEL_MM),
    "1 px": (PIXEL_MM, PIXEL_MM),
    "2 px": (2 * PIXEL_MM, 2 * PIXEL_MM),
    "as measured": PICKED_MM,
}
CONTRASTS_DB = (30.0, 18.0)
POINT_SPREAD_MM = (0.45, 0.18)
PATCH = (64, 96)
"""Rows and columns of B-mode that are rendered around the target."""
MARGIN_MM = 0.05
REFERENCES = ("manual, 1 px", "manual, as measured")
METHODS = ("conventional", "joint")


def speckle_frame(rng: np.random.Generator, position: np.ndarray, contrast_db: float) -> np.ndarray:
    """One patch of B-mode: an echo at [u, v] px in speckle, both with the same point spread."""
    sd_u, sd_v = (sd / PIXEL_MM for sd in POINT_SPREAD_MM)
    wave_v, wave_u = (2 * np.pi * np.fft.fftfreq(size) for size in PATCH)
    response = np.exp(-0.5 * ((wave_u * sd_u) ** 2 + (wave_v[:, None] * sd_v) ** 2))
    white = rng.normal(size=PATCH) + 1j * rng.normal(size=PATCH)
    field = np.fft.ifft2(np.fft.fft2(white) * response)
    field /= np.sqrt(np.mean(np.abs(field) ** 2))
    v, u = np.indices(PATCH)
    spread = ((u - position[0]) / sd_u) ** 2 + ((v - position[1]) / sd_v) ** 2
    phase = np.exp(2j * np.pi * rng.random())
    envelope = np.abs(field + 10 ** (contrast_db / 20) * phase * np.exp(-0.5 * spread))
    level = 1 + 20 * np.log10(envelope / envelope.max()) / 60.0
    return np.round(255 * np.clip(level, 0, 1)).astype(np.uint8)


def image_errors(
    contrast_db: float, trials: int
) -> tuple[Float[np.ndarray, "trials images 2"], float]:
    """Errors (mm) of the computer's positions in B-mode frames, and the share not found.

    A frame without a credible target is taken again, as at the bench.
    """
    rng = np.random.default_rng([SEED, round(contrast_db)])
    errors = np.zeros((trials, IMAGES, 2))
    flat, missing, taken = errors.reshape(-1, 2), np.arange(trials * IMAGES), 0
    while len(missing):
        again = []
        for block in np.array_split(missing, max(1, len(missing) // 500)):
            # The target's place within a pixel is what matters, not where in the image that is.
            positions = np.array(PATCH)[::-1] / 2 + rng.uniform(-4, 4, (len(block), 2))
            frames = np.stack([speckle_frame(rng, p, contrast_db) for p in positions])
            located = localise(frames)
            flat[block] = PIXEL_MM * (located.position - positions)
            again.append(block[~located.found])
            taken += len(block)
        missing = np.concatenate(again)
    return errors, 1 - errors.shape[0] * IMAGES / taken


def ways_to_segment(
    exact: Float[np.ndarray, "trials images 2"],
    protocol: Protocol,
    seen: dict[float, np.ndarray],
) -> Iterator[tuple[str, str, float | None, float | None, np.ndarray]]:
    """Every way: name, family, channel noise (mm), clock (MHz) and the points in mm."""
    yield "exact", "exact", None, None, exact
    rng = np.random.default_rng([SEED, 1])
    standard = rng.normal(size=exact.shape)
    for name, sd in CLICKS_MM.items():
        clicks = np.round((exact + standard * np.array(sd)) / PIXEL_MM) * PIXEL_MM
        yield f"manual, {name}", "manual", None, None, clicks
    for contrast, errors in seen.items():
        yield f"B-mode by computer, {contrast:g} dB", "image", None, None, exact + errors

    probe = protocol.probe
    elements = probe.element_lateral()
    positions = probe.element_positions()
    fit = jax.jit(lambda distances: fit_in_plane(distances, positions, steps=5).position)
    distances = np.hypot(exact[..., :1] - elements, exact[..., 1:])
    standard = rng.normal(size=distances.shape)
    for noise in NOISES_MM:
        for clock in CLOCKS_MHZ:
            measured = distances + noise * standard
            if clock is not None:
                tick = probe.sound_speed_m_s * 1e3 / (clock * 1e6)
                measured = np.round(measured / tick) * tick
            label = "no clock" if clock is None else f"{clock:g} MHz"
            # Noise on the shortest distances of a shallow target must not make them negative.
            measured = np.maximum(measured, 1e-3)
            yield (f"least squares, {noise:g} mm, {label}", "least squares", noise, clock,
                   np.asarray(fit(measured)))  # fmt: skip
            if clock is not None:
                shortest = measured.min(axis=-1)
                # Neighbours tie where the clock is coarse: the middle of them is the fair choice.
                tied = measured == shortest[..., None]
                lateral = (tied @ elements) / tied.sum(axis=-1)
                yield (f"shortest, {noise:g} mm, {label}", "shortest", noise, clock,
                       np.stack([lateral, shortest], axis=-1))  # fmt: skip


def run_elevation(elevation: float, trials: int, seen: dict[float, np.ndarray]) -> list[dict]:
    """All ways of segmenting one set of experiments: RP (trials,) by method and test set."""
    protocol = Protocol(images=IMAGES, test_images=IMAGES, elevation_mm=elevation, noise_mm=0.0)

    @jax.jit
    def draw(indices):
        root = jax.random.key(SEED)
        return jax.vmap(lambda k: simulate(jax.random.fold_in(root, k), protocol))(indices)

    experiments = draw(jnp.arange(trials))
    exact = np.asarray(experiments.points)
    template: Problem = problems_of(experiments, covariances=False)
    test = np.asarray(experiments.test_points)
    picks = np.random.default_rng([SEED, 2]).normal(size=test.shape) * np.array(PICKED_MM)
    tests = {"exact": jnp.asarray(test), "picked": jnp.asarray(test + picks)}
    precision = jax.jit(jax.vmap(reconstruction_precision))
    out = []
    for name, family, noise, clock, points in ways_to_segment(exact, protocol, seen):
        problems = Problem(
            poses=template.poses, measurements=jnp.asarray(points), mask=template.mask,
            spacing=template.spacing, face_offset=template.face_offset,
        )  # fmt: skip
        error = points - exact
        row: dict[str | tuple[str, str], Any] = {
            "name": name, "family": family, "noise": noise, "clock": clock, "elevation": elevation,
            "rms": np.sqrt(np.mean(error**2, axis=(0, 1))), "bias": error.mean(axis=(0, 1)),
            "not_converged": 0,
        }  # fmt: skip
        for method in METHODS:
            # Self-tuned Gaussian, whatever the default prior has become.
            prior = "gaussian" if method == "joint" else "auto"
            result = calibrate_batch(problems, method=method, prior=prior)
            row["not_converged"] += int((~np.asarray(result.converged)).sum())
            for kind, points_of_test in tests.items():
                row[method, kind] = np.asarray(
                    precision(result.image_to_probe, experiments.test_poses, points_of_test)
                )
        out.append(row)
        print(
            f"elevation {elevation:g} mm, {name}: RMS error "
            f"{row['rms'][0]:.3f} lateral {row['rms'][1]:.3f} range mm; RP conventional "
            f"{row['conventional', 'exact'].mean():.4f} joint "
            f"{row['joint', 'exact'].mean():.4f} mm "
            f"(picked test {row['conventional', 'picked'].mean():.4f}, "
            f"{row['joint', 'picked'].mean():.4f}); not converged {row['not_converged']}",
            flush=True,
        )
    return out


def interval(values: np.ndarray) -> tuple[float, float]:
    """Mean and half of its 95 % interval."""
    return float(values.mean()), half_95(values)


def verdict(mean: float, half: float) -> str:
    """What the interval of a paired difference says."""
    if abs(mean) + half < MARGIN_MM:
        return "equal"
    if abs(mean) > half:
        return "better" if mean < 0 else "worse"
    return "undecided"


def main() -> None:
    quick, folder = arguments(__doc__)
    trials = 20 if quick else 400
    seen = {}
    for contrast in CONTRASTS_DB:
        seen[contrast], lost = image_errors(contrast, trials)
        print(f"B-mode {contrast:g} dB: not found in {100 * lost:.2f} % of frames", flush=True)
    rows, everything = [], []
    for elevation in ELEVATIONS_MM:
        cell = run_elevation(elevation, trials, seen)
        everything += cell
        manual = {row["name"]: row for row in cell if row["name"] in REFERENCES}
        for row in cell:
            for method in METHODS:
                for kind in ("exact", "picked"):
                    rp = row[method, kind]
                    line = [elevation, row["name"], row["family"],
                            "" if row["noise"] is None else row["noise"],
                            "" if row["clock"] is None else row["clock"],
                            *row["rms"].tolist(), *row["bias"].tolist(), method, kind, trials,
                            *interval(rp)]  # fmt: skip
                    for reference in REFERENCES:
                        difference = interval(rp - manual[reference][method, kind])
                        line += [*difference, verdict(*difference)]
                    rows.append([*line, row["not_converged"]])
    header = ["elevation_mm", "segmentation", "family", "channel_noise_mm", "clock_mhz",
              "rms_lateral_mm", "rms_range_mm", "bias_lateral_mm", "bias_range_mm", "method",
              "test_points", "trials", "rp_mm", "ci95_half_mm"]  # fmt: skip
    for name in ("1px", "measured"):
        header += [f"minus_manual_{name}_mm", f"minus_manual_{name}_ci95_half_mm",
                   f"against_manual_{name}"]  # fmt: skip
    write_table(folder / "segmentation_claim.csv", [*header, "not_converged"], rows)
    for kind in ("exact", "picked"):
        for family in ("least squares", "shortest", "image"):
            chosen = [row for row in rows if row[2] == family and row[10] == kind]
            for column, reference in ((16, REFERENCES[0]), (19, REFERENCES[1])):
                words = [row[column] for row in chosen]
                counts = ", ".join(f"{words.count(word)} {word}" for word in sorted(set(words)))
                print(f"test points {kind}: {family} against {reference}: {counts} "
                      f"of {len(words)} cells")  # fmt: skip
    print(machine())
    plot(folder / "segmentation_claim.png", everything)


def plot(path, everything: list[dict]) -> None:
    """Mean RP with its 95 % interval, every way of segmenting, by offset and method."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 7.5), layout="constrained")
    panels = figure.subplots(1, len(ELEVATIONS_MM), sharey=True)
    for panel, elevation in zip(panels, ELEVATIONS_MM, strict=True):
        cell = [row for row in everything if row["elevation"] == elevation]
        cell.sort(key=lambda row: ["exact", "manual", "image", "least squares", "shortest"].index(
            row["family"]))  # fmt: skip
        for method, colour, shift in zip(METHODS, ("#D55E00", "#0072B2"), (-0.15, 0.15),
                                         strict=True):  # fmt: skip
            for kind, marker in (("exact", "o"), ("picked", "^")):
                means, halves = zip(*(interval(row[method, kind]) for row in cell), strict=True)
                panel.errorbar(means, np.arange(len(cell)) + shift, xerr=halves, fmt=marker,
                               color=colour, markersize=4, linewidth=0.8,
                               fillstyle="full" if kind == "exact" else "none",
                               label=f"{method}, {kind} test points")  # fmt: skip
        panel.set_yticks(range(len(cell)), [row["name"] for row in cell])
        panel.set(xscale="log", xlabel="mean reconstruction precision (mm)",
                  title=f"offsets uniform to {elevation:g} mm")  # fmt: skip
        panel.grid(alpha=0.3)
    panels[0].invert_yaxis()
    panels[0].legend(fontsize="x-small")
    save_figure(figure, path, dpi=150)


if __name__ == "__main__":
    main()
