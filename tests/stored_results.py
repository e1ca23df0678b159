"""Results of every class that `save` has, in files: for tests of what is printed, drawn and read,
which compute nothing then.

    python tests/stored_results.py [NAME ...]

computes all of them anew, or some, in minutes.
"""

import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

TESTS = Path(__file__).parent
if __name__ == "__main__":
    sys.path[:0] = [str(TESTS / "files")]
    import conftest  # before the first array

    conftest.choose_compilers(plain=True)

import numpy as np

import iblf_jax as ij

FOLDER = TESTS / "data" / "results"


def stored(name: str) -> Any:
    return ij.load(FOLDER / f"{name}.result")


def identified_without_friction() -> ij.Identification:
    """A log with noise, of which the Coulomb friction is not identified."""
    friction = ij.disturbances.Friction(viscous=[0.15, 0.08], coulomb=[0.2, 0.1], width=0.05)
    true = ij.with_parts(ij.presets.zhang_yan_2024(), disturbance=friction)
    run = ij.simulate(true, duration=3.0, dt=2e-3, record_every=2)
    t, q, tau = (np.asarray(x) for x in (run.t, run.q, run.tau))
    log = {"t": t, "q": q + 1e-4 * np.cos(77.0 * t)[:, None] * [1.0, 0.5], "tau": tau}
    values = {"plant.mass": [1.6, 1.0], "model.mass": [1.6, 1.0]}
    believed = ij.with_parameters(true, values | {"disturbance.coulomb": [0.0, 0.0]})
    return ij.identify(believed, log, ["robot.mass", "disturbance.viscous"], widths=False)


def makers() -> dict[str, Callable[[], Any]]:
    from test_results import EXAMPLES

    found = {
        f"{name}_{i}": make for name, all_of in EXAMPLES.items() for i, make in enumerate(all_of)
    }
    return found | {"Identification_1": identified_without_friction}


def main() -> None:
    warnings.simplefilter("ignore")
    made = makers()
    for name in sys.argv[1:] or made:
        made[name]().save(FOLDER / f"{name}.result")


if __name__ == "__main__":
    main()
