"""An arm of seven joints beside what a user would take instead: steps per second of many runs, RK4
at 1 ms, in one run of the benchmark.

    python benchmarks/arm.py [--quick] [--json FILE] [--runs 4096] [--steps 200]

Rows: `native` on the closed loop of `presets.iiwa14` (with its load), the state alone and with the
  standard metrics; the same loop in
C++ on Pinocchio (`peers/arm_loop.cc`; needs the wheel `pin`, and Eigen); MuJoCo's own `rollout` and
MJX on the bare plant, which is less than half of the work.  `of the limit` is the part of what the
operations of the step would take at two vector instructions a cycle on every core (`ij.explain`).
`q differs` is from this package's run, after as many steps.  A row that needs what is not there is
left out.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib.util
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from _timing import compile_seconds, report
from scipy.spatial.transform import Rotation
from throughput import measured, method_for

import iblf_jax as ij
from iblf_jax.core import devices
from iblf_jax.engine import RunRequest
from iblf_jax.engine.execute import run_batch
from iblf_jax.engine.structural_constants import robot_constants
from iblf_jax.kernels import toolchain
from iblf_jax.simulation.metrics import as_folds
from iblf_jax.simulation.scenario import canonical

DT = 1e-3


def starts(scenario, runs: int) -> np.ndarray:
    """One a run, near the scenario's."""
    return np.asarray(scenario.initial.q) + 0.01 * np.random.default_rng(0).standard_normal(
        (runs, scenario.n)
    )


def native(dtype: str, metrics, runs: int, steps: int, method: str) -> tuple[float, float, float]:
    """Seconds to compile, and wall and processor seconds of a batch."""
    scenario = canonical(ij.astype(ij.presets.iiwa14(), dtype))
    folds, run = (
        as_folds(metrics, dtype, scenario),
        RunRequest(steps, method, constants=robot_constants(scenario), backend="native"),
    )
    values, dt = {"initial.q": jnp.asarray(starts(scenario, runs), dtype)}, jnp.asarray(DT, dtype)
    seconds, call = compile_seconds(
        lambda v, dt: run_batch(scenario, v, folds, dt, run), values, dt
    )
    return seconds, *measured(lambda: call(values, dt), 3)


def links(robot) -> np.ndarray:
    """Rows of `peers/arm_loop.cc`, one a link."""
    rotation = (
        Rotation.from_quat(np.asarray(robot.rotation), scalar_first=True).as_matrix().reshape(-1, 9)
    )
    parts = (
        robot.mass[:, None],
        robot.centre,
        robot.inertia,
        rotation,
        robot.position,
        robot.axis,
        robot.armature[:, None],
    )
    return np.ascontiguousarray(np.concatenate([np.asarray(x, float) for x in parts], axis=1))


def pinocchio_flags() -> list[str] | None:
    """How to compile with Pinocchio, or None if it is not there."""
    if importlib.util.find_spec("pinocchio") is None:
        return None
    prefix = Path(importlib.util.find_spec("pinocchio").origin).parents[4]
    found = subprocess.run(
        ["pkg-config", "--cflags", "eigen3"], capture_output=True, text=True, check=False
    )
    eigen = found.stdout.split() if found.returncode == 0 else ["-I/usr/include/eigen3"]
    # Boost's lists hold twenty types unless they are told; Pinocchio has more joints.
    boost = ["-DBOOST_MPL_LIMIT_LIST_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS"]
    return [
        *boost,
        *eigen,
        f"-I{prefix}/include",
        f"-L{prefix}/lib",
        f"-Wl,-rpath,{prefix}/lib",
        "-lpinocchio_default",
    ]


def with_pinocchio(runs: int, steps: int) -> tuple[float, float, float, float]:
    """Seconds of a batch (compiling is not counted), and how far its positions are from this
    package's.
    """
    scenario = canonical(ij.presets.iiwa14())
    n, law = scenario.n, scenario.controller.law
    positions = scenario.bounds[0]
    waves = [
        getattr(wave, name)
        for wave in (scenario.reference, positions.lower, positions.upper, scenario.disturbance)
        for name in ("offset", "amplitude", "frequency", "phase")
    ]
    rows = [law.k1, law.K2, law.o, scenario.observer.kf, scenario.controller.limit, *waves]
    rows = np.ascontiguousarray(
        np.stack([np.broadcast_to(np.asarray(x, float), (n,)) for x in rows])
    )
    tip = np.concatenate(
        [np.asarray(scenario.plant.tip_position, float), np.asarray(scenario.plant.g, float)]
    )
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "arm_loop.so"
        text = Path(__file__).parent / "peers" / "arm_loop.cc"
        options = [
            "-std=c++17",
            "-O3",
            "-march=native",
            "-DNDEBUG",
            "-w",
            "-fPIC",
            "-shared",
            "-pthread",
        ]
        subprocess.run(
            [*toolchain.compiler(), *options, str(text), *pinocchio_flags(), "-o", str(library)],
            check=True,
        )
        loop = ctypes.CDLL(str(library)).arm_loop

    def run() -> np.ndarray:
        states = np.zeros((runs, 3 * n))
        states[:, :n] = starts(scenario, runs)
        arrays = [
            x.ctypes.data_as(ctypes.c_void_p) for x in (links(scenario.plant), tip, rows, states)
        ]
        counts = [ctypes.c_long(x) for x in (runs, steps)]
        load = ctypes.c_double(float(scenario.plant.payload))
        loop(
            ctypes.c_int(n),
            *arrays[:2],
            load,
            *arrays[2:],
            *counts,
            ctypes.c_double(DT),
            ctypes.c_long(devices.threads()),
        )
        return states

    wall, used = measured(run, 3)
    alone = ij.with_parameters(scenario, {"initial.q": starts(scenario, runs)[0]})
    reference = ij.simulate(alone, duration=steps * DT, dt=DT, record_every=steps).q[-1]
    return math.nan, wall, used, float(np.max(np.abs(run()[0, :n] - np.asarray(reference))))


def mjcf(robot) -> str:
    """The bare plant with its load, for MuJoCo."""
    head, tail = "", ""
    words = lambda x: " ".join(f"{float(y):.17g}" for y in np.ravel(x))  # noqa: E731
    for i in range(robot.n):
        inertial = (
            f'<inertial pos="{words(robot.centre[i])}" mass="{words(robot.mass[i])}"'
            f' fullinertia="{words(robot.inertia[i])}"/>'
        )
        head += (
            f'<body pos="{words(robot.position[i])}" quat="{words(robot.rotation[i])}"><joint'
            f' axis="{words(robot.axis[i])}"/>{inertial}'
        )
        tail += "</body>"
    small = 'diaginertia="1e-9 1e-9 1e-9"'
    load = (
        f'<body pos="{words(robot.tip_position)}"><inertial pos="0 0 0"'
        f' mass="{words(robot.payload)}" {small}/></body>'
    )
    option = f'<option integrator="RK4" timestep="{DT}" gravity="{words(robot.g)}"/>'
    return f"<mujoco>{option}<worldbody>{head}{load}{tail}</worldbody></mujoco>"


def with_mujoco(runs: int, steps: int) -> tuple[float, float, float]:
    """MuJoCo's rollout of the plant alone, torques zero."""
    import mujoco
    from mujoco import rollout

    scenario = ij.presets.iiwa14()
    model = mujoco.MjModel.from_xml_string(mjcf(scenario.plant))
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.zeros((runs, size))
    state[:, 1 : 1 + scenario.n] = starts(scenario, runs)
    data = [mujoco.MjData(model) for _ in range(devices.threads())]
    return math.nan, *measured(lambda: rollout.rollout(model, data, state, nstep=steps)[0], 3)


def with_mjx(runs: int, steps: int) -> tuple[float, float, float]:
    """MJX of the plant alone, torques zero, float32."""
    import mujoco
    from mujoco import mjx

    scenario = ij.presets.iiwa14()
    with jax.enable_x64(False):
        model = mjx.put_model(mujoco.MjModel.from_xml_string(mjcf(scenario.plant)))
        start = mjx.make_data(model)

        def one(q):
            step = lambda _, data: mjx.step(model, data)  # noqa: E731
            return jax.lax.fori_loop(0, steps, step, start.replace(qpos=q)).qpos

        q = jnp.asarray(starts(scenario, runs), "float32")
        seconds, call = compile_seconds(jax.vmap(one), q)
        return seconds, *measured(lambda: call(q), 1)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json")
    parser.add_argument("--runs", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=200)
    options = parser.parse_args()
    runs, steps = (8, 10) if options.quick else (options.runs, options.steps)
    method = method_for(options.quick)
    rows = []

    def add(name: str, dtype: str, made: int, found: tuple, limit: float = math.nan) -> None:
        seconds, wall, used, *rest = found
        rows.append(
            [
                name,
                dtype,
                runs,
                made,
                seconds,
                runs * made / wall,
                runs * made / used,
                runs * made / wall / limit,
                *(rest or [math.nan]),
            ]
        )
        print(f"{name} {dtype}: {runs * made / wall:.3g} steps/s", file=sys.stderr, flush=True)

    kinds = (("native, state alone", ()), ("native, standard metrics", None))
    wanted = [(dtype, *kind) for dtype in ("float64", "float32") for kind in kinds]
    for dtype, name, metrics in wanted[:1] if options.quick else wanted:
        limit = ij.explain(
            ij.astype(ij.presets.iiwa14(), dtype), method=method, metrics=metrics
        ).limit
        add(name, dtype, steps, native(dtype, metrics, runs, steps, method), limit)
    if not options.quick and pinocchio_flags():
        add("Pinocchio in C++", "float64", steps, with_pinocchio(runs, steps))
    if importlib.util.find_spec("mujoco"):
        add("MuJoCo rollout, plant alone", "float64", steps, with_mujoco(runs, steps))
    if not options.quick and importlib.util.find_spec("mujoco.mjx"):
        few, short = (
            min(runs, 64),
            max(steps // 20, 1),
        )  # on a CPU it is made for neither many runs nor many steps
        add("MJX, plant alone", "float32", short, with_mjx(few, short), runs=few)
    columns = [
        "row",
        "type",
        "runs",
        "steps",
        "compile s",
        "steps/s",
        "steps/s per core",
        "of the limit",
        "q differs [rad]",
    ]
    report(f"iiwa14, {method} at 1 ms", columns, rows, options.json)


if __name__ == "__main__":
    main()
