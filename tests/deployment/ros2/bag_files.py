"""Writes rosbag2 recordings with the writer of the package `rosbags`, for tests.

python tests/deployment/ros2/bag_files.py examples/run_bag     writes the one of the examples
"""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="the package rosbags of the extra `ros` is not installed")

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import iblf_jax as ij

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
JOINT_STATE, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
STRING = "std_msgs/msg/String"
STORAGES = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}


def state_message(stamp, names, q, dq=(), effort=()):
    """A joint state with a stamp [ns]."""
    time = TYPES["builtin_interfaces/msg/Time"](int(stamp) // 10**9, int(stamp) % 10**9)
    header = TYPES["std_msgs/msg/Header"](time, "")
    numbers = (np.asarray(x, float) for x in (q, dq, effort))
    return JOINT_STATE, TYPES[JOINT_STATE](header, list(names), *numbers)


def effort_message(tau):
    layout = TYPES["std_msgs/msg/MultiArrayLayout"]([], 0)
    return ARRAY, TYPES[ARRAY](layout, np.asarray(tau, float))


def string_message(text):
    return STRING, TYPES[STRING](text)


def write_bag(folder, messages, storage="sqlite3", compressed=False):
    """Writes messages (topic, receive time [ns], (type, message)) in the order of their times."""
    connections = {}
    writer = Writer(Path(folder), version=9, storage_plugin=STORAGES[storage])
    if compressed:
        writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        for topic, received, (kind, message) in sorted(messages, key=lambda x: x[1]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], int(received), STORE.serialize_cdr(message, kind))
    return folder


def messages_of(t, names, q, tau, dq=None, *, origin=0, latency=300_000, delay=50_000):
    """Joint states, received `delay` ns after their stamps, and answers `latency` ns later."""
    found = []
    for k, time in enumerate(t):
        stamp = origin + round(time * 1e9)
        state = state_message(stamp, names, q[k], () if dq is None else dq[k])
        found.append(("/joint_states", stamp + delay, state))
        if tau[k] is not None:
            found.append(("/efforts", stamp + delay + latency, effort_message(tau[k])))
    return found


def example_scenario():
    """The scenario of the recording in the examples, as `docs/how_to/from_a_log.md` has it."""
    return ij.with_parts(
        ij.presets.zhang_yan_2024(),
        controller=ij.controllers.Backstepping(k1=2.0, K2=4.0, o=0.1),
        observer=ij.observers.Momentum(kf=10.0),
        sampling=ij.Sampling(4e-3),
        disturbance=ij.disturbances.Friction(viscous=0.05, coulomb=0.05),
    )


EXAMPLE = {"plant.mass": np.array([2.2, 1.0]), "disturbance.viscous": np.array([0.15, 0.08])}
"""What the arm in the examples differs in from its scenario."""


def example_messages():
    """4 s of the law on that arm, with encoders of 16 bits."""
    encoder = ij.sensors.Encoder(counts=65536, velocity=ij.sensors.Measured())
    scenario = ij.with_parts(ij.with_parameters(example_scenario(), EXAMPLE), sensor=encoder)
    run = ij.simulate(scenario, duration=4.0, dt=1e-3, record_every=4)
    t, q, dq, tau = (np.asarray(x) for x in (run.t, run.measured.q, run.measured.dq, run.tau))
    return messages_of(t, ("shoulder", "elbow"), q, tau, dq, origin=1_700_000_000 * 10**9)


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    write_bag(sys.argv[1], example_messages(), "mcap", compressed=True)
