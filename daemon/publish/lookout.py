"""Warns of peers that come without a key where the sockets want one."""

from __future__ import annotations

import logging
import os
import socket
import struct
import threading
from collections.abc import Sequence
from typing import Final

import zmq

log = logging.getLogger("graspd")

EVENTS: Final = int(
    zmq.EVENT_ACCEPTED | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_DISCONNECTED
)
EVENT: Final = struct.Struct("=HI")
"""First frame of an event: its number and value (zmq_socket_monitor(3))."""
WITHOUT_KEY: Final = 0x11000002
"""Value of a failed handshake: the peer speaks without encryption (ZMQ_PROTOCOL_ERROR_*)."""
WRONG_SERVER_KEY: Final = 0x11000001
"""Value of a failed handshake: the peer has another key of the daemon."""
PROBLEMS: Final = {
    WITHOUT_KEY: "it has no key",
    WRONG_SERVER_KEY: "it takes another key for the daemon's",
}
PEERS_MAX: Final = 1024
"""Connections whose address is kept until they end."""
UNKNOWN: Final = "an unknown address"


class Lookout(threading.Thread):
    """Reads the monitors of sockets until their context ends, and closes them.

    They must be read all the time: libzmq waits where a monitor's queue is full.
    """

    def __init__(self, monitors: Sequence[zmq.Socket[bytes]]) -> None:
        """The thread owns these sockets, made with `EVENTS`, from `start` on."""
        super().__init__(name="lookout", daemon=True)
        self._monitors = monitors
        self._addresses: dict[tuple[int, int], str] = {}
        """By number of the monitor and descriptor of the connection."""
        self._problems: dict[int, str] = {}
        """Problem of the connection that ends next, by monitor."""

    def run(self) -> None:
        poller = zmq.Poller()
        for monitor in self._monitors:
            poller.register(monitor, zmq.POLLIN)
        try:
            while True:
                ready = dict(poller.poll())
                for number, monitor in enumerate(self._monitors):
                    if monitor in ready:
                        self._take(number, *EVENT.unpack(monitor.recv_multipart()[0]))
        except zmq.ContextTerminated:
            pass
        finally:
            for monitor in self._monitors:
                monitor.close(0)

    def _take(self, number: int, event: int, value: int) -> None:
        """Take an event; one that a connection ends comes right after what was wrong with it."""
        if event == zmq.EVENT_ACCEPTED:
            if len(self._addresses) >= PEERS_MAX:
                self._addresses.clear()
            self._addresses[number, value] = _address_of(value)
        elif event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
            self._problems[number] = PROBLEMS.get(value, "it does not speak ZeroMQ with keys")
        else:
            address = self._addresses.pop((number, value), UNKNOWN)
            problem = self._problems.pop(number, None)
            if problem is not None:
                log.warning("turned away a peer from %s: %s", address, problem)


def _address_of(descriptor: int) -> str:
    """Return the peer's address; libzmq may have closed the connection already."""
    try:
        with socket.socket(fileno=os.dup(descriptor)) as connection:
            return str(connection.getpeername()[0])
    except (OSError, IndexError):
        return UNKNOWN
