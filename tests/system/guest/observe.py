"""Runs in the emulated machine: writes each daemon's messages, with their arrival, to stdout."""

from __future__ import annotations

import json
import sys
import time

import zmq

RECONNECT_MS = 50
"""Time between attempts to reconnect, ms: part of each recovery time that is measured."""


def main(endpoints: list[str]) -> None:
    """Subscribe to the endpoints, and write their messages as JSON lines; never ends."""
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
