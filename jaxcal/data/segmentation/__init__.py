"""Points (lateral position and range) from times of flight or from images."""
