"""`python -m graspd`: the command line."""

import sys

from graspd.daemon.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
