"""A ROS 2 node that sends a Shadow hand's counts and joint angles to graspd. Untried under ROS."""

import json
import socket

import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from sr_robot_msgs.msg import BiotacAll

ORDER = ["ff", "mf", "rf", "lf", "th"]  # fingers of BiotacAll.tactiles
rclpy.init()
NODE = rclpy.create_node("graspd_feeder")
SIDE = NODE.declare_parameter("side", "rh").value
HAND = NODE.declare_parameter("hand", "left" if SIDE == "lh" else "right").value
FINGERS = NODE.declare_parameter("fingers", "ff mf th").value.split()
TO = NODE.declare_parameter("address", "127.0.0.1").value
PORT = NODE.declare_parameter("port", 9872).value  # port of counts; joints: one less
SENDER = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
SENDER.bind(("", PORT + 1))  # fixed, as counts from another port are of other sensors


def _send_counts(message: BiotacAll) -> None:
    counts = {each: list(message.tactiles[ORDER.index(each)].electrodes) for each in FINGERS}
    stamp = message.header.stamp
    fields = {"t": stamp.sec + stamp.nanosec * 1e-9 or None, "hand": HAND, "counts": counts}
    SENDER.sendto(json.dumps(fields).encode(), (TO, PORT))


def _send_joints(message: JointState) -> None:
    angles = {message.name[place]: angle for place, angle in enumerate(message.position)}
    mine = {name: angle for name, angle in angles.items() if name.startswith(SIDE)}
    time_s = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9 or None
    if mine:  # an arm may publish on the same topic
        SENDER.sendto(json.dumps({"t": time_s, "joints": mine}).encode(), (TO, PORT - 1))


NODE.create_subscription(BiotacAll, f"/{SIDE}/tactile", _send_counts, qos_profile_sensor_data)
NODE.create_subscription(JointState, "/joint_states", _send_joints, qos_profile_sensor_data)
rclpy.spin(NODE)
