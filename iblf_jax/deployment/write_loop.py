"""Writes a closed loop as C, and as a WebAssembly module with a table of its parameters."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iblf_jax import __version__
from iblf_jax.deployment.build import build, write_files, zig
from iblf_jax.deployment.c_names import Parameters
from iblf_jax.deployment.loop_program import Loop, LoopOutput, Shape, loop_outputs
from iblf_jax.deployment.write_c import SEGMENT, fill_template, shared_values
from iblf_jax.kernels import plain_function
from iblf_jax.simulation.noise import has_noise
from iblf_jax.simulation.scenario import Scenario

WASM_FLAGS = ("-target", "wasm32-wasi", "-mexec-model=reactor", "-O2", "-s")
RECORD_BUFFER = 32_768
"""Records in the buffer of a module."""


class GeneratedLoop(NamedTuple):
    """The C of a loop."""

    files: dict[str, str]
    parameters: Parameters
    outputs: tuple[LoopOutput, ...]
    shape: Shape | None
    values: dict[str, Any]
    """The values for the placeholders of the templates."""


def loop_files(
    scenario: Scenario, loop: Loop, name: str, method: str, joints: tuple[str, ...]
) -> GeneratedLoop:
    """Header and source of a closed loop."""
    parameters = Parameters.of(scenario, (loop.start, loop.step))
    setting_count, noise_setting = 1, ""
    if has_noise(scenario):
        setting_count, noise_setting = 5, ", then the four words of the noise's key"
    outputs = loop_outputs(scenario)
    output_count = len(loop.step.outputs)
    inputs = {
        "shared": parameters.numbers,
        "per_run": [f"u[{i}]" for i in range(setting_count)],
        "carry": [f"m[{k}]" for k in range(loop.carry_size)],
        "index": ["index"],
    }
    results = [f"r[{k}]" for k in range(loop.carry_size + output_count)]
    arguments = [f"const {name}_parameters *p", "const F *u"]
    begin = plain_function(
        loop.start, f"{name}_begin", arguments, inputs, results[: loop.carry_size], SEGMENT
    )
    arguments[1:] = ["const F *m", "const F *u", "I index"]
    step = plain_function(loop.step, f"{name}_advance", arguments, inputs, results, SEGMENT)
    values = shared_values(scenario, name, loop.step.dtype, parameters, joints, begin, step) | {
        "method": method,
        "settings": setting_count,
        "output_count": output_count,
        "memory_size": loop.carry_size,
        "outputs": ", ".join(output.name for output in outputs),
        "shape": "".join(f", then {name} [m]" for name in _drawn(loop.shape)),
        "noise_setting": noise_setting,
        "buffer_rows": RECORD_BUFFER,
        "real_bytes": loop.step.dtype.itemsize,
    }
    texts = {f"{name}.{ending}": fill_template(f"loop.{ending}", values) for ending in "hc"}
    return GeneratedLoop(texts, parameters, outputs, loop.shape, values)


def table(generated: GeneratedLoop, run_settings: list[float]) -> dict[str, Any]:
    """The description of a module for a page: its parameters, settings and records."""
    rows, offset = [], 0
    for field in generated.parameters.fields:
        row = {"path": field.path, "offset": offset, "shape": field.shape, "unit": field.unit}
        # JSON has no numbers that are not finite; they become null.
        value = np.asarray(field.value, object)
        value[~np.isfinite(value.astype(float))] = None
        rows.append(row | {"value": value.tolist()})
        offset += math.prod(field.shape)
    values, n = generated.values, generated.values["joints"]
    columns = [
        {"name": output.name, "unit": output.unit, "offset": k * n, "size": n}
        for k, output in enumerate(generated.outputs)
    ]
    end = len(columns) * n
    columns.append({"name": "status", "unit": "1", "offset": end, "size": 1})
    end += 1
    for name, array in _drawn(generated.shape).items():
        column = {"name": name, "unit": "m", "offset": end, "size": array.size}
        columns.append(column | {"shape": array.shape})
        end += array.size
    return {
        "parameters": rows,
        "count": offset,
        "settings": run_settings,
        "records": columns,
        "record": values["output_count"],
        "bytes": values["real_bytes"],
        "joints": n,
        "method": values["method"],
        "version": __version__,
    }


def _drawn(shape: Shape | None) -> dict[str, Any]:
    """The arrays of a shape that are there, by name."""
    found = {} if shape is None else shape._asdict()
    return {name: array for name, array in found.items() if not isinstance(array, tuple)}


def wasm_files(generated: GeneratedLoop, folder: Path, run_settings: list[float]) -> list[str]:
    """Writes a module, its table and its sources into a folder; returns the names of the files.

    Raises:
      ToolchainError: ziglang is not installed, or it failed.
    """
    name = generated.values["name"]
    texts = generated.files | {f"{name}_module.c": fill_template("wasm.c", generated.values)}
    texts["README.md"] = fill_template("wasm.md", generated.values)
    description = json.dumps(table(generated, run_settings), indent=1, allow_nan=False)
    texts[f"{name}.json"] = f"{description}\n"
    command = zig()
    write_files(folder, texts)
    build(
        [*command, *WASM_FLAGS, f"{name}.c", f"{name}_module.c", "-lm", "-o", f"{name}.wasm"],
        folder,
    )
    return [*texts, f"{name}.wasm"]
