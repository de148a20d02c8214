"""Make the manual page of the parsers of the command line.

`python -m tests.daemon.commands.shell_files` writes it to `deploy/shell`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from argparse_manpage.manpage import Manpage

from graspd.daemon.cli import whole_parser
from graspd.daemon.commands.arguments import Parser

PAGE: Final = Path(__file__).parents[3] / "deploy" / "shell" / "graspd.1"
SECTIONS: Final = {
    "exit status": """.TP
.B 0
Done.
.TP
.B 1
Something failed while running, or doctor has found something.
.TP
.B 2
The command line, a scene, a recording or a model is wrong.
.TP
.B 130, 143
Stopped by SIGINT or SIGTERM before the work was done.
""",
    "environment": """.TP
.B NO_COLOR
If it is not empty, nothing is coloured on a terminal.
.TP
.B TERM
If it is dumb, neither.
""",
    "files": """.TP
.B /etc/graspd/*.toml
Scenes of the service graspd@.service, one per hand.
.TP
.B /run/graspd
Sockets of the service.
.TP
.B /var/lib/graspd
What each hand has learned, and recordings.
""",
}


def parsers(parser: Parser) -> Iterator[Parser]:
    """Yield the parser and those of all its commands."""
    yield parser
    for command in parser.subparsers.values():
        yield from parsers(command)


def manual() -> str:
    """Return the manual page. It has no date and no version: it is kept in a file."""
    page = Manpage(whole_parser())
    page.date, page.manual = "", "User Commands"
    page.description = "says before a Shadow Dexterous Hand lifts whether the grasp will hold"
    for heading, text in SECTIONS.items():
        page.add_section(heading, "=", text)
    return str(page)


if __name__ == "__main__":
    os.environ["COLUMNS"] = "80"
    PAGE.write_text(manual())
