"""In a process: JAX's modes and arrays, compiled programs and where they are kept."""
