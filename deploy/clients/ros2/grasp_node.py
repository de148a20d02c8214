"""A ROS 2 node: publishes verdicts, answers whether to lift, reports how a lift ended. Copy
../python/graspd_client.py beside it: `python3 grasp_node.py --ros-args -p endpoint:=...`."""

from __future__ import annotations

import rclpy
from graspd_client import Client, Verdict
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger


class GraspNode(Node):
    """Node with the topic `~/decision`, only to look at, and the services `~/may_i_lift` and
    `~/held`. A lift must rely on the service."""

    def __init__(self) -> None:
        super().__init__("graspd")
        endpoint = self.declare_parameter("endpoint", "ipc:///run/graspd/right.ipc")
        ask_endpoint = self.declare_parameter("ask_endpoint", "ipc:///run/graspd/right.ask.ipc")
        self.graspd = Client(endpoint.value, ask_endpoint=ask_endpoint.value)
        self.lifted_on: Verdict | None = None
        self.decisions = self.create_publisher(String, "~/decision", 1)
        self.create_timer(0.02, self.publish_decision)
        self.create_service(Trigger, "~/may_i_lift", self.may_i_lift)
        self.create_service(SetBool, "~/held", self.tell)

    def publish_decision(self) -> None:
        self.decisions.publish(String(data=_words(self.graspd.verdict())))

    def may_i_lift(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        answer = self.graspd.may_i_lift(0.5)
        if answer:
            self.lifted_on = answer.verdict
        response.success, response.message = bool(answer), _words(answer.verdict)
        return response

    def tell(self, held: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if self.lifted_on is None:
            response.success, response.message = False, "no lift was allowed"
            return response
        answer = self.graspd.tell(self.lifted_on, "held" if held.data else "slipped")
        response.success, response.message = bool(answer), answer.why
        return response


def _words(verdict: Verdict) -> str:
    return " ".join([verdict.decision, *verdict.reasons])


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(GraspNode())
