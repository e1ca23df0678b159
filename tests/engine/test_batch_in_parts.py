"""A batch whose parts are compiled one by one: the same results, and parts that are shared."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.core.status import UNTRUSTED, Status
from iblf_jax.engine import RunRequest, batch_in_parts, compile_batch, run_batch_in_parts
from iblf_jax.simulation.metrics import as_folds
from iblf_jax.simulation.scenario import canonical

DT = 2e-3
GAINS = {"controller.K2": np.asarray([[20.0, 20.0], [5.0, 60.0], [4e3, 20.0]])}
"""The step is too large for the last gains."""


def sampled():
    velocity = ij.sensors.FilteredDifference(cutoff=300.0)
    parts = {"sampling": ij.Sampling(period=2 * DT)}
    parts["sensor"] = ij.sensors.Encoder(counts=2.0**14, velocity=velocity)
    return ij.with_parts(ij.presets.zhang_yan_2024(), **parts)


@pytest.fixture(params=[ij.presets.zhang_yan_2024, sampled], ids=["continuous", "sampled"])
def problem(request):
    scenario = canonical(request.param())
    dtype = scenario.initial.q.dtype
    varied = {path: jnp.asarray(x, dtype) for path, x in GAINS.items()}
    return scenario, varied, as_folds(None, dtype, scenario), jnp.asarray(DT, dtype)


def compiled_programs():
    parts = (batch_in_parts._initialize, batch_in_parts._all_steps, batch_in_parts._finalize)
    return [part._cache_size() for part in parts]


def request_for(scenario, steps, **options):
    return RunRequest.of(scenario, steps=steps)._replace(**options)


@pytest.mark.slow
def test_the_parts_make_the_outcome_of_one_program(problem):
    request = request_for(problem[0], 30)
    complete = jax.jit(partial(compile_batch(request, *problem)))(*problem)
    found = run_batch_in_parts(*problem, request)
    assert found.metrics.keys() == complete.metrics.keys()
    assert found.status.tolist() == complete.status.tolist()
    assert found.status[-1] & int(Status.STEP_TOO_LARGE)
    for name, x in {**complete.metrics, "mode": complete.fastest_mode}.items():
        other = found.metrics.get(name, found.fastest_mode)
        np.testing.assert_allclose(other, x, rtol=1e-6, err_msg=name)

    # The scan gives the same numbers.
    by_scan = run_batch_in_parts(*problem, request._replace(backend="vmap", constants=None))
    np.testing.assert_allclose(by_scan.metrics["rmse"], complete.metrics["rmse"], rtol=2e-4)


@pytest.mark.slow
def test_nothing_is_compiled_for_another_number_of_steps(problem):
    run_batch_in_parts(*problem, request_for(problem[0], 80))
    before = compiled_programs()
    *others, dt = problem
    half = run_batch_in_parts(*others, 0.5 * dt, request_for(problem[0], 160))
    assert compiled_programs() == before
    batch = compile_batch(request_for(problem[0], 160), *others, 0.5 * dt)
    by_one = jax.jit(partial(batch))(*others, 0.5 * dt)
    np.testing.assert_allclose(half.metrics["rmse"], by_one.metrics["rmse"], rtol=1e-6)


@pytest.mark.slow
def test_without_the_assessment_the_other_numbers_are_the_same(problem):
    request = request_for(problem[0], 30)
    complete = run_batch_in_parts(*problem, request)
    before = compiled_programs()
    found = run_batch_in_parts(*problem, request._replace(assessed=False))
    assert np.subtract(compiled_programs(), before).tolist() == [0, 0, 1]
    assert found.metrics.keys() < complete.metrics.keys()
    assert not {"numerical_error", "sampling_radius"} & found.metrics.keys()
    for name, x in found.metrics.items():
        np.testing.assert_array_equal(x, complete.metrics[name], err_msg=name)
    np.testing.assert_array_equal(found.fastest_mode, complete.fastest_mode)
    flags = np.asarray([found.status, complete.status]) & int(UNTRUSTED)
    assert flags[0].tolist() == flags[1].tolist() and flags[0, -1]
