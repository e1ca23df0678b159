"""The torque on a level set: bounds, against equations of its own, and the limits of a loop."""

import dataclasses
import functools

import numpy as np
import pytest
from proof_cases import pendulum, within
from test_arm_proofs import LEVEL, LEVELS, LOOPS, WEIGHT, coordinates_of, each, paper_loop

import iblf_jax as ij
from iblf_jax.control.actuators import Ideal
from iblf_jax.kernels.enclosure import enclose
from iblf_jax.proofs import Verdict
from iblf_jax.proofs.arms import arm_problem
from iblf_jax.proofs.torque import MARGINS, TorqueRange, without_limits

Saturated, Motor = ij.controllers.Saturated, ij.actuators.Motor


def limited(scenario, limit, actuator=None, **more):
    law = Saturated(scenario.controller, limit=limit, **more)
    return dataclasses.replace(scenario, controller=law, actuator=actuator or scenario.actuator)


@functools.cache
def proof(limit=None, weight=3e-3, motor=None, **options):
    scenario = pendulum() if limit is None else limited(pendulum(), limit)
    if motor is not None:
        scenario = dataclasses.replace(scenario, actuator=Motor(limit=motor))
    options = {"parameters": within(3.0), "level": 0.5, "progress": False} | options
    return ij.prove(scenario, weight=weight, **options)


# --- the bound --------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", each({"pendulum"}))
def test_bound_over_boxes_contains_the_torque_of_their_points(name):
    scenario, parameters = LOOPS[name]()
    problem = arm_problem(scenario, parameters)
    n, generator = scenario.n, np.random.default_rng(1)
    level = LEVELS.get(name, LEVEL)
    ends = np.full(n, -1.0), np.full(n, 3.0)
    for share in (0.0, 0.3, 1.0):
        points = problem.sample(2, 500)
        inside = problem.constants(WEIGHT, max(level * share**2, 1e-12))
        torque = problem.torques(points, inside)
        rows = np.array([coordinates_of(point, n) for point in points])
        x = np.insert(rows, rows.shape[1] - n - 1, max(share, 1e-6 / level**0.5), axis=1)
        lower, upper, _ = problem.whole_set
        width = np.concatenate([upper - lower, np.zeros(n + 1)])
        size = width * generator.choice([0.0, 1e-6, 1e-3, 1e-2, 0.1], (len(x), 1))
        below, above = generator.uniform(size=(2, *x.shape)) * size
        low, high = x - below - 1e-12 * width, x + above + 1e-12 * width
        # The level is not divided by share^2 where share is an interval.
        low[:, -n - 2] = np.maximum(low[:, -n - 2], 0.0)
        constants = [*problem.constants(WEIGHT, level), *ends]
        _, (bounds, _) = enclose(problem.torque.excess, low, high, constants)
        excess = np.maximum(torque - ends[1], ends[0] - torque).max(axis=1) / 4.0
        assert not np.any(bounds[:, 0] < excess - 1e-9 * np.abs(excess))
        is_narrow = size[:, 0] == 0.0
        # The best direction of f_tilde is a bound, not the direction of the point.
        assert np.nanmin(bounds[is_narrow, 0] - excess[is_narrow]) < 0.1 * np.max(np.abs(excess))


class TwoLinks:
    """The equations of the paper's loop without the package, for points (count, ...)."""

    mass, length, centre = np.array([2.0, 0.85]), np.array([0.35, 0.31]), np.array([0.175, 0.155])
    inertia = np.array([0.06125, 0.02042125])
    phase = np.array([0.0, 0.5 * np.pi])
    k1, K2, o, g = 2.0, 3.0, 0.1, 9.81

    def dynamics(self, q, factor):
        """M, the Christoffel matrices and G with factors of the masses and inertias of links."""
        m1, m2 = (self.mass * factor).T
        I1, I2 = (self.inertia * factor).T
        (l1, _), (c1, c2) = self.length, self.centre
        p3 = m2 * l1 * c2
        cos, sin = np.cos(q[:, 1]), np.sin(q[:, 1])
        M22 = m2 * c2**2 + I2
        M12 = M22 + p3 * cos
        M11 = m1 * c1**2 + I1 + m2 * l1**2 + M22 + 2.0 * p3 * cos
        M = np.stack([np.stack([M11, M12], -1), np.stack([M12, M22], -1)], -2)
        outer = m2 * c2 * self.g * np.cos(q.sum(axis=1))
        G = np.stack([(m1 * c1 + m2 * l1) * self.g * np.cos(q[:, 0]) + outer, outer], -1)
        return M, p3 * sin, G

    def coriolis(self, h, v, u):
        return np.stack(
            [-h * (v[:, 1] * u[:, 0] + v.sum(axis=1) * u[:, 1]), h * v[:, 0] * u[:, 0]], -1
        )

    def tube(self, t):
        """q_d, q_d', q_d", k_l, k_u and their rates."""
        t = t[:, None]
        wave = [0.14 * np.sin(t + self.phase + k * 0.5 * np.pi) for k in range(3)]
        side = [0.14 * np.sin(t + self.phase[::-1] + k * 0.5 * np.pi) for k in range(2)]
        k_l, k_u = 0.5 + wave[0] - 0.2 - side[0], 0.9 + side[0] - 0.5 - wave[0]
        return 0.5 + wave[0], wave[1], wave[2], k_l, k_u, wave[1] - side[1], side[1] - wave[1]

    def alpha(self, t, q):
        q_d, dq_d, _, k_l, k_u, dk_l, dk_u = self.tube(t)
        kappa = np.sqrt((dk_u / k_u) ** 2 + (dk_l / k_l) ** 2 + self.o)
        return dq_d - (self.k1 + kappa) * (q - q_d)

    def torque(self, t, q, e2, f_tilde, factor):
        """tau = M(p) (alpha' + e2') + C(p) q' + G(p)."""
        q_d, _, _, k_l, k_u, _, _ = self.tube(t)
        e1 = q - q_d
        k = np.where(e1 > 0.0, k_u, k_l)
        v = self.alpha(t, q) + e2
        step = 1e-6
        later, sooner = (self.alpha(t + d, q + d * v) for d in (step, -step))
        M0, h0, _ = self.dynamics(q, np.ones_like(q))
        force = f_tilde - self.coriolis(h0, v, e2) - self.K2 * e2 - 2.0 * e1 / (k**2 - e1**2)
        e2_rate = np.linalg.solve(M0, force[..., None])[..., 0]
        acceleration = (later - sooner) / (2.0 * step) + e2_rate
        M, h, G = self.dynamics(q, factor)
        return np.einsum("bij,bj->bi", M, acceleration) + self.coriolis(h, v, v) + G

    def states(self, t, s, level, weight):
        """q, e2 and f_tilde where V_w = level |s|^2, s (count, 6)."""
        q_d, _, _, k_l, k_u, _, _ = self.tube(t)
        xi = np.sign(s[:, :2]) * np.sqrt(-np.expm1(-level * s[:, :2] ** 2))
        q = q_d + xi * np.where(xi > 0.0, k_u, k_l)
        M0, _, _ = self.dynamics(q, np.ones_like(q))
        scaled = np.sqrt(2.0 * level) * s[:, 2:4]
        root = np.swapaxes(np.linalg.cholesky(M0), 1, 2)
        e2 = np.linalg.solve(root, scaled[..., None])[..., 0]
        return q, e2, np.sqrt(2.0 * level / weight) * s[:, 4:]

    def random(self, count, level, weight, width, seed):
        """Torques at points of {V_w <= level}, every second one on its boundary."""
        generator = np.random.default_rng(seed)
        t = generator.uniform(0.0, 2.0 * np.pi, count)
        s = generator.normal(size=(count, 6))
        s /= np.linalg.norm(s, axis=1, keepdims=True)
        s[::2] *= generator.uniform(size=(len(s[::2]), 1))
        factor = 1.0 + width * generator.choice([-1.0, 0.0, 1.0], (count, 2))
        return self.torque(t, *self.states(t, s, level, weight), factor)


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.1, pytest.param(1.0, marks=pytest.mark.release)])
def test_the_torque_of_two_links_is_bounded_and_the_bound_is_tight(level):
    masses = {"plant.mass, plant.inertia": ij.factor(ij.interval(0.99, 1.01))}
    options = {"level": level, "weight": 3e-3, "parameters": masses, "progress": False}
    found = ij.prove(paper_loop(), **options)
    assert found.proved and found.torque.is_proved
    torque = TwoLinks()
    samples = np.concatenate([torque.random(100_000, level, 3e-3, 0.01, seed) for seed in range(5)])
    assert np.all(samples >= found.torque.lowest) and np.all(samples <= found.torque.highest)
    largest = np.abs(samples).max(axis=0)
    found_largest = np.maximum(-found.torque.found_lowest, found.torque.found_highest)
    assert np.all(found_largest >= 0.99 * largest)
    assert np.all(found.torque.largest <= (1.0 + MARGINS[0]) * found_largest + 1e-9)
    # Sampled with other equations, at the weights 1.9e-3 and 3e-3
    expected = {1.0: [52.0, 51.0], 0.1: [17.5, 14.7]}[level]
    np.testing.assert_allclose(found_largest, expected, rtol=0.1)
    points, constants = found.problem.sample(0, 1), found.problem.constants(3e-3, 1.0)
    state = found.problem.state_of(points[0], constants)
    of_package = found.problem.torques(points, constants)
    factor = np.array([[state.parameters[f"plant.mass[{i}]"] for i in range(2)]]) / torque.mass
    t, q = np.array([state.t]), state.q[None]
    e2 = state.dq[None] - torque.alpha(t, q)
    expected = torque.torque(t, q, e2, state.f_tilde[None], factor)
    np.testing.assert_allclose(of_package, expected, rtol=1e-6)


@pytest.mark.slow
def test_no_run_exceeds_the_bound_and_the_law_commands_what_the_plant_needs():
    found = proof()
    for run in found.adversarial_runs(4):
        assert np.all(np.asarray(run.tau) <= found.torque.highest)
        assert np.all(np.asarray(run.tau) >= found.torque.lowest)
    constants = found.problem.constants(found.weight, found.level)
    points = found.problem.sample(3, 4)
    for point, expected in zip(points, found.problem.torques(points, constants), strict=True):
        scenario = found.problem.scenario_at(point, constants)
        with_start = ij.simulate(scenario, duration=1e-3, dt=1e-3)
        np.testing.assert_allclose(np.asarray(with_start.tau)[0], expected, rtol=1e-9)


# --- limits -----------------------------------------------------------------------------------


def test_limits_of_law_and_motor_are_joined():
    scenario = pendulum()
    assert without_limits(scenario)[1] is None
    loop = limited(scenario, 50.0, lower_limit=-20.0, actuator=Motor(limit=45.0))
    free, limits = without_limits(loop)
    np.testing.assert_array_equal(limits, [[-20.0], [45.0]])
    assert type(free.actuator) is Ideal
    assert type(free.controller) is ij.controllers.Backstepping
    slow = dataclasses.replace(scenario, actuator=Motor(limit=45.0, bandwidth=1e3))
    assert type(without_limits(slow)[0].actuator) is Motor


@pytest.mark.parametrize(
    ("scenario", "options", "words"),
    [
        (limited(pendulum(), 50.0, edge="smooth"), {}, r"controller\.edge"),
        (
            limited(pendulum(), 9.0, lower_limit=8.0, actuator=Motor(limit=7.0)),
            {},
            "limits that overlap",
        ),
        (limited(pendulum(), 50.0), {"disturbance_rate": 1.0}, "any torque"),
    ],
)
def test_what_changes_the_torque_inside_its_limits_is_refused(scenario, options, words):
    with pytest.raises(ValueError, match=words):
        ij.prove(scenario, level=0.5, parameters=within(1.0), **options)


@pytest.mark.slow
def test_a_proof_includes_that_the_torque_stays_within_its_limits():
    free = proof()
    highest = float(free.torque.found_highest[0])
    assert "Guaranteed on the whole set [N m]: |tau| <=" in repr(free)
    # Between the extreme that was found and the bound without limits
    within_limits = proof(limit=1.02 * highest)
    assert within_limits.proved
    assert within_limits.torque.highest[0] == 1.02 * highest < free.torque.highest[0]
    assert "and the torque stays within its limits" in within_limits.sentence()
    assert not any("saturation" in x for x in within_limits.assumptions)
    assert any("saturation" in x for x in free.assumptions)
    # Those of a motor may not be active.
    beyond = proof(motor=0.999 * highest)
    assert beyond.verdict == Verdict.NOT_PROVED and beyond.growth_points == ()
    assert "beyond the limits" in repr(beyond)
    few = proof(motor=1.0001 * highest, max_boxes=3_000)
    assert few.verdict == Verdict.UNDECIDED and few.done == 1.0
    assert "not proved to stay within its limits" in repr(few)


@pytest.mark.slow
def test_the_weight_and_the_largest_level_respect_the_limits():
    """A larger weight allows a smaller f_tilde, and a smaller torque."""
    free = proof(weight=None)
    limit = 0.97 * float(free.torque.found_highest[0])
    found = proof(limit=limit, weight=None)
    assert found.proved and found.torque.largest[0] <= limit
    assert found.weight > free.weight
    common = {"parameters": within(3.0), "accuracy": 0.5, "weight": 3e-3, "progress": False}
    levels = [
        ij.largest_level(scenario, between=(0.05, 2.0), **common).level
        for scenario in (pendulum(), limited(pendulum(), 25.0))
    ]
    assert levels[1] < levels[0]


def test_excess_is_negative_inside():
    ends = np.array([-5.0, -1.0]), np.array([7.0, 2.0])
    torque = TorqueRange(np.full(2, -np.inf), np.full(2, np.inf), *ends, 0)
    assert torque.excess(np.array([[-6.0, -6.0], [8.0, 8.0]])) == pytest.approx(-1.0 / 14.0)
    assert torque.excess(np.array([[-4.0, -6.0], [8.0, 8.0]])) == pytest.approx(1.0 / 12.0)
    assert not torque.is_proved
