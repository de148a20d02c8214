"""Compare with the references, or renew them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Final

from tests.process_replay import commands, messages, verdicts

KINDS: Final[Mapping[str, ModuleType]] = {
    "verdicts": verdicts,
    "messages": messages,
    "commands": commands,
}
"""Module of each kind of references, with `NAMES` and functions `path_of(name)`, `made(name)` and
`differences(before, now)`."""
SHOWN_MAX: Final = 5
"""Most differences of a reference that are printed; all are counted."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare with the references, or renew them; return 1 if one differs and is not renewed."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.process_replay",
        description="Compare with the references, or renew them.",
    )
    parser.add_argument("--renew", action="store_true", help="write the references")
    args = parser.parse_args(arguments)
    code = 0
    for kind in KINDS.values():
        for name in kind.NAMES:
            path, now = kind.path_of(name), kind.made(name)
            before = path.read_text() if path.is_file() else ""
            found = kind.differences(before, now)
            if args.renew and found:
                path.parent.mkdir(exist_ok=True)
                path.write_text("".join(renewed(kind, before, now)))
            sys.stdout.writelines(f"{path.name}: {line}\n" for line in found[:SHOWN_MAX])
            if found:
                sys.stdout.write(f"{path.name}: {len(found)} differences\n")
            code = code or int(bool(found) and not args.renew)
    return code


def renewed(kind: ModuleType, before: str, now: str) -> list[str]:
    """Return the lines of `now`, but those of `before` that differ only within the tolerance.

    If the numbers of lines differ, all lines of `now`.
    """
    was, lines = before.splitlines(keepends=True), now.splitlines(keepends=True)
    if len(was) != len(lines):
        return lines
    return [
        kept if not kind.differences(kept, line) else line
        for kept, line in zip(was, lines, strict=True)
    ]


if __name__ == "__main__":
    sys.exit(main())
