"""The command line ``jaxcal-hw``; nothing numerical is imported before a command needs it."""
