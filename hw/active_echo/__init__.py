"""Active-echo electronics: the element that hears each transmitted line, and can answer."""

from __future__ import annotations

from hw.active_echo.device import ActiveEcho, EchoFrame, EchoStatistics

__all__ = ["ActiveEcho", "EchoFrame", "EchoStatistics"]
