"""Claims of the guides: safety, and which poses."""

from __future__ import annotations

from claims import Row, claim, number, table

SAFETY, POSES = "docs/safety.md", "docs/how-to/poses.md"

WAYS = {
    "guard": "guard reports danger",
    "stop": "`Motion.stop`",
    "interrupt": "Ctrl-C",
    "pipe": "the pipe closes",
    "kill": "the caller is killed",
}


def _stops(row: Row) -> list[float]:
    names = ("trials", "moving", "lost", "rest_median_ms", "rest_max_ms")
    return [number(row, name) for name in (*names, "travel_median_mm", "travel_max_mm")]


for stopped in table("stops"):
    claim(
        SAFETY,
        f"| {stopped['series']} | {WAYS[stopped['way']]} "
        "| {:.0f} | {:.0f} | {:.0f} | {:.0f} / {:.0f} ms | {:.1f} / {:.1f} mm |",
        lambda row=stopped: _stops(row),
    )
claim(
    SAFETY,
    "{:.0f} of {:,.0f} stops were lost",
    lambda: [sum(number(row, name) for row in table("stops")) for name in ("lost", "trials")],
)
claim(
    POSES,
    "errors of plans are at most {:.1f} % above",
    lambda: [
        max(
            100 * (number(row, "planned_tre_mm") / number(row, "least_tre_mm") - 1)
            for row in table("pose_design_bound")
        )
    ],
)
