"""The file of an acquisition: its layout, its writer, and the open devices that fill it."""
