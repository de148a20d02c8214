"""Files made to break who reads them: scenes, models, recordings; and browsers that never finish.

Each goes to a real process: a daemon at SIGHUP, `graspd check`, `graspd replay`, `graspd watch`.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

from drivers.recordings.csv_player import DEMO_RECORDING
from models import zoo
from tests.bench.attacks.attack import Aim, Attack, Outcome, Plan
from tests.bench.live import PATIENCE_S, Child, Subscriber, start_daemon, usage
from tests.threads import at_work

MIB = 1024
"""KiB."""
GROWTH_MAX_MIB = 32
"""Memory that no file may cost a running daemon for good, or a refused scene ever, MiB."""
GAP_MAX_S = 0.5
"""Between two verdicts while a scene is read, s: readings come every 10 ms, shared computers
stall."""
SWAP_MAX_S = 1.5
"""Between two verdicts where another scene has taken over, s: its driver begins anew."""
END_MAX_S = 15.0
"""Until a command must have refused a file, s: a model is tried for ten."""
STOP_MAX_S = 2.0
"""Until a daemon that was told to stop is gone, s."""
REPLAY_MAX_MIB = 256
"""Memory of a replay; one of a sound recording of minutes takes half of it."""

REFUSED = "the new scene is wrong, the former one goes on"

SCENE = """
[tactile]
driver = "replay"
recordings = ["{recording}"]
loop = true
[model]
{model}
[publish]
endpoint = "ipc://{folder}/v"
"""


def scene(folder: Path, model: str = 'name = "small-session"') -> str:
    """A scene whose readings never end."""
    return SCENE.format(recording=DEMO_RECORDING, model=model, folder=folder)


def _peak_mib(pid: int) -> float:
    """Most memory that a process has had; 0 of one that has ended."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int((status.partition("VmHWM:")[2].split() or ["0"])[0]) / MIB


DOTTED: dict[str, Callable[[int], str]] = {
    "a key of dots": lambda size: ".".join(["a"] * (size // 2)) + " = 1",
    "a header of dots": lambda size: "[" + ".".join(["a"] * (size // 2)) + "]",
    "quoted dots": lambda size: " . ".join(['"a"'] * (size // 6)) + " = 1",
    "many keys of dots": lambda size: "\n".join(
        ".".join([f"k{number}", *["a"] * 240]) + " = 1" for number in range(size // 490)
    ),
    "arrays": lambda size: "a = " + "[" * (size // 2) + "]" * (size // 2),
    "inline tables": lambda size: "a = " + "{a=" * (size // 4) + "1" + "}" * (size // 4),
    "dots in an inline table": lambda size: "a = {" + ".".join(["a"] * (size // 2)) + " = 1}",
}
"""Ways to nest, by name: TOML of about so many bytes."""
SIZES = (32_000, 48_000, 96_000)


@dataclass(slots=True)
class Reloaded:
    """What happened at a SIGHUP."""

    alive: bool
    told: str
    """What the daemon told the service manager became of it; nothing if it did not in time."""
    gap_s: float
    """Longest time without a verdict."""


class Running:
    """A daemon on `folder`'s scene, with a service manager and somebody who hears its verdicts."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.scene = folder / "scene.toml"
        self.log = folder / "log"
        self.scene.write_text(scene(folder))

    def __enter__(self) -> Running:
        with contextlib.ExitStack() as stack:
            self.manager = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
            self.manager.bind(str(self.folder / "notify"))
            stack.callback((self.folder / "notify").unlink)
            self.manager.setblocking(False)
            with (  # in the folder, where weights of other files would be looked for
                contextlib.chdir(self.folder),
                patch.dict(os.environ, NOTIFY_SOCKET=str(self.folder / "notify")),
            ):
                self.daemon: Child = stack.enter_context(start_daemon(self.scene, self.log))
            self.ears = stack.enter_context(Subscriber(f"ipc://{self.folder}/v"))
            if self.ears.take(PATIENCE_S) is None:
                raise TimeoutError("no verdict at the start")
            self.hear(1.0)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_details: object) -> None:
        self._stack.close()

    @property
    def alive(self) -> bool:
        return self.daemon.process.poll() is None

    def hear(self, seconds: float, until: Callable[[], bool] = lambda: False) -> float:
        """The longest time without a verdict, s, from now until so long or `until`."""
        began_ns = last_ns = time.monotonic_ns()
        longest_ns = 0
        while self.alive and (now_ns := time.monotonic_ns()) < began_ns + seconds * 1e9:
            if until():
                break
            if self.ears.take(0.05) is not None:
                now_ns = self.ears.received_ns
                longest_ns, last_ns = max(longest_ns, now_ns - last_ns), now_ns
        return max(longest_ns, time.monotonic_ns() - last_ns) / 1e9

    def told(self) -> str:
        """What the manager was told to be the end of a reload, since the last call."""
        with contextlib.suppress(BlockingIOError):
            while True:
                ready, _, status = self.manager.recv(4096).decode().partition("\nSTATUS=")
                if ready == "READY=1":
                    return status.partition("\n")[0]
        return ""

    def reload(self, text: str, patience_s: float = END_MAX_S) -> Reloaded:
        """Put a scene in the place of the former one and tell the daemon."""
        self.scene.write_text(text)
        said: list[str] = []

        def is_told() -> bool:
            said.extend(filter(None, [self.told()]))
            return bool(said)

        while self.told():
            pass  # of former reloads
        self.daemon.process.send_signal(signal.SIGHUP)
        gap_s = self.hear(patience_s, is_told)
        gap_s = max(gap_s, self.hear(0.3))
        return Reloaded(self.alive, "".join(said), gap_s)

    def rss_mib(self) -> float:
        return usage(self.daemon.pid).rss_kib / MIB if self.alive else 0.0

    def forget_peak(self) -> None:
        Path(f"/proc/{self.daemon.pid}/clear_refs").write_text("5")

    def peak_mib(self) -> float:
        """Most memory since `forget_peak`."""
        return _peak_mib(self.daemon.pid) if self.alive else 0.0

    def stops_in_s(self) -> float:
        """How long it takes from SIGTERM to its end, s; it is killed after five."""
        began_s = time.monotonic()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.daemon.terminate()
        return time.monotonic() - began_s


def _dotted(plan: Plan) -> Outcome:
    tried, gap_s, growth_mib, held = 0, 0.0, 0.0, True
    ways = [(way, size) for size in SIZES for way in DOTTED]
    with Running(plan.folder) as running:
        rest_mib = running.rss_mib()
        end_s = time.monotonic() + max(plan.seconds, 1.0)
        for way, size in itertools.cycle(ways):
            running.forget_peak()
            found = running.reload(DOTTED[way](size) + "\n" + scene(plan.folder))
            tried += 1
            gap_s = max(gap_s, found.gap_s)
            growth_mib = max(growth_mib, running.peak_mib() - rest_mib)
            fits = found.gap_s < GAP_MAX_S and growth_mib < GROWTH_MAX_MIB
            held = held and found.alive and found.told == REFUSED and fits
            if not found.alive:
                return Outcome(tried, f"the daemon is gone after {way}, {size} bytes", False)
            if tried >= len(ways) and time.monotonic() > end_s:
                break
        held = held and running.stops_in_s() < STOP_MAX_S
    happened = (
        f"longest gap in the verdicts {gap_s * 1e3:.0f} ms, memory at most +{growth_mib:.0f} MiB"
    )
    return Outcome(tried, happened, held)


def _storm(plan: Plan) -> Outcome:
    sent, gap_s = 0, 0.0
    with Running(plan.folder) as running:
        running.hear(3.0)  # all that it needs it has by then
        rest_mib = running.rss_mib()

        def hang_up(stop: threading.Event) -> None:
            nonlocal sent
            while not stop.wait(0.0005):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(running.daemon.pid, signal.SIGHUP)
                sent += 1

        with at_work(hang_up):
            gap_s = running.hear(max(plan.seconds, 8.0))
        growth_mib = running.rss_mib() - rest_mib
        running.hear(2.0)  # the last one was late
        other = running.reload(scene(plan.folder, 'name = "mlp"'))
        stops_s = running.stops_in_s()
    taken = other.alive and other.told.endswith("mlp")
    held = taken and gap_s < SWAP_MAX_S and growth_mib < GROWTH_MAX_MIB
    happened = (
        f"memory {growth_mib:+.0f} MiB, longest gap in the verdicts {gap_s * 1e3:.0f} ms, "
        f"ends {stops_s:.1f} s after SIGTERM"
    )
    return Outcome(sent, happened, held and stops_s < STOP_MAX_S)


def _zoo_model() -> Any:  # noqa: ANN401 - onnx has no types
    import onnx

    return onnx.load(zoo.find("small-session"))


def external(folder: Path) -> Path:
    """A zoo model whose weights are in a file beside it, which may be changed under its sha."""
    import onnx

    model, path = _zoo_model(), folder / "external.onnx"
    onnx.save_model(
        model, path, save_as_external_data=True, location="weights.bin", size_threshold=1024
    )
    return path


def endless(folder: Path) -> Path:
    """A zoo model that counts for ever before it answers."""
    import onnx
    from onnx import TensorProto, helper

    model, path = _zoo_model(), folder / "endless.onnx"
    graph = model.graph
    node = next(node for node in graph.node if "probability" in node.output)
    node.output[0] = "sound"
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go"], ["go_on"]),
            helper.make_node("Add", ["x", "nothing"], ["y"]),
        ],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            helper.make_tensor_value_info("x", TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("go_on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("y", TensorProto.FLOAT, None),
        ],
        [helper.make_tensor("nothing", TensorProto.FLOAT, [], [0.0])],
    )
    graph.initializer.append(helper.make_tensor("ever", TensorProto.INT64, [], [2**62]))
    graph.initializer.append(helper.make_tensor("yes", TensorProto.BOOL, [], [True]))
    loop = helper.make_node("Loop", ["ever", "yes", "sound"], ["probability"], body=body)
    graph.node.append(loop)
    onnx.save_model(model, path)
    return path


def giant(folder: Path, side: int = 5000) -> Path:
    """A zoo model of a few bytes more that multiplies matrices of so many rows for minutes."""
    import onnx
    from onnx import TensorProto, helper

    model, path = _zoo_model(), folder / "giant.onnx"
    graph = model.graph
    node = next(node for node in graph.node if "probability" in node.output)
    node.output[0] = "sound"
    graph.initializer.append(helper.make_tensor("sides", TensorProto.INT64, [2], [side, side]))
    graph.initializer.append(helper.make_tensor("none", TensorProto.FLOAT, [], [0.0]))
    graph.node.append(helper.make_node("ReduceSum", ["sound"], ["sum"], keepdims=0))
    graph.node.append(helper.make_node("Mul", ["sum", "none"], ["zero"]))
    graph.node.append(helper.make_node("Expand", ["zero", "sides"], ["m0"]))
    for number in range(40):
        graph.node.append(
            helper.make_node("MatMul", [f"m{number}", f"m{number}"], [f"m{number + 1}"])
        )
    graph.node.append(helper.make_node("ReduceSum", ["m40"], ["nothing"], keepdims=0))
    graph.node.append(helper.make_node("Add", ["sound", "nothing"], ["probability"]))
    onnx.save_model(model, path)
    return path


def _command(folder: Path, *arguments: object) -> tuple[int | None, float, float, str]:
    """Exit code (None if it had to be killed), seconds, peak MiB, stderr."""
    began_s = time.monotonic()
    with (folder / "said").open("w+") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "daemon", *map(str, arguments)],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=said,
        )
        ended, peak_mib = False, 0.0
        while not ended and time.monotonic() < began_s + 2 * END_MAX_S:
            peak_mib = max(peak_mib, _peak_mib(process.pid))
            time.sleep(0.02)
            ended = process.poll() is not None
        process.kill()
        process.wait()
        said.seek(0)
        text = said.read()
    code = process.returncode if ended else None
    return code, time.monotonic() - began_s, peak_mib, text


def _model(make: Callable[[Path], Path]) -> Callable[[Plan], Outcome]:
    def run(plan: Plan) -> Outcome:
        path = make(plan.folder)
        wanted = scene(plan.folder, f'path = "{path}"')
        tried, slowest_s, gap_s, held = 0, 0.0, 0.0, True
        for _ in plan.rounds():
            tried += 2
            checked = plan.folder / "checked.toml"
            checked.write_text(wanted)
            code, seconds, _, said = _command(plan.folder, "check", checked)
            slowest_s = max(slowest_s, seconds)
            held = held and code == 2 and str(path) in said and seconds < END_MAX_S
            with Running(plan.folder) as running:
                found = running.reload(wanted)
                refused = found.told == REFUSED
                gap_s = max(gap_s, found.gap_s)
                held = held and found.alive and refused and found.gap_s < GAP_MAX_S
                running.scene.write_text(wanted)
                running.daemon.process.send_signal(signal.SIGHUP)
                running.hear(0.5)  # SIGTERM comes while it is read
                stops_s = running.stops_in_s()
                held = held and stops_s < STOP_MAX_S
        happened = (
            f"check ends after {slowest_s:.1f} s with {code}, the reload is "
            f"{'refused' if refused else 'not refused'}, longest gap in the verdicts "
            f"{gap_s * 1e3:.0f} ms, ends {stops_s:.1f} s after SIGTERM"
        )
        return Outcome(tried, happened, held)

    return run


def _mcap(chunks: Iterator[tuple[str, int, bytes]]) -> Iterator[bytes]:
    """A recording of graspd with chunks as (compression, size that is said, bytes as they are)."""
    from io import BytesIO

    from mcap.data_stream import RecordBuilder
    from mcap.records import Chunk
    from mcap.writer import Writer

    from daemon.record.header import RecordingHeader
    from daemon.record.mcap import METADATA

    stream = BytesIO()
    writer = Writer(stream)
    writer.start(profile="", library="graspd")
    header = RecordingHeader(
        fingers=("ff", "mf", "th"),
        joints=False,
        boot_id="0" * 32,
        scene={"hand": {}},
        model="cnn1",
        model_sha256="0" * 64,
    )
    writer.add_metadata(METADATA, header.texts())
    writer.flush()
    yield stream.getvalue()
    for compression, size, data in chunks:
        builder = RecordBuilder()
        Chunk(compression, data, 0, 0, 0, size).write(builder)
        yield builder.end()


def _messages(size: int) -> bytes:
    """So many bytes of the smallest messages."""
    import struct

    message = struct.pack("<BQHIQQ", 5, 22 + 2, 1, 0, 0, 0) + b"{}"
    return message * (size // len(message))


def _bombs() -> dict[str, Callable[[], list[tuple[str, int, bytes]]]]:
    import lz4.frame
    import zstandard

    def zstd(size: int) -> bytes:
        return zstandard.ZstdCompressor(level=19).compress(_messages(size))

    def unsized(size: int) -> bytes:
        packer = zstandard.ZstdCompressor(level=19, write_content_size=False).compressobj()
        return packer.compress(_messages(size)) + packer.flush()

    big, chunk = 96 << 20, 1 << 20
    return {
        "one large chunk": lambda: [("zstd", big, zstd(big))],
        "a chunk larger than it says": lambda: [("zstd", chunk, zstd(big))],
        "a chunk that does not say": lambda: [("zstd", big, unsized(big))],
        "lz4": lambda: [("lz4", chunk, lz4.frame.compress(_messages(big)))],
        "many chunks": lambda: [("zstd", len(_messages(chunk)), zstd(chunk))] * 90,
    }


def _bomb(plan: Plan) -> Outcome:
    tried, slowest_s, most_mib, largest, held = 0, 0.0, 0.0, 0, True
    path = plan.folder / "bomb.mcap"
    for _ in plan.rounds():
        for make in _bombs().values():
            path.write_bytes(b"".join(_mcap(iter(make()))))
            largest = max(largest, path.stat().st_size)
            code, seconds, mib, said = _command(plan.folder, "replay", path)
            tried += 1
            slowest_s, most_mib = max(slowest_s, seconds), max(most_mib, mib)
            refused = code == 2 and "bomb.mcap" in said and "Traceback" not in said
            held = held and refused and seconds < END_MAX_S and mib < REPLAY_MAX_MIB
    happened = f"refused after {slowest_s:.1f} s and {most_mib:.0f} MiB at most"
    if not held:
        happened = f"up to {slowest_s:.1f} s and {most_mib:.0f} MiB"
    return Outcome(tried, f"{happened} (largest file {largest // 1000} kB)", held)


class _Slow:
    """Connections that send a byte of their request every second, and come again when cut off."""

    def __init__(self, port: int, number: int, sent: bytes, buffer_bytes: int | None) -> None:
        self._port, self._number = port, number
        self._sent, self._buffer_bytes = sent, buffer_bytes
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._go)
        self.opened = 0

    def __enter__(self) -> _Slow:
        self._thread.start()
        return self

    def __exit__(self, *_details: object) -> None:
        self._stop.set()
        self._thread.join()

    def _connect(self) -> socket.socket:
        link = socket.socket()
        if self._buffer_bytes is not None:
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._buffer_bytes)
        link.connect(("127.0.0.1", self._port))
        link.sendall(self._sent)
        self.opened += 1
        return link

    def _go(self) -> None:
        links: list[socket.socket] = []
        while not self._stop.wait(1.0 if links else 0.0):
            still = []
            for link in links:
                try:
                    link.sendall(b"a")
                    still.append(link)
                except OSError:
                    link.close()
            with contextlib.suppress(OSError):
                while len(still) < self._number:
                    still.append(self._connect())
            links = still
        for link in links:
            link.close()


def _get_s(port: int) -> float:
    """How long it takes until the page is there, s; raises `OSError` if it is not."""
    began_s = time.monotonic()
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as link:
        link.settimeout(PATIENCE_S)
        link.sendall(b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n")
        answer = link.makefile("rb").read()
    if not answer.startswith(b"HTTP/1.0 200") or b"</html>" not in answer:
        raise OSError("no page")
    return time.monotonic() - began_s


def _slowloris(
    sent: bytes, number: int, buffer_bytes: int | None = None
) -> Callable[[Plan], Outcome]:
    def run(plan: Plan) -> Outcome:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        asked = unserved = 0
        slowest_s = 0.0
        page = ["-m", "daemon", "watch", "--web", "--port", str(port)]
        with Child([*page, "--connect", f"ipc://{plan.folder}/v"]) as child:
            child.line()
            with _Slow(port, number, sent, buffer_bytes) as slow:
                time.sleep(2.0)
                end_s = time.monotonic() + max(plan.seconds, 8.0)
                while time.monotonic() < end_s:
                    asked += 1
                    try:
                        slowest_s = max(slowest_s, _get_s(port))
                    except OSError:
                        unserved += 1
                    time.sleep(0.2)
        happened = f"{unserved} of {asked} visitors not served, the slowest after {slowest_s:.2f} s"
        return Outcome(slow.opened, happened, unserved == 0 and slowest_s < 1.0)

    return run


ATTACKS = (
    Attack(
        "scene-nested",
        Aim.FALLS,
        "SIGHUP with scenes of 32 to 96 kB that nest: dotted keys, arrays, inline tables",
        "scenes",
        _dotted,
    ),
    Attack("sighup-storm", Aim.FALLS, "SIGHUP every half millisecond", "signals", _storm),
    Attack(
        "model-external",
        Aim.FALSE_STABLE,
        "a model whose weights are in another file, to check and at SIGHUP",
        "models",
        _model(external),
    ),
    Attack(
        "model-endless",
        Aim.FALLS,
        "a model with a loop without end, to check and at SIGHUP",
        "models",
        _model(endless),
    ),
    Attack(
        "model-giant",
        Aim.FALLS,
        "a model that multiplies matrices for minutes, to check and at SIGHUP",
        "models",
        _model(giant),
    ),
    Attack(
        "recording-bomb",
        Aim.FALLS,
        "replay of small MCAP files that unpack to hundreds of megabytes",
        "recordings",
        _bomb,
    ),
    Attack(
        "page-slow-head",
        Aim.FALLS,
        "20 connections to the page that send a byte of their request a second",
        "connections",
        _slowloris(b"GET / HTTP/1.0\r\nX: ", 20),
    ),
    Attack(
        "page-slow-reader",
        Aim.FALLS,
        "20 connections to the page that ask for it and do not read",
        "connections",
        _slowloris(b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n", 20, 1024),
    ),
)
