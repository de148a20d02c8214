"""The tactile stream: what is a message, what a count, how old it is, and from whom."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd.drivers.base import ElectrodeFault, Reading, TactileReading
from graspd.drivers.datagrams.tactile import TactileStream, TactileStreamDriver
from graspd.drivers.link import SenderClock
from graspd.drivers.udp import Datagram
from tests.drivers.one_sweep import counts_of, number_in, tactile
from tests.drivers.palm.palm_stream import flags
from tests.drivers.udp_standin import HERE, THERE, Receiver
from tests.kit.clock import Clock

MS = 1_000_000
LOOPBACK = "udp://127.0.0.1:0"
COUNTS = list(range(2000, 2024))
FINGERS = ("ff", "mf", "th")


def message(counts: object = None, **fields: object) -> bytes:
    """A datagram with number 1 and counts of three fingers, unless `counts` or `fields` differ."""
    whole = {"seq": 1, "counts": dict.fromkeys(FINGERS, COUNTS) if counts is None else counts}
    return json.dumps({**whole, **fields}).encode()


def received(*data: bytes) -> tuple[list[TactileReading], dict[str, int]]:
    """Return the readings of datagrams 10 ms apart, and the counters that are not 0."""
    stream = TactileStream(FINGERS, "right")
    readings: list[TactileReading] = []
    for number, each in enumerate(data):
        readings += stream.receive(each, number * 10 * MS) or ()
    return readings, {name: n for name, n in stream.counters.as_dict().items() if n}


@pytest.mark.parametrize(
    "fields",
    [
        {"seq": 7, "t": 12.5, "hand": "right", "v": 3},
        {"counts": {"lf": None, **dict.fromkeys(FINGERS, [2795.0] * 24)}},
        {"seq": None, "t": 0},
        {"seq": (1 << 63) - 1, "pad": " " * (4096 - len(message(seq=(1 << 63) - 1, pad="")))},
    ],
)
def test_a_valid_message_gives_a_reading_without_faults(fields: dict[str, object]) -> None:
    (reading,), counters = received(message(**fields))
    assert reading.counts.tolist() in ([COUNTS] * 3, [[2795] * 24] * 3)
    assert not reading.faults.any()
    assert counters == {"readings": 1}


@pytest.mark.parametrize(
    ("data", "counter", "said"),
    [
        (b"", "bad_messages", "Expecting value"),
        (b'{"seq": 1}', "bad_messages", "not an object with an object `counts`"),
        (message(counts=[COUNTS] * 3), "bad_messages", "not an object with an object `counts`"),
        (message(seq=None), "bad_messages", "it has neither `seq` nor `t`"),
        (message(seq=-1), "bad_messages", "`seq` is -1, and not an integer"),
        (message(seq=1.0), "bad_messages", "`seq` is 1.0"),
        (message(t="now"), "bad_messages", "`t` is 'now', and not a number of seconds"),
        (message(t=1e300), "bad_messages", "`t` is 1e+300"),
        (message(t=float("nan")), "bad_messages", "`t` is 'NaN'"),
        (message(t=True), "bad_messages", "`t` is True"),
        (message(seq=1 << 63), "bad_messages", "`seq` is 9223372036854775808"),
        (message().ljust(4097), "bad_messages", "it is longer than 4096 bytes"),
        (message() + b" x", "bad_messages", "Extra data"),
        (message().decode().encode("utf-16"), "bad_messages", "codec can't decode"),
        (b"[" * 4096, "bad_messages", "recursion"),
        (b'{"seq": ' + b"9" * 4080 + b"}", "bad_messages", "not an object"),
        (b'{"seq": 1, "counts": {"ff": [], "ff": []}}', "bad_messages", "a key stands twice"),
        (message(hand="left"), "other_hands", "names the hand 'left'"),
        (message(hand=["right"]), "other_hands", "names the hand ['right']"),
    ],
)
def test_a_wrong_message_is_dropped_counted_and_logged_once(
    data: bytes, counter: str, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert received(data, data, data) == ([], {counter: 3})
    assert len(caplog.messages) == 1
    assert said in caplog.text


@pytest.mark.parametrize(
    ("finger", "faults", "counter", "number"),
    [
        (None, {ElectrodeFault.MISSING: 24}, "absent_fingers", 1),
        ([0] * 24, {ElectrodeFault.MISSING: 24}, "absent_fingers", 1),
        ([4095] * 24, {ElectrodeFault.MISSING: 24}, "absent_fingers", 1),
        (COUNTS[:19], {ElectrodeFault.MISSING: 24}, "wrong_sizes", 1),
        ([*COUNTS, 2024], {ElectrodeFault.MISSING: 24}, "wrong_sizes", 1),
        ("2000", {ElectrodeFault.MISSING: 24}, "wrong_sizes", 1),
        ([*COUNTS[:21], 4096, -1, 0.5], {ElectrodeFault.NOT_A_COUNT: 3}, "bad_counts", 3),
        ([*COUNTS[:20], None, True, "7", float("nan")], {ElectrodeFault.NOT_A_COUNT: 4},
         "bad_counts", 4),
        ([0, 4095, *COUNTS[:22]], {}, None, 0),
    ],
)  # fmt: skip
def test_a_value_that_is_not_a_count_leaves_others_valid(
    finger: object,
    faults: dict[ElectrodeFault, int],
    counter: str | None,
    number: int,
    caplog: pytest.LogCaptureFixture,
) -> None:
    (reading,), counters = received(message({"ff": COUNTS, "mf": finger, "th": COUNTS}))
    assert ("not 24 counts in 0..4095 of each finger" in caplog.text) == bool(counter)
    assert reading.counts[[0, 2]].tolist() == [COUNTS] * 2
    for fault in ElectrodeFault:
        assert len(flags(reading, fault)) == faults.get(fault, 0)
    assert not reading.counts[reading.faults != 0].any()
    assert counters == {
        "readings": 1,
        **({} if counter is None else {"faulty_readings": 1, counter: number}),
    }


ANY = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=3),
    lambda inner: (
        st.lists(inner, max_size=24) | st.dictionaries(st.sampled_from((*FINGERS, "x")), inner)
    ),
    max_leaves=30,
)


@settings(max_examples=100, deadline=None)
@given(st.dictionaries(st.sampled_from((*FINGERS, "rf", "x")), ANY), ANY, ANY, ANY)
def test_any_json_is_a_reading_or_counted(
    counts: dict[str, object], seq: object, t_s: object, hand: object
) -> None:
    readings, counters = received(message(counts, seq=seq, t=t_s, hand=hand))
    dropped = counters.get("bad_messages", 0) + counters.get("other_hands", 0)
    assert len(readings) + dropped == 1
    for reading in readings:
        assert reading.counts.max() <= 4095
        assert not reading.counts[reading.faults != 0].any()


def test_an_unknown_finger_name_is_left_out_and_counted() -> None:
    (reading,), counters = received(message(dict.fromkeys((*FINGERS, "rf", "FF"), COUNTS)))
    assert reading.counts.tolist() == [COUNTS] * 3
    assert counters == {"readings": 1, "unknown_names": 1}


@pytest.mark.parametrize(
    ("stamps", "taken"),
    [
        ([{"seq": n} for n in (5, 5, 4, 6)], [0, 3]),
        ([{"seq": None, "t": n / 100} for n in (5, 5, 4, 6)], [0, 3]),
        ([{"seq": n, "t": 1} for n in range(20)], [0]),
        ([{"seq": 1, "t": n} for n in range(20)], [0]),
        ([{"seq": 5}, {"seq": None, "t": 9}, {"seq": 5}, {"seq": None, "t": 9}], [0, 1]),
        ([{"seq": n, "t": n / 100} for n in (500, *range(12))], [0, 11, 12]),
        ([{"seq": n} for n in (500, *range(6), 501, *range(6, 17))], [0, 7, 18]),
    ],
    ids=["by number", "by time", "time stands", "number stands", "in turns", "new start", "late"],
)
def test_a_message_that_is_not_newer_is_dropped(
    stamps: list[dict[str, Any]], taken: list[int]
) -> None:
    readings, counters = received(*[
        message({"ff": [1000 + place] * 24}, **stamp) for place, stamp in enumerate(stamps)
    ])  # fmt: skip
    assert [int(reading.counts[0, 0]) - 1000 for reading in readings] == taken
    assert counters["old_messages"] == len(stamps) - len(taken)


@pytest.mark.parametrize(
    ("sent", "made"),
    [
        # Sender's time, s; reception and result, ms.
        ([(5.0, 100), (5.01, 110), (5.02, 150), (5.03, 151)], [100, 110, 120.04, 130.041]),
        ([(5.0, 150), (5.01, 110), (5.02, 120)], [150, 110, 120]),
        ([(5.0, 100), (None, 150), (5.02, 160)], [100, 150, 120.06]),
        # A clock that is too slow by 0.05 %, and a queue that grows by 1 %.
        ([(0.0, 0), (1.0, 1000.5), (2.0, 2001)], [0, 1000.5, 2001]),
        ([(0.0, 0), (1.0, 1010), (2.0, 2020)], [0, 1001.01, 2002.02]),
    ],
)
def test_messages_are_dated_by_sender_time_and_quickest_delay(
    sent: list[tuple[float | None, float]], made: list[float]
) -> None:
    clock = SenderClock()
    found = [clock.made_ns(t_s, round(received_ms * MS)) / MS for t_s, received_ms in sent]
    assert found == pytest.approx(made, abs=0.001)


@pytest.mark.parametrize(
    ("t_s", "received_ms", "made_ms"),
    [(5.51, 2020, 1511), (4.01, 2020, 2020), (4.99, 1980, 991), (4.99, 1992, 1992)],
)
def test_falling_sender_time_a_second_late_starts_a_new_zero(
    t_s: float, received_ms: int, made_ms: float
) -> None:
    clock = SenderClock()
    clock.made_ns(5.0, 1000 * MS)
    assert clock.made_ns(t_s, received_ms * MS) / MS == pytest.approx(made_ms, abs=0.03)


def test_a_message_over_100_ms_late_is_counted() -> None:
    stream = TactileStream(FINGERS, "right")
    for number, received_ms in enumerate((1000, 1010, 1119, 1140)):
        stream.receive(message(seq=number, t=number / 100), received_ms * MS)
    assert stream.counters.late_messages == 1


def test_the_first_reading_after_restart_or_outage_is_interrupted() -> None:
    stream, readings = TactileStream(FINGERS, "right"), list[TactileReading]()
    for place, seq in enumerate((*range(50, 60), *range(20), 5000, 5001)):
        if place == 31:
            stream.interrupt()
        readings += stream.receive(message(seq=seq), 0) or []
    assert [at for at, reading in enumerate(readings) if reading.interrupted] == [10, 20, 21]
    assert stream.counters.restarts == 2


@pytest.mark.parametrize(
    ("times", "interrupted"),
    [
        ([10.0, 20.0, 30.0, 40.0], [False]),  # milliseconds
        ([1e7, 2e7, 3e7, 4e7], [False]),  # nanoseconds
        ([0.01, 3600.02, 3600.03, 3600.04], [False, True, False]),  # a clock that was set
        # A message that waited, and losses behind it: ten times 10 ms and 200 ms at most.
        ([0.01, 0.02, 0.03, 0.33], [False] * 4),
        ([0.01, 0.02, 0.03, 0.331], [False] * 3),
    ],
)
def test_messages_whose_sender_time_leaps_are_dropped(
    times: list[float], interrupted: list[bool]
) -> None:
    readings, counters = received(*[message(seq=n, t=t_s) for n, t_s in enumerate(times)])
    assert [reading.interrupted for reading in readings] == interrupted
    assert counters.get("bad_messages", 0) == 4 - len(interrupted)


@pytest.fixture
def driver(receiver: Receiver, clock: Clock) -> Iterator[TactileStreamDriver]:
    with TactileStreamDriver(LOOPBACK, FINGERS, "right", clock=clock) as driver:
        yield driver


def test_seq_gaps_are_losses_and_another_sender_has_other_serials(
    driver: TactileStreamDriver, receiver: Receiver, clock: Clock
) -> None:
    receiver.send(message(seq=3), message(seq=4), message(seq=7))
    readings = tactile(driver.read_ready())
    first = dict.fromkeys(FINGERS, "udp://127.0.0.1:7")
    assert driver.serials == first
    receiver.send(message(seq=9), sender=THERE)
    assert list(driver.read_ready()) == []
    clock.now_ns += 500 * MS
    assert list(driver.read_ready()) == []
    receiver.send(message(seq=9), sender=THERE)
    readings += tactile(driver.read_ready())
    assert driver.serials == dict.fromkeys(FINGERS, "udp://127.0.0.1:8")
    assert [reading.seq for reading in readings] == [0, 1, 4, 6]
    assert [reading.interrupted for reading in readings] == [False, False, False, True]
    assert driver.counters.missed_readings == 3
    assert driver.counters.foreign_datagrams == 1


PERIOD_NS = 10_000_000
START_S = 70.0
ACTIONS = ("send", "lose", "copy", "late", "stall", "stale")
"""What happens to a sweep's message. `copy`: it comes again later; `late`: others overtake it;
`stall`: those behind it wait as well; `stale`: it repeats the time of the one before."""


@st.composite
def arrivals(draw: st.DrawFn) -> list[tuple[int, Datagram, int]]:
    """Draw times of arrival in ns, datagrams and numbers of their sweeps, made every 10 ms.

    The first sweep comes at once. `periods`: time for which a message, or its copy, is held back.
    """
    actions = st.tuples(st.sampled_from(ACTIONS), st.integers(1, 20))
    runs = draw(st.lists(st.tuples(actions, st.integers(1, 12)), min_size=1, max_size=15))
    plan = [("send", 0), *(each for each, times in runs for _ in range(times))]
    found: list[tuple[int, Datagram, int]] = []
    held_until = 0
    for place, (action, periods) in enumerate(plan):
        good = dict(zip(FINGERS, counts_of(place).tolist(), strict=True))
        now, time_s = max(place, held_until), START_S + place / 100
        if action == "stall":
            now = held_until = max(held_until, place + periods)
        if action == "stale":
            time_s -= 0.01
        elif action == "late":
            now += periods
        datagram = Datagram(message(good, seq=place, t=time_s), 0, HERE)
        if action != "lose":
            found.append((now, datagram, place))
        if action == "copy":
            found.append((now + periods, datagram, place))
    found.sort(key=lambda each: each[0])  # those of one time stay in their order
    return [(PERIOD_NS * periods, datagram, place) for periods, datagram, place in found]


@settings(max_examples=100, deadline=None)
@given(arrivals())
def test_no_count_is_older_than_its_reading_says(sent: list[tuple[int, Datagram, int]]) -> None:
    receiver, clock = Receiver(), Clock()
    start_ns = clock.now_ns
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("graspd.drivers.udp.DatagramReceiver", lambda *_: receiver)
        driver = TactileStreamDriver(LOOPBACK, FINGERS, "right", clock=clock)
        driver.open()
        last = -1
        for received_ns, datagram, place in sent:
            clock.now_ns = start_ns + received_ns
            receiver.waiting.append(datagram)
            readings: list[Reading] = [*driver.read_ready(), *driver.read_ready()]
            if driver.sender != "udp://127.0.0.1:7":
                return  # after 0.5 s of silence: other sensors
            for reading in tactile(readings):
                assert number_in(reading) == place
                assert place > last or driver.counters.as_dict()["restarts"]
                # The first message came at once; clocks may drift by 0.1 %.
                sent_ns = start_ns + 10 * MS * place
                assert reading.t_ns <= sent_ns + received_ns // 1000
                last = place
        driver.close()
    assert last >= 0, "the first message is read"
