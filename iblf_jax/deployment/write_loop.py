"""The closed loop as C, and as a WebAssembly module with a table of its parameters."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iblf_jax import __version__
from iblf_jax.deployment.build import build, zig
from iblf_jax.deployment.c_names import Parameters, number
from iblf_jax.deployment.loop_program import OUTPUTS, Loop
from iblf_jax.deployment.write_c import LOOKUP, SEGMENT, filled, title_of, words_for
from iblf_jax.lowering.emit_c import plain_function
from iblf_jax.simulation.scenario import Scenario

WASM_FLAGS = ("-target", "wasm32-wasi", "-mexec-model=reactor", "-O2", "-s")
ROWS = 32_768
"""Records that a module has room for."""


class WrittenLoop(NamedTuple):
    """The C of a loop."""

    files: dict[str, str]
    parameters: Parameters
    values: dict[str, Any]
    """What its templates are filled with."""


def loop_files(scenario: Scenario, loop: Loop, name: str, method: str, joints: tuple[str, ...]) -> WrittenLoop:
    """Header and source of a closed loop."""
    parameters = Parameters.of(scenario, (loop.start, loop.step))
    is_float, n = loop.step.dtype == np.float32, scenario.n
    settings = max((node.value for node in loop.step.nodes if node.op == "lane"), default=0)
    count = 5 if settings > 0 else 1
    told = len(loop.step.samples)
    p, u = f"const {name}_parameters *p", "const F *u"
    inputs = {"shared": parameters.numbers, "lane": [f"u[{i}]" for i in range(count)], "carry": [f"m[{k}]" for k in range(loop.size)], "index": ["index"]}
    begin = plain_function(loop.start, f"{name}_begin", [p, u], inputs, [f"r[{k}]" for k in range(loop.size)], SEGMENT)
    seen = [p, "const F *m", u, "I index"]
    step = plain_function(loop.step, f"{name}_advance", seen, inputs, [f"r[{k}]" for k in range(loop.size + told)], SEGMENT)
    values = {
        "name": name, "upper": name.upper(), "guard": f"{name.upper()}_H", "version": __version__, "joints": n, "title": title_of(scenario),
        "type": "float" if is_float else "double", "integer": "int32_t" if is_float else "int64_t", "suffix": "name##f" if is_float else "name",
        "method": method, "settings": count, "told": told, "memory_size": loop.size, "outputs": ", ".join(OUTPUTS),
        "noise_setting": ", then the four words of the noise's key" if count > 1 else "",
        "parameters": parameters.declaration(f"{name}_real", joints), "defaults": parameters.defaults(is_float),
        "plain": words_for(begin + step), "lookup": LOOKUP if "f_lookup(" in begin + step else "", "start": begin, "sample": step, "rows": ROWS,
    }  # fmt: skip
    return WrittenLoop({f"{name}.h": filled("loop.h", values), f"{name}.c": filled("loop.c", values)}, parameters, values)


def _finite(value: np.ndarray) -> Any:
    """Numbers for JSON; null for what has no limit."""
    return np.where(np.isfinite(value), np.asarray(value, object), None).tolist()


def table(written: WrittenLoop, settings: list[float]) -> dict[str, Any]:
    """What a page must know of a module: its parameters, settings and records."""
    rows, offset = [], 0
    for field in written.parameters.fields:
        size = math.prod(field.shape)
        rows.append({"path": field.path, "offset": offset, "shape": list(field.shape), "unit": field.unit, "value": _finite(field.value)})
        offset += size
    n = written.values["joints"]
    columns = [{"name": name, "unit": unit, "offset": k * n, "size": n} for k, (name, unit) in enumerate(OUTPUTS.items())]
    columns.append({"name": "status", "unit": "1", "offset": len(OUTPUTS) * n, "size": 1})
    return {
        "parameters": rows, "settings": settings, "records": columns, "record": written.values["told"], "bytes": 8 if written.values["type"] == "double" else 4,
        "joints": n, "method": written.values["method"], "version": __version__,
    }  # fmt: skip


def wasm_files(written: WrittenLoop, folder: Path, settings: list[float]) -> list[str]:
    """Writes a module, its table and its sources into a folder; their names.

    Raises:
      ToolchainError: ziglang is not installed, or it failed.
    """
    name = written.values["name"]
    texts = written.files | {f"{name}_module.c": filled("wasm.c", written.values)}
    texts[f"{name}.json"] = json.dumps(table(written, settings), indent=1, allow_nan=False) + "\n"
    command = zig()
    folder.mkdir(parents=True, exist_ok=True)
    for file, text in texts.items():
        (folder / file).write_text(text)
    build([*command, *WASM_FLAGS, f"{name}.c", f"{name}_module.c", "-lm", "-o", f"{name}.wasm"], folder)
    return [*texts, f"{name}.wasm"]
