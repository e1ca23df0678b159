"""The law as a folder of C99: source, header, self-test, how to build it, and what is inside."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from importlib.resources import files
from string import Template
from typing import Any, NamedTuple

import numpy as np

from iblf_jax import __version__
from iblf_jax.deployment.c_names import Parameters, comment, number
from iblf_jax.deployment.control_law import FLAGS, ControlLaw
from iblf_jax.kernels import INPUTS, OPERATIONS, Program, header, plain_function
from iblf_jax.simulation.scenario import Scenario

SEGMENT = 500
"""Operations of a function, at most: compilers' time grows with the square of its length, and so
does its stack without optimisation."""
LONG = 16
"""Cost (`operations.OPERATIONS`) above which an operation is an elementary function."""
REFERENCE = ("q_d", "dq_d", "ddq_d")
LOOKUP = """static F f_lookup(const I *table, I size, I i) {
  F x;
  memcpy(&x, &table[i < 0 ? 0 : i < size ? i : size - 1], sizeof x);
  return x;
}
"""
FRAME = 256
"""Bytes of a call besides its numbers, at most about."""
ROUNDS_FOR = 10**8
"""Operations that the self-test times, about."""


def filled(template: str, values: dict[str, Any]) -> str:
    """A file of `c/` with its places filled in."""
    return Template((files("iblf_jax.deployment") / "c" / template).read_text()).substitute(values)


def operations_of(program: Program) -> Counter[str]:
    """How many operations a call makes, by what they cost on a processor without vectors."""
    counts: Counter[str] = Counter()
    roots = {"div": "divisions", "sqrt": "square roots", "rsqrt": "square roots"}
    for node in program.nodes:
        if node.op not in INPUTS and node.op != "const":
            cost = OPERATIONS[node.op].cost
            counts[
                roots.get(
                    node.op,
                    (
                        "sums, products and choices"
                        if cost is not None and cost <= LONG
                        else "elementary functions"
                    ),
                )
            ] += 1
    return counts


def told(counts: Counter[str]) -> str:
    """Counts in words."""
    order = ("sums, products and choices", "divisions", "square roots", "elementary functions")
    return ", ".join(f"{counts[name]} {name}" for name in order if counts[name])


def stack_of(text: str, real_bytes: int) -> int:
    """Bytes that the longest chain of calls of a generated function takes, every number of it in
    memory.
    """
    bodies = re.split(r"^(?:static|SEPARATE) void ", text, flags=re.MULTILINE)[1:]
    own = [len(re.findall(r"^  [FI] v\d+ =", body, re.MULTILINE)) for body in bodies]
    rooms = (
        sum(map(int, re.findall(r"^  F x\[(\d+)\]; I y\[(\d+)\];$", bodies[-1], re.MULTILINE)[0]))
        if len(bodies) > 1
        else 0
    )
    return real_bytes * (max(own[:-1], default=0) + own[-1] + rooms) + FRAME * (1 + (len(own) > 1))


def words_for(text: str) -> str:
    """The lines of `c/plain.h` whose words a text uses; what they use themselves are functions of C
    and `MASK`, which is kept with them.
    """
    lines = header("plain.h").splitlines()
    used = [
        line
        for line in lines
        if (found := re.match(r"#define (\w+)", line)) and re.search(rf"\b{found[1]}\b", text)
    ]
    mask = [
        line
        for line in lines
        if line.startswith("#define MASK") and line not in used and any("MASK(" in x for x in used)
    ]
    return "\n".join(mask + used)


CHECKED = 10
"""The self-test compares the torque of every so-many-th sample."""


class Vectors(NamedTuple):
    """What the self-test compares with: a run's samples, (K, n) each, and what the law answered."""

    first: tuple[np.ndarray, ...]
    """q, q' and the reference at the start."""
    q: np.ndarray
    dq: np.ndarray
    reference: tuple[np.ndarray, ...]
    """q_d, q_d', q_d"; empty where it is inside."""
    tau: np.ndarray
    """Of every CHECKED-th sample."""


class Law(NamedTuple):
    """A law to be written."""

    scenario: Scenario
    programs: ControlLaw
    name: str
    told_reference: bool
    vectors: Vectors
    joints: tuple[str, ...]
    file: str | None
    """The scenario as TOML; None where it has parts that files have no name for."""

    @property
    def is_float(self) -> bool:
        """Whether its numbers are floats; doubles otherwise."""
        return self.programs.sample.dtype == np.float32


class Written(NamedTuple):
    """The files of a law, and what they take."""

    files: dict[str, str]
    operations: Counter[str]
    state_bytes: int
    parameter_bytes: int
    stack_bytes: int
    parameters: Parameters


def written(law: Law) -> Written:
    """The files of a law, name -> text."""
    scenario, programs, name, n = law.scenario, law.programs, law.name, law.scenario.n
    parameters = Parameters.of(scenario, (programs.start, programs.sample))
    size, real_bytes = len(programs.memory), 4 if law.is_float else 8
    lane = [
        "t[0]",
        *(
            f"{x}[{i}]"
            for x in ("q", "dq", *(REFERENCE if law.told_reference else ()))
            for i in range(n)
        ),
    ]
    seen = [f"const {name}_parameters *p", "const F *m", "const F *t", "const F *q", "const F *dq"]
    seen += [f"const F *{x}" for x in REFERENCE] if law.told_reference else []
    inputs = {
        "shared": parameters.numbers,
        "per_run": lane,
        "carry": [f"m[{k}]" for k in range(size)],
    }
    results = len(programs.start.samples), size + len(programs.sample.samples)
    start = plain_function(
        programs.start, f"{name}_start", [seen[0], *seen[2:]], inputs, _places(results[0]), SEGMENT
    )
    sample = plain_function(
        programs.sample, f"{name}_sample", seen, inputs, _places(results[1]), SEGMENT
    )
    operations = operations_of(programs.sample)
    state_bytes = real_bytes * (max(size, 1) + 3 * n)
    parameter_bytes = real_bytes * max(1, parameters.size)
    stack_bytes = (
        max(stack_of(start, real_bytes), stack_of(sample, real_bytes)) + real_bytes * results[1]
    )
    keep = "memcpy(s->memory, result, sizeof s->memory);\n{}" if size else ""
    values = shared_values(
        scenario, name, programs.sample.dtype, parameters, law.joints, start, sample
    ) | {
        "period": "sampling.period",
        "operations": told(operations),
        "memory": (
            "".join(f"       [{k}] {comment(x)}\n" for k, x in enumerate(programs.memory))
            or "       nothing\n"
        ),
        "memory_size": max(size, 1),
        "memory_count": size,
        "flags": len(FLAGS),
        "keep_start": keep.format("  "),
        "keep_sample": keep.format("    "),
        "default_dq": "(void)still;" if programs.reads_velocity else "if (dq == NULL) dq = still;",
        "dq_argument": "dq" if programs.reads_velocity else "NULL",
        "dq_note": (
            ""
            if programs.reads_velocity
            else "\n   dq is the velocity that the filter starts with; NULL for 0."
        ),
        **_reference_text(law.told_reference, name, n),
    }
    texts = {f"{name}.h": filled("law.h", values), f"{name}.c": filled("law.c", values)}
    texts |= _around(law, values, (state_bytes, parameter_bytes, stack_bytes))
    return Written(texts, operations, state_bytes, parameter_bytes, stack_bytes, parameters)


def _places(count: int) -> list[str]:
    return [f"r[{k}]" for k in range(count)]


def shared_values(
    scenario: Scenario,
    name: str,
    dtype: np.dtype,
    parameters: Parameters,
    joints: Sequence[str],
    start: str,
    sample: str,
) -> dict[str, Any]:
    """What the templates of laws and loops ask for alike; `start` and `sample` are generated
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
        "type": "float" if is_float else "double",
        "integer": "int32_t" if is_float else "int64_t",
        "suffix": "name##f" if is_float else "name",
        "parameters": parameters.declaration(f"{name}_real", joints),
        "defaults": parameters.defaults(is_float),
        "plain": words_for(start + sample),
        "lookup": LOOKUP if "f_lookup(" in start + sample else "",
        "start": start,
        "sample": sample,
    }
    return values | {"prelude": filled("prelude.c", values)}


def title_of(scenario: Scenario) -> str:
    """What the law is, in a line."""
    parts = [type(x).__name__ for x in (scenario.controller, scenario.observer)]
    return comment(f"The law {parts[0]} with the observer {parts[1]}, for {scenario.n} joints")


def _reference_text(told_reference: bool, name: str, n: int) -> dict[str, str]:
    if not told_reference:
        return dict.fromkeys(
            (
                "reference_arguments",
                "reference_declarations",
                "reference_parameters",
                "reference_finite",
                "reference_values",
            ),
            "",
        )
    return {
        "reference_arguments": ", q_d, dq_d, ddq_d",
        "reference_declarations": "".join(f", const {name}_real *{x}" for x in REFERENCE),
        "reference_parameters": "".join(f", const real *{x}" for x in REFERENCE),
        "reference_finite": "".join(f" && are_finite({x}, {n})" for x in REFERENCE),
        "reference_values": "".join(f"{x}, " for x in REFERENCE),
    }


def _around(law: Law, values: dict[str, Any], sizes: tuple[int, int, int]) -> dict[str, str]:
    """Self-test, how to build it, README."""
    v, reads, period = law.vectors, law.programs.reads_velocity, float(law.scenario.sampling.period)  # type: ignore[union-attr]
    of = "".join(f", {x}[k]" for x in REFERENCE) if v.reference else ""
    told_velocity = "It is told positions and velocities."
    dtype, where = "float" if law.is_float else "double", "told" if v.reference else "inside"
    again = (
        f"python -m iblf_jax export scenario.toml --out . --name {law.name} --dtype {dtype}"
        f" --reference {where}"
    )
    row = f"\n| `scenario.toml` | what it was written from: `{again}` writes it again |"
    values |= {
        "samples": len(v.q),
        "duration": f"{len(v.q) * period:g}",
        "rounds": max(1, ROUNDS_FOR // (len(v.q) * law.programs.sample.size)),
        "tolerance": "1e-4" if law.is_float else "1e-10",
        "dq_of_k": "dq[k]" if reads else "NULL",
        "dq_of_0": "dq[0]" if reads else "NULL",
        "reference_of_k": of,
        "reference_of_0": of.replace("[k]", "[0]"),
        "first_reference": "".join(f", first_{x}" for x in REFERENCE) if v.reference else "",
        "state_bytes": sizes[0],
        "parameter_bytes": sizes[1],
        "stack_bytes": sizes[2],
        "period": repr(period),
        "velocity": (
            told_velocity
            if reads
            else "It is told positions alone; velocities follow by the scenario's filter."
        ),
        "inside": _inside(law),
        "reference": (
            "The reference is told at every sample."
            if v.reference
            else "The reference is inside, a function of t."
        ),
        "scenario_row": "" if law.file is None else row,
        "time_note": (
            "Time as a float loses a millisecond after four hours: start again before.  "
            if law.is_float
            else ""
        ),
    }
    arrays = (
        {"q": v.q, "torque": v.tau}
        | ({"dq": v.dq} if reads else {})
        | dict(zip(REFERENCE, v.reference, strict=bool(v.reference)))
    )
    return {
        "selftest.c": filled("selftest.c", values),
        "vectors.h": _vectors(law, arrays),
        "CMakeLists.txt": filled("CMakeLists.txt", values),
        "README.md": filled("README.md", values),
        **({} if law.file is None else {"scenario.toml": law.file}),
    }


def _inside(law: Law) -> str:
    s = law.scenario
    parts = [
        type(s.controller).__name__,
        type(s.observer).__name__,
        f"the model ({type(s.model).__name__})",
        "the bounds",
    ]
    if not law.programs.reads_velocity:
        velocity = s.sensor.velocity  # type: ignore[attr-defined]
        parts.append(f"the filter {type(velocity).__name__}")
    return ", ".join(parts)


def _vectors(law: Law, arrays: dict[str, np.ndarray]) -> str:
    v, n, real = law.vectors, law.scenario.n, f"{law.name}_real"

    def row(x) -> str:
        return "{" + ", ".join(number(float(y), law.is_float) for y in x) + "}"

    lines = ["/* Samples of a simulated run, for selftest.c; the torque of every CHECKED-th. */"]
    lines.append(f"enum {{ SAMPLES = {len(v.q)}, CHECKED = {CHECKED} }};")
    names = ("q", "dq", *REFERENCE)[: len(v.first)]
    lines += [
        f"static const {real} first_{x}[{n}] = {row(y)};"
        for x, y in zip(names, v.first, strict=True)
    ]
    lines += [
        f"static const {real} {x}[{len(rows)}][{n}] = {{\n" + ",\n".join(map(row, rows)) + "\n};"
        for x, rows in arrays.items()
    ]
    return "\n".join(lines) + "\n"
