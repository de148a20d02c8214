"""The checker of words finds each refused phrase, with its line, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.words import check_file, check_subjects, checked_files, texts_of_test

SOURCE = '''\
"""Drop old sweeps.

Of two sweeps, keep the newer."""

LIMIT = 3
"""Limit, sweeps. Raised but
for palms."""

# One reading waits so
# long only if nobody asks.
def wait(name: str) -> None:
    """Wait, as far as needed. That `name` is late is no error."""
    raise ValueError(f"{name}: started anew")
'''


C_SOURCE = 'int anew;  // nobody\n/* `wanted`\n goes on */ say("is no\\"link");\n'
PAGE = "There is no file. It is no longer open.\nIt is no file.\n"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        (
            "module.py",
            SOURCE,
            [
                *((3, "Of ..."), (6, "but for"), (9, "so long"), (10, "nobody")),
                *((12, "That ..."), (12, "as far as"), (12, "is no"), (13, "anew")),
            ],
        ),
        ("client.hpp", C_SOURCE, [(1, "nobody"), (3, "goes on"), (3, "is no")]),
        ("page.md", PAGE, [(2, "is no")]),
    ],
)
def test_refused_phrases_are_found_with_their_lines(
    name: str, text: str, expected: list[tuple[int, str]], tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(text)
    assert [(each.line, each.phrase) for each in check_file(path)] == expected


def test_names_of_tests_are_checked_but_not_their_strings() -> None:
    source = 'def test_it_goes_on():\n    """Wait for nobody."""\n    print("so long as")\n'
    texts = [(each.line, each.text) for each in texts_of_test(source)]
    assert (1, "test it goes on") in texts
    assert "so long as" not in [text for _, text in texts]


def test_a_commit_subject_may_have_72_characters_at_most() -> None:
    log = f"1a2b3c4 {'x' * 72}\n2b3c4d5 {'y' * 73}\n"
    (complaint,) = check_subjects(log)
    assert complaint.startswith("commit 2b3c4d5: subject of 73 characters")


def test_source_and_pages_of_the_tree_are_checked() -> None:
    root = Path(__file__).parents[1]
    names = {str(path.relative_to(root)) for path in checked_files()}
    assert {"daemon/cli.py", "README.md", "deploy/bridge/BUILD.md", "models/RESULTS.md"} <= names
    kinds = ("tests/ports.py", "deploy/install.sh", ".ci/run", "tests/clients/probe.cpp")
    assert {*kinds, "deploy/clients/cpp/graspd_client.hpp", "deploy/bridge/src/bridge.c"} <= names
