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

import numpy as np

from hw.bench.phantoms import ActiveEcho, Phantom, phantom_named
from hw.bench.tank import ELEMENT_MM, Beam, Noise, Pose, Tank
from hw.planning.scene import Scene
from hw.runtime.rigid import looking_rotation, rigid
from jaxcal import InputError
from jaxcal.data.poses import rotations_from_vectors
from jaxcal.runtime.array_types import Float

FULL_SCALE = 4095
"""Largest amplitude that the electronics' 12-bit converter tells, counts."""


@dataclass(frozen=True)
class World(Tank):
    """One simulated bench; :func:`make_world` draws one.

    Attributes:
        phantom: what is in the tank.
    """

    phantom: Phantom = field(default_factory=ActiveEcho)

    def loudness(self, pose: Pose) -> Float[np.ndarray, " elements"]:
        """Amplitude of every line at the phantom without noise or saturation, counts."""
        return self.phantom.loudness(self, pose)

    def echoes(
        self, pose: Pose, threshold: int, rng: np.random.Generator, frames: int
    ) -> tuple[Float[np.ndarray, "frames elements"], Float[np.ndarray, "frames elements"]]:
        """What the element reports of some frames at one place.

        Args:
            pose: true, tool -> base, mm.
            threshold: amplitude from which it answers, counts.
            rng: of the frames' noise.
            frames: how many.

        Returns:
            one-way times of flight (s, a whole number of clock periods; NaN: no answer) and
            amplitudes (counts, whole, at most full scale; 0 without an answer).
        """
        count, noise = self.probe.elements, self.noise
        loudness, floor = self.loudness(pose), self.phantom.noise_counts(self)
        lateral, elevation, axial = self.target(pose)
        straight = np.sqrt((lateral - self.elements) ** 2 + elevation**2 + axial**2)
        times, amplitudes = np.empty((2, frames, count))
        for frame in range(frames):
            normal = rng.standard_normal((3, count))
            amplitude = np.rint(loudness * (1 + noise.amplitude * normal[0]) + floor * normal[1])
            amplitude = np.clip(amplitude, 0, FULL_SCALE)
            heard = amplitude >= max(threshold, 1)
            way = straight
            if noise.reflection > 0:
                late = rng.random(count) < noise.reflection
                way = way + late * rng.uniform(*noise.reflection_mm, size=count)
            time = way / (1e3 * self.sound_speed_m_s) + self.delay_s + noise.time_s * normal[2]
            time = np.rint(time * self.clock_hz) / self.clock_hz
            times[frame] = np.where(heard & (time > 0), time, np.nan)
            amplitudes[frame] = np.where(heard, amplitude, 0.0)
        return times, amplitudes

    def echo(
        self, pose: Pose, threshold: int, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, " elements"], Float[np.ndarray, " elements"]]:
        """What the element reports of one frame, as by :meth:`echoes`."""
        times, amplitudes = self.echoes(pose, threshold, rng, 1)
        return times[0], amplitudes[0]

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
            pose[:3, :3] = looking @ rotations_from_vectors(turn) @ self.image_to_probe[:3, :3].T
            place = self.image_to_probe[:3, :3] @ [lateral, 0.0, depth] + self.image_to_probe[:3, 3]
            pose[:3, 3] = self.point_mm - pose[:3, :3] @ place
        return poses, points


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
