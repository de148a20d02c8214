"""The soak finds what is wrong in figures of daemons that are made up by hand."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from graspd.daemon.judge.reasons import Reason
from graspd.daemon.publish.messages import encode
from tests.bench.live import TALLIED, Usage
from tests.bench.soak_judge import Found, Heard, Row, judge
from tests.kit.messages import GOLDEN_VERDICT

HOUR_S = 3600.0
RATE_HZ = 100
MADE = 12_000
COUNTED = 30


def broken(rows: list[Row]) -> set[str]:
    """What is beyond its limit."""
    return {row.name for row in rows if row.broken}


def samples(kib: Callable[[float], float], seconds: float = HOUR_S) -> list[Usage]:
    """Of a daemon whose memory is a function of time, s, with the noise of an allocator."""
    noise = np.random.default_rng(0).integers(-20, 21, round(2 * seconds))
    return [
        Usage(t_s, 80_000 + round(kib(t_s)) + 4 * int(n), 14, 3)
        for t_s, n in zip(np.arange(0.0, seconds, 0.5), noise, strict=True)
    ]


def heard(readings: int) -> Heard:
    """A subscriber who has taken everything, and never waited."""
    return Heard(messages=readings + 20, readings=readings, boots={"one"}, worst_ms=3.0)


def well() -> Found:
    """A run in which 30 sweeps were dropped, and counted, and nothing else is lost."""
    twin = {**dict.fromkeys(TALLIED, 0), "sweeps": MADE, "drop": COUNTED}
    readings = MADE - COUNTED
    return Found(
        samples=samples(lambda _: 0.0),
        heard=heard(readings),
        twin=twin,
        ends_ns=np.arange(MADE, dtype=np.int64) * 10_000_000,
        driver={"readings": readings, "missed_readings": COUNTED, "link_losses": 2},
        outages=4,
        exit_code=0,
        stop_s=0.2,
    )


def with_driver(**counters: int) -> Found:
    """The well run, with other counters of the driver, whose readings all were heard."""
    found = well()
    driver = {**found.driver, **counters}
    return dataclasses.replace(found, driver=driver, heard=heard(driver["readings"]))


def with_heard(**fields: object) -> Found:
    """The well run, as another subscriber would have heard it."""
    found = well()
    return dataclasses.replace(found, heard=dataclasses.replace(found.heard, **fields))  # type: ignore[arg-type]


def last_third(values: dict[str, int]) -> Found:
    """The well run, with another use of things at its end."""
    found = well()
    ends = len(found.samples) * 2 // 3
    later = [dataclasses.replace(sample, **values) for sample in found.samples[ends:]]
    return dataclasses.replace(found, samples=[*found.samples[:ends], *later])


def test_a_run_in_which_all_is_well_breaks_no_limit() -> None:
    assert broken(judge(well())) == set()


LEAK = {"memory slope"}
LOSS = {"unexplained losses"}
CASES: dict[str, tuple[Found, set[str]]] = {
    "2 MiB/h for an hour": (
        dataclasses.replace(well(), samples=samples(lambda t_s: 2048 * t_s / HOUR_S)),
        LEAK,
    ),
    "100 bytes per reading for two minutes": (
        dataclasses.replace(well(), samples=samples(lambda t_s: 100 * RATE_HZ * t_s / 1024, 120.0)),
        LEAK,
    ),
    "0.5 MiB/h for an hour": (
        dataclasses.replace(well(), samples=samples(lambda t_s: 512 * t_s / HOUR_S)),
        set(),
    ),
    "a jump by 5 MiB, once": (
        dataclasses.replace(well(), samples=samples(lambda t_s: 5120.0 * (t_s > 3000))),
        set(),
    ),
    "10 MiB while it warms up": (
        dataclasses.replace(well(), samples=samples(lambda t_s: 10_240 * min(t_s / 25, 1))),
        set(),
    ),
    "1 MiB in the first minute of two": (
        dataclasses.replace(well(), samples=samples(lambda t_s: 1024 * min(t_s / 60, 1), 120.0)),
        set(),
    ),
    "a descriptor": (last_third({"descriptors": 15}), {"descriptors more at the end"}),
    "a thread": (last_third({"threads": 4}), {"threads more at the end"}),
    "a gap in seq": (with_heard(gaps=1), {"gaps in seq"}),
    "a verdict": (with_heard(readings=MADE - COUNTED - 1), LOSS),
    "one sweep at each break": (with_driver(readings=MADE - COUNTED - 3), set()),
    "one sweep more": (with_driver(readings=MADE - COUNTED - 4), {"lost as the link broke"} | LOSS),
    "more readings than sweeps": (with_driver(readings=MADE + 1), LOSS),
    "50 sweeps without an outage": (
        with_driver(readings=MADE - COUNTED - 50),
        {"lost as the link broke"} | LOSS,
    ),
    "another start": (with_heard(boots={"one", "two"}), {"restarts"}),
    "no start": (with_heard(boots=set()), {"restarts"}),
    "killed": (dataclasses.replace(well(), exit_code=-9), {"exit code"}),
    "late ones": (with_heard(late=MADE // 10), {"late verdicts"}),
    "a very late one": (with_heard(worst_ms=600.0), {"worst, last byte to subscriber"}),
    "a slow end": (dataclasses.replace(well(), stop_s=3.0), {"time to stop"}),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_wrong_breaks_its_limit_and_no_other(name: str) -> None:
    found, wrong = CASES[name]
    assert broken(judge(found)) == wrong


def verdict(seq: int, t_ns: int, age_ms: float = 0.0, *, boot: str = "one") -> bytes:
    """The payload of one; an old one says that nothing came."""
    reasons = [Reason.STALE if age_ms > 100.0 else Reason.NO_CONTACT]
    return encode(
        msgspec.structs.replace(
            GOLDEN_VERDICT,
            boot_id=boot,
            seq=seq,
            t_mono_ns=t_ns,
            reasons=reasons,
            age_ms=age_ms,
            latency_us=0.0,
        )
    )


def test_a_subscriber_tells_readings_gaps_pauses_and_restarts_apart() -> None:
    ms = 1_000_000
    subscriber = Heard()
    for payload, received_ms in (
        (verdict(0, 0, 101.0), 101),
        (verdict(1, 500 * ms), 503),
        (verdict(2, 510 * ms), 521),  # later than a period
        (verdict(3, 510 * ms, 0.2), 521),  # came together with the one before
        (verdict(4, 510 * ms, 101.0), 611),
        (verdict(5, 900 * ms), 902),
        (verdict(8, 930 * ms), 932),  # two are missing
        (verdict(0, 2000 * ms, boot="two"), 2001),
    ):
        subscriber.add(b"verdict.right", payload, received_ms * ms)
    assert (subscriber.messages, subscriber.readings, subscriber.gaps) == (8, 6, 2)
    assert (subscriber.late, subscriber.worst_ms) == (2, 11.0)
    assert subscriber.pauses_ns[:2] == [(0, 500 * ms), (510 * ms, 900 * ms)]
    assert subscriber.boots == {"one", "two"}


def test_a_run_that_has_tried_nothing_does_not_pass() -> None:
    found = well()
    enough = dataclasses.replace(found, planned=MADE)
    assert broken(judge(enough)) == set()
    few = dataclasses.replace(found, planned=6.0 * MADE)
    assert broken(judge(few)) == {"missing of a fifth of the plan's"}
    gone = dataclasses.replace(found, ended_early=True)
    assert broken(judge(gone)) == {"ended before it was told to"}
