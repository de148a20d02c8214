"""What readings and counters say about the health of sensors and link, in words."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from drivers.base import COUNT_MAX, ELECTRODES, ElectrodeFault, TactileReading

RAIL_COUNTS = 20
"""A mean this near to 0 or 4095 is a rail; 0.3 % of loaded electrodes come this low."""
QUIET_COUNTS = 40.0
"""An untouched electrode's standard deviation is 3 to 12 counts; beyond this something moves."""
STILL_READINGS = 10
"""So many equal counts in a row do not happen with 3 counts of noise."""
FAULTY_FRACTION = 0.5
"""An electrode with more faulty readings than this is missing, with fewer it is unreliable."""
NAMED_MAX = 6
"""More electrodes than this are counted instead of named."""
RATE_FRACTION = 0.9
"""Readings per nominal rate below which the link is slow."""


USUAL_COUNTERS = frozenset(
    {"readings", "bytes", "frames", "accepted_frames", "packets", "joint_readings"}
)
"""What a driver counts that is no trouble."""
JOINING, JOINING_MAX = "unsynchronised", 108
"""A listener that joins in mid-sweep takes nothing up to two sweeps of 54 samples: no trouble."""


class Level(StrEnum):
    """How bad a finding is."""

    OK = "ok"
    WARNING = "warning"
    ERROR = "error"


FLASH = "flash the firmware of this graspd: deploy/bridge/BUILD.md"
LINK_ADVICE = {
    "no such file": "plug it in; ls /dev/serial/by-id; a Pico that is a drive has no firmware yet",
    "another program": "fuser -v and the port names it; a daemon: systemctl stop 'graspd@*'",
    "permission denied": "join the group of the port: ls -lL and the port names it",
    "speaks version|has layout": FLASH,
    "has . sensors|sweeps once": f"let the scene and the settings of the bridge agree: {FLASH}",
    "no answer": f"plug it in anew; on a UART: TX to RX, baud; not a bridge yet: {FLASH}",
    "other sensors": "serial numbers are misread: see supply, ground, MISO and its pull-up",
    "no sweep": "it began and stopped: see its supply and cable, and how busy this computer is",
    "went away|was reset": "plug, cable, hub and supply: it was unplugged, or lost power",
    "^greeting$": "it has said nothing yet: is it on and connected? longer: --listen 10",
    "": "is it powered, connected, and the one that the scene names?",
}
"""What to do about a link that is not up, by the first pattern that is found in why it is not."""
DEVICE_TROUBLES = (
    ("last error", "", Level.WARNING, ""),
    ("newer firmware", "", Level.WARNING, FLASH),
    (
        "sensors",
        "^none(, none)*$",
        Level.ERROR,
        "see what all share: 3.3 V, ground, SCK, MOSI, MISO and its pull-up",
    ),
    (
        "sensors",
        r"(^|, )(?!none)([^,]+),(.*,)? \2(,|$)",
        Level.ERROR,
        "two chip selects lead to one sensor, or touch",
    ),
    ("sensors", r"\bnone\b", Level.WARNING, "they stand in the order of the chip selects"),
    ("spi errors", "[1-9]", Level.WARNING, "by chip select, since its reset; of one: its wires"),
    ("sweep", "too long", Level.WARNING, "set a longer period or a shorter sequence, and flash it"),
    ("clock", "not trusted", Level.WARNING, f"it stands, was reset, or is wrong: {FLASH}"),
)
"""What a device says of itself that is not fine: key, pattern of the value, how bad, advice."""
COUNTER_ADVICE = {
    "bad_": "damaged or foreign bytes: cable, hub, baud; is it the firmware of a bridge?",
    "too_long": "foreign bytes: is it the firmware of a bridge?",
    "bridge_": "since its reset: what grows from one look to the next is trouble",
}
"""What to do about a counter, by how its name begins."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found, and what to do about it."""

    level: Level
    what: str
    advice: str = ""


class ElectrodeStatistics:
    """Running mean, spread and faults of every electrode, in constant memory (Welford)."""

    def __init__(self, fingers: Sequence[str]) -> None:
        self.fingers = tuple(fingers)
        shape = (len(fingers), ELECTRODES)
        self.readings = 0
        self.faulty = np.zeros(shape, dtype=np.int64)
        """Readings with a fault, shape (fingers, 24)."""
        self.fault_bits = np.zeros(shape, dtype=np.uint8)
        self.mean = np.zeros(shape)
        """Counts, over readings without a fault."""
        self._sound = np.zeros(shape, dtype=np.int64)
        self._squares = np.zeros(shape)

    def add(self, reading: TactileReading) -> None:
        """Take in one reading of these fingers."""
        self.readings += 1
        faulty = reading.faults != 0
        self.faulty += faulty
        self.fault_bits |= reading.faults
        self._sound += ~faulty
        step = np.where(faulty, 0.0, reading.counts - self.mean)
        self.mean += step / np.maximum(self._sound, 1)
        self._squares += step * np.where(faulty, 0.0, reading.counts - self.mean)

    @property
    def deviation(self) -> NDArray[np.float64]:
        """Standard deviation, counts, shape (fingers, 24)."""
        deviation: NDArray[np.float64] = np.sqrt(self._squares / np.maximum(self._sound, 1))
        return deviation

    def findings(self) -> list[Finding]:
        """What is wrong with the electrodes, finger by finger."""
        found: list[Finding] = []
        for finger, name in enumerate(self.fingers):
            found += self._of_finger(finger, name)
        return found

    def _of_finger(self, finger: int, name: str) -> list[Finding]:
        if not self.readings:
            return []
        missing = self.faulty[finger] > FAULTY_FRACTION * self.readings
        why = _faults_in_words(int(np.bitwise_or.reduce(self.fault_bits[finger])))
        if missing.all():
            advice = "check the finger's plug, its chip select and its supply"
            return [Finding(Level.ERROR, f"{name}: no electrode can be read ({why})", advice)]
        unreliable = (self.faulty[finger] > 0) & ~missing
        mean, deviation = self.mean[finger], self.deviation[finger]
        rail = ~missing & ((mean <= RAIL_COUNTS) | (mean >= COUNT_MAX - RAIL_COUNTS))
        enough = self._sound[finger] >= STILL_READINGS
        still = ~missing & ~rail & enough & (deviation == 0.0)
        moving = ~missing & ~rail & (deviation > QUIET_COUNTS)
        table = [
            (missing, Level.ERROR, f"never or rarely sampled ({why})", "check bus load and wiring"),
            (
                rail,
                Level.ERROR,
                "stuck at a rail",
                "a dead electrode: refill or replace the sensor",
            ),
            (still, Level.ERROR, "frozen", "power-cycle the sensor; check who repeats old data"),
            (unreliable, Level.WARNING, f"now and then faulty ({why})", "check wiring and clock"),
            (
                moving,
                Level.WARNING,
                "restless",
                "leave the hand untouched while the doctor looks; if touched: is it this finger?",
            ),
        ]
        return [
            Finding(level, f"{_names(name, which)} {what}", advice)
            for which, level, what, advice in table
            if which.any()
        ]


def device_findings(driver: str, device: Mapping[str, str]) -> list[Finding]:
    """A finding for all that a driver says of its device, by key; a link's with why it is down."""
    told = dict(device)
    found = []
    link, why = told.pop("link", "up"), told.pop("why", None)
    if link != "up":
        link = link if why is None else f"{link}: {why}"
        advice = next(advice for part, advice in LINK_ADVICE.items() if re.search(part, link))
        found.append(Finding(Level.ERROR, f"{driver}: link {link}", advice))
    elif "link" in device:
        found.append(Finding(Level.OK, f"{driver}: link up"))
    for key, value in told.items():
        level, advice = next(
            (
                (level, advice)
                for which, part, level, advice in DEVICE_TROUBLES
                if which == key and re.search(part, value)
            ),
            (Level.OK, ""),
        )
        found.append(Finding(level, f"{driver}: {key} {value}", advice))
    return found


def counter_findings(driver: str, counters: Mapping[str, int]) -> list[Finding]:
    """A warning for every counter of a driver that is about something going wrong."""
    return [
        Finding(
            Level.WARNING,
            f"{driver}: {number} {name.replace('_', ' ')}",
            next((advice for word, advice in COUNTER_ADVICE.items() if name.startswith(word)), ""),
        )
        for name, number in counters.items()
        if number > JOINING_MAX * name.startswith(JOINING) and name not in USUAL_COUNTERS
    ]


def rate_finding(driver: str, readings: int, seconds: float, period_ns: int | None) -> Finding:
    """Whether readings come, and as often as they should."""
    rate_hz = readings / seconds
    if not readings:
        advice = "is it powered, connected, and the one that the scene names?"
        return Finding(Level.ERROR, f"{driver}: no reading in {seconds:.1f} s", advice)
    if period_ns is None:
        return Finding(Level.OK, f"{driver}: {rate_hz:.1f} readings/s")
    nominal_hz = 1e9 / period_ns
    what = f"{driver}: {rate_hz:.1f} readings/s of {nominal_hz:.1f}"
    if rate_hz < RATE_FRACTION * nominal_hz:
        return Finding(Level.WARNING, what, "frames are lost: check bus load, cable and baud rate")
    return Finding(Level.OK, what)


def _faults_in_words(bits: int) -> str:
    names = [fault.name or "" for fault in ElectrodeFault if fault & bits]
    return ", ".join(name.lower().replace("_", " ") for name in names) or "no fault"


def _names(finger: str, which: NDArray[np.bool_]) -> str:
    """Electrodes of a finger by name, such as `ff_7`, or their number where they are many."""
    numbers = np.flatnonzero(which) + 1
    if len(numbers) > NAMED_MAX:
        return f"{finger}: {len(numbers)} electrodes"
    return ", ".join(f"{finger}_{number}" for number in numbers)
