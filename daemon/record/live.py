"""Serve a daemon's messages to Lichtblick and Foxglove, live. Needs the extra `foxglove`."""

from __future__ import annotations

import logging
import time
from typing import Final, Self

import foxglove
import msgspec

from graspd.daemon.record.topics import MALFORMED, flat, schemas
from graspd.daemon.record.viewers import Viewer

ADDRESS: Final = "127.0.0.1"
"""Address of the server; only loopback, because it does not check who connects."""
BACKLOG: Final = 256
"""Most messages that wait for a viewer; a slow one loses the oldest."""
CHANNELS_MAX: Final = 128
"""Most topics, seven for each hand; also most hands."""


class LiveServer:
    """A WebSocket server for viewers; the library runs it in threads."""

    def __init__(self, port: int) -> None:
        """Serve on `port`; 0: any free one. Raises `RuntimeError` if it is in use."""
        # If the library logged through Python, its threads and a logging thread could deadlock.
        foxglove.set_log_level(logging.CRITICAL)
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._viewers: dict[str, Viewer] = {}
        """Viewer of each hand, by name."""
        self._server = foxglove.start_server(
            name="graspd",
            host=ADDRESS,
            port=port,
            context=self._context,
            message_backlog_size=BACKLOG,
        )

    @property
    def port(self) -> int:
        return int(self._server.port)

    def send(self, topic: bytes, payload: bytes) -> None:
        """Pass on a message, its log lines and image; ignore an unknown topic or malformed JSON."""
        kind, _, hand = topic.decode(errors="replace").partition(".")
        if kind not in schemas():
            return
        try:
            message = msgspec.json.decode(payload)
            content = msgspec.json.encode(flat(message))
        except MALFORMED:
            return
        now_ns = time.time_ns()
        self._log(kind, hand, content, now_ns)
        if hand not in self._viewers:
            if len(self._viewers) >= CHANNELS_MAX:
                return
            self._viewers[hand] = Viewer()
        for made, shown in self._viewers[hand].of(kind, message, now_ns):
            self._log(made, hand, shown, now_ns)

    def _log(self, kind: str, hand: str, payload: bytes, at_ns: int) -> None:
        topic = f"{kind}.{hand}"
        if topic not in self._channels:
            if len(self._channels) >= CHANNELS_MAX:
                return
            name, text = schemas()[kind]
            schema = foxglove.Schema(name=name, encoding="jsonschema", data=text)
            self._channels[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="json", context=self._context
            )
        self._channels[topic].log(payload, log_time=at_ns)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_details: object) -> None:
        self._server.stop()
