"""The measurement model: unknowns, residuals and the offset's prior, as pieces that compose."""
