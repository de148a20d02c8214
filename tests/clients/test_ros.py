"""The examples for ROS, run with stand-ins for the ROS modules that they import."""

from __future__ import annotations

import runpy
import socket
import sys
from array import array
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from deploy.clients.python import graspd_client
from graspd.drivers.base import JointReading, TactileReading
from graspd.drivers.datagrams.joints import JointStreamDriver
from graspd.drivers.datagrams.tactile import TactileStreamDriver
from tests.clients.building import CPP
from tests.clients.false_daemon import false_daemon
from tests.drivers.one_sweep import tactile
from tests.drivers.palm.palm_stream import joints
from tests.kit.waiting import wait_until

FOLDER = CPP.parent / "ros"
NODE = CPP.parent / "ros2" / "grasp_node.py"
START_S = 1_700_000_000
SENSORS = 5
"""Length of `BiotacAll.tactiles`: first, middle, ring and little finger, thumb (sr_robot_msgs)."""


class Biotac(SimpleNamespace):
    """`sr_robot_msgs/Biotac`."""


class BiotacAll(SimpleNamespace):
    """`sr_robot_msgs/BiotacAll`."""


class JointState(SimpleNamespace):
    """`sensor_msgs/JointState`."""


ABSENT = Biotac(pac0=0, pac1=0, pdc=-9784, tac=32518, tdc=0, electrodes=array("h", [0] * 24))
"""Values that the topic has for an absent sensor (Shadow's documentation)."""


def header(number: int) -> SimpleNamespace:
    """Make a `std_msgs/Header` of `number` times 10 ms after `START_S`, with the fields of ROS 2
    and those that only ROS 1 has, `to_sec` and `seq`."""
    time_s = START_S + number / 100
    stamp = SimpleNamespace(sec=START_S, nanosec=number * 10_000_000, to_sec=lambda: time_s)
    return SimpleNamespace(seq=number, stamp=stamp)


def sweep(number: int, *, repeats: int | None = None) -> BiotacAll:
    """Make a message of a hand with three sensors, which read 1000 + 100 * place + `number`.

    `repeats`: number of the message whose header it repeats.
    """
    sensors = [ABSENT] * SENSORS
    for place in (0, 1, 4):
        counts = array("h", [1000 + 100 * place + number] * 24)
        sensors[place] = Biotac(pac0=0, pac1=0, pdc=2779, tac=2006, tdc=2247, electrodes=counts)
    return BiotacAll(header=header(number if repeats is None else repeats), tactiles=sensors)


def joint_state(number: int, angles: dict[str, float]) -> JointState:
    return JointState(header=header(number), name=[*angles], position=tuple(angles.values()))


ARM = joint_state(900, {"ra_elbow_joint": 1.5})
BOTH = joint_state(1, {"rh_FFJ3": 0.5, "lh_FFJ3": 0.9, "rh_THJ5": -0.1})
WITHOUT_ANGLES = JointState(header=header(2), name=BOTH.name, position=())
NO_STAMP = SimpleNamespace(sec=0, nanosec=0, to_sec=lambda: 0.0)
UNSTAMPED = JointState(
    header=SimpleNamespace(seq=0, stamp=NO_STAMP), name=["rh_FFJ3"], position=[1]
)
MESSAGES = (
    *(sweep(number) for number in (1, 2, 3)),
    *(sweep(4, repeats=3), sweep(5, repeats=3)),
    sweep(6),
    *(ARM, BOTH, WITHOUT_ANGLES, UNSTAMPED, UNSTAMPED),
)
"""Messages in order: the header of the third sweep is repeated twice, and joints of an arm come on
the topic of the hand's; the last two have no time."""


class Ros:
    """The parts of `rospy` and of `rclpy` that the feeders use; `spin` plays `MESSAGES`."""

    def __init__(self, parameters: dict[str, object]) -> None:
        self._parameters = parameters
        self.subscribed: dict[str, tuple[type, Callable[[Any], None]]] = {}

    def init_node(self, name: str) -> None:
        assert name == "graspd_feeder"

    def get_param(self, name: str, default: object) -> object:
        return self._parameters.get(name.removeprefix("~"), default)

    def subscribe(self, topic: str, kind: type, callback: Callable[[Any], None]) -> None:
        self.subscribed[topic] = kind, callback

    def spin(self, _node: object = None) -> None:
        for message in MESSAGES:
            topic = "/rh/tactile" if isinstance(message, BiotacAll) else "/joint_states"
            kind, callback = self.subscribed[topic]
            assert isinstance(message, kind)
            callback(message)

    def modules(self) -> dict[str, dict[str, object]]:
        def create_subscription(
            kind: type, topic: str, callback: Callable[[Any], None], qos: object
        ) -> None:
            assert qos == "sensor data"
            self.subscribe(topic, kind, callback)

        def subscriber(
            topic: str, kind: type, callback: Callable[[Any], None], queue_size: int
        ) -> None:
            assert queue_size == 1, "an old message is not to be sent"
            self.subscribe(topic, kind, callback)

        def create_node(name: str) -> SimpleNamespace:
            self.init_node(name)
            return SimpleNamespace(
                declare_parameter=lambda *each: SimpleNamespace(value=self.get_param(*each)),
                create_subscription=create_subscription,
            )

        return {
            "rospy": {
                "init_node": self.init_node,
                "get_param": self.get_param,
                "Subscriber": subscriber,
                "spin": self.spin,
            },
            "rclpy": {
                "init": lambda: None,
                "create_node": create_node,
                "spin": self.spin,
            },
            "rclpy.qos": {"qos_profile_sensor_data": "sensor data"},
            "sensor_msgs": {},
            "sensor_msgs.msg": {"JointState": JointState},
            "sr_robot_msgs": {},
            "sr_robot_msgs.msg": {"BiotacAll": BiotacAll},
        }


def stand_in(monkeypatch: pytest.MonkeyPatch, modules: dict[str, dict[str, Any]]) -> None:
    """Replace modules for later imports; `modules`: names in each module by its name."""
    for name, holds in modules.items():
        module = ModuleType(name)
        vars(module).update(holds)
        monkeypatch.setitem(sys.modules, name, module)


def free_ports() -> int:
    """Return a UDP port that is free, as are those before and after it."""
    while True:
        with ExitStack() as stack:
            probes = [stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in range(3)]
            try:
                probes[0].bind(("", 0))
                middle: int = probes[0].getsockname()[1]
                probes[1].bind(("", middle - 1))
                probes[2].bind(("", middle + 1))
            except OSError:
                continue
            return middle


@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")
@pytest.mark.parametrize("name", ["feed_ros1.py", "feed_ros2.py"])
def test_a_ros_feeder_sends_its_topics_counts_and_angles(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len((FOLDER / name).read_text().splitlines()) <= 40
    port = free_ports()
    stand_in(monkeypatch, Ros({"port": port}).modules())
    sweeps: list[TactileReading] = []
    angles: list[JointReading] = []
    with (
        TactileStreamDriver(f"udp://127.0.0.1:{port}") as hand,
        JointStreamDriver(f"udp://127.0.0.1:{port - 1}") as fingers,
    ):
        left = runpy.run_path(str(Path(FOLDER / name)))

        def all_came() -> bool:
            sweeps.extend(tactile(hand.read_ready()))
            angles.extend(joints(fingers.read_ready()))
            return len(sweeps) + hand.counters.as_dict()["old_messages"] == 6 and len(angles) == 3

        wait_until(all_came)
        left["SENDER"].close()
        assert hand.sender == f"udp://127.0.0.1:{port + 1}"
    assert [reading.counts.tolist() for reading in sweeps] == [
        [[1000 + number] * 24, [1100 + number] * 24, [1400 + number] * 24]
        for number in (1, 2, 3, 6)
    ]
    assert not any(reading.faults.any() for reading in sweeps)
    reading = angles[0]
    assert dict(zip(reading.names, reading.position_rad, strict=True)) == {
        "FFJ3": 0.5,
        "THJ5": -0.1,
    }


class Node:
    """The part of `rclpy.node.Node` that the example uses."""

    given: dict[str, str]
    """Parameters that the node was given."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.published: dict[str, list[str]] = {}
        self.timers: dict[float, Callable[[], None]] = {}
        self.served: dict[str, Callable[[Any, Any], Any]] = {}

    def declare_parameter(self, name: str, value: str) -> SimpleNamespace:
        return SimpleNamespace(value=self.given.get(name, value))

    def create_publisher(self, _kind: type, topic: str, depth: int) -> SimpleNamespace:
        assert depth == 1, "what is old is not to be delivered"
        texts = self.published.setdefault(topic, [])
        return SimpleNamespace(publish=lambda message: texts.append(message.data))

    def create_timer(self, period_s: float, callback: Callable[[], None]) -> None:
        self.timers[period_s] = callback

    def create_service(self, _kind: type, name: str, callback: Callable[[Any, Any], Any]) -> None:
        self.served[name] = callback

    def ask(self, service: str, **request: bool) -> tuple[bool, str]:
        answer = self.served[service](SimpleNamespace(**request), SimpleNamespace())
        return answer.success, answer.message


class String(SimpleNamespace):
    """`std_msgs.msg.String`."""


class Service:
    """Stand-in for a service type of `std_srvs.srv`."""

    Request = Response = SimpleNamespace


def made_node(monkeypatch: pytest.MonkeyPatch, given: dict[str, str], **client: object) -> Node:
    """Make the example's node with the parameters `given`; `client`: stand-ins of its names."""
    stand_in(
        monkeypatch,
        {
            "rclpy": {},
            "rclpy.node": {"Node": Node},
            "std_msgs": {},
            "std_msgs.msg": {"String": String},
            "std_srvs": {},
            "std_srvs.srv": {"SetBool": Service, "Trigger": Service},
            "graspd_client": vars(graspd_client) | client,
        },
    )
    Node.given = given
    made: Node = runpy.run_path(str(NODE))["GraspNode"]()
    return made


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Node:
    endpoints = {"endpoint": f"ipc://{tmp_path}/out", "ask_endpoint": f"ipc://{tmp_path}/ask"}
    return made_node(monkeypatch, endpoints)


@pytest.mark.parametrize(
    ("given", "hand", "endpoint"),
    [
        ({}, "right", "ipc:///run/graspd/right.ipc"),
        ({"hand": "left"}, "left", "ipc:///run/graspd/left.ipc"),
        ({"hand": "left", "endpoint": "ipc:///tmp/l"}, "left", "ipc:///tmp/l"),
    ],
)
def test_the_ros2_node_serves_the_hand_that_it_is_given(
    monkeypatch: pytest.MonkeyPatch, given: dict[str, str], hand: str, endpoint: str
) -> None:
    found: list[object] = []

    def client(endpoint: str, hand: str, *, ask_endpoint: str) -> None:
        found.extend([endpoint, hand, ask_endpoint])

    made_node(monkeypatch, given, Client=client)
    assert found == [endpoint, hand, f"ipc:///run/graspd/{hand}.ask.ipc"]


def test_the_ros2_node_publishes_decisions_answers_and_reports_outcomes(
    node: Node, tmp_path: Path
) -> None:
    decisions = node.published["~/decision"]
    ((period_s, publish),) = node.timers.items()
    assert period_s * 1e3 < 100, "in less than the age limit"

    def is_stable() -> bool:
        publish()
        return decisions[-1] == "stable"

    publish()
    assert decisions == ["unknown no-message"]
    with false_daemon(tmp_path) as heard:
        wait_until(is_stable)
        wait_until(lambda: node.ask("~/may_i_lift") == (True, "stable"))
        wait_until(lambda: node.ask("~/not_lifted") == (True, ""))
        assert heard[-1].endswith(b" 1 not-lifted")
        wait_until(lambda: node.ask("~/may_i_lift") == (True, "stable"))
        wait_until(lambda: node.ask("~/held", data=True) == (True, ""))
        assert node.ask("~/may_i_lift") == (False, "unknown outcome-told")
    node.graspd.close()  # type: ignore[attr-defined]


def test_the_ros2_node_says_why_it_refuses(node: Node, tmp_path: Path) -> None:
    with false_daemon(tmp_path, outcome="unknown", reasons=["moving"]):
        wait_until(lambda: node.ask("~/may_i_lift") == (False, "unknown moving"))
        assert node.ask("~/held", data=True) == (False, "no lift was allowed")
    node.graspd.close()  # type: ignore[attr-defined]
