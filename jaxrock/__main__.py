"""`python -m jaxrock`."""

import sys

from jaxrock.command_line.main import main

if __name__ == "__main__":
    sys.exit(main())
