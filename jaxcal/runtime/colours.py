"""Colours of data in figures: those of Okabe and Ito, which the colour-blind can tell apart."""

BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"
GREY = "#666666"
