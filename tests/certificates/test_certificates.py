"""Certificates: at random states, along runs, without a claim, of many runs; the printed gap."""

import dataclasses
import json
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from claim_terms import terms_at
from conftest import PAPER, SHORT
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.certificates import Certificate, certify, counterexample, summary
from iblf_jax.certificates.claims import theorem, weighted
from iblf_jax.certificates.claims.two_cases import Gains, gains_of
from iblf_jax.certificates.eigenvalues import eigenvalues_over
from iblf_jax.certificates.lines import Role, Statement
from iblf_jax.certificates.summary import restarts
from iblf_jax.certificates.terms import Terms, rounding
from iblf_jax.simulation.closed_loop import LoopState, initial_state
from iblf_jax.simulation.scenario import canonical
from iblf_jax.studies.perturbation_cube import unit_cube

OWN = {"duration": 0.08, "dt": 1e-3, "method": "euler"}
"""A run whose length does not matter; so few steps need one kernel, not two."""


def between(low, high):
    return ij.value(ij.uniform(low, high))


BARRIERS = {
    "integral": ij.barriers.Integral(),
    "log_p2": ij.barriers.Log(p=2),
    "tan": ij.barriers.Tan(),
    "state": ij.barriers.StateBarrier(),
    "prescribed_performance": ij.barriers.PrescribedPerformance(),
    "mapping": ij.barriers.TransformedError(),
    "quadratic": ij.barriers.Quadratic(),
}
WITH_WEIGHTS = ("tan", "quadratic")
"""Barriers under which the claim with weights is tested, and not the one of Theorem 2."""


def loop(variant: str = "corrected", observer: str = "momentum", barrier=None) -> ij.Scenario:
    """The paper's loop with one law and one observer, to be varied by `random_loops`."""
    barrier = ij.barriers.Integral(guard=1e-3) if barrier is None else barrier
    law = ij.controllers.Backstepping(k1=2.0, K2=20.0, barrier=barrier, variant=variant)
    parts = {"controller": law, "observer": ij.observers.MEMBERS[observer](kf=20.0)}
    return canonical(dataclasses.replace(ij.presets.zhang_yan_2024(), **parts))


def random_loops(scenario, seed=0, *, states=4096, speed=10.0, nearest=0.99, weighted=False):
    """Scenarios with other gains, masses and disturbances, and a time and state of each: (scenario,
    t, state), batched. With `weighted` the barriers have weights, and the gains are anything
    positive: below the conditions of Theorem 2, too."""
    dtype, rng, n = scenario.initial.q.dtype, np.random.default_rng(seed), scenario.n

    def uniform(low, high, *shape):
        return rng.uniform(low, high, (states, *shape)).astype(dtype)

    every = jax.tree.map(lambda x: np.broadcast_to(x, (states, *np.shape(x))), scenario)
    gains = {} if scenario.controller.o is None else {"o": 10 ** uniform(-3, 0, n)}
    gains |= {"k1": 10 ** uniform(-1, 1, n), "K2": 0.5 + 10 ** uniform(-2, 1.7, n)}
    kf, phase = 1.0 + 10 ** uniform(-2, 1.7, n), uniform(0.0, 6.28)
    load = {"mass": every.plant.mass * uniform(0.5, 1.5, n), "payload": uniform(0.0, 0.5)}
    batch = _rebuilt(
        every,
        controller=_rebuilt(every.controller, **gains),
        observer=_rebuilt(every.observer, kf=kf),
        disturbance=_rebuilt(every.disturbance, phase=phase),
        plant=_rebuilt(every.plant, **load),
        model=_rebuilt(every.model, mass=every.model.mass * uniform(0.5, 1.5, n)),
    )
    t, dq = uniform(0.0, 20.0), uniform(-speed, speed, n)
    q, momentum = _position(batch, t, uniform(-nearest, nearest, n), dq)
    if weighted:
        light = {"weight": 10 ** uniform(-3, 1.5, n), "K2": 10 ** uniform(-3, 1.7, n)}
        law, kf = _rebuilt(batch.controller, **light), 10 ** uniform(-3, 1.7, n)
        batch = _rebuilt(batch, controller=law, observer=_rebuilt(batch.observer, kf=kf))
    eta = uniform(-5.0, 5.0, n) - batch.observer.kf * momentum
    return batch, t, LoopState(jnp.stack([q, dq], axis=-2), (), eta)


def _rebuilt(part, **changes):
    """A component with other fields, unchecked: its leaves are batched."""
    copy = object.__new__(type(part))
    for field in dataclasses.fields(part):
        object.__setattr__(copy, field.name, changes.get(field.name, getattr(part, field.name)))
    return copy


@jax.jit
@jax.vmap
def _position(scenario: ij.Scenario, t, xi, dq):
    """The position with this relative error, and M0 q' there."""
    tube = scenario.context.tube(t)
    q = tube.q_d + xi * jnp.where(xi > 0, tube.k_u, tube.k_l)
    return q, scenario.model.mass_matrix(q) @ dq


@jax.jit
def terms_of(batch: ij.Scenario, t, state: LoopState) -> Terms:
    """The terms of the claims at each of the states."""
    return jax.vmap(terms_at)(batch, t, state)


def proven_rate(scenario, t, state, proof):
    """V2' of the integral barrier by (3.8) and (3.24), with the terms that the proof drops."""
    law, kf = scenario.controller, scenario.observer.kf
    tube = scenario.context.tube(t)
    above = state.q > tube.q_d
    k, dk = jnp.where(above, tube.k_u, tube.k_l), jnp.where(above, tube.dk_u, tube.dk_l)
    kappa = jnp.sqrt((tube.dk_u / tube.k_u) ** 2 + (tube.dk_l / tube.k_l) ** 2 + law.o)
    xi, e2, f_tilde = tube.xi(state.q), proof.e[1], proof.d_tilde
    position = -jnp.sum(2 * xi**2 / (1 - xi**2) * (law.k1 + kappa + dk / k))
    rest = -e2 @ (law.K2 * e2) + e2 @ f_tilde + f_tilde @ proof.dd - f_tilde @ (kf * f_tilde)
    dropped = proof.claims["torque"]
    return position + rest + dropped.dropped_e2 + dropped.dropped_f


def rho_of(scenario, proof, case):
    """The rate of Theorem 2, the least of its three terms, with the largest eigenvalue of M0."""
    lambda_max = jnp.linalg.eigvalsh(proof.claims["torque"].M0)[-1]
    return jnp.min(theorem.rho_terms(gains_of(scenario), lambda_max, case))


def left_side(batch, proof):
    """V2' + rho V2 - |f'|^2/2 with lambda_max of each position."""
    rho = jax.vmap(partial(rho_of, case=2))(batch, proof)
    return np.asarray(proof.dV + rho * proof.V - 0.5 * jnp.sum(proof.dd**2, axis=-1))


@pytest.mark.slow
@pytest.mark.parametrize("case", ["corrected printed float32", "printed momentum float64"])
def test_the_rate_of_V2_is_the_proofs_plus_the_dropped_terms(case):
    variant, observer, dtype = case.split()
    batch, t, state = random_loops(ij.astype(loop(variant, observer), dtype), nearest=0.998)
    proof = terms_of(batch, t, state)
    assert proof.dV.dtype == dtype and not np.any(proof.excluded)
    error = np.abs(np.asarray(jax.jit(jax.vmap(proven_rate))(batch, t, state, proof) - proof.dV))
    allowed = rounding(dtype) * np.asarray(proof.size)
    assert np.all(error <= allowed)
    # The tolerance is small beside what it judges, so that it hides nothing.
    assert np.median(allowed / np.abs(proof.dV)) < (1e-11 if dtype == "float64" else 5e-3)
    dropped = proof.claims["torque"]
    assert np.any(np.asarray(dropped.dropped_e2) != 0) == (variant == "printed")
    assert np.any(np.asarray(dropped.dropped_f) != 0) == (observer == "printed")


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in BARRIERS if name not in WITH_WEIGHTS])
def test_corrected_keeps_the_inequality_at_every_state(name):
    batch, t, state = random_loops(loop(barrier=BARRIERS[name]), speed=30.0)
    proof = terms_of(batch, t, state)
    free = ~np.asarray(proof.excluded)
    assert np.mean(free) > 0.9
    left, allowed = left_side(batch, proof), rounding("float64") * np.asarray(proof.size)
    assert np.all(np.isfinite(left[free])) and np.all(left[free] <= allowed[free])


@pytest.mark.slow
def test_inequality_is_an_equality_where_the_proof_leaves_nothing():
    # e1 = 0, e2 = f_tilde = f', and equal rates of the claim: each step is an equality.
    rate = 1.7
    arm = ij.robots.PlanarChain(mass=[1.3], length=[0.4], centre=[0.2], inertia=[0.02])
    K2 = 0.5 + 0.5 * rate * float(arm.mass_matrix(jnp.zeros(1))[0, 0])
    scenario = ij.with_parts(
        one_joint(arm),
        bounds=ij.bounds.Bounds(lower=ij.bounds.Constant(-1.0), upper=ij.bounds.Constant(2.0)),
        disturbance=ij.disturbances.Sinusoids(amplitude=0.8, frequency=1.0),
        controller=ij.controllers.Backstepping(k1=5.0, K2=K2, variant="corrected"),
        observer=ij.observers.Momentum(kf=1.0 + 0.5 * rate, start="matched"),
        initial=ij.Initial(q=0.5, dq=0.1 + 0.8),
    )
    scenario = canonical(ij.with_parameters(scenario, {"observer.eta0": -0.8}))
    seen = jax.jit(terms_at)(scenario, jnp.zeros(()), initial_state(scenario))
    np.testing.assert_allclose([seen.e[1, 0], seen.d_tilde[0], seen.dd[0]], 0.8, rtol=1e-12)
    rho = rho_of(scenario, seen, 2)
    assert float(rho) == pytest.approx(rate, rel=1e-12)
    left = float(seen.dV + rho * seen.V - 0.5 * seen.dd @ seen.dd)
    assert abs(left) <= rounding("float64") * float(seen.size) < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("name", WITH_WEIGHTS)
def test_the_claim_with_weights_holds_at_every_state_for_every_positive_gain(name):
    """(W.1) with any a, b and w_f, at any weights, and gains far below Theorem 2's conditions."""
    rng, scenario = np.random.default_rng(5), loop(barrier=BARRIERS[name])
    batch, t, state = random_loops(scenario, 5, states=1024, speed=30.0, weighted=True)
    proof = jax.tree.map(np.asarray, terms_of(batch, t, state))
    K2, kf = np.asarray(batch.controller.K2), np.asarray(batch.observer.kf)
    assert np.mean(np.any(K2 < 0.5, axis=1) & np.any(kf < 0.5, axis=1)) > 0.4
    decay = batch.controller.barrier.decay_rate(np.asarray(batch.controller.k1))
    a = rng.uniform(0.02, 0.98, t.size)
    b = 2.0 * kf.min(axis=1) * rng.uniform(0.02, 0.9, t.size)
    least = 0.25 / (a[:, None] * K2 * (kf - b[:, None] / 2.0))
    w_f = least.max(axis=1) * 10 ** rng.uniform(0.0, 2.0, t.size)
    M0 = proof.claims["torque"].M0
    scaled = M0 / np.sqrt(K2[:, :, None] * K2[:, None, :])
    mu = 1.0 / np.linalg.eigvalsh(scaled)[:, -1]
    numbers = zip(decay, K2, kf, mu, a, b, w_f, strict=True)
    terms = np.array([weighted.rate_terms(Gains(*each[:3]), *each[3:]) for each in numbers])
    assert np.all(terms > -1e-9 * (1.0 + kf.max(axis=1))[:, None])
    rho, half_square = terms.min(axis=1), 0.5 * np.sum(proof.d_tilde**2, axis=1)
    V = proof.V + (w_f - 1.0) * half_square
    rate = proof.dV + (w_f - 1.0) * np.sum(proof.d_tilde * proof.dd_tilde, axis=1)
    left = rate + rho * V - w_f / (2.0 * b) * np.sum(proof.dd**2, axis=1)
    allowed = rounding("float64") * np.maximum(1.0, w_f) * proof.size
    free = ~proof.excluded
    assert np.mean(free) > 0.9 and np.all(left[free] <= allowed[free])
    # Without e2 and f_tilde, what is left of V_w is the barriers' with their weights.
    e2 = proof.e[:, 1]
    V1 = V - w_f * half_square - 0.5 * np.einsum("ti,tij,tj->t", e2, M0, e2)

    def weighted_barrier(scenario, t, q):
        law = scenario.controller
        return jnp.sum(law.weight * law.barrier.value(scenario.context.tube(t), q))

    expected = jax.vmap(weighted_barrier)(batch, t, state.q)
    np.testing.assert_allclose(V1, expected, rtol=1e-6, atol=1e-9 * np.abs(V).max())


def test_the_weights_of_the_envelope_give_its_smallest_mean_and_it_starts_anew_at_jumps():
    """No other a, b and w_f that (W.2) admits is better by more than the grid is coarse."""
    gains = Gains(*(np.array(x) for x in ([4.0, 3.0], [0.2, 0.05], [0.7, 0.4])))
    given = {"mu": 0.9, "V_rest": 0.3, "half_square": 0.05, "F_d": 0.2, "duration": 10.0}

    def mean(rho, w_f, rho2):
        fading = (1.0 - np.exp(-rho * 10.0)) / (rho * 10.0)
        return (given["V_rest"] + w_f * given["half_square"]) * fading + rho2 / rho

    found = weighted.best_constants(gains, *given.values(), 2)
    terms = weighted.rate_terms(gains, 0.9, found.a, found.b, found.w_f)
    assert np.min(terms) == pytest.approx(found.rho)
    rng, others = np.random.default_rng(0), []
    for a, b, exponent in rng.uniform(0, [1.0, 0.8, 4.0], (20000, 3)):
        w_f = 10**exponent
        rho = np.min(weighted.rate_terms(gains, 0.9, a, b, w_f))
        others.append(mean(rho, w_f, w_f * given["F_d"] ** 2 / (2 * b)) if rho > 0 else np.inf)
    assert mean(found.rho, found.w_f, found.rho2) < 1.01 * min(others)
    assert weighted.best_constants(gains, 0.9, np.nan, 0.0, 0.2, 10.0, 2) is None
    begins = restarts(np.arange(6.0), np.arange(6) == 2, np.array([3.5, 5.0]))
    np.testing.assert_array_equal(begins, [True, False, False, True, True, True])


@pytest.fixture(scope="module")
def corrected_run():
    return ij.simulate(ij.presets.zhang_yan_2024(variant="corrected"), **PAPER)


@pytest.mark.slow
def test_paper_run_keeps_the_printed_inequality(paper, paper_run):
    paper_certificate = certify(paper, paper_run)
    assert paper_certificate.holds and not paper_certificate.is_of_own_claim
    np.testing.assert_allclose(paper_certificate.traces.V, paper_run.V, rtol=1e-9)
    numbers = paper_certificate.numbers
    assert numbers["case"] == 2 and numbers["rho_run_case_2"] == pytest.approx(4.0)
    assert numbers["V2_start"] == pytest.approx(0.966, abs=1e-3)
    line = paper_certificate["inequality, case 2"]
    assert line.verdict == "holds" and 1e-6 < line.margin < 1e-3
    for name, equation in {"inequality": "(3.18)", "envelope": "(3.20)", "rho": "(3.19)"}.items():
        line = paper_certificate[f"{name}, case 1"]
        assert (line.verdict, line.equation) == ("not applicable", equation)
    assert paper_certificate["xi"].equation == "(3.31)"
    dropped = (paper_certificate[f"dropped term of the {part}"] for part in ("law", "observer"))
    by_law, by_observer = dropped
    assert 1e-3 < by_law.value < by_observer.value < 0.05 and "at most 18.5 %" in by_observer.note
    with pytest.raises(KeyError, match="envelope, case 1"):
        paper_certificate["envelopes"]
    assert_refused("until", paper_certificate.plot, until=1e-6)
    # M0 of two links depends on q2 alone: it is largest at the end of the box, 0.06.
    M0 = np.asarray(paper.model.mass_matrix(jnp.array([0.0, 0.06])))
    largest = np.linalg.eigvalsh(M0)[-1]
    assert numbers["lambda_max_box"] == pytest.approx(largest, rel=1e-6)
    assert numbers["lambda_max_run"] <= largest
    assert "grid" in paper_certificate["rho, case 2, over the box"].note
    # The role of a line and not its name decides the verdict.
    for role, verdict in ((Role.INEQUALITY, "holds"), (Role.OTHER, "not applicable")):
        line = Statement("decay", "(X.1)", "V' <= -V", role=role).line("holds")
        assert dataclasses.replace(paper_certificate, lines=(line,)).verdict == verdict


@pytest.mark.slow
def test_lambda_max_over_the_box_of_many_joints():
    ones = np.ones(4)
    arm = ij.robots.PlanarChain(ones, 0.3 * ones, 0.15 * ones, 0.01 * ones)
    extremes = eigenvalues_over(arm, -ones, ones)
    straight = np.linalg.eigvalsh(np.asarray(arm.mass_matrix(jnp.zeros(4))))
    assert extremes.lambda_max == pytest.approx(straight[-1], rel=1e-6)
    assert "Sobol" in extremes.searched
    some = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (300, 4)))
    assert extremes.lambda_min <= np.linalg.eigvalsh(jax.vmap(arm.mass_matrix)(some)).min()


LIGHT = {"controller.K2": [0.3, 0.1], "observer.kf": [0.4, 0.9], "controller.weight": [0.5, 0.05]}


@pytest.mark.slow
def test_claims_with_weights_scale_with_them_and_a_broken_one_is_seen(corrected_run, monkeypatch):
    """With a rate that is too large the inequality fails where the right one holds.  V1 is
    sum w_i V1_i in every line: the inequality, the envelope, and xi by the barrier of its joint."""
    scenario = ij.with_parameters(corrected_run.scenario, LIGHT)
    run = ij.simulate(scenario, **SHORT)
    certificate = certify(scenario, run)
    assert certificate.holds and certificate["weighted inequality, case 2"].verdict == "holds"
    assert (certificate["K2"].verdict, certificate["K2"].enters_verdict) == ("fails", False)
    best = weighted.best_constants

    def too_fast(*given):
        found = best(*given)
        return found and found._replace(rho=1e3 * found.rho)

    with monkeypatch.context() as patch:
        patch.setattr(weighted, "best_constants", too_fast)
        certificate = certify(scenario, run)
    assert certificate["weighted inequality, case 2"].verdict == "fails"
    assert certificate.verdict == "fails"
    assert "the claim with weights holds" not in certificate.headline
    weight = [0.3, 2.5]
    scenario = ij.with_parameters(corrected_run.scenario, {"controller.weight": weight})
    run = ij.simulate(scenario, **SHORT)
    certificate = certify(scenario, run)
    assert certificate.holds, certificate
    V1 = -np.log(1.0 - np.asarray(run.xi[0]) ** 2) * weight
    M0, e2 = np.asarray(scenario.model.mass_matrix(run.q[0])), np.asarray(run.e2[0])
    f_tilde = np.asarray(run.disturbance[0] - run.disturbance_estimate[0])
    V = V1.sum() + 0.5 * (e2 @ M0 @ e2 + f_tilde @ f_tilde)
    assert certificate.numbers["V2_start"] == pytest.approx(V, rel=1e-9)
    bound = np.sqrt(-np.expm1(-certificate.traces.envelope[0] / np.asarray(weight)))
    np.testing.assert_allclose(certificate.traces.xi_bound[0], bound, rtol=1e-9)


@pytest.mark.slow
def test_jumps_restart_the_envelope_and_saturated_samples_are_left_out(corrected_run):
    jump = ij.disturbances.Step(size=[3.0, -2.0], time=10.0)
    scenario = dataclasses.replace(corrected_run.scenario, disturbance=jump)
    run = ij.simulate(scenario, **PAPER)
    certificate = certify(scenario, run)
    assert certificate.holds, certificate
    assert certificate.numbers["case"] == 1 and "t = 10 s" in certificate["f' bounded"].note
    at = int(np.searchsorted(np.asarray(run.t), 10.0))
    assert certificate.traces.envelope[at] == pytest.approx(certificate.traces.V[at])
    assert certificate.traces.V[at] > 1e6 * certificate.traces.envelope[at - 1]
    limited = ij.controllers.Saturated(corrected_run.scenario.controller, limit=[8.0, 3.0])
    scenario = dataclasses.replace(corrected_run.scenario, controller=limited)
    certificate = certify(scenario, duration=2.0, method="euler")
    left_out = certificate.numbers["samples_left_out"]
    assert 0 < left_out < 1000
    assert certificate["inequality, case 2"].verdict == "holds"
    assert f"{left_out} of 2001 samples are excluded" in certificate["inequality, case 2"].note
    assert np.all(np.isnan(certificate.traces.envelope[certificate.traces.excluded]))


UNRECORDED = ("scenario", "metrics", "status", "fastest_mode", "dt", "method", "steps")
"""Fields of a rollout that are not recorded step by step."""


def decimated(run, every: int, **changes):
    """What record_every=`every` leaves of a run that recorded every step."""
    recorded = {field.name for field in dataclasses.fields(run)} - {*UNRECORDED}
    kept = {name: jax.tree.map(lambda x: x[::every], getattr(run, name)) for name in recorded}
    return dataclasses.replace(run, **kept, **changes)


def pushed(scenario, amplitude: float, period: float):
    values = {"amplitude": amplitude, "frequency": 2 * np.pi / period}
    changes = {f"disturbance.acceleration_{name}": value for name, value in values.items()}
    return ij.simulate(ij.with_parameters(scenario, changes), **SHORT)


def assert_alike(one: Certificate, other: Certificate):
    assert [line.verdict for line in one.lines] == [line.verdict for line in other.lines]
    for a, b in zip(one.lines, other.lines, strict=True):
        assert (a.margin is None) == (b.margin is None), a.name
        assert a.margin is None or a.margin == pytest.approx(b.margin, rel=1e-6, abs=1e-9), a.name


@pytest.mark.slow
def test_decimated_run_is_judged_at_every_step_and_must_be_reproduced(corrected_run, monkeypatch):
    shaken = pushed(corrected_run.scenario, 20.0, 0.1)
    complete = certify(shaken.scenario, shaken)
    assert complete.numbers["F_d"] > 100
    run = decimated(shaken, 100)
    assert np.ptp(run.disturbance, axis=0).max() < 0.1 * np.ptp(shaken.disturbance, axis=0).max()
    sparse = certify(run.scenario, run)
    assert sparse.numbers["samples"] == 501 and sparse.traces.t.shape == run.t.shape
    assert sparse.numbers["F_d"] == pytest.approx(complete.numbers["F_d"], rel=1e-9)
    assert_alike(sparse, complete)
    # The steps after the last sample count; a long run, not kept in memory, gives the same.
    with monkeypatch.context() as patch:
        patch.setattr(summary, "KEPT_STEPS", 0)
        for every in (300, 501):
            assert_alike(certify(run.scenario, decimated(shaken, every)), complete)
    near = {"observer_state": jax.tree.map(lambda x: x * (1 + 1e-13), run.observer_state)}
    assert certify(run.scenario, dataclasses.replace(run, x=run.x * (1 + 1e-14), **near)).holds
    others = {"controller.K2": 20.01, "initial.q[0]": 0.8001, "plant.mass[1]": 0.8501}
    for changes in (
        *({"scenario": ij.with_parameters(run.scenario, {path: x})} for path, x in others.items()),
        {"x": run.x.at[3, 1, 0].add(1e-3)},
        {"dt": 2 * run.dt},
        {"t": run.t.at[2].add(0.01)},
    ):
        other = dataclasses.replace(run, **changes)
        assert_refused(r"^run.*Simulate it again", certify, other.scenario, other)


def joined(*runs):
    return jax.tree.map(lambda *x: jnp.stack(x), *runs)


@pytest.mark.slow
def test_certificate_never_contradicts_the_status(corrected_run):
    run = pushed(corrected_run.scenario, 3000.0, 0.5)
    assert int(run.status) & int(ij.Status.BOUND_VIOLATED)
    ends = decimated(run, 500)
    assert np.all((ends.q > ends.lower) & (ends.q < ends.upper))
    line = certify(run.scenario, ends)["joints inside"]
    assert line.verdict == "fails"
    assert line.margin == pytest.approx(1 - float(jnp.abs(run.xi).max()), abs=1e-9)
    with pytest.raises(ValueError, match="samples that cover the run"):
        certify(run.scenario, decimated(run, 501, steps=None))
    with pytest.raises(ValueError, match=r"run\.status"):
        certify(run.scenario, dataclasses.replace(ends, status=jnp.int32(0)))
    not_finite = int(ij.Status.NOT_FINITE)
    lost = dataclasses.replace(run, status=run.status | not_finite)
    assert certify(run.scenario, joined(run, lost)).verdict == "fails"
    lost = dataclasses.replace(corrected_run, status=jnp.int32(not_finite))
    certificate = certify(corrected_run.scenario, joined(corrected_run, lost))
    assert certificate.verdict == "not applicable"
    assert "not applicable in 1 of 2 runs" in certificate["inequality, case 2"].note


@ij.component
@ij.robots.from_energy
class Growing:
    """A pendulum with friction, whose mass grows from a time on."""

    mass: jax.Array = ij.leaf("kg")
    damping: jax.Array = ij.leaf("N m s/rad", shape="scalar", default=0.0)
    growth: jax.Array = ij.leaf("kg/s", shape="scalar", default=0.0)
    n = 1

    def at(self, t):
        return dataclasses.replace(self, mass=self.mass + self.growth * t)

    def friction_torque(self, dq):
        return -self.damping * dq

    def mass_matrix(self, q):
        return (0.02 + 0.04 * self.mass)[:, None]

    def potential(self, q):
        return 9.81 * 0.2 * jnp.sum(self.mass * jnp.sin(q))

    def tip(self, q):
        return 0.4 * jnp.concatenate([jnp.cos(q), jnp.sin(q)])


def one_joint(plant):
    return ij.Scenario(
        plant=plant,
        reference=ij.references.Sinusoid(offset=0.5, amplitude=0.1),
        bounds=ij.bounds.Bounds(lower=ij.bounds.Constant(0.1), upper=ij.bounds.Constant(0.9)),
        controller=ij.controllers.Backstepping(k1=2.0, K2=20.0, variant="corrected"),
        observer=ij.observers.Momentum(kf=20.0),
        initial=ij.Initial(q=0.7),
    )


terms_there = jax.jit(terms_at)


@pytest.mark.parametrize("changes", [{}, {"damping": 0.5}, {"growth": 0.5}], ids=str)
def test_f_is_constant_only_where_nothing_that_changes_is_left_in_it(changes):
    scenario = canonical(one_joint(Growing(mass=[1.3], **changes)))
    apart = dataclasses.replace(scenario, model=jax.tree.map(jnp.copy, scenario.model))
    for one in (scenario, apart):
        start = initial_state(one)
        seen = terms_there(one, jnp.asarray(0.15), start._replace(x=start.x.at[1].set(0.3)))
        assert bool(seen.claims["torque"].steady) == (not changes)
        assert (float(jnp.abs(seen.dd[0])) < 1e-9) == (not changes)
    other = ij.with_parameters(scenario, {"model.mass": 1.2})
    assert not terms_there(other, jnp.asarray(0.15), initial_state(other)).claims["torque"].steady


@ij.component
class Passive:
    """V = r^T M0 r / 2 + e^T slope K e, of which the law proves V' = -W + r . f_tilde exactly."""

    slope: ij.Leaf = ij.leaf("1/s", sign="positive")
    K: ij.Leaf = ij.leaf("N m s/rad", sign="positive")
    share: ij.Leaf = ij.leaf("1", shape="scalar", default=1.0)
    """Of the true decay, what it states."""
    late: ij.Leaf = ij.leaf("1/s", shape="scalar", default=0.0)
    """What it states too much, from t = 0.05 s on."""

    def errors(self, t, q, dq, context):
        tube = context.tube(t)
        e, de = q - tube.q_d, dq - tube.dq_d
        return e, de, de + self.slope * e, tube.ddq_d - self.slope * de

    def command(self, t, q, dq, f_hat, context, state):
        _, _, r, dv = self.errors(t, q, dq, context)
        model, no = context.model, jnp.zeros(q.shape, bool)
        rigid = model.mass_matrix(q) @ dv + model.coriolis(q, dq, dq - r) + model.gravity(q)
        return ij.controllers.Command(rigid - f_hat - self.K * r, dq - r, 0.0 * q, no, no), ()

    def lyapunov(self, t, q, dq, f_tilde, context, state):
        e, _, r, _ = self.errors(t, q, dq, context)
        return 0.5 * r @ (context.model.mass_matrix(q) @ r) + jnp.sum(self.slope * self.K * e**2)

    def decay(self, t, q, dq, f_tilde, context, state):
        e, de, _, _ = self.errors(t, q, dq, context)
        true = jnp.sum(self.K * (de**2 + (self.slope * e) ** 2))
        return self.share * true + jnp.where(t > 0.05, self.late, 0.0)


@pytest.fixture(scope="module")
def own(paper):
    """The paper's arm with more load than its model, under a law that states its own claim."""
    law, observer = Passive(slope=[3.0, 4.0], K=[8.0, 2.0]), ij.observers.NoObserver()
    scenario = dataclasses.replace(paper, controller=law, observer=observer)
    return ij.with_parameters(scenario, {"plant.payload": 0.4})


def own_line(scenario):
    return certify(scenario, **OWN)["inequality, own V"]


def assert_equality(line):
    """The proof leaves nothing: the inequality is an equality, to rounding."""
    assert line.verdict == "holds" and abs(line.margin) <= line.tolerance < 1e-10


@pytest.mark.slow
def test_a_law_is_held_against_its_own_claim_and_one_that_is_too_strong_fails(own):
    """The claim is an equality although f_tilde is large."""
    certificate = certify(own, **OWN)
    assert certificate.holds
    line = certificate["inequality, own V"]
    assert_equality(line)
    assert certificate.numbers["F_m"] > 0.9
    assert [line.name for line in certificate.applicable] == [
        *("f bounded", "f' bounded", "reference inside", "start inside"),
        *("own V", "own decay", "inequality, own V"),
    ]
    text, reason = repr(certificate), certificate["inequality, case 2"].note
    assert "inequality, own V" in text and "not applicable" not in text
    assert "apply" not in text and "apply" not in certificate.table_html()
    words = f"18 lines of the paper's theorem do not apply, because {reason}."
    assert certificate.omitted == words
    assert len(certificate.lines) == len(certificate.applicable) + 18
    assert certificate.is_of_own_claim
    assert np.all(np.abs(certificate.traces.left) <= line.tolerance)
    json.dumps(certificate.to_dict(), allow_nan=False)
    figure = certificate.plot()
    texts = [*figure.texts, *(text for axes in figure.axes for text in axes.texts)]
    words = " ".join(text.get_text() for text in texts)
    assert "The law's own claim along the run: holds" in words and "own decay" in words
    certificate = certify(ij.with_parameters(own, {"controller.share": 1.02}), **OWN)
    strong = certificate["inequality, own V"]
    assert certificate.verdict == strong.verdict == "fails" and strong.first_broken == 0.0
    late = own_line(ij.with_parameters(own, {"controller.share": 0.98, "controller.late": 9.0}))
    assert late.verdict == "fails" and late.first_broken == pytest.approx(0.051)
    assert "first broken at t = 0.051 s" in late.where()
    weak = own_line(ij.with_parameters(own, {"controller.share": 0.9}))
    assert weak.verdict == "holds" and weak.margin > 0


@ij.component
class WithEstimate(Passive):
    """V + f_tilde . f_tilde / 2: with the momentum observer V' = -W - kf |f_tilde|^2 + r .
    f_tilde + f_tilde . f' exactly."""

    kf: ij.Leaf = ij.leaf("1/s", default=20.0)

    def lyapunov(self, t, q, dq, f_tilde, context, state):
        return super().lyapunov(t, q, dq, f_tilde, context, state) + 0.5 * f_tilde @ f_tilde

    def decay(self, t, q, dq, f_tilde, context, state):
        return super().decay(t, q, dq, f_tilde, context, state) + jnp.sum(self.kf * f_tilde**2)


@pytest.mark.slow
def test_own_claims_with_the_error_of_the_estimate_terms_of_their_own_and_a_memory(paper):
    law = WithEstimate(slope=2.0, K=5.0, kf=12.0)
    scenario = dataclasses.replace(paper, controller=law, observer=ij.observers.Momentum(kf=12.0))
    assert_equality(own_line(scenario))
    assert own_line(ij.with_parameters(scenario, {"controller.kf": 13.0})).verdict == "fails"
    law = Adaptive(slope=2.0, K=6.0, gamma=[2.0, 3.0])
    line = own_line(dataclasses.replace(paper, controller=law))
    assert_equality(line)
    assert "what the law states" in line.statement


@ij.component
class Adaptive(Passive):
    """V = r . M0 r / 2 + d . d / (2 gamma), joint by joint, with T = r f; it is given f itself, as
    it uses no estimate."""

    gamma: ij.Leaf = ij.leaf("1/s", sign="positive", default=1.0)
    uses_observer: ClassVar[bool] = False

    def init(self, q, dq, context):
        return {"d": 0.3 + 0.0 * q}

    def command(self, t, q, dq, f_hat, context, state):
        command, _ = super().command(t, q, dq, state["d"], context, ())
        return command, {"d": self.gamma * self.errors(t, q, dq, context)[2]}

    def lyapunov(self, t, q, dq, f_tilde, context, state):
        r = self.errors(t, q, dq, context)[2]
        return 0.5 * r * (context.model.mass_matrix(q) @ r) + 0.5 * state["d"] ** 2 / self.gamma

    def decay(self, t, q, dq, f_tilde, context, state):
        return self.K * self.errors(t, q, dq, context)[2] ** 2

    def disturbance_terms(self, t, q, dq, f_tilde, df, context, state):
        return self.errors(t, q, dq, context)[2] * f_tilde


@ij.component
class PassiveOfLevels(ij.controllers.Law):
    """`Passive` as a law of x, with d_tilde in x' in the place of f_tilde."""

    law: Passive

    def command(self, t, x, d_hat, context, state):
        return self.law.command(t, x[0], x[1], d_hat, context, state)

    def lyapunov(self, t, x, d_tilde, context, state):
        return self.law.lyapunov(t, x[0], x[1], d_tilde, context, state)

    def decay(self, t, x, d_tilde, context, state):
        return self.law.decay(t, x[0], x[1], d_tilde, context, state)


@ij.component
class PassiveWithTerms(PassiveOfLevels):
    """With T of its own: r . M0 d_tilde_2."""

    def disturbance_terms(self, t, x, d_tilde, dd, context, state):
        assert d_tilde.shape == dd.shape == x.shape
        _, _, r, _ = self.law.errors(t, x[0], x[1], context)
        return r @ (context.model.mass_matrix(x[0]) @ d_tilde[1])


@pytest.mark.slow
@pytest.mark.parametrize("kind", [PassiveOfLevels, PassiveWithTerms])
def test_a_law_of_x_on_a_robot_has_its_uncertain_term_in_the_rates(own, kind):
    law = kind(own.controller)
    if kind is PassiveOfLevels:
        law = ij.controllers.Saturated(law=law, limit=[500.0, 500.0])
    line = own_line(dataclasses.replace(own, controller=law))
    assert_equality(line)
    assert ("what the law states" in line.statement) == (kind is PassiveWithTerms)


@pytest.mark.release
def test_where_an_own_claim_is_not_made(own):
    def certified(**parts):
        return certify(ij.with_parts(own, **parts), **OWN)

    law, saturated = own.controller, ij.controllers.Saturated
    smooth = certified(controller=saturated(law=law, limit=[20.0, 9.0], edge="smooth"))
    assert "all the time" in smooth["inequality, own V"].note
    cut = certified(controller=saturated(law=law, limit=[8.0, 1.4]))
    assert 0 < cut.numbers["samples_left_out"] < 81 and cut["inequality, own V"].verdict == "holds"
    lagging = certified(actuator=ij.actuators.Motor(bandwidth=200.0))
    assert lagging.verdict == "not applicable" and "Motor" in lagging["inequality, own V"].note
    filtered = certified(controller=ij.controllers.SafetyFilter(law=law))
    assert "does not cover the SafetyFilter" in filtered.omitted
    sampled = certified(sampling=ij.Sampling(period=1e-3))
    assert sampled["inequality, own V"].verdict == "not applicable"


def test_wrong_arguments_are_named(paper, short_run, own):
    other = ij.with_parameters(paper, {"controller.K2": 21.0})
    log = ij.presets.zhang_yan_2024(law="log")
    without = dataclasses.replace(paper, observer=ij.observers.NoObserver())
    no_decay = {"__annotations__": {}, "decay": ij.controllers.RobotLaw.decay}
    half = ij.component(type("Half", (Passive,), no_decay))(slope=3.0, K=2.0)
    incomplete = dataclasses.replace(own, controller=half)
    for call, words in (
        (lambda: certify(log, short_run), r"run: got .* expected a run of `scenario`"),
        (lambda: certify(other, short_run), "other numbers"),
        (lambda: certify(paper, 3), "a Rollout, a study or None"),
        (lambda: counterexample(without, {"initial.q": between(0.4, 0.7)}), "claim"),
        (lambda: certify(incomplete, **OWN), "with lyapunov and without decay"),
    ):
        assert_refused(words, call)


BRIEF = {"duration": 0.01, "dt": 1e-3}


@pytest.mark.parametrize(
    ("search", "timing", "path", "perturbation", "words"),
    [
        (counterexample, {}, "initial.q", ij.offset(ij.normal(0.0, 0.1)), "bounded"),
        (counterexample, {}, "initial.q", between(1.1, 1.2), "initial.q.*start inside.*Narrow"),
        (ij.falsify, BRIEF, "robot.mass", between(-2.0, -1.0), r"robot\.mass.*(positive|> 0)"),
        (ij.falsify, BRIEF, "initial.q", (0.4, [0.7, 0.8]), r"ij\.value\(ij\.uniform\(0\.4, \["),
    ],
)
def test_searches_refuse_perturbations(paper, search, timing, path, perturbation, words):
    with pytest.raises(ValueError, match=f"perturbations.*{words}"):
        search(paper, {path: perturbation}, starts=2, **timing)


@pytest.mark.slow
def test_many_runs_and_studies_are_judged_at_their_worst_runs(corrected_run):
    scenario = corrected_run.scenario
    others = [ij.with_parameters(scenario, {"observer.kf": kf}) for kf in (0.9, 5.0)]
    # The second run has kf below (3.25).
    batch = joined(corrected_run, *(ij.simulate(other, **PAPER) for other in others))
    certificate = certify(scenario, batch)
    assert certificate.runs == (0, 1, 2)
    line = certificate["kf, case 2"]
    assert (line.run, line.verdict, line.joint, line.equation) == (1, "fails", 0, "(3.25)")
    assert line.margin == pytest.approx(-0.1) and "1 of 3" in line.note
    assert "not applicable in 1 of 3" in certificate["inequality, case 2"].note
    assert certificate.worst_run == 1
    sound = certify(scenario, batch[np.array([0, 2])])
    single = [certify(batch[i].scenario, batch[i]) for i in (0, 2)]
    margins = [one["inequality, case 2"].margin for one in single]
    assert sound["inequality, case 2"].margin == pytest.approx(min(margins))
    assert sound.worst_run == int(np.argmin(margins)) and sound.holds
    assert f"worst {sound.worst_run}" in repr(sound)
    perturbed = {"plant.mass": ij.factor(ij.uniform(0.9, 1.1))}
    study = ij.monte_carlo(scenario, perturbed, runs=3, duration=0.08)
    nearest = int(np.argmin(np.min(np.asarray(study.metrics.xi_margin), axis=1)))
    assert certify(scenario, study, worst=1).runs == (nearest,)
    assert certify(scenario, study, worst=None).runs == (0, 1, 2)
    stiffer = ij.with_parameters(scenario, {"controller.K2": 2 * scenario.controller.K2})
    for arguments, words in (
        ((study,), r"got 'Study'.*certify\(scenario, study\)"),
        ((stiffer, study), "a run of a scenario with other numbers"),
        ((ij.presets.zhang_yan_2024(law="log"), study), "a run of another kind of scenario"),
    ):
        assert_refused(words, certify, *arguments)


@pytest.mark.release
def test_search_finds_the_gap_of_the_printed_law_only():
    perturbations = {"initial.q": between(0.4, 0.75), "initial.dq": between(-4.0, 4.0)}
    perturbations |= {"controller.K2": between(0.6, 20.0), "observer.kf": between(1.1, 40.0)}
    perturbations |= {"observer.eta0": between(-80.0, 80.0)}
    # Of four starts the best is one or another with the last digit.
    found = counterexample(ij.presets.printed_gap(), perturbations, starts=8)
    assert found.growth > 0.3
    for path, perturbation in perturbations.items():
        low, high = perturbation.distribution.support()
        assert np.all((found.parameters[path] >= low) & (found.parameters[path] <= high))
    none = counterexample(ij.presets.printed_gap(variant="corrected"), perturbations, starts=4)
    assert none.growth < -1.0 + 1e-9


def test_search_takes_the_perturbations_of_a_study(paper):
    """Around the nominal value, one draw where it is shared, plant and model alike as `robot`."""
    K2 = ij.factor(ij.uniform(0.9, 1.1), shared=True)
    ways = {"controller.K2": K2, "robot.mass": ij.factor(ij.log_uniform(0.8, 1.25))}
    cube = unit_cube(canonical(paper), ways)
    values = cube.values(jnp.array([0.25, 0.5, 1.0]))
    np.testing.assert_allclose(values["controller.K2"], 0.95 * paper.controller.K2)
    np.testing.assert_allclose(values["robot.mass"], np.array([1.0, 1.25]) * paper.plant.mass)
    assert cube.size == 3 and not cube.why_inadmissible(np.ones(3))
