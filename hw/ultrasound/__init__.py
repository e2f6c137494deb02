"""The ultrasound machine: images, RF channel data and transforms through OpenIGTLink."""

from __future__ import annotations

from hw.ultrasound.receiver import Image, Transform, UltrasoundStatistics, UltrasoundStream

__all__ = ["Image", "Transform", "UltrasoundStatistics", "UltrasoundStream"]
