"""The process around the daemon: settings of libraries, signals, streams, log, files, threads."""

import os

LIBRARIES = {
    # numpy's threads for large matrices, one a processor, spin; with memory locked each of them
    # takes its whole stack. Matrices are small here.
    "OPENBLAS_NUM_THREADS": "1",
    # Plugins that other packages have installed do not belong in a daemon.
    "PYDANTIC_DISABLE_PLUGINS": "__all__",
}
"""Settings that libraries read on import; those of the user come first."""


def set_up_libraries() -> None:
    """Call this before the first library is imported."""
    for name, value in LIBRARIES.items():
        os.environ.setdefault(name, value)
