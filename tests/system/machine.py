"""A machine emulated by QEMU: starts it, runs commands in it, unplugs its USB adapter."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import socket
import subprocess
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

from tests.system.image import Image
from tests.system.messages import Messages

RETRY_S: Final = 0.1
RECEIVE_BYTES: Final = 65536
MEMORY_MIB: Final = 1536
CPUS: Final = 2
START_TIMEOUT_S: Final = 60.0
BOOT_TIMEOUT_S: Final = 900.0
"""Longest boot, s. It takes 18 s on an idle host, 220 s with a tenth of a processor."""
CONSOLE_BYTES: Final = 2000
"""Bytes of the console's end that an error shows at most."""
ANSWER_TIMEOUT_S: Final = 200.0
"""Longest wait, s, for an answer of QEMU or of the guest agent, which may be busy."""
COMMAND_TIMEOUT_S: Final = 600.0
SYNCHRONISE_S: Final = 5.0
"""Time after which the agent is asked again, s: while it starts it loses requests."""
POLL_S: Final = (0.05, 0.1, 0.2, 0.5)
"""Waits before the first checks that a command has ended, s; the last one repeats."""
AGENT_PORT: Final = "org.qemu.guest_agent.0"
KERNEL_OPTIONS: Final = "mitigations=off no_timer_check"
"""Options of the kernel: without its test of the timer, which may fail on a busy host."""
MESSAGE_PORT: Final = "graspd.messages"
"""Name of the virtio port to which the guest writes what its subscriber receives."""
ENVIRONMENT: Final = (
    "PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
    "LC_ALL=C.UTF-8",
    "HOME=/root",
)


class MachineError(Exception):
    """The emulated machine did not boot, run a command or answer in time; the message says what."""


class ProtocolError(MachineError):
    """The other side refused a request, answered too late, or has gone."""


class JsonLines:
    """Requests and answers as JSON, one per line, over a Unix socket: QMP and the guest agent."""

    def __init__(self, path: Path, timeout_s: float) -> None:
        """Connect to the socket, retrying for `timeout_s`. Raises `ProtocolError` if it cannot."""
        self._name = path.name
        self._rest = b""
        deadline_s = time.monotonic() + timeout_s
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        while True:
            try:
                self._socket.connect(str(path))
            except (FileNotFoundError, ConnectionRefusedError) as error:
                if time.monotonic() > deadline_s:
                    self._socket.close()
                    raise ProtocolError(f"{self._name}: its socket has no listener") from error
                time.sleep(RETRY_S)
            else:
                return

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def request(self, execute: str, timeout_s: float, **arguments: object) -> Any:  # noqa: ANN401
        """Send the request `execute` with `arguments`; return the value of the answer.

        Raises `ProtocolError` if it is refused, late or cannot be sent.
        """
        message = {"execute": execute, "arguments": arguments}
        try:
            self._socket.sendall(json.dumps(message).encode() + b"\n")
        except OSError as error:
            raise ProtocolError(f"{self._name}: {error.strerror}") from error
        deadline_s = time.monotonic() + timeout_s
        while True:
            answer = self.receive(deadline_s)
            if "error" in answer:
                raise ProtocolError(f"{self._name}: {execute}: {answer['error'].get('desc')}")
            if "return" in answer:
                return answer["return"]

    def receive(self, deadline_s: float) -> dict[str, Any]:
        """Return the next JSON object. Raises `ProtocolError` if none comes by `deadline_s`."""
        while b"\n" not in self._rest:
            self._socket.settimeout(max(deadline_s - time.monotonic(), 0.001))
            try:
                chunk = self._socket.recv(RECEIVE_BYTES)
            except OSError as error:
                raise ProtocolError(f"{self._name}: no answer ({error})") from error
            if not chunk:
                raise ProtocolError(f"{self._name}: hung up")
            self._rest += chunk
        line, self._rest = self._rest.split(b"\n", 1)
        # After a synchronisation the agent's answer begins with a byte that is not JSON.
        try:
            decoded: dict[str, Any] = json.loads(line.lstrip(b"\xff"))
        except ValueError as error:
            raise ProtocolError(f"{self._name}: not JSON: {line[:80]!r}") from error
        return decoded


@dataclass(frozen=True, slots=True)
class Done:
    """Result of a command that has ended."""

    code: int
    """Exit code; 128 and the signal's number if a signal ended it."""
    out: str
    err: str


class Machine:
    """A machine that QEMU emulates during its `with` block; changes to its disk are discarded."""

    def __init__(self, image: Image, payload: Path, serial: Path, folder: Path) -> None:
        """`payload`: image of a second disk. `serial`: terminal of the host, where the USB adapter
        leads. `folder`: for sockets and the console's log."""
        self.messages = Messages()
        self.console = folder / "console.log"
        self._image, self._payload, self._serial = image, payload, serial
        self._folder = folder
        self._number = 0
        self._in_step = False
        """True if the agent has answered all requests; False: a late answer may still come."""
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._qemu = stack.enter_context(
                subprocess.Popen(
                    self._command(), stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
                )
            )
            stack.callback(self._qemu.kill)
            try:
                self._qmp = JsonLines(self._folder / "qmp", START_TIMEOUT_S)
                stack.callback(self._qmp.close)
                self._qmp.request("qmp_capabilities", ANSWER_TIMEOUT_S)
                self._agent = JsonLines(self._folder / "agent", START_TIMEOUT_S)
            except ProtocolError as error:
                raise MachineError(f"QEMU does not start: {self._complaint()}") from error
            stack.callback(self._agent.close)
            stack.enter_context(self.messages.listening(self._folder / "messages"))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_details: object) -> None:
        self._stack.close()

    def wait_for_agent(self) -> None:
        """Wait until commands can be run. Raises `MachineError` if the machine does not boot."""
        deadline_s = time.monotonic() + BOOT_TIMEOUT_S
        while time.monotonic() < deadline_s:
            with contextlib.suppress(ProtocolError):
                return self._synchronise()
            if self._qemu.poll() is not None:
                raise MachineError(f"QEMU has ended: {self._complaint()}")
        said = self.console.read_text(errors="replace")[-CONSOLE_BYTES:]
        raise MachineError(
            f"the machine has not booted in {BOOT_TIMEOUT_S:g} s: {said or 'silent'}"
        )

    def _synchronise(self) -> None:
        """Have the agent repeat a number, and drop the answers before it, which are stale."""
        self._number += 1
        deadline_s = time.monotonic() + SYNCHRONISE_S
        answer = self._agent.request("guest-sync", SYNCHRONISE_S, id=self._number)
        while answer != self._number:
            answer = self._agent.receive(deadline_s).get("return")
        self._in_step = True

    def run(self, script: str, timeout_s: float = COMMAND_TIMEOUT_S) -> Done:
        """Run a shell script in the machine, as root. Raises `MachineError` if it does not end in
        `timeout_s`."""
        deadline_s = time.monotonic() + timeout_s
        pid = self._begin(script)
        for look in range(1_000_000):
            time.sleep(POLL_S[min(look, len(POLL_S) - 1)])
            status = self._ask("guest-exec-status", pid=pid)
            if status["exited"]:
                return _done(status)
            if time.monotonic() > deadline_s:
                break
        raise MachineError(f"no end after {timeout_s:g} s: {script}")

    def unplug(self) -> None:
        """Pull the USB serial adapter."""
        self._qmp.request("device_del", ANSWER_TIMEOUT_S, id="adapter")

    def plug(self) -> None:
        """Put the USB serial adapter back."""
        self._qmp.request(
            "device_add",
            ANSWER_TIMEOUT_S,
            driver="usb-serial",
            id="adapter",
            chardev="bridge",
            bus="usb.0",
            serial=ADAPTER_SERIAL,
        )

    def _begin(self, script: str) -> int:
        """Begin a shell script in the machine; return its process id there."""
        if not self._in_step:
            self.wait_for_agent()
        started = self._ask(
            "guest-exec",
            path="/bin/sh",
            arg=["-c", script],
            env=list(ENVIRONMENT),
            **{"capture-output": True},
        )
        return int(started["pid"])

    def _ask(self, execute: str, **arguments: object) -> Any:  # noqa: ANN401
        try:
            return self._agent.request(execute, ANSWER_TIMEOUT_S, **arguments)
        except ProtocolError as error:
            self._in_step = False
            if self._qemu.poll() is not None:
                raise MachineError(f"QEMU has ended: {self._complaint()}") from error
            raise MachineError(str(error)) from error

    def _complaint(self) -> str:
        self._qemu.kill()
        return self._qemu.communicate()[1].strip()

    def _command(self) -> list[str]:
        words = [
            *("setpriv", "--pdeathsig", "KILL"),  # QEMU must not outlive this process
            "qemu-system-x86_64",
            # What later processors can is emulated too, and costs a fifth more.
            *("-accel", "tcg,thread=multi", "-machine", "q35", "-cpu", "Nehalem"),
            *("-smp", str(CPUS), "-m", str(MEMORY_MIB)),
            *("-nodefaults", "-no-user-config", "-display", "none", "-nic", "none"),
            *("-kernel", str(self._image.kernel), "-initrd", str(self._image.initrd)),
            *("-append", f"root=/dev/vda rw console=ttyS0 quiet loglevel=4 {KERNEL_OPTIONS}"),
            *("-drive", f"file={self._image.disk},if=virtio,format=raw,snapshot=on,cache=unsafe"),
            *("-drive", f"file={self._payload},if=virtio,format=raw,read-only=on"),
            *("-serial", f"file:{self.console}"),
            *("-chardev", f"socket,id=qmp,path={self._folder}/qmp,server=on,wait=off"),
            *("-mon", "chardev=qmp,mode=control"),
            *("-device", "virtio-serial"),
        ]
        for name, port in (("agent", AGENT_PORT), ("messages", MESSAGE_PORT)):
            words += ["-chardev", f"socket,id={name},path={self._folder}/{name},server=on,wait=off"]
            words += ["-device", f"virtserialport,chardev={name},name={port}"]
        words += ["-device", "qemu-xhci,id=usb"]
        words += ["-chardev", f"serial,id=bridge,path={os.path.realpath(self._serial)}"]
        words += ["-device", f"usb-serial,id=adapter,chardev=bridge,serial={ADAPTER_SERIAL}"]
        return words


ADAPTER_SERIAL: Final = "GRASPD1"


def _done(status: dict[str, Any]) -> Done:
    code = status.get("exitcode", 128 + status.get("signal", 0))
    out, err = (
        base64.b64decode(status.get(name, "")).decode(errors="replace")
        for name in ("out-data", "err-data")
    )
    return Done(code, out, err)
