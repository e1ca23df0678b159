"""Decays against the independent program, in their limits, and through files, batches and code."""

from __future__ import annotations

import dataclasses
from functools import partial

import chain_cases
import independent_chains
import independent_decays as other
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax import barriers, controllers, decays, disturbances, observers

FINITE = other.Powers(((2.5, 0.45),), 0.02)
FIXED = other.Powers(((1.5, 0.4), (0.8, 1.6)), 0.015)
PRESCRIBED = other.Prescribed(0.8, 3.0, 25.0)
SECOND = other.Prescribed(0.9, 2.0, 15.0)
PAIRS = {
    "finite": (FINITE, other.Powers(((3.0, 0.6),), 0.05)),
    "fixed": (FIXED, other.Powers(((2.0, 0.5), (1.0, 1.4)), 0.04)),
    "prescribed": (PRESCRIBED, SECOND),
    "mixed": (FINITE, SECOND),
}


def of_package(decay):
    """A decay of the independent program in the package's terms."""
    if isinstance(decay, other.Prescribed):
        return decays.PrescribedTime(T=decay.T, gain=decay.order, cap=decay.cap)
    (k_a, a), *rest = decay.terms
    if not rest:
        return decays.FiniteTime(k_a=k_a, a=a, delta=decay.delta)
    ((k_b, b),) = rest
    return decays.FixedTime(k_a=k_a, k_b=k_b, a=a, b=b, delta=decay.delta)


def arm_scenario(pair, K2=20.0, **parts):
    """The paper's arm without disturbance, under Mapping with two decays."""
    law = controllers.Backstepping(
        k1=2.0,
        K2=K2,
        barrier=barriers.Mapping(),
        reading="corrected",
        decays=tuple(map(of_package, pair)),
    )
    given = {
        "controller": law,
        "observer": observers.NoObserver(),
        "disturbance": disturbances.Nothing(),
    }
    return ij.with_parts(ij.presets.zhang_yan_2024(), **(given | parts))


@jax.jit
def torque(scenario, t, q, dq):
    """The command at one state."""
    return scenario.controller.command(t, q, dq, jnp.zeros_like(q), scenario.context, ())[0].tau


@pytest.mark.parametrize("name", PAIRS)
def test_torque_of_an_arm_at_random_states(name, rng):
    first, second = PAIRS[name]
    scenario, arm = arm_scenario(PAIRS[name]), other.Arm(first=first, second=second)
    for t in rng.uniform(0.0, 1.1, 40):
        (_, _), (low, _), (up, _) = arm.tube(t)
        q = low + (up - low) * rng.uniform(0.05, 0.95, 2)
        dq = rng.normal(size=2)
        expected, _, _ = arm.torque(t, q, dq)
        found = torque(scenario, t, q, dq)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * max(abs(expected)))


@pytest.mark.parametrize("name", PAIRS)
def test_trajectory_of_an_arm(name):
    first, second = PAIRS[name]
    scenario = arm_scenario(PAIRS[name], K2=4.0)
    run = ij.simulate(scenario, duration=1.0, dt=5e-4, record_every=200)
    least_smooth = [0.8 - 0.24, 0.8, 0.9 - 4.0 / 15.0, 0.9]
    arm = other.Arm(K2=np.full(2, 4.0), first=first, second=second)
    expected = arm.run_at(np.asarray(run.t), least_smooth)
    np.testing.assert_allclose(run.q, expected[:, :2], atol=1e-7)
    np.testing.assert_allclose(run.dq, expected[:, 2:], atol=1e-7)


SLOWER = other.Prescribed(2.5, 3.0, 20.0)
CHAINS = {
    "pendulum": (other.Powers(((0.4, 0.5),), 0.05), FIXED, SLOWER),
    "coupled": (SLOWER, FINITE, FIXED),
    "surface": (FINITE, SLOWER, FIXED),
    "flexible": (SLOWER, FIXED, FINITE, SLOWER),
}


def chain_with(name, levels):
    """A case of the independent program, and its scenario, with a decay for each level."""
    case = dataclasses.replace(independent_chains.CASES[name], decays=levels)
    scenario = chain_cases.scenario(name)
    law = dataclasses.replace(scenario.controller, decays=tuple(map(of_package, levels)))
    return case, ij.with_parts(scenario, controller=law)


@partial(jax.jit, static_argnames="filtered")
def commanded(scenario, t, x, d_hat, beta, filtered):
    """The command of a law of levels at one state."""
    state = beta if filtered else ()
    return scenario.controller.command(t, x, d_hat, scenario.context, state)[0]


@pytest.mark.parametrize("name", CHAINS)
def test_input_of_a_chain_at_random_states(name):
    case, scenario = chain_with(name, CHAINS[name])
    tables = (independent_chains.SPREAD, independent_chains.NOISE)
    data = independent_chains.points(case, *(table.get(name) for table in tables))
    filtered = case.filter is not None
    betas = data["beta"] if filtered else np.zeros((len(data["t"]), 0))
    worst = 0.0
    for i, beta in enumerate(betas):
        x, d_hat = data["x"][i], data["d_hat"][i]
        found = commanded(scenario, data["t"][i], x, d_hat, beta, filtered)
        size = np.max(np.abs(data["u"][i]))
        worst = max(worst, np.max(np.abs(found.tau - data["u"][i])) / size)
    assert worst < 1e-12
