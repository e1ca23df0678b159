"""`export`: a scenario's law or its complete closed loop as C99, an FMU, WebAssembly or a ROS 2
package.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from numpy.typing import ArrayLike

from iblf_jax.control.actuators import Ideal
from iblf_jax.core import checks, notices, taylor
from iblf_jax.core.progress import announced
from iblf_jax.core.pytree import astype, is_absent
from iblf_jax.core.status import FAILED, Status, describe, has_flag
from iblf_jax.deployment.build import write_files
from iblf_jax.deployment.c_names import FILES, RESERVED
from iblf_jax.deployment.control_law import (
    SampleInputs,
    control_law,
    inputs_at_start,
    sample,
    start,
)
from iblf_jax.deployment.cosimulate import check_single, with_period
from iblf_jax.deployment.finite import check_finite
from iblf_jax.deployment.fmu import law_fmu, loop_fmu
from iblf_jax.deployment.loop_program import loop_program
from iblf_jax.deployment.ros2.package import (
    RosOptions,
    check_ros_name,
    ros_options,
    write_package,
)
from iblf_jax.deployment.write_c import (
    CHECK_INTERVAL,
    Law,
    Vectors,
    describe_counts,
    generate,
    operations_of,
    vectors_of,
)
from iblf_jax.deployment.write_loop import loop_files, wasm_files
from iblf_jax.engine.simulate import simulate
from iblf_jax.engine.step_size import comfortable_dt, limited
from iblf_jax.files.scenario import scenario_to_toml
from iblf_jax.kernels import UnsupportedError
from iblf_jax.simulation.closed_loop import evaluate, initial_state
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.noise import check_method, has_noise, noise_key, realised
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical, fitted_to_step
from iblf_jax.world import plants

LAW_TARGETS = ("c", "fmu", "ros2")
LOOP_TARGETS = ("fmu-loop", "wasm")
TITLES = {
    "c": "the law as C99",
    "fmu": "the law as an FMU",
    "ros2": "the law as a ROS 2 package",
    "fmu-loop": "the closed loop as an FMU",
    "wasm": "the closed loop as WebAssembly",
}
"""Target -> what was written, in words."""
NEXT_STEPS = {
    "c": "compare the code with a simulated run: cc -std=c99 -O2 {folder}/{name}.c"
    " {folder}/selftest.c -lm -o {folder}/selftest && {folder}/selftest",
    "fmu": "list its inputs and outputs: fmpy info {folder}/{name}.fmu",
    "ros2": "build it in a ROS 2 workspace: cp -r {folder} WORKSPACE/src/{name} && cd WORKSPACE &&"
    " colcon build --packages-select {name}",
    "fmu-loop": "run it: fmpy simulate {folder}/{name}.fmu --show-plot",
    "wasm": "load {name}.wasm in a page; {folder}/README.md has its functions",
}
"""Target -> what to do with the files, with the folder and the name."""
LOOP_DEFAULTS = {"method": "rk4", "seed": 0}
"""The defaults of the arguments that only a closed loop has."""
TYPES = {"double": "float64", "float": "float32"}
VECTORS_DURATION = 20.0
"""Length of the simulated run whose torques the self-test compares [s]."""
SAMPLES_AT_START = 3
"""Samples of a sampled law that are checked before its closed loop is written; the first torque
influences later samples through the observer."""
DECIMALS = 9
"""Decimals of the inputs of the self-test."""
LONGEST_STEP = 1e-3
"""Longest time step of the run of the self-test [s]."""
SHORTEST_PERIOD, LONGEST_PERIOD = 1e-6, 1e3
"""Limits of the period of a law [s]; others make the run of the self-test too long."""
LONGEST_IDENTIFIER = 63
"""Number of characters of a name that every C compiler distinguishes (C99, 5.2.4.1)."""


@dataclasses.dataclass(frozen=True)
class Exported:
    """The result of `export`; prints what was written, what a call costs, and the next step."""

    folder: Path
    target: str
    files: tuple[str, ...]
    operations: Counter[str]
    """Operations of a call, by kind; every call executes all of them."""
    sizes: dict[str, int]
    """Bytes of state, parameters and stack."""
    parameters: tuple[str, ...]
    """Paths of the leaves that can be set in the exported code."""
    notes: tuple[str, ...] = ()
    """What was left out, and why."""
    next_step: str = ""
    """What to do with the files."""

    def __repr__(self) -> str:
        described = "; README.md describes them" if "README.md" in self.files else ""
        sizes = ", ".join(f"{name} {size} bytes" for name, size in self.sizes.items())
        lines = [
            f"{TITLES[self.target]} in {self.folder}: {len(self.files)} files{described}",
            f"a call: {describe_counts(self.operations)}",
            f"memory: {sizes}",
            f"{len(self.parameters)} parameters can be changed without another export",
            *self.notes,
        ]
        return "\n".join([*lines, f"next: {self.next_step}"])


@notices.each_warning_once
@announced("exporting; the self-test contains a simulated run")
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
    gains: Sequence[Any] | None = None,
    torque_limits: ArrayLike | None = None,
    on_fault: str = "hold",
) -> Exported:
    """Writes a scenario's law, or its complete closed loop, as code that runs without JAX.

        (tau_k, z_(k+1)) = law(t_k, y_k, z_k)

    "c": law, observer and velocity filter as one C99 file and its header, without allocation,
    global state or anything but libm, with `name_init` and `name_step`; gains and model are a
    struct whose fields are the paths of the leaves, filled in; a self-test with 20 s of a simulated
    run; build files.  "fmu": the same law as `name.fmu`, FMI 3.0 for co-simulation, with the binary
    of this platform. "fmu-loop": the complete closed loop as an FMU.  "wasm": the complete closed
    loop as `name.wasm` for a browser, and `name.json`, the table of its parameters and records.
    "ros2": a package of type ament_python with the C law and a node that reads `joint_states` and
    publishes `efforts`, within torque limits and with a policy for faults.

    Args:
      scenario: the scenario.  An exported law does not contain the effects of the sensors
        (counts, offset, noise), the actuator and the delay, which are the robot's own; they are
        part of the simulated run only.  The process noise of the plant is left out.  Levels that
        the sensor does not measure are inputs of the start only.
        The observer is part of the code, also for a law that does not use its estimate, unless it
        is `NoObserver()`.
      folder: output folder; it is created if it does not exist, and existing files are replaced.
      target: "c", "fmu", "fmu-loop", "wasm" or "ros2".
      period: of the law [s]; the scenario's `sampling.period` if not given.  A closed loop need not
        be sampled.
      dtype: floating-point type of the code, "double" or "float"; an FMU and a ROS 2 package have
        doubles.
      reference: "inside" for a law that computes its reference as a function of time; "given" for
        a law whose inputs are q_d, q_d' and q_d".
      name: prefix of all names in the code, a C identifier, and the name of a ROS 2 package;
        "iblf_law" or "iblf_loop" if not given.
      dt: the time step [s]: of a closed loop, as in `simulate`; of a law, the longest one of the
        self-test's run, which is at most 1 ms and smaller where the plant needs it.
      method, seed: of a closed loop, as in `simulate`.
      gains: of a ROS 2 package, the gains that can be changed while the node runs: paths, or
        `ij.tunable(path, low, high)` with a range that was simulated; without one, the range is the
        default of `tune`, which may contain unstable loops, and a warning says so.
      torque_limits: of a ROS 2 package, the largest torques, () or (n,) [N m], at most the model's
        `effort`, which they are if not given; a warning says if gravity takes more.
      on_fault: of a ROS 2 package, "hold" (the torques that hold the position) or "zero".

    Returns:
      An `Exported`: files, sizes and operations of a call; prints as a table.

    Raises:
      ValueError: invalid arguments, a scenario that cannot be lowered, or a law whose torque is
        not finite; the message states the reason.
      ToolchainError: no compiler for an FMU (cc, gcc, clang) or for WebAssembly (`ziglang`, of the
        extra `export`), or it failed.

    Source: design of this package; FMI standard 3.0, Modelica Association, 2022.
    """
    checks.one_of("target", target, (*LAW_TARGETS, *LOOP_TARGETS))
    is_loop = target in LOOP_TARGETS
    loop_options = {"method": method, "seed": seed}
    ros_only = {"gains": gains, "torque_limits": torque_limits, "on_fault": on_fault}
    _check_options(target, dtype, reference, loop_options, ros_only)
    tableau(method)
    dt, seed = checks.time_span("dt", dt), checks.seed(seed)
    name = checked_name(name, "iblf_loop" if is_loop else "iblf_law")
    if target == "ros2":
        check_ros_name(name)
    check_single(scenario)
    if not is_loop:
        # The program of a law ends with its command: the noise acts on the plant, and the delay
        # belongs to the computer that runs the law.
        if scenario.actuator.input_delay is not None:
            scenario = dataclasses.replace(scenario, actuator=Ideal())
        scenario = dataclasses.replace(scenario, process_noise=None)
    if not is_loop or period is not None:
        scenario = with_period(scenario, period)
    jax_type = TYPES[dtype]
    if jax.dtypes.canonicalize_dtype(jax_type) != jax_type:
        expected = '"float", as JAX computes in float32 here'
        remedy = 'Call jax.config.update("jax_enable_x64", True) first.'
        raise checks.fail("dtype", dtype, expected, remedy)
    scenario = canonical(astype(scenario, jax_type))
    if not is_loop:
        period = float(scenario.sampling.period)  # type: ignore[union-attr]
        if not SHORTEST_PERIOD <= period <= LONGEST_PERIOD:
            expected = f"a period of the law from {SHORTEST_PERIOD:g} to {LONGEST_PERIOD:g} s"
            remedy = "The self-test contains a simulated run with this period."
            raise checks.fail("period", period, expected, remedy)
    ros = None
    if target == "ros2":
        ros = ros_options(scenario, gains, torque_limits, on_fault)
    folder = checks.folder_to_write("folder", folder)
    external_reference = reference == "given"
    try:
        if is_loop:
            return _export_loop(scenario, folder, target, name, dt, method, seed)
        return _export_law(scenario, folder, target, name, external_reference, ros, dt)
    except UnsupportedError as error:
        came = f"what has no C ({error})"
        raise checks.fail("scenario", came, "a scenario whose operations are lowered") from None


def _check_options(
    target: str,
    dtype: str,
    reference: str,
    loop_options: Mapping[str, object],
    ros_only: Mapping[str, object],
) -> None:
    """Raises ValueError for an unknown option, for options that exclude each other, and for those
    of another target.
    """
    checks.one_of("dtype", dtype, tuple(TYPES))
    checks.one_of("reference", reference, ("inside", "given"))
    if target.startswith("fmu") and dtype != "double":
        raise checks.fail("dtype", dtype, '"double" for an FMU', "FMI's own numbers are.")
    if target == "ros2" and dtype != "double":
        expected = '"double" for a ROS 2 package'
        raise checks.fail("dtype", dtype, expected, "The messages have doubles.")
    if target == "ros2" and reference == "given":
        expected = '"inside" for a ROS 2 package'
        remedy = "The node has no topic for a reference: give the scenario a reference."
        raise checks.fail("reference", reference, expected, remedy)
    if target in LOOP_TARGETS and reference == "given":
        expected = '"inside" for a closed loop'
        remedy = "Only a law alone receives its reference as an input."
        raise checks.fail("reference", reference, expected, remedy)
    if target == "ros2":
        for name, value in loop_options.items():
            if value != LOOP_DEFAULTS[name]:
                expected = f"{LOOP_DEFAULTS[name]!r}, the default, for a ROS 2 package"
                raise checks.fail(name, value, expected, "Only a closed loop has this option.")
        return
    for name, value in ros_only.items():
        if value is None or (name == "on_fault" and isinstance(value, str) and value == "hold"):
            continue
        expected = f"the default for the target {target!r}"
        raise checks.fail(name, value, expected, 'Only target="ros2" has this option.')


def _export_law(
    scenario: Scenario,
    folder: Path,
    target: str,
    name: str,
    external_reference: bool,
    ros: RosOptions | None,
    dt: float,
) -> Exported:
    scenario_toml: str | None = None
    notes: tuple[str, ...] = ()
    try:
        scenario_toml = scenario_to_toml(scenario)
    except ValueError as error:
        notes = (f"scenario.toml left out: {error}",)
    law = Law(
        scenario=scenario,
        programs=control_law(scenario, external_reference),
        name=name,
        external_reference=external_reference,
        vectors=vectors(scenario, external_reference, dt),
        joints=plants.declared_joints(scenario.model),
        scenario_toml=scenario_toml,
    )
    generated = generate(law)
    if target == "c":
        write_files(folder, generated.files)
        files = tuple(generated.files)
    elif ros is not None:
        files = write_package(law, generated, ros, folder)
    else:
        law_fmu(law, generated, folder / f"{name}.fmu")
        files = (f"{name}.fmu",)
    sizes = {
        "state": generated.state_bytes,
        "parameters": generated.parameter_bytes,
        "stack, without optimisation": generated.stack_bytes,
    }
    paths = tuple(field.path for field in generated.parameters.fields)
    next_step = NEXT_STEPS[target].format(folder=folder, name=name)
    return Exported(folder, target, files, generated.operations, sizes, paths, notes, next_step)


def _export_loop(
    scenario: Scenario, folder: Path, target: str, name: str, dt: float, method: str, seed: int
) -> Exported:
    scenario = fitted_to_step(scenario, dt)
    _check_start(scenario)
    check_method(scenario, method)
    key = np.asarray(noise_key(jax.random.key(seed)), float)
    scenario = realised(scenario, jnp.asarray(key, scenario.initial.q.dtype))
    loop = loop_program(scenario, method, has_shape=target == "wasm")
    joints = plants.declared_joints(scenario.plant)
    generated = loop_files(scenario, loop, name, method, joints)
    run_settings = [dt]
    if has_noise(scenario):
        run_settings += key.tolist()
    if target == "wasm":
        files = tuple(wasm_files(generated, folder, run_settings))
    else:
        loop_fmu(scenario, generated, run_settings, folder / f"{name}.fmu")
        files = (f"{name}.fmu",)
    width = loop.step.dtype.itemsize
    sizes = {"state": width * loop.carry_size + 8, "parameters": width * generated.parameters.size}
    paths = tuple(field.path for field in generated.parameters.fields)
    next_step = NEXT_STEPS[target].format(folder=folder, name=name)
    operations = operations_of(loop.step)
    return Exported(folder, target, files, operations, sizes, paths, next_step=next_step)


def checked_name(name: str | None, default: str) -> str:
    """The prefix of all names in the code; ValueError if it is invalid."""
    if name is None:
        return default
    rest = LONGEST_IDENTIFIER - 1
    pattern = rf"[A-Za-z][A-Za-z0-9_]{{0,{rest}}}"
    is_identifier = isinstance(name, str) and re.fullmatch(pattern, name) is not None
    if is_identifier and name not in RESERVED and name.lower() not in FILES:
        return name
    expected = f"a C identifier of at most {LONGEST_IDENTIFIER} characters"
    expected += " that is not reserved by C, its headers or CMake"
    raise checks.fail("name", name, expected, 'Such as name="arm_law".')


def vectors(
    scenario: Scenario, external_reference: bool, longest_step: float = LONGEST_STEP
) -> Vectors:
    """Inputs of the law in a simulated run and its outputs; warns where that run fails.

    A plant may need steps that are shorter than a period, such as one with stiff friction: a run
    whose step is too large for it is repeated once, with the step that it needs.
    """
    period = float(scenario.sampling.period)  # type: ignore[union-attr]
    samples = max(2, round(VECTORS_DURATION / period))

    def run_with(step: float) -> Rollout:
        steps = max(1, math.ceil(period / step - 1e-9))
        return simulate(scenario, duration=samples * period, dt=period / steps, record_every=steps)

    with notices.muted():
        run = run_with(min(longest_step, LONGEST_STEP))
        if has_flag(int(run.status), Status.STEP_TOO_LARGE):
            needed = comfortable_dt(float(run.fastest_mode), run.method)
            run = run_with(limited(needed, float(run.dt)))
    dtype = run.q.dtype
    t = jnp.asarray(np.arange(samples) * period, dtype)
    at_start = inputs_at_start(scenario)
    levels = [run.measured.q, run.measured.dq]
    if not is_absent(at_start.higher):
        levels.append(run.measured.higher[:, : len(at_start.higher)])
    inputs = SampleInputs(t, *[_rounded(x, samples, dtype) for x in levels])
    first = jax.tree.map(lambda x: x[None], at_start)
    if external_reference:
        inputs = _with_own_reference(scenario, inputs)
        first = _with_own_reference(scenario, first)
    first = jax.tree.map(lambda x: x[0], first)
    torques = np.asarray(_torques(scenario, first, inputs))
    _check_torques(scenario, first, inputs, torques, " of the simulated run")
    status = int(run.status)
    if has_flag(status, FAILED | Status.SAMPLING_TOO_SLOW):
        notices.warn(
            f"the simulated run with this law every {period:g} s: {describe(status)}. The exported"
            " code is that law. Make the period shorter (in Python, ij.recommended_period(scenario)"
            " returns how long it may be)."
        )
    return vectors_of(first, inputs, torques[::CHECK_INTERVAL])


def _with_own_reference(scenario: Scenario, inputs: SampleInputs) -> SampleInputs:
    """Inputs with the scenario's own reference at their times, rounded."""
    count, dtype = len(inputs.t), inputs.q.dtype
    reference = _reference(scenario, inputs.t, plants.order_of(scenario.model))
    q_d, dq_d, ddq_d, *further = (_rounded(x, count, dtype) for x in reference)
    given = inputs._replace(q_d=q_d, dq_d=dq_d, ddq_d=ddq_d)
    return given._replace(further_d=jnp.stack(further, axis=1)) if further else given


def _check_torques(
    scenario: Scenario, first: SampleInputs, inputs: SampleInputs, torques: np.ndarray, where: str
) -> None:
    """Raises ValueError for a law whose torques (K, n) at K samples are not finite; the message
    states the reason and `where`.
    """
    wrong = ~np.isfinite(torques).all(axis=1)
    if not wrong.any():
        return
    until = int(np.argmax(wrong)) + 1
    first_samples = jax.tree.map(lambda x: x[:until], inputs)
    instant = f"at t = {float(first_samples.t[-1]):g} s{where}"

    def torques_of(changed: Scenario) -> jax.Array:
        return _torques(changed, first, first_samples)

    check_finite(scenario, torques_of, torques[:until], instant)


def _check_start(scenario: Scenario) -> None:
    """Raises ValueError for a closed loop whose law is not finite at its start."""
    if scenario.sampling is None:
        check_finite(scenario, _first_torque, np.asarray(_first_torque(scenario)), "at t = 0 s")
        return
    first = inputs_at_start(scenario)
    inputs = jax.tree.map(lambda x: jnp.stack([x] * SAMPLES_AT_START), first)
    t = jnp.arange(SAMPLES_AT_START, dtype=first.q.dtype) * scenario.sampling.period
    inputs = inputs._replace(t=t)
    _check_torques(scenario, first, inputs, np.asarray(_torques(scenario, first, inputs)), "")


@jax.jit
def _first_torque(scenario: Scenario) -> jax.Array:
    """The torque of a continuous law at t = 0, (1, n) [N m].  A joint whose acceleration is not
    finite gets the acceleration in place of the torque.
    """
    t = jnp.zeros((), scenario.initial.q.dtype)
    rate, found = evaluate(scenario, t, initial_state(scenario))
    return jnp.where(jnp.isfinite(rate.dq), found.tau, rate.dq)[None]


def _rounded(x: jax.Array, samples: int, dtype: DTypeLike) -> jax.Array:
    """The first samples, rounded to DECIMALS so that the written inputs are short."""
    return jnp.asarray(np.round(np.asarray(x[:samples], float), DECIMALS), dtype)


@partial(jax.jit, static_argnames="order")
def _reference(scenario: Scenario, t: jax.Array, order: int) -> list[jax.Array]:
    """The scenario's own reference and its derivatives up to an order at times (K,), (K, n)
    each.
    """
    return taylor.in_time(jax.vmap(scenario.reference.position), t, order)


@jax.jit
def _torques(scenario: Scenario, first: SampleInputs, inputs: SampleInputs) -> jax.Array:
    """The torques of samples one after the other, (K, n) [N m]."""

    def one(state, inputs):
        state, outputs = sample(scenario, inputs, state)
        return state, outputs.tau

    return jax.lax.scan(one, start(scenario, first)[0], inputs)[1]
