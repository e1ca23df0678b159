"""Every number of a few steps of loops that have a member of every family in them.

NumPy runs the scalar program of the step, operation by operation, so that a loop costs its tracing
and no compiler.  `tests/data/steps.json` has what the signals, states, metrics and flags of three
runs add up to, with generic weights: a sign, a factor or an axis anywhere in plant, sensor, law,
observer, actuator, metrics or error estimate moves one of them.  The tests compare to 1e-7, and to
1e-3 what the estimate of the error finds, which multiplies what compilers round (measured with two
settings of XLA: 8e-5).  After a change that is to move them,

    python tests/engine/test_time_step.py

writes the file anew; its difference names what moved.
"""

import json
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")
TESTS = Path(__file__).parents[1]
if __name__ == "__main__":
    sys.path.insert(0, str(TESTS))
    import conftest  # before the first array

    conftest.choose_compilers(plain=True)

import jax
import jax.numpy as jnp
import members
import numpy as np
import pytest
import scenarios_of_members as loops
from by_numpy import evaluate

import iblf_jax as ij
from iblf_jax.engine import RunRequest
from iblf_jax.engine.batch import Batch, carry_without_linearization
from iblf_jax.engine.compile import inputs_of
from iblf_jax.engine.loops import program_of
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.kernels import written_out
from iblf_jax.simulation import metrics
from iblf_jax.simulation.scenario import with_history

FILE = TESTS / "data" / "steps.json"
DT, STEPS = 4e-3, 5
METHODS = ("heun", "euler", "rk4")
SHIFTS = np.array([0.0, 0.13, -0.21])
"""By which the states of the three runs differ: one of them leaves its bounds."""


REFERENCES = ("sinusoid", "quintic", "smooth_step", "waypoint_spline")
DISTURBANCES = ("model_shaped", "sinusoids", "step", "tip_force", "friction", "sum")
ACTUATORS = (
    "motor",
    "fault",
    "chain",
    "dead_zone",
    "quantiser",
    "backlash",
    "delay",
    "motor_two_limits",
)
OBSERVERS = ("momentum", "extended_state", "printed_matched", "momentum", "none")
SENSORS = ("encoder_filtered_difference", "encoder_tracking", "encoder_measured")
SIDES = (
    (
        ij.bounds.Constant(-0.9),
        ij.bounds.Sinusoid(offset=[1.9, 1.8], amplitude=0.3, frequency=2.0, phase=0.7),
    ),
    (ij.bounds.Funnel(initial=-0.5, final=[-0.1, -0.2], rate=1.5), ij.bounds.Constant([1.9, 1.6])),
    (ij.bounds.Constant(-1.1), ij.bounds.Funnel(initial=0.9, final=[0.1, 0.2], rate=1.5)),
)
EARLY = {
    "step": ij.disturbances.Step(size=[1.0, -0.5], time=0.006),
    "delay": ij.actuators.Delay(delay=1.4 * DT),
    "fault": ij.actuators.Fault(effectiveness=[0.7, 0.5], bias=[0.3, -0.2], time=0.01),
}
"""Members that would change nothing within the few steps, or are shorter than one."""


def member(family: dict[str, Any], names: tuple[str, ...], i: int) -> Any:
    """The i-th member of some names, from the first again after the last."""
    name = names[i % len(names)]
    return EARLY.get(name, family[name])


def loop_of_law(name: str, i: int) -> ij.Scenario:
    """The paper's robot under a law, with other members in the other places."""
    law = members.LAWS[name]
    lower, upper = SIDES[i % len(SIDES)]
    tube = ij.Bounds(lower=lower, upper=upper)
    parts: dict[str, Any] = {
        "controller": law,
        "reference": member(members.REFERENCES, REFERENCES, i),
        "disturbance": member(members.DISTURBANCES, DISTURBANCES, i),
        "actuator": member(members.ACTUATORS, ACTUATORS, i),
        "observer": member(members.OBSERVERS, OBSERVERS, i),
        "bounds": (tube, loops.WIDE) if members.keeps_velocities(law) else tube,
    }
    if i % 3 == 1:
        parts["actuator"] = members.ACTUATORS["motor"]
        parts["sensor"] = member(members.SENSORS, SENSORS, i)
        parts["sampling"] = ij.Sampling(
            period=2 * DT,
            delay=1.3 * DT,
            observer=("exact", "poles", "euler")[i // 3 % 3],
            trigger=ij.EventTrigger(relative=0.1, absolute=0.05) if i % 2 else None,
        )
    if i % 3 == 2:
        parts["regions"] = (members.REGIONS["half_space"], members.REGIONS["sphere"])
    return ij.with_parts(loops.paper(), **parts)


LOOPS: dict[str, Callable[[], ij.Scenario]] = {
    name: partial(loop_of_law, name, i) for i, name in enumerate(members.LAWS)
}
LOOPS |= {
    name: partial(loops.FITTING["plant"], plant)
    for name, plant in members.PLANTS.items()
    if name != "neighbour_model"
}
QUICK = (
    *("backstepping", "backstepping_decays", "barrier_backstepping_velocities"),
    *("barrier_backstepping_compensated", "barrier_backstepping_matrices", "dynamic_surface"),
    *("adaptive_network", "surface_barrier", "terminal_sliding_mode", "pd_gravity"),
    *("reference_governor", "saturated_auxiliary", "event_compensated"),
    *("adaptive_rbf_fuzzy", "computed_torque", "safety_filter", "saturated", "saturated_smooth"),
    *("electric_drive", "flexible_joint", "strict_feedback", "strict_feedback_diagonal"),
)
"""Loops of the default tests."""


def values_of(loop: str) -> dict[str, float]:
    return sums(*steps_of(LOOPS[loop](), METHODS[[*LOOPS].index(loop) % 3]))


def record(folds: Any, found: Any) -> Any:
    """All signals of the instant, whether they are states, samples or rates."""
    return found.sample


def steps_of(scenario: ij.Scenario, method: str) -> tuple[Any, Any, list[Any], list[Any]]:
    """Carry and record of a step, as trees of shapes, and the numbers of both: of the carry after
    the last step, and of the records of all steps."""
    scenario = with_history(ij.astype(scenario, "float64"), DT)
    method = "heun" if scenario.actuator.input_delay is not None else method
    method = "euler_maruyama" if scenario.process_noise is not None else method
    request = RunRequest.of(scenario, steps=STEPS, method=method)
    folds = metrics.as_folds(None, jnp.float64, scenario)
    inputs = inputs_of(scenario, folds, jnp.asarray(DT, float), request, jnp.arange(4.0))
    batch = Batch.of(inputs, {"initial.dq": scenario.initial.dq[None]}, request.constants)
    carry = jax.jit(lambda: carry_without_linearization(batch, method))()
    step, records = program_of(TimeStep(method, record), batch, carry)
    program = written_out(step)
    x = carry.state.x
    moved = carry._replace(state=carry.state._replace(x=x + SHIFTS[:, None, None]))
    state = [
        number
        for leaf in jax.tree.leaves(moved)
        for number in np.asarray(leaf).reshape(len(leaf), -1).T
    ]
    shared, per_run = (
        [number for leaf in leaves for number in np.ravel(leaf)]
        for leaves in (batch.leaves.shared, batch.leaves.per_run)
    )
    rows = []
    for index in range(STEPS):
        known = evaluate(program, {"shared": shared, "per_run": per_run, "carry": state}, index)
        state = [known[i] for _, i in program.carry]
        rows.append([known[i] for i in program.outputs])
    return carry, records, state, rows


def sums(carry: Any, records: Any, state: list[Any], rows: list[Any]) -> dict[str, float]:
    """Name of a leaf -> the sum of its numbers, of all runs and steps, with generic weights."""
    found = {}
    for tree, drop, numbers in ((carry, 1, [state]), (records, 0, rows)):
        first = 0
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            size = int(np.prod(leaf.shape[drop:]))
            values = np.array(
                [
                    [np.broadcast_to(x, len(SHIFTS)) for x in row[first : first + size]]
                    for row in numbers
                ],
                float,
            ).ravel()
            first += size
            finite = np.where(np.isfinite(values), values, 7.0)
            weights = np.cos(1.0 + np.arange(finite.size))
            found[jax.tree_util.keystr(path)] = float(f"{finite @ weights:.12g}")
    return found


@pytest.mark.parametrize(
    "loop", [x if x in QUICK else pytest.param(x, marks=pytest.mark.slow) for x in LOOPS]
)
def test_steps(loop):
    stored = json.loads(FILE.read_text())[loop]
    found = values_of(loop)
    assert found.keys() == stored.keys()
    moved = {
        name: (stored[name], x)
        for name, x in found.items()
        if not np.isclose(x, stored[name], rtol=1e-3 if "growth" in name else 1e-7, atol=1e-9)
    }
    assert not moved


if __name__ == "__main__":
    table = {loop: values_of(loop) for loop in LOOPS}
    rows = [f"{json.dumps(loop)}: {json.dumps(found)}" for loop, found in table.items()]
    FILE.write_text("{\n" + ",\n".join(rows) + "\n}\n")
