"""Text for people: escaped for terminals, coloured."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable
from enum import IntEnum

from graspd.daemon.process.logs import JOURNAL_ERROR, is_journal


class Colour(IntEnum):
    """Colours of a terminal (ECMA-48, SGR)."""

    BOLD = 1
    RED = 31
    GREEN = 32
    YELLOW = 33


def coloured(text: str, colour: Colour) -> str:
    """Return coloured text if stdout shows colours (https://no-color.org), else `text`."""
    if not sys.stdout.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return f"\x1b[{colour.value}m{text}\x1b[0m"


def did_you_mean(wrong: str, words: Iterable[str]) -> str:
    """Return "; did you mean ..." with the word nearest to `wrong`; "" if none is near."""
    import difflib  # imported here, as few runs need it

    near = difflib.get_close_matches(wrong, list(words), n=1)
    return f"; did you mean {near[0]}?" if near else ""


def printable(text: str, length_max: int | None = None) -> str:
    """Shorten the text to `length_max` characters (None: no limit), then escape what is not
    printable."""
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
    """Write the text of a problem to stderr, escaped; in the journal as an error."""
    lines = [printable(line) for line in str(problem).split("\n")]
    if is_journal(os.environ):
        sys.stderr.writelines(f"{JOURNAL_ERROR}{line}\n" for line in lines)
    else:
        sys.stderr.write("graspd: " + "\n".join(lines) + "\n")


def write_json(content: object) -> None:
    """Write one JSON object to stdout, as a line."""
    sys.stdout.write(json.dumps(content) + "\n")


def write_lines(*lines: str) -> None:
    """Write lines to stdout. Pass untrusted text through `printable` first."""
    sys.stdout.writelines(f"{line}\n" for line in lines)
