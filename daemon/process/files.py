"""Read files without waiting; replace files in one step. Works on systems without POSIX, too."""

from __future__ import annotations

import errno
import os
import stat
from contextlib import suppress
from pathlib import Path


class SceneError(Exception):
    """The scene is missing or wrong; the text has one line per mistake, with its key."""


def is_linux() -> bool:
    """Return True if Python has the Linux calls that the daemon needs."""
    return hasattr(os, "eventfd")


def require_linux(what: str) -> None:
    """Raise `SceneError` if `what` needs Linux and this is another system."""
    if not is_linux():
        raise SceneError(f"{what} needs Linux")


def open_flags(flags: int, *names: str) -> int:
    """Return `flags` for `os.open` of a binary file, and those of `names` that this system has."""
    for name in ("O_BINARY", "O_CLOEXEC", *names):
        flags |= getattr(os, name, 0)
    return flags


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Return the content of a regular file, without waiting for the writer of a pipe.

    Raises `OSError` with a reason in `strerror`, also for more than `max_bytes`.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "not a regular file")
    with open(os.open(path, open_flags(os.O_RDONLY, "O_NONBLOCK")), "rb") as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise OSError(errno.EFBIG, f"larger than {max_bytes} bytes")
    return content


def write_atomically(path: Path, content: bytes, mode: int = 0o600) -> None:
    """Replace the file at `path` in one step; `mode`: its permissions.

    Readers always see a whole file, also after a power cut. After an `OSError`, which names
    `path`, the old file stays.
    """
    part = path.with_name(f"{path.name}.{os.urandom(4).hex()}")
    try:
        handle = os.open(part, open_flags(os.O_WRONLY | os.O_CREAT | os.O_EXCL), 0o600)
        with open(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.chmod(part, mode)
            os.fsync(handle)
        os.replace(part, path)
    except OSError as error:
        with suppress(OSError):
            part.unlink()
        error.filename, error.filename2 = str(path), None
        raise
    sync_folder(path.parent)


def sync_folder(path: Path) -> None:
    """Make changes of file names in a folder survive a power cut, where the system can do that."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    with suppress(OSError):
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
