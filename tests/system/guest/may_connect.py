"""Runs inside: whether this user may connect to a Unix socket. Exit code 0, or the error's."""

from __future__ import annotations

import socket
import sys


def main(path: str) -> int:
    """0, or the number of the error."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(path)
        except OSError as error:
            return error.errno or 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
