"""``python -m hw``: the command line ``jaxcal-hw``."""

import sys

from hw.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
