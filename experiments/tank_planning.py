"""Time against precision: which placement, how many images, and what joint estimation replaces."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import precision, save_figure, show, write_rows
from tank import (
    CROSSING,
    FWHM,
    SCATTER_MM,
    WIRE_MM,
    Tank,
    exact_images,
    orientations,
    parted_mm,
    picked,
    pose_errors,
    wire_widths_mm,
)
from tank_grid import Grid, interval, padded_problems
from tank_placements import (
    BY_EYE_S,
    PROCEDURES,
    beside,
    digest,
    library,
    part,
    rows_of,
    sampled,
    travel_s,
)
from tank_run import Run
from tank_sds import FACTOR, GAIN_SD, from_amplitude, own_sds

from hw.bench.world import DRAWN, TANK_MM
from jaxcal import calibrate_batch
from jaxcal.data.poses import rotations_from_vectors
from jaxcal.study import ArraySpec, Chunk

BY_EYE = "by eye, cross-wire"
WAYS = (*PROCEDURES, BY_EYE)
IMAGES = (10, 15, 20, 30, 45, 60, 90, 120)
ACCURACIES_MM = (0.0, 0.55)
"""The robot's pose error beyond its repeatability: none, and what Table 4 asks for (tank.py)."""
METHODS: dict[str, dict[str, Any]] = {
    "without": {"method": "conventional"},
    "joint": {"method": "joint"},
    "joint, own SDs": {},
}
"""The last: Gaussian offsets with an SD for each image, from its amplitude (AE), its bracket (the
image scan) or what a person can tell apart (by eye); see tank_sds.py."""
LOCALISED_MM = (0.09, 0.08)
"""SDs of a crossing localised in frames, lateral and range (part ``validation``)."""
WANTED_MM = (0.08, 0.1, 0.15, 0.2, 0.3)
COLORS = {
    "seen, by hand": "C7",
    "first seen, robot": "C5",
    "amplitude scan": "C0",
    "pattern injection": "C2",
    "threshold climb": "C4",
    "image scan, cross-wire": "C1",
    BY_EYE: "C3",
}


@dataclass(frozen=True)
class Session:
    """A condition: how images are placed, how many, and how good the robot is.

    Attributes:
        way: one of :data:`WAYS`.
        images: poses.
        accuracy_mm: SD on each axis of the pose error beyond the repeatability.
        library: path of the placements' table, from this folder.
        sha256: of that table.
    """

    way: str
    images: int
    accuracy_mm: float
    library: str
    sha256: str


@dataclass(frozen=True)
class Planning(Grid):
    """Sessions of a lab."""

    kind = Session

    def arrays(self, chunk: Chunk) -> dict[str, ArraySpec]:
        """Precision by method, and how long it took."""
        trials = chunk.stop - chunk.start
        return {
            "rp": ArraySpec("mm", (len(METHODS), trials)),
            "seconds": ArraySpec("s", (trials,)),
            "status": ArraySpec("1", (len(METHODS), trials), "i"),
        }

    def compute(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """Draw the sessions, calibrate, judge on images without errors."""
        session = self.conditions[chunk.condition]
        drawn = [one(session, self.seed, trial) for trial in range(chunk.start, chunk.stop)]
        poses, points, offset_sd, tests, test_points = (
            np.array([getattr(shot, name) for shot in drawn])
            for name in ("poses", "points", "offset_sd", "test_poses", "test_points")
        )
        rp, status = [], []
        problem = padded_problems(poses, points)
        sigma = np.ones((len(poses), 2))
        for arguments in METHODS.values():
            if not arguments:
                room = problem.mask.shape[1] - offset_sd.shape[1]
                full = np.pad(offset_sd, [(0, 0), (0, room)], constant_values=1.0)
                x = own_sds(problem, full, np.maximum(sigma, 0.01))
                status.append(np.where(np.isfinite(x).all(axis=(1, 2)), 0, 3))
            else:
                result = calibrate_batch(problem, **arguments)
                x = np.asarray(result.image_to_probe)
                status.append(np.asarray(result.status_code))
                if arguments["method"] == "joint":
                    sigma = np.asarray(result.sigma)[:, :2]
            rp.append(precision(x, tests, test_points))
        seconds = np.array([shot.seconds for shot in drawn])
        return {"rp": np.array(rp), "seconds": seconds, "status": np.array(status, np.int32)}


@dataclass(frozen=True)
class Shots:
    """One session's images and what judges them.

    Attributes:
        poses: (n, 4, 4) as reported, mm.
        points: (n, 2) [lateral, range], mm.
        bounds: (n,) of the brackets, mm.
        offset_sd: (n,) what is known of each offset, mm.
        placements: (n, columns) rows of the library, or None.
        elevation: (n,) true offsets, mm.
        seconds: all together.
        test_poses: (m, 4, 4).
        test_points: (m, 2).
    """

    poses: np.ndarray
    points: np.ndarray
    bounds: np.ndarray
    offset_sd: np.ndarray
    placements: np.ndarray | None
    elevation: np.ndarray
    seconds: float
    test_poses: np.ndarray
    test_points: np.ndarray


def one(session: Session, seed: int, trial: int) -> Shots:
    """One session; trials of all conditions share their orientations and mounts."""
    tank = Tank(images=session.images, accuracy_mm=session.accuracy_mm)
    rng = np.random.default_rng([seed, trial])
    n = session.images
    plan = orientations(n, tank.cone_deg, tank.turn_deg, trial % 32)
    off = rng.uniform(-1, 1, size=(2, 3))
    x = DRAWN.copy()
    x[:3, :3] = DRAWN[:3, :3] @ rotations_from_vectors(np.radians(1.5) * off[0])
    x[:3, 3] += 2.0 * off[1]
    tests, test_points, _ = exact_images(x, rng)
    shared = pose_errors(tank, plan.rotations, rng)
    stop = tank.repeatability_mm * rng.normal(size=(n, 2))
    ranges = plan.places[:, 1]
    placements: np.ndarray | None = None
    if session.way == BY_EYE:
        reach = parted_mm(tank, ranges, plan.wires)
        elevation = rng.uniform(-1, 1, n) * reach
        elevation = elevation + tank.repeatability_mm * rng.normal(size=n)
        bounds, seconds = reach + FACTOR * tank.repeatability_mm, n * BY_EYE_S
        offset_sd = reach / np.sqrt(3.0)
    else:
        rows = rows_of(session.library, session.sha256)[session.way]
        placements = sampled(rows, ranges, rng)
        elevation, bounds = part(placements, "offset_mm"), part(placements, "half_mm")
        seconds = float(part(placements, "seconds").sum())
        # The lab misjudges the amplitude in the mid-plane, once a session.
        gain = float(1 + GAIN_SD * rng.normal())
        offset_sd = (
            bounds / FACTOR if "wire" in session.way else from_amplitude(placements, gain)[1]
        )
        if "hand" not in session.way:
            seconds += travel_s(n, trial % 8)
    # The pose error beyond repeatability moves the target in the image; so does the last stop.
    moved = -np.einsum("nji,nj->ni", plan.rotations, shared) @ x[:3, :3]
    # Searches find the true plane: the reported pose is off by what the robot errs.
    nominal = np.stack([plan.places[:, 0], elevation - moved[:, 1], ranges], axis=1)
    true = nominal + moved
    true[:, [0, 2]] += stop
    points = np.stack([true[:, 0], np.hypot(true[:, 1], true[:, 2])], axis=1)
    points += measured(session.way, tank, plan.wires, ranges, true[:, 1], rng)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = plan.rotations
    in_probe = nominal @ x[:3, :3].T + x[:3, 3]
    poses[:, :3, 3] = TANK_MM - np.einsum("nij,nj->ni", plan.rotations, in_probe)
    # A lab knows how good its robot is.
    offset_sd = np.hypot(offset_sd, np.hypot(session.accuracy_mm, 0.5 * tank.repeatability_mm))
    return Shots(
        poses, points, bounds, offset_sd, placements, true[:, 1], seconds, tests, test_points
    )


def measured(
    way: str,
    tank: Tank,
    wires: np.ndarray,
    ranges: np.ndarray,
    elevation: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Error of the segmented points, mm."""
    n = len(ranges)
    if way == BY_EYE:
        widths = CROSSING * wire_widths_mm(tank, ranges, wires).mean(axis=1)
        apart = np.abs(elevation * (wires[:, 0] - wires[:, 1]))
        middle = np.stack([elevation * wires.mean(axis=1), np.zeros(n)], axis=1)
        echo = SCATTER_MM * rng.normal(size=(n, 2)) - [0.0, 0.5 * WIRE_MM]
        return echo + middle + picked(rng, FWHM * widths + apart, FWHM * tank.look.axial_mm)
    if "wire" in way:
        return rng.normal(size=(n, 2)) * LOCALISED_MM - [0.0, 0.5 * WIRE_MM]
    return 0.005 * rng.normal(size=(n, 2))


def planning(run: Run) -> None:
    """Run all sessions; table, what to do, figure."""
    path = library(run)
    sha = digest(path)
    conditions = tuple(
        Session(way, n, accuracy, beside(path), sha)
        for accuracy in ACCURACIES_MM
        for way in WAYS
        for n in IMAGES
    )
    data = run.study("paper_experiment_planning", run.grid(Planning, conditions))
    rows: list[dict[str, Any]] = []
    for c, session in enumerate(conditions):
        for m, name in enumerate(METHODS):
            rp = data["rp"][c, m]
            mean, half = interval(rp)
            rows.append(
                {
                    "placement": session.way,
                    "method": name,
                    "images": session.images,
                    "accuracy_mm": session.accuracy_mm,
                    "experiments": run.trials,
                    "minutes": float((data["seconds"][c] / 60).mean()),
                    "rp_mm": mean,
                    "ci95_half_mm": half,
                    "rp_95_mm": float(np.quantile(rp, 0.95)),
                    "not_converged": int((data["status"][c, m] != 0).sum()),
                }
            )
    write_rows(run.folder / "paper_experiment_planning.csv", rows)
    advice = times_to(rows)
    write_rows(run.folder / "paper_experiment_planning_times.csv", advice)
    for row in advice:
        if row["minutes"] != "":
            show(row.values())
    placements = rows_of(beside(path), sha)
    first = np.abs(part(placements["first seen, robot"], "true_offset_mm"))
    told = statements(rows, advice, placements)
    told.append(
        [
            "4.3",
            "the element gives no feedback unless the image plane is very close to it",
            "holds",
            "coming from one side, the robot hears it first at a mean of "
            f"{first.mean():.1f} mm and at most {first.max():.1f} mm from the plane",
        ]
    )
    run.statements("planning", told)
    plot(run.folder / "paper_experiment_planning.png", rows)


def statements(
    rows: list[dict[str, Any]], advice: list[dict[str, Any]], placements: dict[str, np.ndarray]
) -> list[list[str]]:
    """What section 4.3 says of placement and estimation, with our evidence."""
    wanted = 0.15

    def minutes(accuracy: float, way: str, method: str) -> str:
        (value,) = [
            row["minutes"] for row in advice
            if (row["accuracy_mm"], row["wanted_rp_mm"], row["placement"], row["method"])
            == (accuracy, wanted, way, method)
        ]  # fmt: skip
        return "not with 120 images" if value == "" else f"{value:.1f} min"

    def rp(way: str, method: str) -> float:
        (value,) = [row["rp_mm"] for row in chosen(rows, way, method, 0.0) if row["images"] == 60]
        return value

    fine, rough = "amplitude scan", "seen, by hand"
    found = []
    for accuracy in ACCURACIES_MM:
        found.append(
            [
                "4.3",
                "with out-of-plane estimation the point need only be placed roughly, and fine "
                f"localisation is time-consuming (robot's pose error {accuracy:g} mm)",
                "see figures",
                f"minutes to {wanted:g} mm: placed roughly by hand "
                f"{minutes(accuracy, rough, 'without')} without and "
                f"{minutes(accuracy, rough, 'joint, own SDs')} with joint estimation and an SD for "
                f"each image; amplitude scan {minutes(accuracy, fine, 'without')} and "
                f"{minutes(accuracy, fine, 'joint, own SDs')}; "
                f"pattern injection {minutes(accuracy, 'pattern injection', 'without')}; "
                f"cross-wire by eye {minutes(accuracy, BY_EYE, 'without')} and "
                f"{minutes(accuracy, BY_EYE, 'joint, own SDs')}; by robot in the image "
                f"{minutes(accuracy, 'image scan, cross-wire', 'without')}",
            ]
        )
    gain = {way: 100 * (rp(way, "joint, own SDs") / rp(way, "without") - 1) for way in WAYS}
    found.append(
        [
            "4.2, 4.3",
            "out-of-plane estimation is more beneficial for points placed with less experience, "
            "and a slight adjustment for well-placed ones",
            "holds" if gain[rough] < gain[fine] < 5 else "does not hold",
            "joint with an SD for each image over without, 60 images, robot without pose error: "
            + ", ".join(f"{way} {value:+.0f} %" for way, value in gain.items()),
        ]
    )
    scan = "image scan, cross-wire"
    sds = {way: float(part(placements[way], "offset_mm").std()) for way in (fine, scan)}
    found.append(
        [
            "4.2",
            "as in simulation, estimation has little effect when the elevational uncertainty is "
            "low",
            "holds" if max(abs(gain[fine]), abs(gain[scan])) < 10 else "does not hold",
            "the same: "
            + ", ".join(
                f"{way} {gain[way]:+.0f} % (SD of the offsets {sd:.2f} mm)"
                for way, sd in sds.items()
            ),
        ]
    )
    return found


def chosen(
    rows: list[dict[str, Any]], way: str, method: str, accuracy: float
) -> list[dict[str, Any]]:
    """The rows of a placement, a method and a robot: one for each number of images."""
    wanted = {"placement": way, "method": method, "accuracy_mm": accuracy}
    return [row for row in rows if row.items() >= wanted.items()]


def times_to(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Images and minutes to a wanted mean RP, interpolated in log-log; empty: not reached."""
    found: list[dict[str, Any]] = []
    for accuracy, wanted, way, method in itertools.product(ACCURACIES_MM, WANTED_MM, WAYS, METHODS):
        some = chosen(rows, way, method, accuracy)
        rp = np.array([row["rp_mm"] for row in some])
        reached = np.flatnonzero(rp <= wanted)
        row: dict[str, Any] = {
            "accuracy_mm": accuracy, "wanted_rp_mm": wanted, "placement": way, "method": method,
        }  # fmt: skip
        for name in ("images", "minutes"):
            values = np.array([row[name] for row in some], float)
            if not reached.size:
                row[name] = ""
            elif reached[0] == 0:
                row[name] = float(values[0])
            else:
                k = int(reached[0])
                share = np.log(rp[k - 1] / wanted) / np.log(rp[k - 1] / rp[k])
                ends = np.log(values[k - 1 : k + 1])
                row[name] = float(np.exp((1 - share) * ends[0] + share * ends[1]))
        found.append(row)
    return found


def plot(path: Path, rows: list[dict[str, Any]]) -> None:
    """Minutes of the bench against mean RP; without estimation and joint."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 5.6), layout="constrained")
    panels = figure.subplots(1, len(ACCURACIES_MM), sharey=True)
    for panel, accuracy in zip(panels, ACCURACIES_MM, strict=True):
        for way in WAYS:
            for method, style in (("without", "o:"), ("joint, own SDs", "s-")):
                points = [
                    (row["minutes"], row["rp_mm"], row["ci95_half_mm"])
                    for row in chosen(rows, way, method, accuracy)
                ]
                panel.errorbar(
                    *zip(*points, strict=True), fmt=style, ms=4, color=COLORS[way], capsize=2,
                    lw=1.2, label=way if style == "s-" else None,
                )  # fmt: skip
        panel.set(
            xscale="log",
            yscale="log",
            xlabel="minutes of the bench",
            title=f"robot's pose error beyond repeatability: {accuracy:g} mm",
        )
        panel.grid(alpha=0.3, which="both")
    panels[0].set_ylabel("mean RP on images without errors (mm)")
    panels[0].plot([], [], "k:", marker="o", ms=4, label="without out-of-plane estimation")
    panels[0].plot([], [], "k-", marker="s", ms=4, label="joint, an SD for each image's offset")
    panels[0].legend(fontsize="small")
    save_figure(figure, path, dpi=110)
