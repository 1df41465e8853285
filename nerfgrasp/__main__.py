"""`python -m nerfgrasp` is the command `nerfgrasp`."""

import sys

from nerfgrasp.cli import main

if __name__ == "__main__":
    sys.exit(main())
