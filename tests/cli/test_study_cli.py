"""The commands `montecarlo` and `sweep`, and the files that describe studies."""

import os
import re
import signal
import sys
import time
import tomllib

import jax
import numpy as np
import pytest
import study_cases as cases
from refused import assert_refused

import iblf_jax as ij
from iblf_jax import cli
from iblf_jax.cli import _studies
from iblf_jax.files import study as study_file
from iblf_jax.files.tuning import load_tuning_file
from iblf_jax.studies import distributions, store

STUDY, SWEEP = cases.STUDY, cases.SWEEP
CALM = SWEEP.replace("std = 0.05", "std = 0.001").replace("300", "3")


@pytest.fixture
def command(capsys, monkeypatch, tmp_path):
    """Runs the CLI in a folder of its own; returns exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    for name, text in (("study.toml", STUDY), ("sweep.toml", SWEEP), ("calm.toml", CALM)):
        (tmp_path / name).write_text(text)

    def call(*argv: str) -> tuple[int, str, str]:
        code = cli.main(argv)
        return code, *capsys.readouterr()

    return call


def test_files_are_the_arguments_of_the_functions():
    file = study_file.study_from_dict(tomllib.loads(SWEEP), "sweep")
    expected = {"duration": 0.02, "method": "euler", "runs": 300, "seed": 3, "unit": 256}
    assert file.options == expected
    assert file.grid == {"controller.K2": [10.0, 20.0, 40.0], "observer.kf": [10.0, 20.0]}
    assert list(file.perturbations) == list(cases.perturbations())


@pytest.mark.slow
def test_montecarlo(command, tmp_path):
    code, out, err = command("montecarlo", "study.toml", "--out", "runs.nc", "--quiet")
    assert code == 1, err
    words = ("300 runs", "95% interval", "worst runs", "rank correlation")
    for word in (*words, "plant.mass[1]", "initial.q[1]", "settling_time"):
        assert word in out
    xarray = pytest.importorskip("xarray")
    data = xarray.load_dataset(tmp_path / "runs.nc", engine="scipy")
    study = cases.study(300, metrics=None)
    np.testing.assert_array_equal(data.margin, study.metrics.margin)
    assert f"failed: {len(study.failed)}" in out


@pytest.mark.slow
def test_sweep_and_again(command):
    code, out, err = command("sweep", "sweep.toml", "--store", "s.zarr", "--quiet")
    assert code == 1, err
    assert "1800 runs" in out and out.count(" of 300") == 6
    code, again, _ = command("sweep", "sweep.toml", "--store", "s.zarr", "--quiet", "--out", "s.nc")
    assert again.startswith(out.rstrip())
    code, _, err = command("sweep", "calm.toml", "--store", "s.zarr", "--quiet")
    assert code == 2 and "runs: the store has 300, this call 3" in err
    assert err.count("\n") == 1


@pytest.mark.slow
def test_every_run_ok_is_zero_interrupted_is_130_and_full_is_3(command, monkeypatch):
    assert command("sweep", "calm.toml", "--quiet")[0] == 0
    write = store.Store.write

    def stop(self, unit, data):
        signal.raise_signal(signal.SIGINT)
        write(self, unit, data)

    monkeypatch.setattr(store.Store, "write", stop)
    code, _, err = command("sweep", "sweep.toml", "--store", "s.zarr", "--quiet")
    assert code == 130 and "after 1 of 8 units" in err
    assert "Start the same call or command again" in err

    def full(self, unit, data):
        raise store.StoreWriteError("no space left")

    monkeypatch.setattr(store.Store, "write", full)
    code, _, err = command("sweep", "sweep.toml", "--store", "s.zarr", "--quiet")
    assert (code, err) == (3, "iblf-jax: error: no space left\n")


@pytest.mark.slow
def test_ctrl_c_from_outside(command, tmp_path, compiled):
    """As a user does it: a process, SIGINT after its first unit, the same command again."""
    text = SWEEP.replace("300", "2000")
    (tmp_path / "sweep.toml").write_text(text)
    words = ("sweep", "sweep.toml", "--store", "s.zarr", "--quiet")
    process = cases.start_python(compiled, "-m", "iblf_jax", *words)
    while not (tmp_path / "s.zarr/done/c/0").exists() and process.poll() is None:
        time.sleep(0.001)
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, ""), errors
    assert re.search(r"Stopped after \d+ of 47 units.*Start the same call or command again", errors)
    assert "Traceback" not in errors
    assert 0 < ij.load_sweep("s.zarr").attrs["computed_cases"] < 12000
    assert command(*words)[0] == 1 and ij.load_sweep("s.zarr").identical(cases.from_file(text))


@pytest.mark.slow
def test_ctrl_c_while_a_study_compiles(command, tmp_path):
    """XLA goes on in a thread of its own, and would crash if JAX were taken down under it."""
    code = """
import os, signal, sys, threading, jax
from iblf_jax import cli
from iblf_jax.cli import _studies
from iblf_jax.studies import monte_carlo

def compile_for_long(*_, **__):
    def f(x):
        for i in range(2000):
            x = jax.numpy.sin(x + i)
        return x
    lowered = jax.jit(f).lower(1.0)
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
    lowered.compile()

monte_carlo.monte_carlo = compile_for_long
sys.argv[1:] = ["montecarlo", "study.toml"]
cli.entry()
"""
    # As users compile: at the tests' own settings it could be over before the signal comes.
    process = cases.start_python(
        tmp_path / "nothing_compiled", "-c", code, XLA_FLAGS=os.environ["TESTER_XLA_FLAGS"]
    )
    assert process.communicate(timeout=60) == ("", "iblf-jax: error: interrupted\n")
    assert process.returncode == 130


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        ("study", ("[study]", "[sweep]"), "sweep: got a table, expected none in a file"),
        ("study", ("runs = 300", "rums = 300"), "study.rums"),
        ("study", ("duration = 0.02", ""), "run.duration"),
        ("study", ('method = "euler"', "record_every = 2"), "run.record_every"),
        ("study", ("factor =", "facto ="), "perturbations.plant.mass"),
        ("study", ("std = 0.1 }", "sdt = 0.1 }"), "sdt"),
        ("study", ("std = 0.1 }", 'std = 0.1, offset = "normal" }'), "factor and offset"),
        ("study", ("std = 0.1 }", "std = 0.1, shared = 1 }"), "shared"),
        ("study", ('"normal", mean = 1.0, std = 0.1', '"uniform", low = 1.0'), "high"),
        ("sweep", ("[10.0, 20.0, 40.0]", '["a"]'), "grid.controller.K2"),
    ],
)
def test_bad_files_are_refused(kind, change, message, tmp_path):
    text = STUDY if kind == "study" else SWEEP
    assert change[0] in text
    path = tmp_path / "bad.toml"
    path.write_text(text.replace(*change))
    assert_refused(rf"bad.toml: .*{message}", study_file.load_study_file, path, kind)


PERTURBATIONS = """
[perturbations]
"plant.mass[1]" = { factor = "uniform", low = 0.7, high = 1.3 }
initial.q = { offset = "normal", std = 0.02, shared = true }
"plant.payload" = { value = "choice", values = [0.0, 0.5], weights = [3.0, 1.0] }
disturbance.phase = { value = "log_uniform", low = 0.1, high = 6.28 }
"""
HEADS = {
    "study": "[study]\nruns = 2",
    "sweep": "[sweep]",
    "tune": '[tune]\nparameters = ["controller.k1"]\n[[objective]]\nkind = "tracking"',
}


def perturbations_in(kind, perturbations, path):
    head = 'preset = "zhang_yan_2024"\n[run]\nduration = 0.01\n'
    path.write_text(f"{head}{perturbations}\n{HEADS[kind]}\n")
    if kind == "tune":
        return load_tuning_file(path)["perturbations"]
    return study_file.load_study_file(path, kind).perturbations


def test_one_table_of_perturbations_serves_every_file_and_the_api(tmp_path):
    expected = {
        "plant.mass[1]": ij.factor(ij.uniform(0.7, 1.3)),
        "initial.q": ij.offset(ij.normal(std=0.02), shared=True),
        "plant.payload": ij.value(ij.choice([0.0, 0.5], [3.0, 1.0])),
        "disturbance.phase": ij.value(ij.log_uniform(0.1, 6.28)),
    }
    nested = "[perturbations]\nplant.mass = { factor = { uniform = [0.7, 1.3] } }"
    words = r"file.toml: perturbations.plant.mass.*distribution. There are: .*uniform"
    for kind in HEADS:
        found = perturbations_in(kind, PERTURBATIONS, tmp_path / "file.toml")
        assert list(found) == list(expected)
        assert jax.tree.structure(found) == jax.tree.structure(expected)
        jax.tree.map(np.testing.assert_array_equal, found, expected)
        assert_refused(words, perturbations_in, kind, nested, tmp_path / "file.toml")


def test_a_distribution_of_ones_own_is_named_in_files(tmp_path, monkeypatch):
    uniform = type(ij.uniform(1.0, 2.0))
    own = ij.component(type("Own", (uniform,), {"__annotations__": {}}))
    monkeypatch.setitem(distributions.MEMBERS, "own", own)
    text = '[perturbations]\nplant.mass = { factor = "own", low = 1, high = 2 }'
    (found,) = perturbations_in("tune", text, tmp_path / "a").values()
    assert isinstance(found.distribution, own) and found.kind == "factor"


def test_bad_options_end_with_2_and_one_line(command):
    for option in ("--devices 200", "--chunk 0", "--out runs.csv"):
        code, _, err = command(*f"montecarlo study.toml {option}".split())
        assert (code, err.count("\n")) == (2, 1), option


@pytest.mark.parametrize("installed", [True, False])
def test_an_unreachable_scheduler_ends_with_2_and_one_line(command, monkeypatch, installed):
    if installed:
        pytest.importorskip("distributed")
        monkeypatch.setattr(_studies, "DASK_TIMEOUT", 0.5)
    else:
        monkeypatch.setitem(sys.modules, "distributed", None)
    code, _, err = command("sweep", "sweep.toml", "--dask", "tcp://127.0.0.1:1")
    assert code == 2
    assert ("127.0.0.1:1" in err) if installed else ("pip install distributed" in err)
    assert err.count("iblf-jax: error") == 1
