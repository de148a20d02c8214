"""Values in cells: counts, numbers, times and outcomes, and what other values look like."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Final

from graspd.biotac import COUNT_MAX

SHOWN_LENGTH_MAX: Final = 40
"""Most characters of a cell in an error message."""
VOLTS_MAX: Final = 5.5
"""Largest value that looks like a voltage, V."""

# ASCII digits only: float() also takes `1_000`, `nan` and digits of other scripts.
_NUMBER: Final = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?")
_THOUSANDS: Final = re.compile(r"[+-]?[0-9]{1,3}([ ,'\u2019\u00a0\u202f][0-9]{3})+")
_POINTED: Final = re.compile(r"[1-9][0-9]{0,2}\.[0-9]{3}")
_HEXADECIMAL: Final = re.compile(r"(0x)?[0-9a-f]{1,4}", re.IGNORECASE)
_CLOCK: Final = re.compile(
    r"((?P<days>[0-9]+) days?,? )?(?P<hours>[0-9]{1,3}):(?P<minutes>[0-5][0-9])"
    r":(?P<seconds>[0-5][0-9]([.,][0-9]+)?)"
)
COUNT_OF_TEXT: Final = {str(count): count for count in range(COUNT_MAX + 1)}
"""Counts by their usual text: a look-up is ten times as fast as parsing."""
_OUTCOMES: Final = {
    **dict.fromkeys(("0", "0.0", "0,0", "false", "stable"), False),
    **dict.fromkeys(("1", "1.0", "1,0", "true", "slip"), True),
    **dict.fromkeys(("", "nan", "none", "null", "na", "n/a", "<na>"), None),
}
BLANK: Final = frozenset(text for text, slipped in _OUTCOMES.items() if slipped is None)
"""Texts of a missing value, in small letters."""


def number_of(cell: str, *, decimal_comma: bool = False) -> float | None:
    """Return the finite number in a cell; None if it holds none."""
    cell = cell.strip()
    if decimal_comma:
        cell = cell.replace(",", ".")
    if _NUMBER.fullmatch(cell) is None:
        return None
    number = float(cell)
    return number if math.isfinite(number) else None


def count_of(cell: str, *, decimal_comma: bool = False) -> int | None:
    """Return the 12-bit count in a cell; None if it holds no count.

    `2,795` is not a count: it may be a mean of 2.8 or 2795.
    """
    count = COUNT_OF_TEXT.get(cell)
    if count is not None:
        return count
    if _THOUSANDS.fullmatch(cell.strip()):
        return None
    number = number_of(cell, decimal_comma=decimal_comma)
    if number is None or not number.is_integer() or not 0 <= number <= COUNT_MAX:
        return None
    return int(number)


def has_thousands(cell: str) -> bool:
    """Return True for a number whose comma may separate thousands, as that of `1,250`."""
    return "," in cell and _THOUSANDS.fullmatch(cell.strip()) is not None


def time_of(cell: str, *, decimal_comma: bool = False) -> float | None:
    """Return a time: a number in any unit, or seconds of a date, clock or span; None: neither."""
    number = number_of(cell, decimal_comma=decimal_comma)
    return _clock_s(cell.strip()) if number is None else number


def is_clock(cell: str) -> bool:
    """Return True for a date, a time of day or a span, which `time_of` returns in seconds."""
    return _clock_s(cell.strip()) is not None and number_of(cell) is None


def _clock_s(text: str) -> float | None:
    """Return the seconds of a date (since 1970), a time of day or a span. No zone: UTC."""
    if not text.isascii():
        return None
    if clock := _CLOCK.fullmatch(text):
        minutes = 60 * (24 * int(clock["days"] or 0) + int(clock["hours"])) + int(clock["minutes"])
        return 60 * minutes + float(clock["seconds"].replace(",", "."))
    try:
        day = datetime.fromisoformat(text.removesuffix(" UTC").removesuffix(" GMT"))
    except ValueError:
        return None
    return (day if day.tzinfo else day.replace(tzinfo=UTC)).timestamp()


def outcome_of(cell: str) -> bool | None:
    """Return how a lift ended: True slip, False stable, None blank. Raises `ValueError` else."""
    text = cell.strip().lower()
    if text not in _OUTCOMES:
        problem = "is not an outcome: 0, False or stable; 1, True or slip; blank if it is not known"
        raise ValueError(f"{shown(cell)} {problem}")
    return _OUTCOMES[text]


def is_outcome(cell: str) -> bool:
    """Return True if a cell has a known outcome."""
    return _OUTCOMES.get(cell.strip().lower()) is not None


def problem_with(cells: Sequence[str], *, decimal_comma: bool) -> str | None:
    """Return why values of electrodes are not counts; None: they are.

    Up to half of those not blank may be wrong, as of broken electrodes. Up to a twentieth of them
    may have a point or comma, or be negative other than -1, which stands for a missing value.
    """
    given = [cell for cell in cells if cell.strip().lower() not in BLANK]
    wrong = [cell for cell in given if count_of(cell, decimal_comma=decimal_comma) is None]
    scaled = [cell for cell in wrong if "." in cell or "," in cell or _is_negative(cell)]
    if 2 * len(wrong) <= len(given) and 20 * len(scaled) <= len(given):
        return None
    return (
        f"{len(wrong)} of {len(given)} values are not counts, whole numbers in 0..{COUNT_MAX}, the "
        f"first is {shown(wrong[0])}: {_looks_like(wrong, decimal_comma=decimal_comma)}"
    )


def _is_negative(cell: str) -> bool:
    return cell.strip().startswith("-") and number_of(cell) not in (None, -1.0)


def are_numbers(cells: Sequence[str]) -> bool:
    """Return True if most cells are numbers, which a header's never are."""
    return 2 * sum(number_of(cell) is not None for cell in cells) > len(cells)


def are_texts(cells: Sequence[str]) -> bool:
    """Return True if no cell is a number or blank, as in a header or a row of units."""
    return all(number_of(cell) is None and cell.strip().lower() not in BLANK for cell in cells)


def _looks_like(wrong: Sequence[str], *, decimal_comma: bool) -> str:
    if any(_THOUSANDS.fullmatch(cell.strip()) for cell in wrong):
        return "write them without a separator of thousands"
    if all(_POINTED.fullmatch(cell.strip()) for cell in wrong):
        return "thousands with a point, or volts? write 2820 for 2.820; volts are not counts"
    if all(_HEXADECIMAL.fullmatch(cell.strip()) for cell in wrong):
        return "hexadecimal? write decimal numbers"
    numbers = [number_of(cell, decimal_comma=decimal_comma) for cell in wrong]
    values = [abs(number) for number in numbers if number is not None]
    if 2 * len(values) < len(wrong):
        return "text in place of numbers?"
    if any(number is not None and number < 0 for number in numbers):
        return "differences? graspd takes the counts of the sensor as they are"
    if max(values) <= 1.0:
        return f"normalised? multiply by {COUNT_MAX} and round"
    if max(values) <= VOLTS_MAX:
        return "volts? graspd takes the counts of the sensor"
    if max(values) > COUNT_MAX:
        return "another sensor, or another scale?"
    if max(values) <= 100.0:
        return "percent, or another scale?"
    return "means of several readings? graspd takes single readings"


def shown(cell: str) -> str:
    """Return the first `SHOWN_LENGTH_MAX` characters of a cell in quotes, for a message."""
    return repr(cell if len(cell) <= SHOWN_LENGTH_MAX else cell[:SHOWN_LENGTH_MAX] + "...")
