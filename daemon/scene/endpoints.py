"""Check endpoints of ZeroMQ, and which computers can connect to them."""

from __future__ import annotations

import ipaddress
import os
import re

IPC_PATH_MAX_BYTES = 107
"""Longest path of a Unix socket on Linux (sun_path, less the closing NUL)."""


def check_endpoint(endpoint: str) -> str:
    """Return `endpoint` if it has a form that can be bound. Raises `ValueError`."""
    scheme, separator, address = endpoint.partition("://")
    if not separator or scheme not in {"ipc", "tcp"}:
        raise ValueError("must start with ipc:// or tcp://")
    if "\0" in endpoint:
        raise ValueError("has a NUL character")
    if scheme == "tcp":
        host, _, port = address.rpartition(":")
        if not re.fullmatch(r"[0-9]{1,5}", port) or not 0 < int(port) < 65536:
            raise ValueError("needs a port of 1 to 65535, as in tcp://127.0.0.1:5555")
        _ip_address(host)
    elif address.startswith("@"):
        raise ValueError(
            "needs a path: an abstract socket has no file mode, so any user could connect"
        )
    elif not address or len(address.encode()) > IPC_PATH_MAX_BYTES:
        raise ValueError(f"needs a path of 1 to {IPC_PATH_MAX_BYTES} bytes after ipc://")
    elif address.startswith("*"):
        raise ValueError("needs a path that subscribers can know, not '*'")
    return endpoint


def is_private(endpoint: str) -> bool:
    """Return True if only this computer can connect to a checked endpoint."""
    scheme, _, address = endpoint.partition("://")
    return scheme == "ipc" or _ip_address(address.rpartition(":")[0]).is_loopback


def clash(first: str, second: str) -> bool:
    """Return True if two checked endpoints cannot both be bound, however they are written.

    An `ipc://` endpoint also takes its path with `.lock`, and one on all addresses its whole port.
    Both may be a `str` of `udp.Endpoint`.
    """
    (scheme, _, one), (other_scheme, _, other) = first.partition("://"), second.partition("://")
    if scheme != other_scheme:
        return False
    if scheme == "ipc":
        one, other = os.path.realpath(one), os.path.realpath(other)
        return one in (other, f"{other}.lock") or other == f"{one}.lock"
    (host, _, port), (other_host, _, other_port) = one.rpartition(":"), other.rpartition(":")
    addresses = {_ip_address(host), _ip_address(other_host)}
    shared = len(addresses) == 1 or any(address.is_unspecified for address in addresses)
    return int(port) == int(other_port) and shared


def _ip_address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    try:
        if host.startswith("[") and host.endswith("]"):
            address = ipaddress.IPv6Address(host[1:-1])
            return address.ipv4_mapped or address
        return ipaddress.IPv4Address(host)
    except ValueError:
        raise ValueError(f"needs an IP address, 127.0.0.1 or [::1], not '{host}'") from None
