"""The largest errors of the methods whose throughput is compared.

    python benchmarks/errors.py [--quick] [--json FILE]

An error is the largest distance of a position at a time step of 1 ms from the same program at an
eighth of the step, whose own error is some thousand times smaller with RK4.  The runs are those of
`throughput.py` (the paper's loop, float64, for 2 s) and of `arm.py` (the iiwa 14, float64, for
0.2 s, with law and observer; MuJoCo has the plant alone, with torques of zero).
"""

from __future__ import annotations

import argparse

import jax

jax.config.update("jax_enable_x64", True)

import arm
import jax.numpy as jnp
import numpy as np
from _timing import report
from throughput import textbook_slope

import iblf_jax as ij

DT = 1e-3
"""s, of the compared runs."""
FINER = 8
"""Steps of the reference in one of these."""


def with_textbook(duration: float, dt: float) -> np.ndarray:
    """Positions of the loop in plain JAX by RK4, (T, 2) [rad]."""
    scenario = ij.presets.zhang_yan_2024()
    mass, start = scenario.plant.mass[1], scenario.initial.q

    def add(x, h, k):
        return jax.tree.map(lambda a, b: a + h * b, x, k)

    def step(x, i):
        t = i * dt
        k1 = textbook_slope(mass, t, x)
        k2 = textbook_slope(mass, t + dt / 2, add(x, dt / 2, k1))
        k3 = textbook_slope(mass, t + dt / 2, add(x, dt / 2, k2))
        k4 = textbook_slope(mass, t + dt, add(x, dt, k3))
        for k, weight in ((k1, 1 / 6), (k2, 1 / 3), (k3, 1 / 3), (k4, 1 / 6)):
            x = add(x, dt * weight, k)
        return x, x[0]

    steps = jnp.arange(round(duration / dt), dtype=float)
    return np.asarray(jax.lax.scan(step, (start, 0 * start, 0 * start), steps)[1])


def with_simulate(scenario: ij.Scenario, duration: float, dt: float) -> np.ndarray:
    """Positions of a run of this package after its first instant, (T, n) [rad]."""
    return np.asarray(ij.simulate(scenario, duration=duration, dt=dt).q[1:])


def with_mujoco(duration: float, dt: float) -> np.ndarray:
    """Positions of MuJoCo's rollout of the iiwa 14 without torques, (T, 7) [rad]."""
    import mujoco
    from mujoco import rollout

    scenario = ij.presets.iiwa14()
    model = mujoco.MjModel.from_xml_string(arm.mjcf(scenario.plant))
    model.opt.timestep = dt
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.zeros((1, size))
    state[:, 1 : 1 + scenario.n] = scenario.initial.q
    steps = round(duration / dt)
    found = rollout.rollout(model, mujoco.MjData(model), state, nstep=steps)[0]
    return np.asarray(found)[0, :, 1 : 1 + scenario.n]


def largest(positions, duration: float) -> float:
    """The largest error of `positions(duration, dt)` [rad]."""
    coarse, fine = (positions(duration, dt) for dt in (DT, DT / FINER))
    return float(np.abs(coarse - fine[FINER - 1 :: FINER]).max())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="0.02 s of motion, without MuJoCo")
    parser.add_argument("--json")
    options = parser.parse_args()
    long, short = (0.02, 0.02) if options.quick else (2.0, 0.2)
    paper, iiwa = ij.presets.zhang_yan_2024(), ij.presets.iiwa14()

    def of(scenario):
        return lambda duration, dt: with_simulate(scenario, duration, dt)

    rows = [
        ["throughput", "native", largest(of(paper), long)],
        ["throughput", "textbook", largest(with_textbook, long)],
        ["arm", "native, standard metrics", largest(of(iiwa), short)],
    ]
    if not options.quick:
        rows.append(["arm", "MuJoCo rollout, plant alone", largest(with_mujoco, short)])
    title = f"Largest errors at a time step of {DT:g} s"
    report(title, ["benchmark", "row", "largest error [rad]"], rows, options.json)


if __name__ == "__main__":
    main()
