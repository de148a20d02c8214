"""The daemon's driver on the emulated board: its clock is emulated time: no real delay counts."""

from __future__ import annotations

import os
import select
import tty
from collections.abc import Callable, Sequence
from pathlib import Path

from graspd.drivers.base import TactileReading
from graspd.drivers.link import LinkState
from graspd.drivers.spi.conversation import LineEvent
from graspd.drivers.spi.driver import SpiBridgeDriver
from tests.drivers.spi.bridge_c import START, frame
from tests.emulated.board import MS, Board

FINGERS = ("ff", "mf", "th")
EPOCH_NS = 10**12
"""The driver's clock at the board's first power-on."""
PATIENCE_S = 60.0
"""Real time for bytes to get through a pseudo-terminal."""
LOOK_MS = 10.0
"""How often it is looked whether the board is there."""


class LockStep:
    """A driver at a path that is there while the board's serial port is, as udev's links are.

    `serve` lets emulated time pass; bytes go both ways through a pseudo-terminal at the emulated
    time at which they are there.
    """

    def __init__(self, board: Board, path: Path, fingers: Sequence[str] = FINGERS) -> None:
        self.board = board
        self.path = path
        self.readings: list[TactileReading] = []
        self.states: list[LinkState] = []
        """States of the link, each time that it changed."""
        self.driver = SpiBridgeDriver(str(path), fingers, clock=self.now_ns)
        self._master = self._slave = -1
        self._to_driver = 0
        self._from_driver = bytearray()
        self._is_open = False
        self.driver.tap(self._tap)

    def now_ns(self) -> int:
        return EPOCH_NS + round(self.board.now_ns)

    def open(self) -> None:
        """Plug the board's serial port in and open the driver."""
        self._look()
        self._send_all(self.driver.open)

    def hang_up(self) -> None:
        """Close the driver as the daemon does."""
        self._send_all(self.driver.close)

    def close(self) -> None:
        """Close the driver and take the port away; may be called more than once."""
        self.driver.close()
        self._vanish()

    def serve(self, ms: float, enough: Callable[[], bool] = lambda: False) -> None:
        """Serve the driver as the daemon does, for an emulated time or until it is enough."""
        end_ns = self.board.now_ns + ms * MS
        while self.board.now_ns < end_ns and not enough():
            self._look()
            if self._is_open and self._master < 0:
                self._send_all(self._take)  # its device went away
            due_ns = self.driver.due_ns()
            wait_ns = end_ns if due_ns is None else max(due_ns - EPOCH_NS, self.board.now_ns)
            there = self.board.run_until(
                min(end_ns, wait_ns, self.board.now_ns + LOOK_MS * MS), hand_over=True
            )
            if there and self._is_open and self._master >= 0:
                self._to_driver += os.write(self._master, there)
            if there or (due_ns is not None and self.now_ns() >= due_ns):
                self._send_all(self._read)

    # ---- both ways ----

    def _read(self) -> None:
        """What has come is read to the last byte, and the driver does what is due."""
        self._take()
        while self._is_open and self.driver.counters.bytes < self._to_driver:
            descriptor = self.driver.fileno()
            if descriptor is None:
                return  # the driver gave the port back; what was left is gone with it
            assert select.select([descriptor], [], [], PATIENCE_S)[0]
            self._take()

    def _take(self) -> None:
        self.readings += [r for r in self.driver.read_ready() if isinstance(r, TactileReading)]

    def _send_all(self, step: Callable[[], None]) -> None:
        """Let the driver do something; the board gets what it wrote and how the port stands."""
        step()
        said = bytes(self._from_driver)
        self._from_driver.clear()
        if self._master >= 0:
            self._swallow(len(said))
        is_open = self.driver.fileno() is not None
        if is_open and not self._is_open:
            self.board.do("open")
        if said:
            if frame(START) in said:
                self.board.do("rewind")
            self.board.send(said)
        if self._is_open and not is_open:
            self.board.do("close")
        self._is_open = is_open
        state = self.driver.conversation.link.state
        if not self.states or self.states[-1] is not state:
            self.states.append(state)

    def _swallow(self, size: int) -> None:
        """Take from the terminal what the tap has seen already."""
        while size > 0:
            assert select.select([self._master], [], [], PATIENCE_S)[0]
            size -= len(os.read(self._master, size))

    def _tap(self, event: LineEvent, data: bytes) -> None:
        if event is LineEvent.SENT:
            self._from_driver += data
        elif event is LineEvent.OPENED:
            self._to_driver = self.driver.counters.bytes

    # ---- the device ----

    def _look(self) -> None:
        """The path is there while the host's side has the board configured."""
        there = self.board.do("state")["configured"]
        if there and self._master < 0:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            self.path.symlink_to(os.ttyname(self._slave))
        elif not there:
            self._vanish()

    def _vanish(self) -> None:
        if self._master >= 0:
            os.close(self._master)
            os.close(self._slave)
            self.path.unlink()
        self._master = self._slave = -1
