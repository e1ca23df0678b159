"""The commands `montecarlo` and `sweep`, and the files that describe studies."""

from __future__ import annotations

import signal
import tomllib

import numpy as np
import pytest
import study_cases as cases

import iblf_jax as ij
from iblf_jax import cli, study_file
from iblf_jax.studies import store

STUDY = """
preset = "zhang_yan_2024"
[run]
duration = 0.02
method = "euler"
[perturbations]
"plant.mass[1]" = { factor = "normal", mean = 1.0, std = 0.1 }
initial.q = { offset = "normal", std = 0.05 }
[study]
runs = 300
seed = 3
"""
SWEEP = (
    STUDY.replace("[study]", "[sweep]")
    + """
unit = 256
[grid]
"controller.K2" = [10.0, 20.0, 40.0]
observer.kf = [10.0, 20.0]
"""
)
CALM = SWEEP.replace("std = 0.05", "std = 0.001").replace("300", "3")


@pytest.fixture
def command(capsys, monkeypatch, tmp_path):
    """Runs the CLI in a folder of its own; returns exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name, text in (("study.toml", STUDY), ("sweep.toml", SWEEP), ("calm.toml", CALM)):
        (tmp_path / name).write_text(text)

    def call(*argv: str) -> tuple[int, str, str]:
        code = cli.main(argv)
        return code, *capsys.readouterr()

    return call


def test_files_are_the_arguments_of_the_functions():
    file = study_file.study_from_dict(tomllib.loads(SWEEP), "sweep")
    assert file.options == {"duration": 0.02, "method": "euler", "runs": 300, "seed": 3, "unit": 256}
    assert file.grid == {"controller.K2": [10.0, 20.0, 40.0], "observer.kf": [10.0, 20.0]}
    expected = cases.perturbations()
    assert list(file.perturbations) == list(expected)
    for path, found in file.perturbations.items():
        assert found.kind == expected[path].kind
        np.testing.assert_allclose(
            found.distribution.quantile(np.array([0.1, 0.7])), expected[path].distribution.quantile(np.array([0.1, 0.7]))
        )


def test_montecarlo(command, tmp_path):
    code, out, err = command("montecarlo", "study.toml", "--out", "runs.nc", "--quiet")
    assert code == 1, err
    for word in ("300 runs", "95% interval", "worst runs", "rank correlation", "plant.mass[1]", "initial.q[1]", "settling_time"):
        assert word in out
    xarray = pytest.importorskip("xarray")
    data = xarray.load_dataset(tmp_path / "runs.nc", engine="scipy")
    study = cases.study(300, metrics=None)
    np.testing.assert_array_equal(data.margin, study.metrics.margin)
    assert f"failed: {len(study.failed)}" in out


def test_sweep_and_again(command):
    code, out, err = command("sweep", "sweep.toml", "--store", "s.zarr", "--quiet")
    assert code == 1, err
    assert "1800 runs" in out
    assert out.count(" of 300") == 6
    code, again, _ = command("sweep", "sweep.toml", "--store", "s.zarr", "--quiet", "--out", "s.nc")
    assert again.startswith(out.rstrip())
    code, _, err = command("sweep", "calm.toml", "--store", "s.zarr", "--quiet")
    assert code == 2
    assert "runs: the store has 300, this call 3" in err
    assert err.count("\n") == 1


def test_every_run_ok_is_zero_interrupted_is_130_and_full_is_3(command, monkeypatch):
    assert command("sweep", "calm.toml", "--quiet")[0] == 0
    plain = store.Store.write

    def stop(self, unit, data):
        signal.raise_signal(signal.SIGINT)
        plain(self, unit, data)

    monkeypatch.setattr(store.Store, "write", stop)
    code, _, err = command("sweep", "sweep.toml", "--store", "s.zarr", "--quiet")
    assert code == 130
    assert "after 1 of 8 units" in err
    assert "Start the same call or command again" in err

    def full(self, unit, data):
        raise store.StoreWriteError("no space left")

    monkeypatch.setattr(store.Store, "write", full)
    code, _, err = command("sweep", "sweep.toml", "--store", "s.zarr", "--quiet")
    assert (code, err) == (3, "iblf-jax: error: no space left\n")


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        ("study", ("[study]", "[sweep]"), "sweep: got an unknown key"),
        ("study", ("runs = 300", "runs = 300.0"), "study.runs"),
        ("study", ("runs = 300", "rums = 300"), "study.rums"),
        ("study", ("duration = 0.02", ""), "run.duration"),
        ("study", ('method = "euler"', "record_every = 2"), "run.record_every"),
        ("study", ("factor =", "facto ="), "perturbations.plant.mass"),
        ("study", ('"normal", std', '"norml", std'), "Did you mean normal"),
        ("study", ("std = 0.1 }", "sdt = 0.1 }"), "sdt"),
        ("study", ("std = 0.1 }", "std = -0.1 }"), "perturbations.plant.mass.*std"),
        ("study", ("std = 0.1 }", 'std = 0.1, offset = "normal" }'), "factor and offset"),
        ("study", ("std = 0.1 }", "std = 0.1, shared = 1 }"), "shared"),
        ("study", ('factor = "normal", mean = 1.0, std = 0.1', 'factor = "uniform", low = 1.0'), "high"),
        ("sweep", ("[10.0, 20.0, 40.0]", '["a"]'), "grid.controller.K2"),
        ("sweep", ("unit = 256", "unit = true"), "sweep.unit"),
    ],
)
def test_bad_files_are_refused(kind, change, message, tmp_path):
    text = STUDY if kind == "study" else SWEEP
    assert change[0] in text
    path = tmp_path / "bad.toml"
    path.write_text(text.replace(*change))
    with pytest.raises(ValueError, match=rf"bad.toml: .*{message}"):
        study_file.load_study_file(path, kind)


@pytest.mark.parametrize(
    "words",
    [
        ("montecarlo", "nothing.toml"),
        ("montecarlo", "study.toml", "--out", "runs.csv"),
        ("montecarlo", "study.toml", "--runs", "0"),
        ("montecarlo", "study.toml", "--chunk", "0"),
        ("sweep", "sweep.toml", "--coordinator", "localhost:1"),
        ("sweep", "study.toml"),
    ],
)
def test_bad_commands_end_with_2_and_one_line(command, words):
    code, _, err = command(*words)
    assert code == 2
    assert err.count("\n") == 1


def test_ij_names_are_there():
    names = ("monte_carlo", "sweep", "load_sweep", "sensitivity", "Study", "StoreError", "uniform", "normal", "log_uniform", "choice")
    assert all(hasattr(ij, name) for name in (*names, "factor", "offset", "value", "distributed"))
