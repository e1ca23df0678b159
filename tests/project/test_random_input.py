"""Random input at the entry points: a ValueError or a result, never a crash of another kind, never
a silent NaN."""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import inspect
import itertools
import json
import math
import os
import re
import shutil
import sys
import types
import warnings
from pathlib import Path
from unittest import mock

import jax
import members
import numpy as np
import pytest
from conftest import ROOT, SHORT
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from made_up_runs import made_up
from members import FAMILIES
from test_bad_input import GOOD, INTERVAL, WEAK, call

import iblf_jax as ij
from iblf_jax import barriers, bounds, cli, robots
from iblf_jax.core import checks
from iblf_jax.core.pytree import is_leaf_field
from iblf_jax.core.status import Status
from iblf_jax.engine import CompiledBatch
from iblf_jax.engine.plan import ExecutionPlan
from iblf_jax.files.components import decode_fields
from iblf_jax.simulation import metrics, paths
from iblf_jax.simulation.results import Metrics
from iblf_jax.simulation.scenario_rules import check_leaves
from iblf_jax.studies.options import RunOptions
from iblf_jax.studies.study_setup import prepare
from iblf_jax.tuning.parameters import layout
from iblf_jax.tuning.result import TuneSetup
from iblf_jax.tuning.robust import as_risk

ODD = [np.float16(1), np.float32("nan"), np.int64(-3), np.bool_(True), np.str_("x"), 10**400]
SCALARS = st.one_of(
    *(st.floats(), st.integers(), st.booleans(), st.none(), st.text(max_size=5)),
    *(st.complex_numbers(), st.binary(max_size=3)),
    st.sampled_from([*ODD, Ellipsis, object, {}, set(), b""]),
)
ARRAYS = hnp.arrays(
    st.sampled_from([*"efdiB?F", "U3", object]),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3),
)
ANYTHING = st.one_of(
    SCALARS,
    ARRAYS,
    st.recursive(
        SCALARS, lambda inner: st.lists(inner, max_size=3) | st.tuples(inner, inner), max_leaves=5
    ),
)
MEMBERS = [member for family, (members, _, _) in FAMILIES.items() for member in members.values()]
many = settings(max_examples=200)


def accepts_or_value_error(call):
    """The result, or None if the call raised a ValueError that names what came."""
    refusal = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return call()
        except ValueError as error:
            refusal = str(error)
    assert ": got " in refusal, refusal
    return None


def finite(tree) -> bool:
    return all(np.all(np.isfinite(x)) for x in jax.tree.leaves(tree))


@pytest.mark.slow
@many
@given(
    member=st.sampled_from(MEMBERS) | st.just(ij.presets.zhang_yan_2024()),
    data=st.data(),
    value=ANYTHING | st.sampled_from(MEMBERS),
)
def test_constructors(member, data, value):
    """Any field of any member or any part of a scenario, given anything or another member."""
    fields = [f for f in dataclasses.fields(member) if f.init]
    if not fields:
        return
    field = data.draw(st.sampled_from(fields))
    given_now = {f.name: getattr(member, f.name) for f in fields} | {field.name: value}
    made = accepts_or_value_error(lambda: type(member)(**given_now))
    if made is not None:
        check_leaves(made)
        if is_leaf_field(field) and getattr(made, field.name) is not None:
            assert np.issubdtype(getattr(made, field.name).dtype, np.floating)


WORDS_OF_PATHS = (
    (
        *("plant", "model", "robot", "controller", "initial", "disturbance", "bounds.lower"),
        *("observer", "x"),
    ),
    (
        *("mass", "K2", "k1", "q", "g", "kf", "phase", "offset", "variant", "barrier"),
        *("__init__",),
    ),
    ("", *("[0]", "[1]", "[-1]", "[7]", "[0][0]", "[99999999999]", ".real", "[a]")),
)
PATHLIKE = st.one_of(
    st.text(alphabet="plantmscoer.[]0123456789-_K ", max_size=20),
    st.builds(lambda a, b, i: f"{a}.{b}{i}", *map(st.sampled_from, WORDS_OF_PATHS)),
    ANYTHING,
)


@pytest.mark.slow
@many
@given(path=PATHLIKE)
def test_parse_and_get(paper, path):
    tokens = accepts_or_value_error(lambda: paths.parse(path))
    if tokens is not None:
        assert all(isinstance(t, str | int) for t in tokens)
        rows = [f"[{json.dumps(t) if isinstance(t, str) else t}]" for t in tokens]
        names = [isinstance(t, str) and not isinstance(t, paths.RowName) for t in tokens]
        spelled = [f".{t}" if x else r for t, x, r in zip(tokens, names, rows, strict=True)]
        assert paths.parse("".join(spelled).removeprefix(".")) == tokens
    value = accepts_or_value_error(lambda: paths.get(paper, path))
    assert value is None or np.all(np.isfinite(value))


@pytest.mark.slow
@many
@given(path=PATHLIKE.filter(lambda p: isinstance(p, str)), value=ANYTHING)
def test_with_parameters(paper, path, value):
    other = accepts_or_value_error(lambda: ij.with_parameters(paper, {path: value}))
    if other is not None:
        assert finite(other)
        assert jax.tree.structure(other) == jax.tree.structure(paper)
        assert [np.shape(x) for x in jax.tree.leaves(other)] == [
            np.shape(x) for x in jax.tree.leaves(paper)
        ]
        before, after = (
            {p.path: np.asarray(p.value) for p in ij.parameters(s)} for s in (paper, other)
        )
        changed = {p for p in before if not np.array_equal(before[p], after[p])}
        touched = {p.split("[")[0] for p in paths.expand(path)}
        assert changed <= touched


class Entered(Exception):  # noqa: N818
    """The arguments were accepted; nothing is compiled in these tests."""


def entered(*args, **options):
    raise Entered


@many
@given(duration=st.floats(), dt=st.floats())
def test_steps(duration, dt):
    steps = accepts_or_value_error(lambda: checks.whole_steps(duration, dt))
    if steps is not None:
        assert 1 <= steps <= checks.MAX_STEPS
        assert math.isclose(steps * dt, duration, rel_tol=1e-2)


NUMBERS = st.one_of(
    st.floats(-1e3, 1e3),
    st.floats(1e-3, 1e2),
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from([1e-300, 1e300, 0.0]),
)


@pytest.mark.slow
@settings(max_examples=150)
@given(
    values=st.dictionaries(
        st.sampled_from([p.path for p in ij.parameters(ij.presets.zhang_yan_2024())]),
        NUMBERS,
        min_size=1,
        max_size=4,
    )
)
def test_no_silent_nan_in_a_run(paper, values):
    """Any numbers in any leaves: refused, or run; a run that is not finite says so, and its records
    are finite up to there."""
    # The step that a warning names takes longer to find than the run; other tests look at it.
    with mock.patch("iblf_jax.engine.diagnosis.find_dt", return_value=1e-4):
        run = accepts_or_value_error(
            lambda: ij.simulate(ij.with_parameters(paper, values), **SHORT)
        )
    if run is None:
        return
    status = int(run.status)
    state = np.concatenate(
        [
            np.asarray(run.q).ravel(),
            np.asarray(run.dq).ravel(),
            np.asarray(run.observer_state).ravel(),
        ]
    )
    assert np.all(np.isfinite(state))
    others = [
        np.asarray(x)
        for x in (run.tau, run.e1, run.e2, run.xi, run.disturbance, run.disturbance_estimate, run.V)
    ]
    if not all(np.all(np.isfinite(x)) for x in others):
        assert status & Status.NOT_FINITE, values


# ---------------------------------------------------- whatever a user may put in the place of it

DEEP: list = [1.0]
for _ in range(5000):
    DEEP = [DEEP]


class Broken:
    """Nothing can be asked of it."""

    def __bool__(self):
        raise RuntimeError

    __len__ = __iter__ = __array__ = __float__ = __repr__ = __eq__ = __bool__
    __hash__ = None


NASTY = {
    "none": None,
    "long": "x" * 5000,
    "null-byte": "a\0b.npz",
    "surrogate": "\ud800.nc",
    "huge": 10**5000,
    "2**40": 2**40,
    "int8": np.int8(-3),
    "nan": float("nan"),
    "key": jax.random.key(0),
    "keys": jax.random.split(jax.random.key(0)),
    "array": np.ones(3),
    "objects": np.asarray([object(), None]),
    "ragged": [[1.0], [1.0, 2.0]],
    "deep": DEEP,
    "mixed-dict": {1: 2, "a": DEEP},
    "date": datetime.date(2020, 1, 1),
    "class": int,
    "generator": (x for x in (1.0, 2.0)),
    "words": ["cpu"],
    "bytes": b"abc",
    "folder": Path("/"),
    "broken": Broken(),
}
WAYS = {"controller.K2": ij.factor(ij.uniform(0.9, 1.1))}
GOAL = ij.objectives.tracking(scale=1.0)


def with_a_design(scenario, kind, points):
    """A sweep over random gains."""
    grid = {"controller.K2": ij.uniform(1.0, 2.0)}
    return ij.sweep(scenario, grid, design=ij.studies.Design(kind, points), duration=0.01)


ENTRIES = {
    name: GOOD[name]
    for name in (
        *("simulate", "compare", "monte_carlo", "sweep", "sensitivity", "tune", "SQP"),
        *("LBFGS", "Adam", "Optax", "Effort", "Report", "pareto", "falsify"),
        *("failure_probability", "certify", "explain", "tunable"),
    )
} | {
    "LocalExecutor": (
        lambda **options: ij.studies.LocalExecutor(**options).checked(),
        {"devices": None, "memory": 1e9, "chunk": 8},
    ),
    "StoreOptions": (
        lambda **options: ij.studies.StoreOptions(**options).checked(),
        {"path": "sweep.zarr", "unit": None, "writer": "client", "shared": False},
    ),
    "prove": (ij.prove, {"level": 1.0, "parameters": INTERVAL, "runs": 0}),
    "Design": (with_a_design, {"kind": "random", "points": 4}),
    "load_scenario": (ij.load_scenario, {"path": "x.toml"}),
    "load": (ij.load, {"path": "x.npz"}),
    "load_sweep": (ij.load_sweep, {"path": "x.zarr"}),
    "tune_file": (ij.tune_file, {"path": "x.toml"}),
    "robots.load": (robots.load, {"path": "x.urdf"}),
    "save_scenario": (ij.save_scenario, {"path": "/"}),
    "astype": (ij.astype, {"tree": WEAK, "dtype": "float32"}),
    "choice": (ij.choice, {"values": [1.0]}),
    "arm_scenario": (
        ij.presets.arm_scenario,
        {"robot": WEAK.plant, "reference": WEAK.reference, "law": "log"},
    ),
}
"""Entry points, and arguments besides the scenario and the duration that are fine."""


def names_of(entry: str) -> list[str]:
    """All arguments of an entry point."""
    function, arguments = ENTRIES[entry]
    parameters = inspect.signature(function).parameters.values()
    named = [x.name for x in parameters if x.kind not in (x.VAR_POSITIONAL, x.VAR_KEYWORD)]
    return list(dict.fromkeys((*arguments, *named)))


FIRST = {name: entry for entry in reversed(ENTRIES) for name in names_of(entry)}
"""Argument -> the first entry point that has it.  There all values are tried; entry points that
come later share what checks it, and try every fourth value."""


@pytest.fixture
def no_runs(monkeypatch):
    """Whatever would run raises Entered."""
    for place in (
        "engine.simulate.run_one",
        "studies.blocks._execute",
        "tuning.problem.rollouts",
        "tuning.evaluation.Evaluator.__call__",
        "tuning._falsify._margins",
        "engine.explain.instructions",
        "certificates._certify._certificate_of",
        "proofs._prove.problem_of",
    ):
        monkeypatch.setattr(f"iblf_jax.{place}", entered)
    by_scan = ExecutionPlan((), reports_unsupported=True)
    monkeypatch.setattr(
        "iblf_jax.studies.study_setup.compile_batch",
        lambda request, *_: CompiledBatch(request, by_scan),
    )


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.filterwarnings("ignore")
def test_anything_in_the_place_of_any_argument(entry, no_runs, tmp_path, monkeypatch):
    """A ValueError that says what came, in one line that can be read; or nothing is there; or the
    call goes on to its runs."""
    monkeypatch.chdir(tmp_path)
    fourth = list(NASTY)[list(ENTRIES).index(entry) % 4 :: 4]
    for name in names_of(entry):
        for label in NASTY if FIRST[name] == entry else fourth:
            value = NASTY[label]
            try:
                call(ENTRIES[entry], **{name: value})
            except (Entered, FileNotFoundError, ij.StoreError):
                continue
            except ValueError as error:
                text = str(error)
                assert ": got " in text, (name, label, text)
                assert len(text) < 1500, (name, label)
                assert "\n" not in text, (name, label)
    assert depth_left(500)  # a deep list that reached JAX would have spoilt the interpreter's count


FINE = {
    "robot": members.TWO_LINK,
    "mass_matrix": members.TWO_LINK.mass_matrix,
    "reference": members.REFERENCES["sinusoid"],
    "objective": GOAL,
    "guard": 1e-3,
    "tube": None,
    **dict.fromkeys(("q", "dq", "v", "u", "acceleration"), (0.1, 0.2)),
}
"""Arguments that several functions require; the tube is made in the test."""
PARTS = {
    "at_time": (robots.at_time, {"t": 0.0}, ("robot",)),
    "friction_torque": (robots.friction_torque, {}, ("dq",)),
    "coriolis_from_mass_matrix": (robots.coriolis_from_mass_matrix, {}, ("q", "v", "u")),
    "mass_matrix_rate": (robots.mass_matrix_rate, {}, ("robot", "q", "dq")),
    "energy_gradient": (robots.energy_gradient, {}, ("robot", "q", "v")),
    "momentum": (robots.momentum, {}, ("robot", "q", "v")),
    "inverse_dynamics": (robots.inverse_dynamics, {}, ("robot", "q", "v", "u", "acceleration")),
    "from_energy": (robots.from_energy, {"cls": None}, ("cls",)),
    "joint_names": (robots.joint_names, {"n": 2}, ("n",)),
    "tube_at": (
        bounds.tube_at,
        {"bounds": bounds.Bounds(bounds.Constant(-2.0), bounds.Constant(2.0)), "t": 0.1},
        ("reference", "bounds", "t", "acceleration"),
    ),
    "positive_width": (bounds.positive_width, {"k": 1.0}, ("k",)),
    "guarded_error": (barriers.guarded_error, {}, ("tube", "q", "guard")),
    "guard_is_active": (barriers.guard_is_active, {}, ("tube", "q", "guard")),
    "splines": (
        ij.references.WaypointSpline,
        {"times": (0.0, 1.0), "waypoints": [[0.0], [1.0]]},
        ("times", "waypoints"),
    ),
    "objectives.complete": (ij.objectives.complete, {"start": [1.0]}, ("objective", "start")),
    "objectives.sharper": (ij.objectives.sharper, {"factor": 2.0}, ("objective",)),
    "objectives.metric": (
        ij.objectives.metric,
        {"fold": metrics.Tracking(), "name": "rmse"},
        ("fold", "name"),
    ),
    "check_law": (ij.testing.check_law, {"law": members.LAWS["pd_gravity"]}, ("law", "scenario")),
    "check_robot": (ij.testing.check_robot, {}, ("robot", "q")),
    "check_reference": (ij.testing.check_reference, {}, ("reference", "n", "duration")),
    "check_side": (
        ij.testing.check_side,
        {"side": bounds.Constant(1.0)},
        ("side", "n", "duration"),
    ),
    "check_disturbance": (
        ij.testing.check_disturbance,
        {"disturbance": members.DISTURBANCES["step"]},
        ("disturbance", "plant", "model", "duration"),
    ),
    "check_observer": (
        ij.testing.check_observer,
        {"observer": members.OBSERVERS["printed"]},
        ("observer", "model"),
    ),
    "check_objective": (ij.testing.check_objective, {}, ("objective", "scenario", "duration")),
}
"""Functions that parts are made of and looked at with: other arguments that are fine, and those
that anything is put in the place of."""


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.filterwarnings("ignore")
def test_anything_in_the_place_of_the_arguments_of_a_part(part, paper, monkeypatch):
    """A ValueError that says what came, or the findings of a checker; what is accepted goes no
    further than to its first function."""
    for checker in ("_contract", "laws", "metrics", "observers", "robots", "world", "objectives"):
        monkeypatch.setattr(f"iblf_jax.testing.{checker}.shape_of", entered)
    function, arguments, names = PARTS[part]
    parameters = inspect.signature(function).parameters.values()
    required = [x.name for x in parameters if x.default is x.empty]
    arguments = {name: FINE[name] for name in required if name in FINE} | arguments
    if "tube" in arguments:
        arguments = {**arguments, "tube": bounds.tube_at(paper.reference, paper.bounds[0], 0.1)}
    refused = set()
    for name in names:
        for label, value in {
            **NASTY,
            "empty": [],
            "complex": 1j,
            "matrix": np.ones((2, 3, 4)),
            "words of words": {"a": 1},
        }.items():
            try:
                function(**(arguments | {name: value}))
            except (Entered, ij.testing.ContractError):
                refused.add(name)
            except ValueError as error:
                refused.add(name)
                text = str(error)
                assert ": got " in text, (name, label, text)
                assert "\n" not in text, (name, label)
    assert refused == set(names)
    assert depth_left(500)


def depth_left(n: int) -> bool:
    return n == 0 or depth_left(n - 1)


SEARCHED = {"parameters": ["controller.K2"], "objective": GOAL}
TOO_MUCH = {
    "runs": (ij.monte_carlo, {"perturbations": WAYS, "runs": 2**31}, "at most", "GiB"),
    "points": (ij.sensitivity, {"perturbations": WAYS, "points": 2**30}, "at most", "GiB"),
    "points of a design": (with_a_design, {"kind": "random", "points": 2**31}, "GiB"),
    "starts": (ij.tune, SEARCHED | {"solver": ij.tuning.SQP(starts=2**40)}, "at most", "GiB"),
    "starts of an attack": (ij.falsify, {"perturbations": WAYS, "starts": 2**40}, "GiB"),
    "metrics[0].tolerance": (
        ij.simulate,
        {"metrics": [metrics.Settling(tolerance=[0.1] * 3)]},
        "2",
    ),
    "weights": (ij.tune, SEARCHED | {"objective": ij.objectives.effort(weights=[1.0] * 3)}, "(3,)"),
    "allowed": (ij.objectives.margin_above, {"limit": 0.1, "allowed": 5.0}, "0 to 1"),
} | {
    f"devices {devices}": (
        ij.monte_carlo,
        {"perturbations": WAYS, "runs": 2, "executor": ij.studies.LocalExecutor(devices=devices)},
        word,
    )
    for devices, word in (([], "at least one"), (["cpu"], "cpu"))
}
"""Field -> function, arguments besides the scenario and the duration, and words of the message."""


@pytest.mark.parametrize("case", TOO_MUCH)
def test_sizes_devices_and_shapes(case):
    function, arguments, *words = TOO_MUCH[case]
    with pytest.raises(ValueError, match=": got ") as caught:
        call((function, arguments))
    for word in words if "attack" in case else (case.split()[0], *words):
        assert word in str(caught.value), str(caught.value)


@pytest.mark.slow
def test_recording_less_often_than_there_are_steps(paper, short_run):
    """Past the end of the run every step is as good as any; 2**31 is more than the compiled loop
    can count."""
    run = ij.simulate(paper, record_every=2**31, **SHORT)
    assert run.t.shape == (1,)
    np.testing.assert_array_equal(run.metrics.rmse, short_run.metrics.rmse)


@pytest.mark.parametrize("name", ["a\nb", "a]b", 'quo"te', "1", '"x"', "back\\slash", "\u2028"])
def test_names_of_links_of_any_characters(name, tmp_path):
    """Each listed path leads to its value, and back, in files too."""
    arm = ij.presets.ur5()
    names = (name, *arm.plant.links[1:])
    arm = dataclasses.replace(arm, plant=dataclasses.replace(arm.plant, links=names))
    (path,) = [p.path for p in ij.parameters(arm) if p.path.endswith("].mass")][:1]
    other = ij.with_parameters(arm, {path: 7.5})
    assert paths.get(other, path) == 7.5 == other.plant.mass[0]
    assert paths.parse(path)[2] == name
    ij.save_scenario(other, tmp_path / "arm.toml")
    loaded = ij.load_scenario(tmp_path / "arm.toml")
    assert loaded.plant.links == names
    assert paths.get(loaded, path) == 7.5


@pytest.mark.parametrize(
    "text",
    [
        "x = " + "[" * 100_000,
        "[" + "a." * 5000 + "a]",
        "x = " + "[" * 60 + "]" * 60,
        "x = " + "9" * 6000,
        "run = 2020-01-01",
        "\0",
    ],
    ids=["lists", "tables", "closed", "digits", "date", "null"],
)
def test_toml_of_any_depth(text, tmp_path, capsys):
    from iblf_jax.cli import main

    file = tmp_path / "x.toml"
    file.write_text(text)
    for command in ("simulate", "montecarlo", "sweep", "tune"):
        assert main([command, str(file)]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "x.toml" in said
        assert len(said) < 1500
    assert depth_left(500)


# ---------------------------------------------------------------- what results and commands take


@pytest.fixture
def results(paper, no_runs, monkeypatch):
    """One result of every kind, which no simulator made; whatever would run or draw raises
    Entered."""
    monkeypatch.setattr("iblf_jax.plotting._style.new_figure", entered)
    monkeypatch.setattr("iblf_jax.tuning.result._slice", entered)
    run = made_up(paper.plant, duration=0.1)
    options = RunOptions(duration=0.01, dt=1e-3, method="rk4", backend="vmap", runs=4, seed=0)
    setup = prepare(paper, WAYS, options, metrics=None)
    found = Metrics(
        {"margin": np.full((4, 2), 0.1), "rmse": np.full((4, 2), 0.01)},
        (("margin", "rad"), ("rmse", "rad")),
    )
    samples = {"controller.K2": np.full((4, 2), 20.0)}
    study = ij.Study(paper, found, np.zeros(4, np.int32), np.ones(4), samples, setup)
    history = {
        "valid": np.ones((1, 1), bool),
        "x": np.full((1, 1, 2), 20.0),
        "objective": np.ones((1, 1)),
        "evaluations": np.ones(1, int),
    }
    setup = TuneSetup(
        duration=0.01,
        perturbations={},
        risk=as_risk("mean"),
        objective=GOAL,
        report=ij.tuning.Report(runs=4, seed=1),
        limits=((1.0, 100.0), (1.0, 100.0)),
    )
    names = ("controller.K2[0]", "controller.K2[1]")
    best = {"controller.K2": np.full(2, 20.0)}
    words = ("done", "newton", "forward", 1.0)
    tuned = ij.TuneResult(paper, paper, best, names, history, 0, *words, setup)
    vars(tuned)["nominal"] = (run, run)
    twos, (blocks, _) = np.ones((2, 2)), layout(paper, ["controller.K2"], 1e-3, "rk4")
    front = ij.ParetoFront(("a", "b"), twos, twos, names, twos, twos[0], paper, blocks, twos, 1.0)
    attack = ij.WorstCase(
        paper, {}, 0.1, 0.1, 0, np.ones((2, 2)), 4, {"duration": 0.01, "dt": 1e-3, "method": "rk4"}
    )
    compared = ij.Comparison({"log": run}, {}, {}, {}, {"log": "K2 = 20"})
    results = {"run": run, "study": study, "tuning": tuned}
    return results | {"front": front, "attack": attack, "comparison": compared}


METHODS = {
    "run.plot": {"title": "x"},
    "study.__getitem__": {"index": 0},
    "study.replay": {"index": 0, "record_every": 1},
    "study.worst": {"count": 1, "metric": "margin"},
    "study.probability": {"event": Status.BOUND_VIOLATED, "confidence": 0.9},
    "study.quantiles": {"quantiles": [0.5], "exclude_failed": False},
    "study.correlations": {"metrics": None, "exclude_failed": False},
    "study.bands": {"quantiles": [0.5], "runs": 2, "samples": 5, "exclude_failed": False},
    "study.parameter_unit": {"path": "controller.K2"},
    "study.plot": {"runs": 2},
    "tuning.check": {"runs": 2, "seed": 3},
    "tuning.landscape": {
        "first": "controller.K2[0]",
        "second": "controller.K2[1]",
        "points": 2,
        "span": 1.0,
    },
    "tuning.plot": {"landscape": None},
    "tuning.save": {"path": "/"},
    "front.scenario": {"index": 0},
    "attack.replay": {"record_every": 1},
    "comparison.plot": {"joint": 0, "zoom": None},
}
"""Methods of results, and arguments that are fine."""


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.filterwarnings("ignore")
def test_anything_in_the_place_of_the_arguments_of_a_method(method, results, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kind, _, name = method.partition(".")
    call, odd = (
        getattr(results[kind], name),
        {
            **NASTY,
            "-1": -1,
            "half": 0.5,
            "true": True,
            "slice": slice(0, 1),
            "far": -(2**70),
            "pair": (1, 2),
        },
    )
    refused = set()
    for argument in METHODS[method]:
        for label, value in odd.items():
            try:
                call(**(METHODS[method] | {argument: value}))
                continue
            except (Entered, FileNotFoundError):
                continue
            except ValueError as error:
                refused.add(argument)
                said = str(error)
            assert re.match(r".+: got .*, expected .+$", said), (argument, label, said)
            assert len(said) < 1500, (argument, label)
    assert refused == set(METHODS[method])


@dataclasses.dataclass(frozen=True)
class Own:
    """A fold of a user's."""

    width: object = 1.0
    units: object = dataclasses.field(default_factory=lambda: {"own": "rad"})

    def init(self, sample):
        return 0.0 * sample.t

    def update(self, acc, sample):
        return acc

    def finish(self, acc):
        return {"own": acc}


jax.tree_util.register_dataclass(Own, ["width"], ["units"])


@pytest.mark.parametrize("odd", NASTY)
def test_anything_in_a_fold_and_in_a_table(odd):
    value = NASTY[odd]
    for field in ("width", "units"):
        accepts_or_value_error(
            lambda field=field: metrics.as_folds(
                [Own(**{field: value})], np.float64, ij.presets.zhang_yan_2024()
            )
        )
    for table in (value, {"k1": value}, {"k1": 1.0, "K2": 1.0, "o": 1.0, "barrier": value}):
        accepts_or_value_error(
            lambda table=table: decode_fields(ij.controllers.Backstepping, table, "controller")
        )
    assert depth_left(500)


WORDS = [
    *("", " ", "9" * 5000, "x" * 5000, "a\0b", "\ud800", "a\nb", "[" * 3000 + "=1"),
    str(2**63),
    *("nan", "-1", "0", "1e400", "/", "/dev/null", "--", "-", "[1,2]", "a=b", "=", "a="),
    *("law=7", "localhost:99999", "::1", ",", "rk5", "folder.toml", "folder.nc"),
    *("missing.toml", "missing/x.nc", "empty.toml", "loop.toml", "pipe.toml"),
    *("controller.K2=nan", "controller.K2=" + "[" * 5000, "plant.mass[999999999999]=1"),
]
COMMANDS = {
    "reproduce": ["--out", "out"],
    "simulate": ["zhang_yan_2024", "--duration", "0.01"],
    "compare": ["zhang_yan_2024", "--duration", "0.01"],
    "montecarlo": ["study.toml", "--quiet"],
    "failure": ["failure.toml", "--quiet"],
    "sweep": ["sweep.toml", "--quiet"],
    "tune": ["tune.toml", "--quiet"],
    "prove": ["zhang_yan_2024", "--level", "1.0", "--quiet"],
    "presets": ["printed_gap"],
    "parameters": ["zhang_yan_2024"],
}
"""Command, and words for it that are fine."""


@pytest.mark.parametrize("command", COMMANDS)
def test_any_word_in_the_place_of_any_other_on_the_command_line(
    command, no_runs, tmp_path, monkeypatch, capsys
):
    """Exit code 2 and one line that can be read, or the command goes on to its runs; `presets` and
    `parameters` print."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "distributed", types.SimpleNamespace(Client=entered))
    monkeypatch.setattr("iblf_jax.cli.prepare_jax", lambda: None)
    for name in ("study", "failure", "sweep", "tune"):
        shutil.copy(ROOT / "examples" / f"{name}.toml", tmp_path)
    for name in ("folder.toml", "folder.nc"):
        (tmp_path / name).mkdir()
    (tmp_path / "empty.toml").touch()
    (tmp_path / "loop.toml").symlink_to("loop.toml")
    os.mkfifo(tmp_path / "pipe.toml")
    (commands,) = (
        x.choices for x in cli.build_parser()._actions if isinstance(x, argparse._SubParsersAction)
    )
    words, fine, lines = itertools.cycle(WORDS), COMMANDS[command], [COMMANDS[command]]
    for action in commands[command]._actions[1:]:
        for word in itertools.islice(words, 2):
            if not action.option_strings:
                lines.append([word, *fine[1:]])
            elif action.nargs == 0:
                lines.append([*fine, action.option_strings[0], word])
            else:
                lines += [
                    [*fine, action.option_strings[0], word],
                    [*fine, f"{action.option_strings[0]}={word}"],
                ]
        lines.append([*fine, f"{action.option_strings[0]}=--"] if action.option_strings else ["--"])
    codes = set()
    for line in lines:
        try:
            code = cli.main([command, *line])
        except Entered:
            code = None
        codes.add(code)
        said = capsys.readouterr().err
        assert code in (0, 2, None), line
        if code == 2:
            assert said.startswith("iblf-jax: error: "), line
            assert said.count("\n") == 1, line
            assert len(said) < 1500, line
    assert 2 in codes
    assert codes - {2}
