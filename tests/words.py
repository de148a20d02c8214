"""Refuse phrases that readers stumble over, and commit subjects that are too long.

Usage: `python -m tests.words [FILE ...]`, in CI without files. It reads the docstrings, comments
and messages of the source, the docstrings, comments and names of the tests, the comments and
strings of C and C++, shell scripts and the pages. The rules stand in .github/CONTRIBUTING.md.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
FOLDERS = ("daemon", "drivers", "models", "deploy", "tests")
"""Folders of source."""
SUFFIXES = {".py", ".c", ".h", ".cpp", ".hpp", ".sh"}
"""Suffixes of source files."""
OTHERS = ("README.md", "deploy/**/*.md", "models/*.md", ".ci/run", ".ci/quick")
"""Patterns of pages, and scripts without a suffix."""
EXEMPT = {ROOT / "tests/words.py", ROOT / "tests/test_words.py"}
"""Files that have the refused phrases on purpose."""
SUBJECT_MAX = 72
"""Longest subject of a commit, characters. `git log` cuts longer ones off on 80 columns."""
SUBJECTS_SINCE = "2026-11-27T03:46:00+00:00"
"""Commits before this time are not checked. A time needs no commit that a shallow clone lacks."""
INSTEAD = {
    "so many": "the number, or the parameter's name",
    "so much": "the amount, or the parameter's name",
    "so long": "the time, or the parameter's name: up to `timeout_s`",
    "so often": "the number of times",
    "as far as": "if, where, or the bound itself",
    "but for": "except",
    "anew": "again, or re-: reconnect, restart",
    "none of": "no, not, or without",
    "that there is": "that exists",
    "nobody": "the thing that lacks: no subscriber, no peer",
    "somebody": "the thing: a subscriber, a peer, a person",
    "whoever": "the thing: a subscriber that, a person who",
    "goes on": "continues",
    "go on": "continue",
    "went on": "continued",
    "can be had": "is available",
    "are others": "differ",
    "taken for": "read as, counted as, mistaken for",
    "heed": "use, obey",
    "heeds": "uses, obeys",
    "wanted": "required, or the thing: the scene, the setting",
    "heard": "received",
    "felt": "detected, measured",
    "is out": "has ended, is missing, has no answer yet",
    "are out": "have ended, are missing, have no answer yet",
    "is no": "is not a, is not an",
    "are no": "are not",
}
"""Refused phrases, and what to write instead."""
SUBJECT_FIRST = "say the subject first: functions begin with a verb, values with a noun"

_PHRASE = re.compile(
    r"(?<!\bthere )\b(" + "|".join(each.replace(" ", r"\s+") for each in INSTEAD) + r")\b"
    r"(?!\s+(?:longer|of)\b|-)",
    re.IGNORECASE,
)
_CODE = re.compile(r"`[^`]*`")
_C_TEXT = re.compile(r'//[^\n]*|/\*.*?\*/|"(?:\\.|[^"\\\n])*"', re.DOTALL)
_TEST_NAME = re.compile(r"^ *(?:async )?def (test_\w+)", re.MULTILINE)
_WEAK_START = re.compile(
    r"(?:\A\s*|[.!?][\"')`]*\s+|\n\s*\n\s*)(Of|What|Who|Whoever|That|So|Where)\s"
)


class Text(NamedTuple):
    """A piece of prose and the line on which it begins."""

    line: int
    text: str
    is_docstring: bool = False


class Complaint(NamedTuple):
    """A refused phrase, where it stands, and what to write instead."""

    place: str
    line: int
    phrase: str
    instead: str

    def __str__(self) -> str:
        return f"{self.place}:{self.line}: {self.phrase!r}: {self.instead}"


def docstrings(tree: ast.Module) -> Iterator[ast.Constant]:
    """Yield the docstrings of modules, classes, functions and attributes."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for statement in node.body:
            match statement:
                case ast.Expr(value=ast.Constant(value=str()) as constant):
                    yield constant


def messages(tree: ast.Module, docs: Iterable[ast.Constant]) -> Iterator[Text]:
    """Yield the strings of several words other than `docs`; f-strings as a whole."""
    done = {id(constant) for constant in docs}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [part for part in node.values if isinstance(part, ast.Constant)]
            done.update(id(part) for part in parts)
            text = "{}".join(str(part.value) for part in parts)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if id(node) in done:
                continue
            text = node.value
        else:
            continue
        if " " in text:
            yield Text(node.lineno, text)


def comments(source: str) -> Iterator[Text]:
    """Yield the comments; those on consecutive lines as one text."""
    first, lines = 0, list[str]()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT:
            continue
        if token.start[0] != first + len(lines):
            yield Text(first, "\n".join(lines))
            first, lines = token.start[0], []
        lines.append(token.string.lstrip("#: "))
    yield Text(first, "\n".join(lines))


def texts_of_python(source: str) -> Iterator[Text]:
    """Yield the docstrings, messages and comments of a module."""
    tree = ast.parse(source)
    docs = list(docstrings(tree))
    for constant in docs:
        yield Text(constant.lineno, str(constant.value), is_docstring=True)
    yield from messages(tree, docs)
    yield from comments(source)


def complaints(place: str, texts: Iterable[Text]) -> Iterator[Complaint]:
    """Yield what is refused in `texts`, which stand in the file `place`."""
    for line, text, is_docstring in texts:
        for match in _PHRASE.finditer(_CODE.sub(_blanked, text)):
            phrase = " ".join(match[1].lower().split())
            at = line + text.count("\n", 0, match.start(1))
            yield Complaint(place, at, phrase, INSTEAD[phrase])
        for match in _WEAK_START.finditer(text) if is_docstring else ():
            at = line + text.count("\n", 0, match.start(1))
            yield Complaint(place, at, f"{match[1]} ...", SUBJECT_FIRST)


def _blanked(code: re.Match[str]) -> str:
    """Return spaces in place of the match, which is code and may have any name."""
    return re.sub(r"[^\n]", " ", code[0])


def texts_of_test(source: str) -> Iterator[Text]:
    """Yield the docstrings, comments and names of a module of tests."""
    for constant in docstrings(ast.parse(source)):
        yield Text(constant.lineno, str(constant.value))
    yield from comments(source)
    for match in _TEST_NAME.finditer(source):
        yield Text(source.count("\n", 0, match.start(1)) + 1, match[1].replace("_", " "))


def texts_of_c(source: str) -> Iterator[Text]:
    """Yield the comments and strings of a file in C or C++."""
    for match in _C_TEXT.finditer(source):
        yield Text(source.count("\n", 0, match.start()) + 1, match[0])


def texts_of(path: Path) -> Iterable[Text]:
    """Return the pieces of prose of a file: of source, of tests, or of a page as a whole."""
    source = path.read_text()
    if path.suffix == ".py":
        is_test = path.is_relative_to(ROOT / "tests")
        return texts_of_test(source) if is_test else texts_of_python(source)
    if path.suffix in {".c", ".h", ".cpp", ".hpp"}:
        return texts_of_c(source)
    return [Text(1, source)]


def check_file(path: Path) -> list[Complaint]:
    """Return the complaints about a file of source, a test, a script or a page."""
    place = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
    return sorted(complaints(str(place), texts_of(path)))


def check_subjects(log: str) -> list[str]:
    """Return a complaint for each too long subject of `log`: one commit a line, id and subject."""
    commits = (line.partition(" ") for line in log.splitlines())
    return [
        f"commit {commit}: subject of {len(subject)} characters, at most {SUBJECT_MAX}: {subject}"
        for commit, _, subject in commits
        if len(subject) > SUBJECT_MAX
    ]


def recent_commits() -> str:
    """Return the recent commits for `check_subjects`; empty where the tree is no clone."""
    if not (ROOT / ".git").exists():
        return ""
    command = ["git", "log", f"--since={SUBJECTS_SINCE}", "--format=%h %s"]
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout


def checked_files() -> list[Path]:
    """Return the source files, tests, scripts and pages that CI checks."""
    every = (path for folder in FOLDERS for path in (ROOT / folder).rglob("*"))
    source = (path for path in every if path.suffix in SUFFIXES and path.is_file())
    others = (path for pattern in OTHERS for path in ROOT.glob(pattern))
    return sorted({*source, *others} - EXEMPT)


def main(names: list[str]) -> int:
    """Print the complaints about the named files, else about the tree; return the exit code."""
    files = [Path(name).resolve() for name in names] or checked_files()
    lines = [str(complaint) for path in files for complaint in check_file(path)]
    if not names:
        lines += check_subjects(recent_commits())
    for line in lines:
        print(line)  # noqa: T201
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
