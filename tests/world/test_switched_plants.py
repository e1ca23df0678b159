"""Plants whose parameters switch: an independent program, the order, and Markov chains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loops_of_plants import band
from refused import refused
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax import controllers, plants, references
from iblf_jax.engine.diagnosis import report
from iblf_jax.simulation.closed_loop import initial_state, rate
from iblf_jax.simulation.noise import noise_key, realised
from iblf_jax.simulation.scenario import canonical

LINK = ij.robots.PlanarChain(mass=[0.8], length=[0.5], centre=[0.3], inertia=[0.05])
MASSES, TIMES = (0.8, 1.6, 0.5), (0.313, 0.7021)
Q = np.array([[-3.0, 2.0, 1.0], [1.0, -1.5, 0.5], [0.0, 4.0, -4.0]])


def scenario_of(plant):
    parts = {"bounds": band(-2.0, 2.0), "initial": ij.Initial(q=[0.2], dq=[0.5])}
    parts["reference"] = references.Sinusoid(offset=0.1, amplitude=0.3, frequency=2.0)
    return ij.Scenario(plant=plant, controller=controllers.PDGravity(Kp=9.0, Kd=2.0), **parts)


SWITCHED = plants.Switched(LINK, {"mass[0]": MASSES}, TIMES)


def independent_rate(t, x, mass):
    """The link under the PD law of a model with the first mass, with formulas of its own."""
    q, v = x
    desired, desired_rate = 0.1 + 0.3 * np.sin(2.0 * t), 0.6 * np.cos(2.0 * t)
    weight = 9.81 * 0.3 * np.cos(q)
    torque = MASSES[0] * weight - 9.0 * (q - desired) - 2.0 * (v - desired_rate)
    return np.array([v, (torque - mass * weight) / (0.05 + mass * 0.3**2)])


def independent_end(duration):
    """The state at the end, by an adaptive method that restarts at each switch."""
    x, edges = np.array([0.2, 0.5]), [0.0, *TIMES, duration]
    for mass, begin, end in zip(MASSES, edges[:-1], edges[1:], strict=True):
        how = {"args": (mass,), "rtol": 1e-12, "atol": 1e-13}
        x = solve_ivp(independent_rate, (begin, end), x, "DOP853", **how).y[:, -1]
    return x


def test_vector_field_against_an_independent_program():
    scenario = canonical(scenario_of(SWITCHED))
    field = jax.jit(lambda t, x: rate(scenario, t, initial_state(scenario)._replace(x=x)).x)
    rng = np.random.default_rng(3)
    for _ in range(30):
        t, *x = rng.uniform((0.0, -1.0, -2.0), (1.2, 1.0, 2.0))
        mass = MASSES[int(np.searchsorted(TIMES, t, side="right"))]
        found = field(jnp.asarray(t), jnp.asarray(x)[:, None])[:, 0]
        expected = independent_rate(t, x, mass)
        np.testing.assert_allclose(found, expected, atol=1e-11, rtol=1e-12)


@pytest.mark.slow
def test_trajectory_and_order_with_switches_between_the_instants():
    exact, errors = independent_end(1.0), []
    for steps in (40, 80, 320):
        run = ij.simulate(scenario_of(SWITCHED), duration=1.0, dt=1.0 / steps, backend="vmap")
        errors.append(np.max(np.abs(run.x[-1, :, 0] - exact)))
    assert errors[1] < 1e-5 and errors[2] < 1e-7
    assert np.log2(errors[0] / errors[1]) > 3.5
    assert float(run.metrics["switches"]) == 2
    assert float(run.metrics["shortest_dwell_time"]) == pytest.approx(0.313)
    assert float(run.metrics["mean_dwell_time"]) == pytest.approx(0.7021 / 2)


def test_members_of_the_inner_plant_are_passed_through():
    drive = plants.ElectricDrive(
        LINK, torque_constant=0.9, inductance=0.025, resistance=5.0, back_emf=0.9
    )
    outer = plants.Switched(drive, {"resistance": (5.0, 6.0), "robot.mass[0]": (0.8, 1.0)}, [0.4])
    assert (outer.n, outer.order) == (1, 3)
    for member in (plants.units_of, plants.level_names, plants.input_name):
        assert member(outer) == member(drive)
    assert float(outer.at(jnp.asarray(0.5)).robot.mass[0]) == 1.0
    assert float(outer.robot.mass[0]) == 0.8
    scenario = scenario_of(SWITCHED)
    assert scenario.model is LINK or scenario.model.mass is LINK.mass
    both = ij.with_parameters(scenario, {"robot.mass[0]": 0.9})
    assert float(both.model.mass[0]) == 0.9 == float(both.plant.mass[0])


PAIR = {"mass[0]": (1.0, 2.0)}


def markov(**fields):
    return plants.MarkovSwitched(LINK, {"mass[0]": MASSES}, rates=Q, **fields)


def paths_of(scenario, seed, count):
    keys = jax.vmap(lambda i: noise_key(jax.random.PRNGKey(seed), i))(jnp.arange(count))
    return jax.jit(jax.vmap(lambda key: realised(scenario, key).plant))(keys.astype(float))


@pytest.mark.slow
def test_distribution_of_the_path():
    found = paths_of(canonical(scenario_of(markov(switches=3))), 2, 20_000)
    times, modes = np.asarray(found.times), np.asarray(found.sequence)
    before = np.concatenate([np.zeros((len(modes), 1)), modes[:, :-1]], axis=1)
    dwell = np.diff(times, axis=1, prepend=0.0)
    assert np.all(modes != before)
    for i in range(3):
        here = before == i
        count = here.sum()
        assert dwell[here].mean() == pytest.approx(-1 / Q[i, i], rel=4 / np.sqrt(count))
        assert dwell[here].std() == pytest.approx(-1 / Q[i, i], rel=8 / np.sqrt(count))
        for j in range(3):
            share = 0.0 if i == j else -Q[i, j] / Q[i, i]
            assert np.mean(modes[here] == j) == pytest.approx(share, abs=2.5 / np.sqrt(count))


@pytest.mark.slow
def test_a_rate_that_is_varied_alone_changes_the_dwell_time():
    """A study varies q_ij without q_ii: the mean time in mode i is 1/sum_{j != i} q_ij."""
    one = scenario_of(markov(switches=1))
    found = paths_of(canonical(ij.with_parameters(one, {"plant.rates[0][1]": 9.0})), 3, 4_000)
    assert np.mean(found.times[:, 0]) == pytest.approx(0.1, rel=4 / np.sqrt(4_000))
    assert np.mean(np.asarray(found.sequence)[:, 0] == 1) == pytest.approx(0.9, abs=0.02)


@pytest.mark.slow
def test_every_run_of_a_study_has_a_path_of_its_own():
    scenario = scenario_of(markov(switches=2))

    how = {"duration": 0.5, "dt": 1e-2, "metrics": (ij.metrics.Tracking(),), "progress": False}
    every, some = (
        ij.monte_carlo(
            scenario, {}, runs=runs, executor=ij.studies.LocalExecutor(chunk=chunk), **how
        )
        for runs, chunk in ((600, None), (300, 256))
    )
    for name in ("ise", "switches", "shortest_dwell_time"):
        np.testing.assert_array_equal(some.metrics[name], every.metrics[name][:300])
    lost = (np.asarray(every.status) & int(ij.Status.MODES_EXHAUSTED)) != 0
    assert not np.array_equal(*(every.replay(i).scenario.plant.times for i in (0, 1)))
    assert 0 < lost.sum() < 300
    with pytest.warns(ij.SimulationWarning, match=r"Increase plant\.switches"):
        report(every.replay(int(np.flatnonzero(lost)[0])), 50, throw=False)
    assert np.all(every.metrics["switches"][lost] == 2)


test_modes_that_do_not_fit_are_refused = refused(
    (lambda: plants.Switched(LINK, {"mass[0]": (1.0, 2.0)}, [0.5, 0.6]), "3 values"),
    (lambda: plants.Switched(LINK, {"weight": (1.0, 2.0)}, [0.5]), "path of a parameter"),
    (lambda: plants.Switched(LINK, {"mass[0]": (1.0, -2.0)}, [0.5]), "positive values"),
    (lambda: plants.MarkovSwitched(LINK, {"mass[0]": (1.0, 0.0)}, Q[:2, :2]), "positive"),
    (lambda: plants.Switched(LINK, {"mass[0]": (1.0, 2.0, 3.0)}, [0.6, 0.5]), "increasing"),
    (lambda: plants.Switched(3.0, {"mass[0]": (1.0, 2.0)}, [0.5]), "Robot"),
    (lambda: plants.Switched(LINK, {}, [0.5]), "parameters"),
    (lambda: plants.MarkovSwitched(LINK, PAIR, [[-1.0, 2.0], [0, 0]]), "sum"),
    (lambda: scenario_of(plants.Switched(markov(), PAIR, [0.5])), "as the plant itself"),
)
