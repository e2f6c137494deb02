"""A calibration for a program (record), for a person (verdict, tables) and on paper (figures)."""
