"""Poses to take images from, before and while an experiment runs."""
