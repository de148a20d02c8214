"""Write result files, which are complete or absent whenever the program ends, and their tables."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path to write to; the file then replaces `path`. Raises `OSError`.

    After an exception `path` is unchanged, and the folder has no other file.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, data: bytes) -> None:
    """Write these bytes as the file `path`. Raises `OSError`."""
    with replacing(path) as part:
        part.write_bytes(data)


def to_json(value: object) -> bytes:
    """Return indented JSON with a newline; `value` may have numbers of numpy."""
    encoded = msgspec.json.encode(value, enc_hook=lambda number: number.item())
    return msgspec.json.format(encoded, indent=2) + b"\n"


def markdown_table(
    titles: Sequence[str], rows: Iterable[Sequence[str]], right: Collection[str] = ()
) -> Iterator[str]:
    """Yield the lines of a Markdown table; columns named in `right` are right-aligned."""
    yield f"| {' | '.join(titles)} |"
    yield f"| {' | '.join('---:' if title in right else '---' for title in titles)} |"
    for row in rows:
        cells = (cell.replace("|", "\\|") for cell in row)
        yield f"| {' | '.join(cells)} |"
