"""Cells of a table file: Parquet, or text with any separator and encoding."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from itertools import chain, zip_longest
from pathlib import Path
from typing import BinaryIO, Final

from graspd.biotac import FINGERS
from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.columns import has_electrodes, is_electrode, with_units
from graspd.drivers.recordings.kinds import (
    HEAD_BYTES,
    LINE_LENGTH_MAX,
    TABLES,
    Kind,
    encoding_of,
    kind_of_open,
    reason,
)
from graspd.extras import needs

_SEPARATORS: Final = ",;\t|"
_SEPARATOR_LINE: Final = re.compile(r"sep=(.)", re.IGNORECASE)
"""First line in which a spreadsheet program names the separator."""
TITLE_LINES_MAX: Final = 30
"""Most lines above the header, not counting comments and blank ones."""


class Cells:
    """The header of a file, and its rows. Iterate once.

    Lines that are blank or begin with `#` are not rows, and empty cells after those of the header
    are left out. Titles and comments may stand above the header, which may be the last comment
    itself; fingers may stand above their electrodes, and units below. The constructor and
    iterating raise `RecordingError`.
    """

    def __init__(self, path: Path, file: BinaryIO) -> None:
        """`file`: opened, at its start."""
        self._path = path
        self.line = 0
        """Number of the last line read, from 1. The rows of a Parquet file count from 2."""
        self.has_end = True
        """False after a last line without a line end."""
        self.decimal_comma = False
        """True if numbers may have a decimal comma."""
        kind = kind_of_open(path, file)
        if kind not in TABLES:
            raise RecordingError(path, f"is {kind.value}, not a table or stream")
        self.header_line = 1
        self._rows = self._parquet(file) if kind is Kind.PARQUET else self._text(file)
        self.names = [" ".join(name.split()) for name in next(self._rows)]
        """The header, with a space for each line break within a name."""
        while self.names and not self.names[-1]:
            self.names.pop()

    def __iter__(self) -> Iterator[list[str]]:
        width = len(self.names)
        for cells in self._rows:
            if len(cells) != width:
                if not "".join(cells).strip():
                    continue
                if any(cells[width:]) or len(cells) < width:
                    problem = f"the row has {len(cells)} cells, the header {width}"
                    raise self.error(problem)
                del cells[width:]
            if cells[0] or any(cells):
                yield cells

    def error(self, problem: str, column: str | None = None) -> RecordingError:
        """Return an error that names the line that was read last."""
        if not self.has_end:
            problem += "; the file ends here without a line end, so it may be cut off"
        return RecordingError(self._path, problem, line=self.line or None, column=column)

    def _text(self, file: BinaryIO) -> Iterator[list[str]]:
        lines = self._lines(file)
        separator, header, below = self._header(lines)
        self.decimal_comma = separator != ","
        self._length = 0
        """Number of characters read so far of the current row."""
        rows = csv.reader(
            chain(header, self._row_lines(below, separator, header[-1].count(separator))),
            delimiter=separator,
            skipinitialspace=True,
            strict=True,
        )
        try:
            names = next(rows)
            if len(header) > 1:
                names = _merged(names, next(rows))
            first = next(rows, [])
            units = with_units(names, first)
            self._length = 0
            yield units or names
            if units is None:
                yield first
            for cells in rows:
                self._length = 0
                yield cells
        except csv.Error as error:
            raise self.error(f"this is not CSV: {error}") from error

    def _header(self, lines: Iterator[str]) -> tuple[str, list[str], Iterator[str]]:
        """Return the separator, the one or two lines of the header, and the lines below. If no
        line at the begin names electrodes, the header is the first line."""
        separator, comment, commented, above = "", "", 0, ""
        titles, header, below = list[tuple[int, str]](), list[str](), list[str]()
        while not header and len(titles) <= TITLE_LINES_MAX and (line := next(lines, "")):
            line, lines = self._with_breaks(line, lines)
            text = line.strip()
            if self.line == 1 and (match := _SEPARATOR_LINE.fullmatch(text)):
                separator = match[1]
            elif text.startswith("#"):
                comment, commented = text.lstrip("# "), self.line
            elif text:
                tops, names = _split(above, separator), _split(text, separator)
                if _name_fingers(tops) and has_electrodes(_merged(tops, names)):
                    header = [above, line]
                elif has_electrodes(names):
                    header = [line]
                elif has_electrodes(_split(comment, separator)):
                    header, below = [comment], [line]
                titles.append((self.line, line))
                above = line
        if not titles:
            raise RecordingError(self._path, "the file is empty")
        self.header_line = commented if below else self.line
        if not header:
            self.header_line, first = titles[0]
            header = [first]
        return separator or _separator(header[-1]), header, chain(below, lines)

    def _with_breaks(self, line: str, lines: Iterator[str]) -> tuple[str, Iterator[str]]:
        """Return a header with those of `lines` in which its quoted names continue, and the rest.

        Any other line, such as a title with a single quotation mark, comes back as it is.
        """
        text, start, held = line, (self.line, self.has_end), list[tuple[int, bool, str]]()
        while text.count('"') % 2 and len(text) <= LINE_LENGTH_MAX and (more := next(lines, "")):
            held.append((self.line, self.has_end, more))
            text += more
        if not held or (text.count('"') % 2 == 0 and _is_header(text)):
            return text, lines
        self.line, self.has_end = start
        return line, chain(self._again(held), lines)

    def _again(self, held: Sequence[tuple[int, bool, str]]) -> Iterator[str]:
        """Yield the lines of `held`, which were read before; set `line` and `has_end` to theirs."""
        for number, has_end, line in held:
            self.line, self.has_end = number, has_end
            yield line

    def _row_lines(self, lines: Iterator[str], separator: str, number: int) -> Iterator[str]:
        """Yield rows as lines, without comments. A row of several lines has the length limit of a
        line. `number`: number of separators in the header."""
        for line in lines:
            if self._length == 0 and line.startswith("#"):
                is_row = separator != " " and line.count(separator) >= number
                if is_row and not has_electrodes(_split(line.lstrip("# "), separator)):
                    raise self.error(
                        "the line begins with #, as a comment does, and has the cells of a row: "
                        "put its first cell into quotes, or delete it"
                    )
                continue
            self._length += len(line)
            if self._length > LINE_LENGTH_MAX:
                raise self.error(f"the row is longer than {LINE_LENGTH_MAX} characters")
            yield line

    def _lines(self, file: BinaryIO) -> Iterator[str]:
        """Yield the lines of text with their ends: line feed, carriage return or both."""
        encoding = encoding_of(file.read(HEAD_BYTES)) or "utf-8"
        file.seek(0)
        # A byte that is not UTF-8 becomes a surrogate, so that an error can name its line.
        errors = "surrogateescape" if encoding.startswith("utf-8") else "strict"
        text = io.TextIOWrapper(file, encoding, errors, newline="")
        try:
            while line := text.readline(LINE_LENGTH_MAX + 1):
                self.line += 1
                if len(line) > LINE_LENGTH_MAX:
                    raise self.error(f"the line is longer than {LINE_LENGTH_MAX} characters")
                self.has_end = line.endswith(("\n", "\r"))
                if not line.isascii():
                    line.encode()
                yield line
        except UnicodeError as error:
            problem = f"not {encoding.upper()}: this is a binary file or has another encoding"
            raise self.error(problem) from error
        except OSError as error:
            raise self.error(reason(error)) from error
        finally:
            if not file.closed:
                text.detach()

    def _parquet(self, file: BinaryIO) -> Iterator[list[str]]:
        try:
            from pyarrow import ArrowException, parquet
        except ModuleNotFoundError as error:
            raise RecordingError(self._path, needs("Parquet", "pandas", error)) from error
        try:
            table = parquet.ParquetFile(file)
            self.line = 1
            yield list(table.schema_arrow.names)
            for batch in table.iter_batches(batch_size=256):
                for values in zip(*(column.to_pylist() for column in batch.columns), strict=True):
                    self.line += 1
                    yield ["" if value is None else str(value) for value in values]
        except (ArrowException, OSError, ValueError, OverflowError) as error:
            problem = "is damaged: " + str(error).partition("\n")[0]
            raise RecordingError(self._path, problem) from error


def _separator(header: str) -> str:
    """Return the most frequent of `_SEPARATORS` in a header; a space if it has none."""
    most = max(_SEPARATORS, key=header.count)
    return most if most in header else " "


def _split(text: str, separator: str) -> list[str]:
    """Return the cells of a header; `separator`: empty if it is not known."""
    cells = text.strip().split(separator or _separator(text))
    return [" ".join(cell.strip(' "').split()) for cell in cells]


def _is_header(text: str) -> bool:
    """Return True if `text`, which has line breaks, is one row that names electrodes."""
    lines = io.StringIO(text, newline="")
    names, *others = csv.reader(lines, delimiter=_separator(text), skipinitialspace=True)
    return not others and has_electrodes([" ".join(name.split()) for name in names])


def _name_fingers(cells: Sequence[str]) -> bool:
    return not {cell.lower() for cell in cells}.isdisjoint(FINGERS)


def _merged(above: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return names, electrodes prefixed by the finger in `above`, which applies until the next."""
    merged, finger = list[str](), ""
    for top, name in zip_longest(above, names, fillvalue=""):
        finger = top.strip() or finger
        both = f"{finger}_{name.strip()}"
        merged.append(both if is_electrode(both) else name or top)
    return merged
