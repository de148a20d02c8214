"""Columns of tables and streams: the names by which electrodes, joints and times are known."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from graspd.biotac import ELECTRODES, FINGERS, FORMER_ELECTRODES, Finger
from graspd.drivers.base import JOINTS, RecordingError
from graspd.drivers.recordings.kinds import PAGE
from graspd.drivers.recordings.values import are_numbers, number_of, time_of

TIME: Final = "t"
"""Name of the column of times that graspd writes: seconds since any moment."""
OBJECT: Final = "object"
SLIPPED: Final = "slipped"

_BETWEEN: Final = r"[_ ./\[-]*"
_HAND: Final = rf"(?:.*[./])?(?:[rl]h_)?(?P<finger>ff|mf|rf|lf|th){_BETWEEN}"
_ELECTRODE: Final = rf"e(?:le(?:c(?:trode)?)?)?{_BETWEEN}"
_NUMBER: Final = r"(?P<number>\d+)[\]_]?"
SCHEMES: Final[Mapping[str, re.Pattern[str]]] = {
    example: re.compile(pattern, re.IGNORECASE)
    for example, pattern in {
        "ff_biotac_1": rf"{_HAND}biotac{_BETWEEN}e?{_NUMBER}",
        "ff_e1": rf"{_HAND}{_ELECTRODE}{_NUMBER}",
        "ff_1": rf"{_HAND}{_NUMBER}",
        "field.tactiles0.electrodes0": (
            rf".*tactiles{_BETWEEN}(?P<place>[0-4])\]?{_BETWEEN}electrodes{_BETWEEN}{_NUMBER}"
        ),
        "field.bt_data0.electrode_data0": (
            rf".*(?P<sensor>bt_data{_BETWEEN}\d+)\]?{_BETWEEN}electrode_data{_BETWEEN}{_NUMBER}"
        ),
        "E1": rf"{_ELECTRODE}{_NUMBER}",
    }.items()
}
"""Patterns of electrodes' names, by an example of each; a file is read by the first that fits any
of its names. The fourth is of Shadow's message BiotacAll, for ff, mf, rf, lf, th. The fifth, of
BioTacHand, names no finger, and the last one is for a single finger."""

ONE_ROW: Final = "put all fingers into one row, as ff_e1 and mf_e1"
HEADER_ELECTRODES_MIN: Final = 12
"""Fewest names of electrodes in a line that make it the header: half of a finger's."""
_PLACES: Final[Mapping[str, int]] = {finger: place for place, finger in enumerate(FINGERS)}
_UNIT_S: Final = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "\u00b5s", "\u03bcs", "usec", "usecs", "micros", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds"), 1e-9),
}
_PARTS_S: Final = frozenset((1.0, 1e-9))
"""Units of the two columns of a time in whole seconds and nanoseconds, s."""
_UNITS: Final = "|".join(sorted(_UNIT_S, key=len, reverse=True))
_CLOCKS: Final = (
    "abs|absolute|elapsed|epoch|gps|host|local|log|msg|pc|publish|receive|received|record|recorded"
    "|recv|rel|relative|ros|rosbag|sample|sensor|sim|sys|system|unix|utc|wall"
)
_TIMES: Final = (
    "t|times?|time[_ ]?stamp|stamp|date[_ ]?time|epoch|elapsed|clock|(?:receiv|record)ed_at"
    "|zeit|zeitstempel|tiempo|temps"
)
_TIME_NAME: Final = re.compile(
    rf"(?P<before>(?:.*[./])?[%_]*(?:(?:{_CLOCKS})[._ ]*)?(?:{_TIMES})s?(?:_utc)?[ _./(\[]*)?"
    rf"(?P<unit>{_UNITS})?(?:[)\]]|\(\))?",
    re.IGNORECASE,
)
_IN_UNIT: Final = re.compile(rf"(?P<before>.*)[(\[](?P<unit>{_UNITS})[)\]]", re.IGNORECASE)
_UNIT: Final = re.compile(r"\s*[(\[]([^\W\d][^)\]]*|-)[)\]]")
"""A unit in brackets after the name of a column."""
_REMARK: Final = re.compile(
    r"(?<=object)\s*[(\[][^)\]]*[)\]]$|(?<=slipped)\s*[(\[][^)\]a-z]*[)\]]$"
)
"""A remark after a label, as in `object (name)` and `slipped (0/1)`; `slipped (mm)` is a length."""
_OF_A_FINGER: Final = re.compile(
    r"(?:finger(?:[_ ]?tip)?|digit|sensor|biotac|tip)(?:[_ ]?(?:name|id|no|nr|index))?|frame_id",
    re.IGNORECASE,
)
_JOINT: Final = re.compile(
    rf"(?:[rl]h_)?(?P<joint>{'|'.join(f'{each[:2]}[_ .-]?{each[2:]}' for each in JOINTS)})(?!\d)",
    re.IGNORECASE,
)
_WORD: Final = re.compile("[^\\W_]+|[\N{DEGREE SIGN}\N{RING ABOVE}]")
_DEGREES: Final = re.compile("deg.*|[\N{DEGREE SIGN}\N{RING ABOVE}\N{MASCULINE ORDINAL INDICATOR}]")
"""Words of degrees. Keyboards have three signs for them."""
_ANGLE: Final = re.compile("angles?|hand|joints?|lh|pos|positions?|q|rad|radians?|rh|states?")
"""Words of the angle of a joint: `FFJ3_position`, `/joint_states/rh_FFJ3/position`."""
_NO_ANGLE: Final = re.compile(
    "acc|acceleration|cmd|command(?:ed|s)?|desired|dot|efforts?|err|error|force|goal|limits?|max"
    "|min|n|nm|ref|reference|s|set|setpoint|speed|targets?|temp|temperature|torques?|v|vel"
    "|velocit(?:y|ies)|voltage"
)
"""Words of other values of a joint: `FFJ3_effort`, `FFJ3 [rad/s]`, `FFJ3_target`."""
UNITS: Final = frozenset((*_UNIT_S, "counts", "count", "raw", "adc", "lsb", "bits", "rad", "deg"))


class MissingFingersError(RecordingError):
    """A file lacks fingers that were requested."""

    def __init__(
        self, path: Path, problem: str, line: int, column: str, there: Sequence[Finger]
    ) -> None:
        """`there`: fingers that the file has."""
        super().__init__(path, problem, line=line, column=column)
        self.there = there


@dataclass(frozen=True, slots=True)
class TimeColumn:
    """Column of times, or columns of whole seconds and nanoseconds."""

    name: str
    places: tuple[int, ...]
    unit_s: float | None
    """Unit of the times, s, if the column's name gives it; else None."""

    def value(self, cells: Sequence[str], *, decimal_comma: bool = False) -> float | None:
        """Return the time of a row in the unit of the column; None if the row has no time.

        `decimal_comma`: True if a comma stands for the point.
        """
        value = time_of(cells[self.places[0]], decimal_comma=decimal_comma)
        if len(self.places) == 1 or value is None:
            return value
        rest_ns = number_of(cells[self.places[1]], decimal_comma=decimal_comma)
        return None if rest_ns is None else value + rest_ns * 1e-9


@dataclass(frozen=True, slots=True)
class Columns:
    """Places of the columns that are read from a file, from 0."""

    electrodes: tuple[int, ...]
    """Finger by finger, E1 to E24 each."""
    joints: Mapping[str, int]
    """Place of a joint, by its name without hand prefix."""
    degrees: tuple[str, ...]
    """Names of joints' angles in degrees; those that are in radians too are not among them."""
    unclear: tuple[str, ...]
    """Names that may be a joint's angle, of joints whose angle no other column clearly is."""
    time: TimeColumn | None
    object: int | None
    slipped: int | None
    ignored: tuple[str, ...]
    """Columns of unknown names; electrodes of fingers that are not read are not among them."""
    fingers: tuple[Finger, ...]
    """Fingers that the file has, asked for or not."""
    finger: tuple[int, str] | None
    """Place and name of a column that may name the finger of each row, in a file whose electrodes
    are of one finger; else None."""
    names_finger: bool
    """True if the names of the electrodes have a finger, as `ff_e1`."""

    @classmethod
    def of(cls, path: Path, names: Sequence[str], fingers: Sequence[str], line: int) -> Columns:
        """Return the columns to read for `fingers`; without any, for all that the file has.

        `names`: the header, at line `line`. Raises `RecordingError` for columns that are missing or
        occur twice, and for electrodes whose finger is not clear.
        """
        plain = [_UNIT.sub("", name) for name in names]
        found = _electrodes(path, plain, fingers, line)
        joints, degrees, unclear = _joints(path, names, line)
        time = time_column(names)
        single: dict[str, int] = {}
        labels = _labels(names)
        for place, name in enumerate(names):
            is_time = time is not None and name == time.name
            if is_time or labels[place] in (OBJECT, SLIPPED):
                key = name if is_time else labels[place]
                _refuse_twice(path, names, line, single.get(key), place)
                single[key] = place
        known = {*joints.values(), *single.values(), *(() if time is None else time.places)}
        known |= {place for electrodes in found.values() for place in electrodes.values()}
        every = tuple(finger for finger in FINGERS if finger in found)
        return cls(
            electrodes=tuple(
                found[finger][number] for finger in fingers or every for number in range(ELECTRODES)
            ),
            joints=joints,
            degrees=degrees,
            unclear=unclear,
            time=time,
            object=single.get(OBJECT),
            slipped=single.get(SLIPPED),
            ignored=tuple(name for place, name in enumerate(names) if place not in known),
            fingers=every,
            finger=finger_column(names) if len(every) == 1 else None,
            names_finger=not any(map(SCHEMES["E1"].fullmatch, plain)),
        )


def _labels(names: Sequence[str]) -> list[str]:
    """Return names in small letters, without a remark in brackets unless they differ by it."""
    whole = [name.lower() for name in names]
    bare = [_REMARK.sub("", name) for name in whole]
    number = Counter(bare)
    return [each if number[each] == 1 else name for name, each in zip(whole, bare, strict=True)]


def has_electrodes(names: Sequence[str]) -> bool:
    """Return True if at least `HEADER_ELECTRODES_MIN` names are of electrodes, as in a header.

    A title may name one, as may a row of a table that has a row for each electrode.
    """
    return sum(map(is_electrode, names)) >= HEADER_ELECTRODES_MIN


def is_electrode(name: str) -> bool:
    """Return True for the name of an electrode in some scheme."""
    plain = _UNIT.sub("", name)
    matches = (scheme.fullmatch(plain) for scheme in SCHEMES.values())
    return any(match and int(match["number"]) <= ELECTRODES for match in matches)


def with_units(names: Sequence[str], cells: Sequence[str]) -> list[str] | None:
    """Return names with units, as `t [s]`, from the `cells` below; None if these are not units."""
    units = [cell.strip("[]()- ") for cell in cells]
    given = {unit.lower() for unit in units} - {""}
    if not given or not given <= UNITS:
        return None
    units += [""] * (len(names) - len(units))
    return [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=False)]


def _joints(
    path: Path, names: Sequence[str], line: int
) -> tuple[dict[str, int], tuple[str, ...], tuple[str, ...]]:
    """Return `joints`, `degrees` and `unclear` of `Columns`. Raises for an angle given twice."""
    plain, worded, degrees, unclear = (dict[str, list[int]]() for _ in range(4))
    for place, name in enumerate(names):
        match, rest = _JOINT.search(name), _JOINT.sub(" ", name, count=1).lower()
        words, bare = _WORD.findall(rest), _WORD.findall(_UNIT.sub("", rest))
        if match is None or any(map(_NO_ANGLE.fullmatch, words)):
            continue
        if any(map(_DEGREES.fullmatch, words)):
            kind = degrees
        elif all(map(_ANGLE.fullmatch, bare)):
            kind = worded if bare else plain
        else:
            kind = unclear
        kind.setdefault(re.sub("[_ .-]", "", match["joint"]).upper(), []).append(place)
    found = worded | plain
    for first, *others in found.values():
        if others:
            _refuse_twice(path, names, line, first, others[0])
    in_degrees, may_be = (
        tuple(
            names[place] for each, places in kind.items() if each not in found for place in places
        )
        for kind in (degrees, unclear)
    )
    return {joint: places[0] for joint, places in found.items()}, in_degrees, may_be


def _electrodes(
    path: Path, names: Sequence[str], fingers: Sequence[str], line: int
) -> dict[str, dict[int, int]]:
    """Return places of electrodes by finger, then number from 0. Raises `RecordingError`."""
    for example, scheme in SCHEMES.items():
        found: dict[str, dict[int, int]] = {}
        for place, name in enumerate(names):
            if match := scheme.fullmatch(name):
                finger = _finger(match, fingers)
                numbers = found.setdefault(finger, {})
                number = int(match["number"])
                _refuse_twice(path, names, line, numbers.get(number), place)
                numbers[number] = place
        if found:
            return _whole(path, example, found, fingers, line, finger_column(names))
    if are_numbers(names):
        raise RecordingError(
            path, "has numbers in place of names: the header is missing", line=line
        )
    problem = f"no column of electrodes is known{_nearest(names)}; {PAGE} has the table of names"
    raise RecordingError(path, problem, line=line)


def _finger(match: re.Match[str], fingers: Sequence[str]) -> str:
    groups = match.groupdict()
    if "place" in groups:
        return FINGERS[int(groups["place"])]
    if named := groups.get("finger") or groups.get("sensor"):
        return named.lower()
    return fingers[0] if len(fingers) == 1 else ""


def _whole(
    path: Path,
    example: str,
    found: dict[str, dict[int, int]],
    fingers: Sequence[str],
    line: int,
    finger_column: tuple[int, str] | None,
) -> dict[str, dict[int, int]]:
    """Return `found`, places by finger and number, with numbers from 0; raise `RecordingError` if a
    finger to read lacks electrodes or has too many. `example`: that of the names' scheme."""
    base = min(1, *(min(numbers) for numbers in found.values()))
    is_named = found.keys() <= _PLACES.keys()
    for finger in fingers if fingers and is_named else found:
        if set(found.get(finger, ())) == set(range(base, base + FORMER_ELECTRODES)):
            problem = (
                f"{finger or 'it'} has {FORMER_ELECTRODES} electrodes: a BioTac, which is another "
                f"sensor than the BioTac SP with {ELECTRODES}; no model of graspd judges it"
            )
            raise RecordingError(path, problem, line=line)
    if not is_named and len(found) == 1 and finger_column is not None:
        problem = f"{example} and so on name no finger, but {finger_column[1]} may: {ONE_ROW}"
        raise RecordingError(path, problem, line=line)
    if not is_named:
        asked = f"{len(fingers)} are" if fingers else "none is"
        problem = f"{example} and so on name no finger, and {asked} asked for: name it, as ff_e1"
        raise RecordingError(path, problem, line=line)
    there = tuple(finger for finger in FINGERS if finger in found)
    expected = range(base, base + ELECTRODES)
    for finger in fingers or found:
        numbers = found.get(finger, {})
        missing = [number for number in expected if number not in numbers]
        if missing:
            written = str(_PLACES[finger]) if "tactiles" in example else finger
            column = re.sub(r"^ff|(?<=tactiles)0", written, example)
            column = re.sub(r"\d+$", str(missing[0]), column)
            others = f", the first of {len(missing)} that are" if len(missing) > 1 else ""
            problem = f"this column is missing{others}; the file has the fingers {', '.join(there)}"
            if finger not in found:
                raise MissingFingersError(path, problem, line, column, there)
            raise RecordingError(path, problem, line=line, column=column)
        if extra := [number for number in numbers if number not in expected]:
            problem = f"{finger} has electrode {extra[0]}, and they begin at {base}"
            raise RecordingError(path, problem, line=line)
    return {
        finger: {number - base: place for number, place in numbers.items()}
        for finger, numbers in found.items()
    }


def finger_column(names: Sequence[str]) -> tuple[int, str] | None:
    """Return place and name of the first column that may say of which finger a row is."""
    found = ((place, name) for place, name in enumerate(names) if _OF_A_FINGER.fullmatch(name))
    return next(found, None)


def problem_of_fingers(named: Iterable[str]) -> str | None:
    """Return why rows that are named so are not of one finger; None: one name at most."""
    first = sorted(named)[:2]
    return f"has rows of {' and of '.join(first)}: {ONE_ROW}" if len(first) > 1 else None


def _nearest(names: Sequence[str]) -> str:
    """Return text for an error: the expected names, and the name most like one of them."""
    from difflib import SequenceMatcher  # only where it is needed

    likeness = [
        (SequenceMatcher(None, name.lower(), example).ratio(), example, name)
        for name in names[:200]
        for example in SCHEMES
        if re.search(r"\d", name)
    ]
    nearest = [f"{name[:60]!r} is nearest to {example}" for _, example, name in sorted(likeness)]
    return "; ".join([f": looked for {', '.join(SCHEMES)}", *nearest[-1:]])


def time_column(names: Sequence[str]) -> TimeColumn | None:
    """Return the column of times: `t`, else the first usual name, else unit; None without any."""
    found = [(place, match) for place, name in enumerate(names) if (match := _is_time(name))]
    found = found or [
        (place, match) for place, name in enumerate(names) if (match := _IN_UNIT.fullmatch(name))
    ]
    found.sort(key=lambda each: names[each[0]] != TIME)
    if not found:
        return None
    place, match = found[0]
    words = {
        (also["unit"] or "").lower(): other
        for other, also in found
        if also["before"] == match["before"]
    }
    # `t_s` and `t_ns` are whole times each, `secs` and `nsecs` the parts of one.
    parts = {_UNIT_S[word]: other for word, other in words.items() if "sec" in word}
    unit_s = None if match["unit"] is None else _UNIT_S[match["unit"].lower()]
    if place in parts.values() and unit_s in _PARTS_S and parts.keys() >= _PARTS_S:
        seconds, rest_ns = parts[1.0], parts[1e-9]
        return TimeColumn(names[seconds], (seconds, rest_ns), 1.0)
    return TimeColumn(names[place], (place,), unit_s)


def _is_time(name: str) -> re.Match[str] | None:
    match = _TIME_NAME.fullmatch(name)
    return match if match and (match["before"] or len(match["unit"] or "") > 1) else None


def _refuse_twice(
    path: Path, names: Sequence[str], line: int, before: int | None, place: int
) -> None:
    if before is not None:
        problem = f"this column is there twice, as {names[before]} too"
        raise RecordingError(path, problem, line=line, column=names[place])
