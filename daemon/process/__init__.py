"""The process of the daemon: settings of libraries, signals, streams, log, files, threads."""

import os

LIBRARIES = {
    # numpy starts a thread per processor for large matrices, which spins. With locked memory each
    # takes its whole stack. The matrices of graspd are small.
    "OPENBLAS_NUM_THREADS": "1",
    # Plugins of other installed packages do not belong in a daemon.
    "PYDANTIC_DISABLE_PLUGINS": "__all__",
}
"""Environment variables that libraries read on import; the user's own values come first."""


def set_up_libraries() -> None:
    """Set those of `LIBRARIES` that are not set. Call before the first library is imported."""
    for name, value in LIBRARIES.items():
        os.environ.setdefault(name, value)
