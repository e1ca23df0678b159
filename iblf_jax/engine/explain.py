"""`explain`: the operations of one step of a scenario, counted in its scalar program."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.devices import threads
from iblf_jax.core.presentation import Content, Result
from iblf_jax.core.progress import announced
from iblf_jax.core.tables import Table
from iblf_jax.engine import thresholds
from iblf_jax.engine.adjoint import ReverseRun
from iblf_jax.engine.batch import Batch, carry_shapes
from iblf_jax.engine.compile import inputs_of
from iblf_jax.engine.loops import program_of
from iblf_jax.engine.registry import EXECUTORS, Executor, default_backend
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.structural_constants import constants_of
from iblf_jax.engine.time_step import TimeStep
from iblf_jax.kernels import OPERATIONS, PER_RUN, SHARED, TIME, Program, vector_bytes, written_out
from iblf_jax.simulation.metrics import as_folds
from iblf_jax.simulation.noise import NOISE_NAME, check_method, has_noise
from iblf_jax.simulation.paths import get
from iblf_jax.simulation.scenario import Scenario, canonical, with_history

EXPLAINED_STEP = 1e-3
"""Time step of the explained loop [s]; one delay, where the input has a shorter one."""
LIBRARY_CALL = 40
"""Vector instructions that a function of the C library takes for a run, roughly."""
NAMES = {
    SHARED: "once",
    SHARED | TIME: "a step, shared",
    PER_RUN: "a run",
    PER_RUN | TIME: "a step and run",
}


@dataclasses.dataclass(frozen=True, repr=False)
class Explanation(Result):
    """Operations of one step, by how often they are executed; prints as a table."""

    counts: dict[str, Counter]
    """How often -> operation -> number."""
    slots: float
    """Vector instructions for a step of a register full of runs, a product and the sum that it goes
    into counted as one."""
    width: int
    """Runs in a register of this machine's processor."""
    limit: float
    """Estimated limit of this machine's processor [steps/s]: two vector instructions a cycle on
    every core."""
    backend: str = ""
    """The executor that runs a batch here by default, and the reason if it does not compile
    kernels."""
    derivatives: str = ""
    """What computes the derivatives of `simulate` under `jax.grad`, `jacfwd` or `hessian`, and the
    reason if it is no compiled kernel."""

    def _content(self) -> Content:
        rows = []
        for name, counter in self.counts.items():
            which = ", ".join(f"{op} {n}" for op, n in counter.most_common(8))
            rows.append((name, str(sum(counter.values())), which))
        return [
            Table(("operations done", "number", "which"), rows, left=(0, 2)),
            f"about {self.slots:.0f} vector instructions a step for {self.width} runs",
            f"two a cycle on every core would be {self.limit:.3g} steps/s",
            f"a batch runs on {self.backend}",
            f"derivatives of simulate: {self.derivatives}",
        ]


@notices.each_warning_once
@announced("compiling a time step to explain it")
def explain(
    scenario: Scenario, *, varied: Sequence[str] = (), method: str = "rk4", metrics=None
) -> Explanation:
    """What one step of a scenario costs on a compiled backend; where the law is sampled, a step in
    which it runs and a command arrives.

    Args:
      scenario: what runs; its floating-point type decides the width of a register of runs.
      varied: paths of leaves that differ between runs; the start always does.
      method: the integrator.
      metrics: the folds, the standard ones if None.

    Returns:
      An `Explanation`, which prints as a table.

    Raises:
      ValueError: bad scenario or path.
      UnsupportedError: the step does not lower; the message says why.
    """
    scenario = canonical(scenario)
    delay, step = scenario.actuator.input_delay, EXPLAINED_STEP
    if delay is not None:
        step = min(step, float(delay.delay))
    scenario = with_history(scenario, step)
    dtype = scenario.initial.q.dtype
    folds = as_folds(metrics, dtype, scenario)
    check_method(scenario, method)
    if not isinstance(varied, list | tuple) or not all(isinstance(path, str) for path in varied):
        raise checks.fail("varied", varied, 'a list of paths, such as ["controller.K2"]')
    leaves = {
        path: jnp.asarray(get(scenario, path))[None]
        for path in {"initial.q", "initial.dq", *varied}
    }
    if has_noise(scenario):
        leaves[NOISE_NAME] = jnp.zeros((1, 4), jnp.float32)
    one = Batch.of(
        inputs_of(scenario, folds, jnp.asarray(step, dtype), RunRequest(1), None),
        leaves,
        constants=constants_of(scenario),
    )
    program = written_out(program_of(TimeStep(method), one, carry_shapes(one, method)).program)
    width = vector_bytes() // np.dtype(dtype).itemsize
    slots = instructions(program, width)
    counts = {NAMES[c]: counter for c, counter in program.counts().items()}
    name, reason = default_backend()
    backend = name
    if reason:
        backend = f"{name}: {reason}"
        derivatives = f"by plain JAX: {reason}"
    else:
        derivatives = _derivatives(EXECUTORS[name], one)
    return Explanation(
        counts, slots, width, threads() * width * 2 * _clock() / slots, backend, derivatives
    )


def _derivatives(executor: Executor, one: Batch) -> str:
    """What computes the derivatives of `simulate`, for a batch of one run."""
    many = "more of them and others by plain JAX"
    if ReverseRun(executor, one, (), RunRequest(1)).is_supported():
        many = "first ones by more of them in reverse mode; others by plain JAX"
    return (
        f"by up to {thresholds.MAX_COLUMNS} numbers of the scenario on {executor.name}, one run a"
        f" number, first and second ones; {many}"
    )


def instructions(program: Program, width: int) -> float:
    """Vector instructions of a step for a register of runs (class PER_RUN | TIME)."""
    classes, uses = program.classes(), Counter(a for node in program.nodes for a in node.args)
    fused = {
        next(
            (
                a
                for a in node.args
                if program.nodes[a].op == "mul" and uses[a] == 1 and classes[a] == PER_RUN | TIME
            ),
            None,
        )
        for node in program.nodes
        if node.op in ("add", "sub")
    }
    counted = program.counts()[PER_RUN | TIME]
    total = -len(fused - {None})
    for op, n in counted.items():
        cost = OPERATIONS[op].cost
        if cost is None:
            cost = LIBRARY_CALL * width
        total += n * cost
    return total


def _clock() -> float:
    """Cycles a second: the highest of the first core where it is known, else 3e9."""
    try:
        return 1e3 * float(
            Path("/sys/devices/system/cpu/cpu0/cpufreq/cpuinfo_max_freq").read_text()
        )
    except (OSError, ValueError):
        return 3e9
