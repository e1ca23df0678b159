"""Runs as xarray Datasets, and the files that hold them."""

import dataclasses
import json
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from conftest import SHORT
from loops_of_plants import rigid_law
from made_up_runs import ALWAYS
from plant_cases import body, pendulum
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.files import rollouts
from iblf_jax.files import scenario as scenario_file
from iblf_jax.files.rollouts import load_datasets, load_rollouts
from iblf_jax.simulation.signals import VIEWS


def test_one_run_which_can_be_done_again_from_its_attributes(short_run):
    data = short_run.to_xarray()
    assert data.sizes == {"time": short_run.t.size, "joint": 2}
    shown = {*ALWAYS, *VIEWS} & set(data)
    assert set(VIEWS) - {"dq_lower", "dq_upper"} <= shown
    for name in shown:
        np.testing.assert_array_equal(data[name], getattr(short_run, name))
    for name in short_run.metrics:
        np.testing.assert_array_equal(data[name], short_run.metrics[name])
        assert data[name].attrs["units"] == short_run.metrics.units[name]
    for variable in data.variables.values():
        assert variable.attrs["units"] and variable.attrs["description"]
    np.testing.assert_array_equal(data.observer_state, short_run.observer_state)
    one = data.sel(joint=1, time=0.1, method="nearest").q.item()
    assert one == pytest.approx(float(short_run.q[100, 1]))
    attributes = data.attrs
    again = scenario_file.from_dict(tomllib.loads(attributes["scenario"])).scenario
    np.testing.assert_array_equal(ij.simulate(again, **SHORT).q, short_run.q)
    assert json.loads(attributes["parameters"])["plant.mass"] == [2.0, 0.85]
    assert attributes["iblf_jax_version"] == ij.__version__
    assert attributes["jax_version"] == jax.__version__ and attributes["status"] == "ok"


@pytest.mark.slow
def test_a_batch(paper):
    def one(gain):
        scenario = ij.with_parameters(paper, {"controller.K2": gain})
        return ij.simulate(scenario, duration=0.1, record_every=5, method="euler")

    batch = jax.vmap(one)(jnp.array([10.0, 20.0, 30.0]))
    data = batch.to_xarray()
    assert data.q.dims == ("run", "time", "joint") and data.rmse.dims == ("run", "joint")
    assert data.status.dims == ("run",) and list(data.status_words.values) == ["ok"] * 3
    np.testing.assert_array_equal(data["controller.K2"], [[10.0, 10.0], [20.0, 20.0], [30.0, 30.0]])
    assert "controller.K2" not in json.loads(data.attrs["parameters"])
    assert json.loads(data.attrs["parameters"])["plant.mass"] == [2.0, 0.85]
    xarray.testing.assert_equal(data.q.isel(run=1, drop=True), batch[1].to_xarray().q)


def test_metrics_laws_and_states_of_any_kind(short_run, tmp_path):
    """A metric with the name of a field, a law of a user, which is kept by its parameters, and
    states of any structure.  The digest knows values that are written in several ways: a NaN of the
    other sign, 64-bit integers and truth values are equal after a file of netCDF 3."""
    metrics = ij.Metrics({"V": jnp.array(3.0), "own": jnp.zeros(5)}, (("V", "J"), ("own", "s")))
    data = dataclasses.replace(short_run, metrics=metrics).to_xarray()
    assert data.V.dims == ("time",) and data.metric_V == 3.0
    assert data.metric_V.attrs["units"] == "J" and data.own.dims == ("own_axis_0",)
    law = ij.controllers.PDGravity
    mine = ij.component(type("Mine", (law,), {"__annotations__": {}}))(Kp=2.0, Kd=1.0)
    scenario = dataclasses.replace(short_run.scenario, controller=mine)
    attributes = dataclasses.replace(short_run, scenario=scenario).to_xarray().attrs
    assert "scenario" not in attributes and "Mine" in attributes["scenario_not_saved"]
    assert json.loads(attributes["parameters"])["controller.Kp"] == [2.0, 2.0]
    T = short_run.t.size
    state = {"weights": jnp.zeros((T, 3, 4)), "rest": (jnp.ones((T, 2)), jnp.ones(T))}
    run = dataclasses.replace(short_run, controller_state=state)
    data = run.to_xarray()
    assert data.controller_state_weights.shape == (T, 3, 4)
    assert data.controller_state_rest_0.dims == ("time", "joint")
    assert data.controller_state_rest_1.dims == ("time",)
    ij.save_rollouts(run, tmp_path / "a.nc")
    xarray.testing.assert_identical(load_datasets(tmp_path / "a.nc")["run"], data)
    values = short_run.metrics.values_by_name | {
        "many": jnp.arange(3),
        "is_so": jnp.array(True),
        "none": jnp.array([-jnp.nan, -0.0, jnp.inf]),
    }
    metrics = dataclasses.replace(short_run.metrics, values_by_name=values)
    run = dataclasses.replace(short_run, metrics=metrics)
    ij.save_rollouts(run, tmp_path / "a.nc")
    assert bool(load_datasets(tmp_path / "a.nc")["run"]["is_so"])


def test_bad_arguments_and_files(short_run, tmp_path):
    path = tmp_path / "a.nc"
    turned = r"path: got \w+, expected a path, after the runs.*save_rollouts\(runs, path\)"
    for runs, place, words in (
        (short_run, tmp_path / "a.csv", r"ends in \.nc"),
        *((runs, path, "dict of at least one Rollout") for runs in ({}, [short_run], None)),
        *(({x: short_run}, path, "name of a run") for x in ("a.b", "", "a/b", 3, "attributes")),
        ({"a": 3}, path, "expected a Rollout"),
        *((path, run, turned) for run in (short_run, {"a": short_run})),
    ):
        assert_refused(words, ij.save_rollouts, runs, place)
    assert_refused(r"ends in \.nc", load_datasets, tmp_path / "a")
    assert_refused("jit", jax.jit(lambda run: rollouts.rollout_to_xarray(run) and 0), short_run)
    for path in (tmp_path / "a.nc", tmp_path / "a.npz"):
        with pytest.raises(FileNotFoundError):
            load_datasets(path)
        for content in (b"", b"hello", b"CDF\x01" + bytes(40), b"PK\x03\x04"):
            path.write_bytes(content)
            assert_refused("expected a file written by save_rollouts", load_datasets, path)


@pytest.fixture(scope="module")
def stored(short_run, tmp_path_factory):
    """A netCDF file of two runs, and what it loads as."""
    path = tmp_path_factory.mktemp("stored") / "runs.nc"
    batch = jax.tree.map(lambda x: np.stack([x, x]), short_run)
    ij.save_rollouts({"one": short_run, "two runs": batch}, path)
    return path, load_datasets(path)


def _is_same(found, expected):
    if found.keys() != expected.keys():
        return False
    return all(
        found[name].identical(one)
        and all(found[name][label].dtype == x.dtype for label, x in one.variables.items())
        for name, one in expected.items()
    )


def _damage(content, rng, kind):
    """The content with one bit, one byte, a block of 64 bytes, or five bytes changed."""
    damaged, at = bytearray(content), int(rng.integers(len(content)))
    if kind == "bit":
        damaged[at] ^= 1 << int(rng.integers(8))
    elif kind == "byte":
        damaged[at] ^= int(rng.integers(1, 256))
    elif kind == "block":
        damaged[at : at + 64] = bytes(len(damaged[at : at + 64]))
    else:
        for place in rng.integers(len(content), size=5):
            damaged[int(place)] ^= 0xFF
    return bytes(damaged)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("kind", ["bit", "byte", "block", "five"])
def test_a_damaged_netcdf_file_is_refused_or_loads_as_it_was(kind, stored, rng, tmp_path):
    path, expected = stored
    content, refused = path.read_bytes(), 0
    for _ in range(25):
        (tmp_path / "damaged.nc").write_bytes(_damage(content, rng, kind))
        try:
            found = load_datasets(tmp_path / "damaged.nc")
        except ValueError:
            refused += 1
            continue
        assert _is_same(found, expected)
    assert refused > 16  # a few of the bytes are padding


def test_an_edited_file_is_refused_unless_it_has_no_digest(stored, tmp_path):
    """Files of older versions have none, nor has a Dataset that a user edits and saves."""
    path, expected = stored
    assert not any("digest" in one.attrs for one in expected.values())
    data = xarray.load_dataset(path, engine="scipy")
    data["one.q"][3, 1] += 1e-9
    data.to_netcdf(tmp_path / "edited.nc", engine="scipy")
    with pytest.raises(ValueError, match=r"edited.nc.*variable q of run 'one'.*'digest'") as caught:
        load_datasets(tmp_path / "edited.nc")
    assert "variable dq" not in str(caught.value)
    del data.attrs["digest"]
    data.to_netcdf(tmp_path / "edited.nc", engine="scipy")
    found = load_datasets(tmp_path / "edited.nc")
    np.testing.assert_array_equal(found["one"].q, data["one.q"])
    assert _is_same({"two runs": found["two runs"]}, {"two runs": expected["two runs"]})


def test_signals_of_levels_have_dimensions_and_units_also_in_a_file(tmp_path):
    levels_run = ij.simulate(pendulum(), duration=0.2, dt=1e-3)
    data = levels_run.to_xarray()
    for ending in (".nc", ".npz"):
        ij.save_rollouts(levels_run, tmp_path / f"run{ending}")
        assert load_datasets(tmp_path / f"run{ending}")["run"].identical(data)
    assert data.disturbance.dims == ("time", "level", "joint")
    assert data.disturbance.attrs["units"] == "rad/s; rad/s^2; A/s"
    assert data.x.dims == ("time", "level", "joint") and data.x.attrs["units"] == "rad; rad/s; A"
    assert data.tau.attrs == {"units": "V", "description": "input: input"}
    assert data.level_margin.dims == ("higher_level", "joint")
    assert data.estimate_rmse.dims == ("level", "joint")
    assert np.array_equal(data.level, [1, 2, 3]) and np.array_equal(data.higher_level, [3])
    assert data.level.attrs["description"] == "level of the plant, from 1: angle, speed, current"
    assert data.joint.attrs["description"] == "component of a level, from 0: pendulum"


@pytest.mark.slow
def test_components_of_different_units_and_estimated_levels_with_rows_of_the_model(tmp_path):
    data = ij.simulate(body(), duration=0.1, dt=1e-2).to_xarray()
    assert data.q.attrs == {"units": "m, m, rad", "description": "pose"}
    assert data.margin.attrs["units"] == "m, m, rad"
    plant = rigid_law().plant
    scenario = rigid_law(model=plant.rigid(), observer=ij.observers.StateObserver(bandwidth=100.0))
    run = ij.simulate(scenario, duration=0.02, dt=1e-3)
    data = run.to_xarray()
    assert data.x.sizes == {"time": 21, "level": 4, "joint": 2}
    assert data.x_hat.sizes == {"time": 21, "model_level": 2, "joint": 2}
    assert data.peak_level_error.dims == ("model_level", "joint")
    assert np.array_equal(data.model_level, [1, 2])
    ij.save_rollouts(run, tmp_path / "run.nc")
    assert np.array_equal(load_rollouts(tmp_path / "run.nc").x_hat, run.x_hat)
