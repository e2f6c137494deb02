"""Solvers: closed form, conventional, alternating, joint, self-tuned; they see arrays only."""
