"""Placing the target in the image's mid-plane (section 2.1 of the paper): four procedures.

Each takes a :class:`hw.midplane.search.Bench`, moves the probe along its elevational axis, and
listens to the active echo or, in :mod:`hw.midplane.image_scan`, looks at the image. Its result is a
:class:`hw.midplane.bracket.Placement`: where the target's elevational offset lies in this image.
"""
