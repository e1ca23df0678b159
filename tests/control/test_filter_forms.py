"""Filters, matrices and damping of backstepping laws beside the published equations."""

import dataclasses

import chain_cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from independent import Loop
from refused import refused

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, plants, references
from iblf_jax.control.controllers import LawContext
from iblf_jax.simulation.closed_loop import LoopState, initial_state, rate
from iblf_jax.world.robots import momentum

K = np.array([2.0, 5.0, 9.0])
MU = np.array([0.05, 0.03])
K1 = np.array([[0.5, 0.1, 0.0], [-0.1, 0.4, 0.05], [0.0, 0.05, 0.6]])
K2 = np.array([[9.0, 1.0, 0.0], [0.5, 12.0, 2.0], [0.0, -1.0, 5.0]])
WIDE = bounds.Bounds(bounds.Constant(-2.0), bounds.Constant(3.0))


@dataclasses.dataclass
class FilteredLoop(Loop):
    """The independent loop with alpha filtered; its state is (q, q', eta, beta)."""

    mu: np.ndarray = dataclasses.field(default_factory=lambda: np.full(2, 0.02))

    def filtered(self, t, x):
        q, v, eta, beta = np.split(x, 4)
        M, C, G, dM = self.arm(q)
        e1, k, alpha, _ = self.virtual(t, q, v)
        dbeta, f_hat = (alpha - beta) / self.mu, eta + self.kf * (M @ v)
        slope = 2 * e1 / (k**2 - e1**2)
        tau = C(v) @ beta + G + M @ dbeta - f_hat - self.K2 * (v - beta) - slope
        deta = -self.kf * (f_hat + tau - C(v) @ v - G + dM * v[1] @ v)
        acceleration = self.acceleration(q, v, tau + self.disturbance(t, q, v))
        return np.concatenate([v, acceleration, deta, dbeta])


@pytest.mark.slow
def test_a_dynamic_surface_law_and_its_start_are_those_of_an_independent_program(rng):
    field = jax.jit(rate)
    for _ in range(10):
        ranges = {"k1": (1, 3), "K2": (10, 25), "o": (0.05, 0.3), "mu": (0.01, 0.05)}
        draws = {name: rng.uniform(*ends, 2) for name, ends in ranges.items()}
        lower = (rng.uniform(0.1, 0.2, 2), 0.14, 1.0, (np.pi / 2, 0.0))
        loop = FilteredLoop(**draws, q0=tuple(rng.uniform(0.4, 0.8, 2)), lower=lower)
        scenario = ij.with_parts(
            ij.presets.zhang_yan_2024(variant="corrected"),
            controller=controllers.DynamicSurface(loop.k1, loop.K2, filter=loop.mu, o=loop.o),
            bounds=bounds.Bounds(bounds.Sinusoid(*loop.lower), bounds.Sinusoid(*loop.upper)),
            initial=ij.Initial(loop.q0),
        )
        start = loop.virtual(0.0, np.array(loop.q0), np.zeros(2)).alpha
        np.testing.assert_allclose(initial_state(scenario).controller, start, rtol=1e-12)
        t, q = rng.uniform(0.0, 5.0), rng.uniform(0.45, 0.55, 2)
        dq, eta, beta = rng.normal(size=(3, 2))
        state = LoopState(jnp.stack([q, dq]), jnp.asarray(beta), jnp.asarray(eta))
        found = field(scenario, jnp.asarray(t), state)
        expected = loop.filtered(t, np.concatenate([q, dq, eta, beta]))
        rates = np.concatenate([found.q, found.dq, found.observer, found.controller])
        np.testing.assert_allclose(rates, expected, atol=1e-12 * np.max(np.abs(expected)))


ARM_GAIN = np.array([[1.2, -0.3], [0.5, 0.8]])
COMMON = {"k1": 2.0, "K2": 20.0, "barrier": barriers.TransformedError()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("found", "K"),
    [
        (controllers.DynamicSurface(filter=0.05, filter_form="compensated", **COMMON), np.eye(2)),
        (controllers.Backstepping(variant="corrected", gain_matrix=ARM_GAIN, **COMMON), ARM_GAIN),
    ],
)
def test_the_energy_of_a_law_of_robots_decays_as_with_exact_derivatives(found, K, rng):
    scenario = ij.presets.zhang_yan_2024(variant="corrected")
    arm, has_filter = plants.as_plant(scenario.model), found.filter is not None

    def commanded(t, x, state):
        return found.command(t, x[0], x[1], jnp.zeros(2), scenario.context, state)

    def energy(t, x, state):
        command = commanded(t, x, state)[0]
        e2 = x[1] - command.alpha
        return jnp.sum(command.V1) + 0.5 * jnp.sum(e2 * momentum(scenario.model, x[0], e2))

    for _ in range(3):
        t = jnp.asarray(rng.uniform(0.0, 3.0))
        x = jnp.asarray(rng.uniform(-0.05, 0.05, (2, 2)))
        x = x.at[0].add(scenario.context.tube(t).q_d)
        state = jnp.asarray(rng.uniform(-0.05, 0.05, (2, 2))) if has_filter else ()
        command, rates = commanded(t, x, state)
        dx = plants.flow(arm, t, x, command.tau)
        dV = jax.jvp(energy, (t, x, state), (jnp.ones_like(t), dx, rates))[1]
        e2 = x[1] - command.alpha
        decay = 4.0 * jnp.sum(command.V1) + 20.0 * e2 @ K @ e2
        np.testing.assert_allclose(dV, -decay, rtol=1e-9)
        if not has_filter:
            stated = found.energy_decay(t, x[0], x[1], scenario.context)
            np.testing.assert_allclose(stated, decay, rtol=1e-9)


@pytest.mark.slow
def test_the_claims_about_a_full_gain_are_those_of_its_symmetric_part():
    scenario = ij.presets.zhang_yan_2024(variant="corrected")
    law = controllers.Backstepping(
        k1=2.0, K2=[20.0, 15.0], gain_matrix=ARM_GAIN, variant="corrected"
    )
    scenario = ij.with_parts(scenario, controller=law)
    cert = ij.certify(scenario, duration=0.5, dt=1e-3)
    full = ARM_GAIN * np.array([20.0, 15.0])
    symmetric = 0.5 * (full + full.T)
    np.testing.assert_allclose(cert["K2"].margin, np.linalg.eigvalsh(symmetric)[0] - 0.5)
    assert (cert["K2"].joint, cert.headline) == (None, "holds")
    for name in ("inequality, case 2", "weighted inequality, case 2"):
        assert cert[name].verdict == "holds"
    M0 = scenario.model.mass_matrix(scenario.initial.q)
    mu = scipy.linalg.eigvalsh(symmetric, M0)[0]
    assert 0.9 * mu < cert.numbers["lambda_min_K2_over_M0_run"] <= mu * (1.0 + 1e-9)


@pytest.mark.slow
def test_certificates_claim_nothing_about_other_forms_and_matrices():
    scenario = ij.presets.motor_driven_pendulum()
    changed = dataclasses.replace(scenario.controller, filter=0.02, filter_form="compensated")
    text = str(ij.certify(ij.with_parts(scenario, controller=changed), duration=0.01, dt=1e-3))
    assert 'the law has filters of the form "compensated"' in text
    scenario = ij.presets.vessel()
    law = of_levels(gain_matrices=np.stack([np.eye(3), K2]))
    changed = ij.with_parts(scenario, controller=law, bounds=(scenario.bounds[0], None))
    cert = ij.certify(changed, duration=0.01, dt=1e-3)
    assert "the law has matrices as gains or weights" in str(cert)
    assert cert.headline != "holds"


@pytest.mark.slow
def test_the_force_of_a_vessel_is_the_published_one(rng):
    """tau = M alpha' + C nu + D nu + g - K2 z2 - R^T z1,   alpha = R^T (eta_d' - K1 z1)."""
    stiffness, rest = np.array([3.0, 5.0, 0.8]), np.array([0.2, -0.1, 0.3])
    mooring = plants.Mooring(stiffness, rest)
    vessel = dataclasses.replace(ij.presets.cybership_ii(), restoring=mooring)
    M = np.asarray(vessel.inertia_matrix())
    found = controllers.BarrierBackstepping(
        k=(1.0, 1.0),
        barriers=barriers.Quadratic(),
        gain_matrices=np.stack([K1, K2]),
        weight_matrices=np.stack([np.eye(3), M]),
    )
    reference = references.Sinusoid([0.1, 0.2, 0.3], [1.0, 0.5, 0.4], [0.3, 0.2, 0.5])
    given = LawContext(vessel, reference, (WIDE, None))
    for _ in range(3):
        t, eta, nu = rng.uniform(0.0, 5.0), rng.normal(size=3), rng.normal(size=3)
        x = jnp.stack([eta, nu])
        ready = found.with_defaults(given, x)
        np.testing.assert_array_equal(ready.weights, 1.0)
        command, _ = ready.command(jnp.asarray(t), x, jnp.zeros((2, 3)), given, ())
        wave, amplitude = np.array([0.3, 0.2, 0.5]), np.array([1.0, 0.5, 0.4])
        z1 = eta - np.array([0.1, 0.2, 0.3]) - amplitude * np.sin(wave * t)
        velocity = amplitude * wave * np.cos(wave * t)
        acceleration = -amplitude * wave**2 * np.sin(wave * t)
        s, c = np.sin(eta[2]), np.cos(eta[2])
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        S = np.array([[0.0, -nu[2], 0.0], [nu[2], 0.0, 0.0], [0.0, 0.0, 0.0]])
        alpha = R.T @ (velocity - K1 @ z1)
        dalpha = -S @ alpha + R.T @ (acceleration - K1 @ (R @ nu - velocity))
        C, D = np.asarray(vessel.coriolis_matrix(nu)), np.asarray(vessel.damping_matrix(nu))
        forces = C @ nu + D @ nu + R.T @ (stiffness * (eta - rest))
        tau = M @ dalpha + forces - K2 @ (nu - alpha) - R.T @ z1
        np.testing.assert_allclose(command.tau, tau, rtol=1e-11, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["surface", "derivative", "compensated"])
def test_filters_matrices_weights_and_damping_are_those_of_the_equations(form, rng):
    """(S.2) with (S.4) to (S.6) in NumPy, for two components and matrices on every level."""
    gain = np.array([[1.5, 0.7], [2.0, 1.1], [0.8, 0.9]])
    W = np.array([[[2.0, 0.3], [0.3, 0.7]], [[1.2, -0.2], [-0.2, 0.5]], [[0.9, 0.1], [0.1, 1.4]]])
    A = np.array([[[4.0, 1.0], [0.5, 2.0]], [[7.0, 0.0], [-1.0, 5.0]], [[9.0, 2.0], [1.0, 6.0]]])
    w, c, gamma = rng.uniform(0.5, 2.0, (3, 3, 2))
    plant = plants.StrictFeedback(lambda t, x: -(x**3), lambda t, x: gain, n=2, order=3)
    found = controllers.BarrierBackstepping(
        k=K,
        barriers=barriers.Quadratic(),
        c=c,
        weights=w,
        filter=MU,
        filter_form=form,
        damping=gamma,
        regressor=lambda t, x: jnp.stack([jnp.sin(x), x * x], axis=-1),
        gain_matrices=A,
        weight_matrices=W,
    )
    given = LawContext(plant, references.Sinusoid([0.2, 0.1], 0.4, 1.3), (WIDE, None, None))
    t, x, beta = rng.uniform(0.0, 3.0), rng.normal(size=(3, 2)), rng.normal(size=(2, 2))
    xi, compensates = np.zeros((3, 2)), form == "compensated"
    xi[:2] = rng.normal(size=(2, 2)) * compensates
    state = np.concatenate([beta, xi[:2]]) if compensates else beta
    numbers = jnp.asarray(t), jnp.asarray(x), jnp.zeros((3, 2))
    command, rates = found.command(*numbers, given, state)

    centre = np.array([0.2, 0.1]) + 0.4 * np.sin(1.3 * t)
    rate = np.full(2, 0.4 * 1.3 * np.cos(1.3 * t))
    expected, of_xi, below = [], [], np.zeros(2)
    for i in range(3):
        e = x[i] - xi[i] - centre
        s = W[i] @ e
        a = rate - np.linalg.solve(W[i], A[i] @ (K[i] * e))
        third = np.linalg.solve(W[i], below) / w[i]
        damping = c[i] + gamma[i] * (np.sin(x[i]) ** 2 + x[i] ** 4)
        alpha = (a - damping * s - third - K[i] * xi[i] + x[i] ** 3) / gain[i]
        if i == 2:
            break
        rate = (alpha - beta[i]) / MU[i]
        centre = alpha if form == "derivative" else beta[i]
        expected.append(rate)
        of_xi.append(gain[i] * (beta[i] - alpha + xi[i + 1]) - K[i] * xi[i])
        below = gain[i] * w[i] * s
    np.testing.assert_allclose(command.tau, alpha, rtol=1e-11)
    expected += of_xi * compensates
    np.testing.assert_allclose(rates, expected, rtol=1e-11, atol=1e-12)


def of_levels(**fields):
    both = (barriers.TransformedError(), barriers.Quadratic())
    return controllers.BarrierBackstepping(**{"k": (1.0, 1.0), "barriers": both} | fields)


def of_joints(matrix):
    return controllers.Backstepping(k1=1.0, K2=3.0, gain_matrix=matrix)


ARM_CONTEXT = ij.presets.zhang_yan_2024().context


def with_a_wrong_regressor():
    wrong = controllers.BarrierBackstepping(k=K, damping=1.0, regressor=lambda t, x: x)
    reference = references.Sinusoid(offset=0.2, amplitude=0.4)
    wrong.check_start(LawContext(chain_cases.pendulum(), reference, (WIDE, None, None)))


test_what_does_not_fit_is_refused = refused(
    (lambda: of_levels(gain_matrices=[K1, K2]), r"matrices\[0\].*unit matrix.*TransformedError"),
    (lambda: of_levels(weight_matrices=[np.eye(3), K2]), r"weight_matrices\[1\].*symmetric"),
    (lambda: of_levels(gain_matrices=[np.eye(3), -K2]), r"matrices\[1\].*eigenvalue -12.2"),
    (lambda: of_joints(np.eye(3)[0]), r"Backstepping\.gain_matrix.*shape \(n, n\)"),
    (lambda: of_joints(np.diag([1.0, -2.0])), r"Backstepping\.gain_matrix.*eigenvalue -6"),
    (lambda: of_joints(np.eye(3)).check_start(ARM_CONTEXT), r"controller\.gain.*\(2, 2\)"),
    (lambda: of_levels(weight_matrices=np.eye(3)), r"weight_matrices.*shape \(2, n, n\)"),
    (lambda: of_levels(filter_form="derivative"), r"BarrierBackstepping\.filter.*filter=0\.01"),
    (
        lambda: controllers.DynamicSurface(k1=1.0, K2=1.0, filter=0.1, filter_form="lag"),
        r"DynamicSurface\.filter_form.*surface",
    ),
    (lambda: of_levels(damping=1.0), r"regressor.*phi"),
    (lambda: of_levels(regressor=phi), "damping"),
    (with_a_wrong_regressor, r"controller\.regressor.*\(3, 1, m\)"),
)


def phi(t, x):
    return x[..., None]


def test_the_unit_of_damping_is_that_for_phi_in_the_unit_of_a_rate():
    mixed = (barriers.PrescribedPerformance(), barriers.Quadratic())
    damped = controllers.BarrierBackstepping(
        k=(1.0, 1.0), barriers=mixed, damping=1.0, regressor=phi
    )
    formulas = [unit.formula for unit in damped.leaf_units()["damping"]]
    assert formulas == ["s", "s/x2^2"]
