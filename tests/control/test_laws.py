"""The laws beside the paper's: what each does, what saturation leaves of the claims, and paths
through a wrapper."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from independent import Loop, sine

import iblf_jax as ij
from iblf_jax import controllers
from iblf_jax.core.pytree import rewrapped, unwrapped

PD = controllers.PDGravity(Kp=1.0, Kd=1.0)
Q, DQ = jnp.array([0.7, 0.6]), jnp.array([0.4, -0.3])


def test_linear_laws_are_those_of_the_equations(rng):
    """PD with gravity and computed torque at gains of each joint, beside an independent arm."""
    arm, context = Loop(), ij.presets.zhang_yan_2024().context
    Kp, Kd = np.array([25.0, 16.0]), np.array([10.0, 7.0])
    laws = controllers.PDGravity(Kp, Kd), controllers.ComputedTorque(Kp, Kd)
    for _ in range(10):
        t, q, (dq, f_hat) = rng.uniform(0.0, 5.0), rng.uniform(0.3, 0.7, 2), rng.normal(size=(2, 2))
        q_d, dq_d, ddq_d = sine(*arm.reference)(t)
        M, C, G, _ = arm.arm(q)
        asked = -Kp * (q - q_d) - Kd * (dq - dq_d)
        expected = G + asked - f_hat, M @ (ddq_d + asked) + C(dq) @ dq + G - f_hat
        arguments = map(jnp.asarray, (t, q, dq, f_hat))
        commands = law_commands(laws, context, *arguments)
        np.testing.assert_allclose(commands, expected, rtol=1e-12, atol=1e-12)


@jax.jit
def law_commands(laws, context, t, q, dq, f_hat):
    return jnp.stack([law.command(t, q, dq, f_hat, context, ())[0].tau for law in laws])


# ---------------------------------------------------------------------------------- adaptive RBF


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


@pytest.mark.slow
def test_smooth_limit():
    dtype, zero = jnp.float32, jnp.zeros(2, jnp.float32)
    context = ij.astype(ij.presets.zhang_yan_2024(), dtype).context
    tau = jnp.asarray([0.0, 1e-30, 0.5, 0.999, 1.0, 1.001, 2.0, 1e8, 1e30], dtype)

    def limited(x):
        fixed = _Fixed(tau=jnp.stack([x, -x]))
        wrapped = controllers.Saturated(law=fixed, limit=jnp.ones(2, dtype), edge="smooth")
        return wrapped.command(zero[0], jnp.stack([zero, zero]), zero, context, ())[0].tau

    value, slope = jax.vmap(limited)(tau), jax.vmap(jax.jacfwd(limited))(tau)
    assert value.dtype == dtype
    np.testing.assert_allclose(value[:, 0], -value[:, 1])
    wide = np.asarray(tau, np.longdouble)
    exact, exact_slope = wide / (1 + wide**8) ** 0.125, (1 + wide**8) ** -1.125
    np.testing.assert_allclose(value[:, 0], exact.astype(float), rtol=1e-6)
    np.testing.assert_allclose(slope[:, 0], exact_slope.astype(float), rtol=1e-5, atol=1e-30)
    assert bool(jnp.all(jnp.isfinite(jax.vmap(jax.jacrev(limited))(tau))))
    assert bool(jnp.all(jnp.abs(value) <= 1.0))


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
    again = rewrapped(twice.controller, PD)
    assert isinstance(again.law.law, controllers.PDGravity)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ij.presets.zhang_yan_2024(law="nonsense"), "mapping"),
        (lambda: controllers.Saturated(PD, limit=1.0, edge="soft"), "hard"),
        (lambda: controllers.Saturated(PD, limit=0.0), "> 0"),
        (lambda: controllers.Saturated(3.0, limit=1.0), r"Saturated\.law"),
        (lambda: ij.observers.ExtendedState(), "bandwidth"),
        (lambda: ij.observers.ExtendedState(l1=1.0), "bandwidth"),
        (lambda: ij.observers.ExtendedState(bandwidth=1.0, l1=1.0, l2=1.0), "bandwidth"),
    ],
)
def test_refusals_name_what_is_expected(make, words):
    with pytest.raises(ValueError, match=words):
        make()


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


@pytest.mark.parametrize(
    ("name", "unit"), [("backstepping", "N m rad"), ("corrected_mapping", "N m/rad")]
)
def test_the_weight_is_a_leaf_with_the_unit_that_its_barrier_gives_it(name, unit):
    found = {p.path: p for p in ij.parameters(weighted(name))}["controller.weight"]
    assert (found.shape, found.unit) == ((2,), unit)
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


@pytest.mark.slow
def test_the_derivative_by_the_weight_is_that_of_differences_also_at_one():
    paper = ij.presets.zhang_yan_2024()

    def end(w):
        weighted = ij.with_parameters(paper, {"controller.weight": w})
        return ij.simulate(weighted, duration=0.05, dt=1e-3).q[-1, 0]

    for w in (1.0, 0.7):
        difference = (end(w + 1e-4) - end(w - 1e-4)) / 2e-4
        np.testing.assert_allclose(jax.grad(end)(w), difference, rtol=1e-5)
