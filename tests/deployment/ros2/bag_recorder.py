"""Records `joint_states` and `efforts` as rosbag2 does, until SIGTERM.

    python bag_recorder.py FOLDER

The messages are stored as ROS serialised them, with the times at which the middleware received
them.
It prints "ready" once it is subscribed.
"""

from __future__ import annotations

import signal
import sys

import rclpy
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

KINDS = {
    "joint_states": (JointState, "sensor_msgs/msg/JointState"),
    "efforts": (Float64MultiArray, "std_msgs/msg/Float64MultiArray"),
}


def main(folder: str) -> None:
    ended = []
    signal.signal(signal.SIGTERM, lambda *_: ended.append(True))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("recorder")
    rows = []

    def subscribe(topic):
        def record(raw, info):
            rows.append((info["received_timestamp"], topic, bytes(raw)))

        node.create_subscription(KINDS[topic][0], topic, record, QoSProfile(depth=5000), raw=True)

    for topic in KINDS:
        subscribe(topic)
    print("ready", flush=True)
    while not ended:
        rclpy.spin_once(node, timeout_sec=0.05)
    rows.sort(key=lambda row: row[0])
    store = get_typestore(Stores.LATEST)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            topic: writer.add_connection(f"/{topic}", kind, typestore=store)
            for topic, (_, kind) in KINDS.items()
        }
        for received, topic, raw in rows:
            writer.write(connections[topic], received, raw)


if __name__ == "__main__":
    main(sys.argv[1])
