"""What a recording refuses, beyond what the readers' own tests hold."""

import numpy as np
import pytest

import jaxcal
from jaxcal import InputError


def arrays() -> dict:
    images = jaxcal.simulate_recording(jaxcal.Protocol(images=6, test_images=4)).calibration
    return {"poses": np.array(images.poses), "measurements": np.array(images.measurements)}


@pytest.mark.parametrize("name", ["poses", "measurements", "covariance"])
def test_numbers_beyond_any_measure_are_refused_with_their_row(name: str):
    given = arrays() | {"covariance": np.tile(np.eye(2), (6, 1, 1))}
    given[name][3].flat[1] = 1e200
    with pytest.raises(InputError, match=r"3 holds a number beyond 1e\+07"):
        jaxcal.make_images(**given)
    # An image left out may hold anything.
    jaxcal.make_images(**given, mask=np.arange(6) != 3)
