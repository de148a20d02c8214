"""CURVE keys (RFC 26): the daemon's own pair, and the public keys of peers that may connect."""

from __future__ import annotations

import errno
import logging
import os
import re
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from graspd.daemon.process.files import SceneError, read_regular

if TYPE_CHECKING:
    from graspd.daemon.scene import Scene

log = logging.getLogger("graspd")

PUBLIC, SECRET = ".key", ".key_secret"
"""Endings of key files, as pyzmq and czmq have them."""
NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
Z85_KEY = re.compile(rb"[0-9A-Za-z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
"""A key of 32 bytes as text (RFC 32)."""
CLIENTS_MAX = 1000
"""Most keys of peers."""
FILE_MAX_BYTES = 1 << 16
SERVICE = "graspd"
"""User of the service; a program of root accepts keys that belong to this user."""
LINKS_MAX = 40
"""Most symbolic links on the way to a file (path_resolution(7))."""


class KeysError(SceneError):
    """Keys are missing, wrong, or open to other users."""


class Clients(NamedTuple):
    """Keys of peers in a folder: the admitted ones, and errors of the others."""

    admitted: dict[bytes, str]
    """Name of each peer by its public key, Z85."""
    refused: list[str]
    """Error of each other key file, as text with its path."""


def make(folder: Path, name: str) -> tuple[Path, Path]:
    """Make `NAME.key` and `NAME.key_secret` (mode 0600); return their paths.

    Raises `KeysError`, also if one of the files exists.
    """
    from zmq.auth import create_certificates  # imported here, as the daemon itself makes no keys

    if not NAME.fullmatch(name) or name.startswith("."):
        raise KeysError(f"{name!r} is not a name for a key: letters, digits, '_', '-' and '.'")
    public, secret = folder / f"{name}{PUBLIC}", folder / f"{name}{SECRET}"
    for path in (public, secret):
        if path.exists():
            raise KeysError(f"{path} is there already; remove it to make a new one")
    former = os.umask(0o077)  # set before a file exists that others could read
    try:
        folder.mkdir(parents=True, exist_ok=True)
        create_certificates(folder, name)
        public.chmod(0o644)
    except OSError as error:
        raise KeysError(f"{folder}: cannot make keys: {error.strerror}") from error
    finally:
        os.umask(former)
    return public, secret


def load_pair(path: Path) -> tuple[bytes, bytes]:
    """Return public and secret key, Z85. Raises `KeysError`, also if others may read the file."""
    public, secret = _load(path, "the key")
    if secret is None:
        raise KeysError(f"{path}: has no secret key; name the {SECRET} file")
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o077 and hasattr(os, "geteuid"):  # on Windows the mode does not show the rights
        raise KeysError(f"{path}: mode {mode:04o}; others may read it: chmod 600")
    return public, secret


def load_own(path: Path) -> tuple[bytes, bytes]:
    """Return the daemon's pair, as `load_pair` does.

    Also raises `KeysError` if another user may write the file or a folder above it.
    """
    _refuse_open(path)
    return load_pair(path)


def load_public(path: Path, what: str = "the key") -> bytes:
    """Return the public key, Z85, of a file. `what`: its name in errors. Raises `KeysError`."""
    return _load(path, what)[0]


def load_clients(folder: Path) -> Clients:
    """Read a folder of key files. Raises `KeysError` if it is missing or others may write it."""
    _refuse_open(folder)
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix == PUBLIC)
    except OSError as error:
        raise KeysError(f"{folder}: cannot list the keys: {error.strerror}") from error
    if len(paths) > CLIENTS_MAX:
        raise KeysError(f"{folder}: more than {CLIENTS_MAX} keys")
    clients = Clients({}, [])
    for path in paths:
        try:
            _refuse_open(path)
            key = load_public(path)
            if key in clients.admitted:
                same = f"has the same key as {clients.admitted[key]}{PUBLIC}, which is used"
                raise KeysError(f"{path}: {same}")
            clients.admitted[key] = path.stem
        except KeysError as error:
            clients.refused.append(str(error))
    return clients


def missing(wanted: Scene, clients: Clients) -> list[str]:
    """Return a warning for each key in `ask.tell` that may not connect: it may be added later."""
    if wanted.ask is None or (wanted.ask_endpoint or "").startswith("ipc://"):
        return []
    names = [name for name in wanted.ask.tell or () if name not in clients.admitted.values()]
    return [f"ask.tell: there is no key {name} that may connect" for name in names]


@dataclass(slots=True)
class Admission:
    """Peers that may connect to `tcp://` sockets."""

    folder: Path
    """Folder of the public keys of these peers."""
    admitted: Mapping[bytes, str] = field(default_factory=dict)
    """Name of each peer, by its public key, Z85."""
    seen: object = None
    """`state` of the folder when it was last read; None: not read yet."""

    def look(self) -> bool:
        """Read the folder if it has changed; return True if an admitted key no longer is.

        A folder that cannot be read, or that others may write, admits no peer.
        """
        now = state(self.folder)
        if now == self.seen:
            return False
        self.seen = now
        try:
            clients = load_clients(self.folder)
        except KeysError as error:
            clients = Clients({}, [str(error)])
        for why in clients.refused:
            log.error("%s; no key there may connect", why)
        log.info("%d keys may connect", len(clients.admitted))
        removed = self.admitted.keys() - clients.admitted.keys()
        self.admitted = clients.admitted
        return bool(removed)

    def callback(self, _domain: str, key: bytes) -> bool:
        """Return True if the key may connect; called in pyzmq's thread."""
        name = self.admitted.get(key)
        if name is None:
            log.warning("turned away a peer: its key %s is not on the list", key.decode())
            return False
        log.info("admitted a peer with the key of %s", name)
        return True


def state(folder: Path) -> object:
    """Return a value that changes when a file in the folder, or its rights, change."""
    try:
        with os.scandir(folder) as entries:
            signatures = {entry.name: _signature(entry) for entry in entries}
        about = os.stat(folder)
    except OSError as error:
        return error.errno
    return signatures, about.st_ino, about.st_ctime_ns


def _signature(entry: os.DirEntry[str]) -> object:
    try:
        about = entry.stat()
    except OSError as error:  # a link that leads nowhere, for example
        return error.errno
    return about.st_ino, about.st_mtime_ns, about.st_ctime_ns, about.st_size


def _load(path: Path, what: str) -> tuple[bytes, bytes | None]:
    try:
        content = read_regular(path, FILE_MAX_BYTES)
    except OSError as error:
        raise KeysError(f"{path}: cannot read {what}: {error.strerror}") from error
    fields: dict[bytes, bytes] = {}
    for line in content.splitlines():
        name, is_set, value = line.partition(b"=")
        if is_set:
            fields.setdefault(name.strip(), value.strip(b" \t'\""))
    if b"public-key" not in fields:
        raise KeysError(f"{path}: has no public key")
    public, secret = fields[b"public-key"], fields.get(b"secret-key")
    for key in (public, secret):
        if key is not None and not Z85_KEY.fullmatch(key):
            raise KeysError(f"{path}: a key must have 40 characters of Z85")
    return public, secret


def _refuse_open(path: Path) -> None:
    """Raise `KeysError` if another user may replace a file or a folder or link on its path."""
    at, ahead, links = Path("/"), [*reversed((Path.cwd() / path).parts[1:])], 0
    while True:
        try:
            status = at.lstat()
            if stat.S_ISLNK(status.st_mode):
                _refuse_owner(at, status)
                links += 1
                if links > LINKS_MAX:
                    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
                target = at.readlink()
                at = Path("/") if target.is_absolute() else at.parent
                ahead += reversed(target.relative_to(target.anchor).parts)
            elif ahead and status.st_mode & stat.S_ISVTX:
                _refuse_owner(at, status)  # only owners may replace files in it
            else:
                _refuse_writers(at, status)
        except OSError as error:
            raise KeysError(f"{path}: cannot look at {at}: {error.strerror}") from error
        if not ahead:
            return
        name = ahead.pop()
        at = at.parent if name == ".." else at / name


def _refuse_writers(path: Path, status: os.stat_result) -> None:
    _refuse_owner(path, status)
    mode = stat.S_IMODE(status.st_mode)
    if mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise KeysError(f"{path}: mode {mode:04o}; others may write it: chmod go-w")


def _refuse_owner(path: Path, status: os.stat_result) -> None:
    if status.st_uid in (0, os.geteuid()):
        return
    import pwd  # not everywhere; the daemon's own computer has it

    try:
        owner = pwd.getpwuid(status.st_uid).pw_name
    except KeyError:
        owner = str(status.st_uid)
    if os.geteuid() or owner != SERVICE:
        raise KeysError(f"{path}: belongs to {owner}, who may put another key there")
