"""Placing the target in the image's mid-plane (section 2.1 of the paper): three procedures.

Each takes a :class:`hw.midplane.search.Bench`, moves the probe along its elevational axis, listens
to the active echo, and ends in a :class:`hw.midplane.bracket.Placement`, which says where the
target's elevational offset lies: that image's prior.
"""
