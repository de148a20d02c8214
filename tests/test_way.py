"""The way of a reading through the source is the one that the page on the architecture tells."""

from __future__ import annotations

import re

from tests.conftest import ROOT
from tests.way import files, median, walk


def told() -> list[str]:
    """The files that the page names, in its order."""
    page = (ROOT / "deploy" / "ARCHITECTURE.md").read_text()
    section = page.split("## The way of a reading")[1].split("\n## ")[0]
    return re.findall(r"^\| `([a-z0-9_/]+\.py)` \|", section, re.MULTILINE)


def test_the_page_names_each_file_that_a_judged_reading_enters_once_and_in_order() -> None:
    entered = files(median(walk().readings(judged=True)))
    assert list(dict.fromkeys(entered)) == told()
