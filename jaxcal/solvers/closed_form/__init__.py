"""Conventional calibration, Eq. 7, in closed form, and the proof that nothing fits better."""
