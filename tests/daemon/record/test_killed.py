"""A daemon that is killed has recorded all but the last flush interval."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from tests.bench.live import Subscriber
from tests.daemon.processes import TIMEOUT_S, start
from tests.daemon.record.recorded import files, messages, scene
from tests.kit.messages import decode_verdict

FLUSH_S = 1.0
"""Default of `[record] flush_ms`."""


@pytest.mark.parametrize("life_s", [1.6, 2.7])
def test_a_killed_daemon_loses_no_more_than_the_flush_interval(
    tmp_path: Path, life_s: float
) -> None:
    published: dict[int, float] = {}
    with (
        start("run", scene(tmp_path)) as daemon,
        Subscriber(f"ipc://{tmp_path}/graspd") as subscriber,
    ):
        end_s, wait_s = None, float(TIMEOUT_S)
        while (message := subscriber.take(wait_s)) is not None:
            verdict = decode_verdict(message[1])
            published[verdict.seq] = verdict.t
            end_s = time.monotonic() + life_s if end_s is None else end_s
            if time.monotonic() > end_s:
                daemon.kill()
                wait_s = 0.2
        daemon.communicate(timeout=TIMEOUT_S)
    (path,) = files(tmp_path)
    recorded = [content["seq"] for kind, content in messages(path) if kind == "verdict"]
    assert recorded == list(range(len(recorded)))
    lost = [t for seq, t in published.items() if seq >= len(recorded)]
    assert max(published.values()) - min(lost, default=max(published.values())) <= FLUSH_S
