"""`graspd twin KIND`: simulate hardware, to try graspd and a controller without a hand."""

from __future__ import annotations

import argparse
import logging
import signal
import threading
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path

from graspd.biotac import ELECTRODES, TABLE_FINGERS
from graspd.daemon.commands.arguments import check_folder, within
from graspd.daemon.process.signals import stopping
from graspd.daemon.process.text import complain, write_json
from graspd.drivers.base import DriverError
from graspd.drivers.biotac import SEQUENCES
from graspd.drivers.can.frames import EXTENDED_ID_MAX
from graspd.drivers.twins.faults import LinkFaults
from graspd.drivers.twins.grasps.grasps import Counts, recorded_counts
from graspd.drivers.twins.grasps.whole_grasps import PALM_RATE_HZ, synthetic_grasps

log = logging.getLogger("graspd")

SPI_PATH = Path("/tmp/graspd-twin")
CAN_GROUP = "239.74.163.2"
"""Default multicast group of python-can's `udp_multicast`."""
TARGETS = {
    "palm": "udp://127.0.0.1:9870",
    "joints": "udp://127.0.0.1:9871",
    "datagrams": "udp://127.0.0.1:9872",
}
"""Default address to which each twin of UDP datagrams sends."""
PROBABILITIES = {
    "bit-flip": "one random bit of it flips",
    "drop": "it is lost",
    "duplicate": "it comes twice",
    "reorder": "it comes after the next one instead of before it",
}
KINDS = {
    "spi": "an SPI bridge on a pseudo-terminal",
    "can": "a CAN board on any python-can bus",
    "palm": "a Shadow hand's palm over UDP",
    "joints": "a stream of joint angles over UDP",
    "datagrams": "a program that sends counts as JSON over UDP",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    kinds = parser.add_subparsers(
        dest="kind", metavar="KIND", required=True, help="what to stand in for"
    )
    spi, can, palm, joints, datagrams = (
        kinds.add_parser(name, help=text, description=f"Stands in for {text}.")
        for name, text in KINDS.items()
    )
    spi.add_argument(
        "--path", type=Path, default=SPI_PATH, help=f"link to the terminal (default: {SPI_PATH})"
    )
    can.add_argument(
        "--interface",
        default="udp_multicast",
        help="of python-can, as in a scene (default: udp_multicast, which needs msgpack)",
    )
    can.add_argument(
        "--channel", default=CAN_GROUP, help=f"of that interface (default: {CAN_GROUP})"
    )
    can.add_argument(
        "--arbitration-id",
        type=_frame_id,
        metavar="ID",
        default=0x100,
        help="of its frames (default: 0x100)",
    )
    for name, target in TARGETS.items():
        help_text = f"where to send (default: {target})"
        kinds.choices[name].add_argument("--to", default=target, help=help_text)
    for kind in (spi, can, datagrams):
        kind.add_argument(
            "--rate",
            type=within(0.001, 1000.0),
            default=100.0,
            metavar="HZ",
            help="sweeps/s (default: 100)",
        )
    for kind in (spi, can):
        kind.add_argument(
            "--sequence",
            choices=sorted(SEQUENCES),
            default="electrodes",
            help="channels that a sweep samples, as in a scene (default: electrodes)",
        )
    for kind in (spi, can, palm, datagrams):
        kind.add_argument(
            "--recording",
            type=Path,
            action="append",
            metavar="FILE",
            help="play this recording, row by row (default: synthetic grasps)",
        )
        kind.add_argument("--loop", action="store_true", help="play recordings for ever")
    for kind in (spi, can, palm, joints, datagrams):
        _add_faults(kind)


def _frame_id(text: str) -> int:
    try:
        number = int(text, 0)
    except ValueError:
        number = -1
    if not 0 <= number <= EXTENDED_ID_MAX:
        raise argparse.ArgumentTypeError(f"{text} is not an id of 0 to {EXTENDED_ID_MAX:#x}")
    return number


def _add_faults(parser: argparse.ArgumentParser) -> None:
    """Declare options for the faults; they are parsed into the names of `LinkFaults`' fields."""
    faults = parser.add_argument_group("faults, none by default; chances are per frame")
    for name, text in PROBABILITIES.items():
        faults.add_argument(
            f"--{name}",
            dest=f"{name.replace('-', '_')}_probability",
            type=float,
            default=0.0,
            metavar="P",
            help=f"chance, from 0 to 1, that {text}",
        )
    faults.add_argument(
        "--one-byte-at-a-time", action="store_true", help="write every byte on its own (spi)"
    )
    faults.add_argument(
        "--burst",
        dest="burst_frames",
        type=int,
        default=1,
        metavar="FRAMES",
        help="collect this many frames, then send them at once",
    )
    faults.add_argument(
        "--disconnect-every",
        dest="disconnect_every_frames",
        type=int,
        metavar="FRAMES",
        help="break the link in the middle of every such frame",
    )
    faults.add_argument(
        "--wrong-version", action="store_true", help="speak a later version of the protocol"
    )
    faults.add_argument(
        "--stuck-clock", action="store_true", help="the device's clock does not move"
    )
    faults.add_argument(
        "--dead",
        dest="dead_electrodes",
        action="append",
        default=[],
        metavar="ELECTRODE",
        help="reads 0 for ever, such as ff_7; may be given several times",
    )
    faults.add_argument(
        "--unplugged",
        dest="unplugged_fingers",
        action="append",
        default=[],
        choices=TABLE_FINGERS,
        help="finger whose line nothing drives; may be given several times",
    )
    faults.add_argument(
        "--seed", type=int, default=0, help="of chance: the same faults again (default: 0)"
    )


def run(args: argparse.Namespace) -> int:
    """Serve until stopped or the recording ends, print injected faults as JSON and return 0; return
    2 after an error."""
    stop = threading.Event()
    former = {number: signal.signal(number, lambda *_: stop.set()) for number in stopping()}
    try:
        injected = SERVE.get(args.kind, _serve_datagrams)(args, _faults(args), stop)
    except (DriverError, ValueError, OSError) as error:
        complain(error)
        return 2
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
    write_json({"injected": injected})
    return 0


def _counts(args: argparse.Namespace, rate_hz: float) -> Iterator[Counts]:
    if not args.recording:
        for moment in synthetic_grasps(rate_hz=rate_hz, loop=True):
            yield moment.counts
    while True:
        for path in args.recording:
            yield from recorded_counts(path)
        if not args.loop:
            return


def _faults(args: argparse.Namespace) -> LinkFaults:
    options = vars(args)
    values = {field.name: options[field.name] for field in fields(LinkFaults)}
    values["dead_electrodes"] = tuple(map(_electrode, args.dead_electrodes))
    values["unplugged_fingers"] = tuple(map(TABLE_FINGERS.index, args.unplugged_fingers))
    return LinkFaults(**values)


def _electrode(text: str) -> tuple[int, int]:
    finger, _, electrode = text.partition("_")
    if (
        finger not in TABLE_FINGERS
        or not electrode.isdecimal()
        or not 1 <= int(electrode) <= ELECTRODES
    ):
        raise ValueError(f"{text!r} is not an electrode; th_24 would be one")
    return TABLE_FINGERS.index(finger), int(electrode) - 1


def _serve_spi(
    args: argparse.Namespace, faults: LinkFaults, stop: threading.Event
) -> Mapping[str, int]:
    from graspd.drivers.twins.spi import SpiTwin

    channels = SEQUENCES[args.sequence]
    counts = _counts(args, args.rate)
    check_folder(args.path.parent)
    with SpiTwin(args.path, counts, rate_hz=args.rate, channels=channels, faults=faults) as twin:
        log.info("SPI bridge on %s", args.path)
        twin.serve(lambda: stop.is_set() or twin.exhausted)
    return twin.injected


def _serve_can(
    args: argparse.Namespace, faults: LinkFaults, stop: threading.Event
) -> Mapping[str, int]:
    from graspd.drivers.twins.can import CanTwin

    twin = CanTwin(
        args.interface,
        args.channel,
        _counts(args, args.rate),
        arbitration_id=args.arbitration_id,
        sequence=args.sequence,
        rate_hz=args.rate,
        faults=faults,
    )
    with twin:
        log.info("CAN board on %s %s", args.interface, args.channel)
        twin.serve(stop)
    return twin.injected


def _serve_datagrams(
    args: argparse.Namespace, faults: LinkFaults, stop: threading.Event
) -> Mapping[str, int]:
    from graspd.drivers.twins.datagrams import DatagramTwin, JointTwin, PalmTwin, TactileTwin

    twin: DatagramTwin
    if args.kind == "palm":
        twin = PalmTwin(_counts(args, PALM_RATE_HZ), faults=faults)
    elif args.kind == "datagrams":
        twin = TactileTwin(_counts(args, args.rate), rate_hz=args.rate, faults=faults)
    else:
        twin = JointTwin(faults=faults)
    log.info("%s to %s", args.kind, args.to)
    twin.serve(args.to, stop)
    return twin.injected


SERVE = {"spi": _serve_spi, "can": _serve_can}
"""Function that runs the twin of each kind; all other kinds send datagrams."""
