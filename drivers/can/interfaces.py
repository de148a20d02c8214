"""Interfaces of python-can: which can work on this computer, with which channel and options.

The extras are those of python-can's own metadata. For other interfaces advice names only their page
in python-can's documentation: a package with a module's name may belong to another project.
"""

from __future__ import annotations

import ctypes
import importlib
import inspect
import ipaddress
import logging
import socket
from collections.abc import Mapping
from ctypes.util import find_library
from importlib.util import find_spec
from typing import Annotated, Any, Final, get_type_hints

import can
import msgspec
from can.interfaces import BACKENDS

from graspd.drivers.base import DriverError, LinkCause, LinkError
from graspd.extras import installer

Options = Mapping[str, str | int | float | bool]
"""Arguments of an interface of python-can beside channel and bit rate, by name."""

NAME_BYTES_MAX: Final = 15
"""Longest name of a network interface (IFNAMSIZ - 1 of linux/if.h)."""
CONNECT_S: Final = 0.25
"""Longest wait for each step of the connection to socketcand, s; a robot's network needs 1 ms."""
OWN_OPTIONS: Final[dict[str, dict[str, str | int | float | bool]]] = {
    # By default slcan waits for 2 s after opening and for 1 ms in every read.
    "slcan": {"sleep_after_open": 0.0, "timeout": 0.0},
    # Both fail if the rest of a frame takes longer, s. These are their defaults.
    "seeedstudio": {"timeout": 0.1},
    "serial": {"timeout": 0.1},
    # Without this option the server may hold frames back for 40 ms, until an acknowledgement.
    "socketcand": {"tcp_tune": True},
    # The default queue is unbounded. This one holds about 4 s of a full bus.
    "virtual": {"rx_queue_size": 16384},
}

_EXTRAS: Final[dict[str, tuple[str, str]]] = {
    **dict.fromkeys(("slcan", "serial", "robotell", "seeedstudio"), ("serial", "serial")),
    "udp_multicast": ("msgpack", "multicast"),
    "gs_usb": ("gs_usb", "gs-usb"),
    "canalystii": ("canalystii", "canalystii"),
    "cantact": ("cantact", "cantact"),
    "neovi": ("ics", "neovi"),
}
"""Module that each interface needs, and the extra of python-can that installs it."""
_PLUGINS: Final = frozenset({"candle", "canine", "cvector", "remote", "sontheim", "zlgcan"})
"""Extras of python-can that install an interface of the same name."""
_LIBRARIES: Final = {"kvaser": "canlib", "neousys": "wdt_dio", "pcan": "pcanbasic"}
"""Libraries of vendors, by interface, that no Python package contains."""
_WINDOWS: Final = frozenset(
    {"etas", "iscan", "ixxat", "nican", "nixnet", "systec", "usb2can", "vector"}
)
_BITRATES: Final = {
    "slcan": (10, 20, 50, 83.3, 100, 125, 250, 500, 750, 1000),
    "seeedstudio": (5, 10, 20, 50, 100, 125, 200, 250, 400, 500, 800, 1000),
}
"""Rates that adapters of an interface support, kbit/s. Those of others are not checked."""
_RATELESS: Final = {
    "socketcan": "`ip link set CHANNEL type can bitrate` sets it",
    "socketcand": "its server's computer sets it",
    "serial": "the adapter has its own; options.baudrate is the rate of the line",
    "udp_multicast": "datagrams have none",
    "virtual": "frames stay in the process",
}
"""Interfaces that take no bit rate, and why. python-can ignores it there."""
_OWN_KEYS: Final = frozenset({"interface", "channel", "bitrate"})
_PORT: Final = Annotated[int, msgspec.Meta(ge=1, le=65535)]
_TYPES: Final[dict[str, dict[str, Any]]] = {
    "socketcand": {"host": str, "port": _PORT, "tcp_tune": bool},
}
"""Types of options that python-can does not declare."""
_WRONG_ARGUMENT: Final = (TypeError, ValueError, OverflowError)
_ARGUED: Final = frozenset({"gs_usb", "slcan", "socketcan", "socketcand", "udp_multicast"})
"""Interfaces that raise `_WRONG_ARGUMENT` only for wrong arguments. Others also raise it for absent
devices."""

# python-can also raises what it logs, and socketcand logs each piece of a stream.
logging.getLogger("can").setLevel(logging.CRITICAL)


def refuse_unusable(interface: str, channel: str, bitrate: int | None, options: Options) -> None:
    """Raise `ValueError` if a bus with these arguments can never be opened on this computer; open
    nothing. `bitrate`: bit/s; None: not set."""
    if interface not in can.VALID_INTERFACES:
        raise ValueError(f"interface: {_what_there_is(interface)}")
    if interface in _WINDOWS:
        raise ValueError(f"interface: {_named(interface)} is for Windows alone")
    if interface in _EXTRAS and find_spec(_EXTRAS[interface][0]) is None:
        raise ValueError(f"interface: {_what_is_missing(interface)}")
    if interface in _LIBRARIES and not _has_library(_LIBRARIES[interface]):
        missing = f"the library lib{_LIBRARIES[interface]}.so"
        raise ValueError(f"interface: {_named(interface)} needs {missing}: {_page(interface)}")
    _refuse_channel(interface, channel)
    _refuse_bitrate(interface, bitrate)
    _refuse_options(interface, options)


def open_bus(interface: str, channel: str, **options: Any) -> can.BusABC:  # noqa: ANN401
    """Open a bus of python-can; `options`: further arguments of its constructor.

    Raises `LinkError`, or `DriverError` if no retry can succeed.
    """
    where = f"cannot open {interface} {channel}"
    if interface == "socketcan":
        try:
            socket.if_nametoindex(channel)
        except OSError as error:
            raise LinkError(LinkCause.NO_INTERFACE, f"{where}: {error}") from error
    try:
        if interface == "socketcand":
            return _open_socketcand(channel, **options)
        if interface == "slcan" and "://" not in channel:
            from graspd.drivers.protocol_polled import SCHEME  # needs pyserial

            channel = SCHEME + channel
        return can.Bus(channel=channel, interface=interface, ignore_config=True, **options)
    except (NotImplementedError, ImportError) as error:
        raise DriverError(_what_is_missing(interface, error)) from error
    except Exception as error:
        if isinstance(error, _WRONG_ARGUMENT) and interface in _ARGUED:
            raise DriverError(f"{where}: {error}") from error
        raise LinkError.from_errno(error, f"{where}: {error}") from error


def _open_socketcand(channel: str, host: str, port: int, **options: Any) -> can.BusABC:  # noqa: ANN401
    """Open a bus of python-can at this server; each step of connecting takes `CONNECT_S` at most.

    `options`: further arguments of the bus. python-can alone would wait for ever, or spin for ten
    seconds.
    """
    before_s = socket.getdefaulttimeout()
    socket.create_connection((host, port), CONNECT_S).close()
    socket.setdefaulttimeout(CONNECT_S)
    try:
        return can.Bus(
            channel=channel,
            interface="socketcand",
            ignore_config=True,
            host=host,
            port=port,
            **options,
        )
    finally:
        socket.setdefaulttimeout(before_s)


def _refuse_channel(interface: str, channel: str) -> None:
    """Raise `ValueError` for a channel that the interface can never have."""
    try:
        if interface == "socketcan" and len(channel.encode()) > NAME_BYTES_MAX:
            raise ValueError(f"longer than {NAME_BYTES_MAX} bytes, so no network interface has it")
        if interface == "udp_multicast" and not ipaddress.ip_address(channel).is_multicast:
            raise ValueError("not a multicast address, as 239.74.163.2")
        if interface == "serial" and channel.lower().startswith("rfc2217://"):
            raise ValueError("each read would wait; a server's raw port is socket://HOST:PORT")
        if interface == "slcan":
            from graspd.drivers.protocol_polled import refuse_url

            refuse_url(channel)
        if get_type_hints(_constructor(interface)).get("channel") is int:
            int(channel)
    except ValueError as error:
        raise ValueError(f"channel {channel}: {error}") from error


def _refuse_bitrate(interface: str, bitrate: int | None) -> None:
    """Raise `ValueError` for a bit rate that is missing, in vain, or not the adapter's."""
    known = _BITRATES.get(interface)
    if interface in _RATELESS and bitrate is not None:
        raise ValueError(f"bitrate: {_named(interface)} takes none: {_RATELESS[interface]}")
    if interface == "canalystii" and bitrate is None:
        raise ValueError(f"bitrate: {_named(interface)} needs one")
    if known and bitrate is not None and bitrate / 1000 not in known:
        rates = ", ".join(f"{rate * 1000:.0f}" for rate in known)
        raise ValueError(f"bitrate: {_named(interface)} has {rates}")


def _refuse_options(interface: str, options: Options) -> None:
    """Raise `ValueError` for options that are missing, unknown, of a wrong type, in `_OWN_KEYS`, or
    different from `OWN_OPTIONS`."""
    constructor = _constructor(interface)
    parameters = inspect.signature(constructor).parameters
    named = {name for name, each in parameters.items() if each.kind is not each.VAR_KEYWORD}
    named.discard("self")
    needed = [name for name, each in parameters.items() if _is_needed(each)]
    for name in needed:
        if name not in options:
            example = ", ".join(f"{each} = ..." for each in needed)
            raise ValueError(f"options: {_named(interface)} needs options = {{ {example} }}")
    types = get_type_hints(constructor) | _TYPES.get(interface, {}) if options else {}
    for name, value in options.items():
        if name in _OWN_KEYS:
            raise ValueError(f"options.{name}: is a key of its own, tactile.{name}")
        own = OWN_OPTIONS.get(interface, {}).get(name, value)
        if own != value:
            raise ValueError(f"options.{name}: must be {own}, or left out")
        # Some interfaces take arguments from a dictionary; their names then stand in its code.
        if name not in named and name not in constructor.__code__.co_consts:
            raise ValueError(f"options.{name}: {_named(interface)} has no such option")
        try:
            msgspec.convert(value, types.get(name, Any))
        except (msgspec.ValidationError, TypeError) as error:
            raise ValueError(f"options.{name}: {error}") from error


def _constructor(interface: str) -> Any:  # noqa: ANN401
    """Return `__init__` of an interface's bus. Raises `ValueError` if it cannot be imported."""
    module, name = BACKENDS[interface]
    try:
        return inspect.unwrap(getattr(importlib.import_module(module), name).__init__)
    except Exception as error:
        raise ValueError(f"interface: {_what_is_missing(interface, error)}") from error


def _is_needed(parameter: inspect.Parameter) -> bool:
    if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
        return False
    return parameter.default is parameter.empty and parameter.name not in {"self", *_OWN_KEYS}


def _has_library(name: str) -> bool:
    try:
        return find_library(name) is not None or bool(ctypes.CDLL(f"lib{name}.so"))
    except OSError:
        return False


def _what_there_is(interface: str) -> str:
    if interface in _PLUGINS:
        return f"{_named(interface)} needs a package: {_install(interface)}"
    common = "socketcan, slcan, udp_multicast, socketcand, virtual"
    return f"python-can has no interface {interface!r}; it has {common} and others"


def _what_is_missing(interface: str, error: Exception | None = None) -> str:
    if interface in _EXTRAS:
        return f"{_named(interface)} needs more packages: {_install(_EXTRAS[interface][1])}"
    return f"{_named(interface)} does not work here: {error}: {_page(interface)}"


def _named(interface: str) -> str:
    return f"python-can's interface {interface!r}"


def _install(extra: str) -> str:
    return f"run {installer()} 'python-can[{extra}]'"


def _page(interface: str) -> str:
    return f"see https://python-can.readthedocs.io/en/stable/interfaces/{interface}.html"
