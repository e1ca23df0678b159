"""What goes wrong in a run is flagged, with the physics in the message, and every number stays
finite."""

import dataclasses
import re
import warnings

import jax
import numpy as np
import pytest
from conftest import PAPER, SHORT
from jax.flatten_util import ravel_pytree

import iblf_jax as ij
from iblf_jax.core.status import FAILED, WORDS, WORDS_OF_LEVELS, Status, describe
from iblf_jax.engine import diagnosis
from iblf_jax.simulation.closed_loop import initial_state, rate


def quiet(scenario, **options) -> ij.Rollout:
    with warnings.catch_warnings(action="ignore"):
        return ij.simulate(scenario, **(SHORT | options))


SIGNALS = ("q", "dq", "tau", "e1", "e2", "xi", "alpha", "disturbance", "disturbance_estimate", "V")
MAY_BE_INFINITE = ("settling_time", "first_violation_time")


def all_finite(run) -> bool:
    arrays = {name: getattr(run, name) for name in SIGNALS} | dict(run.metrics.items())
    return all(np.all(np.isfinite(x)) for name, x in arrays.items() if name not in MAY_BE_INFINITE)


@pytest.mark.slow
def test_the_guard_alone_is_not_a_failure(paper):
    law = dataclasses.replace(paper.controller, barrier=ij.barriers.Integral(guard=0.05))
    start = ij.Initial(q=[0.5 + 0.9505 * 0.54, 0.8], dq=[-2.0, 0.0])  # xi is 0.9505, for an instant
    near = ij.with_parts(paper, controller=law, initial=start)
    with warnings.catch_warnings(action="error"):
        run = ij.simulate(near, duration=0.05, dt=1e-3)
    assert int(run.status) == Status.GUARD_ACTIVE
    assert not Status(int(run.status)) & FAILED
    assert all_finite(run)


@pytest.mark.slow
def test_a_step_too_large_is_found_and_a_step_that_works_is_named(paper):
    stiff = ij.with_parameters(paper, {"controller.K2": 200.0})
    words = r"fastest mode .* 1/s, so rk4 is stable up to dt = .* Take dt=0\.0001"
    with pytest.warns(ij.SimulationWarning, match=words):
        run = ij.simulate(stiff, **SHORT)
    assert int(run.status) & Status.STEP_TOO_LARGE and int(run.status) & Status.NOT_FINITE
    assert all_finite(run)
    with pytest.raises(ij.SimulationError, match="time step is too large"):
        ij.simulate(stiff, **SHORT, throw=True)
    dt = ij.recommended_dt(stiff, duration=SHORT["duration"])
    assert dt == 1e-4
    assert ij.simulate(stiff, duration=500 * dt, dt=dt).ok
    words = r"the mode may be that of the failure\. Take dt=0\.0001: if the run fails"
    with pytest.warns(ij.SimulationWarning, match=words):
        ij.simulate(ij.with_parameters(paper, {"controller.K2": 3e4}), **SHORT)


@pytest.mark.slow
def test_the_fastest_mode_is_the_largest_spectral_radius(paper, short_run):
    """Of the closed loop's exact Jacobian at the start, where the run was nearest to a bound and at
    the end: about K2 / lambda_min(M0), 850 to 1010 1/s."""
    assert ij.recommended_dt(paper) == 1e-3
    assert ij.recommended_dt(ij.with_parameters(paper, {"controller.K2": 2.0})) > 1e-3
    assert 800 < float(short_run.fastest_mode) < 1100
    flat, whole = ravel_pytree(initial_state(paper))

    @jax.jit
    def jacobian(t, x):
        return jax.jacfwd(lambda y: ravel_pytree(rate(paper, t, whole(y)))[0])(x)

    run = short_run
    states = np.concatenate([run.q, run.dq, run.observer_state], axis=1)
    np.testing.assert_array_equal(states[0], flat)
    places = (0, np.argmax(np.max(np.abs(run.xi), axis=1)), -1)
    radii = [np.max(np.abs(np.linalg.eigvals(jacobian(run.t[i], states[i])))) for i in places]
    assert float(run.fastest_mode) == pytest.approx(max(radii), rel=0.05)


@pytest.mark.slow
def test_a_run_away_state_is_frozen_at_its_last_good_value(paper):
    run = quiet(ij.with_parameters(paper, {"controller.K2": 150.0}))
    assert int(run.status) & Status.NOT_FINITE
    q = np.asarray(run.q)
    last = np.flatnonzero(np.any(np.diff(q, axis=0) != 0, axis=1))[-1]
    assert last < 400  # it stands still from somewhere on
    assert np.all(q[last + 1 :] == q[-1])
    assert all_finite(run)
    assert np.max(np.abs(run.dq)) < 1e4


@pytest.mark.slow
def test_an_infeasible_reference_is_an_error_with_joint_and_time(paper):
    """It touches the bound of joint 1 between recorded samples only, long after the start."""
    bounds = paper.bounds[0]
    upper = dataclasses.replace(bounds.upper, offset=[0.9, 0.5 + 0.14 * np.sqrt(2) - 1e-7])
    close = dataclasses.replace(bounds, upper=upper)
    scenario = ij.with_parts(paper, bounds=close, initial=ij.Initial(q=[0.8, 0.6]))
    words = r"reference of joint 1: .* inside .* at t = (5\.49|11\.78|18\.06).*Assumption 2"
    with pytest.raises(ValueError, match=words):
        quiet(scenario, **PAPER)


@pytest.mark.parametrize("flag", list(Status), ids=lambda flag: flag.name)
def test_every_flag_that_is_set_is_put_into_words(flag, short_run, monkeypatch):
    assert short_run.ok and describe(int(short_run.status)) == "ok"
    assert describe(int(Status.BOUND_VIOLATED | Status.NOT_FINITE)).count(";") == 1
    for words in (WORDS, WORDS_OF_LEVELS):
        assert describe(int(flag), words) == words[flag]
    if flag == Status.INFEASIBLE_REFERENCE:  # an error of its own, for the whole run
        return
    monkeypatch.setattr(diagnosis, "_explanations", lambda *_: [])
    status = np.int32(int(flag | Status.BOUND_VIOLATED))
    with pytest.warns(ij.SimulationWarning, match=re.escape(WORDS[flag])):
        diagnosis.report(dataclasses.replace(short_run, status=status), 1, throw=False)


def test_gains_below_the_theorem_are_advised_against(paper):
    for path, name in (("controller.K2", "K2"), ("observer.kf", "kf")):
        weak = ij.with_parameters(paper, {path: [20.0, 0.4]})
        words = f'{path} = .*Theorem 2 needs {name} > 1/2.*of the paper.*variant="corrected"'
        with pytest.warns(UserWarning, match=words):
            ij.simulate(weak, **SHORT)
        part = weak.controller if name == "K2" else weak.observer
        # There is nothing to say about a number that is not known yet.
        assert jax.jit(lambda p: len(p.advice()))(part) == 0
    # The claim of the corrected law holds for every K2 > 0; a light joint cannot have K2 > 1/2.
    corrected = ij.presets.zhang_yan_2024(variant="corrected")
    assert ij.with_parameters(corrected, {"controller.K2": 0.1}).controller.advice() == []


@pytest.mark.slow
def test_a_reference_that_is_too_fast_is_named_with_its_limit(paper):
    slow = ij.Bounds(lower=ij.bounds.Constant(-9.0), upper=ij.bounds.Constant([0.1, 9.0]))
    start = ij.Initial(q=paper.reference.position(0.0), dq=[0.0, 0.0])
    scenario = ij.with_parts(paper, bounds=(paper.bounds[0], slow), initial=start)
    with pytest.warns(ij.SimulationWarning, match=r", its limit is 0\.1 rad/s") as caught:
        run = ij.simulate(scenario, **SHORT)
    fastest = float(run.dq_d[:, 0].max())
    (text,) = [str(w.message) for w in caught]
    assert f"The reference of joint 0 reaches {fastest:.4g} rad/s at t = " in text
    assert "joint 1 reaches" not in text


def test_a_torque_that_was_cut_is_named_where_a_run_failed(short_run):
    values = short_run.metrics.values_by_name | {"saturated_share": np.array([0.0, 0.25])}
    metrics = ij.Metrics(values, short_run.metrics.unit_pairs)
    status = np.int32(int(Status.TORQUE_SATURATED | Status.STATE_BOUND_VIOLATED))
    run = dataclasses.replace(short_run, metrics=metrics, status=status)
    with pytest.warns(ij.SimulationWarning, match=r"cut the input, 25 % of the time in joint 1:"):
        diagnosis.report(run, 1, throw=False)
