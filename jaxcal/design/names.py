"""The criteria of a plan by name; the command line reads them, so import nothing."""

from typing import Literal

Criterion = Literal["tre", "rp", "d"]
"""What a plan minimises: target registration error, reconstruction precision, or the determinant of
the covariance."""
