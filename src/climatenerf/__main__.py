"""``python -m climatenerf`` is ``climatenerf``."""

import sys

from climatenerf.cli import main

if __name__ == "__main__":
    sys.exit(main())
