"""The paper's experiment (sections 3.2, 3.3, 4.2, 4.3, Table 4) in the emulated tank, and beyond.

Active echo element (AE), cross-wire (CW) and hydrophone (OH) are imaged at shared orientations; X
is calibrated from each and judged on each. ``tank.py`` is the model, with the source of every
constant.

    --part validation    the fast model against frames, electronics and procedures of the bench
    --part table4        every cell of Table 4, ours beside the paper's; statements of 4.2 and 4.3
    --part sensitivity   the conclusions against sizes, beam, poses, robot and sound speed
    --part planning      time against precision: placements by the bench's own durations
    --part bounds        image-specific bounds and SDs of the offsets against one bound and ``auto``
    --part page          the tables of docs/results/paper-experiment.md

All parts by default. They run through the study engine: chunks are kept in studies/, an interrupted
run goes on, ``--workers N`` uses processes and ``--dask ADDRESS`` a cluster. Seed 20261122; 128
experiments a cell (``--quick``: 16, minutes).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

from common import machine
from tank_bounds import bounds
from tank_page import page
from tank_planning import planning
from tank_run import Run
from tank_sensitivity import sensitivity
from tank_table4 import table4
from tank_validation import validation

PARTS: dict[str, Callable[[Run], None]] = {
    "validation": validation,
    "table4": table4,
    "sensitivity": sensitivity,
    "planning": planning,
    "bounds": bounds,
    "page": page,
}


def main() -> None:
    """Run the parts that were asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="few experiments; minutes")
    parser.add_argument("--part", choices=list(PARTS), action="append", help="only this one")
    parser.add_argument("--workers", type=int, default=0, help="processes on this machine")
    parser.add_argument("--dask", default=None, metavar="ADDRESS", help="of a Dask scheduler")
    given = parser.parse_args()
    run = Run(given.quick, given.workers, given.dask)
    for name in given.part or PARTS:
        PARTS[name](run)
    print(machine())


if __name__ == "__main__":
    main()
