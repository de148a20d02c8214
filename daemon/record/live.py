"""Serves what a daemon publishes to Lichtblick and Foxglove, live, under the schemas of recordings.

Needs the package `foxglove-sdk` (extra `foxglove`).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Final, Self

import foxglove
import msgspec

from daemon.record.flat import flat
from daemon.record.topics import Topic, schemas
from daemon.record.viewers import ForPeople

ADDRESS: Final = "127.0.0.1"
"""Nobody who connects is asked who it is, so nobody of another computer can."""
BACKLOG: Final = 256
"""Messages that may wait for a viewer, a second of them; a slow one loses the oldest."""
IMAGES_HZ: Final = 10.0
CHANNELS_MAX: Final = 128
"""Topics that are served: of some ten hands. No more are taken up."""


class LiveServer:
    """A WebSocket server for viewers, in threads of the library."""

    def __init__(self, port: int, wall_clock: Callable[[], int] = time.time_ns) -> None:
        """Serve on a port of this computer, 0 for any free one. Raises `RuntimeError` if not."""
        self._wall_clock = wall_clock
        # Its threads log through Python: one that holds a lock would wait for who waits for it.
        foxglove.set_log_level(logging.CRITICAL)
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._people: dict[str, ForPeople] = {}
        """By hand."""
        self._server = foxglove.start_server(
            name="graspd",
            host=ADDRESS,
            port=port,
            context=self._context,
            message_backlog_size=BACKLOG,
        )

    @property
    def port(self) -> int:
        """Where it serves."""
        return int(self._server.port)

    def send(self, topic: bytes, payload: bytes) -> None:
        """Pass on a published message; what is none of a daemon's is passed over."""
        kind, _, hand = topic.decode(errors="replace").partition(".")
        if kind not in list(Topic):
            return
        try:
            message = msgspec.json.decode(payload)
        except msgspec.DecodeError:
            return
        now_ns = self._wall_clock()
        self._log(kind, hand, msgspec.json.encode(flat(message)), now_ns)
        if hand not in self._people and len(self._people) < CHANNELS_MAX:
            self._people[hand] = ForPeople(IMAGES_HZ)
        people = self._people.get(hand)
        if people is None:
            return
        for made, content in people.of(kind, message, now_ns):
            self._log(made, hand, content, now_ns)

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
