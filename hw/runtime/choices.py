"""What an operator may choose by name. Imports nothing, so that ``--help`` costs nothing."""

PLACEMENTS = ("amplitude-scan", "threshold-climb", "pattern-injection", "image-scan", "none")
"""How the target is brought into the mid-plane; the first is the default."""

PLACEMENTS_OF = {
    "active-echo": ("amplitude-scan", "threshold-climb", "pattern-injection", "none"),
    "cross-wire": ("image-scan", "none"),
    "hydrophone": ("amplitude-scan", "none"),
}
"""Placements possible with each phantom, the default first: a cross-wire is not connected to the
electronics, and a hydrophone never answers."""
PHANTOMS = tuple(PLACEMENTS_OF)
"""What is in the tank; the first is the default."""

CONTROLLERS = ("cb", "e")
"""Series of the emulated robot; the first is the default."""

HAND_PLACEMENTS = ("none", "pattern-injection")
"""Placements of a hand-held probe; the first is the default."""

OPERATORS = ("person", "window", "simulated")
"""Who follows the injected pattern."""

PLANS = ("sobol", "optimal")
"""How poses are planned: spread evenly beforehand, or chosen by the images taken so far."""
