"""Findings on devices and links, by the faults and counters that their drivers tell."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from graspd.daemon.doctor.finding import Cause, Finding, Level, Trouble, fine
from graspd.drivers.base import DeviceFault, Fact, LinkCause

RATE_FRACTION = 0.9
"""Share of the nominal rate below which the link is slow."""
TOO_MUCH = {Cause.DAMAGED: 0.05, Cause.FRAMES_LOST: 0.1}
"""Share of frames from which damage or loss is an error. Each loss hides motion for 240 ms, so at a
tenth of 100 readings/s hardly a grasp is ever known to be still."""
BAD_MIN = 5
"""With fewer bad frames their share is not known."""
WHOLES = "frames", "packets", "readings"
"""Counters of what comes, by link."""
NOT_FRAMES = frozenset(
    {"not_counts", "missed_readings", "cut_sweeps", "interrupted_sweeps", "interrupted_rounds"}
)
"""Counters of values, of which a frame has many, and of readings, which may take many frames."""
JOINING, JOINING_MAX = "unsynchronised", 108
"""Counter, and its most samples that are no trouble: a listener may join in mid-sweep.

It then loses up to two sweeps of 54 samples.
"""

FLASH = "flash the firmware of this graspd: deploy/bridge/BUILD.md"
AGAIN = "look longer (--listen 20); if it goes on"
CLOCK_ADVICE = f"it stands, was reset, or is wrong: {FLASH}"

NOT_OURS = {
    ("bad_lengths",): Trouble(
        Cause.VERSION,
        "no palm that graspd knows sends these: its firmware is another one, or the relay adds "
        "bytes",
    ),
    ("bad_messages",): Trouble(
        Cause.JOINTS, "what comes are no joint angles: deploy/wire/JOINTS.md"
    ),
    ("error_frames", "bus_off"): Trouble(
        Cause.BITRATE, "the board has another bit rate than the interface: set that of the board"
    ),
    ("bad_cobs", "bad_crc", "too_long", "unknown_frames"): Trouble(
        Cause.NOT_A_BRIDGE,
        f"damaged or foreign bytes: is the baud rate the bridge's? not a bridge yet: {FLASH}",
    ),
    ("service_packets", "empty_packets", "nonsense_packets"): Trouble(
        Cause.PALM_MODE,
        "the palm is in a service mode or starting: let the hand's own driver start it",
    ),
    (
        *("wrong_length_frames", "unknown_commands", "malformed_frames", "unexpected_channels"),
        *("foreign_frames", "frames"),
    ): Trouble(
        Cause.SETTINGS,
        "let arbitration_id, sequence and data_length be those of the board (candump shows "
        "what it sends); are sensors connected to it?",
    ),
}
"""Trouble of a link that receives data but gives no reading, by counters that are not 0."""
FLAPS_MIN = 3
"""Fewest losses of a link while the doctor listens that are an error."""
BETWEEN = frozenset({LinkCause.UNKNOWN, LinkCause.NOT_FOUND, LinkCause.SILENT, LinkCause.NO_ANSWER})
"""Causes that a link shows between its losses; they are not reported beside the losses."""
COUNTERS = {
    ("link_losses",): Trouble(
        Cause.LINK_LOST, f"it went away and came back: {AGAIN}, plug, hub and supply"
    ),
    ("restarts",): Trouble(
        Cause.RESTARTED, f"the board was reset: {AGAIN}, its supply and reset line"
    ),
    ("error_frames", "bus_off"): Trouble(
        Cause.BUS_ERRORS,
        f"frames are cut on the bus: {AGAIN}, bit rates, and terminators of 120 Ohm at both ends",
    ),
    (
        *("bad_cobs", "bad_crc", "too_long", "bad_frames", "unknown_frames", "malformed_frames"),
        *("wrong_length_frames", "unknown_commands", "nonsense_packets", "bad_lengths"),
        "not_counts",
    ): Trouble(
        Cause.DAMAGED, f"damaged or foreign bytes: {AGAIN}, cable and hub, and who else sends there"
    ),
    ("kernel_drops", "untimed_frames", "host_tx_dropped"): Trouble(
        Cause.COMPUTER_BUSY,
        "this computer was too late to read: top shows why; [realtime] puts graspd first",
    ),
    ("clock_faults",): Trouble(Cause.CLOCK, CLOCK_ADVICE),
    (
        *("duplicates", "duplicate_frames", "duplicate_packets", "conflicting_packets"),
        "old_messages",
    ): Trouble(
        Cause.REPEATED,
        "the same comes twice: is there a second sender, or does the board stand still?",
    ),
    ("foreign_datagrams",): Trouble(
        Cause.FOREIGN_SENDER,
        "two send to one port, and one of them is listened to: name it with only_from",
    ),
    ("unexpected_channels",): Trouble(
        Cause.SETTINGS, "the board samples what the scene's sequence does not have: let them agree"
    ),
    (
        *("missed_readings", "lost_frames", "lost_packets", "cut_sweeps", "interrupted_sweeps"),
        *("interrupted_rounds", "controller_overflows"),
        *("unsynchronised_frames", "unsynchronised_packets"),
    ): Trouble(
        Cause.FRAMES_LOST,
        f"lost or late on the way: {AGAIN}, see the load of bus, hub and this computer",
    ),
    (
        *("reordered", "reordered_frames", "reordered_packets", "late_frames", "late_packets"),
    ): Trouble(
        Cause.OUT_OF_ORDER,
        f"frames overtake each other: {AGAIN}, what lies between board and computer (relay, hub)",
    ),
    ("service_packets", "empty_packets"): Trouble(
        Cause.PALM_MODE,
        "the palm is in a service mode, or too late: let the hand's own driver start it",
    ),
    ("bad_messages", "unknown_names", "bad_angles"): Trouble(
        Cause.JOINTS, "what is no joint or no angle is left out: deploy/wire/JOINTS.md"
    ),
    ("cut_off", "malformed"): Trouble(
        Cause.RECORDING, "the recording is damaged or ends in the middle: record it again"
    ),
}
"""Counters that are trouble on a link that is up. Others show at the electrodes or are harmless."""
TROUBLES: dict[LinkCause | DeviceFault, Trouble] = {
    LinkCause.UNKNOWN: Trouble(
        Cause.LINK_DOWN, "is it powered, connected, and the one that the scene names?"
    ),
    LinkCause.NOT_FOUND: Trouble(
        Cause.PORT_MISSING,
        "plug it in, or name an existing one; a Pico that is a drive has no firmware yet",
    ),
    LinkCause.DENIED: Trouble(
        Cause.PORT_DENIED, "join the group of the port: ls -lL and the port names it"
    ),
    LinkCause.IN_USE: Trouble(
        Cause.PORT_HELD,
        "sudo fuser -v and the port names it (of UDP: sudo ss -ulpn); a daemon: systemctl stop "
        "'graspd@*'",
    ),
    LinkCause.NO_INTERFACE: Trouble(Cause.INTERFACE_MISSING, "plug its adapter in"),
    LinkCause.INTERFACE_DOWN: Trouble(Cause.INTERFACE_DOWN, "bring it up"),
    LinkCause.NO_ADDRESS: Trouble(
        Cause.ADDRESS, "ip -brief address has those of this computer: listen on one of them"
    ),
    LinkCause.BUS_OFF: Trouble(
        Cause.BITRATE, "let the interface have the board's bit rate; it has: then the terminators"
    ),
    LinkCause.SILENT: Trouble(
        Cause.SILENT, "it has said nothing yet: is it on and connected? longer: --listen 10"
    ),
    LinkCause.NO_ANSWER: Trouble(
        Cause.SILENT, f"plug it in again; on a UART: TX to RX, baud; not a bridge yet: {FLASH}"
    ),
    LinkCause.FOREIGN: Trouble(
        Cause.FOREIGN_SENDER, "name the sender in only_from if it is the right one"
    ),
    LinkCause.TIMEOUT: Trouble(
        Cause.LINK_LOST,
        "it began and stopped: see its supply and cable, and how busy this computer is",
    ),
    LinkCause.DISCONNECTED: Trouble(
        Cause.LINK_LOST, "plug, cable, hub and supply: it was unplugged, or lost power"
    ),
    LinkCause.VERSION: Trouble(Cause.VERSION, FLASH),
    LinkCause.SETTINGS: Trouble(
        Cause.SETTINGS, f"let the scene and the settings of the bridge agree: {FLASH}"
    ),
    LinkCause.SERIALS: Trouble(
        Cause.SENSOR_WORDS, "serial numbers are misread: see supply, ground, MISO and its pull-up"
    ),
    DeviceFault.BUS_ERROR: COUNTERS["error_frames", "bus_off"],
    DeviceFault.OLD_FIRMWARE: Trouble(Cause.FIRMWARE_OLD, FLASH),
    DeviceFault.NO_SENSOR: Trouble(
        Cause.SENSOR_ABSENT,
        "see what all share: 3.3 V, ground, SCK, MOSI, MISO and its pull-up",
        Level.ERROR,
    ),
    DeviceFault.SENSOR_TWICE: Trouble(
        Cause.SENSOR_TWICE, "two chip selects lead to one sensor, or touch", Level.ERROR
    ),
    DeviceFault.SENSOR_ABSENT: Trouble(
        Cause.SENSOR_ABSENT, "they stand in the order of the chip selects"
    ),
    DeviceFault.SENSOR_WORDS: Trouble(
        Cause.SENSOR_WORDS,
        "by chip select, since its reset: look again; of one, and growing: its wires",
    ),
    DeviceFault.SWEEP_TOO_LONG: Trouble(
        Cause.SETTINGS, "set a longer period or a shorter sequence, and flash it"
    ),
    DeviceFault.CLOCK_NOT_TRUSTED: Trouble(Cause.CLOCK, CLOCK_ADVICE),
}
"""Cause and advice for each fault that a driver reports."""


def device_findings(
    driver: str, device: Mapping[str, Fact], counters: Mapping[str, int] | None = None
) -> list[Finding]:
    """Judge the facts of a device one by one; of a link that is not up only why."""
    facts = dict(device)
    link = facts.pop("link", None)
    if link is not None and link.fault is not None:
        what = f"{driver}: link {link.text}"
        if "why" in facts:
            what = f"{what}: {facts['why'].text}"
        counters, trouble = counters or {}, TROUBLES[link.fault]
        losses = counters.get("link_losses", 0)
        if losses and link.fault in BETWEEN:
            what += f"; it was up and was lost {losses} {'time' if losses == 1 else 'times'}"
            trouble = TROUBLES[LinkCause.DISCONNECTED]
        elif trouble.cause is Cause.SILENT:
            for names, other in NOT_OURS.items():
                if counted := _counted(names, counters):
                    what, trouble = f"{what}, but {counted}", other
                    break
        return [Finding(Level.ERROR, what, trouble.cause, trouble.advice)]
    found = [] if link is None else [fine(f"{driver}: link up")]
    for key, fact in facts.items():
        what = f"{driver}: {key} {fact.text}"
        found.append(fine(what) if fact.fault is None else TROUBLES[fact.fault].finding(what))
    return found


def counter_findings(driver: str, counters: Mapping[str, int]) -> list[Finding]:
    """Return a finding for each trouble that the counters of a link that is up show."""
    found = []
    for names, trouble in COUNTERS.items():
        if counted := _counted(names, counters):
            finding = trouble.finding(f"{driver}: {counted}")
            if _is_too_much(trouble.cause, names, counters):
                finding = replace(finding, level=Level.ERROR)
            found.append(finding)
    return found


def rate_finding(driver: str, readings: int, seconds: float, period_ns: int | None) -> Finding:
    """Judge whether readings come at their nominal rate."""
    rate_hz = readings / seconds
    if not readings:
        advice = "is it powered, connected, and the one that the scene names?"
        what = f"{driver}: no reading in {seconds:.1f} s"
        return Finding(Level.ERROR, what, Cause.SILENT, advice)
    if period_ns is None:
        return fine(f"{driver}: {rate_hz:.1f} readings/s")
    nominal_hz = 1e9 / period_ns
    what = f"{driver}: {rate_hz:.1f} readings/s of {nominal_hz:.1f}"
    if rate_hz < RATE_FRACTION * nominal_hz:
        advice = "none was lost on the way: the board is late, or this computer is busy (top)"
        return Finding(Level.WARNING, what, Cause.SLOW, advice)
    return fine(what)


def _is_too_much(cause: Cause, names: Sequence[str], counters: Mapping[str, int]) -> bool:
    """Return True for `FLAPS_MIN` losses of a link, and for a share of bad frames in `TOO_MUCH`."""
    if cause is Cause.LINK_LOST:
        return counters["link_losses"] >= FLAPS_MIN
    share = TOO_MUCH.get(cause)
    if share is None:
        return False
    frames = next(filter(None, (counters.get(name, 0) for name in WHOLES)), 0)
    of_frames = [name for name in names if name not in NOT_FRAMES]
    pairs = [(sum(counters.get(name, 0) for name in of_frames), frames)]
    if "missed_readings" in names:
        pairs.append((counters.get("missed_readings", 0), counters.get("readings", 0)))
    return any(
        bad >= BAD_MIN and bad + 2.0 * math.sqrt(bad) >= share * (bad + sound)
        for bad, sound in pairs
    )


def _counted(names: Sequence[str], counters: Mapping[str, int]) -> str:
    """Name the counters that are not 0, such as `2 bad crc, 1 too long`."""
    return ", ".join(
        f"{count} {name.replace('_', ' ')}"
        for name in names
        if (count := counters.get(name, 0)) > JOINING_MAX * name.startswith(JOINING)
    )
