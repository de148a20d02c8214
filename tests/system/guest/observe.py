"""Runs inside: subscribes, and writes every message with the time of its arrival to stdout."""

from __future__ import annotations

import json
import sys
import time

import zmq

RECONNECT_MS = 50
"""How often to try a socket that is gone, ms: part of every recovery that is measured."""


def main(endpoints: list[str]) -> None:
    """Never ends."""
    subscriber = zmq.Context().socket(zmq.SUB)
    subscriber.reconnect_ivl = RECONNECT_MS
    for endpoint in endpoints:
        subscriber.connect(endpoint)
    subscriber.subscribe("")
    while True:
        topic, payload = subscriber.recv_multipart()
        told = {"t_s": time.monotonic(), "topic": topic.decode(), "body": json.loads(payload)}
        sys.stdout.write(json.dumps(told) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
