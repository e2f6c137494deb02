"""``python -m jaxcal``: the command line ``jaxcal``."""

import sys

from jaxcal.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
