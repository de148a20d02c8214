"""Load a model for a daemon, after a trial in a process of its own.

A bad model may be slow, take too much memory or crash; this then harms only that process. The trial
takes 0.2 s. Models of the zoo, known by the digest in their card, need none.
"""

from __future__ import annotations

import json
import signal
import sys
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from graspd.biotac import COUNT_MAX
from graspd.models import zoo
from graspd.models.contract import ModelError
from graspd.models.runtime import ModelFile, TactileModel, check_operators, read

TRIAL_S = 10.0
"""Longest trial, s of processor time: loading and the first runs. A model of 12 MB takes 0.3."""
WAIT_S = 60.0
"""Longest trial, s. A start of the daemon waits for it; a busy computer takes several times
`TRIAL_S`."""
MEMORY_MAX_BYTES = 640 << 20
"""Most memory of the trial's process, bytes; the service has a gigabyte."""
VARIED = 20
"""Number of random readings in a trial, and of others within the training's range."""
REFUSED = 2
PR_SET_PDEATHSIG = 1
"""Option of prctl(2): a signal for this process when its parent ends."""
_BEGIN = "import sys; sys.path[:] = sys.argv[2:]; from graspd.models.trial import main; main()"

passed: deque[str] = deque(maxlen=8)
"""Digests of models that passed their trial, the newest last."""


def load(path: Path, file: ModelFile | None = None) -> TactileModel:
    """Return the model at `path`, after a trial in a process of its own if it is not of the zoo.

    Raises `ModelError`, also if the model is too slow or takes too much memory.

    `file`: its content, if it was read before.
    """
    file = read(path) if file is None else file
    if not zoo.ships(path, file.sha256) and file.sha256 not in passed:
        _try(path, file.data)
        passed.append(file.sha256)
    return TactileModel(path, file)


def card(path: Path) -> dict[str, Any]:
    """Return the card beside a model file; without a card, one made of its contract.

    Raises `ModelError` if the daemon would refuse the model, or if the card is of another file.
    """
    file = read(path)
    contract = json.loads(load(path, file).contract.to_json())
    about = path.with_suffix(".json")
    if not about.exists():
        size = {"sha256": file.sha256, "size_bytes": len(file.data)}
        return {"what": "no card came with it", "contract": contract, "file": size}
    return {**zoo.read_card(about), "contract": contract}


def _try(path: Path, content: bytes) -> None:
    import subprocess  # imported here: it takes 10 ms, and models of the zoo need no trial

    command = [sys.executable, "-c", _BEGIN, str(path), *sys.path]
    try:
        tried = subprocess.run(
            command,
            input=content,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=WAIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise ModelError(
            f"{path}: takes too long: no answer within {WAIT_S:g} s of its trial"
        ) from error
    except OSError as error:
        raise ModelError(f"{path}: cannot be tried: {error.strerror}") from error
    if tried.returncode == REFUSED:
        raise ModelError(tried.stdout.decode(errors="replace").strip())
    if hasattr(signal, "SIGXCPU") and tried.returncode == -signal.SIGXCPU:
        raise ModelError(f"{path}: takes too long: over {TRIAL_S:g} s of processor time")
    if tried.returncode != 0:
        raise ModelError(
            f"{path}: its trial ended with {tried.returncode}: it takes more than "
            f"{MEMORY_MAX_BYTES >> 20} MiB, or breaks onnxruntime"
        )


def main() -> None:
    """Try the model on stdin, in its own process; if refused, print why and exit with `REFUSED`."""
    with suppress(ModuleNotFoundError):  # without these limits only its time is limited
        _limit_process()
    path, file = Path(sys.argv[1]), ModelFile(sys.stdin.buffer.read())
    try:
        check_operators(path, file.data)
        model = TactileModel(path, file)
        seen, draw = model.contract.seen, np.random.default_rng(0)
        for low, high in ((0, COUNT_MAX), (seen.low, seen.high)):
            shape = (VARIED, *np.shape(seen.low))
            for counts in draw.integers(low, high, shape, endpoint=True):
                model.inputs.build(counts, model.input)
                model.run()
    except ModelError as error:
        sys.stdout.write(str(error))
        sys.exit(REFUSED)


def _limit_process() -> None:
    """Limit memory and processor time, and end with the parent.

    Raises `ModuleNotFoundError` if the system has no such limits.
    """
    import ctypes
    import resource

    with suppress(AttributeError):  # prctl is missing
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_MAX_BYTES, MEMORY_MAX_BYTES))
        resource.setrlimit(resource.RLIMIT_CPU, (round(TRIAL_S), round(TRIAL_S) + 1))
