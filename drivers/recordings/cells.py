"""Cells of a table file, text or Parquet, whatever its dialect."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import BinaryIO, Final

from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.columns import has_electrodes
from graspd.drivers.recordings.kinds import (
    LINE_LENGTH_MAX,
    TABLES,
    Kind,
    kind_of_open,
    marked_encoding,
    reason,
)
from graspd.extras import needs

_SEPARATORS: Final = ",;\t|"
_SEPARATOR_LINE: Final = re.compile(r"sep=(.)", re.IGNORECASE)
"""First line by which a spreadsheet tells the separator."""


class Cells:
    """The header of a file, and its rows. Iterate once.

    Lines that are blank or begin with `#` are no rows, and empty cells after those of the header
    are left out. A header may stand in the last comment. The constructor and iterating raise
    `RecordingError`.
    """

    def __init__(self, path: Path, file: BinaryIO) -> None:
        """`file`: opened, at its start."""
        self._path = path
        self.line = 0
        """Number of the last line that was read, from 1; of Parquet, of the row."""
        self.has_end = True
        """False after a last line without a line end."""
        self.decimal_comma = False
        """True if numbers may have a comma for a point."""
        self._length = 0
        """Characters of the row that is read, so far."""
        kind = kind_of_open(path, file)
        if kind not in TABLES:
            raise RecordingError(path, f"is {kind.value}, not a table or stream")
        self._rows = self._parquet(file) if kind is Kind.PARQUET else self._text(file)
        self.names = [name.strip() for name in next(self._rows)]
        """The header."""
        self.header_line = self.line
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
        """Return an error of the line that was read last."""
        if not self.has_end:
            problem += "; the file ends here without a line end, so it may be cut off"
        return RecordingError(self._path, problem, line=self.line or None, column=column)

    def _text(self, file: BinaryIO) -> Iterator[list[str]]:
        lines = self._lines(file)
        comment, separator, first = "", None, ""
        for line in lines:
            text = line.strip()
            if text.startswith("#"):
                comment = text.lstrip("# ")
            elif self.line == 1 and (match := _SEPARATOR_LINE.fullmatch(text)):
                separator = match[1]
            elif text:
                first = line
                break
        if not first:
            raise RecordingError(self._path, "the file is empty")
        if comment and has_electrodes(_split(comment)) and not has_electrodes(_split(first)):
            lines = chain([first], lines)
            first = comment
        separator = separator or _separator(first)
        self.decimal_comma = separator != ","
        self._length = 0
        rows = csv.reader(
            chain([first], self._row_lines(lines, separator, first.count(separator))),
            delimiter=separator,
            skipinitialspace=True,
            strict=True,
        )
        try:
            for cells in rows:
                self._length = 0
                yield cells
        except csv.Error as error:
            raise self.error(f"this is not CSV: {error}") from error

    def _row_lines(self, lines: Iterator[str], separator: str, number: int) -> Iterator[str]:
        """Yield lines without comments; a row of several lines is as long as a line may be.

        `number`: separators of the header.
        """
        for line in lines:
            if self._length == 0 and line.startswith("#"):
                is_row = separator != " " and line.count(separator) >= number
                if is_row and not has_electrodes(_split(line.lstrip("# "))):
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
        encoding = marked_encoding(file.read(3)) or "utf-8"
        file.seek(0)
        # A byte that is not UTF-8 becomes a surrogate, so that its line is known.
        errors = "strict" if encoding == "utf-16" else "surrogateescape"
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
    """Return what separates the cells of a header."""
    most = max(_SEPARATORS, key=header.count)
    return most if most in header else " "


def _split(text: str) -> list[str]:
    return [cell.strip(' "') for cell in text.strip().split(_separator(text))]
