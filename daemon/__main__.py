"""`python -m daemon` is `graspd`."""

import sys

from daemon.cli import main

sys.exit(main())
