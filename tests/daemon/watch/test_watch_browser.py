"""The page in a real Chromium: the verdict is seen, and so is silence."""

from __future__ import annotations

import json
import re
import time
from typing import Literal

import pytest

from graspd.daemon.judge.reasons import Decision
from graspd.daemon.watch.snapshot import Snapshot
from graspd.daemon.watch.view import View
from tests.daemon.watch.browser import (
    BANNER,
    CHROMIUM,
    Browser,
    Page,
    reads,
    says,
    see,
    serving_hands,
    show,
    text,
)
from tests.daemon.watch.watch_fakes import Talker, verdict, whole_hand

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt install chromium"),
]

Theme = Literal["light", "dark"]
COLOURS = {
    "light": {
        "stable": "rgb(26, 127, 55)",
        "slip": "rgb(207, 34, 46)",
        "leans": "rgb(255, 255, 255)",
    },
    "dark": {"stable": "rgb(31, 128, 64)", "slip": "rgb(208, 53, 60)", "leans": "rgb(23, 27, 34)"},
}
"""Colours of the banner by theme and tone, as in the page's style; `leans`: not filled."""


def is_of(colour: str) -> str:
    """Return a script: is the banner of this colour?"""
    return f"getComputedStyle({BANNER}).backgroundColor == '{colour}'"


@pytest.mark.parametrize(("width", "theme"), [(1280, "light"), (390, "dark")])
def test_the_page_shows_verdict_images_and_advice(
    page: Page, talker: Talker, browser: Browser, width: int, theme: Theme
) -> None:
    browser.look(width, 844, theme)
    browser.go(page.address)
    see(browser, "waiting")
    first = text(browser, "clock")
    assert re.fullmatch(r"\d\d:\d\d:\d\d", first)
    for decision, share in ((Decision.STABLE, "25 %"), (Decision.SLIP, "75 %")):
        talker.decision = decision
        see(
            browser,
            decision.value,
            reads("verdict", decision.value.upper()),
            says("p", share),
            is_of(COLOURS[theme][decision.value]),
        )
    talker.more = {"risk": None, "outcomes": 0}
    talker.decision = Decision.STABLE
    see(browser, "leans", reads("verdict", "LEANS TO STABLE"), is_of(COLOURS[theme]["leans"]))
    talker.more = {}
    talker.decision = Decision.SLIP
    see(
        browser,
        "slip",
        "document.querySelectorAll('figure canvas').length == 2",
        reads("who", "graspd right"),
        says("joints", "FFJ3\n28.6°"),
        says("health", "ff_7 electrode-dead: "),
        says("timing", "latency\t250 us, 99 % below 500 us"),
        # Nothing is wider than the window, and the images are drawn: not all of one colour.
        "document.documentElement.scrollWidth <= innerWidth",
        "(c => new Set(c.getContext('2d').getImageData(0, 0, c.width, c.height).data).size)"
        "(document.querySelector('figure canvas')) > 8",
    )
    browser.wait_for(f"document.querySelector('.clock').innerText > '{first}'")


def test_unknown_motion_is_not_a_bar_of_zero(page: Page, talker: Talker, browser: Browser) -> None:
    def bars(*wanted: list[str]) -> str:
        """Return a script: are motion, share and text of the bars in turn as in `wanted`?"""
        shown = "[...document.querySelectorAll('.moves:not([hidden])')]"
        parts = (
            "bar.dataset.motion, bar.style.getPropertyValue('--share'), bar.nextSibling.innerText"
        )
        found = f"{shown}.map(bar => [{parts}])"
        return f"JSON.stringify({found}) == JSON.stringify({json.dumps(wanted)})"

    show(browser, page, talker, Decision.STABLE)
    see(browser, "stable", reads("still", "-"), bars())
    limits = {"motion_limits": {"ff": 1.25, "th": 1.0}}
    talker.more = {"still_ms": 130.5, "motion": {"ff": 1.0, "th": None}, **limits}
    see(
        browser,
        "stable",
        reads("still", "130 ms, may slide"),
        bars(
            ["still", "40%", "motion 1.0 / 1.3 \u03c3"],  # by hand: half of 1 / 1.25
            ["unknown", "0%", "motion not known"],
        ),
    )
    talker.more |= {"still_ms": 0.0, "motion": {"ff": 9.0, "th": 0.4}}
    see(
        browser,
        "stable",
        reads("still", "0 ms"),
        bars(
            ["moving", "100%", "motion 9.0 / 1.3 \u03c3"],
            ["still", "20%", "motion 0.4 / 1.0 \u03c3"],
        ),
    )
    talker.decision = None
    see(browser, "silent", reads("still", "-"), bars())


def test_silence_of_daemon_or_server_is_unknown_with_dim_figures(
    page: Page, talker: Talker, browser: Browser
) -> None:
    show(browser, page, talker, Decision.STABLE)
    figure = "getComputedStyle(document.querySelector('.timing td'))"
    plain = f"{figure}.fontStyle == 'normal'"
    see(browser, "stable", says("timing", "250 us"), reads("old", ""), plain)
    talker.decision = None
    # For more than a second: a busy computer is silent for less.
    see(browser, "silent", r"/silent: no message for \d{4}/.test(document.body.innerText)")
    assert text(browser, "verdict") == "UNKNOWN"
    assert browser.value(f"{figure}.fontStyle") == "italic"
    assert browser.value(f"{figure}.color") == "rgb(91, 101, 112)"  # --faint
    assert "250 us" in text(browser, "timing")
    assert text(browser, "was") == ""
    assert text(browser, "judged") == "-"
    assert re.fullmatch(r"figures are of \d\d:\d\d:\d\d, the last message", text(browser, "old"))
    talker.decision = Decision.SLIP
    see(browser, "slip")
    page.stop()
    see(browser, "silent")
    why = text(browser, "why")
    assert why.startswith("no connection: graspd watch does not answer; no message from graspd ")
    page.start()
    see(browser, "slip")
    browser.complaints.clear()  # the browser says that there was no server


@pytest.mark.parametrize(
    ("names", "width", "title", "strip"),
    [
        (["right"], 1280, "stable - graspd", ""),
        (
            ["left", "right"],
            400,
            "left stable, right slip - graspd",
            "left\nSTABLE\nlift\nnot well: ff_7 electrode-dead "
            "right\nSLIP\ndo not lift\nnot well: ff_7 electrode-dead",
        ),
    ],
)
def test_a_whole_hand_fits_one_window_and_several_one_page(
    browser: Browser, names: list[str], width: int, title: str, strip: str
) -> None:
    views = [View(f"ipc:///tmp/{name}") for name in names]

    def seen(seq: int) -> list[Snapshot]:
        hands = zip(views, names, (Decision.STABLE, Decision.SLIP), strict=False)
        return [whole_hand(view, name, said, seq) for view, name, said in hands]

    with serving_hands(seen) as address:
        browser.look(width, 800)
        browser.go(address)
        browser.wait_for("document.querySelectorAll('.grasps tr').length >= 8")
        assert browser.value("document.documentElement.scrollWidth <= innerWidth")
        # While a busy computer stands still, the page says that it hears nothing.
        shown = "[...document.querySelectorAll('#strip a')].map(a => a.innerText).join(' ')"
        hidden = "document.getElementById('strip').hidden"
        expected = f"{shown} == {json.dumps(strip)}" if strip else hidden
        browser.wait_for(f"document.title == '{title}' && {expected}")
        assert browser.value(hidden) is not bool(strip)
        if len(names) == 1:
            assert browser.value("document.documentElement.scrollHeight <= innerHeight")


def note_tones(browser: Browser) -> None:
    """Have the page collect in `tones` each tone that it shows; a freeze empties the list."""
    browser.value(
        "tones = []; document.addEventListener('freeze', () => { tones = []; });"
        f" new MutationObserver(() => {{ const tone = {BANNER}.dataset.tone;"
        " if (tones.at(-1) !== tone) tones.push(tone); })"
        f".observe({BANNER}, {{attributes: true}})"
    )


def hide(browser: Browser, hidden: str) -> None:
    """Have the page believe that it is hidden. `hidden`: `true` or `false`, in JavaScript."""
    value = f"{{value: {hidden}, configurable: true}}"
    browser.value(f"Object.defineProperty(document, 'hidden', {value})")


def test_a_frozen_page_shows_unknown_and_nothing_that_waited(
    page: Page, talker: Talker, browser: Browser
) -> None:
    show(browser, page, talker, Decision.STABLE)
    hide(browser, "false")  # by what the page knows
    note_tones(browser)
    browser.ask("Page.setWebLifecycleState", state="frozen")
    talker.wait_for(50)  # stable verdicts wait
    talker.decision = Decision.SLIP
    talker.wait_for(50)
    browser.ask("Page.setWebLifecycleState", state="active")
    see(browser, "slip")
    assert browser.value("tones.slice(0, 2)") == ["silent", "slip"]


def test_after_a_sleep_the_page_shows_unknown_first(
    page: Page, talker: Talker, browser: Browser
) -> None:
    """The page's wall clock jumps by an hour, as in a sleep."""
    show(browser, page, talker, Decision.STABLE)
    note_tones(browser)
    browser.value("(real => { tones = []; Date.now = () => real() + 3600000; })(Date.now)")
    browser.wait_for("tones.length >= 2")
    assert browser.value("tones.slice(0, 2)") == ["silent", "stable"]


def test_a_page_in_the_background_shows_no_verdict(
    page: Page, talker: Talker, browser: Browser
) -> None:
    show(browser, page, talker, Decision.STABLE)
    for hidden, tone in (("true", "silent"), ("false", "stable")):
        hide(browser, hidden)
        browser.value("document.dispatchEvent(new Event('visibilitychange'))")
        word = "document.querySelector('.verdict').innerText.toLowerCase()"
        see(browser, tone, f"document.title == {word} + ' - graspd'")


def test_snapshots_that_arrive_late_are_shown_as_silence(browser: Browser) -> None:
    """Snapshots begin to arrive five seconds late, as through a tunnel that hung."""
    late_s = 0.0
    view = View("ipc:///tmp/any", wall=lambda: time.time() - late_s)

    def seen(seq: int) -> list[Snapshot]:
        view.take(b"verdict.right", verdict(seq, Decision.STABLE), 0)
        return [view.snapshot(0)]

    with serving_hands(seen) as address:
        browser.go(address)
        see(browser, "stable")
        note_tones(browser)
        late_s = 5.0
        browser.wait_for("tones.includes('silent')")


def test_a_chosen_grasp_shows_its_image_until_left(
    page: Page, talker: Talker, browser: Browser
) -> None:
    show(browser, page, talker, Decision.STABLE)
    browser.wait_for("document.querySelectorAll('figure canvas').length == 2")
    talker.decision = Decision.UNKNOWN
    see(browser, "waiting")
    deepest = "document.querySelector('figcaption :last-child').innerText"
    browser.wait_for(f"{deepest} == '0 counts'")  # of the open hand
    browser.value("document.querySelector('.grasps button').click()")
    past = "Grasp 7 as it was judged: stable, slip probability 25 %"
    assert text(browser, "images") == past
    assert browser.value(deepest) != "0 counts"
    talker.decision = None
    see(browser, "silent")
    assert text(browser, "images") == past
    browser.value("document.querySelector('.live').click()")
    assert text(browser, "images") == "Tactile images and motion"
    assert browser.value("document.querySelectorAll('figure').length") == 0


def test_the_timeline_is_read_by_pointing_and_can_be_paused(
    page: Page, talker: Talker, browser: Browser
) -> None:
    show(browser, page, talker, Decision.SLIP)
    browser.wait_for("/slip [2-9] s/.test(document.querySelector('.timeline').ariaLabel)")
    browser.value("document.querySelector('.pause').click()")
    assert re.fullmatch(r"Paused: five minutes until \d\d:\d\d:\d\d", text(browser, "minutes"))
    talker.decision = Decision.STABLE
    see(browser, "stable")  # the verdict continues
    box = browser.value(
        "(b => [b.right, b.top])(document.querySelector('.timeline').getBoundingClientRect())"
    )
    browser.ask("Input.dispatchMouseEvent", type="mouseMoved", x=box[0] - 6, y=box[1] + 20)
    at = r"/^\d\d:\d\d:\d\d: slip.*; highest slip probability 75 %$/"
    browser.wait_for(f"{at}.test(document.querySelector('.at').innerText)")
    assert "stable" not in browser.value("document.querySelector('.timeline').ariaLabel")
    browser.value("document.querySelector('.pause').click()")
    browser.wait_for("document.querySelector('.timeline').ariaLabel.includes('stable')")
