"""The command line; nothing here imports JAX, numpy or matplotlib before a command needs it."""
