"""Hardware side of jaxcal: what a bench measures becomes arrays for the engine, live or in files.

``hw`` imports ``jaxcal``, never the other way round. The small processes that talk to devices
import parts of ``hw`` too, so the engine is loaded only when ``LiveCalibration`` is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hw.acquisition.live_calibration import LiveCalibration

__all__ = ["LiveCalibration"]


def __getattr__(name: str) -> object:
    if name == "LiveCalibration":
        from hw.acquisition.live_calibration import LiveCalibration

        return LiveCalibration
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
