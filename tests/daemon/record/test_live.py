"""What a viewer gets over its WebSocket: channels with the schemas of recordings, and messages."""

from __future__ import annotations

import base64
import json
import os
import select
import socket
import struct
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import zmq

from graspd.daemon.record.topics import schemas
from tests.conftest import ROOT
from tests.daemon.processes import TIMEOUT_S, start
from tests.kit.messages import GOLDEN
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

    def channels(self, wanted: set[str], send: Callable[[], None]) -> dict[str, dict[str, Any]]:
        """What is advertised, by topic; `send` is called until all `wanted` are there.

        A view that stood still for a second connects again, and has lost what waited.
        """
        found: dict[str, dict[str, Any]] = {}
        while not wanted <= found.keys():
            send()
            while select.select([self._socket], [], [], 0.05)[0]:
                frame = self.frame()
                if frame.startswith(b"{"):
                    told = json.loads(frame)
                    found |= {one["topic"]: one for one in told.get("channels", [])}
        return found

    def message(self) -> dict[str, Any] | None:
        """A message, if one comes soon; before its JSON stand opcode 1, subscription and time."""
        while select.select([self._socket], [], [], 0.05)[0]:
            frame = self.frame()
            if frame[:1] == b"\x01":
                return dict(json.loads(frame[13:]))
        return None

    def close(self) -> None:
        self._socket.close()


class Hand:
    """A daemon's publisher, and `graspd watch --foxglove` that listens to it."""

    def __init__(self, folder: Path, context: zmq.Context[Any]) -> None:
        self.socket = context.socket(zmq.XPUB)
        self.socket.linger = 0
        self.socket.bind(f"ipc://{folder}/hand")
        self.port = free_port()
        self.arguments = ("--foxglove", "--connect", f"ipc://{folder}/hand", "--port", self.port)

    def wait_for_subscriber(self) -> None:
        for _ in ("verdict", "gate", "tactile", "status", "outcome"):
            assert self.socket.poll(100_000)
            self.socket.recv()

    def send(self, topic: str, payload: bytes) -> None:
        self.socket.send_multipart([topic.encode(), payload])


@pytest.fixture
def hand(tmp_path: Path) -> Iterator[Hand]:
    with zmq.Context() as context:
        publishing = Hand(tmp_path, context)
        with publishing.socket:
            yield publishing


def test_a_viewer_gets_channels_and_messages_that_their_schemas_allow(hand: Hand) -> None:
    sent = {name: (GOLDEN / f"{name}.json").read_bytes() for name in ("tactile", "gate", "status")}
    sent["verdict"] = (GOLDEN / "verdict_stable.json").read_bytes()
    with start("watch", *hand.arguments) as watching:
        assert watching.stdout is not None
        hand.wait_for_subscriber()
        assert f"ws://127.0.0.1:{hand.port}" in watching.stdout.readline()

        def send() -> None:
            for kind, payload in sent.items():
                hand.send(f"{kind}.right", payload)
            hand.send("verdict.strange", b"no json")

        send()
        viewer = ViewerClient(hand.port)
        wanted = {f"{kind}.right" for kind in (*sent, "image", "log")}
        channels = viewer.channels(wanted, send)
        assert channels.keys() == wanted
        for topic, channel in channels.items():
            name, text = schemas()[topic.partition(".")[0]]
            assert (channel["schemaName"], channel["encoding"]) == (name, "json")
            assert channel["schemaEncoding"] == "jsonschema"
            assert json.loads(channel["schema"]) == json.loads(text)
        verdict = channels["verdict.right"]
        viewer.tell({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": verdict["id"]}]})
        message = None
        while message is None:
            hand.send("verdict.right", sent["verdict"])
            message = viewer.message()
        viewer.close()
        watching.terminate()
        _, said = watching.communicate(timeout=TIMEOUT_S)
    assert watching.returncode == 0, said
    assert said == ""
    assert message["p_slip"] == json.loads(sent["verdict"])["p_slip"]
    jsonschema.validate(message, json.loads(schemas()["verdict"][1]))


def test_no_thread_of_the_library_asks_python_to_log() -> None:
    """Such a thread may hold what the thread that runs Python waits for: once both hung."""
    script = """
        import logging
        from graspd.daemon.record.live import LiveServer
        from tests.daemon.record.test_live import ViewerClient
        with LiveServer(0) as server:
            server.send(b"status.right", b"{}")
            viewer = ViewerClient(server.port)
            (channel,) = viewer.channels({"status.right"}, lambda: None).values()
            wanted = [{"id": 7, "channelId": channel["id"]}]
            viewer.tell({"op": "subscribe", "subscriptions": wanted})
            while viewer.message() is None:
                server.send(b"status.right", b"{}")
            viewer.close()
        print([name for name in logging.root.manager.loggerDict if "foxglove" in name])
    """
    result = subprocess.run(
        (sys.executable, "-c", textwrap.dedent(script)),
        cwd=ROOT,
        check=False,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert result.stdout == "[]\n", result.stderr
