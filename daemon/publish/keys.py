"""CURVE keys (RFC 26): the daemon's own pair, and the public keys of those who may connect."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path

import zmq.auth

PUBLIC, SECRET = ".key", ".key_secret"
"""Endings of key files, as pyzmq and czmq have them."""
NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
Z85_KEY = re.compile(rb"[0-9A-Za-z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
"""A key of 32 bytes as text (RFC 32)."""
CLIENTS_MAX = 1000
"""Keys in the folder of those who may connect; more were put there by mistake."""


class KeysError(Exception):
    """Keys are missing, wrong, or open to others; the message says which file."""


def make(folder: Path, name: str) -> tuple[Path, Path]:
    """Make a pair of keys, `NAME.key` and `NAME.key_secret` (mode 0600); never over others.

    Raises `KeysError`.
    """
    if not NAME.fullmatch(name) or name.startswith("."):
        raise KeysError(f"{name!r} is no name for a key: letters, digits, '_', '-' and '.'")
    public, secret = folder / f"{name}{PUBLIC}", folder / f"{name}{SECRET}"
    for path in (public, secret):
        if path.exists():
            raise KeysError(f"{path} is there already; remove it to make a new one")
    former = os.umask(0o077)  # before there is anything to read
    try:
        folder.mkdir(parents=True, exist_ok=True)
        zmq.auth.create_certificates(folder, name)
        public.chmod(0o644)
    except OSError as error:
        raise KeysError(f"{folder}: cannot make keys: {error.strerror}") from error
    finally:
        os.umask(former)
    return public, secret


def load_pair(path: Path) -> tuple[bytes, bytes]:
    """Public and secret key, Z85, of a `.key_secret` file that nobody else may read.

    Raises `KeysError`.
    """
    public, secret = _load(path)
    if secret is None:
        raise KeysError(f"{path}: has no secret key; name the {SECRET} file")
    loose = _looser_than_0600(path)
    if loose:
        raise KeysError(f"{path}: {loose}; others may read it: chmod 600")
    return public, secret


def load_public(path: Path, what: str = "the key") -> bytes:
    """Public key, Z85, of a file that holds one; errors call it `what`. Raises `KeysError`."""
    return _load(path, what)[0]


def load_clients(folder: Path) -> dict[bytes, str]:
    """Names of those who may connect, by their public key, Z85. Raises `KeysError`."""
    try:
        paths = sorted(p for p in folder.iterdir() if p.suffix == PUBLIC and p.is_file())
    except OSError as error:
        raise KeysError(f"{folder}: cannot list the keys: {error.strerror}") from error
    if len(paths) > CLIENTS_MAX:
        raise KeysError(f"{folder}: more than {CLIENTS_MAX} keys")
    return {load_public(path): path.stem for path in paths}


def _load(path: Path, what: str = "the key") -> tuple[bytes, bytes | None]:
    try:
        public, secret = zmq.auth.load_certificate(path)
    except OSError as error:
        reason = error.strerror or "there is no such file"
        raise KeysError(f"{path}: cannot read {what}: {reason}") from error
    except ValueError as error:
        raise KeysError(f"{path}: has no public key") from error
    for key in (public, secret):
        if key is not None and not Z85_KEY.fullmatch(key):
            raise KeysError(f"{path}: a key must have 40 characters of Z85")
    return public, secret


def _looser_than_0600(path: Path) -> str:
    """The file's mode, if it gives others anything; empty otherwise."""
    mode = stat.S_IMODE(path.stat().st_mode)
    return f"mode {mode:04o}" if mode & 0o077 else ""
