"""The page of attacks has all of them."""

from __future__ import annotations

import re

from tests.bench.attacks.__main__ import ATTACKS
from tests.conftest import ROOT


def test_the_page_has_a_row_for_every_attack() -> None:
    page = (ROOT / "deploy" / "ATTACKS.md").read_text()
    assert re.findall(r"^\| `([a-z0-9-]+)` \|", page, re.M) == list(ATTACKS)
