"""The time loop for long closed loops (`compact_loop.run_compactly`) is the time loop: same records, metrics, verdicts and derivatives."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax import compact_loop, one_function, rollout, stability, time_loop
from iblf_jax.closed_loop import initial_state
from iblf_jax.metrics import as_folds
from iblf_jax.scenario import canonical
from iblf_jax.status import Status


def both(scenario, method="rk4", record_every=1, alone=True, steps=50, dt=1e-3):
    scenario, step = canonical(scenario), jnp.asarray(dt)
    folds = as_folds(None, step.dtype)
    options = {"steps": steps, "record_every": record_every, "method": method}
    plain = jax.jit(partial(time_loop.scan_steps, **options))(scenario, folds, step)
    return plain, jax.jit(partial(compact_loop.run_compactly, alone=alone, **options))(scenario, folds, step)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "record_every", "alone"),
    [("rk4", 7, False), ("heun", 1, True), ("euler", None, True)],
)
def test_it_is_the_same_run(paper, method, record_every, alone):
    plain, compact = both(ij.with_parameters(paper, {"initial.dq": [0.3, -0.2]}), method, record_every, alone)
    assert jax.tree.structure(plain) == jax.tree.structure(compact)
    for one, other in zip(jax.tree.leaves(plain), jax.tree.leaves(compact), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_a_run_that_breaks_is_flagged_alike(paper):
    for dt in (4e-3, 2e-2):  # it oscillates; it runs away
        plain, compact = both(paper, dt=dt, steps=150)
        assert int(plain.status) == int(compact.status)
        assert int(plain.status) & Status.STEP_TOO_LARGE


@pytest.mark.slow
def test_a_state_frozen_at_the_last_step_is_no_flag(paper):
    """The step after the end, which is not made, says nothing."""
    fast = ij.with_parameters(paper, {"controller.K2": 1e4})
    plain, compact = both(fast, method="euler", steps=1)
    assert int(plain.status) == int(compact.status)
    assert not int(compact.status) & Status.NOT_FINITE


@pytest.mark.slow
def test_long_loops_take_it(paper, monkeypatch):
    """By its length alone; a batch from outside and derivatives work as ever."""
    before = ij.simulate(paper, duration=0.011, dt=1e-3)
    monkeypatch.setattr(compact_loop, "is_for", lambda *args: True)
    rollout._run_compiled.clear_cache()
    try:

        def ise(K2):
            return ij.simulate(ij.with_parameters(paper, {"controller.K2": K2}), duration=0.011, dt=1e-3).metrics.ise.sum()

        compact = ij.simulate(paper, duration=0.011, dt=1e-3)
        K2 = jnp.array([20.0, 30.0])
        slope = jax.grad(ise)(K2)
        values = jax.vmap(ise)(K2[:, None] * jnp.ones(2))
    finally:
        rollout._run_compiled.clear_cache()
    np.testing.assert_allclose(before.q, compact.q, rtol=0, atol=1e-12)
    step = 1e-3
    for i in range(2):
        move = step * np.eye(2)[i]
        assert float(slope[i]) == pytest.approx(float(ise(K2 + move) - ise(K2 - move)) / (2 * step), rel=1e-5)
    assert float(values[0]) == pytest.approx(float(before.metrics.ise.sum()), rel=1e-9)


def test_the_two_ways_to_measure_a_mode_agree(paper):
    scenario = canonical(paper)
    state = initial_state(scenario)
    x, whole = jax.flatten_util.ravel_pytree(state)

    def rate(x):
        return jax.flatten_util.ravel_pytree(stability.rate(scenario, jnp.asarray(0.3), whole(x)))[0]

    exact = stability.fastest_mode(scenario, jnp.asarray(0.3), state)
    assert float(stability.fastest_mode_by_differences(rate, x)) == pytest.approx(float(exact), rel=1e-6)


def test_the_length_of_a_function_is_that_of_its_inner_ones():
    inner = jax.jit(lambda x: jnp.sin(x) + jnp.cos(x))
    closed = jax.make_jaxpr(lambda x: inner(x) * inner(2.0 * x))(1.0)
    assert sum(1 for _ in one_function._operations(closed.jaxpr)) == 8
    assert not one_function.is_long(inner, 1.0)
