"""`compare`: what it holds equal, what it says, and what it does with laws that fail."""

import dataclasses
import json
import math
import re

import jax.numpy as jnp
import numpy as np
import plant_cases
import pytest
from matplotlib.text import Text

import iblf_jax as ij
from iblf_jax import barriers, cli, controllers
from iblf_jax.core.status import Status
from iblf_jax.studies.compare import factor_nearest_one
from iblf_jax.studies.equal_effort import Trials, search

SCENARIO = ij.presets.zhang_yan_2024()
RUN = {"duration": 2.0, "dt": 1e-3, "record_every": 10}
BRIEF = {"duration": 0.08, "dt": 1e-3}


@pytest.fixture(scope="module")
def comparison():
    return ij.compare(SCENARIO, ["integral", "log", "pd"], **RUN)


@pytest.mark.slow
def test_effort_text_and_table_are_those_of_the_runs(comparison):
    assert list(comparison.equal_effort) == ["integral", "log", "pd"]
    efforts = [float(run.metrics.effort_above_gravity) for run in comparison.equal_effort.values()]
    np.testing.assert_allclose(efforts, efforts[0], rtol=1e-5)
    assert comparison.factors["integral"] == 1.0 < comparison.factors["log"]
    pair = comparison.rollouts, comparison.equal_effort
    for name, gain in (("log", "k1"), ("log", "K2"), ("pd", "Kp"), ("pd", "Kd")):
        before, after = (getattr(runs[name].scenario.controller, gain) for runs in pair)
        np.testing.assert_allclose(after, before * comparison.factors[name], rtol=1e-12)
    text = repr(comparison)
    for words in (
        *("Equal gains favour the integral form", "that of integral", "Kp = 60, Kd = 20 (pd)"),
    ):
        assert words in text
    assert comparison._repr_html_().count("<table>") == 2
    runs = comparison.rollouts
    for names in (["pd"], ["integral", "pd"]):
        without = dataclasses.replace(comparison, rollouts={name: runs[name] for name in names})
        assert "integral form" not in repr(without)
    row, run = comparison.table["gains"][1], comparison.rollouts["log"]
    assert row.law == "log" and row.settling_time == float(jnp.max(run.metrics.settling_time))
    assert row.xi_margin == float(jnp.min(run.metrics.xi_margin))
    assert row.chatter == float(jnp.sum(run.metrics.torque_variation))
    frame = comparison.to_pandas()
    assert frame.loc[("gains", "log"), "rmse"] == row.rmse and frame.shape == (6, 10)


@pytest.mark.slow
def test_a_figure_for_print_shows_every_torque_and_names_the_joint(comparison):
    """Of smaller torques at equal effort, too: both panels have one axis."""
    smaller = {
        name: dataclasses.replace(run, tau=0.1 * run.tau)
        for name, run in comparison.equal_effort.items()
    }
    runs = dict(comparison.rollouts)
    found = dataclasses.replace(comparison, rollouts=runs, equal_effort=smaller)
    figure = found.plot(joint=1, style="paper")
    torques = figure.axes[2]
    assert torques.get_ylabel() == r"torque $\tau$ of joint 1 [N m]"
    low, high = torques.get_ylim()
    shown = np.concatenate([line.get_ydata() for line in torques.get_lines()])
    assert low < shown.min() < 0.3 * low and shown.max() < high
    for law in ("log", "pd"):  # A failed run does not set the axis, and its peak is written.
        failed = dataclasses.replace(runs[law], status=np.int32(Status.BOUND_VIOLATED))
        runs[law] = dataclasses.replace(failed, tau=30.0 * failed.tau)
    texts = [text.get_text() for text in found.plot(style="paper").axes[2].texts]
    assert len(texts) == 1 and re.fullmatch(r"peak .[\d.]+ N m", texts[0])


@pytest.mark.slow
def test_laws_by_name_take_the_gains_the_observer_and_the_limit_of_the_scenario():
    gains = {"controller.k1": [1.5, 2.5], "controller.K2": 15.0}
    scenario = ij.with_parameters(ij.presets.zhang_yan_2024_saturated(), gains)
    comparison = ij.compare(scenario, ["log", "adaptive_rbf"], equal_effort=False, **BRIEF)
    for name, run in comparison.rollouts.items():
        law = run.scenario.controller
        assert isinstance(law, controllers.Saturated)
        np.testing.assert_array_equal(law.law.k1, [1.5, 2.5])
        np.testing.assert_array_equal(law.law.K2, [15.0, 15.0])
        assert float(jnp.max(jnp.abs(run.tau) - law.limit)) <= 1e-12
        observer = type(run.scenario.observer).__name__
        assert observer == ("NoObserver" if name == "adaptive_rbf" else "Momentum")
    assert comparison.rollouts["log"].scenario.controller.law.variant == "corrected"
    assert not comparison.equal_effort and "effort" not in comparison.table


@pytest.mark.slow
def test_a_metric_replaces_the_standard_one_of_its_class(comparison):
    folds = (ij.metrics.Settling(tolerance=[0.02, 0.04]), ij.metrics.LyapunovValue())
    options = RUN | {"record_every": 1}
    found = ij.compare(comparison.scenario, ["log"], metrics=folds, equal_effort=False, **options)
    with pytest.raises(ValueError, match=r"metrics.*Put one fold into brackets"):
        ij.compare(comparison.scenario, ["log"], metrics=folds[0], **RUN)
    run = found.rollouts["log"]
    inside = np.abs(run.e1) < np.array([0.02, 0.04])
    settled = [np.flatnonzero(~inside[:, i])[-1] + 1 for i in range(2)]
    np.testing.assert_allclose(run.metrics.settling_time, run.t[np.array(settled)])
    assert set(ij.metrics.LyapunovValue.units) <= set(run.metrics)
    assert found.table["gains"][0].settling_time < comparison.table["gains"][1].settling_time


@pytest.mark.slow
def test_failed_runs_and_laws_of_a_users_own_are_named(tmp_path, monkeypatch):
    laws = {"good": "integral", "weak": controllers.PDGravity(Kp=0.01, Kd=0.01)}
    moving = dataclasses.replace(SCENARIO, initial=ij.Initial(q=0.8, dq=[1.0, 1.0]))
    comparison = ij.compare(moving, laws, **RUN)
    assert "bound was violated" in comparison.failed["weak"]
    assert "weak FAILED: a bound was violated" in repr(comparison)
    turned = {"weak": laws["weak"], "good": "integral"}
    reverse = ij.compare(comparison.rollouts["weak"].scenario, turned, **RUN)
    assert math.isnan(reverse.factors["good"]) and "weak, failed itself" in repr(reverse)
    law = controllers.Backstepping(k1=2.0, K2=20.0, barrier=barriers.Tan())
    comparison = ij.compare(SCENARIO, [law, Bang(), Bang(size=0.2)], **BRIEF)
    assert list(comparison.rollouts) == ["Backstepping(Tan)", "Bang", "Bang 2"]
    assert "no gains to scale" in comparison.reasons["Bang"]
    assert "no gains (Bang, Bang 2)" in repr(comparison)
    monkeypatch.setitem(controllers.MEMBERS, "bang", Bang)
    loaded = ij.load(comparison.save(tmp_path / "compared"))
    for equal in (comparison.equal_effort, loaded.equal_effort):
        with pytest.raises(
            KeyError, match=r"'Bang' has no run at equal effort.* no gains to scale"
        ):
            equal["Bang"]
        with pytest.raises(KeyError, match="no run of 'PD' at equal effort; there are Back"):
            equal["PD"]
    for style in ("screen", "paper"):
        figure = ij.plotting.joint(loaded.equal_effort, style=style)
        named = [text.get_text() for text in figure.legends[0].get_texts()]
        assert named[-2:] == ["Bang: no factor", "Bang 2: no factor"]
    assert "no factor" not in str(ij.plotting.joint(loaded.rollouts).findobj(Text))


@pytest.mark.slow
def test_laws_for_other_constraints_have_names_and_margins():
    """At equal effort, too, though the first law leaves what it does not know of."""
    speeds = ij.Bounds(ij.bounds.Constant([-1.0, -0.6]), ij.bounds.Constant([0.6, 0.5]))
    wall = ij.regions.HalfSpace(normal=[-1.0, 0.0], offset=-0.245)
    preset = ij.presets.zhang_yan_2024_full_state()
    scenario = ij.with_parts(preset, bounds=(preset.bounds[0], speeds), regions=(wall,))
    laws = ["integral", "full_state", "reference_governor"]
    comparison = ij.compare(scenario, laws, duration=0.1, dt=1e-3)
    given = {row.law: row for row in comparison.table["gains"]}
    assert given["integral"].velocity_margin < 0 < given["full_state"].velocity_margin
    for row in given.values():
        margin = comparison.rollouts[row.law].metrics.region_margin
        assert row.region_margin == float(np.min(margin))
    assert given["integral"].region_margin < 0
    law = comparison.rollouts["reference_governor"].scenario.controller
    assert (type(law), type(law.law)) == (controllers.ReferenceGovernor, controllers.PDGravity)
    assert comparison.factors["full_state"] > 1.0
    assert "region margin [m]" in repr(comparison) and "region_margin" in comparison.to_pandas()
    with pytest.raises(ValueError, match=r"bounds\[1\]"):
        ij.compare(SCENARIO, ["integral", "full_state"], **RUN)


def test_a_filter_by_name_is_around_the_unconstrained_law_and_a_plant_needs_a_law():
    law = controllers.law_by_name("safety_filter", k1=3.0, variant="corrected")
    assert isinstance(law.law.barrier, ij.barriers.Quadratic) and float(law.law.k1) == 3.0
    found = ij.compare(ij.with_parts(SCENARIO, controller=law), ["pd"], equal_effort=False, **BRIEF)
    # A filter is a law's own, unlike a torque limit.
    assert isinstance(found.rollouts["pd"].scenario.controller, controllers.PDGravity)
    with pytest.raises(ValueError, match=r"laws: got 'log'.*Give \{'log': .*BarrierBackstepping"):
        ij.compare(plant_cases.pendulum(), ["log"], **BRIEF)


@ij.component
class Bang:
    """A user's law without gains."""

    size: object = ij.leaf("N m", default=0.1)

    def command(self, t, q, dq, f_hat, context, state):
        tube = context.tube(t)
        never = jnp.zeros(q.shape, bool)
        tau = context.model.gravity(q) - self.size * jnp.sign(q - tube.q_d)
        return controllers.Command(tau, tube.dq_d, jnp.zeros_like(q), never, never), ()


@pytest.mark.slow
def test_command_line(tmp_path, capsys):
    words = ["--laws", "integral", "log", "--out", str(tmp_path / "out")]
    words += ["--duration", "2", "--record-every", "10"]
    assert cli.main(["compare", *words]) == 0
    out = capsys.readouterr().out
    assert "Equal effort" in out and "twice the logarithmic" in out
    names = {path.name for path in (tmp_path / "out").iterdir()}
    tables = {f"comparison.{ending}" for ending in ("txt", "csv", "json")}
    assert names >= tables | {"comparison_joint_0.png", "comparison_joint_1.pdf"} | {"rollouts.nc"}
    report = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert report["factors"]["integral"] == 1.0
    assert report["factors"]["log"] == pytest.approx(1.1, abs=0.1)
    assert set(ij.load(tmp_path / "out" / "rollouts.nc")) == {"integral", "log"}


def banded(low, high, flags):
    """Trials whose effort is the factor, and which fail between two factors."""

    def run(factors):
        inside = (factors > low) & (factors < high)
        status, modes = np.where(inside, int(flags), 0), np.where(inside, 5e3, 10.0)
        return Trials(factors.copy(), status, modes, np.zeros(len(factors)))

    return run


def test_what_a_search_found_is_said_in_words():
    """The nearest trial and a smaller step where no factor is found, and an effort that does not
    depend on the factor.  Inaccurate trials count only where the given runs are inaccurate too."""

    def dt_for(trials):
        assert np.all(trials.mode == 5e3)
        return 2e-4

    found = search(banded(1.1, 1.5, Status.STEP_TOO_LARGE | Status.NOT_FINITE), 1.32, dt_for)
    assert math.isnan(found.factor)
    factor, effort = found.nearest
    assert factor == effort and (1.08 < factor <= 1.1 or 1.5 <= factor < 1.54)
    assert abs(effort - 1.32) == np.min(np.abs(found.efforts[found.valid] - 1.32))
    words = found.in_words()
    range_of_factors = "its effort does not pass through 1.32 N m (0.03125 to 32)"
    nearest = f"{range_of_factors}; the nearest of them has {effort:.4g} N m, at {factor:.4g}"
    assert nearest in words and "ran away" in words
    assert "with dt=0.0002" in words and found.smaller_dt == 2e-4
    # A violation is no matter of the step, and nothing nearer is hidden beyond the factor.
    assert search(banded(1.1, 1.5, Status.BOUND_VIOLATED), 1.32, dt_for).smaller_dt is None
    beyond = search(banded(1.4, 1.5, Status.STEP_TOO_LARGE), 1.32, dt_for)
    assert beyond.factor == pytest.approx(1.32, rel=1e-6) and beyond.smaller_dt is None
    hiding = search(banded(1.1, 1.2, Status.STEP_TOO_LARGE), 1.32, dt_for)
    assert hiding.factor == pytest.approx(1.32, rel=1e-6) and hiding.smaller_dt == 2e-4
    run = banded(1.1, 1.5, Status.INACCURATE)
    assert math.isnan(search(run, 1.32).factor)
    found = search(run, 1.32, inaccurate=True)
    assert found.factor == pytest.approx(1.32, rel=1e-6)
    assert not found.failed and "inaccurate runs count" in found.in_words()

    def flat(factors):
        nothing = np.zeros(len(factors))
        return Trials(2.0 + 0.01 * np.log2(factors), nothing.astype(int), nothing, nothing)

    found = search(flat, 2.02)
    assert found.factor == pytest.approx(4.0, rel=1e-4)
    assert found.influence == pytest.approx(0.02 / 2.02, rel=0.2)
    assert found.remark().startswith("half and twice the gains change the effort by 0.99 % only")
    assert search(banded(9.0, 9.1, Status.OK), 1.32).remark() == ""


@pytest.mark.parametrize(
    ("effort", "target", "expected"),
    [
        (lambda c: c, 1.0, 1.0),
        (lambda c: 1.0 / c, 0.3, 1.0 / 0.3),
        # of two factors the nearest to 1
        (lambda c: (c - 0.5) * (c - 1.1) + 2.0, 2.0, 1.1),
        (lambda c: 2.0 + math.sin(12.0 * math.log(c)), 2.5, math.exp(math.asin(0.5) / 12.0)),
        # turns back just beyond the target, between grid points
        (lambda c: 2.0 - (c - 0.71) ** 2, 2.0 - 1e-4, 0.72),
        (lambda c: math.nan if 1.1 < c < 1.3 else c, 1.35, 1.35),
        (lambda c: math.nan if 1.1 < c < 1.3 else c, 1.2, math.nan),
        (lambda c: 1.0 + 0.1 * math.tanh(c), 5.0, math.nan),
        # a jump over the target is no factor
        (lambda c: math.nan if 1.03 < c < 1.3 else c + 3.0 * (c < 0.2), 1.2, math.nan),
        # 1/e and e are equally near: the first one
        (lambda c: abs(math.log(c)) + 0.1, 1.1, math.exp(-1.0)),
    ],
)
def test_efforts_of_any_shape(effort, target, expected):
    found = factor_nearest_one(effort, target)
    if expected == math.exp(-1.0):
        found = min(found, 1.0 / found)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.slow
def test_a_rigid_law_and_one_of_all_levels_at_equal_effort():
    """Neither has a barrier above the first level: leaving the bounds there is no obstacle."""
    preset = ij.presets.flexible_joint_two_link(stiffness=1000.0)
    damped = ij.with_parameters(preset, {f"{x}.motor_damping": 1.0 for x in ("plant", "model")})
    scenario = ij.with_parts(damped, observer=ij.observers.Momentum(kf=5.0))
    rigid = ij.controllers.Backstepping(k1=2.0, K2=0.9, variant="corrected")
    all_levels = ij.controllers.BarrierBackstepping(k=(2.0, 10.0, 30.0, 60.0))
    found = ij.compare(scenario, {"rigid": rigid, "all levels": all_levels}, duration=1.0, dt=5e-4)
    model = found.rollouts["rigid"].scenario.model
    assert type(model) is ij.robots.WithMotors
    np.testing.assert_array_equal(model.inertia, scenario.plant.motor_inertia)
    assert found.rollouts["all levels"].scenario.model.order == 4
    assert int(found.rollouts["rigid"].status) & ij.Status.STATE_BOUND_VIOLATED
    efforts = [x.metrics.effort_above_gravity for x in found.equal_effort.values()]
    assert list(found.equal_effort) == ["rigid", "all levels"]
    np.testing.assert_allclose(efforts[1], efforts[0], rtol=1e-4)
    assert "k = " in str(found)
