"""Where ZeroMQ may be bound: on this computer, for this computer."""

from __future__ import annotations

import ipaddress
import re

IPC_PATH_MAX_BYTES = 107
"""Longest path of a Unix socket on Linux (sun_path, less the closing NUL)."""


def check_endpoint(endpoint: str) -> None:
    """Raise ValueError unless ZeroMQ can bind here and only this computer can connect."""
    scheme, separator, address = endpoint.partition("://")
    if not separator or scheme not in {"ipc", "tcp"}:
        raise ValueError("must start with ipc:// or tcp://")
    if "\0" in endpoint:
        raise ValueError("has a NUL character")
    if scheme == "tcp":
        _check_tcp(address)
    elif address in {"", "@"} or len(address.encode()) > IPC_PATH_MAX_BYTES:
        raise ValueError(f"needs a path of 1 to {IPC_PATH_MAX_BYTES} bytes after ipc://")
    elif address.startswith("*"):
        raise ValueError("needs a path that subscribers can know, not '*'")


def _check_tcp(address: str) -> None:
    host, _, port = address.rpartition(":")
    if not re.fullmatch(r"[0-9]{1,5}", port) or not 0 < int(port) < 65536:
        raise ValueError("needs a port of 1 to 65535, as in tcp://127.0.0.1:5555")
    try:
        if host.startswith("[") and host.endswith("]"):
            loopback = ipaddress.IPv6Address(host[1:-1]) == ipaddress.IPv6Address("::1")
        else:
            loopback = ipaddress.IPv4Address(host).is_loopback
    except ValueError:
        raise ValueError(f"needs an IP address, 127.0.0.1 or [::1], not '{host}'") from None
    if not loopback:
        raise ValueError(f"{host} is not a loopback address; anyone could listen")
