"""A folder for sessions."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from graspd.daemon.session.folder import SessionFolder


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[SessionFolder]:
    with SessionFolder(tmp_path / "right") as folder:
        yield folder
