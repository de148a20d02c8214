"""`python -m tests.system`: the service in a real Debian on a real kernel, from nothing.

Needs the Debian packages mmdebstrap, qemu-system-x86 and e2fsprogs; who is not root also fakeroot
and uidmap.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from tests.system import steps_faults, steps_install, steps_verdicts
from tests.system.image import CACHE, ImageError, image
from tests.system.lab import Bridge, Lab, Outcome, StepError
from tests.system.machine import Machine, MachineError
from tests.system.payload import make_payload

Step = Callable[[Lab], Outcome]

STEPS: Final[tuple[Step, ...]] = (
    steps_install.prepare,
    steps_install.install,
    steps_install.doctor,
    steps_install.start,
    steps_install.realtime,
    steps_install.access,
    steps_faults.wrong_start,
    steps_verdicts.serial_verdicts,
    steps_faults.unplugged,
    steps_faults.disk_full,
    steps_faults.clock_stepped,
    steps_verdicts.can_verdicts,
    steps_faults.recording_again,
    steps_faults.hangs,
    steps_faults.killed,
    steps_faults.bus_down,
    steps_faults.hung,
    steps_faults.stopped,
    steps_install.enabled,
    steps_install.uninstall,
)
"""Grasps come over both links from `start` on, while the other steps are done. The recording that a
full disk ends must hold some: `serial_verdicts` waits for them. What takes its time by itself is
begun by one step and awaited by a later one: `recording_again`, `hung`."""
NEEDED: Final = frozenset((steps_install.prepare, steps_install.install, steps_install.start))
"""Without these there is no use in going on."""


class Table:
    """Lines of what was done, how long it took, how long a recovery took, and what was seen."""

    def __init__(self) -> None:
        self.failed: list[str] = []
        self._began_s = time.monotonic()
        _write("", "step", "took, s", "recovery, s", "seen")

    @contextlib.contextmanager
    def timed(self, name: str) -> Iterator[list[str]]:
        """Time what is done within; what is put into the list is what was seen."""
        began_s = time.monotonic()
        seen: list[str] = []
        yield seen
        _write("ok", name, f"{time.monotonic() - began_s:.1f}", "", " ".join(seen))

    def run(self, step: Step, lab: Lab) -> bool:
        """Do a step; whether all was as it must be."""
        name = step.__name__.replace("_", " ")
        began_s = time.monotonic()
        mark, recovery = "ok", ""
        try:
            outcome = step(lab)
        except (StepError, MachineError) as error:
            mark, what = "FAILED", str(error)
            self.failed.append(name)
        else:
            what = outcome.what
            if outcome.recovery_s is not None:
                recovery = f"{outcome.recovery_s:.1f}"
        _write(mark, name, f"{time.monotonic() - began_s:.1f}", recovery, what)
        return mark == "ok"

    def end(self) -> None:
        """The last line."""
        took_s = time.monotonic() - self._began_s
        verdict = f"failed: {', '.join(self.failed)}" if self.failed else "all is well"
        sys.stdout.write(f"{verdict}, in {took_s:.0f} s, under software emulation\n")


def _write(mark: str, step: str, took: str, recovery: str, seen: str) -> None:
    sys.stdout.write(f"{mark:7}{step:17}{took:>8}{recovery:>13}  {seen}\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Run all steps; 0 if all is as it must be, 1 if something is not, 2 if it cannot be tried."""
    parser = argparse.ArgumentParser(prog="python -m tests.system", description=__doc__)
    parser.add_argument(
        "--rebuild", action="store_true", help="build the image even if it is there"
    )
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))
    table = Table()
    try:
        with tempfile.TemporaryDirectory(prefix="graspd-system-") as folder:
            _run(Path(folder), options.rebuild, table)
    except (ImageError, MachineError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    table.end()
    return 1 if table.failed else 0


def _run(folder: Path, rebuild: bool, table: Table) -> None:
    with table.timed("image") as seen:
        built, is_new = image(CACHE, rebuild=rebuild)
        seen.append("built" if is_new else "from the cache")
    with table.timed("payload") as seen:
        make_payload(CACHE, folder / "payload")
        seen.append("wheels, deploy, programs for the machine")
    bridge = Bridge(folder / "bridge")
    with bridge.serving(), Machine(built, folder / "payload", bridge.path, folder) as machine:
        with table.timed("boot") as seen:
            machine.wait_for_agent()
            seen.append("until commands run")
        lab = Lab(machine, bridge)
        for step in STEPS:
            if not table.run(step, lab):
                _explain(machine)
                if step in NEEDED:
                    return


def _explain(machine: Machine) -> None:
    """What the journal has, to look into a failure."""
    with contextlib.suppress(MachineError):
        said = machine.run("journalctl -q --no-pager -n 60 -p notice; systemctl --failed").out
        sys.stderr.write(said + "\n")


if __name__ == "__main__":
    sys.exit(main())
