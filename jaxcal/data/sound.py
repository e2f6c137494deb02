"""The speed of sound: in water from its temperature, and a check of given values."""

from __future__ import annotations

import numpy as np

from jaxcal import InputError
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.given_values import is_number, real_array

# W. Marczak, "Water as a standard in the measurements of speed of sound in liquids",
# J. Acoust. Soc. Am. 102 (1997) 2776-2779: fifth degree in degrees Celsius, lowest power first.
_MARCZAK = (1.402385e3, 5.038813, -5.799136e-2, 3.287156e-4, -1.398845e-6, 2.787860e-9)

WATER_M_S = 1490.0
"""Speed of sound in water at room temperature, assumed where none is given."""

SCANNER_M_S = 1540.0
"""Speed of sound by which ultrasound scanners compute the depth of a pixel: the mean of tissues."""

SLOWEST_M_S, FASTEST_M_S = 100.0, 10_000.0


def sound_speed_in_water(
    temperature_celsius: float | Float[np.ndarray, "*batch"],
) -> float | Float[np.ndarray, "*batch"]:
    """Speed of sound in pure water at atmospheric pressure, m/s.

    Args:
        temperature_celsius: 0 to 95 degrees Celsius, a number or an array.

    Returns:
        m/s; within 0.06 m/s of the polynomial of Del Grosso and Mader (1972) everywhere.

    Raises:
        InputError: a temperature outside 0 to 95 degrees, such as one in kelvin.

    Source: Marczak 1997, J. Acoust. Soc. Am. 102, 2776.
    """
    temperature = real_array(temperature_celsius, "water temperature")
    if not ((temperature >= 0) & (temperature <= 95)).all():
        raise InputError("water temperature must be in degrees Celsius, from 0 to 95")
    speed = np.polynomial.polynomial.polyval(temperature, _MARCZAK)
    return float(speed) if speed.ndim == 0 else speed


def check_sound_speed(sound_speed_m_s: float) -> None:
    """Refuse what cannot be a speed of sound in m/s.

    Raises:
        InputError: not between 100 and 10000, with a hint where it looks like mm/us.
    """
    if is_number(sound_speed_m_s) and SLOWEST_M_S < sound_speed_m_s < FASTEST_M_S:
        return
    like = is_number(sound_speed_m_s) and 0.5 < sound_speed_m_s < 7
    hint = f": {sound_speed_m_s} looks like mm/us" if like else ""
    raise InputError(f"sound speed must be in m/s (water: about 1490), not {sound_speed_m_s}{hint}")
