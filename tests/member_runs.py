"""Runs of scenarios from a folder of pickles, in processes that are told apart.

    python tests/member_runs.py FOLDER [--apart]

Each line of the input names a backend, a method and a file without its suffix.  The answer is a
line of JSON with position, velocity and torque at the end of a short run; a backend that cannot run
it is an error.  With `--apart`, each line gets a process of its own; it starts with the package
imported, and with nothing computed or compiled.
"""

import json
import os
import pickle
import sys
import warnings
from pathlib import Path

import jax

import iblf_jax as ij
from iblf_jax.engine.compile import BackendWarning

RUN = {"duration": 0.02, "dt": 2e-3}


def fitting(scenario: ij.Scenario, method: str) -> str:
    """The method, or the nearest one that the scenario admits."""
    if scenario.process_noise is not None:
        return "euler_maruyama"
    if method == "euler" and scenario.actuator.input_delay is not None:
        return "heun"
    return method


def answer(folder: Path, line: str) -> None:
    backend, method, name = line.strip().split(" ", 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", BackendWarning)
        scenario = pickle.loads((folder / f"{name}.pickle").read_bytes())
        method = fitting(scenario, method)
        run = ij.simulate(scenario, backend=backend, method=method, **RUN)
    end = [getattr(run, x)[-1].tolist() for x in ("q", "dq", "tau")]
    print(json.dumps({"name": name, "backend": backend, "end": end}), flush=True)


def serve(folder: Path, apart: bool) -> None:
    for line in sys.stdin:
        if not apart:
            answer(folder, line)
        elif os.fork() == 0:
            answer(folder, line)
            os._exit(0)
        else:
            os.wait()


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    serve(Path(sys.argv[1]), "--apart" in sys.argv)
