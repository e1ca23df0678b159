"""Regions for the tip and for joints' origins: watched, kept by the safety filter, drawn, tuned."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from iblf_jax.regions import along, in_words, margins, position_of
from independent import Loop
from matplotlib.figure import Figure
from refused import assert_refused, refused

import iblf_jax as ij
from iblf_jax import bounds, controllers, plotting, regions

RUN = {"duration": 1.5, "dt": 1e-3}
WALL = regions.HalfSpace(normal=[-2.0, 0.2], offset=-0.46)
BALL = regions.Sphere(centre=[0.40, 0.06], radius=0.1, point=1)
REACH = regions.Sphere(centre=[0.1, 0.1], radius=0.46, keep="inside")


def stepping(goal=(0.3, 0.9), **parts):
    """PD that steps towards a tip beyond the wall and an elbow in the ball."""
    made = {
        "controller": controllers.PDGravity(Kp=[30.0, 20.0], Kd=[2.0, 1.0]),
        "reference": ij.references.Sinusoid(offset=goal, amplitude=0.0),
        "bounds": bounds.Bounds(lower=bounds.Constant(-0.5), upper=bounds.Constant(2.2)),
        "initial": ij.Initial([1.0, 1.3]),
        "regions": (WALL, BALL, REACH),
        "disturbance": ij.disturbances.Nothing(),
    }
    scenario = ij.presets.zhang_yan_2024(law="pd", variant="corrected")
    return ij.with_parts(scenario, **(made | parts))


def filtered(scenario, **options):
    law = controllers.SafetyFilter(law=scenario.controller, **options)
    return ij.with_parts(scenario, controller=law)


@pytest.fixture(scope="module")
def alone():
    with pytest.warns(
        ij.SimulationWarning,
        match=r"a region was left\. regions\[\d\]: the \w+.* crossed its boundary, at t = .* m\.$",
    ):
        return ij.simulate(stepping(), **RUN)


@pytest.fixture(scope="module")
def kept():
    return ij.simulate(filtered(stepping()), **RUN, backend="vmap")


def points(q):
    """Elbow and tip of the paper's arm."""
    elbow = 0.35 * np.array([np.cos(q[0]), np.sin(q[0])])
    return elbow, elbow + 0.31 * np.array([np.cos(q[0] + q[1]), np.sin(q[0] + q[1])])


def distances(q):
    elbow, tip = points(q)
    normal = np.array([-2.0, 0.2]) / np.hypot(2.0, 0.2)
    ball = np.linalg.norm(elbow - [0.40, 0.06]) - 0.1
    reach = 0.46 - np.linalg.norm(tip - [0.1, 0.1])
    return np.array([normal @ tip + 0.46, ball, reach])


def levels(q):
    """The filter's: as the distances, but smooth at the centre inside."""
    _, tip = points(q)
    return np.array([*distances(q)[:2], (0.46**2 - np.sum((tip - [0.1, 0.1]) ** 2)) / (2 * 0.46)])


def rates(q, v, h=1e-5):
    """Slope (3, 2) and second rate without accelerations (3,) of the levels, by differences."""
    steps, k = np.array([-2, -1, 0, 1, 2]), 1e-3

    def weighted(w, along):
        return np.array(w) @ [levels(q + step * along) for step in steps]

    first, second = [1 / 12, -2 / 3, 0, 2 / 3, -1 / 12], [-1 / 12, 4 / 3, -5 / 2, 4 / 3, -1 / 12]
    slope = np.stack([weighted(first, h * e) / h for e in np.eye(2)], axis=1)
    return slope, weighted(second, k * v) / k**2


def least_change(G, h):
    """The least x with G x <= h, by trying every set of active rows; None if there is none."""
    best = None
    for size in range(3):
        for active in itertools.combinations(range(len(h)), size):
            A = G[list(active)]
            if size == 2 and abs(np.linalg.det(A)) < 1e-9 * np.prod(np.linalg.norm(A, axis=1)):
                continue
            x = np.linalg.pinv(A) @ h[list(active)] if size else np.zeros(2)
            fits = np.all(G @ x <= h + 1e-10 * (1 + np.abs(h)))
            if fits and (best is None or x @ x < best @ best):
                best = x
    return best


def filtered_torque(q, v, nearest, limit, a1=10.0, a2=10.0, b1=10.0, b2=10.0):
    """PD with gravity, and the torque nearest to it that meets every condition."""
    M, C, G, _ = Loop().arm(q)
    asked = G - np.array([30.0, 20.0]) * (q - [0.3, 0.9]) - np.array([2.0, 1.0]) * v
    inverse = np.linalg.inv(M)
    planned = inverse @ (asked - C(v) @ v - G)
    low, high = -(a1 + a2) * v + a1 * a2 * (-0.5 - q), -(a1 + a2) * v + a1 * a2 * (2.2 - q)
    slope, bend = rates(q, v)
    room = slope @ planned + bend + (b1 + b2) * slope @ v + b1 * b2 * levels(q)
    rows = np.concatenate([inverse, -inverse, -slope @ inverse, np.eye(2), -np.eye(2)])
    ends = [high - planned, planned - low, room, limit - asked, limit + asked]
    to_torque = M if nearest == "acceleration" else np.eye(2)
    return asked, asked + to_torque @ least_change(rows @ to_torque, np.concatenate(ends))


@pytest.mark.slow
@pytest.mark.parametrize(("nearest", "limit"), [("torque", None), ("acceleration", [20.0, 8.0])])
def test_the_torque_is_that_of_every_set_of_active_rows(nearest, limit, rng):
    scenario, changed = filtered(stepping(), nearest=nearest, limit=limit), 0
    most = np.full(2, 1e3) if limit is None else np.array(limit)
    q, v = rng.uniform([0.8, 0.9], [1.2, 1.6], (60, 2)), rng.uniform(-1.5, 1.5, (60, 2))
    law, zero = scenario.controller, jnp.zeros(2)

    def command(q, v):
        return law.command(zero[0], jnp.stack([q, v]), zero, scenario.context, ())[0]

    found = jax.jit(jax.vmap(command))(q, v)
    assert not np.any(found.slack) and not np.any(found.region_slack)
    for k in range(len(q)):
        asked, tau = filtered_torque(q[k], v[k], nearest, most)
        np.testing.assert_allclose(found.tau[k], tau, rtol=0, atol=1e-6 * (1 + np.max(np.abs(tau))))
        changed += np.max(np.abs(tau - asked)) > 1e-3
    assert 15 < changed < 60


@pytest.mark.slow
def test_margins_are_those_by_hand_and_what_the_status_says(alone):
    expected = [distances(q) for q in np.asarray(alone.q)]
    np.testing.assert_allclose(alone.region_margin, expected, atol=1e-12)
    outside = np.asarray(alone.region_margin <= 0)
    first = int(np.flatnonzero(outside.any(axis=1))[0])
    assert ij.Status(int(alone.status)) & ij.status.FAILED == ij.Status.REGION_VIOLATED
    assert float(alone.metrics.first_region_violation_time) == pytest.approx(float(alone.t[first]))
    assert outside[first, int(alone.metrics.first_region_violation_region)]
    least = alone.region_margin.min(axis=0)
    np.testing.assert_allclose(alone.metrics.region_margin, least, rtol=1e-12)
    assert np.sum(np.asarray(alone.metrics.region_margin) < -0.01) >= 2


@pytest.mark.slow
def test_the_filter_keeps_what_the_law_breaks(kept):
    assert not int(kept.status) & int(ij.status.FAILED | ij.Status.FILTER_INFEASIBLE)
    margin = np.asarray(kept.metrics.region_margin)
    assert np.all(margin > 0) and np.sum(margin < 0.01) >= 1
    assert not np.any(kept.metrics.largest_slack) and not np.any(kept.metrics.largest_region_slack)


@pytest.mark.slow
def test_too_little_torque_breaks_them_and_says_by_how_much():
    scenario = filtered(stepping(initial=ij.Initial([1.0, 1.3], [-3.0, -1.0])), limit=[3.0, 1.0])
    with pytest.warns(ij.SimulationWarning, match=r"m/s\^2 \(run\.region_slack\).*b1 and b2"):
        run = ij.simulate(scenario, duration=0.3, dt=1e-3, method="euler", backend="vmap")
    assert int(run.status) & int(ij.Status.FILTER_INFEASIBLE)
    np.testing.assert_allclose(run.metrics.largest_region_slack, run.region_slack.max(axis=0))
    assert float(np.max(run.metrics.largest_region_slack)) > 0.1
    assert np.all(np.max(np.abs(run.tau), axis=0) <= np.array([3.0, 1.0]) * (1 + 1e-9))
    q, v = np.asarray(run.q[1]), np.asarray(run.dq[1])
    ddq = Loop().acceleration(q, v, np.asarray(run.tau[1]))
    slope, bend = rates(q, v)
    broken = -(slope @ ddq + bend + 20.0 * slope @ v + 100.0 * levels(q))
    allowed = 1e-5 * np.max(np.abs(broken))
    np.testing.assert_allclose(run.region_slack[1], np.maximum(broken, 0.0), atol=allowed)


@pytest.mark.slow
def test_points_of_an_arm_are_mujocos_and_move_as_their_rates_say(rng, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(MODEL)
    model = mujoco.MjModel.from_xml_string(MODEL)
    data, robot = mujoco.MjData(model), ij.robots.load(tmp_path / "arm.xml", tip="tip")
    wrist = regions.HalfSpace([0.0, 1.0, 2.0], -1.0, "wrist")
    inside = regions.Sphere([0.0, 0.0, 0.0], 2.0, keep="inside")
    parts = regions.Sphere([0.3, 0.1, 0.2], 0.1), wrist, inside
    moving = jax.jit(lambda q, v: along(parts, robot, q, v))
    for q, v, a in rng.uniform(-1.5, 1.5, (5, 3, robot.n)):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        points_of_mujoco = {"wrist": data.joint("wrist").xanchor, "tip": data.site("tip").xpos}
        for point, expected in points_of_mujoco.items():
            np.testing.assert_allclose(position_of(robot, point, q), expected, atol=1e-12)
        h = 1e-4
        moved = [moving(q + s * v + 0.5 * s**2 * a, v).level for s in (-h, 0.0, h)]
        at = moving(q, v)
        np.testing.assert_allclose(at.rate, (moved[2] - moved[0]) / (2 * h), atol=1e-6)
        second = (moved[2] - 2 * moved[1] + moved[0]) / h**2
        np.testing.assert_allclose(at.slope @ a + at.bend, second, atol=1e-5)
    assert in_words(wrist, robot) == "the origin of wrist"


MODEL = """<mujoco><compiler angle="radian"/><worldbody>
<body><joint name="base" axis="0 0 1"/><geom size="0.1"/>
<body pos="0.1 0 0.3"><joint name="elbow" axis="0 1 0"/><geom size="0.1" pos="0.1 0 0"/>
<body pos="0.4 0 0.05"><joint name="wrist" axis="0 1 0.2"/><geom size="0.05" pos="0.1 0 0"/>
<site name="tip" pos="0.2 0 0.1"/>
</body></body></body></worldbody></mujoco>"""


@pytest.mark.slow
def test_a_requirement_on_regions_and_an_attack_on_them():
    scenario = stepping(goal=(0.5, 0.9), regions=(BALL, WALL))
    short = {"duration": 0.4, "dt": 2e-3, "progress": False}
    objective = ij.objectives.tracking() + 0.1 * ij.objectives.effort()
    objective = objective + ij.objectives.region_margin_above(0.01)
    effort = ij.tuning.Effort(iterations=8)
    result = ij.tune(scenario, ["controller.Kd"], objective, **short, effort=effort)
    line = result.report.verdicts[0]
    assert (line.name, line.unit, line.verdict) == ("region margin > 0.01 m", "m", "pass")
    run = result.nominal[1]
    assert float(np.min(run.metrics.region_margin)) == pytest.approx(line.value)
    sets = {"initial.q": ij.offset(ij.uniform(-0.02, 0.02))}
    attack = ij.falsify(result.scenario, sets, **short, starts=4, iterations=3, margin="regions")
    assert attack.unit == "m" and attack.margin <= attack.first_margin < line.value + 0.03
    assert attack.violated == (attack.margin < 0)
    assert float(np.min(attack.replay().metrics.region_margin)) == pytest.approx(attack.margin)
    assert_refused("regions", ij.falsify, stepping(regions=()), sets, **short, margin="regions")
    assert_refused("regions", ij.tune, stepping(regions=()), ["controller.Kd"], objective, **short)


@pytest.mark.slow
def test_starts_beyond_a_wall_are_told_from_violations():
    scenario = stepping(goal=(1.0, 1.3), regions=(regions.HalfSpace([1.0, 0.0], -0.1),))
    draws = {"initial.q": ij.offset(ij.uniform(-0.3, 0.3))}
    study = ij.monte_carlo(scenario, draws, runs=32, duration=0.08, dt=1e-3, progress=False)
    at_start = jax.vmap(lambda q: margins(scenario.regions, scenario.plant, q))
    outside = np.asarray(at_start(study.samples["initial.q"]))[:, 0] <= 0
    assert 0 < np.sum(outside) < 32
    np.testing.assert_array_equal(study.started_outside, outside)
    assert study.violation_probability.count >= np.sum(outside)
    with pytest.warns(ij.SimulationWarning, match="the tip was drawn .* m beyond one"):
        study.replay(int(np.flatnonzero(outside)[0]))


@pytest.mark.slow
def test_figures(alone, kept):
    figure, runs = Figure(), {"alone": alone, "filtered": kept}
    assert plotting.region_margins(runs, figure=figure) is figure and len(figure.axes) == 6
    assert len(alone.plot().axes) == 2 + 6 + 2  # tubes, joints together, margins and paths
    lines = {x.get_label(): x.get_xydata() for x in plotting.workspace(runs).axes[0].get_lines()}
    np.testing.assert_allclose(lines["filtered"][-1], points(np.asarray(kept.q[-1]))[1])
    assert {"bound of the tip", "bound of the origin of joint 1", "reference"} <= lines.keys()
    lines = {x.get_label(): x.get_ydata() for x in figure.axes[0].get_lines()}
    np.testing.assert_allclose(lines["alone"][-1], alone.region_margin[-1, 0])


def run_with(*parts):
    return ij.simulate(stepping(regions=parts), **RUN)


test_bad_regions_are_refused = refused(
    (lambda: ij.simulate(stepping(regions=3.0), **RUN), "a tuple of regions"),
    (lambda: run_with(WALL, 3.0), r"regions\[1\]"),
    (lambda: run_with(regions.HalfSpace([0, 0, 1])), r"regions\[0\].*TwoLink of 2 joints"),
    (lambda: run_with(regions.Sphere([0.1, 0.2], 0.1, point="wrist")), "wrist"),
    (lambda: run_with(regions.Sphere([0.1, 0.2], 0.1, point=2)), "joint 0, joint 1"),
    (lambda: run_with(regions.HalfSpace([1, 0], 0.9)), r"initial\.q.*the tip .* m beyond its"),
    (lambda: regions.HalfSpace([0.0, 0.0]), "a direction"),
    (lambda: regions.HalfSpace(1.0), "two numbers"),
    (lambda: regions.Sphere([0.0, 1.0], 1.0, keep="in"), "inside"),
)
