"""The safety filter: its torque beside a general solver's, what it keeps, and what it says where it
cannot."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax import bounds, controllers
from iblf_jax.simulation.closed_loop import initial_state

RUN = {"duration": 1.5, "dt": 1e-3}
LIMITED = {"limit": [60.0, 40.0]}


def falling(speeds=None, **changes):
    """PD that overshoots: soft, from a fast start, towards a reference next to the bound."""
    law = controllers.PDGravity(Kp=30.0, Kd=0.4)
    scenario = ij.presets.zhang_yan_2024(law="pd", variant="corrected")
    rest = ij.references.Sinusoid(offset=[0.4, 0.5], amplitude=0.0)
    walls = bounds.Bounds(
        lower=bounds.Sinusoid(0.2, [0.02, 0.0], 2.0), upper=bounds.Sinusoid(0.9, [0.0, 0.05], 3.0)
    )
    parts = {
        "controller": law,
        "reference": rest,
        "bounds": (walls, speeds),
        "initial": ij.Initial([0.75, 0.3], [0.4, -0.1]),
    }
    return ij.with_parts(scenario, **(parts | {"disturbance": ij.disturbances.Nothing()} | changes))


def filtered(scenario, **options):
    return ij.with_parts(
        scenario, controller=controllers.SafetyFilter(law=scenario.controller, **options)
    )


def walls_at(t):
    """Bounds of `falling` with two rates, by hand: (3, 2) each."""
    s, c = np.sin([2 * t, 3 * t]), np.cos([2 * t, 3 * t])
    lower = [[0.2 + 0.02 * s[0], 0.2], [0.04 * c[0], 0.0], [-0.08 * s[0], 0.0]]
    upper = [[0.9, 0.9 + 0.05 * s[1]], [0.0, 0.15 * c[1]], [0.0, -0.45 * s[1]]]
    return np.array(lower), np.array(upper)


def box_at(t, q, dq, a1=10.0, a2=10.0):
    return [x[2] + (a1 + a2) * (x[1] - dq) + a1 * a2 * (x[0] - q) for x in walls_at(t)]


@pytest.mark.slow
def test_it_keeps_what_the_law_breaks():
    with pytest.warns(ij.SimulationWarning, match="bound was violated"):
        alone = ij.simulate(falling(), **RUN)
    assert float(jnp.min(alone.metrics.margin)) < -0.01
    scenario = filtered(falling(), nearest="acceleration")
    run = ij.simulate(scenario, **RUN, backend="vmap")
    assert not int(run.status) & ~int(ij.Status.INACCURATE)
    assert float(jnp.min(run.metrics.margin)) > 0
    assert float(jnp.max(run.slack)) == 0
    for k in range(0, len(run.t), 50):
        low, high = box_at(float(run.t[k]), np.asarray(run.q[k]), np.asarray(run.dq[k]))
        model = run.scenario.model
        rest = run.tau[k] - model.coriolis(run.q[k], run.dq[k], run.dq[k]) - model.gravity(run.q[k])
        ddq = np.linalg.solve(model.mass_matrix(run.q[k]), rest)
        assert np.all(ddq <= high + 1e-6 * (1 + np.abs(high)))
        assert np.all(ddq >= low - 1e-6 * (1 + np.abs(low)))


def commands(scenario, t, q, dq):
    """Torque of the filter and of the law in it, and the slack."""
    law, x, zero = scenario.controller, jnp.stack([q, dq]), jnp.zeros(2)
    found, bare = (y.command(t, x, zero, scenario.context, ())[0] for y in (law, law.inner))
    return found.tau, bare.tau, found.slack


def random_places(rng, count):
    return (
        rng.uniform(0, 3, count),
        rng.uniform([0.23, 0.21], [0.88, 0.84], (count, 2)),
        rng.uniform(-2, 2, (count, 2)),
    )


def _elsewhere(qpsolvers, *args):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return qpsolvers.solve_qp(
            *args, solver="clarabel", tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{"nearest": "acceleration"}, {}, LIMITED | {"nearest": "acceleration"}]
)
def test_the_torque_is_the_nearest_by_a_general_solver(options, rng):
    qpsolvers = pytest.importorskip("qpsolvers")
    import scipy.sparse as sp

    scenario, (t, q, dq) = filtered(falling(), **options), random_places(rng, 100)
    tau, bare, slack = jax.jit(jax.vmap(lambda *x: commands(scenario, *x)))(t, q, dq)
    changed, lost, passed = 0, 0, 0
    for k in range(len(t)):
        M = np.asarray(scenario.model.mass_matrix(q[k]))
        inverse = np.linalg.inv(M)
        rest = np.asarray(
            scenario.model.coriolis(q[k], dq[k], dq[k]) + scenario.model.gravity(q[k])
        )
        low, high = box_at(t[k], q[k], dq[k])
        H = np.eye(2) if options.get("nearest") != "acceleration" else inverse.T @ inverse
        H = H / np.max(H)
        G, h = [inverse, -inverse], [high + inverse @ rest, -low - inverse @ rest]
        if "limit" in options:
            limit = np.array(options["limit"])
            G, h = [*G, np.eye(2), -np.eye(2)], [*h, limit, limit]
        G, h = np.concatenate(G), np.concatenate(h)
        if np.all(G @ np.asarray(bare[k]) < h - 1e-6 * (1 + np.abs(h))):
            np.testing.assert_array_equal(tau[k], bare[k], "a safe torque is passed on")
            passed += 1
        args = (sp.csc_matrix(H), -H @ np.asarray(bare[k]), sp.csc_matrix(G), h)
        other = _elsewhere(qpsolvers, *args)
        if other is None:  # it has given up, or there is none
            lost += 1
            continue
        if np.any(np.asarray(slack[k]) > 0):
            assert np.max(G @ other - h) > 1e-9
            continue
        np.testing.assert_allclose(tau[k], other, rtol=0, atol=1e-7 * (1 + np.max(np.abs(other))))
        changed += np.max(np.abs(tau[k] - bare[k])) > 1e-3
    assert changed > 20
    assert passed > 5
    assert lost < 5 + np.sum(np.max(slack, axis=1) > 0)


@pytest.mark.slow
def test_velocity_bounds_are_kept_too():
    speeds = bounds.Bounds(lower=bounds.Constant(-0.8), upper=bounds.Sinusoid(0.6, 0.05, 2.0))
    scenario = falling(speeds)
    with pytest.warns(ij.SimulationWarning, match="velocity bound was violated"):
        bare = ij.simulate(scenario, **RUN)
    assert float(jnp.min(bare.metrics.velocity_margin)) < -0.1
    run = ij.simulate(filtered(scenario, nearest="acceleration"), **RUN)
    assert not int(run.status) & int(
        ij.Status.VELOCITY_VIOLATED | ij.Status.BOUND_VIOLATED | ij.Status.FILTER_INFEASIBLE
    )
    assert float(jnp.min(run.metrics.velocity_margin)) > 0


@pytest.mark.slow
def test_an_empty_box_is_flagged_with_its_slack():
    narrow = bounds.Bounds(lower=bounds.Constant(-0.5), upper=bounds.Constant(0.5))
    scenario = filtered(falling(narrow), nearest="acceleration", a1=40.0, a2=40.0, a3=1.0)
    with pytest.warns(
        ij.SimulationWarning, match=r"safety filter's conditions could not all be met.*rad/s\^2"
    ):
        run = ij.simulate(
            ij.with_parts(scenario, initial=ij.Initial([0.75, 0.84], [0.45, 0.45])), **RUN
        )
    assert int(run.status) & int(ij.Status.FILTER_INFEASIBLE)
    worst = np.unravel_index(np.argmax(run.slack), run.slack.shape)
    low, high = scenario.controller.box(
        run.t[worst[0]], run.q[worst[0]], run.dq[worst[0]], scenario.context
    )
    assert float(run.slack[worst]) == pytest.approx(0.5 * float(low[worst[1]] - high[worst[1]]))


@pytest.mark.slow
def test_too_little_torque_is_flagged_and_never_exceeded():
    with pytest.warns(ij.SimulationWarning, match="safety filter"):
        run = ij.simulate(
            filtered(falling(), limit=[7.0, 2.0]), **RUN, method="euler", backend="vmap"
        )
    assert int(run.status) & int(ij.Status.FILTER_INFEASIBLE)
    assert np.all(np.max(np.abs(run.tau), axis=0) <= np.array([7.0, 2.0]) * (1 + 1e-9))
    assert float(jnp.max(run.slack)) > 0.1


@pytest.mark.slow
def test_backends_agree_and_a_run_alone_is_that_of_a_batch():
    scenario = filtered(falling(), **LIMITED)
    options = {"runs": 4, "duration": 0.05, "dt": 1e-3, "method": "euler", "progress": False}
    perturbations = {"initial.q": ij.offset(ij.uniform(-0.05, 0.05))}
    native, vmap = (
        ij.monte_carlo(scenario, perturbations, backend=b, **options) for b in ("native", "vmap")
    )
    for name in ("margin", "peak_torque", "ise"):
        np.testing.assert_allclose(native.metrics[name], vmap.metrics[name], rtol=1e-7, atol=1e-10)
    again_at = 3
    again = native.replay(again_at)
    np.testing.assert_array_equal(again.metrics.ise, native.metrics["ise"][again_at])


@pytest.mark.slow
def test_it_is_sampled():
    sampling = ij.Sampling(period=2e-3, delay=1e-3)
    scenario = ij.with_parts(filtered(falling(), nearest="acceleration"), sampling=sampling)
    run = ij.simulate(scenario, duration=0.08, dt=1e-3)
    assert float(jnp.min(run.metrics.margin)) > 0
    assert run.slack.shape == run.q.shape


@pytest.mark.slow
def test_theorem_2_claims_nothing_while_it_works():
    """The certificate of a barrier law within a filter leaves out the samples at which the torque
    was changed."""
    base = dataclasses.replace(
        ij.presets.zhang_yan_2024(variant="corrected"), initial=ij.Initial([0.95, 0.6], [0.5, 0.0])
    )
    scenario = filtered(base, nearest="acceleration", a1=20.0, a2=20.0)
    certificate = ij.certify(scenario, duration=0.3, dt=1e-3)
    assert 0 < certificate.numbers["samples_left_out"] < certificate.numbers["samples"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"nearest": "jerk"}, "acceleration"),
        ({"a1": -1.0}, "> 0"),
        ({"law": 3}, "SafetyFilter.law"),
    ],
)
def test_bad_ones_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        controllers.SafetyFilter(**{"law": controllers.PDGravity(Kp=1.0, Kd=1.0)} | options)


def test_the_metric_of_slacks_needs_a_filter():
    with pytest.raises(ValueError, match="a law with a filter"):
        ij.simulate(falling(), **RUN, metrics=(ij.metrics.Slack(),))


@pytest.mark.parametrize(("shape1", "shape2"), [("linear", "cubic"), ("atan", "linear")])
def test_the_box_of_shaped_conditions(shape1, shape2, rng):
    scenario, eta = falling(), np.array([0.3, 0.7])
    law = controllers.SafetyFilter(
        law=scenario.controller, a1=2.0, a2=3.0, shape1=shape1, shape2=shape2, margin=eta
    )
    A = {"linear": lambda h: h, "atan": np.arctan}[shape1]
    B = {"linear": lambda z: z, "cubic": lambda z: z**3}[shape2]
    for t, q, dq in zip(*random_places(rng, 5), strict=True):
        low, high = law.box(jnp.asarray(t), jnp.asarray(q), jnp.asarray(dq), scenario.context)
        for ddq, sign, side in ((low, 1, 0), (high, -1, 1)):
            # h and z along a motion with this acceleration; z' by differences.
            def z_at(s, q=q, dq=dq, t=t, ddq=ddq, sign=sign, side=side):
                wall = walls_at(t + s)[side]
                h, dh = (
                    sign * (q + s * dq + s**2 / 2 * ddq - wall[0]),
                    sign * (dq + s * ddq - wall[1]),
                )
                return dh + 2.0 * A(h)

            rate = (z_at(1e-6) - z_at(-1e-6)) / 2e-6
            np.testing.assert_allclose(rate + 3.0 * B(z_at(0.0)), eta, rtol=1e-6, atol=1e-6)


def test_shapes_have_names():
    with pytest.raises(ValueError, match=r"SafetyFilter\.shape1: got 'cubic', expected"):
        controllers.SafetyFilter(law=controllers.PDGravity(Kp=1.0, Kd=1.0), shape1="cubic")
    with pytest.raises(ValueError, match=r"SafetyFilter\.margin.*-1"):
        controllers.SafetyFilter(law=controllers.PDGravity(Kp=1.0, Kd=1.0), margin=-1.0)


@pytest.mark.slow
def test_the_reference_of_a_filter_may_leave_the_bounds_and_that_of_no_other_law():
    parts = {"reference": ij.references.Quintic(start=[0.5, 0.5], end=[1.2, 0.5], duration=0.1)}
    run = ij.simulate(filtered(falling(**parts), nearest="acceleration"), duration=0.3, dt=1e-3)
    assert int(run.status) == 0 and float(jnp.max(run.q_d - run.upper)) > 0.2
    with pytest.raises(ValueError, match="Assumption 2"):
        ij.simulate(falling(**parts), duration=0.3, dt=1e-3)
    law = controllers.Backstepping(k1=2.0, K2=20.0, o=0.1)
    certificate = ij.certify(
        filtered(falling(controller=law, **parts), nearest="acceleration"), duration=0.3, dt=1e-3
    )
    assert certificate["reference inside"].verdict == certificate.verdict == "fails"


@pytest.mark.slow
@pytest.mark.parametrize("nearest", ["torque", "acceleration"])
def test_an_estimate_of_rates_acts_as_its_torque(nearest):
    """A `LevelObserver` passes rates d_hat to a law of x; M0 d_hat_2 is the same estimate as a
    torque."""
    full_state = ij.presets.zhang_yan_2024_full_state()
    observer = ij.observers.LevelObserver(gain=(0.0, 20.0), eta0=[[0.0, 0.0], [3.0, -2.0]])
    scenario = filtered(ij.with_parts(full_state, observer=observer), nearest=nearest)
    loop, start = scenario.loop, initial_state(scenario)
    t = jnp.zeros(())
    d_hat = loop.observer.estimate(t, start.x, loop.model, start.observer)
    f_hat = scenario.model.mass_matrix(start.q) @ d_hat[1]
    assert d_hat.shape == (2, 2)
    taus = []
    for estimate in (d_hat, f_hat):
        command, _ = loop.law.command(t, start.x, estimate, scenario.context, start.controller)
        taus.append(command.tau)
    np.testing.assert_allclose(taus[0], taus[1], rtol=1e-9)
    # The law's own torque is passed on where it meets the conditions.
    alone, _ = full_state.loop.law.command(t, start.x, d_hat, scenario.context, start.controller)
    np.testing.assert_allclose(taus[0], alone.tau, rtol=1e-9)


def test_a_model_that_is_no_robot_is_refused():
    """The filter turns accelerations into torques by a mass matrix, whatever law it wraps."""
    flexible = ij.presets.flexible_joint_two_link()
    law = controllers.Saturated(controllers.SafetyFilter(flexible.controller), limit=60.0)
    words = r"Scenario\.model: got 'FlexibleJoint', expected a robot .* of the law SafetyFilter"
    with pytest.raises(ValueError, match=words):
        ij.with_parts(flexible, controller=law)
