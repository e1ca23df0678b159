"""Datasets of runs of plants in strict-feedback form: dimensions, names and units of levels."""

import numpy as np
import pytest
from loops_of_plants import rigid_law
from plant_cases import body, pendulum

import iblf_jax as ij
from iblf_jax.files.rollouts import load_datasets, load_rollouts


@pytest.fixture(scope="module")
def run():
    return ij.simulate(pendulum(), duration=0.2, dt=1e-3)


def test_signals_of_levels_have_dimensions_and_units(run):
    data = run.to_xarray()
    assert data.disturbance.dims == ("time", "level", "joint")
    assert data.disturbance.attrs["units"] == "rad/s; rad/s^2; A/s"
    assert data.x.dims == ("time", "level", "joint")
    assert data.x.attrs["units"] == "rad; rad/s; A"
    assert data.tau.attrs == {"units": "V", "description": "input: input"}
    assert data.level_margin.dims == ("higher_level", "joint")
    assert data.estimate_rmse.dims == ("level", "joint")
    assert np.array_equal(data.level, [1, 2, 3])
    assert np.array_equal(data.higher_level, [3])
    assert data.level.attrs["description"] == "level of the plant, from 1: angle, speed, current"
    assert data.joint.attrs["description"] == "component of a level, from 0: pendulum"


@pytest.mark.parametrize("ending", [".nc", ".npz"])
def test_a_file_keeps_levels_and_units(run, tmp_path, ending):
    ij.save_rollouts(run, tmp_path / f"run{ending}")
    (data,) = load_datasets(tmp_path / f"run{ending}").values()
    assert data.identical(run.to_xarray())


@pytest.mark.slow
def test_a_study_has_dimensions_and_units_of_levels():
    study = ij.monte_carlo(
        pendulum(),
        {"initial.x[2]": ij.offset(ij.uniform(-1.0, 1.0))},
        runs=4,
        duration=0.1,
        dt=1e-3,
    )
    data = study.to_xarray()
    assert data.level_margin.dims == ("run", "higher_level", "joint")
    assert data.level_margin.attrs["units"] == "A"
    assert data["initial.x[2]"].attrs["units"] == "A"
    assert np.allclose(data["initial.x[2]"], study.samples["initial.x[2]"])
    # The level starts where it was drawn, so its margin is at most that of the start.
    drawn = np.abs(study.samples["initial.x[2]"])
    assert np.all(np.asarray(study.metrics.level_margin)[:, 0] <= 20.0 - drawn + 1e-12)


@pytest.mark.slow
def test_components_of_different_units():
    data = ij.simulate(body(), duration=0.1, dt=1e-2).to_xarray()
    assert data.q.attrs == {"units": "m, m, rad", "description": "pose"}
    assert data.margin.attrs["units"] == "m, m, rad"


@pytest.mark.slow
def test_estimated_levels_of_a_robot_within_a_plant_have_rows_of_the_model(tmp_path):
    """The plant has four levels, and its model two."""
    plant = rigid_law().plant
    scenario = rigid_law(model=plant.rigid(), observer=ij.observers.StateObserver(bandwidth=100.0))
    run = ij.simulate(scenario, duration=0.02, dt=1e-3)
    data = run.to_xarray()
    assert data.x.sizes == {"time": 21, "level": 4, "joint": 2}
    assert data.x_hat.sizes == {"time": 21, "model_level": 2, "joint": 2}
    assert data.peak_level_error.dims == ("model_level", "joint")
    assert np.array_equal(data.model_level, [1, 2])
    ij.save_rollouts(run, tmp_path / "run.nc")
    loaded = load_rollouts(tmp_path / "run.nc")
    assert np.array_equal(loaded.x_hat, run.x_hat)
