"""Runs as xarray Datasets, and the files that hold them."""

from __future__ import annotations

import dataclasses
import json
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w
import xarray
from conftest import SHORT
from made_up_runs import ALWAYS

import iblf_jax as ij
from iblf_jax.files import rollouts
from iblf_jax.files import scenario as scenario_file
from iblf_jax.files.rollouts import load_datasets
from iblf_jax.simulation.signals import VIEWS


@pytest.fixture(scope="module")
def batch(paper) -> ij.Rollout:
    def one(gain):
        return ij.simulate(
            ij.with_parameters(paper, {"controller.K2": gain}),
            duration=0.1,
            record_every=5,
            method="euler",
        )

    return jax.vmap(one)(jnp.array([10.0, 20.0, 30.0]))


def test_one_run(short_run):
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
        assert variable.attrs["units"]
        assert variable.attrs["description"]
    np.testing.assert_array_equal(data.observer_state, short_run.observer_state)
    assert data.sel(joint=1, time=0.1, method="nearest").q.item() == pytest.approx(
        float(short_run.q[100, 1])
    )


def test_the_run_can_be_done_again_from_its_attributes(short_run):
    attributes = short_run.to_xarray().attrs
    again = scenario_file.from_dict(tomllib.loads(attributes["scenario"])).scenario
    np.testing.assert_array_equal(ij.simulate(again, **SHORT).q, short_run.q)
    assert json.loads(attributes["parameters"])["plant.mass"] == [2.0, 0.85]
    assert attributes["iblf_jax_version"] == ij.__version__
    assert attributes["jax_version"] == jax.__version__
    assert attributes["status"] == "ok"


@pytest.mark.slow
def test_a_batch(batch):
    data = batch.to_xarray()
    assert data.q.dims == ("run", "time", "joint")
    assert data.rmse.dims == ("run", "joint")
    assert data.status.dims == ("run",)
    assert list(data.status_words.values) == ["ok"] * 3
    np.testing.assert_array_equal(data["controller.K2"], [[10.0, 10.0], [20.0, 20.0], [30.0, 30.0]])
    assert "controller.K2" not in json.loads(data.attrs["parameters"])
    assert json.loads(data.attrs["parameters"])["plant.mass"] == [2.0, 0.85]
    xarray.testing.assert_equal(data.q.isel(run=1, drop=True), batch[1].to_xarray().q)


@pytest.mark.slow
def test_batches_of_batches_and_of_different_steps(batch):
    runs = jax.tree.map(lambda x: jnp.stack([x, x]), batch)
    t = runs.t * jnp.array([[1.0], [2.0], [3.0]])
    assert runs.to_xarray().q.dims == ("run_0", "run_1", "time", "joint")
    data = dataclasses.replace(runs, t=t).to_xarray()
    assert data.t.dims == ("run_0", "run_1", "time")
    np.testing.assert_array_equal(data.t, t)


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".NC", ".npz"])
def test_files_give_the_same_datasets_back(ending, short_run, batch, tmp_path):
    runs = {"integral BLF": short_run, "b-2": batch}
    ij.save_rollouts(runs, tmp_path / f"runs{ending}")
    found = load_datasets(tmp_path / f"runs{ending}")
    assert list(found) == list(runs)
    for name, run in runs.items():
        xarray.testing.assert_identical(found[name], run.to_xarray())


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".nc", ".npz"])
def test_batches_of_earlier_versions_load(ending, paper, tmp_path):
    """Bounds of velocities had a field of their own; two bounds differ between the runs."""
    speeds = ij.Bounds(lower=ij.bounds.Constant(-9.0), upper=ij.bounds.Constant(9.0))
    scenario = ij.with_parts(paper, bounds=(paper.bounds[0], speeds))

    def one(x):
        changes = {"bounds[0].upper.offset": 0.9 + x, "bounds[1].upper.value": 8.0 + x}
        changed = ij.with_parameters(scenario, changes)
        return ij.simulate(changed, duration=0.01, record_every=5, method="euler")

    batch = jax.vmap(one)(jnp.array([0.0, 0.1]))
    names = {
        "bounds[0].upper.offset": "bounds.upper.offset",
        "bounds[1].upper.value": "velocity_bounds.upper.value",
    }
    data = batch.to_xarray().rename(names)
    tables = tomllib.loads(data.attrs["scenario"])
    tables["bounds"], tables["velocity_bounds"] = tables["bounds"]
    data.attrs["scenario"] = tomli_w.dumps(tables)
    write = {".nc": rollouts._write_netcdf, ".npz": rollouts._write_npz}[ending]
    write(tmp_path / f"old{ending}", {"run": data})
    loaded = ij.load(tmp_path / f"old{ending}")
    assert jax.tree.structure(loaded.scenario) == jax.tree.structure(batch.scenario)
    jax.tree.map(np.testing.assert_array_equal, loaded.scenario, batch.scenario)
    np.testing.assert_array_equal(loaded.q, batch.q)


def test_states_of_any_structure(short_run, tmp_path):
    T = short_run.t.size
    state = {"weights": jnp.zeros((T, 3, 4)), "rest": (jnp.ones((T, 2)), jnp.ones(T))}
    run = dataclasses.replace(short_run, controller_state=state)
    data = run.to_xarray()
    assert data.controller_state_weights.shape == (T, 3, 4)
    assert data.controller_state_rest_0.dims == ("time", "joint")
    assert data.controller_state_rest_1.dims == ("time",)
    ij.save_rollouts(run, tmp_path / "a.nc")
    xarray.testing.assert_identical(load_datasets(tmp_path / "a.nc")["run"], data)


def test_metrics_with_the_name_of_a_field(short_run):
    metrics = ij.Metrics({"V": jnp.array(3.0), "own": jnp.zeros(5)}, (("V", "J"), ("own", "s")))
    data = dataclasses.replace(short_run, metrics=metrics).to_xarray()
    assert data.V.dims == ("time",)
    assert data.metric_V == 3.0
    assert data.metric_V.attrs["units"] == "J"
    assert data.own.dims == ("own_axis_0",)


def test_a_users_law_is_kept_by_its_parameters(short_run):
    @ij.component
    class Mine:
        gain: jax.Array = ij.leaf("1")

        def init(self, q, dq, context):
            return ()

        def command(self, t, q, dq, f_hat, context, state):
            raise NotImplementedError

    run = dataclasses.replace(
        short_run, scenario=dataclasses.replace(short_run.scenario, controller=Mine(2.0))
    )
    attributes = run.to_xarray().attrs
    assert "scenario" not in attributes
    assert "Mine" in attributes["scenario_not_saved"]
    assert json.loads(attributes["parameters"])["controller.gain"] == [2.0, 2.0]


def test_bad_arguments(short_run, tmp_path):
    with pytest.raises(ValueError, match=r"ends in \.nc"):
        ij.save_rollouts(short_run, tmp_path / "a.csv")
    with pytest.raises(ValueError, match=r"ends in \.nc"):
        load_datasets(tmp_path / "a")
    for runs in ({}, [short_run], None):
        with pytest.raises(ValueError, match="dict of at least one Rollout"):
            ij.save_rollouts(runs, tmp_path / "a.nc")  # type: ignore[arg-type]
    for name in ("a.b", "", "a/b", 3, "attributes"):
        with pytest.raises(ValueError, match="name of a run"):
            ij.save_rollouts({name: short_run}, tmp_path / "a.nc")  # type: ignore[dict-item]
    with pytest.raises(ValueError, match="expected a Rollout"):
        ij.save_rollouts({"a": 3}, tmp_path / "a.nc")  # type: ignore[dict-item]
    for runs in (short_run, {"a": short_run}):
        with pytest.raises(
            ValueError,
            match=r"path: got \w+, expected a path, after the runs.*save_rollouts\(runs, path\)",
        ):
            ij.save_rollouts(tmp_path / "a.nc", runs)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="jit"):
        jax.jit(lambda run: rollouts.rollout_to_xarray(run) and 0)(short_run)


@pytest.mark.parametrize("ending", ["nc", "npz"])
def test_bad_files(ending, tmp_path):
    path = tmp_path / f"a.{ending}"
    with pytest.raises(FileNotFoundError):
        load_datasets(path)
    for content in (b"", b"hello", b"CDF\x01" + bytes(40), b"PK\x03\x04"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="expected a file written by save_rollouts"):
            load_datasets(path)


@pytest.fixture(scope="module")
def stored(short_run, tmp_path_factory):
    """A netCDF file of two runs, and what it loads as."""
    path = tmp_path_factory.mktemp("stored") / "runs.nc"
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), short_run)
    ij.save_rollouts({"one": short_run, "two runs": batch}, path)
    return path, load_datasets(path)


def _is_same(found, expected):
    if found.keys() != expected.keys():
        return False
    types = all(
        found[name][label].dtype == x.dtype
        for name, one in expected.items()
        for label, x in one.variables.items()
    )
    return types and all(found[name].identical(one) for name, one in expected.items())


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


def test_the_error_for_a_damaged_file_names_variable_and_remedy(stored, tmp_path):
    path, _ = stored
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


def test_files_without_a_digest_load_and_datasets_carry_none(stored, tmp_path):
    """Files of older versions have none; a Dataset that a user edits and saves must not hold one
    that has become stale."""
    path, expected = stored
    older = xarray.load_dataset(path, engine="scipy")
    assert "digest" in older.attrs
    del older.attrs["digest"]
    older.to_netcdf(tmp_path / "older.nc", engine="scipy")
    assert _is_same(load_datasets(tmp_path / "older.nc"), expected)
    assert not any("digest" in one.attrs for one in expected.values())


def test_a_digest_knows_values_that_are_written_in_several_ways(short_run, tmp_path):
    """A NaN of the other sign, 64-bit integers and truth values are equal after a file of netCDF
    3."""
    values = short_run.metrics.values_by_name | {
        "many": jnp.arange(3),
        "is_so": jnp.array(True),
        "none": jnp.array([-jnp.nan, -0.0, jnp.inf]),
    }
    run = dataclasses.replace(
        short_run, metrics=dataclasses.replace(short_run.metrics, values_by_name=values)
    )
    ij.save_rollouts(run, tmp_path / "a.nc")
    assert bool(load_datasets(tmp_path / "a.nc")["run"]["is_so"])
