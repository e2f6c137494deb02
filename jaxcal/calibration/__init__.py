"""Calibration of one problem or a batch; the answer can be saved and applied."""
