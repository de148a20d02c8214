"""Programs that a test runs to their end."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path


def ran(
    *words: object,
    typed: str = "",
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    check: bool = False,
) -> subprocess.CompletedProcess[str]:
    """Run the program `words[0]` with the arguments `words[1:]` and the input `typed`.

    `cwd`, `env`, `check`: as of `subprocess.run`.
    """
    return subprocess.run(
        [str(word) for word in words],
        input=typed,
        capture_output=True,
        text=True,
        timeout=200,
        cwd=cwd,
        env=env,
        check=check,
    )
