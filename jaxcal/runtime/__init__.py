"""What belongs to a process: JAX's modes and arrays, compiled programs and their storage."""
