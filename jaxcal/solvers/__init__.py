"""Solvers: closed form, conventional, alternating, joint, self-tuned; none knows of files or plots."""
