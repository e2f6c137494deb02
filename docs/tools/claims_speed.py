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
    "That is {:.0f} times as many as numpy with scipy at its best (exact Jacobians, MINPACK), "
    "{:.0f} times as many as with scipy's defaults, and {:.0f} times where scipy segments as well. "
    "A whole trial of the joint method takes {:.2f} times",
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
    "{:.0f} to {:.0f} MiB at most; within the largest, first and last quarter differ by "
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
claim(
    SPEED,
    "prior auto costs {:.1f} times the self-tuned Gaussian solve.",
    lambda: [only("auto_cost", "over_gaussian", images="50", contestant="auto")],
)
