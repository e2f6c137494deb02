"""Hardware side of jaxcal: what a bench measures becomes arrays for the engine, live or in files.

Drivers (robot, active-echo electronics, ultrasound stream) will live here; ``hw`` imports
``jaxcal``, never the other way round.
"""

from __future__ import annotations

from hw.live import LiveCalibration

__all__ = ["LiveCalibration"]
