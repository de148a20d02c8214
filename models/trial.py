"""Loads a model as a daemon may: one that is not of the zoo, by its card's digest, is first tried
in a process of its own, which may be slow, grow or fall. That is a second start, 0.2 s."""

from __future__ import annotations

import sys
from collections import deque
from contextlib import suppress
from pathlib import Path

from graspd.models import zoo
from graspd.models.contract import ModelError
from graspd.models.runtime import ModelFile, TactileModel, check_operators, read

TRIAL_S = 10.0
"""For loading and the first runs, s; a model of 12 MB takes 0.3. So long a daemon's start or a
reload may wait."""
MEMORY_MAX_BYTES = 640 << 20
"""Of that process: the service has a gigabyte."""
REFUSED = 2
PR_SET_PDEATHSIG = 1
"""prctl(2)."""
_BEGIN = "import sys; sys.path[:] = sys.argv[2:]; from graspd.models.trial import main; main()"

passed: deque[str] = deque(maxlen=8)
"""Digests of models that were tried and are fine, the newest last."""


def load(path: Path, file: ModelFile | None = None) -> TactileModel:
    """Return the model at `path`, warm; `file` is its content where that was read.
    Raises `ModelError`, also for a model that is too slow or too large."""
    file = read(path) if file is None else file
    if file.sha256 not in passed and not zoo.ships(path, file.sha256):
        _try(path, file.data)
        passed.append(file.sha256)
    return TactileModel(path, file)


def _try(path: Path, content: bytes) -> None:
    import subprocess  # 10 ms that a model of the zoo does not wait for

    command = [sys.executable, "-c", _BEGIN, str(path), *sys.path]
    try:
        tried = subprocess.run(
            command,
            input=content,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=TRIAL_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise ModelError(
            f"{path}: takes too long: no answer within {TRIAL_S:g} s of its trial"
        ) from error
    except OSError as error:
        raise ModelError(f"{path}: cannot be tried: {error.strerror}") from error
    if tried.returncode == REFUSED:
        raise ModelError(tried.stdout.decode(errors="replace").strip())
    if tried.returncode != 0:
        raise ModelError(
            f"{path}: its trial ended with {tried.returncode}: it takes more than "
            f"{MEMORY_MAX_BYTES >> 20} MiB, or breaks onnxruntime"
        )


def main() -> None:
    """Be the process that tries the model on stdin; prints why it is refused."""
    import ctypes
    import resource
    import signal

    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_MAX_BYTES, MEMORY_MAX_BYTES))
        resource.setrlimit(resource.RLIMIT_CPU, (round(TRIAL_S), round(TRIAL_S) + 1))
    path, file = Path(sys.argv[1]), ModelFile(sys.stdin.buffer.read())
    try:
        check_operators(path, file.data)
        TactileModel(path, file)
    except ModelError as error:
        sys.stdout.write(str(error))
        sys.exit(REFUSED)
