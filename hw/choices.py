"""What an operator may choose by name. Imports nothing, so that ``--help`` costs nothing."""

PLACEMENTS = ("amplitude-scan", "threshold-climb", "pattern-injection", "none")
"""How the target is brought into the mid-plane; the first is the default."""

OPERATORS = ("person", "window", "simulated")
"""Who follows the injected pattern."""

PLANS = ("sobol", "optimal")
"""How poses are planned: spread evenly beforehand, or chosen as the images tell."""
