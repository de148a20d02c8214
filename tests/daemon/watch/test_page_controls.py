"""What a person does with the page: hands beside each other, past grasps, a paused timeline."""

from __future__ import annotations

import re

import pytest

from graspd.daemon.judge.reasons import Decision
from tests.daemon.watch.browser import CHROMIUM, Browser, Page, see, show, text
from tests.daemon.watch.watch_fakes import Talker

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt install chromium")


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
