"""Random input at the entry points: a ValueError or a result, never a crash of another kind, never
a silent NaN."""

import argparse
import dataclasses
import functools
import itertools
import json
import math
import os
import shutil
import sys
import types
import warnings
from unittest import mock

import entry_cases
import jax
import numpy as np
import pytest
from conftest import ROOT, SHORT
from entry_cases import NASTY, Entered, depth_left, readable, without_runs
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from members import FAMILIES

import iblf_jax as ij
from iblf_jax import cli
from iblf_jax.core import checks
from iblf_jax.core.pytree import is_leaf_field
from iblf_jax.core.status import Status
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario_rules import check_leaves

ODD = [np.float16(1), np.float32("nan"), np.int64(-3), np.bool_(True), np.str_("x"), 10**400]
SCALARS = st.one_of(
    *(st.floats(), st.integers(), st.booleans(), st.none(), st.text(max_size=5)),
    *(st.complex_numbers(), st.binary(max_size=3)),
    st.sampled_from([*ODD, Ellipsis, object, {}, set(), b""]),
)
SHAPES = hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3)
ANYTHING = st.one_of(
    SCALARS,
    hnp.arrays(st.sampled_from([*"efdiB?F", "U3", object]), SHAPES),
    st.recursive(
        SCALARS, lambda inner: st.lists(inner, max_size=3) | st.tuples(inner, inner), max_leaves=5
    ),
)
MEMBERS = [member for members, _, _ in FAMILIES.values() for member in members.values()]
many = settings(max_examples=200)


def accepts_or_value_error(call):
    """The result, or None if the call raised a ValueError that names what came."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return call()
        except ValueError as error:
            refusal = str(error)
    assert ": got " in refusal, refusal
    return None


# --- functions, methods, words of the command line ------------------------------------------------


FIRST = {
    name: entry
    for entry in reversed(entry_cases.entries())
    for name in entry_cases.arguments_of(entry)
}
"""Argument -> the first entry point that has it.  There all values are tried; entry points that
come later share what checks it, and try every eighth value."""
LONG = {
    *("tune", "pareto", "excitation", "recommended_dt", "presets.ur5", "presets.iiwa14"),
    *("presets.arm_scenario", "tuning.check", "cosimulate", "identify"),
}
"""They prepare what they would run before they look at all arguments."""
ACCEPTED = {
    *("certify worst", "controllers.within_effort law", "controllers.within_effort edge"),
    *("objectives.sharper factor", "plotting.scatter metric"),
    *(f"plotting.heat_map {name}" for name in ("data", "x", "y")),
}
"""Functions and arguments that nothing is refused for before a run, a drawing or a further step."""


def marked(names):
    return [pytest.param(x, marks=[pytest.mark.slow] * (x in LONG)) for x in names]


def refusals(call, name, values):
    """How many values in the place of an argument are refused, each in a line that can be read, or
    because a library is not installed."""
    count = 0
    for label, value in values.items():
        try:
            call(**{name: value})
        except Entered:
            continue
        except (FileNotFoundError, ImportError, ij.StoreError, ij.testing.ContractError):
            pass
        except ValueError as error:
            readable(error, (name, label))
        else:
            continue
        count += 1
    return count


@pytest.mark.parametrize("entry", marked(entry_cases.entries()))
@pytest.mark.filterwarnings("ignore")
def test_anything_in_the_place_of_any_argument(entry, tmp_path, monkeypatch):
    """A ValueError that says what came, in one line that can be read; or nothing is there; or the
    call goes on to its runs."""
    monkeypatch.chdir(tmp_path)
    place = list(entry_cases.entries()).index(entry)
    eighth = {label: NASTY[label] for label in list(NASTY)[place % 8 :: 8]}
    call = functools.partial(entry_cases.call, entry)
    with without_runs():
        for name in entry_cases.arguments_of(entry):
            if name == "progress":
                continue
            is_first = FIRST[name] == entry
            count = refusals(call, name, NASTY if is_first else eighth)
            assert count or not is_first or f"{entry} {name}" in ACCEPTED, name
    assert depth_left()


OF_INDICES = {"-1": -1, "half": 0.5, "true": True, "slice": slice(0, 1), "far": -(2**70)}


@pytest.mark.parametrize("method", marked(entry_cases.methods()))
@pytest.mark.filterwarnings("ignore")
def test_anything_in_the_place_of_the_arguments_of_a_method(method, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call = functools.partial(entry_cases.call_method, method)
    with without_runs():
        for name in entry_cases.methods()[method]:
            assert refusals(call, name, NASTY | OF_INDICES | {"pair": (1, 2)}), name


WORDS = [
    *("", " ", "9" * 5000, "x" * 5000, "a\0b", "\ud800", "a\nb", "[" * 3000 + "=1"),
    *(str(2**63), "nan", "-1", "0", "1e400", "/", "/dev/null", "--", "-", "[1,2]"),
    *("a=b", "=", "a="),
    *("law=7", "localhost:99999", "::1", ",", "rk5", "folder.toml", "folder.nc"),
    *("missing.toml", "missing/x.nc", "empty.toml", "loop.toml", "pipe.toml"),
    *("controller.K2=nan", "controller.K2=" + "[" * 5000, "plant.mass[999999999999]=1"),
]
PARSER = cli.build_parser()
(COMMANDS,) = (x.choices for x in PARSER._actions if isinstance(x, argparse._SubParsersAction))
FINE_WORDS = {
    "reproduce": ["--out", "out"],
    "compare": ["zhang_yan_2024", "--duration", "0.01"],
    "montecarlo": ["study.toml", "--quiet"],
    **{name: [f"{name}.toml", "--quiet"] for name in ("failure", "sweep", "tune")},
    "presets": ["printed_gap"],
}
"""Command, and words for it that are fine where they are not the name of a preset."""
NEED_FILES = {"doctor", "identify", "export", "ros"}
"""Commands that are refused with these words."""


@pytest.mark.parametrize("command", COMMANDS)
def test_any_word_in_the_place_of_any_other_on_the_command_line(
    command, tmp_path, monkeypatch, capsys
):
    """Exit code 2 and one line that can be read, or the command goes on to its runs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(
        sys.modules, "distributed", types.SimpleNamespace(Client=entry_cases.entered)
    )
    monkeypatch.setattr("iblf_jax.cli.prepare_jax", lambda: None)
    monkeypatch.setattr("iblf_jax.cli.build_parser", lambda: PARSER)
    for name in ("study", "failure", "sweep", "tune"):
        shutil.copy(ROOT / "examples" / f"{name}.toml", tmp_path)
    for name in ("folder.toml", "folder.nc"):
        (tmp_path / name).mkdir()
    (tmp_path / "empty.toml").touch()
    (tmp_path / "loop.toml").symlink_to("loop.toml")
    os.mkfifo(tmp_path / "pipe.toml")
    fine = FINE_WORDS.get(command, ["zhang_yan_2024"])
    words, lines = itertools.cycle(WORDS), [fine]
    for action in COMMANDS[command]._actions[1:]:
        option = action.option_strings[0] if action.option_strings else ""
        first, second = itertools.islice(words, 2)
        if not option:
            lines += [[first, *fine[1:]], [second, *fine[1:]], ["--"]]
            continue
        lines += [[*fine, option, first], [*fine, f"{option}=--"]]
        if action.nargs != 0:
            lines.append([*fine, f"{option}={second}"])
    codes = set()
    with without_runs():
        for line in lines:
            try:
                code = cli.main([command, *line])
            except Entered:
                code = None
            codes.add(code)
            said = capsys.readouterr().err
            assert code in (0, 2, None), line
            if code == 2:
                assert said.startswith("iblf-jax: error: ") and said.count("\n") == 1, line
                assert len(said) < 1500, line
    assert 2 in codes and (codes - {2} or command in NEED_FILES)


TABLES = {
    "lists": "x = " + "[" * 100_000,
    "tables": "[" + "a." * 5000 + "a]",
    "closed": "x = " + "[" * 60 + "]" * 60,
    "digits": "x = " + "9" * 6000,
    "date": "run = 2020-01-01",
    "null": "\0",
}


@pytest.mark.parametrize("table", TABLES)
def test_toml_of_any_depth(table, tmp_path, capsys):
    file = tmp_path / "x.toml"
    file.write_text(TABLES[table])
    for command in ("simulate", "montecarlo", "sweep", "tune"):
        assert cli.main([command, str(file)]) == 2
        said = capsys.readouterr().err
        assert "x.toml" in said and said.count("\n") == 1 and len(said) < 1500
    assert depth_left()


# --- fields of components, paths ------------------------------------------------------------------


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
    others = {f.name: getattr(member, f.name) for f in fields}
    made = accepts_or_value_error(lambda: type(member)(**others | {field.name: value}))
    if made is not None:
        check_leaves(made)
        if is_leaf_field(field) and getattr(made, field.name) is not None:
            assert np.issubdtype(getattr(made, field.name).dtype, np.floating)


PARTS_OF_PATHS = (
    ("plant", "model", "robot", "controller", "initial", "bounds.lower", "observer", "x"),
    ("mass", "K2", "k1", "q", "g", "kf", "phase", "variant", "barrier", "__init__"),
    ("", "[0]", "[1]", "[-1]", "[7]", "[0][0]", "[99999999999]", ".real", "[a]"),
)
PATHLIKE = st.one_of(
    st.text(alphabet="plantmscoer.[]0123456789-_K ", max_size=20),
    st.builds(lambda a, b, i: f"{a}.{b}{i}", *map(st.sampled_from, PARTS_OF_PATHS)),
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
    if other is None:
        return
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(other))
    assert jax.tree.structure(other) == jax.tree.structure(paper)
    before, after = (
        {p.path: np.asarray(p.value) for p in ij.parameters(s)} for s in (paper, other)
    )
    assert {p: x.shape for p, x in before.items()} == {p: x.shape for p, x in after.items()}
    changed = {p for p in before if not np.array_equal(before[p], after[p])}
    assert changed <= {p.split("[")[0] for p in paths.expand(path)}


@pytest.mark.parametrize("name", ["a\nb]\u2028", 'quo"te\\', "1", '"x"'])
def test_names_of_links_of_any_characters(name, tmp_path):
    """Each listed path leads to its value, and back, in files too."""
    arm = ij.presets.ur5()
    names = (name, *arm.plant.links[1:])
    arm = dataclasses.replace(arm, plant=dataclasses.replace(arm.plant, links=names))
    path = next(p.path for p in ij.parameters(arm) if p.path.endswith("].mass"))
    other = ij.with_parameters(arm, {path: 7.5})
    assert paths.get(other, path) == 7.5 == other.plant.mass[0]
    assert paths.parse(path)[2] == name
    ij.save_scenario(other, tmp_path / "arm.toml")
    loaded = ij.load_scenario(tmp_path / "arm.toml")
    assert loaded.plant.links == names
    assert paths.get(loaded, path) == 7.5


# --- runs -----------------------------------------------------------------------------------------


@many
@given(duration=st.floats(), dt=st.floats())
def test_steps(duration, dt):
    steps = accepts_or_value_error(lambda: checks.whole_steps(duration, dt))
    if steps is not None:
        assert 1 <= steps <= checks.MAX_STEPS
        assert math.isclose(steps * dt, duration, rel_tol=1e-2)


NUMBERS = st.one_of(
    *(st.floats(-1e3, 1e3), st.floats(1e-3, 1e2), st.floats(allow_nan=False, allow_infinity=False)),
    st.sampled_from([1e-300, 1e300, 0.0]),
)
LEAVES = [p.path for p in ij.parameters(ij.presets.zhang_yan_2024())]


@pytest.mark.slow
@settings(max_examples=150)
@given(values=st.dictionaries(st.sampled_from(LEAVES), NUMBERS, min_size=1, max_size=4))
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
    assert all(np.all(np.isfinite(x)) for x in (run.q, run.dq, run.observer_state))
    others = (run.tau, run.e1, run.e2, run.xi, run.disturbance, run.disturbance_estimate, run.V)
    if not all(np.all(np.isfinite(x)) for x in others):
        assert int(run.status) & Status.NOT_FINITE, values


@pytest.mark.slow
def test_recording_less_often_than_there_are_steps(paper, short_run):
    """Past the end of the run every step is as good as any; 2**31 is more than the compiled loop
    can count."""
    run = ij.simulate(paper, record_every=2**31, **SHORT)
    assert run.t.shape == (1,)
    np.testing.assert_array_equal(run.metrics.rmse, short_run.metrics.rmse)
