"""An arm at rest that a joint controller moves to a reference, by this package and by the MuJoCo
libraries for GPUs: MJX and MuJoCo Warp.

The controller is `PDGravity` with a constant reference.  In MuJoCo it is a position servo of each
joint, tau = kp (q_d - q) - kv q', and `gravcomp` of each body, which adds the torques of gravity.
All of them integrate the same arm by RK4 with the same step; each run has its own start.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import iblf_jax as ij
from iblf_jax.presets.arms import inertial_gain
from iblf_jax.simulation.scenario import canonical

DT = 1e-3
RATE = 20.0
"""Damping of a joint divided by its inertia [1/s]; the stiffness is RATE^2 / 4 times the
inertia."""
REACH = 0.3
"""Distance of the reference from the start, on every joint [rad]."""


def servo_scenario(dtype: str):
    """The `iiwa14` with a PD law, gravity compensation and a constant reference."""
    preset = canonical(ij.presets.iiwa14())
    start = np.asarray(preset.initial.q)
    damping = np.asarray(inertial_gain(preset.plant, start, RATE, least=1e-6))
    scenario = ij.Scenario(
        plant=preset.model,
        reference=ij.references.Sinusoid(
            offset=start + REACH, amplitude=np.zeros(preset.n), frequency=1.0, phase=0.0
        ),
        bounds=ij.bounds.Bounds(
            ij.bounds.Constant(start - np.pi), ij.bounds.Constant(start + np.pi)
        ),
        controller=ij.controllers.PDGravity(Kp=0.25 * RATE * damping, Kd=damping),
        observer=ij.observers.NoObserver(),
        initial=ij.Initial(q=start),
    )
    return canonical(ij.astype(scenario, dtype))


def starts(scenario, runs: int) -> np.ndarray:
    """A start for each run."""
    noise = np.random.default_rng(0).standard_normal((runs, scenario.n))
    return np.asarray(scenario.initial.q, float) + 0.01 * noise


def numbers(x) -> str:
    """The text of some numbers in a file of MuJoCo."""
    return " ".join(f"{float(y):.17g}" for y in np.ravel(x))


def mjcf(scenario) -> str:
    """The arm and its controller for MuJoCo."""
    robot = scenario.plant
    law = scenario.controller
    bodies = ""
    servos = ""
    for i in range(robot.n):
        bodies += (
            f'<body pos="{numbers(robot.position[i])}" quat="{numbers(robot.rotation[i])}"'
            f' gravcomp="1"><joint name="joint{i}" axis="{numbers(robot.axis[i])}"'
            f' armature="{numbers(robot.armature[i])}"/><inertial'
            f' pos="{numbers(robot.centre[i])}" mass="{numbers(robot.mass[i])}"'
            f' fullinertia="{numbers(robot.inertia[i])}"/>'
        )
        servos += (
            f'<position joint="joint{i}" kp="{numbers(law.Kp[i])}" kv="{numbers(law.Kd[i])}"/>'
        )
    bodies += "</body>" * robot.n
    option = f'<option integrator="RK4" timestep="{DT}" gravity="{numbers(robot.g)}"/>'
    return f"<mujoco>{option}<worldbody>{bodies}</worldbody><actuator>{servos}</actuator></mujoco>"


def with_mjx(runs: int, steps: int) -> Callable:
    """A function of no arguments that returns the positions of all runs by MJX, (runs, n)."""
    import mujoco
    from mujoco import mjx

    scenario = servo_scenario("float32")
    with jax.enable_x64(False):
        model = mjx.put_model(mujoco.MjModel.from_xml_string(mjcf(scenario)), impl="jax")
        goal = jnp.asarray(scenario.initial.q + REACH, "float32")
        start = mjx.make_data(model).replace(ctrl=goal)

        def one(q):
            step = lambda _, data: mjx.step(model, data)  # noqa: E731
            return jax.lax.fori_loop(0, steps, step, start.replace(qpos=q)).qpos

        q = jnp.asarray(starts(scenario, runs), "float32")
        compiled = jax.jit(jax.vmap(one)).lower(q).compile()
    return lambda: compiled(q)


def with_mujoco_warp(runs: int, steps: int) -> Callable:
    """The same by MuJoCo Warp, its step captured as a CUDA graph."""
    import mujoco
    import mujoco_warp
    import warp

    scenario = servo_scenario("float32")
    model = mujoco.MjModel.from_xml_string(mjcf(scenario))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    on_device = mujoco_warp.put_model(model)
    worlds = mujoco_warp.put_data(model, data, nworld=runs, nconmax=1, njmax=1)
    q = starts(scenario, runs).astype("float32")
    goal = np.tile(np.asarray(scenario.initial.q + REACH, "float32"), (runs, 1))
    mujoco_warp.step(on_device, worlds)  # compiles
    with warp.ScopedCapture() as capture:
        mujoco_warp.step(on_device, worlds)

    def call():
        worlds.qpos.assign(q)
        worlds.qvel.zero_()
        worlds.ctrl.assign(goal)
        for _ in range(steps):
            warp.capture_launch(capture.graph)
        warp.synchronize()
        return worlds.qpos.numpy()

    return call
