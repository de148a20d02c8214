"""The table in a terminal: all words at 60 columns, verdict first, several hands."""

from __future__ import annotations

import os
import re
import sys
import time

import pytest
from msgspec import structs

from graspd.daemon.judge.reasons import ADVICE, Decision, Reason
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.watch.snapshot import Snapshot, Tone
from graspd.daemon.watch.terminal import STYLES, Keyboard
from tests.daemon.watch.watch_fakes import (
    ENDPOINT,
    MS,
    a_view,
    after,
    status,
    text_of,
    verdict,
    whole_hand,
)
from tests.kit.crowd import SELECT_MAX, crowded


def a_full_hand(decision: Decision = Decision.SLIP, hand: str = "right") -> Snapshot:
    return whole_hand(a_view(hand), hand, decision)


@pytest.mark.parametrize("width", [60, 80, 200])
@pytest.mark.parametrize("decision", Decision)
def test_all_words_fit_a_terminal_of_sixty_columns(decision: Decision, width: int) -> None:
    seen = a_full_hand(decision)
    lines = text_of(seen, width)
    assert len(lines) <= 40
    assert max(map(len, lines)) <= width
    assert f" {decision.value.upper()} " in lines[0]
    text = " ".join("\n".join(lines).split())
    assert "\u2026" not in text
    for words in (
        "q ends",
        "touches ff mf rf lf th, still 131 ms, may slide",
        "rf motion not known",
        "th ########--|---------- motion 1.2 of 1.5",  # the bar has the limit in its middle
        "FFJ3 28.6°",  # 0.5 rad
        "cnn1 0123456789ab",
        "latency 250 us, 99 % below 500 us",
        "session 57 grasps, calibrated",
        f"endpoint {ENDPOINT} connecting",
        f"act ff_7 electrode-dead: {ADVICE[Reason.ELECTRODE_DEAD]}",
        *(line.advice for line in seen.why),
    ):
        assert words in text
    if decision is not Decision.UNKNOWN:
        assert f"last grasps 7 {decision.value}" in text


@pytest.mark.parametrize("tone", Tone)
def test_only_the_verdict_has_the_colour_of_its_tone(tone: Tone) -> None:
    seen = structs.replace(a_full_hand(), tone=tone, headline="word")
    drawn = "\n".join(text_of(seen, 80, colours=True))
    assert ("48;2;" in drawn) == (tone is not Tone.LEANS)  # hollow
    coloured = re.findall(r"\x1b\[[0-9;]*38;2;[0-9;]*m([^\x1b]*)", drawn)
    assert coloured == [" WORD "]
    assert STYLES.keys() == set(Tone)


@pytest.mark.parametrize("width", [60, 80, 200])
def test_figures_of_a_dead_daemon_are_dim_and_dated(width: int) -> None:
    view = after((b"status.right", status(0)), (b"verdict.right", verdict(0, Decision.STABLE)))
    alive, dead = view.snapshot(0), view.snapshot(12_000 * MS)
    assert (alive.last_t, dead.last_t) == (1790000000.0, 1789999988.0)  # 12 s before the wall clock
    then = time.strftime("%H:%M:%S", time.localtime(1789999988))
    last = f"last message  {then}, 12 s ago; figures of then"
    assert last in "\n".join(text_of(dead, width))
    assert last not in "\n".join(text_of(alive, width))
    for seen, dims in ((alive, False), (dead, True)):
        drawn = "\n".join(text_of(seen, width, colours=True))
        styles = re.search(r"(\x1b\[[0-9;]*m)age 0.2 ms", drawn)
        assert bool(styles and styles[1] == "\x1b[2;3m") is dims  # dim and italic (ECMA-48)


def test_names_that_come_in_messages_cannot_move_the_cursor() -> None:
    evil = "\x1b[2J\x1b]0;owned\x07"
    view = after(
        (b"verdict.right", verdict(0, Decision.SLIP, model=evil, repaired=[evil])),
        (b"status.right", status(0, health={evil: Reason.HELD}, drivers={evil: {evil: 1}})),
    )
    text = "\n".join(text_of(view.snapshot(0), 120))
    assert "\x1b" not in text
    assert "\x07" not in text
    assert r"\x1b[2J" in text


def test_lines_that_do_not_fit_are_shown_page_by_page() -> None:
    places = [f"{finger}_{place}" for finger in ("ff", "mf", "th") for place in range(1, 25)]
    health = dict(zip(places, [*Reason, *Reason, *Reason], strict=False))
    view = after((b"status.right", status(0, health=health)), (b"verdict.right", verdict(0)))
    seen = view.snapshot(0)
    whole = text_of(seen, 80)
    pages = [text_of(seen, 80, height=24, page=page) for page in range(5)]
    assert [len(page) <= 24 for page in pages] == [True] * 5
    wrong = next(at for at, line in enumerate(whole) if line.startswith("evidence")) - 2
    assert pages[0][-1].rstrip() == (
        f"{len(whole) - 23} more lines, {wrong - 21} of them on what is wrong: space shows them"
    )
    assert all(page[:2] == whole[:2] for page in pages)  # verdict and clock stay
    assert pages[0][2:-1] + pages[1][2:-1] == whole[2:44]
    last = (len(whole) - 3) // 21
    assert pages[last][2:-1] == whole[-21:]
    assert pages[last + 1] == pages[0]


def test_several_hands_all_show_their_verdicts() -> None:
    hands = [a_full_hand(Decision.STABLE, "left"), a_full_hand(Decision.SLIP, "right")]
    beside = text_of(hands, 200)
    assert re.fullmatch(
        r"left  STABLE  .*25 %, lift; .* right  SLIP  .*75 %, do not lift; .*", beside[0]
    )
    for chosen, name in enumerate(("left", "right")):
        lines = text_of(hands, 100, chosen)
        assert lines[0].startswith("left  STABLE  slip probability 25 %, lift")
        assert lines[1].startswith("right  SLIP  slip probability 75 %, do not lift")
        assert f"details of {name}: " in lines[2]
        assert "tab: next hand" in lines[2]


def test_keys_are_read_above_descriptor_1024(monkeypatch: pytest.MonkeyPatch) -> None:
    with crowded(), StopSignal() as stop:
        near, far = os.openpty()
        with open(far, closefd=True) as terminal:
            monkeypatch.setattr(sys, "stdin", terminal)
            keyboard = Keyboard(stop)
            with keyboard.unbuffered():
                assert terminal.fileno() >= SELECT_MAX
                os.write(near, b"\t\t ")
                assert not keyboard.wait()
                assert (keyboard.tabs, keyboard.spaces) == (2, 1)
                os.write(near, b"\x1bOQ")  # F2
                assert not keyboard.wait()
                for typed in (b"q", b"\tq"):
                    os.write(near, typed)
                    assert keyboard.wait()
        os.close(near)
