"""Seven joints that MuJoCo moved: an engine that shares nothing with the package, under a computed
torque with wrong masses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from arm_cases import as_mjcf

import iblf_jax as ij
from iblf_jax import disturbances

COUNT = 2.0 * np.pi / 2**14
DAMPING = np.array([1.0, 1.0, 0.8, 0.8, 0.4, 0.3, 0.2])
ARMATURE = np.array([0.1, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05])
DRY = np.array([2.0, 2.0, 1.5, 1.5, 0.6, 0.6, 0.3])
"""Dry friction, which MuJoCo solves for as a soft constraint: a joint sticks, and gives way slowly
[N m]."""
FACTOR = np.array([1.0, 1.1, 0.9, 1.08, 0.93, 1.05, 1.4])
"""True masses by those of the file."""
MIDDLE = np.array([0.0, 0.5, 0.0, -1.2, 0.0, 0.8, 0.0])


def described(arm, mass, dry):
    """The arm with friction as a model of MuJoCo's."""
    import mujoco

    fields = {"mass": mass, "damping": DAMPING, "armature": ARMATURE, "friction": dry}
    model = mujoco.MjModel.from_xml_string(as_mjcf(dataclasses.replace(arm, **fields)))
    model.opt.timestep, model.opt.integrator = 5e-4, mujoco.mjtIntegrator.mjINT_RK4
    return model


def logged(arm, duration, dry, seed=0, step=2e-3):
    """t, q in counts and the held torque."""
    import mujoco

    rng = np.random.default_rng(seed)
    A, P = rng.uniform(0.1, 0.3, (3, 7)), rng.uniform(0, 6.28, (3, 7))
    W = np.array([[1.0], [2.2], [4.0]]) * rng.uniform(0.8, 1.2, (3, 7))
    nominal = np.asarray(arm.mass)
    true, known = described(arm, nominal * FACTOR, dry), described(arm, nominal, 0 * dry)
    moving, thinking = mujoco.MjData(true), mujoco.MjData(known)

    def reference(t):
        """Position, velocity and acceleration."""
        s, c = np.sin(W * t + P), np.cos(W * t + P)
        return (
            MIDDLE + np.sum(A * s, axis=0),
            np.sum(A * W * c, axis=0),
            -np.sum(A * W**2 * s, axis=0),
        )

    moving.qpos[:], moving.qvel[:], _ = reference(0.0)
    before, speed, M, rows = None, moving.qvel.copy(), np.zeros((7, 7)), []
    for k in range(round(duration / step)):
        t, y = k * step, COUNT * np.round(moving.qpos / COUNT)
        speed, before = speed if before is None else 0.7 * speed + 0.3 * (y - before) / step, y
        desired, rate, push = reference(t)
        thinking.qpos[:], thinking.qvel[:] = y, speed
        mujoco.mj_forward(known, thinking)
        mujoco.mj_fullM(known, thinking, M)
        push = push + 100.0 * (desired - y) + 20.0 * (rate - speed)
        tau = M @ push + thinking.qfrc_bias + DAMPING * rate
        rows.append((t, y, tau))
        moving.qfrc_applied[:] = tau
        mujoco.mj_step(true, moving, nstep=4)
    return dict(zip(("t", "q", "tau"), map(np.array, zip(*rows, strict=True)), strict=True))


@pytest.mark.release
@pytest.mark.parametrize("dry", [0.0 * DRY, DRY], ids=["viscous", "dry"])
def test_seven_joints_of_mujoco(dry):
    """All numbers within their errors, masses within a percent, also with dry friction; the first
    link's mass and armature are one."""
    pytest.importorskip("mujoco")
    scenario = ij.with_parts(ij.presets.iiwa14(payload=0.0), disturbance=disturbances.Nothing())
    start = ij.with_parameters(scenario, {"robot.damping": 0.5, "robot.armature": 0.05})
    truth = {
        "robot.mass": np.asarray(scenario.plant.mass) * FACTOR,
        "robot.damping": DAMPING,
        "robot.armature": ARMATURE,
    }
    truth |= {"robot.friction": dry} if dry.any() else {}
    known = ij.identify(start, logged(scenario.plant, 12.0, dry), list(truth))
    z = np.concatenate(
        [(known.values[path] - x) / known.standard_errors[path] for path, x in truth.items()]
    )
    untold = {number.name for number in known.numbers if number.verdict == "cannot be told"}
    assert {number.name for number in known.numbers if number.verdict == "left free"} == set(
        known.names[21 + np.sum(dry > 0) :]
    )
    assert untold == {"robot.mass[0]", "robot.armature[0]"}
    assert np.nanmax(np.abs(z)) < 4.0 and np.mean(np.abs(z[np.isfinite(z)]) < 3.0) > 0.9
    assert np.nanmax(np.abs(known.values["robot.mass"] / truth["robot.mass"] - 1.0)) < 0.01
    assert all(one.after < 1.15 * COUNT / np.sqrt(12) for one in known.fit)
