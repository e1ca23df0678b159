"""Programs that a later process reads: the same bits, and no trace."""

import contextlib
import os
import pickle
import subprocess
import sys

import jax
import numpy as np
import pytest

from iblf_jax.core import kept_programs

LISTEN = """
import hashlib
import numpy as np
import jax
jax.config.update("jax_enable_x64", True)
traced = set()
def listen(event, seconds, **of):
    if event.endswith("jaxpr_trace_duration"):
        traced.add(of.get("fun_name"))
jax.monitoring.register_event_duration_secs_listener(listen)
import iblf_jax as ij
def digest(tree):
    content = b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(tree))
    return hashlib.sha256(content).hexdigest()
@ij.component
class Users(ij.disturbances.Disturbance):
    def torque(self, t, q, dq, plant, model):
        return -20.0 * q
    def jump_times(self):
        return jax.numpy.zeros(0)
paper = ij.presets.zhang_yan_2024()
def printed(cases, value, functions):
    for case in cases:
        traced.clear()
        print(value(case), *sorted(functions & traced), sep=",")
"""
RUN = """
run = lambda scenario: digest(ij.simulate(scenario, duration=0.05, dt=1e-3))
printed([paper], run, {"_initial_values", "_initialize", "_all_steps", "_finalize"})
"""
RADII = """
from iblf_jax.engine.period import radius_at
from iblf_jax.simulation.scenario import canonical
sampled = ij.with_parts(paper, sampling=ij.Sampling(period=1e-3))
cases = [
    sampled,
    ij.with_parts(paper, sampling=ij.Sampling(period=1e-3, observer="euler")),
    ij.with_parameters(sampled, {"controller.weight": 0.5}),
    ij.with_parts(sampled, disturbance=Users()),
]
radius = lambda scenario: radius_at(canonical(scenario), 2e-3, np.zeros(0)).hex()
printed(cases, radius, {"_maps", "_sampled_jacobians", "_sampled_states"})
"""
"""The second loop differs from the first one in a static field, the third one in a constant that is
compiled in, and the fourth one has code of a user."""
STUDIES = """
users = ij.with_parts(paper, disturbance=Users())
cases = [
    (paper, {"plant.mass[1]": ij.factor(ij.uniform(0.9, 1.1))}),
    (paper, {"plant.mass[0]": ij.factor(ij.uniform(0.9, 1.1))}),
    (users, {"plant.mass[1]": ij.factor(ij.uniform(0.9, 1.1))}),
]
def results(case):
    study = ij.monte_carlo(*case, runs=4, duration=0.02, dt=1e-3, progress=False)
    bands = study.bands(samples=10)
    metrics = list(study.metrics.values())
    return digest((metrics, study.samples, study.status, bands.q.values, bands.time.values))
printed(cases, results, {"_execute"})
"""
"""The second study draws another parameter, and the third one has code of a user."""
TUNE = """
goal = ij.objectives.tracking(scale=1.0) + 0.3 * ij.objectives.effort(scale=1.0)
sampled = ij.with_parts(paper, sampling=ij.Sampling(period=2e-3))
effort = ij.tuning.Effort(values=4, starts=2, iterations=2)
cases = [
    (sampled, "controller.K2"),
    (ij.with_parameters(sampled, {"controller.k1": 3.0}), "controller.K2"),
    (sampled, "controller.K2[0]"),
]
def tuned(case):
    scenario, path = case
    options = {"duration": 0.04, "dt": 2e-3, "effort": effort, "progress": False}
    best = ij.tune(scenario, [path], goal, **options)
    return digest((best.values, best.objective, best.report.peak_torque))
names = {"forward_derivatives", "_initialize", "_all_steps", "_finalize"}
printed(cases, tuned, names)
"""
"""The second case has other numbers, and the third one tunes another part of the leaf."""


def printed(script, folder, *, kept=True, **variables):
    """What a script prints in a process of its own: values, and what was traced for each."""
    environment = os.environ | {"XDG_CACHE_HOME": str(folder), **variables}
    environment["JAX_ENABLE_COMPILATION_CACHE"] = str(int(kept))
    command = [sys.executable, "-c", LISTEN + script]
    found = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    rows = [line.split(",") for line in found.stdout.splitlines()]
    return [row[0] for row in rows], [row[1:] for row in rows]


def damage(folder):
    """Changes a bit of every entry, and returns how many there are."""
    entries = sorted((folder / "iblf_jax").glob("*.program"))
    for entry in entries:
        content = bytearray(entry.read_bytes())
        content[len(content) // 2] ^= 1
        entry.write_bytes(content)
    return len(entries)


@pytest.mark.slow
def test_a_second_process_traces_nothing_and_a_damaged_entry_is_made_again(tmp_path):
    everything = ["_all_steps", "_finalize", "_initial_values", "_initialize"]
    digest, traced = printed(RUN, tmp_path)
    assert traced == [everything]
    assert printed(RUN, tmp_path) == (digest, [[]])
    # Other options are another environment.
    assert printed(RUN, tmp_path, IBLF_JAX_THREADS="3") == (digest, traced)
    assert damage(tmp_path) == 10
    assert printed(RUN, tmp_path) == (digest, traced)
    # Without its kernels, a program is compiled again.
    for kernel in (tmp_path / "iblf_jax").glob("*.so"):
        kernel.unlink()
    found, (traced,) = printed(RUN, tmp_path)
    assert found == digest
    assert "_all_steps" in traced


LOOP = ["_maps", "_sampled_jacobians", "_sampled_states"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "first", "again"),
    [
        # Only the kernel of the Jacobians depends on the constants that are compiled in.
        (RADII, [LOOP, LOOP, ["_sampled_jacobians"], LOOP], [[], [], [], LOOP]),
        (STUDIES, [["_execute"]] * 3, [[], [], ["_execute"]]),
    ],
    ids=["the search for a period", "a study and its bands"],
)
def test_programs_are_read_and_a_damaged_entry_is_made_again(script, first, again, tmp_path):
    expected, traced = printed(script, tmp_path, kept=False)
    assert len(set(expected)) == len(first)
    assert traced == first
    assert printed(script, tmp_path) == (expected, traced)
    assert printed(script, tmp_path) == (expected, again)
    assert damage(tmp_path)
    assert printed(script, tmp_path) == (expected, traced)


@pytest.mark.slow
def test_a_tuning_reads_its_programs(tmp_path):
    expected, traced = printed(TUNE, tmp_path, kept=False)
    assert len(set(expected)) == 3
    assert traced[:2] == [["_all_steps", "_finalize", "_initialize", "forward_derivatives"], []]
    assert "forward_derivatives" in traced[2]
    assert printed(TUNE, tmp_path) == (expected, traced)
    assert printed(TUNE, tmp_path) == (expected, [[]] * 3)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "iblf_jax"


def test_a_value_is_read_under_its_own_key(folder, monkeypatch):
    kept_programs.keep("one", (1, 2.0))
    assert kept_programs.read("one") == (1, 2.0)
    assert kept_programs.read("other") is None
    # Two keys of one file: the entry says whose it is.
    monkeypatch.setattr(
        kept_programs, "cache_path", lambda content, suffix: next(folder.glob(f"*{suffix}"))
    )
    assert kept_programs.read("other") is None
    assert kept_programs.read("one") == (1, 2.0)


def test_a_damaged_value_is_not_read(folder):
    kept_programs.keep("one", (1, 2.0))
    (entry,) = folder.glob("*.program")
    content = entry.read_bytes()
    for damaged in (b"", content[:-1], content[:5] + b"x" + content[6:], pickle.dumps(("one", 3))):
        entry.write_bytes(damaged)
        assert kept_programs.read("one") is None
    kept_programs.keep("one", (1, 2.0))
    assert kept_programs.read("one") == (1, 2.0)


def test_a_program_that_falls_back_is_not_kept(folder, monkeypatch):
    monkeypatch.setattr(kept_programs, "key_of", str)
    monkeypatch.setattr(kept_programs, "without_cache", contextlib.nullcontext)
    kept_programs.forbid("nothing is traced")

    def doubled(is_broken):
        def function(x):
            if is_broken:
                kept_programs.forbid("the compiler does not work here")
            return 2.0 * x

        compiled = kept_programs.KeptProgram(jax.jit(function), ("one",), (), ())
        return compiled(np.ones(2, np.float32)).tolist()

    assert doubled(is_broken=True) == [2.0, 2.0] and not list(folder.glob("*.program"))
    assert doubled(is_broken=False) == [2.0, 2.0] and len(list(folder.glob("*.program"))) == 1
