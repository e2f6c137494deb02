"""Claims of the page on speed."""

from __future__ import annotations

from claims import SPEED, claim, column, number, only, span, table, trials

claim(
    SPEED,
    "takes {:.0f} us of CPU: {:,.0f} trials a second on both cores.",
    lambda: (
        1e6 / trials("jaxcal study: trials a second of CPU time, one core"),
        round(trials("jaxcal study: trials a second, two cores"), -2),
    ),
)


def _throughput(peer: str) -> float:
    return trials(f"ratio to numpy and scipy, {peer}: trials a second, two cores")


claim(
    SPEED,
    "That is {:.0f} times as many as with numpy and scipy at its best (exact Jacobians, MINPACK), "
    "{:.0f} times as many as with scipy's defaults, and {:.0f} times as many if scipy segments as "
    "well. A whole trial of the joint method takes {:.2f} times",
    lambda: (
        *(_throughput(peer) for peer in ("best", "usual", "plain")),
        trials(
            "a whole trial of the joint method over its random numbers alone plus its solve alone"
        ),
    ),
)


def _memory() -> list[float]:
    largest = max(table("study_memory"), key=lambda row: float(row["trials"]))
    quarters = [number(largest, f"{name}_quarter_mib") for name in ("first", "last")]
    return [*span(column("study_memory", "peak_mib")), abs(quarters[1] - quarters[0])]


claim(
    SPEED,
    "memory is flat from {:,.0f} to {:,.0f} trials,",
    lambda: span(column("study_memory", "trials")),
)
claim(
    SPEED,
    "{:.0f} to {:.0f} MiB at most; in the largest study, the first and the last quarter differ by "
    "{:.1f} MiB.",
    _memory,
)


def _segmentation(case: str, of: str, **where: str) -> float:
    return column("benchmark_segmentation", of, case=case, **where)[0]


claim(
    SPEED,
    "takes {:.0f} us in a batch (robust: {:.0f} us), {:.0f} times less than scipy in a loop, and "
    "{:.0f} times less than MINPACK with exact Jacobians (robust: {:.0f} times).",
    lambda: (
        _segmentation("least squares", "jaxcal_us_per_trial"),
        _segmentation("robust", "jaxcal_us_per_trial"),
        _segmentation("least squares", "median_ratio", against="scipy, plain"),
        _segmentation("least squares", "median_ratio", against="scipy, best"),
        _segmentation("robust", "median_ratio"),
    ),
)


def _accelerator(method: str, prior: str, images: int = 20) -> float:
    found = only("accelerator", "problems_per_s", method=method, prior=prior, images=str(images))
    return round(found, -3)


claim(
    SPEED,
    "batches of {:,.0f} problems of {:.0f} images in float64 on an NVIDIA H100: {:,.0f} "
    "conventional calibrations a second, {:,.0f} self-tuned Gaussian ones, {:,.0f} with prior "
    "auto; with {:.0f} images {:,.0f}, {:,.0f} and {:,.0f}. That is {:.1f} to {:.1f} times what "
    "all {:.0f} cores",
    lambda: (
        max(column("accelerator", "problems")),
        min(column("accelerator", "images")),
        _accelerator("conventional", "auto"),
        _accelerator("joint", "gaussian"),
        _accelerator("joint", "auto"),
        max(column("accelerator", "images")),
        _accelerator("conventional", "auto", 50),
        _accelerator("joint", "gaussian", 50),
        _accelerator("joint", "auto", 50),
        *span(column("accelerator", "ratio")),
        max(column("accelerator", "cores")),
    ),
)
OURS, FAR, FITTED = "calibrate_batch", "20 degrees, 20 mm off", "conventional fit"


def _over(peer: str, start: str = FAR, *, of: str = "solver_peers", which: str = "median") -> float:
    """How many times as long as ours a peer takes."""
    return only(of, f"calibrate_batch_over_it_{which}", solver=peer, start=start, images="50")


claim(
    SPEED,
    "solves {:,.0f} problems a second. That is {:.1f} times as many as Ceres (DENSE_SCHUR), "
    "{:.1f} times its TinySolver, {:.0f} times scipy with exact Jacobians and {:.0f} times "
    "optimistix;",
    lambda: (
        round(
            only("solver_peers", "solves_per_s_median", solver=f"{OURS}, given SDs", images="50"),
            -2,
        ),
        _over("Ceres DENSE_SCHUR, 1e-9"),
        _over("Ceres TinySolver, 1e-9"),
        _over("scipy lm"),
        _over("optimistix LM, vmapped"),
    ),
)
claim(
    SPEED,
    "Ceres (DENSE_SCHUR) took {:.1f} times as long (single rounds: {:.1f} to {:.1f})",
    lambda: [
        _over("Ceres DENSE_SCHUR, 1e-9", of="solver_peers_avx512", which=which)
        for which in ("median", "min", "max")
    ],
)
claim(
    SPEED,
    "Ceres takes {:.1f} times as long as all of `calibrate_batch` (TinySolver: {:.1f}).",
    lambda: (
        _over("Ceres DENSE_SCHUR, 1e-9, from the conventional fit", FITTED),
        _over("Ceres TinySolver, 1e-9, from the conventional fit", FITTED),
    ),
)
claim(
    SPEED,
    "A problem takes {:.0f} us with self-tuned SDs, {:.0f} us with prior auto, {:.0f} us by the "
    "alternation, {:.0f} us with bounded offsets, {:.0f} us with pixels of unknown size, and "
    "{:.0f} us on the times of flight",
    lambda: [
        only("solver_peers", "us_per_problem", solver=f"{OURS}, {method}", images="50")
        for method in (
            "REML", "auto", "alternation", "bounded", "pixels, unknown scale", "channels"
        )
    ],
)  # fmt: skip
claim(
    SPEED,
    "It takes {:.1f} s of CPU for the conventional method, {:.1f} s with given SDs, {:.1f} s with "
    "self-tuned SDs and {:.0f} s with prior auto.",
    lambda: [
        only("public_calls", "median", part="first call", method=method, unit="CPU s")
        for method in ("conventional", "given SDs", "REML", "auto")
    ],
)
claim(
    SPEED,
    "The results agree to {:.0e} mm. The first call takes {:.0f} to {:.0f} s",
    lambda: [
        max(column("accelerator", "largest_apart_mm")),
        *span(column("accelerator", "first_call_s")),
    ],
)
claim(
    SPEED,
    "prior auto costs {:.1f} times the self-tuned Gaussian solve.",
    lambda: [only("auto_cost", "over_gaussian", images="50", contestant="auto")],
)


def _waits(command: str) -> list[float]:
    """The first run ever, the second, and one of another number of images where there is one."""
    return column("time_to_answer", "wall_s", command=command)


def _bare() -> list[float]:
    """The bare process with JAX: a command's times over their ratios to it."""
    rows = [row for row in table("time_to_answer") if row["command"] == "joint, auto"]
    return [number(row, "wall_s") / number(row, "wall_ratio") for row in rows]


claim(
    SPEED,
    "| a process that imports JAX and makes an array of three zeros " + 3 * "| {:.1f} " + "|",
    _bare,
)
for words, command in (
    ("`jaxcal calibrate --method conventional`, which imports no JAX", "conventional"),
    ("`jaxcal calibrate --method alternating`", "alternating"),
    ("`jaxcal calibrate --prior gaussian`", "joint, gaussian"),
    ("`jaxcal calibrate`", "joint, auto"),
    ("`jaxcal calibrate --robust`", "joint, robust"),
    ("times of flight of a curvilinear probe, 60 images", "channels"),
    ("a small study", "study"),
    ("the emulated bench, to its first estimate", "bench, first estimate"),
):
    claim(
        SPEED,
        f"| {words} " + len(_waits(command)) * "| {:.1f} " + "|",
        lambda command=command: _waits(command),
    )
claim(
    SPEED,
    "from the command to the answer, in s (median of {:.0f})",
    lambda: set(column("time_to_answer", "rounds")),
)
