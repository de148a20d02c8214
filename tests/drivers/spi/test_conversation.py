"""Messages between host and bridge, and when they are sent, by the numbers of the protocol."""

from __future__ import annotations

import dataclasses

import pytest

from graspd.drivers.base import DeviceFault, Fact, LinkCause
from graspd.drivers.biotac import SEQUENCES
from graspd.drivers.link import LinkState
from graspd.drivers.spi.conversation import Conversation
from graspd.drivers.spi.messages import (
    DIGEST,
    FIRMWARE,
    BridgeStatus,
    Ping,
    Start,
    Stop,
    Sweep,
    encode,
    encode_frame,
)
from tests.drivers.spi.bridge_bench import (
    MS,
    T0,
    answer,
    greeted,
    hear,
    hello,
    opened,
    said,
    sweep,
    told,
    words,
)

S = 1000 * MS


def state(conversation: Conversation) -> LinkState:
    return conversation.link.state


def test_a_silent_bridge_is_given_up_after_four_pings() -> None:
    conversation, now_ns = opened(), T0
    for number in range(4):
        assert conversation.due_ns == now_ns
        assert said(conversation, now_ns - 1) == [] or number == 0
        assert said(conversation, now_ns) in ([], [Stop(), Ping(42 + number)])
        now_ns += 500 * MS
    assert conversation.due_ns == now_ns
    assert said(conversation, now_ns - 1) == []
    assert state(conversation) is LinkState.GREETING
    assert said(conversation, now_ns) == []
    assert state(conversation) is LinkState.WAITING
    assert conversation.counters.unanswered_pings == 4
    assert conversation.counters.link_failures == 1


def test_nonces_wrap_without_zero_which_means_a_reset() -> None:
    conversation = opened(nonce=(1 << 32) - 2)
    pings = [said(conversation, T0 + tries * 500 * MS)[1] for tries in range(3)]
    assert pings == [Ping((1 << 32) - 1), Ping(1), Ping(2)]


def test_a_ping_is_sent_every_247_milliseconds() -> None:
    conversation = greeted(hello(0, period_ms=1000))
    assert said(conversation, T0) == [Start()]
    for number in range(10):
        now_ns = conversation.due_ns
        assert said(conversation, now_ns) == [Ping(43 + number)]
        assert now_ns == T0 + 247 * MS * (number + 1)


@pytest.mark.parametrize(("period_ms", "silence_ms"), [(10, 100), (20, 200), (1000, 10_000)])
def test_the_link_is_lost_after_ten_sweep_periods_of_silence(
    period_ms: int, silence_ms: int
) -> None:
    conversation = greeted(hello(0, period_ms=period_ms))
    assert said(conversation, T0) == [Start()]
    heard_ns = T0 + 7 * MS
    assert len(hear(conversation, sweep(0, 1), heard_ns)) == 1
    assert state(conversation) is LinkState.UP
    said(conversation, heard_ns + silence_ms * MS - 1)
    assert state(conversation) is LinkState.UP
    said(conversation, heard_ns + silence_ms * MS)
    assert state(conversation) is LinkState.WAITING
    assert conversation.link.reason == f"no sweep for {silence_ms} ms"
    assert conversation.link.cause is LinkCause.TIMEOUT


@pytest.mark.parametrize(
    ("period_ms", "sensors", "why"),
    [
        (1001, 3, "port: the bridge sweeps once in 1.001 s only"),
        (10, 2, "port: the bridge has 2 sensors, the scene needs 3"),
    ],
)
def test_a_bridge_too_slow_or_with_few_sensors_is_refused(
    period_ms: int, sensors: int, why: str
) -> None:
    conversation = greeted(hello(0, period_ms=period_ms, sensors=sensors))
    assert (conversation.link.reason, conversation.counters.refused_bridges) == (why, 1)
    assert conversation.link.cause is LinkCause.SETTINGS


def test_a_board_that_resets_on_opening_is_pinged_again() -> None:
    conversation = opened()
    assert said(conversation, T0) == [Stop(), Ping(42)]
    assert said(conversation, T0) == []
    hear(conversation, hello(0), T0)
    assert said(conversation, T0) == [Stop(), Ping(43)]


def test_a_bridge_that_resets_while_sweeping_loses_the_link() -> None:
    conversation = greeted()
    sent = [encode(message) for message in (sweep(0, 10_000), hello(0), sweep(1, 20_000))]
    assert len(conversation.receive(b"".join(sent), T0 + S)) == 1
    assert conversation.link.reason == "the bridge was reset"
    assert conversation.counters.restarts == 1


def test_a_bridge_that_changes_its_sampling_loses_the_link() -> None:
    conversation = greeted(hello(0, period_ms=50))
    changed = hello(0, period_ms=50, channels=SEQUENCES["all"])
    answer(conversation, changed, T0 + 247 * MS)
    assert conversation.link.reason == "the bridge changed what it samples"


def test_a_bridge_whose_clock_stands_loses_the_link() -> None:
    conversation = greeted()
    made = [hear(conversation, sweep(number, 10_000), T0 + 20 * MS) for number in range(2)]
    assert list(map(len, made)) == [1, 0]
    assert conversation.link.reason == "the bridge's clock stands or falls back"
    assert conversation.counters.clock_faults == 1


def test_at_most_eight_unanswered_pings_are_remembered() -> None:
    conversation, now_ns = greeted(hello(0, period_ms=1000)), T0
    said(conversation, T0)
    for _ in range(8):
        now_ns = conversation.due_ns
        assert len(said(conversation, now_ns)) == 1
    assert conversation.counters.unanswered_pings == 0
    now_ns = conversation.due_ns
    assert said(conversation, now_ns) == [Ping(51)]
    assert conversation.counters.unanswered_pings == 1
    conversation.lost(LinkCause.DISCONNECTED, "unplugged", now_ns)
    assert conversation.counters.unanswered_pings == 9


def words_of(conversation: Conversation) -> dict[str, str]:
    return {name: fact.text for name, fact in conversation.describe().items()}


@pytest.mark.parametrize(
    ("serials", "numbers", "sensors", "errors"),
    [
        (("A", "B", "C"), (0, 0, 0), Fact("A, B, C"), Fact("0, 0, 0")),
        (("A", "B", "A"), (0, 0, 0), Fact("A, B, A", DeviceFault.SENSOR_TWICE), Fact("0, 0, 0")),
        (("A", "", "C"), (0, 9, 0), Fact("A, none, C", DeviceFault.SENSOR_ABSENT), Fact("0, -, 0")),
        (("A", "B", "C"), (9, 0, 0), Fact("A, B, C"), Fact("9, 0, 0", DeviceFault.SENSOR_WORDS)),
        (("", "", ""), (0, 0, 0), Fact("none, none, none", DeviceFault.NO_SENSOR), Fact("-, -, -")),
    ],
)
def test_absent_or_duplicate_sensors_and_damaged_words_are_faults(
    serials: tuple[str, ...], numbers: tuple[int, ...], sensors: Fact, errors: Fact
) -> None:
    conversation = greeted(dataclasses.replace(hello(0), serials=serials))
    hear(conversation, BridgeStatus(1, 0, 0, 0, 0, numbers), T0)
    assert conversation.describe()["sensors"] == sensors
    assert conversation.describe()["spi errors"] == errors


def test_the_link_description_shows_board_and_sensors() -> None:
    conversation = opened()
    assert words_of(conversation) == {"port": "port", "link": "greeting"}
    serials = ("BTSP-1", "", "BTSP-3")
    for nonce, t_ns in ((42, T0), (43, T0 + 2 * MS)):
        said(conversation, t_ns)
        about_it = dataclasses.replace(hello(nonce), firmware=0x0203, serials=serials)
        hear(conversation, about_it, t_ns + 2 * MS)
    about = {
        "board": "b",
        "firmware": "2.3",
        "sequence": "24 samples at 100.0 Hz",
        "sensors": "BTSP-1, none, BTSP-3",
    }
    now = {"link": "greeting", "clock rate": "1000000 Hz", "round trip": "2.00 ms"}
    assert words_of(conversation) == {"port": "port", **about, **now}
    assert conversation.serials == {"ff": "BTSP-1", "th": "BTSP-3"}
    conversation.lost(LinkCause.DISCONNECTED, "unplugged", T0)
    lost = {"link": "waiting", "why": "unplugged"}
    assert words_of(conversation) == {"port": "port", **about, **lost}


def test_the_link_description_shows_clock_rate_sweep_time_and_errors() -> None:
    conversation = greeted(hello(0, period_ms=500))
    said(conversation, T0 + S)  # a PING, answered after 1 ms by a clock that is 100 ppm fast
    hear(conversation, hello(43, 1_000_100, period_ms=500), T0 + S + MS)
    for seq, took in enumerate((1910, 2209, 1900)):
        made = Sweep(seq, 1_000_200 + 3000 * seq, 1_000_200 + 3000 * seq + took, 7, words())
        assert len(hear(conversation, made, T0 + S + 20 * MS)) == 1
    late = Sweep(3, 1_020_000, 1_520_000, 7, words())
    assert conversation.describe()["sweep"] == Fact("2.21 ms at most, of 500.00 ms")
    hear(conversation, late, T0 + S + 540 * MS)
    too_long = Fact("500.00 ms is too long for 500.00 ms", DeviceFault.SWEEP_TOO_LONG)
    assert conversation.describe()["sweep"] == too_long
    hear(conversation, BridgeStatus(1, 3, 0, 0, 0, (0, 7, 24)), T0 + S + 20 * MS)
    described = words_of(conversation)
    assert described["clock rate"] == "1000000 Hz"
    assert described["spi errors"] == "0, 7, 24"


@pytest.mark.parametrize(
    ("firmware", "newer"),
    [(FIRMWARE - 1, "0.2"), (FIRMWARE, None), (FIRMWARE + 1, None)],
)
def test_the_link_description_names_firmware_newer_than_the_bridges(
    firmware: int, newer: str | None
) -> None:
    conversation = greeted(dataclasses.replace(hello(0), firmware=firmware))
    fact = None if newer is None else Fact(newer, DeviceFault.OLD_FIRMWARE)
    assert conversation.describe().get("newer firmware") == fact


def test_bridge_counters_are_copied_and_an_echo_counts_as_unknown() -> None:
    conversation = greeted()
    hear(conversation, BridgeStatus(1, 2, 3, 4, 5, (6,)), T0)
    hear(conversation, Ping(7), T0)
    counters = conversation.counters
    shown = counters.bridge_overruns, counters.bridge_tx_dropped, counters.bridge_rx_errors
    assert (*shown, counters.unknown_frames) == (3, 4, 5, 1)


@pytest.mark.parametrize(("kind", "bad"), [(1, 1), (2, 1), (3, 1), (4, 0), (0x84, 0)])
def test_frames_with_bad_content_and_unknown_types_are_counted_apart(kind: int, bad: int) -> None:
    conversation = opened()
    digest = 0 if kind == 1 else DIGEST
    assert conversation.receive(encode_frame(kind, b"x", digest), T0) == []
    counters = conversation.counters
    assert (counters.frames, counters.bad_frames, counters.unknown_frames) == (1, bad, 1 - bad)


@pytest.mark.parametrize(
    ("numbers", "taken", "counted"),
    [
        ((1000,), 1, {"missed_readings": 1000}),
        ((1001,), 1, {}),
        (((1 << 32) - 1, 1), 2, {"missed_readings": 1}),
        ((0, (1 << 31) - 1), 2, {"missed_readings": (1 << 31) - 2}),
        ((0, 1 << 31), 1, {"reordered": 1}),
        ((0, 0), 1, {"duplicates": 1}),
    ],
)
def test_missed_reordered_and_duplicate_sweeps_are_counted_by_number(
    numbers: tuple[int, ...], taken: int, counted: dict[str, int]
) -> None:
    conversation = greeted()
    made = [hear(conversation, sweep(seq, at * 10**9), T0) for at, seq in enumerate(numbers, 1)]
    assert sum(map(len, made)) == taken
    counters = conversation.counters.as_dict()
    names = ("missed_readings", "reordered", "duplicates")
    assert {name: counters[name] for name in names if counters[name]} == counted


SERIALS, MISREAD, OTHERS = ("A", "B", "C"), ("A", "8", "C"), ("A", "D", "C")
BY_FINGER = {"ff": "A", "mf": "B", "th": "C"}


@pytest.mark.parametrize(
    ("hellos", "believed"),
    [
        ([SERIALS], None),
        ([SERIALS, SERIALS], "B"),
        ([MISREAD, SERIALS], None),
        ([MISREAD, SERIALS, SERIALS], "B"),
        ([("A", "", "C"), SERIALS, SERIALS], "B"),
        ([MISREAD, SERIALS, MISREAD, SERIALS], None),
    ],
)
def test_readings_wait_for_two_hellos_of_the_same_sensors(
    hellos: list[tuple[str, ...]], believed: str | None
) -> None:
    conversation = opened()
    for at, serials in enumerate(hellos, 1):
        assert conversation.hello is None
        answer(conversation, dataclasses.replace(hello(0), serials=serials))
        made = hear(conversation, sweep(0, 10**9), T0)
        assert bool(made) == (at == len(hellos) and believed is not None)
    assert conversation.serials.get("mf") == believed


def test_a_bridge_whose_serial_numbers_keep_changing_is_given_up() -> None:
    conversation = opened()
    for number in range(5):
        told(conversation, (f"A{number}", "B", "C"), T0)
    assert said(conversation, T0) == []
    assert said(conversation, T0 + 500 * MS) == []
    assert state(conversation) is LinkState.WAITING
    assert conversation.link.reason == "port: the bridge names other sensors each time"
    assert conversation.link.cause is LinkCause.SERIALS


@pytest.mark.parametrize(
    ("second", "third", "serials"),
    [
        (SERIALS, None, SERIALS),  # it was misread
        (OTHERS, None, OTHERS),  # it was exchanged
        (MISREAD, OTHERS, OTHERS),  # exchanged, and misread once more
    ],
)
def test_changed_serial_numbers_stop_readings_until_two_hellos_agree(
    second: tuple[str, ...], third: tuple[str, ...] | None, serials: tuple[str, ...]
) -> None:
    conversation = opened()
    for _ in range(2):
        told(conversation, SERIALS, T0)
    assert len(hear(conversation, sweep(0, 10**9), T0)) == 1
    now_ns = T0 + 247 * MS
    told(conversation, OTHERS, now_ns)
    assert conversation.counters.link_losses == 1
    for at, each in enumerate((second, *(() if third is None else (third, third)))):
        assert hear(conversation, sweep(1 + at, 2 * 10**9), now_ns) == []
        assert conversation.serials == BY_FINGER
        told(conversation, each, now_ns)
    assert len(hear(conversation, sweep(9, 3 * 10**9), now_ns)) == 1
    assert tuple(conversation.serials.values()) == serials


def test_a_sensor_silent_in_one_hello_keeps_the_link_up() -> None:
    conversation = opened()
    for _ in range(2):
        told(conversation, SERIALS, T0)
    about, now_ns = hello(0, period_ms=50), T0
    for serials in (("A", "", "C"), SERIALS):
        now_ns += 247 * MS
        made = sweep(now_ns // MS % 1000, (now_ns - T0) // 1000 - 2000)
        assert len(hear(conversation, made, now_ns)) == 1
        tick = (now_ns - T0) // 1000
        answer(conversation, dataclasses.replace(about, tick=tick, serials=serials), now_ns)
        assert conversation.counters.link_losses == 0
        known = zip(("ff", "mf", "th"), serials, strict=True)
        assert conversation.serials == {finger: serial for finger, serial in known if serial}
