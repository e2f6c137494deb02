"""Targets in simulated B-mode: speckle of the same point spread, coherent sums, log compression."""

from __future__ import annotations

import zlib
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

import jaxcal
from jaxcal.data.segmentation import speckle as speckle_module
from jaxcal.data.segmentation.image import localise
from jaxcal.data.segmentation.spot import half_maximum, local_maxima

POINT_SPREAD = (3.0, 1.2)
"""SD of the envelope along u and v, px."""
SHAPE = (96, 136)


def speckle(rng: np.random.Generator, shape=SHAPE, spread=POINT_SPREAD) -> np.ndarray:
    """Fully developed: white complex noise through the point spread, unit variance in phase."""
    wave_v, wave_u = (2 * np.pi * np.fft.fftfreq(size) for size in shape)
    response = np.exp(-0.5 * ((wave_u * spread[0]) ** 2 + (wave_v[:, None] * spread[1]) ** 2))
    white = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    field = np.fft.ifft2(np.fft.fft2(white) * response)
    return field / np.sqrt(0.5 * np.mean(np.abs(field) ** 2))


def ridge(position, angle: float = 0.0, length: float = 0.0, shape=SHAPE, spread=POINT_SPREAD):
    """A point (length 0) or a piece of wire seen through the point spread, amplitude 1."""
    v, u = np.indices(shape)
    d = np.stack([u - position[0], v - position[1]])
    along = np.array([np.cos(angle), np.sin(angle)])
    precision = np.linalg.inv(np.diag(np.square(spread)) + length**2 * np.outer(along, along))
    return np.exp(-0.5 * np.einsum("iuv,ij,juv->uv", d, precision, d))


def cross(rng: np.random.Generator, position) -> np.ndarray:
    """Two wires leaning 10 to 40 degrees each way, and a fainter second echo 7 px below."""
    lean = np.radians(rng.uniform(10, 40, 2)) * [1, -1]
    signal = ridge(position, lean[0], 5.0).astype(complex)
    signal += ridge(position, lean[1], 5.0) * np.exp(1j * rng.uniform(-np.pi / 3, np.pi / 3))
    below = (position[0], position[1] + 7)
    signal += 0.2 * ridge(below, 0.0, 2.0) * np.exp(2j * np.pi * rng.random())
    return signal / np.abs(signal).max()


def display(field: np.ndarray, decibels: float = 60.0) -> np.ndarray:
    """Log compression to 8 bits, the brightest pixel at 255."""
    envelope = np.abs(field)
    level = 1 + 20 * np.log10(envelope / envelope.max()) / decibels
    return np.round(255 * np.clip(level, 0, 1)).astype(np.uint8)


def draw(target: str, count: int, contrast_db: float, seed: int, compressed: bool = True):
    """Frames (count, rows, columns) and true positions (count, 2)."""
    rng = np.random.default_rng(seed)
    positions = np.array(SHAPE)[::-1] / 2 + rng.uniform(-8, 8, (count, 2))
    frames = []
    for position in positions:
        signal = cross(rng, position) if target == "cross" else ridge(position)
        amplitude = np.sqrt(2) * 10 ** (contrast_db / 20)
        field = speckle(rng) + amplitude * np.exp(2j * np.pi * rng.random()) * signal
        frames.append(display(field) if compressed else np.abs(field))
    return np.stack(frames), positions


def normalised(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)


COUNT = 144
"""Frames of each kind."""


@pytest.fixture(scope="module")
def drawn():
    """Frames of a kind, their true positions and where they are located, each made once."""

    @cache
    def of(target: str, contrast_db: float, compressed: bool):
        frames, truth = draw(target, COUNT, contrast_db, seed=3, compressed=compressed)
        return frames, truth, localise(frames, target, compression="log" if compressed else "none")

    return of


@pytest.mark.parametrize(
    ("target", "contrast_db", "compressed", "largest_rms"),
    [
        ("echo", 18.0, True, (0.40, 0.18)),
        ("echo", 30.0, True, (0.10, 0.045)),
        ("echo", 24.0, False, (0.20, 0.09)),
        ("cross", 24.0, True, (0.26, 0.14)),
        ("cross", 34.0, True, (0.085, 0.045)),
    ],
)
def test_unbiased_and_the_covariance_is_right(drawn, target, contrast_db, compressed, largest_rms):
    _, truth, located = drawn(target, contrast_db, compressed)
    assert located.found.all(), set(located.reason)
    error = located.position - truth
    spread = error.std(axis=0, ddof=1)
    # 3.3 SDs of a mean: a thousandth of all seeds would fail without any bias.
    assert (np.abs(error.mean(axis=0)) < 3.3 * spread / np.sqrt(COUNT)).all()
    assert (np.sqrt(np.mean(error**2, axis=0)) < largest_rms).all()
    # Mean of 144 chi-squares with 2 degrees of freedom: 2 with an SD of 1 / 6.
    assert 1.5 < normalised(error, located.covariance).mean() < 2.5
    claimed = np.sqrt(located.covariance[:, [0, 1], [0, 1]].mean(axis=0))
    assert (np.abs(claimed / spread - 1) < 0.2).all()
    assert located.contrast_db.mean() == pytest.approx(contrast_db, abs=1.0)


def test_error_follows_contrast(drawn):
    """Cramer-Rao: the SD of a position is inverse to the amplitude."""
    spread = []
    for contrast in (18.0, 30.0):
        _, truth, located = drawn("echo", contrast, True)
        spread.append((located.position - truth).std(axis=0))
    # The ratio of two SDs of 144 is known to 8 %.
    np.testing.assert_allclose(spread[0] / spread[1], 10 ** (12 / 20), rtol=0.25)


def test_a_shape_that_does_not_fit_is_paid_for_in_the_covariance(drawn):
    frames, truth, crossing = drawn("cross", 34.0, True)
    half = slice(0, len(frames) // 2)
    spot = localise(frames[half], "echo")
    used = spot.found & crossing.found[half]
    assert used.mean() > 0.95
    assert (spot.residual[used] > crossing.residual[half][used]).mean() > 0.95
    error = spot.position[used] - truth[half][used]
    assert normalised(error, spot.covariance[used]).mean() < 2.4


def test_the_size_of_long_structures_is_that_of_single_lags():
    """All lags at once, by Fourier transforms, where one by one would take most of the time."""
    rng = np.random.default_rng(8)
    for size in (2.0, 9.0, 30.0, 200.0):
        values = ndimage.gaussian_filter1d(rng.normal(size=(300, 200)), size, axis=0)
        weight = (rng.random(values.shape) > 0.2).astype(float)
        values = (values - values.mean()) * weight
        assert speckle_module._speckle_size(values, weight) == pytest.approx(
            _by_single_lags(values, weight), 1e-9
        )


def _by_single_lags(values: np.ndarray, weight: np.ndarray) -> float:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(speckle_module, "_SINGLE_LAGS", 1000)
        return speckle_module._speckle_size(values, weight)


def test_speckle_alone_is_not_taken_for_a_target():
    rng = np.random.default_rng(11)
    frames = np.stack([display(speckle(rng, (128, 160))) for _ in range(200)])
    located = localise(frames, false_alarm=0.01)
    # Two are expected at most; seven have a probability of 0.005.
    assert located.found.sum() < 7
    assert np.isnan(located.position[~located.found]).all()
    assert all(located.reason[k] for k in np.flatnonzero(~located.found))
    assert "speckle alone" in " ".join(located.reason)


def test_two_equal_targets_are_ambiguous_unless_one_is_expected():
    rng = np.random.default_rng(13)
    places = np.array([[40.3, 40.6], [95.2, 55.1]])
    field = speckle(rng) + 60 * (ridge(places[0]) + ridge(places[1]))
    frame = display(field)
    located = localise(frame)
    assert not located.found[0]
    assert "ambiguous" in located.reason[0]
    for place in places:
        located = localise(frame, near=place + 3.0, within_px=15.0)
        assert located.found[0]
        np.testing.assert_allclose(located.position[0], place, atol=0.3)
    # On the flank of a target, or between the two, there is none.
    for place in ((46.0, 40.6), (67.0, 48.0)):
        located = localise(frame, near=place, within_px=4.0)
        assert not located.found[0]
        assert located.reason[0]
    left, top = 70, 20
    located = localise(frame, region=(left, top, 60, 70))
    np.testing.assert_allclose(located.position[0], places[1], atol=0.3)


def test_number_types_and_a_saturated_display_leave_the_position():
    rng = np.random.default_rng(17)
    place = (60.37, 50.71)
    field = speckle(rng) + 80 * ridge(place)
    frame = display(field)
    reference = localise(frame)
    np.testing.assert_allclose(reference.position[0], place, atol=0.2)
    for other in (
        frame.astype(float), frame.astype(np.float32), frame.astype(np.uint16) * 257,
        frame.astype(np.int64), frame / 255.0,
    ):  # fmt: skip
        np.testing.assert_allclose(localise(other).position, reference.position, atol=1e-3)
    given = localise(frame, decibels_per_level=60 / 255)
    np.testing.assert_allclose(given.position, reference.position, atol=0.02)
    np.testing.assert_allclose(given.covariance, reference.covariance, rtol=0.5)
    # A gain of 12 dB too much cuts the top off.
    clipped = np.minimum(frame.astype(int) + 51, 255).astype(np.uint8)
    assert (clipped == 255).sum() > 20
    located = localise(clipped)
    assert located.found[0]
    np.testing.assert_allclose(located.position[0], place, atol=0.2)


def test_clutter_below_the_face_leaves_the_covariance():
    """A bright band across the frame is no speckle: it once made the lateral SD far too small."""
    rng, shape = np.random.default_rng(41), (160, 136)
    places = np.array(shape)[::-1] / 2 + rng.uniform(-8, 8, (24, 2))
    band = 16.0 * (np.arange(shape[0])[:, None] < 12)
    target = np.sqrt(2) * 10 ** (30 / 20)
    fields = [speckle(rng, shape) + band + target * ridge(place, shape=shape) for place in places]
    located = localise(np.stack([display(field) for field in fields]))
    assert located.found.all(), set(located.reason)
    # With a right covariance the mean of 24 is 2 with an SD of 0.41. The band also makes the range
    # of the display look smaller, and so the SDs larger: that is the safe side.
    assert normalised(located.position - places, located.covariance).mean() < 3.2


def test_a_spot_cut_off_by_the_edge_of_a_sector_is_refused():
    """Black corners are a border as well; a spot beside them is whole, and is found."""
    rng = np.random.default_rng(43)
    v, u = np.indices(SHAPE)
    inside = u - 50.0 > 0.6 * (v - 48)
    for gap, background in ((1.0, 0.01), (1.0, 1.0), (12.0, 0.01), (12.0, 1.0)):
        place = np.array([50.0 + gap, 48.0])
        frame = display(background * speckle(rng) + 45 * ridge(place)) * inside.astype(np.uint8)
        located = localise(frame)
        assert located.found[0] == (gap > 1)
        if gap > 1:
            np.testing.assert_allclose(located.position[0], place, atol=0.4)
        else:
            assert "edge of the image" in located.reason[0]


def test_target_scatter_is_added():
    frames, _ = draw("echo", 2, 30.0, seed=19)
    plain, more = localise(frames), localise(frames, target_sd_px=(2.0, 0.5))
    np.testing.assert_allclose(more.covariance - plain.covariance, [np.diag([4.0, 0.25])] * 2)


def test_frames_without_a_target_say_why():
    rng = np.random.default_rng(23)
    shape = (64, 64)
    hot = display(speckle(rng, shape) + 0.0).astype(float) * 0.5
    hot[30, 30] = 255
    bright = np.zeros(shape)
    bright[10:60, 5:60] = 200.0
    edge = display(speckle(rng, shape) + 60 * ridge((0.0, 32.0), shape=shape))
    holed = display(speckle(rng, shape) + 60 * ridge((32.0, 32.0), shape=shape)).astype(float)
    holed[3, 4] = np.nan
    outline = 255.0 * (ridge((32.0, 32.0), shape=shape) > 0.3)
    frames = np.stack([np.zeros(shape), np.full(shape, 7.0), holed, hot, bright, edge, outline])
    located = localise(frames)
    assert not located.found.any()
    for reason, word in zip(
        located.reason,
        ("constant", "constant", "NaN", "single", "", "border", "saturated"),
        strict=True,
    ):
        assert reason
        assert word in reason
    assert np.isnan(located.covariance).all()


@pytest.mark.parametrize(
    ("frames", "options", "message"),
    [
        (np.zeros(40), {}, "shape"),
        (np.zeros((2, 40, 40, 3)), {}, "grey"),
        (np.zeros((40, 40), complex), {}, "real numbers"),
        (np.zeros((0, 0)), {}, "too small"),
        (np.zeros((3, 0, 40)), {}, "too small"),
        (np.zeros((8, 40)), {}, "too small"),
        (np.broadcast_to(np.uint8(0), (5000, 5000)), {}, "too large"),
        (np.broadcast_to(np.uint8(0), (100_001, 16, 16)), {}, "too many"),
        (np.zeros((40, 40)), {"decibels_per_level": 0.0}, "decibels"),
        (np.zeros((40, 40)), {"decibels_per_level": 0.2, "compression": "none"}, "decibels"),
        (np.zeros((40, 40)), {"region": (0, 0, 41, 40)}, "leaves"),
        (np.zeros((40, 40)), {"region": (0, 0, 10, 40)}, "too small"),
        (np.zeros((40, 40)), {"region": (0, 0, 40)}, "four whole numbers"),
        (np.zeros((40, 40)), {"near": (3.0, 4.0)}, "belong together"),
        (np.zeros((40, 40)), {"near": (np.nan, 4.0), "within_px": 5.0}, "NaN"),
        (np.zeros((40, 40)), {"near": np.zeros((2, 2)), "within_px": 5.0}, "near"),
        (np.zeros((40, 40)), {"near": (3.0, 4.0), "within_px": 0.0}, "within_px"),
        (np.zeros((40, 40)), {"false_alarm": 1.0}, "false_alarm"),
        (np.zeros((40, 40)), {"target_sd_px": -1.0}, "target_sd_px"),
    ],
)
def test_bad_input(frames, options, message):
    with pytest.raises(jaxcal.InputError, match=message):
        localise(frames, **options)


def test_local_maxima():
    """Plateaus whole, borders too, nothing of the least value, highest first, then by rows."""
    frame = np.array(
        [
            [5.0, 0.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 7.0, 7.0, 0.0],
            [0.0, 0.0, 1.0, 0.0, 0.0],
            [3.0, 0.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 0.0, 5.0],
        ]
    )
    peaks = [[1, 2], [1, 3], [0, 0], [4, 4], [3, 0]]
    np.testing.assert_array_equal(local_maxima(frame), peaks)
    np.testing.assert_array_equal(local_maxima(frame - 9), peaks)
    assert len(local_maxima(np.full((4, 5), 3.0))) == 0
    # Diagonal neighbours hide each other, and are of one area.
    stairs = np.diag([1.0, 2.0, 3.0, 2.0, 1.0])
    np.testing.assert_array_equal(local_maxima(stairs), [[2, 2]])
    shape, _ = half_maximum(stairs, (2, 2))
    np.testing.assert_array_equal(shape, np.diag([0, 1, 1, 1, 0]).astype(bool))


def test_frames_become_images_that_calibrate():
    """From rendered B-mode to X: as near the truth as the pixels allow, a lost frame masked."""
    recording = jaxcal.simulate_recording(
        jaxcal.Protocol(images=20, elevation_mm=0.0, noise_mm=0.0, depth_mm=(20.0, 60.0)), 4
    )
    points, spacing = recording.calibration.measurements, np.array([0.5, 0.4])
    offset = np.array([35.0, 0.0])  # The left edge of the image lies 35 mm left of the middle.
    shape = (170, 150)
    rng = np.random.default_rng(29)
    pixels = (points + offset) / spacing
    frames = np.stack(
        [display(speckle(rng, shape) + 70 * ridge(pixel, shape=shape)) for pixel in pixels]
    )
    frames[7] = display(speckle(rng, shape))
    located = localise(frames)
    images = jaxcal.make_images(
        recording.calibration.poses,
        located.position,
        "pixel",
        mask=located.found,
        covariance=located.covariance,
        spacing_mm=spacing,
    )
    assert list(np.flatnonzero(~images.mask)) == [7]
    assert located.reason[7]
    result = jaxcal.calibrate(jaxcal.Recording(images), method="conventional")
    assert result.converged
    assert recording.truth is not None
    expected = recording.truth.image_to_probe @ [-offset[0], 0.0, 0.0, 1.0]
    found = np.asarray(result.image_to_probe)
    assert np.linalg.norm(found[:3, 3] - expected[:3]) < 0.3
    corner = [40.0, 0.0, 40.0, 1.0]
    shifted = np.array(corner) - [offset[0], 0.0, 0.0, 0.0]
    miss = (found @ corner - recording.truth.image_to_probe @ shifted)[:3]
    assert np.linalg.norm(miss) < 0.1


@pytest.fixture(scope="module")
def wires(real_data: Path) -> np.ndarray:
    """The first 34 B-mode frames of an N-wire phantom in water, before the probe moves away."""
    path = real_data / "plus" / "NwirePhantomFreehand.igs.mha"
    content = path.read_bytes()
    start = content.index(b"\n", content.index(b"ElementDataFile")) + 1
    pixels = zlib.decompressobj().decompress(content[start:], 97 * 616 * 820)
    return np.frombuffer(pixels, np.uint8).reshape(97, 616, 820)[:34]


def test_real_wires(wires):
    """Two parallel wires: found in every frame, where a centroid is, at a steady distance."""
    upper = localise(wires, region=(180, 260, 120, 85))
    lower = localise(wires, region=(180, 345, 120, 70))
    assert upper.found.all()
    assert lower.found.all()
    for left, top, rows, located in ((180, 260, 85, upper), (180, 345, 70, lower)):
        part = wires[:, top : top + rows, left : left + 120]
        centroids = []
        for frame in part:
            areas, _ = ndimage.label(frame >= 0.7 * frame.max(), structure=np.ones((3, 3)))
            brightest = areas[np.unravel_index(frame.argmax(), frame.shape)]
            v, u = ndimage.center_of_mass(frame, areas, brightest)
            centroids.append([u + left, v + top])
        gap = located.position - np.array(centroids)
        assert (np.median(np.abs(gap), axis=0) < 1.0).all()
    distance = lower.position - upper.position
    assert (distance.std(axis=0) < 1.0).all()
    # Six wires are in the whole frame, and none above them.
    assert "ambiguous" in localise(wires[0]).reason[0]
    assert not localise(wires, region=(0, 0, 820, 150)).found.any()
