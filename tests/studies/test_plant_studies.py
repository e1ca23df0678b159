"""Studies of plants in strict-feedback form."""

from __future__ import annotations

import loops_of_plants
import numpy as np
import pytest

import iblf_jax as ij

SHORT = {"duration": 0.2, "dt": 1e-3}
UNKNOWN = {
    "user class": {"plant.D": ij.factor(ij.uniform(0.9, 1.1))},
    "electric drive": {"plant.robot.mass[1]": ij.factor(ij.uniform(0.9, 1.1))},
    "flexible joint": {"plant.stiffness": ij.factor(ij.uniform(0.8, 1.2))},
}


@pytest.mark.parametrize(
    "case", [x if x == "user class" else pytest.param(x, marks=pytest.mark.slow) for x in UNKNOWN]
)
def test_executors_give_the_same_numbers(case):
    scenario = loops_of_plants.CASES[case]()
    runs = [
        ij.monte_carlo(scenario, UNKNOWN[case], runs=8, backend=name, progress=False, **SHORT)
        for name in ("native", "vmap")
    ]
    for name in runs[0].metrics:
        first, second = (np.asarray(run.metrics[name], float) for run in runs)
        np.testing.assert_allclose(first, second, rtol=1e-7, atol=1e-9, err_msg=name)


def test_a_sweep_over_a_gain_of_a_level_is_stored(tmp_path):
    pytest.importorskip("zarr")
    options = {"store": str(tmp_path / "sweep.zarr"), "progress": False, **SHORT}
    grid = {"controller.k[2]": [20.0, 30.0]}
    first = ij.sweep(loops_of_plants.user_class(), grid, **options)
    again = ij.sweep(loops_of_plants.user_class(), grid, **options)
    np.testing.assert_array_equal(first["rmse"], again["rmse"])
    assert first.sizes["controller.k[2]"] == 2


def test_a_rigid_law_is_compared_with_one_of_all_levels():
    rigid = loops_of_plants.rigid_law()
    scenario = loops_of_plants.flexible_joint(plant=rigid.plant)
    laws = {"all levels": scenario.controller, "rigid": rigid.controller}
    found = ij.compare(scenario, laws, equal_effort=False, **SHORT)
    assert type(found.rollouts["rigid"].scenario.model) is type(loops_of_plants.ROBOT)
    assert found.rollouts["all levels"].scenario.model.order == 4
