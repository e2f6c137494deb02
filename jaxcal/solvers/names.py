"""The names by which a calibration is asked for; the command line reads them, so import nothing."""

from typing import Literal

Method = Literal["joint", "alternating", "conventional"]
PriorName = Literal["auto", "gaussian", "uniform", "bounded"]
Data = Literal["auto", "points", "channels"]
SolverName = Literal["lm", "gauss-newton", "gradient"]
