"""The table that the system test prints, a line as soon as it is known."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

from tests.system.lab import Lab, Outcome, StepError
from tests.system.machine import MachineError


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

    def run(self, step: Callable[[Lab], Outcome], lab: Lab) -> bool:
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
