"""The maker of mutants: what it changes, what it lets be, and that a blind test is found out."""

from __future__ import annotations

import argparse
import marshal
from pathlib import Path

import pytest

from tests.bench import mutants as bench
from tests.kit.mutants import Mutant, mutants

SOURCE = '''"""In 2 sentences."""
LONG_NS = 2_000_000_000

def far(x: Literal[3], limit: float = 2.5) -> bool:
    _log.info("%d", x + 1)
    if not x < limit and x is not None:
        raise ValueError(f"{x / 1e6} is bad")
    return -x & 7 == 250.0
'''
CHANGES = [
    "2: 2000000000 becomes 2400000000",
    "2: 2000000000 becomes 1600000000",
    "4: 2.5 becomes 3.5",
    "4: 2.5 becomes 2.0",
    "6: and and or change places",
    "6: Not is dropped",
    "6: Lt becomes LtE",
    "6: Lt becomes Gt",
    "6: IsNot becomes Is",
    "8: Eq becomes NotEq",
    "8: BitAnd becomes BitOr",
    "8: USub is dropped",
    "8: 7 becomes 8",
    "8: 7 becomes 6",
    "8: 250.0 becomes 300.0",
    "8: 250.0 becomes 200.0",
]
LIMIT = """LIMIT = 5

def is_fast(speed):
    return speed > LIMIT

def first_beyond(n):
    while n <= 5:
        n += 1
    return n
"""
TESTS = """
import pytest
from speeds.limit import first_beyond, is_fast

@pytest.mark.parametrize("speed", [4, 6])
def test_from_six_on_it_is_fast(speed):
    assert is_fast(speed) == (speed in (6, 7))

def test_the_first_is_found():
    assert first_beyond(1) == 6
"""


def test_what_runs_is_changed_and_no_text_alone() -> None:
    found = [each for each in mutants(SOURCE) if each.kind in bench.KINDS]
    assert sorted(f"{each.line}: {each.what}" for each in found) == sorted(CHANGES)
    assert len({marshal.dumps(each.code()) for each in found}) == len(CHANGES)


@pytest.mark.slow
def test_what_no_test_tells_apart_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "SLACK_S", 3.0)  # two of the mutants never end
    picked, survivors = run(tmp_path, LIMIT, TESTS)
    assert len(picked) == 11
    assert [str(each) for each in survivors] == [
        "speeds/limit.py:1: 5 becomes 4 in `LIMIT = 5`",
        "speeds/limit.py:4: Gt becomes GtE in `return speed > LIMIT`",
    ]
    assert "LIMIT = 5" in (tmp_path / "speeds/limit.py").read_text()


def run(tree: Path, module: str, tests: str) -> tuple[list[Mutant], list[Mutant]]:
    """All mutants of `module`, and those that `tests` do not notice."""
    for file, content in {
        "speeds/limit.py": module,
        "speeds/__init__.py": "",
        "tests/speeds/test_limit.py": tests,
        "pyproject.toml": "[tool.pytest.ini_options]\naddopts = '--import-mode=importlib'\n",
    }.items():
        path = tree / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    options = argparse.Namespace(
        package="speeds", only=["limit.py"], number=99, seed=1, tests=["tests/speeds"], timeout=9.0
    )
    return bench.run(tree, options)
