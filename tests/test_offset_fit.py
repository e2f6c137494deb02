"""What is said of the offsets' law holds for many images as well."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import jaxcal
from jaxcal.diagnostics.offset_fit import (
    CONTRADICTED,
    _law_in_words,
    contradicted,
    distribution,
    offset_law,
)
from jaxcal.model.distributions import FAMILIES

DRAWN = {
    "uniform": stats.uniform(-1, 2),
    "bell": stats.beta(3, 3, loc=-1, scale=2),
    "gaussian": stats.norm(),
    "student": stats.t(4),
}


def test_distributions_are_those_of_scipy():
    assert set(CONTRADICTED) == set(DRAWN) == set(FAMILIES)
    u = np.linspace(-4, 4, 81)
    for family, law in DRAWN.items():
        np.testing.assert_allclose(distribution(family, u), law.cdf(u * law.std()), atol=1e-9)


@pytest.mark.parametrize("count", [30, 300])
def test_true_laws_are_hardly_ever_contradicted(count):
    rng = np.random.default_rng(count)
    for family, law in DRAWN.items():
        wrong = [contradicted(2 + law.rvs(count, random_state=rng))[family] for _ in range(500)]
        # Fewer than one in a thousand; 4 of 500 have a chance of one in 6,000.
        assert sum(wrong) < 4, family


def test_many_offsets_tell_the_laws_apart():
    rng = np.random.default_rng(1)
    for family, law in DRAWN.items():
        wrong = contradicted(law.rvs(5000, random_state=rng))
        assert [name for name, beyond in wrong.items() if not beyond] == [family]


def test_words_never_name_a_law_that_the_offsets_contradict():
    said = _law_in_words({"gaussian": 1.0, "uniform": 0.0, "bell": 0.0, "student": 0.0},
                                  ["gaussian", "bell", "student"])  # fmt: skip
    assert "look uniform with sharp limits" in said
    assert said.startswith("The estimate assumes offsets that are Gaussian (100 %), but")
    none = _law_in_words({"gaussian": 1.0, "uniform": 0.0}, list(FAMILIES))
    assert none.startswith("None of the distributions compared fits the offsets")
    told = {"uniform": 0.8, "bell": 0.03, "gaussian": 0.165, "student": 0.005}
    assert _law_in_words(told, ["student"]) == (
        "Of the distributions of the offsets that were compared, the most probable: uniform with "
        "sharp limits (80 %), then Gaussian (16 %)"
    )


def test_what_was_believed_before_is_not_said_to_come_from_the_images():
    """Of 12 images: the uniform one had 40 % before them, and has less after."""
    after = {"uniform": 0.36, "bell": 0.22, "gaussian": 0.22, "student": 0.2}
    assert _law_in_words(after, []) == (
        "These images hardly tell the distributions of the offsets apart: uniform with sharp "
        "limits (36 %), then bell-shaped with sharp limits (22 %), then Gaussian (22 %), then "
        "heavy-tailed (20 %)"
    )
    # Nothing else was compared.
    assert _law_in_words({"uniform": 1.0}, []) == (
        "The offsets are taken to be uniform with sharp limits, as asked for"
    )
    assert "look Gaussian" in _law_in_words({"uniform": 1.0}, ["uniform", "bell", "student"])
    recording = jaxcal.simulate_recording(jaxcal.Protocol(images=12), 0)
    law = offset_law(jaxcal.calibrate(recording, prior="uniform").numpy())
    assert law is not None
    assert str(law["words"]).startswith("The offsets are taken to be uniform")


@pytest.mark.slow
def test_five_thousand_uniform_offsets_are_not_called_gaussian():
    protocol = jaxcal.Protocol(images=5000, elevation_mm=1.0, noise_mm=0.2)
    result = jaxcal.calibrate(jaxcal.simulate_recording(protocol, 0))
    law = offset_law(result.numpy())
    assert law is not None
    words = str(law["words"])
    assert "uniform with sharp limits" in words
    assert "gaussian" in law["contradicted"]
    assert "most probable: G" not in words
