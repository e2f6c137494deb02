"""Reports of a calibration: for programs (record), for people (verdict, tables) and as figures."""
