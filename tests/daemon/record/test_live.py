"""What a viewer gets over its WebSocket: channels with the schemas of recordings, and messages."""

from __future__ import annotations

import base64
import json
import os
import select
import socket
import struct
import sys
import textwrap
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from graspd.daemon.judge.reasons import Decision
from graspd.daemon.record.topics import schemas
from tests.conftest import ROOT
from tests.daemon.processes import TIMEOUT_S, start
from tests.daemon.watch.watch_fakes import Talker
from tests.kit.programs import ran
from tests.ports import free_port

pytest.importorskip("foxglove", reason="needs the extra `foxglove`")


class ViewerClient:
    """A WebSocket client (RFC 6455) that speaks the protocol of Foxglove's viewers."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=100)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = ["GET / HTTP/1.1", f"Host: 127.0.0.1:{port}", "Upgrade: websocket"]
        lines += ["Connection: Upgrade", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {key}"]
        lines += ["Sec-WebSocket-Protocol: foxglove.sdk.v1, foxglove.websocket.v1", "", ""]
        self._socket.sendall("\r\n".join(lines).encode())
        answer = b""
        while not answer.endswith(b"\r\n\r\n"):
            answer += self._socket.recv(1)
        assert b" 101 " in answer.splitlines()[0]

    def frame(self) -> bytes:
        head = self._take(2)
        length = head[1] & 127
        if length == 126:
            (length,) = struct.unpack(">H", self._take(2))
        elif length == 127:
            (length,) = struct.unpack(">Q", self._take(8))
        return self._take(length)

    def _take(self, size: int) -> bytes:
        taken = b""
        while len(taken) < size:
            part = self._socket.recv(size - len(taken))
            assert part
            taken += part
        return taken

    def tell(self, content: dict[str, Any]) -> None:
        text = json.dumps(content).encode()
        assert len(text) < 126
        self._socket.sendall(bytes((0x81, 0x80 | len(text), 0, 0, 0, 0)) + text)

    def channels(self, wanted: set[str]) -> dict[str, dict[str, Any]]:
        """Return the advertised channels by topic, once all `wanted` are there."""
        found: dict[str, dict[str, Any]] = {}
        while not wanted <= found.keys():
            while select.select([self._socket], [], [], 0.05)[0]:
                frame = self.frame()
                if frame.startswith(b"{"):
                    told = json.loads(frame)
                    found |= {one["topic"]: one for one in told.get("channels", [])}
        return found

    def message(self) -> dict[str, Any] | None:
        """Return the JSON after opcode 1, subscription and time; None: no message for 50 ms."""
        while select.select([self._socket], [], [], 0.05)[0]:
            frame = self.frame()
            if frame[:1] == b"\x01":
                return dict(json.loads(frame[13:]))
        return None

    def close(self) -> None:
        self._socket.close()


def test_a_viewer_gets_channels_and_messages_that_their_schemas_allow(tmp_path: Path) -> None:
    endpoint, port = f"ipc://{tmp_path}/hand", free_port()
    arguments = "--foxglove", "--connect", endpoint, "--port", port
    with Talker(endpoint) as talker, start("watch", *arguments) as watching:
        talker.decision = Decision.SLIP
        assert watching.stdout is not None
        assert f"ws://127.0.0.1:{port}" in watching.stdout.readline()
        viewer = ViewerClient(port)
        wanted = {f"{kind}.right" for kind in ("tactile", "status", "verdict", "image", "log")}
        channels = viewer.channels(wanted)
        assert channels.keys() == wanted
        for topic, channel in channels.items():
            name, text = schemas()[topic.partition(".")[0]]
            assert (channel["schemaName"], channel["encoding"]) == (name, "json")
            assert channel["schemaEncoding"] == "jsonschema"
            assert json.loads(channel["schema"]) == json.loads(text)
        verdict = channels["verdict.right"]
        viewer.tell({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": verdict["id"]}]})
        message = None
        while message is None or message.get("p_slip") is None:
            message = viewer.message()
        viewer.close()
        watching.terminate()
        _, said = watching.communicate(timeout=TIMEOUT_S)
    assert (watching.returncode, said) == (0, "")
    assert message["p_slip"] == 0.75
    jsonschema.validate(message, json.loads(schemas()["verdict"][1]))


def test_the_foxglove_library_never_logs_through_python() -> None:
    """A thread of the library that logs in Python could deadlock with a thread of Python."""
    script = """
        import logging
        from graspd.daemon.record.live import LiveServer
        from tests.daemon.record.test_live import ViewerClient
        with LiveServer(0) as server:
            for malformed in (b"{", b'"\\xff"', b"[" * 10_000):
                server.send(b"verdict.right", malformed)
            server.send(b"status.right", b"{}")
            viewer = ViewerClient(server.port)
            (channel,) = viewer.channels({"status.right"}).values()
            wanted = [{"id": 7, "channelId": channel["id"]}]
            viewer.tell({"op": "subscribe", "subscriptions": wanted})
            while viewer.message() is None:
                server.send(b"status.right", b"{}")
            viewer.close()
        print([name for name in logging.root.manager.loggerDict if "foxglove" in name])
    """
    result = ran(sys.executable, "-c", textwrap.dedent(script), cwd=ROOT)
    assert result.stdout == "[]\n", result.stderr
