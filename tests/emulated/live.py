"""The emulated board in real time behind a pseudo-terminal, for `graspd doctor` and `graspd run`.

`python -m tests.emulated.live --link /tmp/graspd-bridge` builds the firmware, lets it run until it
is stopped (SIGINT, SIGTERM, end of standard input) and tells how far it was behind at worst.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import signal
import sys
import time
import tty
from pathlib import Path

from tests.drivers.spi.bridge_c import START, STOP, frame
from tests.emulated.board import MS, Board
from tests.emulated.build import image, missing

NEEDS = (
    "It needs node, npm, cc, cmake, ninja, gcc-arm-none-eabi, and the pico-sdk and boot ROM in "
    "shared/pico beside the checkout (deploy/bridge/README.md); npm fetches the emulator once"
)
WARM_MS = 1500.0
"""Emulated time in which the emulator is compiled by its own machine, before anybody listens."""
STEP_S = 0.001
UNREAD_MAX = 16_384
"""Bytes that wait for a reader before the host's side takes no more."""


class LiveBoard:
    """A board whose emulated time follows the real one, never ahead of it.

    What the host says is heard no sooner than it was said, however far the emulation is behind: to
    the host a stall is an answer that is late, not a clock that stood.
    """

    def __init__(self, board: Board, link: Path) -> None:
        self.behind_ms = 0.0
        """At worst, since the link was made."""
        self._board = board
        self._link = link
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self._path = os.ttyname(slave)
        os.close(slave)  # so that the terminal tells whether anybody has it open
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)
        self._unread = bytearray()
        self._is_open = False
        self._began_ns = 0

    def warm_up(self) -> None:
        """Sweep for a while, then stop."""
        self._board.hello()
        self._board.start()
        self._board.run(WARM_MS)
        self._board.send(frame(STOP))
        self._board.run(20.0)
        self._board.do("close")

    def run(self) -> None:
        """Run until a signal or the end of standard input."""
        self._began_ns = time.monotonic_ns() - round(self._board.now_ns)
        self._link.symlink_to(self._path)
        sys.stderr.write(f"a board on {self._link}; Ctrl-C ends\n")
        try:
            while not select.select([sys.stdin], [], [], 0)[0]:
                self._catch_up()
                self._give()
                self._take()
                time.sleep(STEP_S)
        finally:
            self._link.unlink()
            os.close(self._master)

    def _catch_up(self) -> None:
        now_ns = time.monotonic_ns() - self._began_ns
        self.behind_ms = max(self.behind_ms, (now_ns - self._board.now_ns) / MS)
        self._unread += self._board.run_until(now_ns)
        self._board.frames.clear()

    def _give(self) -> None:
        with contextlib.suppress(BlockingIOError):
            del self._unread[: os.write(self._master, self._unread)]
        self._board.do("read", room=max(UNREAD_MAX - len(self._unread), 0))

    def _take(self) -> None:
        happened = dict(self._poll.poll(0)).get(self._master, 0)
        is_open = not happened & select.POLLHUP
        if is_open != self._is_open:
            self._board.do("open" if is_open else "close")
            self._is_open = is_open
        if happened & select.POLLIN:
            said = os.read(self._master, 4096)
            self._catch_up()
            if frame(START) in said:
                self._board.do("rewind")
            self._board.send(said)


def main() -> None:
    """Run one board; exit code 2 and what is missing if it cannot be built here."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.emulated.live", description=__doc__, epilog=NEEDS
    )
    parser.add_argument("--link", type=Path, required=True, help="made when the board is ready")
    parser.add_argument("--counts", type=Path, help="what the sensors feel, five in each line")
    options = parser.parse_args()
    if (lacking := missing()) is not None:
        parser.error(f"{lacking}. {NEEDS}")
    sys.stderr.write("building the firmware and the emulator, the first time some minutes\n")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with Board() as board:
        live = LiveBoard(board.power(image(), options.counts), options.link)
        live.warm_up()
        with contextlib.suppress(KeyboardInterrupt):
            live.run()
        sys.stdout.write(f"{live.behind_ms:.1f} ms behind at worst\n")


if __name__ == "__main__":
    main()
