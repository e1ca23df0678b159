"""A proportional-derivative law as a ROS 2 node: a counterpart of the simulated robot that shares
no code with the package.

    python pd_law.py [--wrong-length] [--samples N] [--ros-args ...]
"""

import argparse
import math

import rclpy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

STIFFNESS, DAMPING, AMPLITUDE = 30.0, 1.5, 0.3


def torque(t: float, q: list[float], dq: list[float]) -> list[float]:
    """Of each joint [N m], towards the reference 0.5 + 0.3 sin t [rad]."""
    desired = 0.5 + AMPLITUDE * math.sin(t)
    return [
        STIFFNESS * (desired - position) - DAMPING * velocity
        for position, velocity in zip(q, dq, strict=True)
    ]


class Law:
    def __init__(self, node, arguments):
        self.arguments = arguments
        self.last, self.answers = None, 0
        self.publisher = node.create_publisher(Float64MultiArray, "efforts", 10)
        self.subscription = node.create_subscription(JointState, "joint_states", self.state, 10)

    def state(self, message):
        stamp = message.header.stamp
        t = stamp.sec + 1e-9 * stamp.nanosec
        if t == self.last:
            return
        self.last = t
        self.answers += 1
        if self.arguments.wrong_length and self.answers == 3:
            self.publisher.publish(Float64MultiArray(data=[1e3]))
            self.publisher.publish(Float64MultiArray(data=[1e3, 1e3, 1e3]))
            self.publisher.publish(Float64MultiArray(data=[math.nan, 1e3]))
        assert len(message.name) == len(message.effort) == len(message.velocity)
        effort = torque(t, message.position, message.velocity)
        if self.arguments.zero:
            effort = [0.0] * len(effort)
        self.publisher.publish(Float64MultiArray(data=effort))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--wrong-length", action="store_true")
    parser.add_argument("--samples", type=int, default=1 << 30)
    parser.add_argument("--zero", action="store_true")
    arguments, _ = parser.parse_known_args()
    rclpy.init()
    node = rclpy.create_node("pd_law")
    law = Law(node, arguments)
    while rclpy.ok() and law.answers < arguments.samples:
        rclpy.spin_once(node, timeout_sec=0.05)


if __name__ == "__main__":
    main()
