"""``python -m torchbokeh``: the same as the console script ``torchbokeh``."""

import sys

from torchbokeh.commands.entry import main

if __name__ == "__main__":
    sys.exit(main())
