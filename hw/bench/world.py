"""The simulated world: one probe, one phantom in water, and what each of them measures.

Everything is a function of the *true* pose of the tool centre point (mm, tool -> base), and cheap
enough for every frame. The phantom (:mod:`hw.bench.phantoms`) is the active echo element unless
another one is put into the tank. The element hears every transmitted line:

    amplitude_k = peak sqrt(r_0 / r) exp(-(y - s)^2 / (2 w(r)^2)) cos(theta_k)^p

with y the target's elevational offset, w(r) the beam's elevational SD, which is least at the focus,
theta_k the angle off element k's normal, and s the response's own shift. The element answers a line
whose amplitude reaches the threshold. Its time of flight is then that of the straight way, except
for a few lines on which a reflection, some millimetres longer, is taken for the echo.

The shift s is the mid-plane accuracy of the published electronics (+-0.3 mm): an element of finite
size does not hear the most at its middle, but at a place that depends on where the sound comes
from. So the shift is fixed for a pose and differs from pose to pose: reading again, or searching
longer, does *not* average it away. Of the two ways to read the published number this is the harder
case. The shift is a smooth random field over the orientation (correlation length three degrees),
normally distributed with SD 0.3 mm, again the harder way to read "+-". This follows the paper,
which explains the limited mid-plane accuracy by the 2 mm of the element (section 4.2); the shift is
taken to be in proportion to a sensor's size.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from hw.bench.phantoms import ActiveEcho, Phantom, phantom_named
from hw.bench.phantoms.phantom import ELEMENT_MM
from hw.rigid import looking_rotation, rigid, rotation_matrix
from hw.scene import Scene
from hw.shapes import Bool, Float
from jaxcal import InputError
from jaxcal.data.probe import L14_5, LinearProbe

FULL_SCALE = 4095
"""Largest amplitude that the electronics' 12-bit converter tells, counts."""

_WAVES = 96


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
        """Elevational SD of the field itself, one way, mm (:mod:`hw.bench.phantoms.phantom`)."""
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
class Place:
    """Where the target truly is in the image, mm: lateral, range from the element line, offset."""

    lateral_mm: float
    range_mm: float
    elevation_mm: float


@dataclass(frozen=True)
class World:
    """One simulated bench; :func:`make_world` draws one.

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
        phantom: what is in the tank.
    """

    image_to_probe: Float[np.ndarray, "4 4"]
    point_mm: Float[np.ndarray, 3]
    scene: Scene
    probe: LinearProbe = L14_5
    sound_speed_m_s: float = 1490.0
    delay_s: float = 0.0
    clock_hz: float = 100e6
    beam: Beam = field(default_factory=Beam)
    noise: Noise = field(default_factory=Noise)
    seed: int = 0
    phantom: Phantom = field(default_factory=ActiveEcho)

    def target(self, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, 3]:
        """The target in the image frame: q = X^-1 B^-1 c, mm."""
        return self.target_of(pose, self.point_mm)

    def target_of(
        self, pose: Float[np.ndarray, "4 4"], point_mm: Float[np.ndarray, 3]
    ) -> Float[np.ndarray, 3]:
        """Any point of the base frame in the image frame, mm."""
        x = self.image_to_probe
        in_tool = (point_mm - pose[:3, 3]) @ pose[:3, :3]
        return (in_tool - x[:3, 3]) @ x[:3, :3]

    def truth(self, pose: Float[np.ndarray, "4 4"]) -> Place:
        """Where the target truly is when the tool centre point is at ``pose``."""
        lateral, elevation, axial = self.target(np.asarray(pose, float))
        return Place(float(lateral), float(np.hypot(elevation, axial)), float(elevation))

    def field(self, pose: Float[np.ndarray, "4 4"], stream: int = 0) -> float:
        """A smooth random field over the orientation: mean 0, SD 1, three degrees long.

        Args:
            pose: of the tool centre point.
            stream: another one is independent.
        """
        frequency, phase = _waves(self.seed, stream, self.noise.response_correlation_deg)
        wave = np.cos(frequency @ pose[:3, :3].reshape(9) + phase)
        return float(np.sqrt(2 / _WAVES) * wave.sum())

    def shift_mm(self, pose: Float[np.ndarray, "4 4"]) -> float:
        """Elevational place where the response is strongest, at this orientation, mm."""
        size = self.noise.response_mm * self.phantom.response_scale
        return float(size * self.field(pose)) if size > 0 else 0.0

    @cached_property
    def elements(self) -> Float[np.ndarray, " elements"]:
        """Lateral positions of the probe's elements, mm."""
        return self.probe.element_lateral()

    def loudness(self, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " elements"]:
        """Amplitude of every line at the phantom without noise or saturation, counts."""
        return self.phantom.loudness(self, pose)

    def echo(
        self, pose: Float[np.ndarray, "4 4"], threshold: int, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, " elements"], Float[np.ndarray, " elements"]]:
        """What the element reports of one frame.

        Args:
            pose: true, tool -> base, mm.
            threshold: amplitude from which it answers, counts.
            rng: of this frame's noise.

        Returns:
            one-way times of flight (s, a whole number of clock periods; NaN: no answer) and
            amplitudes (counts, whole, at most full scale; 0 without an answer).
        """
        count, noise = self.probe.elements, self.noise
        normal = rng.standard_normal((3, count))
        amplitude = self.loudness(pose) * (1 + noise.amplitude * normal[0])
        amplitude = np.rint(amplitude + self.phantom.noise_counts(self) * normal[1])
        amplitude = np.clip(amplitude, 0, FULL_SCALE)
        heard = amplitude >= max(threshold, 1)

        lateral, elevation, axial = self.target(pose)
        way = np.sqrt((lateral - self.elements) ** 2 + elevation**2 + axial**2)
        if noise.reflection > 0:
            late = rng.random(count) < noise.reflection
            way = way + late * rng.uniform(*noise.reflection_mm, size=count)
        time = way / (1e3 * self.sound_speed_m_s) + self.delay_s + noise.time_s * normal[2]
        time = np.rint(time * self.clock_hz) / self.clock_hz
        return np.where(heard & (time > 0), time, np.nan), np.where(heard, amplitude, 0.0)

    def answers(self, pose: Float[np.ndarray, "4 4"], threshold: int) -> Bool[np.ndarray, " e"]:
        """Which lines the element answers, noise apart."""
        return self.loudness(pose) >= max(threshold, 1)

    def test_set(
        self, count: int = 50, seed: int = 1
    ) -> tuple[Float[np.ndarray, "count 4 4"], Float[np.ndarray, "count 2"]]:
        """Noise-free in-plane test images, for Eq. 8: true poses and [lateral, range], mm.

        Targets are uniform over three quarters of the field, as in the simulated studies; the probe
        is turned by up to 30 degrees about a random axis.
        """
        rng = np.random.default_rng([self.seed, seed, 0x7E57])
        half = 0.75 * self.probe.width_mm / 2
        points = np.stack([rng.uniform(-half, half, count), rng.uniform(20.0, 80.0, count)], 1)
        poses = np.tile(np.eye(4), (count, 1, 1))
        looking = looking_rotation(self.scene.looking)
        for pose, (lateral, depth) in zip(poses, points, strict=True):
            axis = rng.normal(size=3)
            turn = axis / np.linalg.norm(axis) * np.radians(30.0) * rng.random()
            pose[:3, :3] = looking @ rotation_matrix(turn) @ self.image_to_probe[:3, :3].T
            place = self.image_to_probe[:3, :3] @ [lateral, 0.0, depth] + self.image_to_probe[:3, 3]
            pose[:3, 3] = self.point_mm - pose[:3, :3] @ place
        return poses, points


@lru_cache(maxsize=256)
def _waves(seed: int, stream: int, correlation_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies and phases of the waves that make up a field."""
    rng = np.random.default_rng([seed, 0x5EED] if stream == 0 else [seed, 0x5EED, stream])
    # Rotations an angle t apart differ by sqrt(2) t in the Frobenius norm.
    length = np.sqrt(2) * np.radians(correlation_deg)
    return rng.normal(size=(_WAVES, 9)) / length, rng.uniform(0, 2 * np.pi, _WAVES)


DRAWN = rigid(np.array([0.0, 0.0, np.radians(20.0)]), np.array([6.0, -4.0, 60.0]))
"""X as the drawing of the emulated mount has it: image -> tool centre point, mm."""

TANK_MM = np.array([350.0, -250.0, 80.0])
"""Where a person would say that the target is, in the base frame, mm."""


def make_world(seed: int = 0, **changes) -> World:
    """A bench whose mount and target are off the scene by up to 2 mm and 1.5 degrees an axis.

    Args:
        seed: of these differences, and of the response's shift.
        changes: attributes of :class:`World`, or of its ``noise`` and ``beam``, by their names. A
            phantom may be given by its name.

    Raises:
        InputError: an unknown name, an impossible sound speed or clock, or a beam thinner than the
            paper's element.
    """
    rng = np.random.default_rng([seed, 0x0B])
    off = rng.uniform(-1, 1, size=(3, 3))
    error = rigid(np.radians(1.5) * off[0], 2.0 * off[1])
    scene = Scene(DRAWN, TANK_MM, np.array([0.0, 0.0, -1.0]))
    world = World(DRAWN @ error, TANK_MM + 2.0 * off[2], scene, seed=seed)
    for name, value in changes.items():
        if name == "phantom" and isinstance(value, str):
            value = phantom_named(value)
        if name in Noise.__dataclass_fields__:
            world = replace(world, noise=replace(world.noise, **{name: value}))
        elif name in Beam.__dataclass_fields__:
            world = replace(world, beam=replace(world.beam, **{name: value}))
        elif name in World.__dataclass_fields__:
            world = replace(world, **{name: value})
        else:
            raise InputError(f"the simulated world has no {name!r}")
    if not 500 < world.sound_speed_m_s < 3000 or not 1e5 <= world.clock_hz <= 1e10:
        raise InputError("the sound speed must be in m/s and the clock in Hz")
    if world.beam.thickness_mm <= ELEMENT_MM / np.sqrt(12.0):
        raise InputError(
            "the beam's thickness_mm is what an element of 2.08 mm reports: it must exceed 0.6 mm"
        )
    return world
