"""Findings on devices and links, by the faults and counters that their drivers report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from graspd.daemon.doctor.finding import Cause, Finding, Level, Trouble, fine
from graspd.drivers.base import DeviceFault, Fact, LinkCause

RATE_FRACTION = 0.9
"""Share of the nominal rate below which the link is slow."""
BOARD_HZ_MAX = 600
"""Readings/s of a CAN board are fewer: 24 frames of 71 bits, of one sensor, at 1 Mbit/s."""
TOO_MUCH = {Cause.DAMAGED: 0.05, Cause.FRAMES_LOST: 0.1}
"""Share of frames from which on damage or loss is an error. Each loss hides motion for 240 ms, so
with a tenth of 100 readings/s lost, hardly any grasp is ever known to be still."""
BAD_MIN = 5
"""Fewest bad frames that are an error by their share."""
WHOLES = "frames", "packets", "readings"
"""Counters of all that arrives; shares are of the first that is not 0."""
NOT_FRAMES = frozenset(
    {"not_counts", "missed_readings", "cut_sweeps", "interrupted_sweeps", "interrupted_rounds"}
)
"""Counters of other things than frames: values, many in a frame, or readings, of many frames."""
JOINING = frozenset({"unsynchronised_frames", "unsynchronised_packets"})
JOINING_MAX = 108
"""Most samples in `JOINING` that are harmless: who joins in mid-sweep loses up to two sweeps of 54
samples."""

FLASH = "Flash the firmware of this graspd: deploy/bridge/BUILD.md."
AGAIN = "Look longer (--listen 20). If it continues, check"
FLAPS_MIN = 3
"""Fewest losses of a link while the doctor listens that are an error."""
BETWEEN = frozenset({LinkCause.UNKNOWN, LinkCause.NOT_FOUND, LinkCause.SILENT, LinkCause.NO_ANSWER})
"""Causes that a flapping link shows between losses; they are not reported beside `LINK_LOST`."""
NOT_OURS: dict[Cause, tuple[str, ...]] = {
    Cause.VERSION: ("bad_lengths",),
    Cause.MESSAGES: ("bad_messages",),
    Cause.FOREIGN_SENDER: ("other_hands",),
    Cause.BITRATE: ("error_frames", "bus_off"),
    Cause.NOT_A_BRIDGE: ("bad_cobs", "bad_crc", "too_long", "unknown_frames"),
    Cause.PALM_MODE: ("service_packets", "empty_packets", "nonsense_packets"),
    Cause.SETTINGS: (
        *("wrong_length_frames", "unknown_commands", "malformed_frames", "unexpected_channels"),
        *("foreign_frames", "frames"),
    ),
}
"""Counters, by cause, that explain why a link receives data but gives no reading. The first cause
with a counter above 0 is reported."""
STILL_COMES = frozenset({Cause.MESSAGES, Cause.FOREIGN_SENDER, Cause.PALM_MODE})
"""Causes in `NOT_OURS` that also explain why readings stopped. The counters of the others rise with
a link that breaks."""
STOPPED_SHARE = 0.1
"""Least count of a cause in `STILL_COMES`, as a share of the readings, that explains why they
stopped; it must also be `BAD_MIN`."""
NOT_OURS_ADVICE = {
    Cause.VERSION: "No known palm sends this length. Other firmware, or a relay that adds bytes.",
    Cause.MESSAGES: "They are of another form than deploy/wire/TACTILE.md or JOINTS.md.",
    Cause.FOREIGN_SENDER: "They are of another hand. Compare hand.name, or give each hand a port.",
    Cause.REPEATED: "Their numbers or times do not rise: the same data comes again and again, or "
    "the sender's clock was set back.",
    Cause.BITRATE: "Set the interface to the board's bit rate.",
    Cause.NOT_A_BRIDGE: f"Check the baud rate. If it is not a bridge yet: {FLASH}",
    Cause.PALM_MODE: "The palm is in a service mode or starting. Let the hand's driver start it.",
    Cause.SETTINGS: "Compare arbitration_id, sequence and data_length with the board's (candump "
    "shows what it sends). Check that sensors are connected to it.",
}
COUNTERS: dict[Cause, tuple[str, ...]] = {
    Cause.LINK_LOST: ("link_losses",),
    Cause.RESTARTED: ("restarts",),
    Cause.BUS_ERRORS: ("error_frames", "bus_off"),
    Cause.DAMAGED: (
        *("bad_cobs", "bad_crc", "too_long", "bad_frames", "unknown_frames", "malformed_frames"),
        *("wrong_length_frames", "unknown_commands", "nonsense_packets", "bad_lengths"),
        "not_counts",
    ),
    Cause.COMPUTER_BUSY: ("kernel_drops", "host_tx_dropped"),
    Cause.CLOCK: ("clock_faults",),
    Cause.REPEATED: (
        *("duplicates", "duplicate_frames", "duplicate_packets", "conflicting_packets"),
        "old_messages",
    ),
    Cause.FOREIGN_SENDER: ("foreign_datagrams",),
    Cause.SETTINGS: ("unexpected_channels",),
    Cause.FRAMES_LOST: (
        *("missed_readings", "lost_frames", "lost_packets", "cut_sweeps", "interrupted_sweeps"),
        *("interrupted_rounds", "controller_overflows", "late_messages"),
        *("unsynchronised_frames", "unsynchronised_packets", "untimed_frames"),
    ),
    Cause.OUT_OF_ORDER: (
        *("reordered", "reordered_frames", "reordered_packets", "late_frames", "late_packets"),
    ),
    Cause.PALM_MODE: ("service_packets", "empty_packets"),
    Cause.MESSAGES: (
        *("bad_messages", "unknown_names", "bad_angles", "bad_counts", "wrong_sizes"),
        "other_hands",
    ),
    Cause.RECORDING: ("cut_off", "malformed"),
}
"""Counters, by cause, of faults while a link is up. Other counters are harmless, or their faults
show in the statistics of electrodes."""
ADVICE = {
    Cause.LINK_LOST: f"It went away and came back. {AGAIN} plug, hub and supply.",
    Cause.RESTARTED: f"The board was reset. {AGAIN} its supply and reset line.",
    Cause.BUS_ERRORS: f"Frames are cut on the bus. {AGAIN} the bit rates, and the 120 ohm "
    "terminators at both ends.",
    Cause.DAMAGED: f"Bytes are damaged or foreign. {AGAIN} cable, hub, and who else sends there.",
    Cause.COMPUTER_BUSY: "This computer reads too late. See top; [realtime] puts graspd first.",
    Cause.CLOCK: f"The board's clock stands, was reset, or is wrong. {FLASH}",
    Cause.REPEATED: "Data comes twice, or its number or time fell. Check for a second sender, "
    "whether the board hangs, and whether the sender restarted or its clock was set back.",
    Cause.FOREIGN_SENDER: "Two programs send to one port, and one is read. Name it with only_from.",
    Cause.SETTINGS: "The board samples channels that the scene's sequence lacks. Align them.",
    Cause.FRAMES_LOST: f"Data is lost or late. {AGAIN} the load of bus, hub and this computer.",
    Cause.OUT_OF_ORDER: f"Frames overtake each other. {AGAIN} the relay or hub on the way.",
    Cause.PALM_MODE: "The palm is in a service mode, or late. Let the hand's own driver start it.",
    Cause.MESSAGES: "What does not fit is left out: see deploy/wire/TACTILE.md or JOINTS.md.",
    Cause.RECORDING: "The recording is damaged or ends in the middle. Record it again.",
}
HELD_BACK = (
    "The adapter or this computer holds frames back. Set the adapter's latency timer to 1 ms "
    "(deploy/can/PROTOCOL.md); see top."
)
"""Advice on `FRAMES_LOST` with `untimed_frames`."""
TROUBLES: dict[LinkCause | DeviceFault, Trouble] = {
    LinkCause.UNKNOWN: Trouble(
        Cause.LINK_DOWN, "Check that it is powered, connected, and the one that the scene names."
    ),
    LinkCause.NOT_FOUND: Trouble(
        Cause.PORT_MISSING,
        "Plug it in, or name another port. A Pico that shows as a drive has no firmware yet.",
    ),
    LinkCause.DENIED: Trouble(Cause.PORT_DENIED, "Join the group of the port: ls -lL PORT."),
    LinkCause.IN_USE: Trouble(
        Cause.PORT_HELD,
        "Find the program: sudo fuser -v PORT, of UDP sudo ss -ulpn. End a daemon with "
        "systemctl stop 'graspd@*'.",
    ),
    LinkCause.NO_INTERFACE: Trouble(Cause.INTERFACE_MISSING, "Plug its adapter in."),
    LinkCause.INTERFACE_DOWN: Trouble(Cause.INTERFACE_DOWN, "Bring it up."),
    LinkCause.NO_ADDRESS: Trouble(
        Cause.ADDRESS, "Listen on an address of this computer: ip -brief address lists them."
    ),
    LinkCause.BUS_OFF: Trouble(
        Cause.BITRATE,
        "Set the interface to the board's bit rate. If it already matches, check the 120 ohm "
        "terminators.",
    ),
    LinkCause.SILENT: Trouble(
        Cause.SILENT, "No data yet. Check power and connection, or look longer (--listen 10)."
    ),
    LinkCause.NO_ANSWER: Trouble(
        Cause.SILENT,
        "Plug it in again. On a UART check TX to RX, and the baud rate. If it is not a bridge "
        f"yet: {FLASH}",
    ),
    LinkCause.FOREIGN: Trouble(
        Cause.FOREIGN_SENDER, "Name the sender in only_from if it is the right one."
    ),
    LinkCause.TIMEOUT: Trouble(
        Cause.LINK_LOST, "Data came and stopped. Check supply, cable, and this computer's load."
    ),
    LinkCause.DISCONNECTED: Trouble(
        Cause.LINK_LOST, "It was unplugged, or lost power. Check plug, cable, hub and supply."
    ),
    LinkCause.VERSION: Trouble(Cause.VERSION, FLASH),
    LinkCause.SETTINGS: Trouble(
        Cause.SETTINGS, f"Make the settings of scene and bridge equal. {FLASH}"
    ),
    LinkCause.SERIALS: Trouble(
        Cause.SENSOR_WORDS,
        "Serial numbers are misread. Check supply, ground, MISO and its pull-up.",
    ),
    LinkCause.CLOCK: Trouble(Cause.CLOCK, ADVICE[Cause.CLOCK]),
    DeviceFault.BUS_ERROR: Trouble(Cause.BUS_ERRORS, ADVICE[Cause.BUS_ERRORS]),
    DeviceFault.OLD_FIRMWARE: Trouble(Cause.FIRMWARE_OLD, FLASH),
    DeviceFault.NO_SENSOR: Trouble(
        Cause.SENSOR_ABSENT,
        "Check the lines that all share: 3.3 V, ground, SCK, MOSI, MISO and its pull-up.",
        Level.ERROR,
    ),
    DeviceFault.SENSOR_TWICE: Trouble(
        Cause.SENSOR_TWICE,
        "Two chip selects lead to one sensor, or touch each other.",
        Level.ERROR,
    ),
    DeviceFault.SENSOR_ABSENT: Trouble(
        Cause.SENSOR_ABSENT, "The list is in the order of the chip selects."
    ),
    DeviceFault.SENSOR_WORDS: Trouble(
        Cause.SENSOR_WORDS,
        "Counted by chip select since its reset. If one grows, check the wires of that sensor.",
    ),
    DeviceFault.SEQUENCE: Trouble(
        Cause.SETTINGS,
        "Set tactile.sequence to that of the board: electrodes, all or interleaved.",
    ),
    DeviceFault.SWEEP_TOO_LONG: Trouble(
        Cause.SETTINGS, "Set a longer period or a shorter sequence, and flash it."
    ),
}
"""Cause and advice for each fault that a driver reports."""


def device_findings(
    driver: str, device: Mapping[str, Fact], counters: Mapping[str, int] | None = None
) -> list[Finding]:
    """Return a finding on each fact of a device; if its link is not up, only the reason.

    `counters`: those of the link, from which the reason is guessed; None: not known.
    """
    facts = dict(device)
    link = facts.pop("link", None)
    if link is not None and link.fault is not None:
        what = f"{driver}: link {link.text}"
        if "why" in facts:
            what = f"{what}: {facts['why'].text}"
        counters, trouble = counters or {}, TROUBLES[link.fault]
        losses, old = counters.get("link_losses", 0), counters.get("old_messages", 0)
        if old > counters.get("readings", 0):
            what = f"{what}, but {old} old messages"
            trouble = Trouble(Cause.REPEATED, NOT_OURS_ADVICE[Cause.REPEATED])
        elif losses and link.fault in BETWEEN:
            what += f"; it was up and was lost {losses} {'time' if losses == 1 else 'times'}"
            trouble = TROUBLES[LinkCause.DISCONNECTED]
        elif (cause := _not_ours(link.fault, counters)) is not None:
            what = f"{what}, but {_counted(NOT_OURS[cause], counters)}"
            trouble = Trouble(cause, NOT_OURS_ADVICE[cause])
        return [Finding(Level.ERROR, what, trouble.cause, trouble.advice)]
    found = [] if link is None else [fine(f"{driver}: link up")]
    for key, fact in facts.items():
        what = f"{driver}: {key} {fact.text}"
        found.append(fine(what) if fact.fault is None else TROUBLES[fact.fault].finding(what))
    return found


def counter_findings(driver: str, counters: Mapping[str, int]) -> list[Finding]:
    """Return a finding for each fault that the counters of a link show while it is up."""
    found = []
    for cause, names in COUNTERS.items():
        if counted := _counted(names, counters):
            level = Level.ERROR if _is_too_much(cause, counters) else Level.WARNING
            is_held_back = cause is Cause.FRAMES_LOST and counters.get("untimed_frames", 0)
            advice = HELD_BACK if is_held_back else ADVICE[cause]
            found.append(Finding(level, f"{driver}: {counted}", cause, advice))
    return found


def rate_finding(driver: str, readings: int, seconds: float, period_ns: int | None) -> Finding:
    """Return a finding on the readings' rate in `seconds`; `period_ns`: nominal; None: unknown."""
    rate_hz = readings / seconds
    if not readings:
        what = f"{driver}: no reading in {seconds:.1f} s"
        return Finding(Level.ERROR, what, Cause.SILENT, TROUBLES[LinkCause.UNKNOWN].advice)
    if period_ns is None:
        return fine(f"{driver}: {rate_hz:.1f} readings/s")
    nominal_hz = 1e9 / period_ns
    what = f"{driver}: {rate_hz:.1f} readings/s of {nominal_hz:.1f}"
    if rate_hz < RATE_FRACTION * nominal_hz:
        advice = "Nothing was lost. The board is slow, or this computer is busy (top)."
        return Finding(Level.WARNING, what, Cause.SLOW, advice)
    return fine(what)


def two_boards_finding(
    driver: str, readings: int, seconds: float, counters: Mapping[str, int]
) -> Finding | None:
    """Return a finding if two CAN boards send with one arbitration id; None: nothing shows it.

    Each frame of one then seems to begin another sweep, which most samples never join.
    """
    lost = counters.get("lost_frames", 0)
    if readings < BOARD_HZ_MAX * seconds or lost <= counters.get("accepted_frames", lost):
        return None
    what = f"{driver}: {readings / seconds:.0f} pieces of readings/s, more than a board can send"
    advice = "Two boards send with one arbitration id. Give each its own id or bus."
    return Finding(Level.ERROR, what, Cause.FOREIGN_SENDER, advice)


def _not_ours(fault: LinkCause | DeviceFault, counters: Mapping[str, int]) -> Cause | None:
    """Return why data that arrives gives no reading, by `NOT_OURS`; None: not known."""
    if TROUBLES[fault].cause is Cause.SILENT:
        causes, least = frozenset(NOT_OURS), 1.0
    elif fault is LinkCause.TIMEOUT:
        causes, least = STILL_COMES, max(BAD_MIN, STOPPED_SHARE * counters.get("readings", 0))
    else:
        return None
    for cause, names in NOT_OURS.items():
        if cause in causes and sum(counters.get(name, 0) for name in names) >= least:
            return cause
    return None


def _is_too_much(cause: Cause, counters: Mapping[str, int]) -> bool:
    """Return True if the counters of `cause` are an error, by `FLAPS_MIN` or `TOO_MUCH`."""
    if cause is Cause.LINK_LOST:
        return counters["link_losses"] >= FLAPS_MIN
    share = TOO_MUCH.get(cause)
    if share is None:
        return False
    frames = next(filter(None, (counters.get(name, 0) for name in WHOLES)), 0)
    of_frames = [name for name in COUNTERS[cause] if name not in NOT_FRAMES]
    pairs = [(sum(counters.get(name, 0) for name in of_frames), frames)]
    if cause is Cause.FRAMES_LOST:
        pairs.append((counters.get("missed_readings", 0), counters.get("readings", 0)))
    return any(
        bad >= BAD_MIN and bad + 2.0 * math.sqrt(bad) >= share * (bad + sound)
        for bad, sound in pairs
    )


def _counted(names: Sequence[str], counters: Mapping[str, int]) -> str:
    """Return the counters above what is harmless as text, such as `2 bad crc, 1 too long`."""
    return ", ".join(
        f"{count} {name.replace('_', ' ')}"
        for name in names
        if (count := counters.get(name, 0)) > (JOINING_MAX if name in JOINING else 0)
    )
