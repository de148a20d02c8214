"""Text for people: made harmless for a terminal, coloured, in tables."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Collection, Iterable, Iterator, Sequence
from enum import IntEnum
from typing import TextIO

from graspd.daemon.process.logs import JOURNAL_ERROR, is_journal

PROGRESS_MAX = 78
"""Characters: a wrapped line could not be taken back."""


class Colour(IntEnum):
    """Numbers of ECMA-48, SGR."""

    BOLD = 1
    RED = 31
    GREEN = 32
    YELLOW = 33


def coloured(text: str, colour: Colour, stream: TextIO | None = None) -> str:
    """Return coloured text where the stream shows it (https://no-color.org)."""
    stream = sys.stdout if stream is None else stream
    if not stream.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return f"\x1b[{colour.value}m{text}\x1b[0m"


def did_you_mean(wrong: str, known: Iterable[str]) -> str:
    """Return advice on a mistyped word, if a known one is near."""
    import difflib  # only where it is needed

    near = difflib.get_close_matches(wrong, list(known), n=1)
    return f"; did you mean {near[0]}?" if near else ""


def printable(text: str, length_max: int | None = None) -> str:
    """Return the text with control characters escaped, cut at `length_max`."""
    if length_max is not None and len(text) > length_max:
        text = text[: length_max - 3] + "..."
    if text.isprintable():
        return text
    return "".join(
        character
        if character.isprintable()
        else character.encode("unicode_escape", "surrogatepass").decode("ascii")
        for character in text
    )


def complain(problem: object) -> None:
    """Say on stderr what is wrong."""
    lines = [printable(line) for line in str(problem).split("\n")]
    if is_journal(os.environ):
        sys.stderr.writelines(f"{JOURNAL_ERROR}{line}\n" for line in lines)
    else:
        sys.stderr.write("graspd: " + "\n".join(lines) + "\n")


def write_json(content: object) -> None:
    """Write one JSON object to stdout, as a line."""
    sys.stdout.write(json.dumps(content) + "\n")


def write_lines(*lines: str) -> None:
    """Write lines to stdout. The caller makes untrusted text in them `printable`."""
    sys.stdout.writelines(f"{line}\n" for line in lines)


def progress(doing: str) -> None:
    """Show on a terminal what is being done, in place of what was shown; "": nothing."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K{printable(doing, PROGRESS_MAX)}")
        sys.stderr.flush()


def markdown_table(
    titles: Sequence[str], rows: Iterable[Sequence[str]], right: Collection[str] = ()
) -> Iterator[str]:
    """Yield the lines of a Markdown table; columns in `right` are aligned to the right."""
    yield f"| {' | '.join(titles)} |"
    yield f"| {' | '.join('---:' if title in right else '---' for title in titles)} |"
    for row in rows:
        cells = (cell.replace("|", "\\|") for cell in row)
        yield f"| {' | '.join(cells)} |"
