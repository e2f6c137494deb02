"""Offsets within a bound that is too large, right or too small, or uniform: is the error right?

Simulated recordings (noise level 0.5 mm, points without covariances), calibrated with the prior
``bounded`` by a bound of 0.25 to 4 times 1 mm, which is the offsets' true bound (uniform) or their
SD (normal, heavy-tailed), and with the prior ``uniform``, which has no bound. For each condition:
root mean squares of the actual error at the image, of the error that the covariance states, and of
the error that the report states; the share in which the report says that Gaussian offsets lead to
another answer; the share with a good or fair verdict; and the share in which it is so although the
actual error exceeds the end of its 95 % interval. The last also by the covariance alone:
``stated_good_and_wrong``. The actual error with the prior ``gaussian`` is beside it.

Seed 20261127; trial k of a condition is fold_in(root, condition * 10^6 + k).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from common import arguments, experiments, machine, rms, show, write_table

import jaxcal
from jaxcal.data.recording import Recording, make_images
from jaxcal.model.image_points import rms_distance
from jaxcal.report.accuracy import FAIR_MM, region_of
from jaxcal.report.record import calibration_record
from jaxcal.runtime.jax_cache import enable_compilation_cache
from jaxcal.solvers.names import PriorName
from jaxcal.study.laws import LawName

SEED = 20261127
LAWS: tuple[LawName, ...] = ("uniform", "normal", "heavy-tailed")
IMAGES = (12, 30, 60)
SIZE_MM = 1.0
BOUNDS_MM = (0.25, 0.5, 1.0, 2.0, 4.0, None)
"""With None the prior is ``uniform``."""
HEADER = [
    "elevation_distribution", "images", "prior", "bound_mm", "trials", "error_mm",
    "gaussian_error_mm", "stated_mm", "told_mm", "told_of", "good_or_fair", "good_and_wrong",
    "stated_good_and_wrong",
]  # fmt: skip


def judged(result, gaussian, recording: Recording, x: np.ndarray) -> list[float]:
    """The numbers of one calibration; NaN where it states no error."""
    record = calibration_record(result, recording)
    grid = region_of(result, recording).grid()[:, [0, 2]]
    error, other = (
        float(rms_distance(np.asarray(each.image_to_probe), x, grid)) for each in (result, gaussian)
    )
    tre = record["tre"]
    if tre is None or tre["stated_mm"] is None:
        return [error, other, np.nan, np.nan, 0.0, 0.0, 0.0, 0.0]
    good = record["verdict"] in ("good", "fair")
    stated = tre["stated_mm"] <= FAIR_MM and error > tre["stated_interval_mm"][1]
    told = any("Gaussian offsets differs" in words for words in tre["contradictions"])
    wrong = good and error > tre["interval_95_mm"][1]
    return [error, other, tre["stated_mm"], tre["rms_mm"], told, good, wrong, stated]


def known_rms(values: np.ndarray) -> float | None:
    """Root mean square of the known values; None if none is known."""
    return float(rms(values)) if np.isfinite(values).any() else None


def main() -> None:
    quick, folder = arguments(__doc__)
    enable_compilation_cache()
    trials = 20 if quick else 200
    rows: list[list[object]] = []
    for law in LAWS:
        for images in IMAGES:
            protocol = jaxcal.Protocol(
                images=images, test_images=2, elevation_distribution=law, elevation_mm=SIZE_MM
            )
            for bound in BOUNDS_MM:
                indices = len(rows) * 1_000_000 + jnp.arange(trials)
                drawn = experiments(SEED, indices, protocol)
                poses, points, x = map(
                    np.asarray, (drawn.poses, drawn.points, drawn.image_to_probe)
                )
                recordings = [
                    Recording(make_images(*each)) for each in zip(poses, points, strict=True)
                ]
                limits: PriorName = "uniform" if bound is None else "bounded"
                results = jaxcal.calibrate_batch(recordings, prior=limits, max_elevation=bound)
                others = jaxcal.calibrate_batch(recordings, prior="gaussian").numpy()
                results = results.numpy()
                found = np.array(
                    [judged(results[k], others[k], recordings[k], x[k]) for k in range(trials)]
                )
                rows.append([law, images, limits, bound, trials, *map(known_rms, found[:, :4].T)])
                rows[-1] += map(float, found[:, 4:].mean(axis=0))
                show(rows[-1])
    write_table(folder / "sharp_limits.csv", HEADER, rows)
    print(machine())


if __name__ == "__main__":
    main()
