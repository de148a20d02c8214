"""Requests and answers as JSON, one per line, over a Unix socket: QMP and the guest agent."""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path
from typing import Any, Final

RETRY_S: Final = 0.1
RECEIVE_BYTES: Final = 65536


class ProtocolError(Exception):
    """The other side refused a request, answered too late, or has gone."""


class JsonLines:
    """One connection; one request at a time."""

    def __init__(self, path: Path, timeout_s: float) -> None:
        """Connect, with patience. Raises `ProtocolError`."""
        self._name = path.name
        self._rest = b""
        deadline_s = time.monotonic() + timeout_s
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        while True:
            try:
                self._socket.connect(str(path))
            except (FileNotFoundError, ConnectionRefusedError) as error:
                if time.monotonic() > deadline_s:
                    self._socket.close()
                    raise ProtocolError(f"{self._name}: nobody listens") from error
                time.sleep(RETRY_S)
            else:
                return

    def close(self) -> None:
        """Hang up."""
        self._socket.close()

    def request(self, execute: str, timeout_s: float, **arguments: object) -> Any:  # noqa: ANN401
        """What is answered to a request. Raises `ProtocolError`."""
        message = {"execute": execute, "arguments": arguments}
        try:
            self._socket.sendall(json.dumps(message).encode() + b"\n")
        except OSError as error:
            raise ProtocolError(f"{self._name}: {error.strerror}") from error
        deadline_s = time.monotonic() + timeout_s
        while True:
            answer = self.receive(deadline_s)
            if "error" in answer:
                raise ProtocolError(f"{self._name}: {execute}: {answer['error'].get('desc')}")
            if "return" in answer:
                return answer["return"]

    def receive(self, deadline_s: float) -> dict[str, Any]:
        """The next object, by the monotonic clock's `deadline_s`. Raises `ProtocolError`."""
        while b"\n" not in self._rest:
            self._socket.settimeout(max(deadline_s - time.monotonic(), 0.001))
            try:
                chunk = self._socket.recv(RECEIVE_BYTES)
            except OSError as error:
                raise ProtocolError(f"{self._name}: no answer ({error})") from error
            if not chunk:
                raise ProtocolError(f"{self._name}: hung up")
            self._rest += chunk
        line, self._rest = self._rest.split(b"\n", 1)
        # After a synchronisation the agent's answer begins with a byte that is no JSON.
        try:
            decoded: dict[str, Any] = json.loads(line.lstrip(b"\xff"))
        except ValueError as error:
            raise ProtocolError(f"{self._name}: not JSON: {line[:80]!r}") from error
        return decoded
