"""Files in and out: recordings (HDF5 and text), and writing that is complete or did not happen."""
