"""`python -m tests.system`: install and test the service in an emulated machine with Debian.

Needs the Debian packages mmdebstrap, qemu-system-x86 and e2fsprogs; without root also fakeroot and
uidmap.
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
"""Steps in order. From `start` on grasps come over both links. `serial_verdicts` waits for some, so
that the recording that `disk_full` ends holds them. `disk_full` and `hangs` begin what
`recording_again` and `hung` await."""
NEEDED: Final = frozenset((steps_install.prepare, steps_install.install, steps_install.start))
"""Steps whose failure ends the run."""


class Table:
    """Prints a line for each step: result, name, time, time to recover, and what was seen."""

    def __init__(self) -> None:
        self.failed: list[str] = []
        self._began_s = time.monotonic()
        _write("", "step", "took, s", "recovery, s", "seen")

    @contextlib.contextmanager
    def timed(self, name: str) -> Iterator[list[str]]:
        """Time the block and print its line; the block adds what was seen to the list."""
        began_s = time.monotonic()
        seen: list[str] = []
        yield seen
        _write("ok", name, f"{time.monotonic() - began_s:.1f}", "", " ".join(seen))

    def run(self, step: Step, lab: Lab) -> bool:
        """Run a step and print its line; return True if it succeeded."""
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
        """Print the last line: failed steps, and the time of the whole run."""
        took_s = time.monotonic() - self._began_s
        verdict = f"failed: {', '.join(self.failed)}" if self.failed else "all is well"
        sys.stdout.write(f"{verdict}, in {took_s:.0f} s, under software emulation\n")


def _write(mark: str, step: str, took: str, recovery: str, seen: str) -> None:
    sys.stdout.write(f"{mark:7}{step:17}{took:>8}{recovery:>13}  {seen}\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Run all steps; return 0 if all succeed, 1 if one fails, 2 if the emulated machine cannot be
    run."""
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
    """Write the end of the emulated machine's journal and its failed units to stderr."""
    with contextlib.suppress(MachineError):
        said = machine.run("journalctl -q --no-pager -n 60 -p notice; systemctl --failed").out
        sys.stderr.write(said + "\n")


if __name__ == "__main__":
    sys.exit(main())
