"""`graspd check SCENE`: check a scene, and print what it contains and what is left out."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import math
import os
from collections.abc import Iterator, Mapping
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from graspd.biotac import Finger
from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan, require_mcap
from graspd.daemon.commands.models import f1_percent
from graspd.daemon.doctor.computer import NETWORK
from graspd.daemon.doctor.finding import Level
from graspd.daemon.doctor.surroundings import key_findings, socket_findings
from graspd.daemon.judge.joint_motion import RAD_PER_S
from graspd.daemon.judge.windows import LONG_NS, SHORT_NS, STEP_NS, STEPS_MIN
from graspd.daemon.process.text import (
    Colour,
    coloured,
    complain,
    printable,
    write_json,
    write_lines,
)
from graspd.daemon.scene import drivers as scene_drivers
from graspd.daemon.scene.drivers import Device, DeviceKind
from graspd.daemon.scene.endpoints import clash
from graspd.daemon.scene.scene import Realtime, Record, RiskSection
from graspd.drivers.base import DriverError
from graspd.drivers.udp import Endpoint
from graspd.models.contract import ModelError, SessionInput
from graspd.models.runtime import TactileModel

if TYPE_CHECKING:
    from graspd.daemon.judge.decision import GateLimits, HandLimits

TACTILE_SECTIONS = get_args(get_args(scene_drivers.Tactile)[0])

WRONG = 2
USUAL_PERIOD_NS = 10_000_000
"""Assumed time between readings if only the device knows it, ns."""
COIN = 0.5
"""Lowest possible confidence in a verdict. A smaller `min_confidence` has no effect."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", type=Path, nargs="+", help="scene file (TOML)")
    parser.add_argument("--json", action="store_true", help="one JSON object per scene on stdout")


def run(args: argparse.Namespace) -> int:
    """Check the scenes, their models and files; return 0 if all are right, else 2. Warn of what two
    scenes share. Devices are not opened: `graspd doctor` examines them."""
    checked = {path: _check(path, as_json=args.json) for path in args.scene}
    right = [(path, wanted) for path, wanted in checked.items() if wanted is not None]
    for (path, first), (other, second) in itertools.combinations(right, 2):
        if shared := list(_shared(first, second)):
            complain(f"{path} and {other} cannot run together: the same {', '.join(shared)}")
    return WRONG if len(right) < len(checked) else 0


def _shared(first: scene.Scene, second: scene.Scene) -> Iterator[str]:
    """Yield the key and value of each resource that both scenes claim, so they cannot both run."""
    taken = dict(_taken(second))
    for what, name in _taken(first):
        if taken.get(what) == name:
            yield f"{what} {name}"
    for (table, device), (_, other) in itertools.product(_devices(first), _devices(second)):
        if _is_one(device, other):
            yield f"{table}.{device.keys} {device.name} {device.part}".rstrip()
    for ends in itertools.product(_endpoints(first), _endpoints(second)):
        if clash(*ends):
            yield f"endpoint {ends[0]}"


def _endpoints(wanted: scene.Scene) -> list[str]:
    return [end for end in (wanted.endpoint, wanted.ask_endpoint) if end is not None]


def _taken(wanted: scene.Scene) -> Iterator[tuple[str, str]]:
    """Yield key and name of each resource, except devices and endpoints, that a scene claims."""
    yield "hand.name", wanted.hand.name
    if wanted.keeps_session:
        yield "session.folder", os.path.realpath(wanted.session_path)


def _devices(wanted: scene.Scene) -> Iterator[tuple[str, Device]]:
    """Yield each device that a driver of the scene takes, with the name of its section."""
    for table, section in (("tactile", wanted.tactile), ("joints", wanted.joints)):
        if section is not None and section.device is not None:
            yield table, section.device


def _is_one(device: Device, other: Device) -> bool:
    """Return True if two drivers cannot both take these devices."""
    if device.kind is not other.kind:
        return False
    if device.kind is DeviceKind.UDP:
        ends = Endpoint.parse(device.name), Endpoint.parse(other.name)
        return ends[0].port > 0 and clash(*map(str, ends))
    shares = device.kind is not DeviceKind.SERIAL  # a port has one owner
    if shares and device.part and other.part and device.part != other.part:
        return False
    return os.path.realpath(device.name) == os.path.realpath(other.name)


def _check(path: Path, *, as_json: bool) -> scene.Scene | None:
    """Check one scene and print the result. Return the scene; None if it is wrong."""
    try:
        wanted = scene.load(path)
        model = assembly.load_model(wanted)
        assembly.refuse_absent_processors(wanted)
        plan = Plan.of(wanted)
        assembly.build_pipeline(plan, model)
        period_ns = _try_drivers(plan)
        keys = key_findings(wanted)
        findings = (*keys, *socket_findings(wanted))
        if wrong := [finding.what for finding in findings if finding.level is Level.ERROR]:
            raise scene.SceneError("\n".join(wrong))
        if wanted.record is not None:
            require_mcap("[record]")
    except (scene.SceneError, ModelError, DriverError) as error:
        complain(error)
        return None
    document: dict[str, Any] = {
        "scene": str(path),
        "in": _what_is_in(wanted, model, plan.hand, period_ns),
        "left_out": _what_is_left_out(wanted, model, plan.hand),
        "warnings": [
            *_warnings(wanted),
            *(finding.what for finding in keys),  # none is an error
            *assembly.keep_digest(model),
        ],
    }
    for warning in document["warnings"]:
        complain(f"{path}: {warning}")
    if as_json:
        write_json(document)
    else:
        write_lines(*_lines(document))
    return wanted


def _lines(document: Mapping[str, Any]) -> Iterator[str]:
    yield f"{printable(document['scene'])}: {coloured('fine', Colour.GREEN)}"
    for title, key in (("in", "in"), ("left out", "left_out")):
        yield title
        for name, text in document[key].items():
            yield f"  {name:9} {printable(text)}"


def _warnings(wanted: scene.Scene) -> Iterator[str]:
    for table, device in _devices(wanted):
        match device.kind:
            case DeviceKind.UDP if device.only_from is None:
                if ip_address(Endpoint.parse(device.name).address).is_unspecified:
                    yield (
                        f"[{table}] listens to {device.name}, so any sender that reaches this "
                        "computer is treated as the hand: name its sender with only_from, or "
                        "listen on one address"
                    )
            case DeviceKind.SERIAL if os.path.isabs(device.name):  # else a pyserial URL
                yield from _unreachable("port", device.name, device.name)
            case DeviceKind.SOCKETCAN:
                yield from _unreachable("CAN interface", device.name, str(NETWORK / device.name))


def _unreachable(what: str, name: str, path: str) -> Iterator[str]:
    """Yield a warning if the `path` of a device is missing or out of reach; `what`: its kind."""
    try:
        os.stat(path)
    except PermissionError:
        yield f"you may not reach the {what} {name}; graspd doctor says why"
    except OSError:
        yield (
            f"the {what} {name} is not there yet; graspd run waits for it, graspd doctor lists "
            "others"
        )


def _try_drivers(plan: Plan) -> int | None:
    """Construct the drivers, and open one that plays files; return the period of readings, ns.
    None: the period is not known."""
    driver, *_ = assembly.build_drivers(plan)
    with contextlib.closing(driver):
        assembly.open_file(plan.scene, driver)
        return driver.period_ns


def _what_is_in(
    wanted: scene.Scene, model: TactileModel, limits: HandLimits | None, period_ns: int | None
) -> dict[str, str]:
    contract = model.contract
    figures = ", ".join(
        f"{measured.protocol} {f1_percent(measured)} %" for measured in contract.measured
    )
    confidence = wanted.model.min_confidence
    rejects = f", unknown below a confidence of {confidence:.2f}" if confidence > COIN else ""
    parts = {
        "hand": f"{wanted.hand.name}: {', '.join(wanted.hand.fingers)}",
        "tactile": _section(wanted.tactile),
        "model": (
            f"{contract.name} ({model.sha256[:12]}): F1 {figures}; slip from p_slip "
            f"{wanted.model.slip_threshold:g} on{rejects}"
        ),
        "gate": _gate(wanted, limits),
        "publish": f"verdict, gate and status.{wanted.hand.name} on {wanted.endpoint}",
    }
    if limits is not None:
        parts["still"] = _still(wanted, limits.gate, period_ns)
    if wanted.ask_endpoint is not None:
        parts["ask"] = f"on {wanted.ask_endpoint}, answered within {wanted.gate.request_ms:g} ms"
    if wanted.joints is not None:
        parts["joints"] = _section(wanted.joints)
    elif limits is not None and limits.joints:
        parts["joints"] = "those of the recordings"
    if isinstance(contract.input, SessionInput):
        parts["session"] = _session(wanted, contract.input)
    if wanted.learn.enabled:
        tactile = wanted.tactile
        if isinstance(tactile, scene_drivers.ReplayTactile) and tactile.outcomes:
            told = " by the recording"
        else:
            told = "" if wanted.ask_endpoint else "; without [ask] no peer can tell any"
        parts["learn"] = f"from the outcomes of lifts that are told{told}"
    if wanted.risk is not None:
        parts["risk"] = _risk(wanted.risk)
    if wanted.record is not None:
        parts["record"] = _record(wanted.record)
    if wanted.curve is not None:
        parts["curve"] = f"by tcp:// only keys of {wanted.curve.clients}"
    if wanted.realtime is not None:
        parts["realtime"] = _realtime(wanted.realtime)
    return parts


def _record(wanted: Record) -> str:
    raw = ", and what came over the link" if wanted.raw else ""
    return f"in {wanted.folder}, at most {wanted.keep_mb:g} MB{raw}"


def _realtime(wanted: Realtime) -> str:
    priority = "" if wanted.priority is None else f"SCHED_FIFO {wanted.priority}, "
    cpus = "all processors" if wanted.cpus is None else f"processors {wanted.cpus}"
    return f"{priority}{cpus}, memory locked, no garbage collection on the hot path"


def _gate(wanted: scene.Scene, limits: HandLimits | None) -> str:
    gate = wanted.gate
    age = f"not older than {gate.max_age_ms:g} ms"
    if limits is None:
        return f"every reading, {age}"
    when = "when asked, " if limits.on_request else ""
    joints = f", joints below {RAD_PER_S:g} rad/s" if limits.joints else ""
    fingers = ", ".join(gate.fingers or wanted.hand.fingers)
    what = f"median of 3 fresh readings, {age}"
    return f"{when}once per grasp: {fingers} touch and keep still{joints}; {what}"


def _still(wanted: scene.Scene, gate: GateLimits, period_ns: int | None) -> str:
    """Return text on the time after which a grasp is judged; `period_ns` None: a usual one."""
    usual = ", as usual" if period_ns is None else ""
    period_ns = period_ns or USUAL_PERIOD_NS
    step_ns = max(math.ceil(STEP_NS / period_ns), 1) * period_ns
    soon_ms, sure_ms = (
        max(math.ceil(window_ns / step_ns), STEPS_MIN) * step_ns / 1e6
        for window_ns in (SHORT_NS, LONG_NS)
    )
    early = f"early after {soon_ms:.0f} ms, again " if gate.early else ""
    return (
        f"judged {early}after {sure_ms:.0f} ms without motion ({1e9 / period_ns:.0f} readings"
        f"/s{usual}); a settled hand that holds may be said to move {100 * gate.false_alarms:g} % "
        "of the time"
    )


def _risk(wanted: RiskSection) -> str:
    return (
        f"{100 * wanted.max_slip_when_stable:g} % of the lifts of `stable` verdicts may slip; "
        f"the first {wanted.warm_up} lifts supervised, then {100 * wanted.explore:g} % of those "
        "that are not `stable`"
    )


def _session(wanted: scene.Scene, needs: SessionInput) -> str:
    kept = f"kept in {wanted.session_path}" if wanted.keeps_session else "not kept"
    if wanted.session.folder is not None and not wanted.keeps_session:
        kept = "not kept and its folder not read: that takes keep = true"
    learns = "by what is judged" if wanted.session.learn else "by `graspd session seed`"
    return f"calibrated {learns}, from {needs.calibrated_from:g} grasps on, {kept}"


def _section(section: scene_drivers.Section) -> str:
    """Return the driver and the options that the scene gives it."""
    options = section.model_dump(mode="json", exclude_unset=True)
    driver = options.pop("driver")
    return f"{driver}: " + ", ".join(f"{key} {value}" for key, value in options.items())


def _what_is_left_out(
    wanted: scene.Scene, model: TactileModel, limits: HandLimits | None
) -> dict[str, str]:
    drivers = [get_args(kind.model_fields["driver"].annotation)[0] for kind in TACTILE_SECTIONS]
    others = [driver for driver in drivers if driver != wanted.tactile.driver]
    left_out = {"drivers": f"{', '.join(others)}: not imported"}
    if wanted.joints is None and (limits is None or not limits.joints):
        left_out["joints"] = "no joint code"
    if limits is None:
        left_out["gate"] = "no tare, no contact, no gate: each reading is a grasp"
    if not isinstance(model.contract.input, SessionInput):
        left_out["session"] = f"{model.contract.name} needs no session calibration"
    if not wanted.learn.enabled:
        left_out["learn"] = "what is thought of a grasp is the network's alone"
    if wanted.risk is None:
        left_out["risk"] = "nothing limits how many `stable` lifts slip"
    if wanted.record is None:
        learns = "session" not in left_out or wanted.learn.enabled or wanted.risk is not None
        but = " but what the session has learned" if learns and wanted.keeps_session else ""
        left_out["record"] = f"nothing is written{but}"
    if wanted.curve is None:
        left_out["curve"] = "no keys: sockets are for this computer alone"
    if wanted.realtime is None:
        left_out["realtime"] = "ordinary priority, memory not locked"
    without = [name for name in get_args(Finger) if name not in wanted.hand.fingers]
    if without:
        left_out["fingers"] = f"{', '.join(without)}: no channel in image or network"
    return left_out
