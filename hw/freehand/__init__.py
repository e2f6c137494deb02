"""Free-hand acquisition: a person holds the probe, a tracker says where it is.

posed    images of an OpenIGTLink stream with the poses that belong to them
guide    when an image is taken, and what the person is told
acquire  the run, from the connection to a recording that is complete
"""
