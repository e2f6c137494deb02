"""One problem, or a batch of them, to an answer that can be saved and applied."""
