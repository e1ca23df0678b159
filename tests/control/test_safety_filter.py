"""The safety filter: what it keeps and says; its torque is compared in `test_regions.py`."""

import jax.numpy as jnp
import numpy as np
import pytest
from refused import assert_refused, refused

import iblf_jax as ij
from iblf_jax import bounds, controllers
from iblf_jax.simulation.closed_loop import initial_state

RUN = {"duration": 1.5, "dt": 1e-3}


def falling(speeds=None, **changes):
    """PD that overshoots: soft, from a fast start, towards a reference next to the bound."""
    law = controllers.PDGravity(Kp=30.0, Kd=0.4)
    scenario = ij.presets.zhang_yan_2024(law="pd", variant="corrected")
    lower, upper = bounds.Sinusoid(0.2, [0.02, 0.0], 2.0), bounds.Sinusoid(0.9, [0.0, 0.05], 3.0)
    parts = {
        "controller": law,
        "reference": ij.references.Sinusoid(offset=[0.4, 0.5], amplitude=0.0),
        "bounds": (bounds.Bounds(lower, upper), speeds),
        "initial": ij.Initial([0.75, 0.3], [0.4, -0.1]),
        "disturbance": ij.disturbances.Nothing(),
    }
    return ij.with_parts(scenario, **(parts | changes))


def filtered(scenario, **options):
    law = controllers.SafetyFilter(law=scenario.controller, **options)
    return ij.with_parts(scenario, controller=law)


def walls_at(t):
    """Bounds of `falling` with two rates, by hand: (3, 2) each."""
    s, c = np.sin([2 * t, 3 * t]), np.cos([2 * t, 3 * t])
    lower = [[0.2 + 0.02 * s[0], 0.2], [0.04 * c[0], 0.0], [-0.08 * s[0], 0.0]]
    upper = [[0.9, 0.9 + 0.05 * s[1]], [0.0, 0.15 * c[1]], [0.0, -0.45 * s[1]]]
    return np.array(lower), np.array(upper)


@pytest.mark.slow
def test_it_keeps_bounds_of_both_levels_that_the_law_breaks():
    speeds = bounds.Bounds(lower=bounds.Constant(-0.8), upper=bounds.Sinusoid(0.6, 0.05, 2.0))
    scenario = falling(speeds)
    with pytest.warns(ij.SimulationWarning, match="bound was violated"):
        alone = ij.simulate(scenario, **RUN)
    run = ij.simulate(filtered(scenario, nearest="acceleration"), **RUN)
    assert not int(run.status) & ~int(ij.Status.INACCURATE | ij.Status.ALPHA_INFEASIBLE)
    assert float(jnp.max(run.slack)) == 0
    for name in ("margin", "velocity_margin"):
        assert float(jnp.min(alone.metrics[name])) < -0.01
        assert float(jnp.min(run.metrics[name])) > 0


@pytest.mark.slow
def test_an_empty_box_is_flagged_with_its_slack():
    narrow = bounds.Bounds(lower=bounds.Constant(-0.5), upper=bounds.Constant(0.5))
    start = ij.Initial([0.75, 0.84], [0.45, 0.45])
    scenario = falling(narrow, initial=start)
    scenario = filtered(scenario, nearest="acceleration", a1=40.0, a2=40.0, a3=1.0)
    words = r"safety filter's conditions could not all be met.*rad/s\^2"
    with pytest.warns(ij.SimulationWarning, match=words):
        run = ij.simulate(scenario, **RUN)
    assert int(run.status) & int(ij.Status.FILTER_INFEASIBLE)
    worst = np.unravel_index(np.argmax(run.slack), run.slack.shape)
    at = (x[worst[0]] for x in (run.t, run.q, run.dq))
    low, high = scenario.controller.box(*at, scenario.context)
    assert float(run.slack[worst]) == pytest.approx(0.5 * float(low[worst[1]] - high[worst[1]]))


@pytest.mark.slow
def test_theorem_2_claims_nothing_while_it_works():
    """Its certificate leaves out the samples at which the torque was changed."""
    paper = ij.presets.zhang_yan_2024(variant="corrected")
    base = ij.with_parts(paper, initial=ij.Initial([0.95, 0.6], [0.5, 0.0]))
    scenario = filtered(base, nearest="acceleration", a1=20.0, a2=20.0)
    certificate = ij.certify(scenario, duration=0.3, dt=1e-3)
    assert 0 < certificate.numbers["samples_left_out"] < certificate.numbers["samples"]


def on_a_flexible_joint():
    """The filter turns accelerations into torques by a mass matrix, whatever law it wraps."""
    flexible = ij.presets.flexible_joint_two_link()
    law = controllers.Saturated(controllers.SafetyFilter(flexible.controller), limit=60.0)
    return ij.with_parts(flexible, controller=law)


def made(**options):
    return controllers.SafetyFilter(**{"law": controllers.PDGravity(Kp=1.0, Kd=1.0)} | options)


test_refusals_name_what_is_expected = refused(
    (lambda: made(nearest="jerk"), "acceleration"),
    (lambda: made(law=3), "SafetyFilter.law"),
    (lambda: made(shape1="cubic"), r"SafetyFilter\.shape1: got 'cubic', expected"),
    (
        lambda: ij.simulate(falling(), **RUN, metrics=(ij.metrics.Slack(),)),
        "a law with a filter",
    ),
    (on_a_flexible_joint, r"model: got 'FlexibleJoint', expected a robot .* law SafetyFilter"),
)


@pytest.mark.parametrize(("shape1", "shape2"), [("linear", "cubic"), ("atan", "linear")])
def test_the_box_of_shaped_conditions(shape1, shape2, rng):
    scenario, eta = falling(), np.array([0.3, 0.7])
    shapes = {"shape1": shape1, "shape2": shape2, "margin": eta}
    law = controllers.SafetyFilter(law=scenario.controller, a1=2.0, a2=3.0, **shapes)
    A = {"linear": lambda h: h, "atan": np.arctan}[shape1]
    B = {"linear": lambda z: z, "cubic": lambda z: z**3}[shape2]
    for t in rng.uniform(0, 3, 5):
        q, dq = rng.uniform([0.23, 0.21], [0.88, 0.84]), rng.uniform(-2, 2, 2)
        low, high = law.box(jnp.asarray(t), jnp.asarray(q), jnp.asarray(dq), scenario.context)
        for ddq, sign, side in ((low, 1, 0), (high, -1, 1)):
            # h and z along a motion with this acceleration; z' by differences.
            def z_at(s, q=q, dq=dq, t=t, ddq=ddq, sign=sign, side=side):
                wall = walls_at(t + s)[side]
                h = sign * (q + s * dq + s**2 / 2 * ddq - wall[0])
                return sign * (dq + s * ddq - wall[1]) + 2.0 * A(h)

            rate = (z_at(1e-6) - z_at(-1e-6)) / 2e-6
            np.testing.assert_allclose(rate + 3.0 * B(z_at(0.0)), eta, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_the_reference_of_a_filter_may_leave_the_bounds_and_that_of_no_other_law():
    leaving = ij.references.Quintic(start=[0.5, 0.5], end=[1.2, 0.5], duration=0.1)
    scenario, short = falling(reference=leaving), {"duration": 0.3, "dt": 1e-3}
    run = ij.simulate(filtered(scenario, nearest="acceleration"), **short)
    assert int(run.status) == 0 and float(jnp.max(run.q_d - run.upper)) > 0.2
    assert_refused("Assumption 2", ij.simulate, scenario, **short)
    law = controllers.Backstepping(k1=2.0, K2=20.0, o=0.1)
    scenario = filtered(ij.with_parts(scenario, controller=law), nearest="acceleration")
    certificate = ij.certify(scenario, **short)
    assert certificate["reference inside"].verdict == certificate.verdict == "fails"


@pytest.mark.slow
def test_an_estimate_of_rates_acts_as_its_torque():
    """A law of x receives rates d_hat; M0 d_hat_2 is the same estimate as a torque."""
    full_state = ij.presets.zhang_yan_2024_full_state()
    observer = ij.observers.LevelObserver(gain=(0.0, 20.0), eta0=[[0.0, 0.0], [3.0, -2.0]])
    scenario = filtered(ij.with_parts(full_state, observer=observer))
    loop, start = scenario.loop, initial_state(scenario)
    t = jnp.zeros(())
    d_hat = loop.observer.estimate(t, start.x, loop.model, start.observer)
    f_hat = scenario.model.mass_matrix(start.q) @ d_hat[1]
    assert d_hat.shape == (2, 2)
    # The law's own torque is passed on where it meets the conditions.
    given = ((loop.law, d_hat), (loop.law, f_hat), (full_state.loop.law, d_hat))
    taus = [x.command(t, start.x, d, scenario.context, start.controller)[0].tau for x, d in given]
    np.testing.assert_allclose(taus, np.broadcast_to(taus[0], (3, 2)), rtol=1e-9)
