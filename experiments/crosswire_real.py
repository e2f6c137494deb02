"""The real cross-wire recording: how large its errors are, of what kind, and what to make of it.

54 hand-picked points with unknown pixel size (a public recording, not part of this repository:
the folder ``shared/data/crosswire`` beside it, or the one that is named). Conventional least
squares takes all three errors for equal; the joint method estimates an SD for each. Which of the
two predicts an image that it has not seen better is told by the leave-one-out log density, image by
image; the kurtosis of the standardised residuals tells of heavy tails. The pivot recordings that
lie beside it (the same tool with and without about 30 % outliers) follow.

Whether the pivot recording with outliers reaches the clean one's precision is judged by a bootstrap
of blocks of successive poses, for those are alike (2,000 draws). Seed 20261121.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import machine, results_folder, save_figure, write_table

import jaxcal
from jaxcal.calibration.resampling import CrossValidation
from jaxcal.data.problem import taken
from jaxcal.diagnostics.misfits import misfits
from jaxcal.io.text import read_crosswire, read_poses
from jaxcal.runtime.jax_cache import enable_compilation_cache
from jaxcal.solvers.names import Method

DATA = Path(__file__).parents[2] / "shared" / "data" / "crosswire"
UNKNOWNS = 11
SEED, DRAWS, BLOCK = 20261121, 2000, 20
SAMPLES, SPLITS, KEPT = 200, 60, 40
HALVED = 200
PIXELS = np.stack(np.meshgrid(np.linspace(0, 400, 5), np.linspace(50, 500, 5)), axis=-1).reshape(
    -1, 2
)
"""Image points at which calibrations from two halves are compared: the part that was used."""
LEVER_MM = 40.0
"""Where a rotation is taken in mm: about the middle of the image."""


def isotropic_log_density(held: CrossValidation, rms: np.ndarray) -> np.ndarray:
    """Log density of each held-out image under one SD for all three errors."""
    squared = np.asarray(held.residual) ** 2
    variance = rms[:, None] ** 2
    return -0.5 * (squared / variance + np.log(2 * np.pi * variance)).sum(axis=1)


def crosswire(folder: Path) -> tuple[list[list[object]], list[str], np.ndarray]:
    """Table rows, sentences, and the standardised residuals (images, 3)."""
    recording = read_crosswire(
        folder / "crossWirePhantomTransformations.txt", folder / "crossWirePhantom2DPoints.txt"
    )
    data = jaxcal.Problem.from_recording(recording)
    equal = jaxcal.calibrate(data, "conventional", estimate=("scale",), robust=False)
    joint = jaxcal.calibrate(data, estimate=("scale",), robust=False)
    robust = jaxcal.calibrate(data, estimate=("scale",), robust=True)
    held_equal = jaxcal.cross_validate(
        data, result=equal, method="conventional", estimate=("scale",)
    )
    held_joint = jaxcal.cross_validate(data, result=joint, estimate=("scale",))
    images = data.images
    # One SD from the images that each fold was fitted to, its degrees of freedom taken off.
    rms = np.sqrt(np.asarray(held_equal.fold_cost) / (3 * (images - 1) - UNKNOWNS))
    difference = np.asarray(held_joint.log_density) - isotropic_log_density(held_equal, rms)
    gained, error = difference.sum(), difference.std(ddof=1) * np.sqrt(images)
    sigma, kurtosis = np.asarray(joint.sigma), np.asarray(joint.inspection.kurtosis)
    rows: list[list[object]] = [
        ["conventional_rms_mm", float(equal.rms)],
        *([f"sigma_{name}_mm", float(value)] for name, value in
          zip(("lateral", "range", "elevation"), sigma, strict=True)),
        *([f"kurtosis_{name}", float(value)] for name, value in
          zip(("lateral", "range", "elevation"), kurtosis, strict=True)),
        ["log_density_gained", float(gained)],
        ["log_density_gained_standard_error", float(error)],
        ["held_out_rms_conventional_mm", float(held_equal.rms)],
        ["held_out_rms_joint_mm", float(held_joint.rms)],
        ["largest_influence_sds", float(np.nanmax(held_joint.influence))],
        ["images_left_out_by_robust", int(np.sum(robust.outlier))],
    ]  # fmt: skip
    word = "is" if gained > 2 * error else "is not"
    said = [
        f"The errors are {sigma[0]:.2f} mm lateral, {sigma[1]:.2f} mm axial and {sigma[2]:.2f} mm "
        "elevational (SD): the out-of-plane error is the largest, and real.",
        f"Taking them for three sizes instead of one {word} better at predicting images that were "
        f"not used: {gained:.1f} +- {error:.1f} in leave-one-out log density.",
        f"The elevational residuals have kurtosis {kurtosis[2]:.1f} (Gaussian 3, uniform 1.8): "
        "heavy-tailed, so no bound fits them.",
        *(f"The noise model is contradicted: {text}." for text in misfits(joint.numpy())),
        f"No image moves the transform by more than {np.nanmax(held_joint.influence):.2f} of its "
        f"SDs, and the robust solve leaves out {int(np.sum(robust.outlier))}.",
    ]
    standard = np.asarray(held_joint.residual) / sigma
    return rows, said, standard


def steadiness(folder: Path) -> tuple[list[list[object]], list[str]]:
    """Leaving out, bootstrap and precision on images not used: the default and conventional."""
    recording = read_crosswire(
        folder / "crossWirePhantomTransformations.txt", folder / "crossWirePhantom2DPoints.txt"
    )
    data = jaxcal.Problem.from_recording(recording)
    images = data.images
    rng = np.random.default_rng(SEED)
    every = np.arange(images)
    chosen = [every, *(np.delete(every, k) for k in every)]
    chosen += [np.sort(rng.integers(0, images, images)) for _ in range(SAMPLES)]
    shuffled = [rng.permutation(images) for _ in range(SPLITS)]
    chosen += [np.sort(order[:KEPT]) for order in shuffled]
    index = np.array([np.resize(rows, images) for rows in chosen])
    mask = np.array([np.arange(images) < len(rows) for rows in chosen]).astype(float)
    problems = replace(
        jaxcal.stack([data] * len(chosen)),
        poses=np.asarray(data.poses)[index],
        measurements=np.asarray(data.measurements)[index],
        mask=mask,
    )
    rows: list[list[object]] = []
    said, precision = [], {}
    methods: tuple[Method, ...] = ("joint", "conventional")
    for name in methods:
        result = jaxcal.calibrate_batch(problems, name, estimate=("scale",))
        x, covariance = np.asarray(result.image_to_probe), np.asarray(result.covariance[0])
        turn = x[0, :3, :3].T @ x[:, :3, :3]
        skew = 0.5 * (turn - np.swapaxes(turn, 1, 2))
        turned = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        moved = np.concatenate([x[:, :3, 3] - x[0, :3, 3], LEVER_MM * turned], axis=1)
        size = np.diag([1.0, 1, 1, LEVER_MM, LEVER_MM, LEVER_MM])
        sd = np.sqrt(np.trace(size @ covariance @ size))
        away = np.linalg.norm(moved, axis=1) / sd
        left, drawn = away[1 : images + 1], away[images + 1 : images + 1 + SAMPLES]
        scale = np.asarray(result.scale_mm_per_px)[images + 1 + SAMPLES :]
        last = x[images + 1 + SAMPLES :]
        held = []
        for order, where, by in zip(shuffled, last, scale, strict=True):
            point = np.asarray(data.measurements)[order[KEPT:]] * by
            point = np.stack([point[:, 0], 0 * point[:, 0], point[:, 1]], axis=1)
            pose = np.asarray(data.poses)[order[KEPT:]]
            there = point @ where[:3, :3].T + where[:3, 3]
            there = np.einsum("nij,nj->ni", pose[:, :3, :3], there) + pose[:, :3, 3]
            held.append(np.sqrt(np.mean(np.sum((there - there.mean(axis=0)) ** 2, axis=1))))
        precision[name] = float(np.mean(held))
        spread = float(np.sqrt(np.mean(drawn**2)))
        rows += [
            [f"{name}_sd_at_lever_mm", float(sd)],
            [f"{name}_left_out_largest_shift_sds", float(left.max())],
            [f"{name}_left_out_image", int(left.argmax()) + 1],
            [f"{name}_bootstrap_scatter_sds", spread],
            [f"{name}_bootstrap_largest_sds", float(drawn.max())],
            [f"{name}_precision_not_used_mm", precision[name]],
        ]
        said.append(
            f"{name}: the stated SD is {sd:.2f} mm at {LEVER_MM:g} mm. Leaving one image out moves "
            f"X by at most {left.max():.2f} of it; {SAMPLES} bootstrap samples scatter by "
            f"{spread:.2f} of it, at most {drawn.max():.2f}; precision on images not used is "
            f"{precision[name]:.3f} mm."
        )
    ratio = precision["joint"] / precision["conventional"]
    rows.append(["precision_not_used_over_conventional", ratio])
    law = jaxcal.calibrate(data, estimate=("scale",), robust=False).offset_law
    assert law is not None
    rows += [
        ["mean_probability", float(law.mean_probability)],
        ["mean_trust", float(law.trust)],
        ["mean_mm", float(law.mean)],
        ["mean_sd_mm", float(law.mean_sd)],
    ]
    return rows, said


def halves(folder: Path) -> tuple[list[list[object]], list[str]]:
    """Do calibrations from two halves of the images agree, as often as their covariances say?"""
    recording = read_crosswire(
        folder / "crossWirePhantomTransformations.txt", folder / "crossWirePhantom2DPoints.txt"
    )
    data = jaxcal.Problem.from_recording(recording)
    rng = np.random.default_rng(SEED)
    half = data.images // 2
    splits = [np.split(rng.permutation(data.images), [half]) for _ in range(HALVED)]
    rows: list[list[object]] = []
    said = []
    methods: tuple[Method, ...] = ("joint", "conventional")
    for name in methods:
        found = []
        for split in splits:
            first, second = (
                jaxcal.calibrate(
                    taken(data, np.sort(part).tolist()), name, estimate=("scale",)
                ).image_transform()
                for part in split
            )
            found.append(jaxcal.compare_calibrations(first, second, PIXELS))
        agree = float(np.mean([bool(each.agree) for each in found]))
        apart = float(np.sqrt(np.mean([each.rms_mm**2 for each in found])))
        expected = float(np.sqrt(np.mean([each.expected_rms_mm**2 for each in found])))
        rows += [
            [f"{name}_halves_agree", agree],
            [f"{name}_halves_apart_mm", apart],
            [f"{name}_halves_expected_mm", expected],
        ]
        said.append(
            f"{name}: calibrations from two halves of the images are {apart:.2f} mm apart in the "
            f"image (RMS of {HALVED} random splits), {expected:.2f} mm by their covariances; "
            f"{100 * agree:.1f} % are within the limit for 95 %."
        )
    return rows, said


def bootstrapped(poses: np.ndarray) -> np.ndarray:
    """Pivot fits to blocks of poses drawn with replacement: rows of (RMS, tip), mm."""
    rng = np.random.default_rng(SEED)
    starts = rng.integers(0, len(poses) - BLOCK + 1, (DRAWS, -(-len(poses) // BLOCK)))
    rows = (starts[..., None] + np.arange(BLOCK)).reshape(DRAWS, -1)[:, : len(poses)]
    found = []
    for chosen in rows:
        rotation, shift = poses[chosen, :3, :3], poses[chosen, :3, 3]
        eye = np.broadcast_to(-np.eye(3), rotation.shape)
        matrix = np.concatenate([rotation, eye], axis=2).reshape(-1, 6)
        tip, *_ = np.linalg.lstsq(matrix, -shift.ravel())
        errors = (matrix @ tip + shift.ravel()).reshape(-1, 3)
        found.append([np.sqrt((errors**2).sum(axis=1).mean()), *tip[:3]])
    return np.array(found)


def pivots(folder: Path) -> tuple[list[list[object]], list[str]]:
    """The same for the pivot recordings."""
    undisturbed = read_poses(folder / "pivotCalibrationData.txt", quaternion="xyzw")
    clean = jaxcal.calibrate_pivot(undisturbed)
    poses = read_poses(folder / "pivotCalibrationDataWithOutliers.txt", quaternion="xyzw")
    plain = jaxcal.calibrate_pivot(poses, robust=False)
    robust = jaxcal.calibrate_pivot(poses)
    apart = float(np.linalg.norm(np.asarray(robust.tip) - np.asarray(clean.tip)))
    kept = poses[np.asarray(robust.mask) > 0]
    drawn = [bootstrapped(undisturbed), bootstrapped(kept)]
    sd = [draws.std(axis=0, ddof=1) for draws in drawn]
    more = float(robust.rms - clean.rms)
    more_sd = float(np.hypot(sd[0][0], sd[1][0]))
    tip_sd = float(np.sqrt(sum(np.sum(each[1:] ** 2) for each in sd)))
    rows: list[list[object]] = [
        ["pivot_clean_poses", len(undisturbed)],
        ["pivot_clean_rms_sd_mm", float(sd[0][0])],
        ["pivot_outliers_robust_rms_sd_mm", float(sd[1][0])],
        ["pivot_rms_more_mm", more],
        ["pivot_rms_more_sd_mm", more_sd],
        ["pivot_tips_apart_sd_mm", tip_sd],
        ["pivot_clean_rms_mm", float(clean.rms)],
        ["pivot_outliers_plain_rms_mm", float(plain.rms)],
        ["pivot_outliers_robust_rms_mm", float(robust.rms)],
        ["pivot_outliers_named", int(np.sum(robust.outlier))],
        ["pivot_outliers_poses", len(poses)],
        ["pivot_tips_apart_mm", apart],
        ["pivot_tip_sd_clean_mm", float(np.sqrt(np.trace(clean.covariance[:3, :3])))],
        ["pivot_tip_sd_robust_mm", float(np.sqrt(np.trace(robust.covariance[:3, :3])))],
    ]
    said = [
        f"Pivot: {int(np.sum(robust.outlier))} of {len(poses)} poses are left out and the rest "
        f"fit to {float(robust.rms):.3f} mm (the clean recording to {float(clean.rms):.3f} mm, all "
        f"poses of this one to {float(plain.rms):.1f} mm); the tips of the two recordings are "
        f"{apart:.2f} mm apart. By blocks of {BLOCK} poses the difference in RMS is {more:.3f} +- "
        f"{more_sd:.3f} mm (SD), and the tips' distance would be {tip_sd:.2f} mm by chance."
    ]
    return rows, said


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=DATA)
    parser.add_argument("--quick", action="store_true", help="write to the quick results' folder")
    given = parser.parse_args()
    if not given.folder.is_dir():
        print(f"{given.folder}: the recording is not here; nothing was done")
        return
    enable_compilation_cache()
    rows, said, standard = crosswire(given.folder)
    steady_rows, steady_said = steadiness(given.folder)
    half_rows, half_said = halves(given.folder)
    more_rows, more_said = pivots(given.folder)
    folder = results_folder(given.quick)
    write_table(
        folder / "crosswire_real.csv",
        ["quantity", "value"],
        rows + steady_rows + half_rows + more_rows,
    )
    print("\n".join(said + steady_said + half_said + more_said))
    print(machine())
    plot(folder / "crosswire_real.png", standard)


def plot(path: Path, standard: np.ndarray) -> None:
    """Held-out residuals against normal quantiles."""
    from matplotlib.figure import Figure
    from scipy.stats import norm

    count = len(standard)
    quantiles = norm.ppf((np.arange(count) + 0.5) / count)
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for panel, name, values in zip(
        figure.subplots(1, 3, sharey=True), ("lateral", "range", "elevational"), standard.T,
        strict=True,
    ):  # fmt: skip
        panel.plot(quantiles, np.sort(values), "o", markersize=3)
        panel.axline((0, 0), slope=1, color="grey", linewidth=0.8)
        panel.set(title=name, xlabel="normal quantile")
    figure.axes[0].set_ylabel("held-out error (SDs)")
    save_figure(figure, path, dpi=150)


if __name__ == "__main__":
    main()
