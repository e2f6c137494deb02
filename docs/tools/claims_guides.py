"""Claims of the guides: safety, which poses, and when the stated error does not hold."""

from __future__ import annotations

from claims import ACCURACY, Row, claim, column, number, percent, table

from hw.robot.limits import CALLER_S

SAFETY, POSES, TRUST = "docs/safety.md", "docs/how-to/poses.md", "docs/understand/trust.md"

WAYS = {
    "guard": "guard reports danger",
    "stop": "`Motion.stop`",
    "interrupt": "Ctrl-C",
    "pipe": "the pipe closes",
    "kill": "the caller is killed",
    "pause": "the program is paused",
    "unreadable": "packets of NaN",
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
claim(SAFETY, "acquisition's process was silent for {:g} s | hesitation", lambda: [CALLER_S])
claim(SAFETY, "after {:g} s without a sign of life", lambda: [CALLER_S])

_PROMPT = [
    row for row in table("robot_faults") if row["fault"] not in ("lost answers", "unheeded stop")
]
claim(
    SAFETY,
    "After {:.0f} faults the robot was at rest within {:.0f} ms",
    lambda: [
        sum(number(row, "repeats") for row in _PROMPT),
        max(number(row, "rest_max_ms") for row in _PROMPT),
    ],
)
for _words, _fault in (
    ("answers were lost, within {:.0f} ms", "lost answers"),
    ("takes `stopL` but goes on, within {:.0f} ms", "unheeded stop"),
):
    claim(
        SAFETY,
        _words,
        lambda fault=_fault: [
            number(row, "rest_max_ms") for row in table("robot_faults") if row["fault"] == fault
        ],
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


# A mean of the offsets.
def _off_centre(row: Row) -> list[float]:
    """Coverage of X's translation and of TRE with each mean, %."""
    where = {name: row[name] for name in ("sd_mm", "images", "noise_mm")}
    both = (column("off_centre", of, **where) for of in ("cover_t_elevational", "held_at_points"))
    return percent(value for pair in zip(*both, strict=True) for value in pair)


claim(
    ACCURACY,
    "in % of {:.0f} simulated recordings, by the mean of the offsets",
    lambda: set(column("off_centre", "trials")),
)
claim(
    ACCURACY,
    "| images | mean {:g} mm | {:g} mm | {:g} mm | {:g} mm | {:g} mm | {:g} mm |",
    lambda: sorted(set(column("off_centre", "mean_mm"))),
)
for centred in table("off_centre"):
    if number(centred, "mean_mm") == 0:
        claim(
            ACCURACY,
            f"| {centred['sd_mm']} mm | {number(centred, 'range_sd_mm'):.2f} mm "
            f"| {centred['images']} " + 6 * "| {:.0f} / {:.0f} " + "|",
            lambda row=centred: _off_centre(row),
        )


claim(
    TRUST,
    "95 % intervals hold in as few as {:.0f} %",
    lambda: percent([min(column("off_centre", "cover_t_elevational"))]),
)


# Poses in another unit than mm.
def _told_of_unit(group: str, *columns: str) -> float:
    return sum(sum(column("pose_unit", of, group=group)) for of in columns)


claim(
    TRUST,
    "Of {:.0f} simulated recordings with poses in cm, {:.0f} were reported in this way or as wrong "
    "units; of {:.0f} in mm none was with ordinary probes, and {:.0f} with small probes",
    lambda: (
        _told_of_unit("ordinary probe, cm", "recordings"),
        _told_of_unit("ordinary probe, cm", "named", "doubted"),
        _told_of_unit("small probe, mm", "recordings"),
        _told_of_unit("small probe, mm", "named", "doubted"),
    ),
)
