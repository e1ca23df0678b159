"""Checks an installed iblf_jax: `python tools/check_installation.py BACKEND`.

`tools/release` runs it in a new environment, in a folder outside of the repository.  BACKEND is the
executor that is expected of `monte_carlo`: "vmap" where there is no compiler, "native" where there
is one.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import iblf_jax as ij


def check_package() -> None:
    """The package is the installed one, with the data that it needs."""
    home = Path(ij.__file__).resolve()
    assert "site-packages" in home.parts, f"{home} is not an installation"
    assert (home.parent / "py.typed").exists(), "the mark of typed packages is missing"
    for name in ("zhang_yan_2024", "iiwa14"):
        getattr(ij.presets, name)()


def check_run(backend: str) -> None:
    """A run and a study have the expected numbers, with the expected executor."""
    scenario = ij.presets.zhang_yan_2024()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run = ij.simulate(scenario, duration=1.0, dt=1e-3)
        study = ij.monte_carlo(
            scenario,
            {"plant.mass": ij.factor(ij.uniform(0.9, 1.1))},
            runs=8,
            duration=0.5,
            dt=1e-3,
        )
    assert int(run.status) == 0, f"status {ij.Status(int(run.status))!r}"
    assert np.all(np.asarray(run.metrics.margin) > 0.0), "the arm left its bounds"
    assert np.all(np.asarray(study.status) == 0), "a run of the study failed"
    texts = [str(warning.message) for warning in caught]
    advised = any("iblf_jax[export]" in text for text in texts)
    assert advised == (backend == "vmap"), f"{backend}: warnings {texts}"
    explained = str(ij.explain(scenario, varied=["plant.mass"]))
    assert f"a batch runs on {backend}" in explained, explained


def check_command_line() -> None:
    """The command writes a run and its figures."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "iblf_jax", "simulate", "zhang_yan_2024"]
        options = ["--duration", "0.5", "--out", folder]
        subprocess.run([*command, *options], check=True, capture_output=True)
        kinds = {path.suffix for path in Path(folder).rglob("*")}
    assert ".png" in kinds, f"no figure among {kinds}"


def check_export() -> None:
    """A law is exported as C and, where a compiler is installed, as WebAssembly."""
    with tempfile.TemporaryDirectory() as folder:
        ij.export(ij.presets.zhang_yan_2024(), Path(folder) / "law", period=1e-3)
        assert list((Path(folder) / "law").rglob("*.c")), "no C file was written"


def main() -> None:
    """Runs all checks."""
    check_package()
    check_run(sys.argv[1])
    check_command_line()
    check_export()
    print(f"iblf_jax {ij.__version__} on Python {sys.version.split()[0]}: ok ({sys.argv[1]})")


if __name__ == "__main__":
    main()
