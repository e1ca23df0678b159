"""One time loop for all: the executors and the loops of JAX give the same run, and the plan decides
between them."""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import light_loop

import iblf_jax as ij
from iblf_jax.core.status import Status
from iblf_jax.engine import compile, plan, registry, thresholds
from iblf_jax.engine.batch import Batch, run_all
from iblf_jax.engine.carry import Inputs
from iblf_jax.engine.loops import checkpointed, scan
from iblf_jax.engine.request import RunRequest
from iblf_jax.simulation import stability
from iblf_jax.simulation.metrics import as_folds
from iblf_jax.simulation.scenario import canonical

DRAWS = {"controller.Kp": jnp.asarray([[60.0, 60.0], [80.0, 50.0], [40.0, 70.0]])}


@pytest.fixture(scope="module")
def short_loop():
    return light_loop()


def inputs_of(scenario, steps=50, dt=1e-3):
    scenario, step = canonical(scenario), jnp.asarray(dt)
    return Inputs(scenario, as_folds(None, step.dtype), step, jnp.asarray(float(steps)))


ROLLED = partial(scan, rolled=True)
"""The scan with the stages of the integrator as a loop."""


@partial(jax.jit, static_argnames=("run", "loop"))
def all_run(inputs, varied, run, loop):
    return run_all(loop, Batch.of(inputs, varied), run)


def outcome(inputs, run, varied=None, loop=scan):
    return jax.tree.map(np.asarray, all_run(inputs, varied, run, loop))


def assert_same(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_every_loop_makes_the_same_run(short_loop):
    """Alone and in a batch, with the stages of the integrator written out and as a loop, with
    records and without."""
    inputs = inputs_of(ij.with_parameters(short_loop, {"initial.dq": [0.3, -0.2]}))
    recorded, run = RunRequest(50, "heun", 7), RunRequest(50, "euler")
    together = outcome(inputs, recorded, varied=DRAWS)
    first = ij.with_parameters(inputs.scenario, jax.tree.map(lambda x: x[0], DRAWS))
    first = outcome(inputs._replace(scenario=first), recorded)
    assert_same(jax.tree.map(lambda x: x[0], together), first)
    assert_same(outcome(inputs, recorded, DRAWS, ROLLED), together)
    alone = outcome(inputs, run)
    for loop in (ROLLED, checkpointed):
        assert_same(outcome(inputs, run, loop=loop), alone)


@pytest.mark.slow
def test_a_state_frozen_at_the_last_step_is_no_flag(paper):
    """The step from the last instant, which is not made, says nothing."""
    fast = ij.with_parameters(paper, {"controller.K2": 1e4})
    for steps, expected in ((1, 0), (40, int(Status.NOT_FINITE))):
        found = outcome(inputs_of(fast, steps), RunRequest(steps, "euler")).status
        assert int(found) & int(Status.NOT_FINITE) == expected


@pytest.mark.slow
def test_a_failed_run_is_not_reported_inside_a_transformation(short_loop):
    """Its status is a number under `jacfwd`, and its metrics are traced."""
    failing = {"duration": 0.02, "dt": 1e-3, "method": "euler", "throw": True, "backend": "vmap"}
    fast = ij.with_parameters(short_loop, {"initial.dq": [30.0, 0.0]})

    def margin(Kp):
        changed = ij.with_parameters(fast, {"controller.Kp": Kp})
        return ij.simulate(changed, **failing).metrics.margin

    with warnings.catch_warnings(action="error"):
        slope = jax.jacfwd(margin)(jnp.asarray([60.0, 60.0]))
    assert np.all(np.isfinite(slope)) and slope.shape == (2, 2)
    with pytest.raises(ij.SimulationError, match="left its bounds"):
        ij.simulate(fast, **failing)


@pytest.mark.slow
def test_a_long_loop_whose_stages_are_rolled_has_the_same_gradient(paper, monkeypatch):
    def ise(K2):
        changed = ij.with_parameters(paper, {"controller.K2": K2})
        run = ij.simulate(changed, duration=0.011, dt=1e-3, method="heun", backend="vmap")
        return run.metrics.ise.sum()

    K2 = jnp.array([20.0, 30.0])
    found = []
    for limit in (thresholds.LONG_EVALUATION, 0):
        monkeypatch.setattr(thresholds, "LONG_EVALUATION", limit)
        compile.plan_of_single_run.cache_clear()
        assert thresholds.rolls_stages(1) == (limit == 0)
        found.append(np.hstack(jax.value_and_grad(ise)(K2)))
    compile.plan_of_single_run.cache_clear()
    np.testing.assert_allclose(*found, rtol=1e-9)
    assert np.all(found[0] != 0.0)


@pytest.mark.parametrize("steps", [1, 2, 7, 100, 501, 4001, 20_001])
def test_checkpoints_cover_the_run_with_few_steps_too_many(steps):
    inner, blocks = thresholds.checkpoint_edge(steps)
    made = inner * inner * blocks
    assert steps <= made <= 1.25 * steps + 1
    assert 2 * inner + blocks <= 5 * steps ** (1 / 3) + 3


def test_what_the_plan_says():
    """The stages of a long loop are a loop in the scan, and "auto" takes what the platform has."""
    assert [thresholds.rolls_stages(operations) for operations in (700, 10_000)] == [False, True]

    def backends(platform, backend):
        available = [registry.Availability(x.name, None) for x in registry.executors_for(platform)]
        machine = registry.Machine(platform, tuple(available))
        return plan.choose_plan(RunRequest(100, backend=backend), 1000, machine).backends

    assert backends("cpu", "auto") == backends("cpu", "native") == ("native",)
    assert backends("gpu", "auto") == ("gpu",)
    assert backends("tpu", "auto") == backends("cpu", "gpu") == backends("cpu", "vmap") == ()


@pytest.mark.parametrize("size", [2, 72])
def test_the_spectral_radius_is_that_of_the_largest_eigenvalue(size):
    """The map of a sampled loop of six joints has 72 rows."""
    A = np.random.default_rng(size).standard_normal((size, size))
    found = jax.jit(stability.spectral_radius)(A)
    assert float(found) == pytest.approx(np.abs(np.linalg.eigvals(A)).max(), rel=1e-3)
