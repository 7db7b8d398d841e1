"""`python -m jaxfuzzy` is the command line."""

import sys

from jaxfuzzy.cli import main

if __name__ == "__main__":
    sys.exit(main())
