"""Tell systemd that the daemon is ready, alive or stopping (sd_notify(3))."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable, Mapping

from graspd.daemon.judge.reasons import parts_to_act_on
from graspd.daemon.publish.companion import Companion, Requests
from graspd.daemon.publish.messages import Status

log = logging.getLogger("graspd")

FEEDINGS_PER_TIMEOUT = 4
"""Number of keep-alive messages in a watchdog timeout; systemd recommends two."""
NS_PER_US = 1000


class Systemd(Companion):
    """Sender of messages to the service manager; warns once if it does not listen."""

    def __init__(
        self,
        address: str,
        watchdog_us: int | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`address`: a path, or `@` and an abstract name. `watchdog_us`: timeout; None: none."""
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._watchdog_us = watchdog_us
        self._clock = clock
        self._period_ns = (watchdog_us or 0) * NS_PER_US // FEEDINGS_PER_TIMEOUT
        self._due_ns = clock()
        self._warned = False
        self._late = 0
        """Count of late readings in the last status."""
        kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
        self._socket = socket.socket(socket.AF_UNIX, kind)

    @classmethod
    def of(cls, environment: Mapping[str, str]) -> Systemd | None:
        """Return a sender to the manager that `environment` names (sd_notify(3)); None: no such."""
        address = environment.get("NOTIFY_SOCKET", "")
        if address[:1] not in ("/", "@"):
            return None
        timeout, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        mine = timeout.isdecimal() and int(timeout) > 0 and process in ("", str(os.getpid()))
        return cls(address, int(timeout) if mine else None)

    def ready(self, what: str) -> None:
        """Tell systemd that the daemon runs. `what`: text for people."""
        self._send("READY=1", f"STATUS={what}")

    def stopping(self) -> None:
        self._send("STOPPING=1", "STATUS=stopping")

    def on_status(self, status: Status) -> None:
        """Show the status in `systemctl status`."""
        late, self._late = status.late_readings - self._late, status.late_readings
        self._send(f"STATUS={in_a_line(status, late)}")

    def before_wait(self, requests: Requests) -> int | None:
        """Return the time of the next keep-alive message, monotonic ns; None without a watchdog."""
        return None if self._watchdog_us is None else self._due_ns

    def after_round(self) -> None:
        """Send a keep-alive message to the watchdog if one is due."""
        if self._watchdog_us is not None and self._clock() >= self._due_ns:
            self._due_ns = self._clock() + self._period_ns
            self._send("WATCHDOG=1")

    def close(self) -> None:
        self._socket.close()

    def _send(self, *lines: str) -> None:
        try:
            self._socket.sendto("\n".join(lines).encode(), self._address)
        except OSError as error:
            level = logging.DEBUG if self._warned else logging.WARNING
            log.log(level, "the service manager cannot be told: %s", error.strerror)
            self._warned = True


def in_a_line(status: Status, late: int) -> str:
    """Return a status in one line, for people. `late`: late readings since the last status."""
    parts = [f"{status.state}: {status.readings_hz:.1f} readings/s"]
    parts += [f"{number} {outcome}" for outcome, number in status.verdicts.items() if number]
    if status.gate is not None:
        parts.append(f"gate {status.gate}")
    if status.overloaded:
        parts.append(f"overloaded, {status.skipped_readings} readings left out")
    if late:
        parts.append(f"{late} late just now")
    not_well = parts_to_act_on(status.health)
    parts += [f"{' and '.join(names)} {reason}" for reason, names in not_well.items()]
    return ", ".join(parts)
