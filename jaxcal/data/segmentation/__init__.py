"""From what the electronics or the image deliver to points: lateral position and range."""
