"""Checks an installed iblf_jax: `python tools/check_installation.py BACKEND [--reversed]`.

`tools/release` runs it in a new environment, in a folder outside of the repository.  BACKEND is the
executor that is expected of `monte_carlo`: "vmap" where there is no compiler, "native" where there
is one.  Where there is one, it is compared with "vmap" for scenarios of many structures, in one
process.  A second call with --reversed finds the compiled programs of the first one on the disk,
and uses them in another order.
"""

from __future__ import annotations

import argparse
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


def structures() -> dict[str, ij.Scenario]:
    """Scenarios of different structure: barriers, laws, observers, sensors, actuators, plants."""
    paper = ij.presets.zhang_yan_2024(variant="corrected")
    paper = ij.with_parameters(paper, {"controller.K2": 4.0, "observer.kf": 4.0})
    found = {}
    for barrier in (
        ij.barriers.Integral(),
        ij.barriers.Log(),
        ij.barriers.Tan(),
        ij.barriers.StateBarrier(),
        ij.barriers.PrescribedPerformance(),
        ij.barriers.TransformedError(),
        ij.barriers.Quadratic(),
    ):
        law = ij.controllers.Backstepping(k1=2.0, K2=4.0, barrier=barrier, variant="corrected")
        found[type(barrier).__name__] = ij.with_parts(paper, controller=law)
    computed = ij.controllers.ComputedTorque(Kp=25.0, Kd=10.0)
    found["ComputedTorque"] = ij.with_parts(paper, controller=computed)
    limited = ij.controllers.Saturated(law=paper.controller, limit=[4.0, 1.0])
    found["Saturated"] = ij.with_parts(paper, controller=limited)
    found["AsPublished"] = ij.with_parts(paper, observer=ij.observers.AsPublished(kf=4.0))
    found["Motor"] = ij.with_parts(paper, actuator=ij.actuators.Motor(bandwidth=300.0))
    found["Sampling"] = ij.with_parts(paper, sampling=ij.Sampling(period=2e-3))
    encoder = ij.sensors.Encoder(
        counts=65536.0, velocity=ij.sensors.FilteredDifference(cutoff=200.0)
    )
    found["Encoder"] = ij.with_parts(found["Sampling"], sensor=encoder)
    presets = ("zhang_yan_2024_full_state", "motor_driven_pendulum", "flexible_joint_two_link")
    for name in presets:
        found[name] = ij.presets.PRESETS[name]()
    return found


def check_structures(in_reverse: bool) -> None:
    """The executors agree on every structure, whichever were compiled before."""
    scenarios = list(structures().items())
    if in_reverse:
        scenarios.reverse()
    efforts: dict[bytes, str] = {}
    for name, scenario in scenarios:
        found = numbers_of(scenario, "auto")
        expected = numbers_of(scenario, "vmap")
        for key, value in expected.items():
            tolerance = {"rtol": 1e-9, "atol": 1e-9, "err_msg": f"{name}: {key}, auto and vmap"}
            np.testing.assert_allclose(found[key], value, **tolerance)
        other = efforts.setdefault(expected["effort"].tobytes(), name)
        assert other == name, f"{name} and {other} have the same effort"


def numbers_of(scenario: ij.Scenario, backend: str) -> dict[str, np.ndarray]:
    """The metrics of a small study of a scenario."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about gains that were chosen for another law
        study = ij.monte_carlo(
            scenario,
            {"initial.q": ij.offset(ij.uniform(-0.01, 0.01))},
            runs=4,
            duration=0.05,
            dt=1e-3,
            backend=backend,
            progress=False,
        )
    return {name: np.asarray(value) for name, value in study.metrics.items()}


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
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("backend", choices=["vmap", "native"])
    parser.add_argument("--reversed", action="store_true", help="structures in another order")
    options = parser.parse_args()
    check_package()
    check_run(options.backend)
    if options.backend != "vmap":
        check_structures(options.reversed)
    check_command_line()
    check_export()
    versions = f"Python {sys.version.split()[0]}, JAX {jax.__version__}"
    print(f"iblf_jax {ij.__version__} on {versions}: ok ({options.backend})")


if __name__ == "__main__":
    main()
