"""Errors to which the words of a verdict belong; the command line reads them, so import nothing."""

GOOD_MM = 0.5
"""Largest error to expect at the image (root mean square) that is called good."""
FAIR_MM = 1.5
"""Largest error that is called fair; larger ones are called uncertain."""
WIDEST = 3.0
"""Largest upper end of the interval for either word, as a multiple of the word's largest error.

Of few images, whose errors tell little about their own size, the interval is many times as wide as
the error: such a number is no answer, however small it is.
"""
