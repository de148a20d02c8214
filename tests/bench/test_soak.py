"""The soak finds what is wrong in figures of daemons that are made up by hand."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace

from tests.bench.live import Usage
from tests.bench.soak_judge import Found, Heard, Row, judge
from tests.kit.messages import GOLDEN_VERDICT

HOUR_S = 3600.0
RATE_HZ = 100
READINGS = 12_000


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


def well() -> Found:
    """A run in which nothing is lost."""
    heard = Heard(messages=READINGS + 20, readings=READINGS, boots={"one"})
    return Found(samples=samples(lambda _: 0.0), heard=heard, outages=4, exit_code=0)


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
    "another start": (with_heard(boots={"one", "two"}), {"restarts"}),
    "no start": (with_heard(boots=set()), {"restarts"}),
    "killed": (dataclasses.replace(well(), exit_code=-9), {"exit code"}),
    "too few readings": (
        dataclasses.replace(well(), planned=6.0 * READINGS),
        {"missing of a fifth of the plan's"},
    ),
    "gone too early": (
        dataclasses.replace(well(), ended_early=True),
        {"ended before it was told to"},
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_wrong_breaks_its_limit_and_no_other(name: str) -> None:
    found, wrong = CASES[name]
    assert broken(judge(found)) == wrong


def test_a_subscriber_tells_readings_gaps_and_restarts_apart() -> None:
    subscriber = Heard()
    for seq, t_ns, boot in (
        (0, 0, "one"),
        (1, 500, "one"),
        (2, 510, "one"),
        (3, 510, "one"),
        (6, 930, "one"),  # two are missing
        (0, 2000, "two"),
    ):
        subscriber.add(replace(GOLDEN_VERDICT, seq=seq, t_mono_ns=t_ns, boot_id=boot))
    assert (subscriber.messages, subscriber.readings, subscriber.gaps) == (6, 3, 2)
    assert subscriber.boots == {"one", "two"}
