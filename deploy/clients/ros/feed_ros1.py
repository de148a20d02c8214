"""A ROS 1 node that sends a Shadow hand's counts and joint angles to graspd. Untried under ROS."""

import json
import socket

import rospy
from sensor_msgs.msg import JointState
from sr_robot_msgs.msg import BiotacAll

ORDER = ["ff", "mf", "rf", "lf", "th"]  # fingers of BiotacAll.tactiles
rospy.init_node("graspd_feeder")
SIDE = rospy.get_param("~side", "rh")
HAND = rospy.get_param("~hand", "left" if SIDE == "lh" else "right")
FINGERS = rospy.get_param("~fingers", "ff mf th").split()
ADDRESS = rospy.get_param("~address", "127.0.0.1")
PORT = rospy.get_param("~port", 9872)  # port of the counts; the joints' port is one less
SENDER = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
SENDER.bind(("", PORT + 1))  # fixed, as counts from another port are of other sensors


def _send(port: int, message: object, **values: object) -> None:
    stamp = {"seq": message.header.seq or None, "t": message.header.stamp.to_sec() or None}
    SENDER.sendto(json.dumps({**stamp, **values}).encode(), (ADDRESS, port))


def _send_counts(message: BiotacAll) -> None:
    counts = {each: list(message.tactiles[ORDER.index(each)].electrodes) for each in FINGERS}
    _send(PORT, message, hand=HAND, counts=counts)


def _send_joints(message: JointState) -> None:
    angles = {message.name[place]: angle for place, angle in enumerate(message.position)}
    mine = {name: angle for name, angle in angles.items() if name.startswith(SIDE)}
    if mine:  # an arm may publish on the same topic
        _send(PORT - 1, message, joints=mine)


rospy.Subscriber(f"/{SIDE}/tactile", BiotacAll, _send_counts, queue_size=1)
rospy.Subscriber("/joint_states", JointState, _send_joints, queue_size=1)
rospy.spin()
