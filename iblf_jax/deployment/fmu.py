"""Writes a law or a closed loop as an FMU (FMI 3.0, co-simulation) with the binary of this platform
and its sources.
"""

from __future__ import annotations

import math
import tempfile
import uuid
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as Xml

import numpy as np

from iblf_jax import __version__
from iblf_jax.deployment.build import build, c_compiler, fmi_platform, write_files
from iblf_jax.deployment.c_names import Parameters
from iblf_jax.deployment.loop_program import loop_outputs
from iblf_jax.deployment.signal_units import one_unit, rate_units
from iblf_jax.deployment.write_c import (
    GeneratedLaw,
    Law,
    LawInput,
    fill_template,
    law_inputs,
    title_of,
)
from iblf_jax.deployment.write_loop import GeneratedLoop
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world import plants

FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden")
BASE_UNITS = ("kg", "m", "s", "rad", "A")
BASE = {
    "rad": (0, 0, 0, 1, 0),
    "m": (0, 1, 0, 0, 0),
    "s": (0, 0, 1, 0, 0),
    "kg": (1, 0, 0, 0, 0),
    "N": (1, 1, -2, 0, 0),
    "A": (0, 0, 0, 0, 1),
    "V": (1, 2, -3, 0, -1),
    "ohm": (1, 2, -3, 0, -2),
    "H": (1, 2, -2, 0, -2),
}
"""Unit -> its exponents of the BASE_UNITS."""
CONSTANTS = ("sampling.period",)
"""Parameters that an FMU does not let its user change."""


class Variable(NamedTuple):
    """One variable of an FMU besides time."""

    name: str
    causality: str
    unit: str
    shape: tuple[int, ...]
    start: np.ndarray | None = None


def unit_exponents(unit: str) -> tuple[int, ...] | None:
    """The exponents of the BASE_UNITS in a unit such as "N m s/rad" or "kg m^2"; None for a unit
    that is not a product of these.
    """
    found = [0] * len(BASE_UNITS)
    numerator, _, denominator = unit.partition("/")
    for sign, factors in ((1, numerator), (-1, denominator)):
        for factor in factors.replace("(", " ").replace(")", " ").split():
            name, _, power = factor.partition("^")
            if name == "1":
                continue
            power = power or "1"
            if name not in BASE or not power.lstrip("-").isdecimal():
                return None
            for k, exponent in enumerate(BASE[name]):
                found[k] += sign * int(power) * exponent
    return tuple(found)


def law_variables(law: Law, parameters: Parameters) -> list[Variable]:
    """The variables of an FMU of a law."""
    model, n = law.scenario.model, law.scenario.n
    units = [one_unit(unit) for unit in plants.units_of(model)]
    first = (LawInput("q", units[0]), LawInput("dq", units[1]))
    inputs = [
        Variable(x.name, "input", x.unit, (n,), np.asarray(start, float))
        for x, start in zip(
            (*first, *law_inputs(model, law.external_reference)), law.vectors.first, strict=True
        )
    ]
    estimates = {"f_hat": "N m"}
    if law.programs.estimate_size > n:
        estimates = rate_units("d_hat", units)
    outputs = _outputs({"tau": units[-1], "alpha": units[1], **estimates}, n)
    return [*_settable(parameters), *inputs, *outputs]


def loop_variables(scenario: Scenario, parameters: Parameters) -> list[Variable]:
    """The variables of an FMU of a closed loop."""
    units = {x.name: x.unit for x in loop_outputs(scenario)}
    return [*_settable(parameters), *_outputs(units, scenario.n)]


def _outputs(units: dict[str, str], n: int) -> list[Variable]:
    """Output variables with one number per joint, name -> unit, and the status."""
    outputs = [Variable(name, "output", unit, (n,)) for name, unit in units.items()]
    return [*outputs, Variable("status", "output", "1", ())]


def _settable(parameters: Parameters) -> list[Variable]:
    """The parameters; those in CONSTANTS are constants."""
    variables = list[Variable]()
    for field in parameters.fields:
        causality = "constant" if field.path in CONSTANTS else "parameter"
        value = np.asarray(field.value, float)
        variables.append(Variable(field.path, causality, field.unit, field.shape, value))
    return variables


def model_description(
    name: str, title: str, token: str, step: float, variables: Sequence[Variable]
) -> str:
    """The XML description of an FMU."""
    root = Xml.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=name,
        instantiationToken=token,
        description=title,
        generationTool=f"iblf_jax {__version__}",
    )
    Xml.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=name,
        canHandleVariableCommunicationStepSize="true",
        canGetAndSetFMUState="true",
        fixedInternalStepSize=repr(step),
    )
    units = _add_units(root, variables)
    categories = Xml.SubElement(root, "LogCategories")
    for category in ("logStatusWarning", "logStatusError"):
        Xml.SubElement(categories, "Category", name=category)
    Xml.SubElement(root, "DefaultExperiment", startTime="0", stopTime="20", stepSize=repr(step))
    _add_variables(root, variables, units)
    structure = Xml.SubElement(root, "ModelStructure")
    outputs = [str(k) for k, v in enumerate(variables, start=1) if v.causality == "output"]
    for kind in ("Output", "InitialUnknown"):
        for reference in outputs:
            Xml.SubElement(structure, kind, valueReference=reference)
    Xml.indent(root)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n' + Xml.tostring(root, encoding="unicode") + "\n"
    )


def _add_units(root: Xml.Element, variables: Sequence[Variable]) -> set[str]:
    """Adds the definitions of the units; returns their names."""
    exponents: dict[str, tuple[int, ...]] = {"s": BASE["s"]}
    for v in variables:
        found = unit_exponents(v.unit)
        if found is not None and any(found):
            exponents[v.unit] = found
    definitions = Xml.SubElement(root, "UnitDefinitions")
    for unit, powers in sorted(exponents.items()):
        pairs = zip(BASE_UNITS, powers, strict=True)
        base = {name: str(power) for name, power in pairs if power}
        Xml.SubElement(Xml.SubElement(definitions, "Unit", name=unit), "BaseUnit", base)
    return set(exponents)


CAUSALITY_ATTRIBUTES = {
    "parameter": {"causality": "parameter", "variability": "tunable"},
    "constant": {"causality": "local", "variability": "constant"},
    "input": {"causality": "input", "variability": "continuous"},
    "output": {"causality": "output", "variability": "discrete"},
}


def _add_variables(root: Xml.Element, variables: Sequence[Variable], units: set[str]) -> None:
    """Adds time and the variables."""
    listed = Xml.SubElement(root, "ModelVariables")
    Xml.SubElement(
        listed,
        "Float64",
        name="time",
        valueReference="0",
        causality="independent",
        variability="continuous",
        unit="s",
        description="time",
    )
    for k, v in enumerate(variables, start=1):
        attributes = {"name": v.name, "valueReference": str(k), **CAUSALITY_ATTRIBUTES[v.causality]}
        if v.unit in units:
            attributes["unit"] = v.unit
        if v.start is not None:
            numbers = " ".join(map(repr, np.ravel(v.start).tolist()))
            attributes["start"] = numbers.replace("inf", "INF")
        element = Xml.SubElement(listed, "Float64", attributes)
        for size in v.shape:
            Xml.SubElement(element, "Dimension", start=str(size))


def wrapper_source(
    name: str,
    title: str,
    token: str,
    variables: Sequence[Variable],
    block: str,
    values: dict[str, Any],
) -> str:
    """The FMI 3.0 wrapper of a law or a loop in C."""
    rows = list[str]()
    offset = 0
    for v in variables:
        size = math.prod(v.shape)
        is_settable = v.causality in ("parameter", "input")
        rows.append(f"  {{{offset}, {size}, {int(is_settable)}}},")
        offset += size
    counts = {
        kind: sum(math.prod(v.shape) for v in variables if v.causality in causalities)
        for kind, causalities in CAUSALITIES.items()
    }
    inputs = [np.ravel(np.asarray(v.start)) for v in variables if v.causality == "input"]
    values_of_inputs = np.concatenate([*inputs, []]).tolist()
    starts = [f"  f->inputs[{i}] = {x!r};\n" for i, x in enumerate(values_of_inputs)]
    return fill_template(
        "fmi3.c",
        {
            "title": title,
            "version": __version__,
            "name": name,
            "token": token,
            "variables": len(variables),
            "variable_table": "\n".join(rows),
            "parameter_count": counts["parameters"],
            "inputs": counts["inputs"],
            "outputs": counts["outputs"],
            "starts": "".join(starts),
            "block": fill_template(block, values),
        },
    )


CAUSALITIES = {
    "parameters": ("parameter", "constant"),
    "inputs": ("input",),
    "outputs": ("output",),
}

BUILD_DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiBuildDescription fmiVersion="3.0">
  <BuildConfiguration modelIdentifier="{name}">
    <SourceFileSet language="C99">
      <SourceFile name="{name}.c"/>
      <SourceFile name="{name}_fmi3.c"/>
    </SourceFileSet>
  </BuildConfiguration>
</fmiBuildDescription>
"""


def law_fmu(law: Law, generated: GeneratedLaw, path: Path) -> None:
    """Writes a law as an FMU; raises ToolchainError."""
    n = law.scenario.n
    name = law.name
    step = float(law.scenario.sampling.period)  # type: ignore[union-attr]
    names = ("dq", *law.further_inputs)
    at_start = {name: f"q + {k * n}" for k, name in enumerate(names, start=1)}
    further = [f", {at_start[name]}" for name in law.further_inputs]
    at_sample = at_start | dict.fromkeys(law.unread_levels, "NULL")
    sampled = ", ".join(at_sample[name] for name in names)
    # The order counts: the token of the FMU is computed from the text of these values.
    values = {
        "name": name, "upper": name.upper(), "joints": n, "step": repr(step),
        "further": "".join(further), "sampled": sampled,
    }  # fmt: skip
    sources = {file: generated.files[file] for file in (f"{name}.h", f"{name}.c")}
    variables = law_variables(law, generated.parameters)
    title = title_of(law.scenario)
    _package(path, name, title, step, variables, "fmu_law.c", values, sources)


def loop_fmu(
    scenario: Scenario, generated: GeneratedLoop, run_settings: Sequence[float], path: Path
) -> None:
    """Writes a closed loop as an FMU; raises ToolchainError."""
    name, step = generated.values["name"], run_settings[0]
    setting_values = ", ".join(map(repr, run_settings))
    values = {"name": name, "step": repr(step), "setting_values": setting_values}
    title = f"the closed loop: {generated.values['title']}"
    variables = loop_variables(scenario, generated.parameters)
    _package(path, name, title, step, variables, "fmu_loop.c", values, generated.files)


def _package(
    path: Path,
    name: str,
    title: str,
    step: float,
    variables: list[Variable],
    block: str,
    values: dict[str, Any],
    sources: dict[str, str],
) -> None:
    """Writes the archive: the description, the sources, and the binary that is built from them."""
    text = "\n".join(sources[key] for key in sorted(sources))
    token = f"{{{uuid.uuid5(uuid.NAMESPACE_URL, text + repr(values))}}}"
    sources = sources | {
        f"{name}_fmi3.c": wrapper_source(name, title, token, variables, block, values)
    }
    system, suffix = fmi_platform()
    with tempfile.TemporaryDirectory() as folder:
        write_files(Path(folder), sources)
        build(
            [*c_compiler(), *FLAGS, f"{name}.c", f"{name}_fmi3.c", "-lm", "-o", f"{name}{suffix}"],
            Path(folder),
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(
                "modelDescription.xml", model_description(name, title, token, step, variables)
            )
            archive.write(Path(folder) / f"{name}{suffix}", f"binaries/{system}/{name}{suffix}")
            for file, content in sources.items():
                archive.writestr(f"sources/{file}", content)
            archive.writestr("sources/buildDescription.xml", BUILD_DESCRIPTION.format(name=name))
