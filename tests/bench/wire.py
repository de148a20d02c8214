"""Measure a sweep's time from the serial line to a subscriber, by a daemon and by a mere echo.

`python -m tests.bench.wire` prints it for several hands at 100 Hz, each with its own twin, on an
idle computer and beside a busy process for each core. Daemons and echoes take turns. An echo reads
the same line and publishes its bytes as they come. The run takes twelve minutes, `--quick` one
minute, and needs the extra `train`.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Literal

import numpy as np
import zmq
from numpy.typing import NDArray

from graspd.drivers.spi.messages import DIGEST, FrameParser, Message, Start, Sweep, decode, encode
from graspd.drivers.twins.grasps.whole_grasps import RATE_HZ, synthetic_grasps
from graspd.drivers.twins.spi import SpiTwin
from graspd.models.training.evaluating.files import markdown_table
from graspd.models.training.reports.machine import described, machine
from tests.bench.live import (
    PATIENCE_S,
    STOP_S,
    Child,
    end_children_at_sigterm,
    running,
    spi_section,
)
from tests.kit.messages import decode_verdict
from tests.kit.waiting import wait_until

Way = Literal["echo", "daemon"]
WAYS: tuple[Way, ...] = ("echo", "daemon")
HANDS, QUICK_HANDS = (1, 2, 4, 8), (2,)
ROUNDS, QUICK_ROUNDS = 3, 1
SECONDS, QUICK_SECONDS = 10.0, 3.0
"""Time that is measured in each turn, s."""
WARM_UP = 50
"""Messages of each hand before the measurement begins."""
READ_BYTES = 4096
QUANTILES = (0.5, 0.99, 0.999)
BUSY = "while True: pass"
TITLES = ("hands", "load", "way", "sweeps", "p50, us", "p99, us", "p99.9, us")

Heard = list[tuple[int, bytes]]
"""Time at which each message came, monotonic ns, and its payload."""
Written = NDArray[np.int64]
"""Shape (sweeps, 3): the bridge's tick at a sweep's end, when that was and when the twin wrote the
bytes, both monotonic ns."""


class WireTwin(SpiTwin):
    """SPI twin that notes when it writes each sweep."""

    def __init__(self, path: Path) -> None:
        counts = (moment.counts for moment in synthetic_grasps(rate_hz=RATE_HZ, loop=True))
        super().__init__(path, counts, rate_hz=RATE_HZ)
        self.written: list[tuple[int, int, int]] = []

    def _send(self, message: Message, *, waits: bool = True) -> None:
        if isinstance(message, Sweep):
            end_ns = self._boot_ns + message.tick_end * 1000  # ticks of 1 us
            self.written.append((message.tick_end, end_ns, time.monotonic_ns()))
        super()._send(message, waits=waits)


def serve_twin(folder: Path) -> None:
    """Run a twin at `bridge` in `folder` until SIGTERM; then save `written.npy` there."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda _number, _frame: stop.set())
    with WireTwin(folder / "bridge") as twin:
        twin.serve(stop.is_set)
    np.save(folder / "written.npy", np.array(twin.written, np.int64))


def serve_echo(folder: Path) -> None:
    """Start the twin's sweeps, and publish the bytes from its line until the twin has gone."""
    line = os.open(folder / "bridge", os.O_RDWR | os.O_NOCTTY)
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        socket.bind(f"ipc://{folder}/v")
        os.write(line, encode(Start()))
        with suppress(OSError):
            while data := os.read(line, READ_BYTES):
                socket.send_multipart([f"verdict.{folder.name}".encode(), data])


def own(what: str, folder: Path) -> Child:
    """Start a process of this module: `what` is `twin` or `echo`."""
    return Child([sys.executable, "-m", "tests.bench.wire", what, str(folder)])


def turn(way: Way, hands: int, seconds: float) -> list[int]:
    """Measure `hands` hands for `seconds`, each with an echo or a daemon, as `way` says.

    Return each sweep's time from line to subscriber, of all hands, ns.
    """
    with tempfile.TemporaryDirectory() as root, ExitStack() as stack:
        folders = [Path(root) / f"hand{hand}" for hand in range(hands)]
        twins = []
        for folder in folders:
            folder.mkdir()
            twins.append(stack.enter_context(own("twin", folder)))
            wait_until((folder / "bridge").exists)
            if way == "echo":
                stack.enter_context(own("echo", folder))
            else:
                sections = f'[hand]\nname = "{folder.name}"\n{spi_section(folder)}'
                stack.enter_context(running(folder, sections, topics=()))
        heard = listen([f"ipc://{folder}/v" for folder in folders], seconds)
        for twin in twins:
            twin.terminate()
        for twin in twins:
            twin.wait(STOP_S)
        times = (
            times_of(way, messages, np.load(Path(root) / name / "written.npy"))
            for name, messages in heard.items()
        )
        return list(itertools.chain.from_iterable(times))


def listen(endpoints: Sequence[str], seconds: float) -> Mapping[str, Heard]:
    """Return the messages of `seconds` by hand, from when all hands have sent `WARM_UP`.
    Raises `TimeoutError` if one never does."""
    heard: dict[str, Heard] = {}
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.rcvhwm = 0
        socket.subscribe("verdict.")
        for endpoint in endpoints:
            socket.connect(endpoint)
        until_s, is_warm = time.monotonic() + PATIENCE_S, False
        while (left_s := until_s - time.monotonic()) > 0.0:
            if socket.poll(round(left_s * 1000)):
                topic, payload = socket.recv_multipart()
                name = topic.decode().removeprefix("verdict.")
                heard.setdefault(name, []).append((time.monotonic_ns(), payload))
            numbers = [len(each) for each in heard.values()]
            if not is_warm and len(numbers) == len(endpoints) and min(numbers) >= WARM_UP:
                is_warm, until_s = True, time.monotonic() + seconds
                heard.clear()
    if not is_warm:
        raise TimeoutError(f"too few messages, of {len(heard)} of {len(endpoints)} hands")
    return heard


def times_of(way: Way, heard: Heard, written: Written) -> Iterator[int]:
    """Yield the time of each sweep of a hand from its line to its first message, ns.

    `heard`: messages of the hand, made by a daemon or an echo, as `way` says. `written`: when its
    twin wrote the sweeps.
    """
    ticks, ends_ns, written_ns = written.T
    parser, known = FrameParser(DIGEST), set[int]()
    for received_ns, payload in heard:
        if way == "daemon":
            # The daemon knows the time of a sweep to two milliseconds, of ten.
            t_ns = decode_verdict(payload).t_mono_ns
            places = [int(np.abs(ends_ns - t_ns).argmin())]
        else:
            messages = (decode(*frame) for frame in parser.feed(payload))
            sweeps = [each for each in messages if isinstance(each, Sweep)]
            places = [int(np.searchsorted(ticks, sweep.tick_end)) for sweep in sweeps]
        for place in set(places) - known:  # a verdict may come again
            yield received_ns - int(written_ns[place])
        known.update(places)


def main() -> int:
    """Measure all combinations of hands, load and way, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.wire", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="does it run?")
    quick = parser.parse_args().quick
    end_children_at_sigterm()
    hands_of, rounds = (QUICK_HANDS, QUICK_ROUNDS) if quick else (HANDS, ROUNDS)
    seconds, cores = QUICK_SECONDS if quick else SECONDS, os.cpu_count() or 1
    rows = []
    for hands, load in itertools.product(hands_of, ("idle", "loaded")):
        times: dict[Way, list[int]] = {way: [] for way in WAYS}
        with ExitStack() as stack:
            for _ in range(cores if load == "loaded" else 0):
                stack.enter_context(Child([sys.executable, "-c", BUSY]))
            for _, way in itertools.product(range(rounds), WAYS):
                times[way] += turn(way, hands, seconds)
        for way in WAYS:
            spread = np.quantile(times[way], QUANTILES) / 1000.0
            number = str(len(times[way]))
            rows.append((str(hands), load, way, number, *(f"{value:.0f}" for value in spread)))
    made = "quick, the figures mean nothing" if quick else f"{rounds} turns of {seconds:g} s"
    lines = markdown_table(TITLES, rows, right=TITLES[3:])
    sys.stdout.write("\n".join((*lines, "", f"{described(machine())}; {made}")) + "\n")
    return 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["twin"]:
        serve_twin(Path(sys.argv[2]))
    elif sys.argv[1:2] == ["echo"]:
        serve_echo(Path(sys.argv[2]))
    else:
        sys.exit(main())
