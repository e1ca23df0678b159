"""Writes a law as a folder of C99: source, header, self-test, build files and README."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.resources import files
from string import Template
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax import __version__
from iblf_jax.core.modules import is_module
from iblf_jax.core.pytree import field_values
from iblf_jax.deployment.c_names import Parameters, comment, number
from iblf_jax.deployment.control_law import FLAGS, ControlLaw, SampleInputs, velocity_filters
from iblf_jax.deployment.signal_units import one_unit, per_time
from iblf_jax.kernels import INPUTS, OPERATIONS, Program, header, plain_function
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world import plants

SEGMENT = 500
"""Largest number of operations of a C function: the compile time grows with the square of its
length, and so does its stack without optimisation."""
ELEMENTARY_COST = 16
"""Cost (`operations.OPERATIONS`) above which an operation is an elementary function."""
LOOKUP = """static F f_lookup(const I *table, I size, I i) {
  F x;
  memcpy(&x, &table[i < 0 ? 0 : i < size ? i : size - 1], sizeof x);
  return x;
}
"""
STACK_FRAME_BYTES = 256
"""Upper estimate of the bytes of a stack frame besides its numbers."""
TIMED_OPERATIONS = 10**8
"""Approximate number of operations that the self-test times."""


C_TYPES = {
    False: {"type": "double", "integer": "int64_t", "suffix": "name", "array": "Float64Array"},
    True: {"type": "float", "integer": "int32_t", "suffix": "name##f", "array": "Float32Array"},
}
"""Placeholders that depend on whether the numbers are floats."""


def fill_template(template: str, values: Mapping[str, Any], folder: str = "c") -> str:
    """The text of a template in a folder of this package with its placeholders filled in."""
    path = files("iblf_jax.deployment") / folder / template
    return Template(path.read_text(encoding="utf-8")).substitute(values)


def operations_of(program: Program) -> Counter[str]:
    """The number of operations of a call, by their cost on a processor without vectors."""
    kinds = {"div": "divisions", "sqrt": "square roots", "rsqrt": "square roots"}
    found: Counter[str] = Counter()
    for op in (node.op for node in program.nodes):
        if op in INPUTS or op == "const":
            continue
        cost = OPERATIONS[op].cost
        is_cheap = cost is not None and cost <= ELEMENTARY_COST
        other = "sums, products and choices" if is_cheap else "elementary functions"
        found[kinds.get(op, other)] += 1
    return found


def describe_counts(counts: Counter[str]) -> str:
    """The numbers of operations as text; kinds that do not occur are left out."""
    order = ("sums, products and choices", "divisions", "square roots", "elementary functions")
    return ", ".join(f"{counts[name]} {name}" for name in order if counts[name])


def stack_bytes_of(text: str, real_bytes: int) -> int:
    """Stack of the longest chain of calls of a generated function [bytes], under the assumption
    that no number is held in a register.
    """
    bodies = re.split(r"^(?:static|SEPARATE) void ", text, flags=re.MULTILINE)[1:]
    own = [len(re.findall(r"^  [FI] v\d+ =", body, re.MULTILINE)) for body in bodies]
    if len(bodies) == 1:
        return real_bytes * own[0] + STACK_FRAME_BYTES
    # The last function calls the others and passes them arrays of floats and of integers.
    arrays = re.findall(r"^  F x\[(\d+)\]; I y\[(\d+)\];$", bodies[-1], re.MULTILINE)[0]
    passed = sum(int(size) for size in arrays)
    return real_bytes * (max(own[:-1]) + own[-1] + passed) + 2 * STACK_FRAME_BYTES


def helper_macros(text: str) -> str:
    """The macros of `c/plain.h` that a text uses, and `MASK` if one of them uses it."""
    macros = re.findall(r"^(#define (\w+).*)$", header("plain.h"), re.MULTILINE)
    used = [line for line, name in macros if re.search(rf"\b{name}\b", text)]
    if any("MASK(" in line for line in used):
        used = [line for line, name in macros if name == "MASK" and line not in used] + used
    return "\n".join(used)


CHECK_INTERVAL = 10
"""The self-test compares the torque of every tenth sample."""


class Vectors(NamedTuple):
    """Reference data of the self-test: the samples of a run, (K, n) each, and the law's torques."""

    first: tuple[np.ndarray, ...]
    """All inputs at the start, (n,) each."""
    q: np.ndarray
    dq: np.ndarray
    further: tuple[np.ndarray, ...]
    """Levels from the third on, and q_d and its derivatives if the reference is an input."""
    tau: np.ndarray
    """Torque of every CHECK_INTERVAL-th sample."""


def vectors_of(first: SampleInputs, inputs: SampleInputs, tau: np.ndarray) -> Vectors:
    """The reference data from the inputs at the start, those of K samples, and torques."""
    n = first.q.size
    at_start = [np.asarray(x).reshape(-1, n) for x in jax.tree.leaves(first[1:])]
    rows = [np.asarray(x) for x in jax.tree.leaves(inputs[3:])]
    further = [level for x in rows for level in np.moveaxis(x.reshape(len(x), -1, n), 1, 0)]
    q, dq = np.asarray(inputs.q), np.asarray(inputs.dq)
    return Vectors(tuple(np.concatenate(at_start)), q, dq, tuple(further), tau)


class LawInput(NamedTuple):
    """An input of n numbers of a law."""

    name: str
    unit: str


def law_inputs(model: Any, external_reference: bool) -> tuple[LawInput, ...]:
    """The inputs of a law besides q and q', in the order of `SampleInputs`: the levels of its model
    from the third on, and an external reference with its derivatives.
    """
    order, units = plants.order_of(model), [one_unit(x) for x in plants.units_of(model)]
    found = [LawInput(f"x_{i + 1}", units[i]) for i in range(2, order)]
    if not external_reference:
        return tuple(found)
    names = ("q_d", "dq_d", "ddq_d", *(f"d{k}q_d" for k in range(3, order + 1)))
    return (*found, *(LawInput(name, per_time(units[0], k)) for k, name in enumerate(names)))


class Law(NamedTuple):
    """A law to be exported."""

    scenario: Scenario
    programs: ControlLaw
    name: str
    external_reference: bool
    vectors: Vectors
    joints: tuple[str, ...]
    scenario_toml: str | None
    """The scenario as TOML; None if a file cannot hold it."""

    @property
    def further_inputs(self) -> tuple[str, ...]:
        """Names of the inputs besides q and q'."""
        inputs = law_inputs(self.scenario.model, self.external_reference)
        return tuple(x.name for x in inputs)

    @property
    def reference_inputs(self) -> tuple[str, ...]:
        """Names of the inputs that are the reference and its derivatives."""
        return tuple(x for x in self.further_inputs if x not in self.levels)

    @property
    def levels(self) -> tuple[str, ...]:
        """Names of the inputs that are levels of the model."""
        return ("q", "dq", *(x.name for x in law_inputs(self.scenario.model, False)))

    @property
    def unread_levels(self) -> tuple[str, ...]:
        """Those that only the start reads."""
        return tuple(self.levels[level - 1] for level in self.programs.unread)

    @property
    def is_float(self) -> bool:
        """Whether its numbers are floats and not doubles."""
        return self.programs.sample.dtype == np.float32


class GeneratedLaw(NamedTuple):
    """The files of a law, its operations and the sizes of its data [bytes]."""

    files: dict[str, str]
    operations: Counter[str]
    state_bytes: int
    parameter_bytes: int
    stack_bytes: int
    parameters: Parameters


def generate(law: Law) -> GeneratedLaw:
    """Generates the files of a law and counts its operations and the bytes of its data."""
    programs, name, n = law.programs, law.name, law.scenario.n
    parameters = Parameters.of(law.scenario, (programs.start, programs.sample, programs.bounds))
    size = len(programs.state_names)
    real_bytes = np.dtype(programs.sample.dtype).itemsize
    start, sample, bounds = _functions(law, parameters)
    operations = operations_of(programs.sample)
    state_bytes = real_bytes * (max(size, 1) + 2 * n + programs.estimate_size)
    parameter_bytes = real_bytes * max(1, parameters.size)
    result_bytes = real_bytes * (size + len(programs.sample.outputs))
    stack_bytes = max(stack_bytes_of(text, real_bytes) for text in (start, sample)) + result_bytes
    functions = f"{sample}\n{bounds}"
    values = shared_values(
        law.scenario, name, programs.sample.dtype, parameters, law.joints, start, functions
    )
    values |= _law_values(law, operations)
    texts = {
        f"{name}.h": fill_template("law.h", values),
        f"{name}.c": fill_template("law.c", values),
    }
    texts |= _supporting_files(law, values, (state_bytes, parameter_bytes, stack_bytes))
    return GeneratedLaw(texts, operations, state_bytes, parameter_bytes, stack_bytes, parameters)


def _functions(law: Law, parameters: Parameters) -> tuple[str, str, str]:
    """The C functions that compute the start, a sample and the bounds at a time."""
    programs, name = law.programs, law.name
    size = len(programs.state_names)
    arrays = ("q", "dq", *law.further_inputs)
    per_run = ["t[0]", *(f"{x}[{i}]" for x in arrays for i in range(law.scenario.n))]
    parameter_argument = f"const {name}_parameters *p"
    arguments = [f"const F *{x}" for x in ("t", *arrays)]
    inputs = {
        "shared": parameters.numbers,
        "per_run": per_run,
        "carry": [f"m[{k}]" for k in range(size)],
    }
    start_arguments = [parameter_argument, *arguments]
    sample_arguments = [parameter_argument, "const F *m", *arguments]
    results = [f"r[{k}]" for k in range(size + len(programs.sample.outputs))]
    at_start = results[: len(programs.start.outputs)]
    both_bounds = results[: len(programs.bounds.outputs)]
    return (
        plain_function(programs.start, f"{name}_start", start_arguments, inputs, at_start, SEGMENT),
        plain_function(
            programs.sample, f"{name}_sample", sample_arguments, inputs, results, SEGMENT
        ),
        plain_function(
            programs.bounds, f"{name}_tube", start_arguments, inputs, both_bounds, SEGMENT
        ),
    )


def _law_values(law: Law, operations: Counter[str]) -> dict[str, Any]:
    """The values for the placeholders of the law's source and header."""
    state = law.programs.state_names
    entries = "".join(f"       [{k}] {comment(x)}\n" for k, x in enumerate(state))
    model = law.scenario.loop.model
    units = [comment(one_unit(x)) for x in plants.units_of(model)]
    estimate = "estimate of the uncertain term [N m]"
    if model.uncertain_levels:
        estimate = "estimate of the uncertain terms"
    values = {
        "period_parameter": "sampling.period",
        "operations": describe_counts(operations),
        "memory": entries or "       nothing\n",
        "memory_size": max(len(state), 1),
        "memory_count": len(state),
        "flags": len(FLAGS),
        "estimate_size": law.programs.estimate_size,
        "output_meanings": (
            f"{comment(plants.input_name(model))} [{units[-1]}], {model.notation.alpha}"
            f" [{units[1]}], {estimate}"
        ),
        "keep_start": "",
        "keep_sample": "",
        **_input_values(law),
        **_unread_values(law),
    }
    if state:
        keep = "memcpy(s->memory, result, sizeof s->memory);\n"
        values |= {"keep_start": keep + "  ", "keep_sample": keep + "    "}
    return values


def _unread_values(law: Law) -> dict[str, str]:
    """The values that depend on which levels a sample reads."""
    unread = law.unread_levels
    read = ", ".join(x for x in law.levels if x not in unread)
    values = {
        "default_unread": "(void)zero;",
        "unread_note": "",
        "measured": f"Measured at time t: {read}.",
        "velocity": f"Its measured inputs are {read}.",
    }
    if not unread:
        return values
    names = ", ".join(unread)
    values["default_unread"] = "\n  ".join(f"if ({x} == NULL) {x} = zero;" for x in unread)
    values["unread_note"] = f"\n   Filters and observer start with {names}; NULL for 0."
    values["velocity"] += f"  Filters and observer compute {names}, for which it receives NULL."
    return values


def shared_values(
    scenario: Scenario,
    name: str,
    dtype: np.dtype,
    parameters: Parameters,
    joints: Sequence[str],
    start: str,
    sample: str,
) -> dict[str, Any]:
    """The values that the templates of laws and of loops share; `start` and `sample` are generated
    functions.
    """
    is_float = dtype == np.float32
    values = {
        "name": name,
        "upper": name.upper(),
        "guard": f"{name.upper()}_H",
        "version": __version__,
        "joints": scenario.n,
        "title": title_of(scenario),
        **C_TYPES[is_float],
        "parameters": parameters.declaration(f"{name}_real", joints),
        "defaults": parameters.defaults(is_float),
        "plain": helper_macros(start + sample),
        "lookup": "",
        "start": start,
        "sample": sample,
    }
    if "f_lookup(" in start + sample:
        values["lookup"] = LOOKUP
    return values | {"prelude": fill_template("prelude.c", values)}


def title_of(scenario: Scenario) -> str:
    """A one-line description of the law."""
    law, observer = type(scenario.controller).__name__, type(scenario.observer).__name__
    return comment(f"The law {law} with the observer {observer}, for {scenario.n} joints")


def _input_values(law: Law) -> dict[str, str]:
    """The values that depend on the inputs besides q and q'."""
    text = "The reference is an internal function of t."
    if law.external_reference:
        text = "The reference is an input of every sample."
    forms = {
        "further_declarations": f", const {law.name}_real *{{}}",
        "further_parameters": ", const real *{}",
        "further_finite": f" && are_finite({{}}, {law.scenario.n})",
        "further_values": "{}, ",
        "first_further": ", first_{}",
    }
    texts = {key: "".join(map(form.format, law.further_inputs)) for key, form in forms.items()}
    reference = law.reference_inputs
    unread = dict.fromkeys(law.levels, "zero")
    texts |= {
        "bounds_declarations": "".join(map(forms["further_declarations"].format, reference)),
        "bounds_parameters": "".join(map(forms["further_parameters"].format, reference)),
        "bounds_values": "".join(f", {unread.get(x, x)}" for x in law.further_inputs),
    }
    for key, index in (("arguments", ""), ("arguments_of_k", "[k]"), ("arguments_of_0", "[0]")):
        arguments = {name: name + index for name in ("dq", *law.further_inputs)}
        texts[key] = ", ".join((arguments | dict.fromkeys(law.unread_levels, "NULL")).values())
    return {"reference": text, **texts}


def _supporting_files(
    law: Law, values: dict[str, Any], sizes: tuple[int, int, int]
) -> dict[str, str]:
    """The self-test, the build files, the README and, if possible, the file of the scenario."""
    v = law.vectors
    period = float(law.scenario.sampling.period)  # type: ignore[union-attr]
    values |= {
        "samples": len(v.q),
        "duration": f"{len(v.q) * period:g}",
        "rounds": max(1, TIMED_OPERATIONS // (len(v.q) * law.programs.sample.size)),
        "tolerance": "1e-10",
        "state_bytes": sizes[0],
        "parameter_bytes": sizes[1],
        "stack_bytes": sizes[2],
        "period": repr(period),
        "period_text": f"{period:g}",
        "contents": _contents(law),
        "scenario_row": "",
        "time_note": "",
    }
    if law.is_float:
        values["tolerance"] = "1e-4"
        values["time_note"] = (
            "Time as a float loses a millisecond after four hours: start again before, at rest and"
            " with t = 0, at which reference and bounds begin again.  "
        )
    arrays = {"q": v.q, "torque": v.tau}
    rows = dict(zip(("dq", *law.further_inputs), (v.dq, *v.further), strict=True))
    arrays |= {name: x for name, x in rows.items() if name not in law.unread_levels}
    if law.scenario_toml is not None:
        values["scenario_row"] = _scenario_row(law)
    texts = {
        "selftest.c": fill_template("selftest.c", values),
        "vectors.h": _vectors(law, arrays),
        "CMakeLists.txt": fill_template("CMakeLists.txt", values),
        "README.md": fill_template("README.md", values),
    }
    if law.scenario_toml is not None:
        texts["scenario.toml"] = law.scenario_toml
    return texts


def _scenario_row(law: Law) -> str:
    """The row of the README about the file of the scenario."""
    dtype = C_TYPES[law.is_float]["type"]
    reference = "given" if law.external_reference else "inside"
    command = (
        f"iblf-jax export scenario.toml --out . --name {law.name} --dtype {dtype}"
        f" --reference {reference}"
    )
    repeats = f"`{command}` repeats the export"
    classes = sorted(_users_classes(law.scenario))
    if classes:
        call = (
            f'ij.export(ij.load_scenario("scenario.toml"), ".", name="{law.name}",'
            f' dtype="{dtype}", reference="{reference}")'
        )
        repeats = f"`{call}` repeats it, in a program that first registers {', '.join(classes)}"
    return f"\n| `scenario.toml` | the exported scenario: {repeats} |"


def _users_classes(part: object) -> set[str]:
    """The names of the classes of a scenario's parts that are defined outside this package."""
    if isinstance(part, tuple | list):
        return set().union(*map(_users_classes, part))
    if not dataclasses.is_dataclass(part) or isinstance(part, type) or is_module(part):
        return set()
    found = set().union(*map(_users_classes, field_values(part).values()))
    if type(part).__module__.partition(".")[0] != "iblf_jax":
        found.add(type(part).__name__)
    return found


def _contents(law: Law) -> str:
    s = law.scenario
    parts = [
        type(s.controller).__name__,
        type(s.observer).__name__,
        f"the model ({type(s.model).__name__})",
        "the bounds",
    ]
    for _, velocity in velocity_filters(s):
        parts.append(f"the filter {type(velocity).__name__}")
    return ", ".join(parts)


def _vectors(law: Law, arrays: dict[str, np.ndarray]) -> str:
    v, n, real = law.vectors, law.scenario.n, f"{law.name}_real"

    def row(x) -> str:
        return "{" + ", ".join(number(float(y), law.is_float) for y in x) + "}"

    lines = ["/* Samples of a simulated run, for selftest.c; the torque of every CHECKED-th. */"]
    lines.append(
        "/* first_*: the state of the simulated plant at t = 0. A robot gives its first readings */"
    )
    lines.append(f"enum {{ SAMPLES = {len(v.q)}, CHECKED = {CHECK_INTERVAL} }};")
    names = ("q", "dq", *law.further_inputs)
    lines += [
        f"static const {real} first_{x}[{n}] = {row(y)};"
        for x, y in zip(names, v.first, strict=True)
    ]
    lines += [
        f"static const {real} {x}[{len(rows)}][{n}] = {{\n" + ",\n".join(map(row, rows)) + "\n};"
        for x, rows in arrays.items()
    ]
    return "\n".join(lines) + "\n"
