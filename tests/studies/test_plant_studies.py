"""Studies of plants in strict-feedback form."""

from __future__ import annotations

import loops_of_plants
import numpy as np
import plant_cases
import pytest

import iblf_jax as ij

SHORT = {"duration": 0.08, "dt": 1e-3}


@pytest.mark.slow
def test_executors_give_the_same_numbers():
    scenario = loops_of_plants.flexible_joint()
    draws = {"plant.stiffness": ij.factor(ij.uniform(0.8, 1.2))}
    runs = [
        ij.monte_carlo(scenario, draws, runs=8, backend=name, progress=False, **SHORT)
        for name in ("native", "vmap")
    ]
    for name in runs[0].metrics:
        first, second = (np.asarray(run.metrics[name], float) for run in runs)
        np.testing.assert_allclose(first, second, rtol=1e-7, atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_a_sweep_over_a_gain_of_a_level_is_stored(tmp_path):
    pytest.importorskip("zarr")
    options = {"store": str(tmp_path / "sweep.zarr"), "progress": False, **SHORT}
    grid = {"controller.k[2]": [20.0, 30.0]}
    first = ij.sweep(loops_of_plants.user_class(), grid, **options)
    again = ij.sweep(loops_of_plants.user_class(), grid, **options)
    np.testing.assert_array_equal(first["rmse"], again["rmse"])
    assert first.sizes["controller.k[2]"] == 2


@pytest.mark.slow
def test_a_rigid_law_and_one_of_all_levels_at_equal_effort():
    """Neither has a barrier above the first level: leaving the bounds there is no obstacle."""
    preset = ij.presets.flexible_joint_two_link(stiffness=1000.0)
    damped = ij.with_parameters(preset, {f"{x}.motor_damping": 1.0 for x in ("plant", "model")})
    scenario = ij.with_parts(damped, observer=ij.observers.Momentum(kf=5.0))
    rigid = ij.controllers.Backstepping(k1=2.0, K2=0.9, variant="corrected")
    all_levels = ij.controllers.BarrierBackstepping(k=(2.0, 10.0, 30.0, 60.0))
    laws = {"rigid": rigid, "all levels": all_levels}
    found = ij.compare(scenario, laws, duration=1.0, dt=5e-4)
    model = found.rollouts["rigid"].scenario.model
    assert type(model) is ij.robots.WithMotors
    np.testing.assert_array_equal(model.inertia, scenario.plant.motor_inertia)
    assert found.rollouts["all levels"].scenario.model.order == 4
    assert int(found.rollouts["rigid"].status) & ij.Status.STATE_BOUND_VIOLATED
    efforts = [x.metrics.effort_above_gravity for x in found.equal_effort.values()]
    assert list(found.equal_effort) == ["rigid", "all levels"]
    np.testing.assert_allclose(efforts[1], efforts[0], rtol=1e-4)
    assert "k = " in str(found)


def test_a_law_by_name_is_refused_on_a_plant_without_a_robot():
    with pytest.raises(ValueError, match=r"laws: got 'log'.*Give \{'log': .*BarrierBackstepping"):
        ij.compare(plant_cases.pendulum(), ["log"], **SHORT)


def errors_below(size):
    return ij.Bounds(
        lower=ij.bounds.Funnel(-size, -size, 0.0), upper=ij.bounds.Funnel(size, size, 0.0)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "tolerance", "shown"),
    [(0.005, 0.01, False), (0.02, 0.01, True), (0.005, 0.001, True), (0.01, 0.01, False)],
)
def test_a_settling_time_is_shown_where_the_bounds_do_not_settle_the_run(size, tolerance, shown):
    scenario = plant_cases.pendulum(initial=ij.Initial(x=[[0.0]] * 3))
    # The rounded distances of these bounds are 0.01 to 0.010000000000000009.
    offset = ij.references.Sinusoid(offset=0.12, amplitude=0.02, frequency=0.5)
    start = ij.Initial(x=[[0.12], [0.0], [1.2]])
    parts = {"bounds": errors_below(size), "reference": offset, "initial": start}
    scenario = ij.with_parts(scenario, **parts)
    laws = {"mapping": scenario.controller}
    folds = (ij.metrics.Settling(tolerance=tolerance),)
    found = ij.compare(scenario, laws, duration=0.01, dt=1e-3, metrics=folds, equal_effort=False)
    assert np.isfinite(found.table["gains"][0].settling_time) == shown
    assert (f"|e1| < {tolerance:g} rad for good. It is not shown" in str(found)) != shown
    assert "k = [ 3. 10. 30.]" in str(found)


@pytest.mark.slow
def test_the_effort_is_named_by_what_the_plant_states():
    short = {"duration": 0.01, "dt": 1e-3}
    scenario = plant_cases.pendulum()
    found = ij.compare(scenario, {"mapping": scenario.controller}, **short)
    assert "u_0 = 0 (the plant has no steady_input)" in str(found)
    preset = ij.presets.motor_driven_pendulum()
    found = ij.compare(preset, {"mapping": preset.controller}, **short)
    assert "above its steady_input u_0(q)" in str(found)
    assert "voltage above u_0 [V]" in str(found)
    assert "gravity" not in str(found)
