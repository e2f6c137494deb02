"""The answer: a calibration, its use, and its files; its methods lead to all that is said of it."""
