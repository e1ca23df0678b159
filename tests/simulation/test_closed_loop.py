"""The closed loop with other masses, gains, starts and bounds, against `independent.py`."""

import dataclasses

import independent
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import PAPER

import iblf_jax as ij
from iblf_jax.simulation.closed_loop import LoopState, evaluate

TIMES = np.linspace(0.0, 1.2, 121)


def random_loop(seed, law, variant) -> independent.Loop:
    """A feasible closed loop, far from the paper's numbers."""
    rng = np.random.default_rng(seed)
    mass, length = rng.uniform([1.5, 0.8], [3.0, 1.6]), rng.uniform(0.3, 0.5, 2)

    def wobble(low, high):
        return rng.uniform(low, high, 2), rng.uniform(0.5, 2, 2), rng.uniform(0, 6, 2)

    reference = rng.uniform(-0.5, 0.5, 2), *wobble(0.05, 0.15)

    loop = independent.Loop(
        mass=mass,
        length=length,
        centre=length * rng.uniform(0.4, 0.6, 2),
        inertia=mass * length**2 * rng.uniform(0.1, 0.3, 2),
        g=rng.choice([9.81, 1.62]),
        k1=rng.uniform(1, 4, 2),
        o=rng.uniform(0.05, 1, 2),
        K2=rng.uniform(5, 20, 2),
        kf=rng.uniform(5, 20, 2),
        p=None if law == "integral" else 1,
        corrected=variant == "corrected",
        reference=reference,
        lower=(reference[0] - rng.uniform(0.4, 0.6, 2), *wobble(0.02, 0.1)),
        upper=(reference[0] + rng.uniform(0.4, 0.6, 2), *wobble(0.02, 0.1)),
        force_a=(np.zeros(2), *rng.uniform(0.1, 1.5, (3, 2))),
        force_b=(np.zeros(2), *rng.uniform(0.1, 1.5, (3, 2))),
        dq0=rng.uniform(-0.5, 0.5, 2),
    )
    sides = loop.reference, loop.lower, loop.upper
    q_d, lower, upper = (independent.sine(*x)(0.0)[0] for x in sides)
    loop.q0 = q_d + rng.choice([-0.6, 0.6], 2) * np.minimum(upper - q_d, q_d - lower)
    return loop


def scenario_of(loop: independent.Loop) -> ij.Scenario:
    barrier = ij.barriers.Integral() if loop.p is None else ij.barriers.Log(p=loop.p)
    observer = ij.observers.Momentum if loop.corrected else ij.observers.AsPublished
    numbers = loop.mass, loop.length, loop.centre, loop.inertia
    sides = ij.bounds.Sinusoid(*loop.lower), ij.bounds.Sinusoid(*loop.upper)
    return ij.Scenario(
        plant=ij.robots.TwoLink(*numbers, g=loop.g),
        reference=ij.references.Sinusoid(*loop.reference),
        bounds=ij.bounds.Bounds(*sides),
        disturbance=ij.disturbances.ModelShaped(*loop.force_a[1:], *loop.force_b[1:]),
        controller=ij.controllers.Backstepping(
            k1=loop.k1,
            K2=loop.K2,
            o=loop.o,
            barrier=barrier,
            variant="corrected" if loop.corrected else "printed",
        ),
        observer=observer(kf=loop.kf),
        initial=ij.Initial(q=loop.q0, dq=loop.dq0),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "law", "variant"), [(0, "integral", "corrected"), (1, "log", "printed")]
)
def test_other_numbers_against_scipy(seed, law, variant):
    loop = random_loop(seed, law, variant)
    expected = loop.solve(TIMES, rtol=1e-9)
    run = ij.simulate(scenario_of(loop), **PAPER)
    assert run.ok
    names = {"disturbance": "f", "disturbance_estimate": "f_hat"}
    tolerances = {"q": 1e-7, "dq": 5e-5, "e1": 1e-7, "xi": 1e-6, "alpha": 1e-6, "e2": 5e-5}
    tolerances |= {"tau": 2e-3, "V": 1e-5} | dict.fromkeys(names, 1e-4)
    for name, tolerance in tolerances.items():
        found = np.asarray(getattr(run, name))[: TIMES.size]
        error = np.max(np.abs(found - expected[names.get(name, name)]))
        assert error <= tolerance, (name, error)


def test_a_matched_start_of_the_observer():
    """eta(0) = -kf M0 q'(0) makes f_hat(0) = 0, also with a moving start."""
    scenario = scenario_of(random_loop(1, "integral", "printed"))
    model, q, dq = scenario.model, scenario.initial.q, scenario.initial.dq
    printed = scenario.observer.kf * (model.mass_matrix(q) @ dq)
    for start, expected in (("zero", printed), ("matched", np.zeros(2))):
        observer = dataclasses.replace(scenario.observer, start=start)
        found = observer.estimate(0.0, q, dq, model, observer.init(q, dq, model))
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_plant_error_is_the_uncertain_term(rng):
    """An unknown payload and friction: f = M0 q" + C0 q' + G0 - tau, with q" by hand."""
    base = ij.presets.zhang_yan_2024()
    friction = ij.disturbances.Friction(viscous=0.3, coulomb=0.2, width=0.1)
    plant = dataclasses.replace(base.plant, payload=0.4)
    scenario = dataclasses.replace(base, plant=plant, disturbance=friction)
    step = jax.jit(evaluate)
    nominal, loaded = independent.Loop(), independent.Loop()
    m2, mp, l2, c2 = 0.85, 0.4, 0.31, 0.155
    c = (m2 * c2 + mp * l2) / (m2 + mp)
    i2 = 0.02042125 + m2 * (c - c2) ** 2 + mp * (l2 - c) ** 2
    loaded.mass, loaded.centre, loaded.inertia = (2.0, m2 + mp), (0.175, c), (0.06125, i2)
    for _ in range(5):
        q, v, eta = rng.uniform(0.4, 0.7, 2), rng.normal(size=2), rng.normal(size=2)
        state = LoopState(jnp.stack([q, v]), (), jnp.asarray(eta))
        rate, sample = step(scenario, np.asarray(0.3), state)
        tau = np.asarray(sample.tau)
        M, C, G, _ = loaded.arm(q)
        ddq = np.linalg.solve(M, tau - 0.3 * v - 0.2 * np.tanh(v / 0.1) - C(v) @ v - G)
        np.testing.assert_allclose(rate.dq, ddq, rtol=1e-10)
        M0, C0, G0, _ = nominal.arm(q)
        np.testing.assert_allclose(sample.disturbance, M0 @ ddq + C0(v) @ v + G0 - tau, atol=1e-10)
