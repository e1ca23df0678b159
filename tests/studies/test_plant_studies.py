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
