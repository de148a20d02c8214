"""The example for ROS 2, beside stand-ins for what it imports of ROS 2: rclpy is not there."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from deploy.clients.python import graspd_client
from tests.clients.building import CPP
from tests.clients.false_daemon import false_daemon
from tests.kit.waiting import wait_until

EXAMPLE = CPP.parent / "ros2" / "grasp_node.py"


class Node:
    """The part of `rclpy.node.Node` that the example uses."""

    endpoints: dict[str, str]

    def __init__(self, name: str) -> None:
        self.name = name
        self.published: dict[str, list[str]] = {}
        self.timers: dict[float, Callable[[], None]] = {}
        self.served: dict[str, Callable[[Any, Any], Any]] = {}

    def declare_parameter(self, name: str, value: str) -> SimpleNamespace:
        assert value.startswith("ipc:///run/graspd/")
        return SimpleNamespace(value=self.endpoints[name])

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


@dataclass
class String:
    """`std_msgs.msg.String`."""

    data: str


class Service:
    """A kind of service."""

    Request = Response = SimpleNamespace


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Node:
    stand_ins: dict[str, dict[str, object]] = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "std_msgs": {},
        "std_msgs.msg": {"String": String},
        "std_srvs": {},
        "std_srvs.srv": {"SetBool": Service, "Trigger": Service},
    }
    for name, holds in stand_ins.items():
        module = ModuleType(name)
        vars(module).update(holds)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "graspd_client", graspd_client)
    Node.endpoints = {"endpoint": f"ipc://{tmp_path}/out", "ask_endpoint": f"ipc://{tmp_path}/ask"}
    spec = importlib.util.spec_from_file_location("grasp_node", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    made: Node = example.GraspNode()
    return made


def test_the_node_publishes_answers_and_tells(node: Node, tmp_path: Path) -> None:
    decisions = node.published["~/decision"]
    ((period_s, publish),) = node.timers.items()
    assert period_s * 1e3 < 100, "in less than the age limit"

    def is_stable() -> bool:
        publish()
        return decisions[-1] == "stable"

    publish()
    assert decisions == ["unknown no-message"]
    with false_daemon(tmp_path):
        wait_until(is_stable)
        wait_until(lambda: node.ask("~/may_i_lift") == (True, "stable"))
        wait_until(lambda: node.ask("~/held", data=True) == (True, ""))
        assert node.ask("~/may_i_lift") == (False, "unknown outcome-told")
    node.graspd.close()  # type: ignore[attr-defined]


def test_the_node_says_why_it_refuses(node: Node, tmp_path: Path) -> None:
    with false_daemon(tmp_path, outcome="unknown", reasons=["moving"]):
        wait_until(lambda: node.ask("~/may_i_lift") == (False, "unknown moving"))
        assert node.ask("~/held", data=True) == (False, "no lift was allowed")
    node.graspd.close()  # type: ignore[attr-defined]
