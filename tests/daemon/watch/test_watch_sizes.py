"""The terminal at the sizes that people have: 60 columns, 80 x 24, 200 x 50, several hands."""

from __future__ import annotations

import io
import json
import re
import time
from typing import Any

import pytest
from msgspec import structs
from rich.console import Console
from rich.text import Text

from daemon.judge.reasons import ADVICE, Decision, Reason
from daemon.watch.pixels import Canvas
from daemon.watch.snapshot import Snapshot
from daemon.watch.terminal import draw
from tests.daemon.watch.watch_fakes import (
    ENDPOINT,
    MS,
    RESTING,
    a_view,
    after,
    status,
    tactile,
    text_of,
    verdict,
)


@pytest.mark.parametrize("size", [(80, 24), (60, 30), (120, 40), (200, 50)])
def test_the_figures_of_a_dead_daemon_say_of_when_they_are_and_are_dim(
    size: tuple[int, int],
) -> None:
    view = after((b"status.right", status(0)), (b"verdict.right", verdict(0, Decision.STABLE)))
    alive, dead = view.snapshot(0), view.snapshot(12_000 * MS)
    assert (alive.last_t, dead.last_t) == (1790000000.0, 1789999988.0)  # 12 s before the wall clock
    then = time.strftime("%H:%M:%S", time.localtime(1789999988))
    wanted = re.compile(rf"last message +{then}, 12 s ago; figures of then")
    assert wanted.search("\n".join(text_of(dead, *size, Canvas())))
    assert not wanted.search("\n".join(text_of(alive, *size, Canvas())))
    for seen, dims in ((alive, False), (dead, True)):
        file = io.StringIO()
        console = Console(file=file, width=size[0], force_terminal=True, color_system="truecolor")
        console.print(draw([seen], *size, Canvas()))
        found = re.search(r"(\x1b\[[0-9;]*m)p50 250 us", file.getvalue())
        assert bool(found and found[1] == "\x1b[2;3m") is dims  # dim and italic (ECMA-48)


FIVE = ["ff", "mf", "rf", "lf", "th"]


def a_full_hand(hand: str = "right", decision: Decision = Decision.SLIP) -> Snapshot:
    """Five fingers that all move and touch, and a reason longer than a line."""
    view = a_view(hand)
    message = json.loads(tactile(0, RESTING, RESTING))
    message |= {"fingers": FIVE, "counts": [RESTING] * 5, "faults": [[0] * 24] * 5}
    motion = dict.fromkeys(FIVE, 1.2)
    limits = dict.fromkeys(FIVE, 1.5)
    more: dict[str, Any] = {"contact": FIVE, "motion": motion, "motion_limits": limits}
    reasons = [] if decision is not Decision.UNKNOWN else [Reason.STALE]
    view.take(f"status.{hand}".encode(), status(0), 0)
    view.take(f"tactile.{hand}".encode(), json.dumps(message).encode(), 0)
    said = verdict(0, decision, still_ms=131.0, reasons=reasons, **more)
    view.take(f"verdict.{hand}".encode(), said, 0)
    return view.snapshot(0)


@pytest.mark.parametrize("size", [(24, 6), (40, 12), (79, 23), (200, 8)])
@pytest.mark.parametrize("decision", Decision)
def test_the_verdict_is_what_goes_last_from_a_terminal_that_is_too_small(
    size: tuple[int, int], decision: Decision
) -> None:
    lines = text_of(a_full_hand(decision=decision), *size, Canvas())
    assert len(lines) <= size[1]
    assert decision.value.upper() in "\n".join(lines)


@pytest.mark.parametrize("size", [(80, 24), (60, 30), (200, 50)])
def test_no_part_of_a_line_colours_what_stands_beside_it(size: tuple[int, int]) -> None:
    rows = draw([a_full_hand()], *size, Canvas()).renderables
    assert {str(row.style) for row in rows if isinstance(row, Text)} == {""}
    banner = next(row for row in rows if isinstance(row, Text) and "SLIP" in row.plain)
    console = Console(color_system="truecolor")
    behind = [
        style.bgcolor is not None
        for at in range(len(banner.plain.rstrip()))
        for style in [banner.get_style_at_offset(console, at)]
    ]
    across = 20 if size[0] == 60 else 24
    assert behind == [True] * across + [False] * (len(behind) - across)


@pytest.mark.parametrize("decision", Decision)
def test_sixty_columns_are_enough_for_all_words(decision: Decision) -> None:
    seen = a_full_hand(decision=decision)
    lines = text_of(seen, 60, 50, Canvas())
    assert len(lines) <= 50
    assert max(map(len, lines)) <= 60
    text = " ".join("\n".join(lines).split())
    assert "\u2026" not in text
    for finger in FIVE:
        assert f"{finger} touches" in text
    for words in (
        *(
            "touches ff mf rf lf th",
            "still 131 ms, may slide",
            *("FFJ3 28.6°", "last grasps (* watched)" if seen.grasps else ""),
            "small-session 0123456789ab",
        ),
        *("latency p50 250 us, p99 500 us", "lost here 0 messages", f"at {ENDPOINT} connecting"),
        *("ff_7 electrode-dead: " + ADVICE[Reason.ELECTRODE_DEAD], "-5 min", "now", "~ silent"),
        *(line.advice for line in seen.why),
    ):
        assert words in text


def test_a_large_terminal_has_a_lane_for_each_kind_of_verdict_and_a_plot() -> None:
    """By hand, 192 columns for 300 s: 60 s end in column 38, and 180 s within column 115."""
    seen = structs.replace(
        a_full_hand(),
        history=["."] * 60 + ["s"] * 120 + ["x"] * 120,
        history_p=[-1] * 60 + [0] * 120 + [75] * 120,
    )
    lines = text_of(seen, 200, 50, Canvas(colour=False, ascii_only=True))
    assert 44 <= len(lines) <= 50
    lanes = {line[:8].strip(): line[8:].rstrip() for line in lines}
    assert lanes["silent"] == "~" * 39
    assert lanes["stable"] == " " * 39 + "=" * 77
    assert lanes["slip"] == " " * 115 + "X" * 77
    assert lanes["watched"] == lanes["wrong"] == ""
    assert lanes["75 %"] == "." * 115 + "*" * 77
    assert lanes["0 %"] == "." * 39 + "*" * 76 + "." * 77
    assert lanes["100 %"] == "." * 192
    (axis,) = [line[8:] for line in lines if "now|" in line]
    ticks = [axis.index(f"|-{minute} min") for minute in (5, 4, 3, 2, 1)]
    assert ticks == [0, 38, 76, 115, 153]
    assert axis.endswith("now|")


@pytest.mark.parametrize(
    ("width", "height", "shown"),
    [(200, 50, "beside"), (100, 60, "below"), (80, 24, "one"), (60, 24, "one")],
)
def test_of_several_hands_every_verdict_is_seen(width: int, height: int, shown: str) -> None:
    hands = [a_full_hand("left", Decision.STABLE), a_full_hand("right", Decision.SLIP)]
    lines = text_of(hands, width, height, Canvas())
    assert len(lines) <= height
    assert max(map(len, lines)) <= width
    text = "\n".join(lines)
    beside = [line for line in lines if "graspd left" in line and "graspd right" in line]
    assert bool(beside) is (shown == "beside")
    assert ("graspd left" in text, "graspd right" in text) == (True, shown != "one")
    assert "STABLE" in text
    assert "SLIP" in text
    if shown == "one":
        assert "tab next hand" in text
        assert lines[0].startswith("right  SLIP 75 %  do not lift")
        other = text_of(hands, width, height, Canvas(), chosen=1)
        assert other[0].startswith("left  STABLE 25 %  lift")
        assert other[1].startswith("graspd right")
