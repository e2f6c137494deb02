"""Sound speed off by 2 % and a delay of 0.5 us, estimated along with X from times of flight.

The times of simulated experiments (n = 50, offsets uniform to 2 mm) become distances by a sound
speed of 1490 m/s and no delay, while they were made with 1519.8 m/s and 0.5 us. Solved on the
channels with both unknown (priors: SD 20 m/s, 1 us), with both known, and with both wrong. Reported
for each probe and channel noise: the share of trials whose estimate is within 2 of its own reported
SDs of the truth, and mean reconstruction precision (RP) against that with both known. And, on
points, what asking for the same unknowns is answered with. Seed 20261122; trial k of a cell is
fold_in(root, cell * 10^6 + k).
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from common import (
    arguments,
    experiments,
    machine,
    precision,
    save_figure,
    write_table,
)

from jaxcal import Protocol, calibrate, calibrate_batch, simulate
from jaxcal.data.probe import C5_2, L14_5
from jaxcal.data.problem import Problem
from jaxcal.data.segmentation.time_of_flight import fit_in_plane

SEED = 20261122
PROBES = {"linear": L14_5, "curvilinear": C5_2}
NOISES_MM = (0.1, 0.5)
ELEVATION_MM = 2.0
NOMINAL_M_S, TRUE_M_S, DELAY_S = 1490.0, 1490.0 * 1.02, 0.5e-6
MEDIUM = ("sound-speed", "delay")


def as_measured(problem: Problem) -> Problem:
    """The same experiment with its times turned into distances by the nominal medium."""
    channels = problem.channels
    assert channels is not None
    times = channels.distances / (1e3 * TRUE_M_S) + DELAY_S
    seen = channels.heard * 1e3 * NOMINAL_M_S * times
    fit = fit_in_plane(seen, channels.elements)
    return replace(problem, measurements=fit.position, channels=replace(channels, distances=seen))


def run_cell(cell: int, kind: str, noise: float, trials: int) -> dict[str, np.ndarray]:
    probe = PROBES[kind]
    protocol = Protocol(elevation_mm=ELEVATION_MM, noise_mm=noise, probe=probe, raw=True)
    indices = cell * 1_000_000 + jnp.arange(trials)

    drawn = experiments(SEED, indices, protocol)
    known = jax.jit(jax.vmap(lambda e: e.problem(probe=probe)))(drawn)
    measured = jax.jit(jax.vmap(as_measured))(known)
    results = {
        "estimated": calibrate_batch(measured, prior="gaussian", estimate=MEDIUM, data="channels"),
        "known": calibrate_batch(known, prior="gaussian", data="channels"),
        "wrong": calibrate_batch(measured, prior="gaussian", data="channels"),
    }
    tests = drawn.test_poses, drawn.test_points
    out = {f"rp_{name}": precision(r.image_to_probe, *tests) for name, r in results.items()}
    estimated = results["estimated"]
    out["converged"], found = np.asarray(estimated.converged), estimated.medium
    for name, value, sd, truth in (
        ("speed", found.sound_speed_m_s, found.sound_speed_sd_m_s, TRUE_M_S),
        ("delay", found.delay_s, found.delay_sd_s, DELAY_S),
    ):
        assert value is not None
        assert sd is not None
        out[name], out[f"{name}_sd"] = np.asarray(value), np.asarray(sd)
        out[f"{name}_within"] = np.abs(out[name] - truth) <= 2 * out[f"{name}_sd"]
    return out


def main() -> None:
    quick, folder = arguments(__doc__)
    trials = 40 if quick else 500
    rows, draws = [], {}
    for cell, (kind, noise) in enumerate(itertools.product(PROBES, NOISES_MM)):
        got = run_cell(cell, kind, noise, trials)
        draws[kind, noise] = got
        mean = {name: float(got[f"rp_{name}"].mean()) for name in ("estimated", "known", "wrong")}
        rows.append([
            kind, noise, trials,
            float(got["speed"].mean()), float(got["speed"].std(ddof=1)),
            float(got["speed_sd"].mean()), float(got["speed_within"].mean()),
            1e6 * float(got["delay"].mean()), 1e6 * float(got["delay"].std(ddof=1)),
            1e6 * float(got["delay_sd"].mean()), float(got["delay_within"].mean()),
            *mean.values(), mean["estimated"] / mean["known"],
            int((~got["converged"]).sum()),
        ])  # fmt: skip
        print(
            f"{kind}, noise {noise:g} mm: speed {rows[-1][3]:.2f} +- {rows[-1][5]:.2f} m/s, within "
            f"2 SD {100 * rows[-1][6]:.1f} %; delay {rows[-1][7]:.4f} +- {rows[-1][9]:.4f} us, "
            f"within 2 SD {100 * rows[-1][10]:.1f} %; RP "
            + ", ".join(f"{name} {value:.4f}" for name, value in mean.items())
            + f" mm, estimated/known {rows[-1][14]:.3f}; not converged {rows[-1][15]}",
            flush=True,
        )
    write_table(
        folder / "sound_speed_delay.csv",
        ["probe", "channel_noise_mm", "trials", "speed_mean_m_s", "speed_scatter_m_s",
         "speed_reported_sd_m_s", "speed_within_2sd", "delay_mean_us", "delay_scatter_us",
         "delay_reported_sd_us", "delay_within_2sd", "rp_estimated_mm", "rp_known_mm",
         "rp_wrong_mm", "rp_estimated_over_known", "not_converged"],
        rows,
    )  # fmt: skip
    on_points()
    print(machine())
    plot(folder / "sound_speed_delay.png", draws)


def on_points() -> None:
    """Sound speed and delay asked for on segmented points, in one experiment: the answers."""
    experiment = simulate(jax.random.key(SEED), Protocol(elevation_mm=ELEVATION_MM))
    for name in MEDIUM:
        for method in ("conventional", "joint"):
            result = calibrate(experiment.problem(), method, estimate=(name,))
            print(f"points, {method}, {name}: {result.status}; {'; '.join(result.warnings)}")


def plot(path, draws: dict) -> None:
    """Estimates of sound speed and delay against each other, a panel for each cell."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6.5), layout="constrained")
    panels = figure.subplots(len(PROBES), len(NOISES_MM))
    for axes, ((kind, noise), got) in zip(panels.ravel(), draws.items(), strict=True):
        axes.plot(got["speed"], 1e6 * got["delay"], ".", markersize=3)
        axes.plot(TRUE_M_S, 1e6 * DELAY_S, "+", color="tab:red", markersize=12, label="truth")
        axes.set(title=f"{kind}, noise {noise:g} mm", xlabel="sound speed (m/s)",
                 ylabel="delay (us)")  # fmt: skip
        axes.grid(alpha=0.3)
        axes.legend()
    save_figure(figure, path, dpi=150)


if __name__ == "__main__":
    main()
