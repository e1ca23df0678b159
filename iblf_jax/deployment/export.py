"""`export`: a scenario's law, or its whole closed loop, out of Python: C99, an FMU, WebAssembly."""

from __future__ import annotations

import dataclasses
import math
import re
from collections import Counter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.pytree import astype
from iblf_jax.core.status import FAILED, Status, describe
from iblf_jax.deployment.c_names import FILES, RESERVED
from iblf_jax.deployment.control_law import Told, control_law, sample, start
from iblf_jax.deployment.cosimulate import check_single, with_period
from iblf_jax.deployment.finite import check_finite
from iblf_jax.deployment.fmu import law_fmu, loop_fmu
from iblf_jax.deployment.loop_program import loop_program
from iblf_jax.deployment.write_c import CHECKED, Law, Vectors, operations_of, told, written
from iblf_jax.deployment.write_loop import loop_files, wasm_files
from iblf_jax.engine.simulate import simulate
from iblf_jax.files.scenario import scenario_to_toml
from iblf_jax.kernels import UnsupportedError
from iblf_jax.simulation.closed_loop import evaluate, initial_state
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.sampling import check_step, has_noise, noise_key
from iblf_jax.simulation.scenario import Scenario, canonical

TARGETS = ("c", "fmu", "fmu-loop", "wasm")
TYPES = {"double": "float64", "float": "float32"}
VECTORS_DURATION = 20.0
"""Seconds of the run that the self-test compares with."""
SAMPLES_AT_START = 3
"""Samples of a law in a closed loop that are looked at before the loop is written: the first torque
comes back by the observer."""
DECIMALS = 9
LONGEST_STEP = 1e-3
"""Seconds of that run's steps, at most."""
SHORTEST_PERIOD, LONGEST_PERIOD = 1e-6, 1e3
"""[s].  With a period outside of them the run of the self-test would be too long."""
LONGEST_IDENTIFIER = 63
"""Characters of a name that every C compiler compares (C99, 5.2.4.1)."""


@dataclasses.dataclass(frozen=True)
class Exported:
    """What was written; prints as a table."""

    folder: Path
    target: str
    files: tuple[str, ...]
    operations: Counter[str]
    """Operations of a call, by kind: every call makes all of them."""
    sizes: dict[str, int]
    """Bytes of state, parameters and stack."""
    parameters: tuple[str, ...]
    """Paths of the leaves that can be set in what was written."""

    def __repr__(self) -> str:
        lines = [f"{self.folder}: {', '.join(self.files)}", f"a call: {told(self.operations)}"]
        lines += [f"{name}: {size} bytes" for name, size in self.sizes.items()]
        return "\n".join([*lines, f"parameters: {', '.join(self.parameters)}"])


@notices.each_warning_once
def export(
    scenario: Scenario,
    folder: str | Path,
    *,
    target: str = "c",
    period: float | None = None,
    dtype: str = "double",
    reference: str = "inside",
    name: str | None = None,
    dt: float = 1e-3,
    method: str = "rk4",
    seed: int = 0,
) -> Exported:
    """Writes a scenario's law, or its whole closed loop, out of Python.

        (tau_k, z_(k+1)) = law(t_k, y_k, z_k)

    "c": law, observer and velocity filter as one C99 file and its header, without allocation,
    global state or anything but libm, with `name_init` and `name_step`; gains and model are a
    struct whose fields are the paths of the leaves, filled in; a self-test with 20 s of a simulated
    run; how to build it.  "fmu": the same law as `name.fmu`, FMI 3.0 for co-simulation, with the
    binary of this platform. "fmu-loop": the whole closed loop as one.  "wasm": the whole closed
    loop as `name.wasm` for a browser, and `name.json`, the table of its parameters and records.

    Args:
      scenario: the law and all around it.  Of a law alone, what an encoder does to a position
        (counts, offset, noise), the actuator and the delay are the robot's own, and are in the
        simulated run only.
      folder: where to write; made if it is not there, and files of these names are replaced.
      target: "c", "fmu", "fmu-loop" or "wasm".
      period: of the law [s]; the scenario's `sampling.period` if not given.  A closed loop may do
        without.
      dtype: numbers of the code, "double" or "float"; an FMU's are double.
      reference: of a law, "inside", as a function of time, or "told": q_d, q_d', q_d" are inputs.
      name: what begins every name in the code, a C identifier; "iblf_law" or "iblf_loop" if not
        given.
      dt, method, seed: of a closed loop, as in `simulate`.

    Returns:
      An `Exported`: files, sizes and operations of a call; prints as a table.

    Raises:
      ValueError: bad arguments, what cannot be written out, or a law that yields no finite torque;
        the message says why.
      ToolchainError: no compiler for an FMU (cc, gcc, clang) or for WebAssembly (`ziglang`, of the
        extra `export`), or it failed.

    Source: design of this package; FMI standard 3.0, Modelica Association, 2022.
    """
    checks.one_of("target", target, TARGETS)
    checks.one_of("dtype", dtype, tuple(TYPES))
    checks.one_of("reference", reference, ("inside", "told"))
    tableau(method)
    dt, seed = checks.time_span("dt", dt), checks.seed(seed)
    is_loop = target in ("fmu-loop", "wasm")
    name = checked_name(name, "iblf_loop" if is_loop else "iblf_law")
    if target.startswith("fmu") and dtype != "double":
        raise checks.fail("dtype", dtype, '"double" for an FMU', "FMI's own numbers are.")
    if is_loop and reference == "told":
        raise checks.fail(
            "reference",
            reference,
            '"inside" for a closed loop',
            "Only a law alone is told its reference.",
        )
    check_single(scenario)
    if not is_loop or period is not None:
        scenario = with_period(scenario, period)
    scenario = canonical(astype(scenario, _available(dtype)))
    if not is_loop:
        _check_period(float(scenario.sampling.period))  # type: ignore[union-attr]
    folder = checks.folder_to_write("folder", folder)
    try:
        if is_loop:
            return _loop(scenario, folder, target, name, dt, method, seed)
        return _law(scenario, folder, target, name, reference == "told")
    except UnsupportedError as error:
        raise checks.fail(
            "scenario", f"what has no C ({error})", "a scenario whose operations are lowered"
        ) from None


def _law(scenario: Scenario, folder: Path, target: str, name: str, is_told: bool) -> Exported:
    joints = tuple(getattr(scenario.model, "joints", ()))
    law = Law(
        scenario,
        control_law(scenario, is_told),
        name,
        is_told,
        vectors(scenario, is_told),
        joints,
        _as_file(scenario),
    )
    made = written(law)
    if target == "c":
        files = _written_to(folder, made.files)
    else:
        law_fmu(law, made, folder / f"{name}.fmu")
        files = (f"{name}.fmu",)
    sizes = {
        "state": made.state_bytes,
        "parameters": made.parameter_bytes,
        "stack, without optimisation": made.stack_bytes,
    }
    return Exported(
        folder,
        target,
        files,
        made.operations,
        sizes,
        tuple(field.path for field in made.parameters.fields),
    )


def _loop(
    scenario: Scenario, folder: Path, target: str, name: str, dt: float, method: str, seed: int
) -> Exported:
    check_step(scenario, dt)
    _check_start(scenario)
    loop = loop_program(scenario, method)
    made = loop_files(scenario, loop, name, method, tuple(getattr(scenario.plant, "joints", ())))
    settings = [
        dt,
        *(
            np.asarray(noise_key(jax.random.key(seed)), float).tolist()
            if has_noise(scenario)
            else []
        ),
    ]
    if target == "wasm":
        files = tuple(wasm_files(made, folder, settings))
    else:
        loop_fmu(scenario, made, settings, folder / f"{name}.fmu")
        files = (f"{name}.fmu",)
    width = loop.step.dtype.itemsize
    sizes = {"state": width * loop.size + 8, "parameters": width * made.parameters.size}
    return Exported(
        folder,
        target,
        files,
        operations_of(loop.step),
        sizes,
        tuple(field.path for field in made.parameters.fields),
    )


def checked_name(name: Any, default: str) -> str:
    """What begins every name in the code, or a ValueError."""
    if name is None:
        return default
    rest = LONGEST_IDENTIFIER - 1
    pattern = rf"[A-Za-z][A-Za-z0-9_]{{0,{rest}}}"
    is_identifier = isinstance(name, str) and re.fullmatch(pattern, name) is not None
    if is_identifier and name not in RESERVED and name.lower() not in FILES:
        return name
    expected = f"a C identifier of at most {LONGEST_IDENTIFIER} characters"
    expected += " that is no word of C, its headers or CMake"
    raise checks.fail("name", name, expected, 'Such as name="arm_law".')


def _check_period(period: float) -> None:
    """Raises ValueError for a period with which the run of the self-test would be too long."""
    if not SHORTEST_PERIOD <= period <= LONGEST_PERIOD:
        expected = f"a period of the law from {SHORTEST_PERIOD:g} to {LONGEST_PERIOD:g} s"
        remedy = "The self-test holds a simulated run with it."
        raise checks.fail("period", period, expected, remedy)


def _available(dtype: str) -> str:
    """JAX's name of a type of C, if JAX computes in it."""
    wanted = TYPES[dtype]
    if jax.dtypes.canonicalize_dtype(wanted) != wanted:
        raise checks.fail(
            "dtype",
            dtype,
            '"float", as JAX computes in float32 here',
            'Call jax.config.update("jax_enable_x64", True) first.',
        )
    return wanted


def _as_file(scenario: Scenario) -> str | None:
    """The scenario as TOML; None where it has parts that files have no name for."""
    try:
        return scenario_to_toml(scenario)
    except ValueError:
        return None


def _written_to(folder: Path, texts: dict[str, str]) -> tuple[str, ...]:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return tuple(texts)


def vectors(scenario: Scenario, told_reference: bool) -> Vectors:
    """What the law is told in a simulated run, and what it answers; warns where that run fails."""
    period = float(scenario.sampling.period)  # type: ignore[union-attr]
    steps = max(1, math.ceil(period / LONGEST_STEP - 1e-9))
    samples = max(2, round(VECTORS_DURATION / period))
    with notices.muted():
        run = simulate(scenario, duration=samples * period, dt=period / steps, record_every=steps)
    dtype = run.q.dtype
    t = jnp.asarray(np.arange(samples) * period, dtype)
    asked = Told(t, *(_rounded(x, samples, dtype) for x in (run.measured.q, run.measured.dq)))
    first = Told(t[:1], scenario.initial.q[None], scenario.initial.dq[None])
    if told_reference:
        asked, first = (
            (Told(*x[:3], *(_rounded(y, samples, dtype) for y in _reference(scenario, x.t))))
            for x in (asked, first)
        )
    first = jax.tree.map(lambda x: x[0], first)
    torques = np.asarray(_answers(scenario, first, asked))
    _check_answers(scenario, first, asked, torques, " of the simulated run")
    status = int(run.status)
    if status & int(FAILED | Status.SAMPLING_TOO_SLOW):
        notices.warn(
            f"the simulated run with this law every {period:g} s: {describe(status)}. What is"
            " written is that law; ij.recommended_period(scenario) says how long a period may be."
        )
    tau = torques[::CHECKED]
    given = tuple(np.asarray(x) for x in asked[3:]) if told_reference else ()
    begin = tuple(np.asarray(x) for x in first[1:] if not isinstance(x, tuple))
    return Vectors(begin, np.asarray(asked.q), np.asarray(asked.dq), given, tau)


def _check_answers(
    scenario: Scenario, first: Told, asked: Told, torques: np.ndarray, where: str
) -> None:
    """Refuses a law that yields no numbers, from its torques (K, n) at K samples; ValueError says
    why and `where`.
    """
    wrong = ~np.isfinite(torques).all(axis=1)
    if not wrong.any():
        return
    until = int(np.argmax(wrong)) + 1
    told = jax.tree.map(lambda x: x[:until], asked)
    instant = f"at t = {float(told.t[-1]):g} s{where}"
    check_finite(scenario, lambda changed: _answers(changed, first, told), torques[:until], instant)


def _check_start(scenario: Scenario) -> None:
    """Refuses a closed loop whose law yields no numbers at its start; ValueError says why."""
    if scenario.sampling is None:
        check_finite(scenario, _first_torque, np.asarray(_first_torque(scenario)), "at t = 0 s")
        return
    q, dq = scenario.initial.q, scenario.initial.dq
    count = (SAMPLES_AT_START, 1)
    t = jnp.arange(SAMPLES_AT_START, dtype=q.dtype) * scenario.sampling.period
    told = Told(t, jnp.tile(q, count), jnp.tile(dq, count))
    first = jax.tree.map(lambda x: x[0], told)
    _check_answers(scenario, first, told, np.asarray(_answers(scenario, first, told)), "")


@jax.jit
def _first_torque(scenario: Scenario) -> jax.Array:
    """The torque of a law that is not sampled at t = 0, (1, n) [N m]; what it accelerates a joint
    by where that is not finite.
    """
    rate, found = evaluate(
        scenario, jnp.zeros((), scenario.initial.q.dtype), initial_state(scenario)
    )
    return jnp.where(jnp.isfinite(rate.dq), found.tau, rate.dq)[None]


def _rounded(x: Any, samples: int, dtype: Any) -> jax.Array:
    """The first samples with nine decimals: what is told need not be long to read."""
    return jnp.asarray(np.round(np.asarray(x[:samples], float), DECIMALS), dtype)


@jax.jit
def _reference(scenario: Scenario, t: jax.Array) -> tuple[jax.Array, ...]:
    """The scenario's own reference and its derivatives at times (K,), (K, n) each."""
    tube = jax.vmap(scenario.context.tube)(t)
    return tube.q_d, tube.dq_d, tube.ddq_d  # type: ignore[return-value]


@jax.jit
def _answers(scenario: Scenario, first: Told, asked: Told) -> jax.Array:
    """The torques of samples one after the other, (K, n) [N m]."""

    def one(memory, told):
        memory, said = sample(scenario, told, memory)
        return memory, said.tau

    return jax.lax.scan(one, start(scenario, first)[0], asked)[1]
