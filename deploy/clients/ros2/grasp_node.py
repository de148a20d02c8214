"""A ROS 2 node: publishes verdicts, answers whether to lift, reports how a lift ended. Copy
../python/graspd_client.py beside it: `python3 grasp_node.py --ros-args -p hand:=right`."""

from __future__ import annotations

import rclpy
from graspd_client import Client, Outcome, Verdict
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger


class GraspNode(Node):
    """Node with the topic `~/decision`, only to look at, and the services `~/may_i_lift`, `~/held`
    and, if no lift follows a yes, `~/not_lifted`. A lift must rely on the service."""

    def __init__(self) -> None:
        super().__init__("graspd")
        hand = self.declare_parameter("hand", "right").value
        endpoint = self.declare_parameter("endpoint", f"ipc:///run/graspd/{hand}.ipc")
        ask_endpoint = self.declare_parameter("ask_endpoint", f"ipc:///run/graspd/{hand}.ask.ipc")
        self.graspd = Client(endpoint.value, hand, ask_endpoint=ask_endpoint.value)
        self.lifted_on: Verdict | None = None
        self.decisions = self.create_publisher(String, "~/decision", 1)
        self.create_timer(0.02, self.publish_decision)
        self.create_service(Trigger, "~/may_i_lift", self.may_i_lift)
        self.create_service(SetBool, "~/held", self.held)
        self.create_service(Trigger, "~/not_lifted", self.not_lifted)

    def publish_decision(self) -> None:
        self.decisions.publish(String(data=_words(self.graspd.verdict())))

    def may_i_lift(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        answer = self.graspd.may_i_lift(0.5)
        if answer:
            self.lifted_on = answer.verdict
        response.success, response.message = bool(answer), _words(answer.verdict)
        return response

    def held(self, held: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = self.tell("held" if held.data else "slipped")
        return response

    def not_lifted(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = self.tell(Outcome.NOT_LIFTED)
        return response

    def tell(self, outcome: Outcome | str) -> tuple[bool, str]:
        if self.lifted_on is None:
            return False, "no lift was allowed"
        answer = self.graspd.tell(self.lifted_on, outcome)
        return bool(answer), answer.why


def _words(verdict: Verdict) -> str:
    return " ".join([verdict.decision, *verdict.reasons])


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(GraspNode())
