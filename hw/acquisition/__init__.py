"""The experiment: what to acquire, pose by pose, and what is known so far."""
