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
    "takes {:.0f} us in a batch (robust: {:.0f} us). One frame after the other, scipy takes {:.0f} "
    "times as long with its defaults, {:.0f} times with MINPACK and exact Jacobians, and {:.0f} "
    "times where both are robust.",
    lambda: (
        _segmentation("least squares", "jaxcal_us_per_trial"),
        _segmentation("robust", "jaxcal_us_per_trial"),
        _segmentation("least squares", "median_ratio", against="scipy, plain"),
        _segmentation("least squares", "median_ratio", against="scipy, best"),
        _segmentation("robust", "median_ratio"),
    ),
)


def _accelerator(method: str, prior: str, images: int) -> float:
    found = only("accelerator", "problems_per_s", method=method, prior=prior, images=str(images))
    return round(found, -3)


claim(
    SPEED,
    "batches of {:,.0f} problems in float64",
    lambda: [max(column("accelerator", "problems"))],
)
for images in (20, 50):
    claim(
        SPEED,
        f"| {images} " + 3 * "| {:,.0f} " + "|",
        lambda images=images: [
            _accelerator("conventional", "auto", images),
            _accelerator("joint", "gaussian", images),
            _accelerator("joint", "auto", images),
        ],
    )
claim(
    SPEED,
    "That is {:.1f} to {:.1f} times what all {:.0f} cores",
    lambda: (*span(column("accelerator", "ratio")), max(column("accelerator", "cores"))),
)
OURS, FAR, FITTED = "calibrate_batch", "20 degrees, 20 mm off", "conventional fit"


def _over(peer: str, start: str = FAR, *, of: str = "solver_peers", which: str = "median") -> float:
    """How many times as long as ours a peer takes."""
    return only(of, f"calibrate_batch_over_it_{which}", solver=peer, start=start, images="50")


claim(
    SPEED,
    "solves {:,.0f} problems a second.",
    lambda: [
        round(
            only("solver_peers", "solves_per_s_median", solver=f"{OURS}, given SDs", images="50"),
            -2,
        )
    ],
)
for words, peer in (("Ceres (DENSE_SCHUR)", "DENSE_SCHUR"), ("Ceres' TinySolver", "TinySolver")):
    claim(
        SPEED,
        f"| {words} | {{:.1f}} | {{:.1f}} |",
        lambda peer=peer: (
            _over(f"Ceres {peer}, 1e-9"),
            _over(f"Ceres {peer}, 1e-9, from the conventional fit", FITTED),
        ),
    )
for words, peer in (
    ("scipy with exact Jacobians", "scipy lm, 1e-8 (its default)"),
    ("optimistix", "optimistix LM, vmapped, 1e-3"),
):
    claim(SPEED, f"| {words} | {{:.0f}} | |", lambda peer=peer: [_over(peer)])
claim(
    SPEED,
    "at most {:.1e} above the lowest",
    lambda: [max(column("solver_peers", "largest_relative_excess", start=(FAR, FITTED)))],
)
claim(
    SPEED,
    "(DENSE_SCHUR) took {:.1f} times as long (single rounds: {:.1f} to {:.1f})",
    lambda: [
        _over("Ceres DENSE_SCHUR, 1e-9", of="solver_peers_avx512", which=which)
        for which in ("median", "min", "max")
    ],
)


def _us(method: str) -> float:
    return only("solver_peers", "us_per_problem", solver=f"{OURS}, {method}", images="50")


def _first_call(method: str) -> float:
    return only("public_calls", "median", part="first call", method=method, unit="CPU s")


for words, method in (
    ("given SDs", "given SDs"),
    ("self-tuned SDs", "REML"),
    ("prior auto", "auto"),
    ("conventional", "conventional"),
):
    claim(
        SPEED,
        f"| {words} | {{:.0f}} us | {{:.1f}} s |",
        lambda method=method: (_us(method), _first_call(method)),
    )
for words, method in (
    ("alternation", "alternation"),
    ("bounded offsets", "bounded"),
    ("pixels of unknown size", "pixels, unknown scale"),
    ("times of flight of 32 elements", "channels"),
):
    claim(SPEED, f"| {words} | {{:.0f}} us | |", lambda method=method: [_us(method)])
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
