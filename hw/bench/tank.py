"""The simulated tank but for what is in it: probe, water, target's place, beam, errors, looks.

The phantoms (:mod:`hw.bench.phantoms`) are functions of it; :mod:`hw.bench.world` puts one into it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from hw.planning.scene import Scene
from jaxcal.data.poses import targets_in_images
from jaxcal.data.probe import L14_5, LinearProbe
from jaxcal.runtime.array_types import Float

ELEMENT_MM = 2.08
"""Outer diameter of the paper's PZT5H tube, mm (section 3.2)."""

_WAVES = 96

Pose = Float[np.ndarray, "4 4"]
"""True pose of the tool centre point, tool -> base, mm."""


@dataclass(frozen=True)
class Beam:
    """The elevational profile of what the probe transmits, and how loud it is.

    Attributes:
        focus_mm: range at which the beam is thinnest.
        thickness_mm: SD across the plane, there, of the amplitude that the paper's element reports.
        spread: growth of that SD per mm of range away from the focus, far from it.
        peak: amplitude in the mid-plane at 20 mm, counts.
        directivity: exponent of the cosine of the angle off an element's normal.
    """

    focus_mm: float = 40.0
    thickness_mm: float = 0.8
    spread: float = 0.03
    peak: float = 3000.0
    directivity: float = 1.5

    def width_mm(self, range_mm: np.ndarray | float) -> np.ndarray | float:
        """Elevational SD of the amplitude that the paper's element reports at a range, mm."""
        away = np.asarray(range_mm, float) - self.focus_mm
        return np.hypot(self.thickness_mm, self.spread * away)

    def field_mm(self, range_mm: np.ndarray | float) -> np.ndarray | float:
        """Elevational SD of the field itself, one way, mm (:mod:`hw.bench.phantoms`)."""
        return np.sqrt(np.square(self.width_mm(range_mm)) - ELEMENT_MM**2 / 12.0)


@dataclass(frozen=True)
class Noise:
    """Errors of what is measured.

    Attributes:
        response_mm: SD of the mid-plane shift of the element's response, fixed for a pose.
        response_correlation_deg: turns by more than this give another shift.
        amplitude: relative SD of every line's amplitude in every frame.
        amplitude_counts: SD of the electronics' own noise, counts.
        time_s: SD of every time of flight.
        reflection: share of the lines on which a reflection is taken for the echo.
        reflection_mm: least and largest detour of a reflection.
        latency_s: age of a frame when it is sent.
    """

    response_mm: float = 0.3
    response_correlation_deg: float = 3.0
    amplitude: float = 0.015
    amplitude_counts: float = 8.0
    time_s: float = 20e-9
    reflection: float = 0.01
    reflection_mm: tuple[float, float] = (2.0, 15.0)
    latency_s: float = 0.05


@dataclass(frozen=True)
class Look:
    """How bright things are, as envelopes of at most 1, how large, and how good the images are.

    All numbers are assumptions: the paper shows no frame. They are usual for 60 dB of a linear
    array at 5 to 10 MHz.

    Attributes:
        echo: the active echo of a line at full amplitude.
        wire: a wire in the mid-plane; 0: there are no cross-wires beside the element.
        ghost: strength of the active echo's reflection relative to the echo; 0: none.
        ghost_mm: by how much deeper than the echo the reflection shows.
        ghost_share: share of the frames that show it.
        axial_mm: SD of a spot along the axial direction.
        lateral_mm: SD of a point's two-way spot along the lateral direction, in focus.
        focus_mm: depth of the transmit focus; None: set to the target's depth in every image.
        defocus: growth of the transmit beam's lateral SD per mm off its focus.
        speckle_db: level of the background, dB below white.
        face: envelope of the ringing at the probe's face; 0: none.
        beside_mm: place where the wires cross, relative to the element, in the base frame.
    """

    echo: float = 0.9
    wire: float = 0.25
    ghost: float = 0.08
    ghost_mm: float = 7.0
    ghost_share: float = 0.5
    axial_mm: float = 0.35
    lateral_mm: float = 0.6
    focus_mm: float | None = None
    defocus: float = 0.05
    speckle_db: float = 34.0
    face: float = 0.0
    beside_mm: tuple[float, float, float] = (12.0, 9.0, 0.0)

    def two_way_mm(self, range_mm: float, target_mm: float) -> float:
        """Lateral SD of a passive point's spot: the transmit beam times the receive beam, mm.

        The receive aperture is focused at every depth; the transmit beam only at its focus.

        Args:
            range_mm: of the point.
            target_mm: range at which the operator puts the focus, where it is not fixed.
        """
        focus = target_mm if self.focus_mm is None else self.focus_mm
        receive = np.sqrt(2.0) * self.lateral_mm
        transmit = np.hypot(receive, self.defocus * (range_mm - focus))
        return float(1.0 / np.hypot(1.0 / receive, 1.0 / transmit))


@dataclass(frozen=True)
class Place:
    """Where the target truly is in the image, mm: lateral, range from the element line, offset."""

    lateral_mm: float
    range_mm: float
    elevation_mm: float


@dataclass(frozen=True)
class Tank:
    """One simulated bench without its phantom.

    Attributes:
        image_to_probe: (4, 4) the true X: image -> tool centre point, mm.
        point_mm: (3,) the target in the robot's base frame.
        scene: what a person knows of them beforehand, off by some mm and degrees.
        probe: the transducer.
        sound_speed_m_s: the true one; that of ``probe`` is the assumed one.
        delay_s: the electronics' fixed delay, true.
        clock_hz: the counter behind the times of flight.
        beam: elevational profile.
        noise: errors of what is measured.
        seed: of the response's shift.
    """

    image_to_probe: Float[np.ndarray, "4 4"]
    point_mm: Float[np.ndarray, " 3"]
    scene: Scene
    probe: LinearProbe = L14_5
    sound_speed_m_s: float = 1490.0
    delay_s: float = 0.0
    clock_hz: float = 100e6
    beam: Beam = field(default_factory=Beam)
    noise: Noise = field(default_factory=Noise)
    seed: int = 0

    def target(self, pose: Pose) -> Float[np.ndarray, " 3"]:
        """The target in the image frame, mm."""
        return targets_in_images(pose, self.image_to_probe, self.point_mm)

    def truth(self, pose: Pose) -> Place:
        """Where the target truly is when the tool centre point is at ``pose``."""
        lateral, elevation, axial = self.target(np.asarray(pose, float))
        return Place(float(lateral), float(np.hypot(elevation, axial)), float(elevation))

    def field(self, pose: Pose, stream: int = 0) -> float:
        """A smooth random field over the orientation: mean 0, SD 1, three degrees long.

        Args:
            pose: of the tool centre point.
            stream: another one is independent.
        """
        frequency, phase = _waves(self.seed, stream, self.noise.response_correlation_deg)
        wave = np.cos(frequency @ pose[:3, :3].reshape(9) + phase)
        return float(np.sqrt(2 / _WAVES) * wave.sum())

    def response_shift_mm(self, pose: Pose, scale: float) -> float:
        """Elevational place where a sensor hears the most, at this orientation, mm.

        Args:
            pose: of the tool centre point.
            scale: the sensor's :attr:`hw.bench.phantoms.Phantom.response_scale`.
        """
        size = self.noise.response_mm * scale
        return float(size * self.field(pose)) if size > 0 else 0.0

    @cached_property
    def elements(self) -> Float[np.ndarray, " elements"]:
        """Lateral positions of the probe's elements, mm."""
        return self.probe.element_lateral()


@lru_cache(maxsize=256)
def _waves(seed: int, stream: int, correlation_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies and phases of the waves that make up a field."""
    rng = np.random.default_rng([seed, 0x5EED] if stream == 0 else [seed, 0x5EED, stream])
    # Rotations an angle t apart differ by sqrt(2) t in the Frobenius norm.
    length = np.sqrt(2) * np.radians(correlation_deg)
    return rng.normal(size=(_WAVES, 9)) / length, rng.uniform(0, 2 * np.pi, _WAVES)
