"""A bench as a person describes it: its file, a check of its devices, the emulated one."""
