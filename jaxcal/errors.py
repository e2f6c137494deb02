"""The one exception family: what was wrong, where, and what to do about it."""

from __future__ import annotations


class CalibrationError(Exception):
    """Base of every error that jaxcal raises on purpose; its text is meant for a person."""


class InputError(CalibrationError, ValueError):
    """The data handed in cannot be used: shapes, units, non-rotations, too few images."""


class FormatError(InputError):
    """A file is not what it should be: another format, truncated, a newer version, unsafe."""


class OutputError(CalibrationError, OSError):
    """A result could not be written; nothing was left half-written."""


class MissingExtraError(CalibrationError, ImportError):
    """An optional dependency is absent; the message names the extra that installs it."""
