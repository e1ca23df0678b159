"""The contract between backends: on presets of every kind, over ten seconds, native gives what
plain vmap of the reference run gives.

The paper's preset goes by Runge-Kutta, the others by Euler's method, which has one stage to
compile.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.core.status import FAILED, Status
from iblf_jax.engine import RunRequest, compile_batch, native, run_batch
from iblf_jax.simulation.metrics import as_folds
from iblf_jax.simulation.scenario import canonical

needs_compiler = pytest.mark.skipif(native.unavailable() is not None, reason="no C++ compiler")
TOLERANCE = {"float64": 1e-10, "float32": 2e-4}
DT, RUNS = 1e-3, 6
STEPS = 10_000
VARIED = {"motor_driven_pendulum": "plant.D"}
"""Preset of a plant in strict-feedback form -> the leaf that differs between the runs; that of a
robot is a mass.  Its loop is oscillatory, so that it needs Runge-Kutta."""


def draws(name, scenario, dtype):
    """Masses and starts; the last run starts outside of its bounds."""
    rng = np.random.default_rng(3)
    start = np.asarray(scenario.initial.q) + 0.01 * rng.standard_normal((RUNS, scenario.n))
    start[-1] += 2.0 if name in VARIED else 1.0
    path = VARIED.get(name, "plant.mass[1]")
    value = float(np.ravel(ij.paths.get(scenario, path))[0])
    numbers = value * rng.uniform(0.7, 1.3, RUNS)
    return {path: jnp.asarray(numbers, dtype), "initial.q": jnp.asarray(start, dtype)}


outcome_of = partial(jax.jit, static_argnames="request")(run_batch)
CASES = [
    *(("zhang_yan_2024", "float64"), ("zhang_yan_2024", "float32")),
    ("motor_driven_pendulum", "float64"),
]
"""The pendulum with a drive stands for plants in strict-feedback form, the paper's preset for its
variants and robots; `test_programs_of_members` compares shorter runs of all."""


def comparable(status):
    """A status without what is chance: the fastest mode of a run at the instant at which it ran
    away."""
    return np.where(status & int(Status.NOT_FINITE), status & ~int(Status.STEP_TOO_LARGE), status)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize(("name", "dtype"), CASES)
def test_backends_agree_with_the_reference(name, dtype):
    method = "rk4" if (name, dtype) == ("zhang_yan_2024", "float64") or name in VARIED else "euler"
    run = RunRequest(STEPS, method, 250)
    scenario = canonical(ij.astype(ij.presets.PRESETS[name](), dtype))
    varied, dt = draws(name, scenario, dtype), jnp.asarray(DT, dtype)
    arguments = (scenario, varied, as_folds(None, dtype), dt)
    expected, found = (
        jax.tree.map(np.asarray, outcome_of(*arguments, request=run._replace(backend=backend)))
        for backend in ("vmap", "native")
    )
    assert compile_batch(run._replace(backend="native"), *arguments).backend == "native"
    ok = expected.status & int(FAILED) == 0
    assert np.any(ok) and np.any(~ok), expected.status
    np.testing.assert_array_equal(comparable(found.status), comparable(expected.status))
    times = (x.metrics["first_violation_time"] for x in (found, expected))
    np.testing.assert_allclose(*times, rtol=0, atol=1.01 * DT)
    for field in ("x", "e", "xi", "tau", "disturbance_estimate"):
        one, other = (x.records.signals[field][ok] for x in (found, expected))
        scale = max(1.0, np.abs(other).max())
        np.testing.assert_allclose(one, other, rtol=0, atol=TOLERANCE[dtype] * scale, err_msg=field)
