"""Exported laws and loops outside of Python: self-tests, FMUs in FMPy and modules in wasmtime."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

fmpy, wasmtime = pytest.importorskip("fmpy"), pytest.importorskip("wasmtime")
validation = pytest.importorskip("fmpy.validation")

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wconversion")


def built_and_run(folder, *flags, name="iblf_law", compiler=("gcc",)):
    """What the self-test of a folder prints, built with these flags."""
    command = [*compiler, *STRICT, *flags, f"{name}.c", "selftest.c", "-lm", "-o", "selftest"]
    generated = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert generated.returncode == 0, generated.stderr
    ran = subprocess.run(["./selftest"], cwd=folder, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def run_fmu(file, output, duration, interval, inputs=None, **options):
    """The records of an FMU: those of a closed loop, or of a law with the inputs of a run.

    Args:
      inputs: "time" -> (T,), and name of an input -> (T, n).
    """
    assert validation.validate_fmu(str(file)) == []
    if inputs is not None:
        kinds = [(name, float, np.shape(values)[1:]) for name, values in inputs.items()]
        options["input"] = np.zeros(len(inputs["time"]), kinds)
        for name, values in inputs.items():
            options["input"][name] = values
    times = {"stop_time": duration, "output_interval": interval, "step_size": interval}
    return fmpy.simulate_fmu(str(file), output=[*output], **times | options)


class Module:
    """The closed loop of a folder in WebAssembly, with its default parameters."""

    def __init__(self, folder: Path):
        self.store = wasmtime.Store()
        module = wasmtime.Module.from_file(self.store.engine, str(folder / "iblf_loop.wasm"))
        assert list(module.imports) == []
        self.exports = wasmtime.Instance(self.store, module, []).exports(self.store)
        self.table = json.loads((folder / "iblf_loop.json").read_text())
        self.call("_initialize")
        self.call("defaults")
        self.put(self.call("settings"), self.table["settings"])

    def call(self, name, *arguments):
        return self.exports[name](self.store, *arguments)

    def put(self, place, values):
        self.exports["memory"].write(self.store, np.asarray(values, float).tobytes(), place)

    def run(self, steps, record_every):
        """Name -> records of a run, (T, size)."""
        self.call("start")
        rows, place = self.call("run", steps, record_every), self.call("records")
        end = place + 8 * rows * self.table["record"]
        numbers = np.frombuffer(self.exports["memory"].read(self.store, place, end), float)
        numbers = numbers.reshape(rows, -1)
        columns = self.table["records"]
        return {x["name"]: numbers[:, x["offset"] : x["offset"] + x["size"]] for x in columns}
