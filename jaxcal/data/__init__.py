"""What was measured: probes, poses, recordings, times, points from pixels or times of flight."""
