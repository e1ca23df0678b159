"""The laws beside the paper's: what each does, what saturation leaves of the claims, and paths
through a wrapper."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax import controllers, observers
from iblf_jax.control.controllers.adaptive_rbf import sobol_centres
from iblf_jax.core.pytree import rewrapped, unwrapped
from iblf_jax.simulation.closed_loop import evaluate, initial_state, rate

PAPER = {"duration": 20.0, "dt": 1e-3, "record_every": 10}
Q, DQ = jnp.array([0.7, 0.6]), jnp.array([0.4, -0.3])


@pytest.mark.slow
@pytest.mark.parametrize("law", ["tan", "mapping", "adaptive_rbf", "computed_torque"])
def test_every_system_keeps_the_bounds_and_settles(law):
    run = ij.simulate(ij.presets.zhang_yan_2024(law=law), **PAPER)
    assert run.ok
    assert float(jnp.min(run.metrics.xi_margin)) > 0.38  # that of the start
    assert float(jnp.max(run.metrics.settling_time)) < 3.5
    assert float(jnp.max(jnp.abs(run.e1[1000:]))) < 3e-3


def test_unknown_law_names_the_known_ones():
    with pytest.raises(ValueError, match="mapping"):
        ij.presets.zhang_yan_2024(law="nonsense")


@pytest.mark.slow
def test_the_funnel_is_kept_by_its_own_law():
    run = ij.simulate(ij.presets.zhang_yan_2024_funnel(), duration=5.0, dt=5e-4, record_every=10)
    assert run.ok
    assert float(jnp.max(jnp.abs(run.e1[run.t >= 1.0]))) < 0.12
    # and it lies inside the paper's bounds
    paper = ij.presets.zhang_yan_2024()
    t = jnp.linspace(0.0, 20.0, 2001)
    tubes = [jax.vmap(x.context.tube)(t) for x in (run.scenario, paper)]
    assert bool(jnp.all(tubes[0].lower >= tubes[1].lower))
    assert bool(jnp.all(tubes[0].upper <= tubes[1].upper))


NO_DISTURBANCE = {"disturbance.acceleration_amplitude": 0.0, "disturbance.velocity_amplitude": 0.0}


@pytest.mark.slow
def test_computed_torque_gives_the_error_equation_that_it_promises():
    blind = NO_DISTURBANCE | {"observer.kf": 1e-12}
    preset = ij.presets.zhang_yan_2024(law="computed_torque")
    run = ij.simulate(ij.with_parameters(preset, blind), **PAPER)
    w, t = 5.0, run.t[:, None]  # Kp = 25, Kd = 10: double pole at -5
    e0, de0 = run.e1[0], run.dq[0] - run.dq_d[0]
    np.testing.assert_allclose(run.e1, (e0 + (de0 + w * e0) * t) * jnp.exp(-w * t), atol=1e-9)


@pytest.mark.slow
def test_pd_holds_a_reference_at_rest():
    walls = {f"bounds.{side}.amplitude": 0.0 for side in ("lower", "upper")}
    walls |= {"bounds.lower.offset": 0.1, "bounds.upper.offset": 1.0}
    rest = NO_DISTURBANCE | walls
    rest |= {"reference.offset": [0.5, 0.6], "reference.amplitude": 0.0}
    run = ij.simulate(ij.with_parameters(ij.presets.zhang_yan_2024(law="pd"), rest), **PAPER)
    assert float(jnp.max(jnp.abs(run.e1[-1]))) < 1e-8
    np.testing.assert_allclose(run.tau[-1], run.scenario.model.gravity(run.q[-1]), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["state", "mapping", "dynamic_surface"])
def test_a_start_at_the_wall_stays_finite_in_float32(law):
    scenario = ij.with_parameters(
        ij.presets.zhang_yan_2024(law=law), {"initial.q": [1.0399, 0.8999], "initial.dq": 1.0}
    )
    scenario = ij.astype(scenario, "float32")

    def speed(scenario):
        state = initial_state(scenario)
        return evaluate(scenario, jnp.zeros((), jnp.float32), state)

    (slope, sample), tangent = jax.jit(
        lambda s: jax.jvp(speed, (s,), (jax.tree.map(jnp.ones_like, s),))
    )(scenario)
    for part in jax.tree.leaves((slope, sample, tangent)):
        assert part.dtype in (jnp.float32, bool, jax.dtypes.float0)
        assert part.dtype == jax.dtypes.float0 or bool(jnp.all(jnp.isfinite(part)))
    assert bool(jnp.all(sample.tau < 0))


# ---------------------------------------------------------------------------------- adaptive RBF


def test_adaptive_law_uses_neither_model_nor_estimate():
    scenario = ij.presets.zhang_yan_2024(law="adaptive_rbf")
    law, t = scenario.controller, jnp.asarray(0.3)
    weights = jax.random.normal(jax.random.PRNGKey(0), (law.nodes, 2))
    heavy = ij.robots.TwoLink(mass=9.0, length=1.0, centre=0.5, inertia=1.0)
    one = law.command(t, Q, DQ, jnp.zeros(2), scenario.context, weights)
    other = law.command(t, Q, DQ, jnp.ones(2), scenario.context._replace(model=heavy), weights)
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_adaptation_descends_the_lyapunov_function():
    # d/dt of tr(W~^T W~) / (2 Gamma) cancels e2^T W~^T S up to the leak, for any W*
    scenario = ij.presets.zhang_yan_2024(law="adaptive_rbf")
    law, t = scenario.controller, jnp.asarray(0.3)
    weights, ideal = jax.random.normal(jax.random.PRNGKey(1), (2, law.nodes, 2))
    command, dweights = law.command(t, Q, DQ, jnp.zeros(2), scenario.context, weights)
    e2 = DQ - command.alpha
    S = -(dweights / law.Gamma + law.sigma * weights)[:, 0] / e2[0]
    learned = command.tau + law.K2 * e2 + law.barrier.slope(scenario.context.tube(t), Q)
    np.testing.assert_allclose(weights.T @ S, learned, atol=1e-9)
    error = weights - ideal
    stored = jnp.sum(error * dweights / law.Gamma)
    expected = -e2 @ (error.T @ S) - jnp.sum(law.sigma * weights * error)
    np.testing.assert_allclose(stored, expected, rtol=1e-9)


@pytest.mark.parametrize(("nodes", "dimensions"), [(1, 4), (7, 8), (64, 8), (64, 28)])
def test_centres_fill_the_box(nodes, dimensions):
    points = sobol_centres(nodes, dimensions)
    assert points.shape == (nodes, dimensions)
    assert np.all(np.abs(points) < 1)
    assert len(np.unique(points, axis=0)) == nodes
    if nodes == 64:
        np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=1e-12)


# ------------------------------------------------------------------------------------ saturation


@pytest.mark.slow
def test_under_the_preset_limit_bounds_tracking_and_estimate_still_hold():
    scenario = ij.presets.zhang_yan_2024_saturated()
    limit = scenario.controller.limit
    run = ij.simulate(scenario, **PAPER)
    free = ij.simulate(ij.with_parameters(scenario, {"controller.limit": 100.0}), **PAPER)
    assert bool(jnp.all(jnp.max(jnp.abs(free.tau), axis=0) > limit))
    assert run.status == ij.Status.TORQUE_SATURATED
    assert free.ok
    np.testing.assert_allclose(run.metrics.peak_torque, limit, rtol=1e-12)
    assert bool(jnp.all(run.metrics.saturated_share > 0))
    # Less than the start's: it came nearer.
    assert 0.35 < float(jnp.min(run.metrics.xi_margin)) < 0.38
    assert float(jnp.max(run.metrics.settling_time)) < 1.05
    np.testing.assert_allclose(run.e1[1000:], free.e1[1000:], atol=1e-6)
    # The observer is told the torque that was applied, so it does not take the cut for a
    # disturbance.
    error = [jnp.max(jnp.abs(x.disturbance - x.disturbance_estimate)) for x in (run, free)]
    np.testing.assert_allclose(error[0], error[1], rtol=0.1)


@pytest.mark.slow
def test_smooth_limit():
    dtype = jnp.float32
    scenario = ij.astype(ij.presets.zhang_yan_2024_saturated(edge="smooth"), dtype)
    law = scenario.controller
    tau = jnp.asarray([0.0, 1e-30, 0.5, 0.999, 1.0, 1.001, 2.0, 1e8, 1e30], dtype)

    def limited(x):
        fixed = _Fixed(tau=jnp.stack([x, -x]))
        wrapped = controllers.Saturated(law=fixed, limit=jnp.ones(2, dtype), edge="smooth")
        x, zero = jnp.stack([Q, DQ]).astype(dtype), jnp.zeros(2, dtype)
        return wrapped.command(zero[0], x, zero, scenario.context, ())[0].tau

    value, slope = jax.vmap(limited)(tau), jax.vmap(jax.jacfwd(limited))(tau)
    assert value.dtype == dtype
    np.testing.assert_allclose(value[:, 0], -value[:, 1])
    wide = np.asarray(tau, np.longdouble)
    exact, exact_slope = wide / (1 + wide**8) ** 0.125, (1 + wide**8) ** -1.125
    np.testing.assert_allclose(value[:, 0], exact.astype(float), rtol=1e-6)
    np.testing.assert_allclose(slope[:, 0], exact_slope.astype(float), rtol=1e-5, atol=1e-30)
    assert bool(jnp.all(jnp.isfinite(jax.vmap(jax.jacrev(limited))(tau))))
    assert bool(jnp.all(jnp.abs(value) <= 1.0))
    assert law.edge == "smooth"


@ij.component
class _Fixed:
    """A law that asks for a given torque."""

    tau: jax.Array = ij.leaf("N m", shape="any")

    def init(self, q, dq, context):
        return ()

    def command(self, t, q, dq, f_hat, context, state):
        never = jnp.zeros(q.shape, bool)
        return controllers.Command(self.tau, jnp.zeros_like(q), jnp.zeros_like(q), never, never), ()


# ---------------------------------------------------------------------------- paths and wrappers


def test_paths_reach_through_a_wrapper():
    scenario = ij.presets.zhang_yan_2024_saturated()
    paths = [p.path for p in ij.parameters(scenario)]
    assert "controller.K2" in paths
    assert "controller.limit" in paths
    assert not any(".law." in path for path in paths)
    for path in ("controller.K2[1]", "controller.law.K2[1]"):
        other = ij.with_parameters(scenario, {path: 33.0})
        np.testing.assert_array_equal(other.controller.law.K2, [20.0, 33.0])
    for p in ij.parameters(scenario):
        ij.with_parameters(scenario, {p.path: p.value})
    with pytest.raises(ValueError, match=r"controller\.K2"):
        ij.with_parameters(scenario, {"controller.K3": 1.0})
    with pytest.raises(ValueError, match="> 0"):
        ij.with_parameters(scenario, {"controller.K2": -1.0})


def test_a_wrapper_in_a_wrapper_keeps_both_fields_apart():
    scenario = ij.presets.zhang_yan_2024_saturated()
    twice = dataclasses.replace(
        scenario,
        controller=controllers.Saturated(law=scenario.controller, limit=50.0, edge="smooth"),
    )
    values = {p.path: p.value for p in ij.parameters(twice)}
    np.testing.assert_array_equal(values["controller.limit"], [50.0, 50.0])
    np.testing.assert_array_equal(values["controller.law.limit"], [7.2, 1.5])
    np.testing.assert_array_equal(values["controller.k1"], [2.0, 2.0])
    other = ij.with_parameters(twice, {"controller.law.limit": 7.0, "controller.k1": 3.0})
    np.testing.assert_array_equal(other.controller.law.limit, [7.0, 7.0])
    np.testing.assert_array_equal(unwrapped(other.controller).k1, [3.0, 3.0])
    again = rewrapped(twice.controller, controllers.PDGravity(Kp=1.0, Kd=1.0))
    assert isinstance(again.law.law, controllers.PDGravity)


def test_saturation_says_what_is_wrong():
    law = controllers.PDGravity(Kp=1.0, Kd=1.0)
    with pytest.raises(ValueError, match="hard"):
        controllers.Saturated(law=law, limit=1.0, edge="soft")
    with pytest.raises(ValueError, match="> 0"):
        controllers.Saturated(law=law, limit=0.0)
    with pytest.raises(ValueError, match=r"Saturated\.law"):
        controllers.Saturated(law=3.0, limit=1.0)


# ----------------------------------------------------------------------- extended-state observer


@pytest.mark.slow
def test_gains_of_the_extended_state_observer_have_two_forms():
    scenario = ij.presets.zhang_yan_2024(variant="corrected")
    forms = [observers.ExtendedState(bandwidth=40.0), observers.ExtendedState(l1=80.0, l2=1600.0)]
    one, other = (dataclasses.replace(scenario, observer=form) for form in forms)
    states = [
        initial_state(s)._replace(observer=observers.extended_state.ExtendedStateValues(Q, DQ))
        for s in (one, other)
    ]
    rates = [rate(s, jnp.zeros(()), state) for s, state in zip((one, other), states, strict=True)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), *rates)
    assert "observer.bandwidth" in [p.path for p in ij.parameters(one)]
    assert "observer.l2" in [p.path for p in ij.parameters(other)]
    for wrong in ({}, {"l1": 1.0}, {"bandwidth": 1.0, "l1": 1.0, "l2": 1.0}):
        with pytest.raises(ValueError, match="bandwidth"):
            observers.ExtendedState(**wrong)


# --------------------------------------------------------------------- the weight of the barrier

WEIGHTED = {
    "backstepping": controllers.Backstepping(k1=2.0, K2=20.0),
    "corrected_mapping": controllers.Backstepping(
        k1=2.0, K2=20.0, barrier=ij.barriers.TransformedError(), variant="corrected"
    ),
    "dynamic_surface": controllers.DynamicSurface(k1=2.0, K2=20.0, filter=0.02),
    "adaptive_rbf": controllers.AdaptiveRBF(k1=2.0, K2=20.0, nodes=4),
}
WEIGHT = jnp.array([0.3, 2.5])


def weighted(name, weight=None):
    """The paper's scenario under one of these laws, its weight given to the constructor."""
    law = dataclasses.replace(WEIGHTED[name], weight=weight)
    velocities = ij.bounds.Bounds(lower=ij.bounds.Constant(-4.0), upper=ij.bounds.Constant(4.0))
    paper = ij.presets.zhang_yan_2024()
    return dataclasses.replace(paper, controller=law, bounds=(paper.bounds[0], velocities))


def commanded(scenario):
    """What its law commands at one state."""
    law, context = scenario.controller, scenario.context
    f_hat, state = jnp.array([0.5, -0.2]), law.init(Q, DQ, context)
    return law.command(jnp.asarray(0.3), Q, DQ, f_hat, context, state)[0]


@pytest.mark.parametrize("name", WEIGHTED)
def test_the_weight_multiplies_slope_and_value_of_the_barrier(name):
    plain, other = (commanded(weighted(name, weight)) for weight in (None, WEIGHT))
    scenario = weighted(name)
    tube, barrier = scenario.context.tube(jnp.asarray(0.3)), scenario.controller.barrier
    added = (WEIGHT - 1.0) * barrier.slope(tube, Q)
    np.testing.assert_allclose(other.tau, plain.tau - added, rtol=1e-12)
    np.testing.assert_allclose(other.V1, WEIGHT * plain.V1, rtol=1e-9)
    np.testing.assert_array_equal(plain.tau, commanded(weighted(name, 1.0)).tau)
    np.testing.assert_array_equal(scenario.controller.weight, [1.0, 1.0])


@pytest.mark.parametrize("name", WEIGHTED)
def test_the_weight_is_a_leaf_with_the_unit_that_its_barrier_gives_it(name):
    units = {"corrected_mapping": "N m/rad"}
    found = {p.path: p for p in ij.parameters(weighted(name))}["controller.weight"]
    assert (found.shape, found.unit) == ((2,), units.get(name, "N m rad"))
    assert ij.simulation.paths.unit_at(weighted(name), "controller.weight[1]") == found.unit
    limited = controllers.Saturated(law=WEIGHTED[name], limit=30.0)
    outer = dataclasses.replace(weighted(name), controller=limited)
    inside = ij.with_parameters(outer, {"controller.weight": WEIGHT})
    np.testing.assert_array_equal(inside.controller.law.weight, WEIGHT)
    with pytest.raises(ValueError, match=r"weight.*> 0"):
        ij.with_parameters(weighted(name), {"controller.weight": [1.0, 0.0]})


def test_files_without_a_weight_have_the_papers_and_others_keep_theirs(tmp_path):
    ij.save_scenario(weighted("backstepping", WEIGHT), tmp_path / "scenario.toml")
    text = (tmp_path / "scenario.toml").read_text()
    loaded = ij.load_scenario(tmp_path / "scenario.toml")
    np.testing.assert_array_equal(loaded.controller.weight, WEIGHT)
    old = "\n".join(line for line in text.splitlines() if not line.startswith("weight"))
    assert old != text.rstrip("\n")
    (tmp_path / "old.toml").write_text(old)
    loaded = ij.load_scenario(tmp_path / "old.toml")
    np.testing.assert_array_equal(loaded.controller.weight, [1.0, 1.0])


def test_a_weight_of_one_costs_no_operation_and_another_one_a_joint():
    paper = ij.presets.zhang_yan_2024()
    one, other = (
        ij.explain(ij.with_parameters(paper, {"controller.weight": w})) for w in (1.0, 0.5)
    )
    products = [sum(counter["mul"] for counter in found.counts.values()) for found in (one, other)]
    # Four slopes of a step of Runge-Kutta, the value and its rate: one product a joint each.
    assert 0 < products[1] - products[0] <= 2 * 8


@pytest.mark.slow
def test_the_derivative_by_the_weight_is_that_of_differences_also_at_one():
    paper = ij.presets.zhang_yan_2024()

    def end(w):
        weighted = ij.with_parameters(paper, {"controller.weight": w})
        return ij.simulate(weighted, duration=0.05, dt=1e-3).q[-1, 0]

    for w in (1.0, 0.7):
        difference = (end(w + 1e-4) - end(w - 1e-4)) / 2e-4
        np.testing.assert_allclose(jax.grad(end)(w), difference, rtol=1e-5)
