"""What is lost in the middle of a grasp is `unknown` at the subscriber, as soon as is promised."""

from __future__ import annotations

from pathlib import Path

from tests.bench.outages import Bench, outages
from tests.daemon.processes import before_others

PROMISED_S = {
    "sensor": 0.02,
    "link": 0.1,
    "joints": 0.15,
    "joints, and judged without them": 1.0,
    "daemon": 0.1,
}
"""README: two periods; the age limit; late joints; lost joints; silence. Measured by
`python -m tests.bench.outages`."""
STALL_S = 3.0
"""A machine that does other things too may hold a process up for so long."""


def test_every_outage_is_unknown_in_time_and_says_why(tmp_path: Path) -> None:
    with before_others(), Bench(tmp_path) as bench:
        outages_s = dict(outages(bench))
    assert outages_s.keys() == PROMISED_S.keys()
    late = {name: s for name, s in outages_s.items() if s > PROMISED_S[name] + STALL_S}
    assert not late
