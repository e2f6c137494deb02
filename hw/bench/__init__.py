"""Emulated devices: each speaks its real protocol over a real socket or pty."""
