"""The tasks of the benchmark of the field for other programs, and the results of these programs."""

import json
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from conftest import ROOT
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax.core.linalg import solve_gain

FIELD = ROOT / "benchmarks" / "field"
sys.path[:0] = [str(FIELD), str(FIELD / "tasks"), str(ROOT / "docs")]
sys.path.append(str(ROOT / "benchmarks"))
import check
import entry
import external
import field
import read_task
import tasks

NAMES = [folder.name for folder in entry.folders()]
TASKS = {name: read_task.read(tasks.FOLDER / f"{name}.json") for name in NAMES}
EXPRESSED = [name for name in NAMES if "functions" in TASKS[name]]
SCHEMA = read_task.read(tasks.FOLDER / "schema.json")


def test_every_entry_has_a_task_and_most_are_expressed():
    files = {path.stem for path in tasks.FOLDER.glob("*_[0-9][0-9][0-9][0-9].json")}
    assert files == set(NAMES)
    assert len(EXPRESSED) >= 25


@pytest.mark.parametrize("name", NAMES)
def test_a_task_has_the_format(name):
    jsonschema.Draft202012Validator(SCHEMA).validate(TASKS[name])
    for function in TASKS[name].get("functions", {}).values():
        sizes = {"t": 1, "x": len(TASKS[name]["start"]), "u": TASKS[name]["components"]}
        sizes["w"] = (1 + TASKS[name]["levels"]) * TASKS[name]["components"]
        place = sum(sizes[kind] for kind in function["arguments"])
        for op, *args in function["program"]:
            if op != "const":
                assert all(i < place for i in args if isinstance(i, int))
            place += 1
        assert all(i < place for i in function["results"])


def test_the_schema_refuses_what_is_no_task():
    task = TASKS["liu_2018"]
    validator = jsonschema.Draft202012Validator(SCHEMA)
    both = task | {"reason": "none"}
    no_start = {key: value for key, value in task.items() if key != "start"}
    function = {"arguments": ["t"], "program": [["sinh", 0, 1]], "results": [0]}
    other = task | {"functions": task["functions"] | {"reference": function}}
    assert not any(validator.is_valid(one) for one in (both, no_start, other))


@pytest.mark.parametrize("name", EXPRESSED)
def test_a_trajectory_belongs_to_its_task(name):
    task = TASKS[name]
    t, x, u = external.read_result(task, tasks.FOLDER / f"{name}.csv")
    np.testing.assert_allclose(x[0], task["start"], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose([t[0], t[-1]], [0.0, task["duration"]], rtol=1e-8, atol=1e-12)
    assert len(t) <= tasks.ROWS and (np.diff(t) > 0.0).all()
    assert external._faults_of_input(task | {"sampling": None}, t, u) == []
    assert np.isfinite(read_task.rates(task, t, x, u)).all()
    assert max(len(part) for part in (task["jumps"], task["constraints"])) < 50


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_task_is_that_of_its_entry(name):
    """Among others its functions agree with the package at random states to 1e-10."""
    assert tasks.faults_of(entry.ENTRIES / name) == []


@pytest.mark.slow
def test_published_numbers_are_those_of_the_results():
    """The trajectory of a task has at most 300 rows, which cut the corners of a start."""
    measured = [path.stem for path in entry.RESULTS.glob("*.json")]
    assert len(set(measured) & set(EXPRESSED)) >= 4
    for name in set(measured) & set(EXPRESSED):
        stated = json.loads((entry.RESULTS / f"{name}.json").read_text())["own"]
        numbers = TASKS[name]["published"]
        np.testing.assert_allclose(numbers["RMS error"], stated["late_error"], rtol=0.02)
        np.testing.assert_allclose(numbers["peak input"], stated["peak_input"], rtol=1e-3)
        np.testing.assert_allclose(numbers["effort"], stated["effort"], rtol=0.05)


def everything(z):
    """A function with operations of all kinds, of two numbers."""
    x, y = z
    inside = (x > 0.0) & ~(y > 1.0) | (x == y)
    place = jnp.floor(3.0 * x).astype(int)
    table = jnp.array([1.0, -2.0, 5.0])[jnp.clip(place, 0, 2)]
    yield jnp.where(inside, jnp.sqrt(x), jnp.nan) + table
    yield jnp.where(x > 0.5, jnp.inf, y) - jax.lax.rsqrt(1.0 + y**2)
    yield jax.nn.sigmoid(x) + jnp.sign(y) * jnp.arctan2(x, y) + x**-3 + jnp.expm1(y)
    yield solve_gain(jnp.array([[2.0, x], [y, 3.0]]), z)
    yield jnp.clip(x, -0.2, y) + jnp.remainder(y, 0.3) + jnp.argmax(z).astype(float)


def test_programs_of_numbers_are_equal_to_the_function():
    function = tasks.Function(("x",), lambda z: list(everything(z)))
    written = tasks.program_of(function, tasks.Sizes(1, 2, 0, 0))
    task = {"functions": {"f": json.loads(json.dumps(written, allow_nan=False))}}
    z = np.random.default_rng(1).uniform(-1.0, 1.5, (200, 2))
    expected = jax.jit(jax.vmap(lambda z: tasks._flat(list(everything(z)))))(jnp.asarray(z))
    found = read_task.evaluate(task, "f", z)
    assert np.isnan(found[:, 0]).any() and np.isinf(found[:, 1]).any()
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


def test_reasons_of_tasks_that_the_format_cannot_express():
    delayed = ij.with_parts(ij.presets.zhang_yan_2024(), actuator=ij.actuators.Delay(0.01))
    with pytest.raises(tasks.InexpressibleError, match="delay"):
        tasks.check_expressible(delayed)
    function = tasks.Function(("x",), lambda z: jax.scipy.special.erf(z))
    with pytest.raises(tasks.InexpressibleError, match="no operation 'erf'"):
        tasks.program_of(function, tasks.Sizes(1, 2, 0, 0))


def textbook(t, x):
    """The law of liu_2018, as `entries/liu_2018/independent.py` has it."""
    z1, dz1 = x[..., 0] - np.sin(t), x[..., 1] - np.cos(t)
    room = 0.51**2 - z1**2
    z2 = x[..., 1] + room * 10 * z1 - np.cos(t)
    alpha_rate = 20 * dz1 * z1**2 - room * 10 * dz1 - np.sin(t)
    return ((25 * x[..., 1] + alpha_rate - 10 * z2 - z1 / room) / 133)[..., None]


def integrated(task, law, times):
    def rates(t, x):
        return read_task.rates(task, t, x, law(t, x))

    how = {"method": "DOP853", "t_eval": times, "rtol": 1e-9, "atol": 1e-11}
    return solve_ivp(rates, (0.0, times[-1]), task["start"], **how).y.T


def test_a_task_and_the_printed_law_give_the_trajectory():
    task = TASKS["liu_2018"]
    t, x, u = external.read_result(task, tasks.FOLDER / "liu_2018.csv")
    early = t <= 2.0
    found = integrated(task, textbook, t[early])
    np.testing.assert_allclose(found, x[early], atol=2e-7)
    np.testing.assert_allclose(textbook(t, x), u, atol=2e-6)


@pytest.fixture(scope="module")
def short():
    """The task of liu_2018 for 1 s, and a result of it."""
    task = TASKS["liu_2018"] | {"duration": 1.0}
    t = np.linspace(0.0, 1.0, 501)
    x = integrated(task, textbook, t)
    return task, t, x, textbook(t, x)


def test_a_result_of_another_program_is_accepted_unless_it_is_none_of_the_task(short):
    task, t, x, u = short
    assert external.faults_of(task, t, x, u) == []
    rounded = [np.array([[float(f"{v:.9g}") for v in row] for row in part]) for part in (x, u)]
    assert external.faults_of(task, t, *rounded) == []
    assert external.violations_of(task, t, x) == []
    (words,) = external.faults_of(task, t, x, u * 1.02)
    assert "from the motion of the plant under the stated input" in words
    bent = x + 1e-4 * np.sin(40.0 * t)[:, None]
    assert any("from the motion" in words for words in external.faults_of(task, t, bent, u))
    assert "x1_1 starts at 0.51" in external.faults_of(task, t, x + 0.01, u)[0]
    assert "it runs from 0 to 0.5 s" in external.faults_of(task, t[:251], x[:251], u[:251])[0]
    rows = slice(None, None, 50)
    assert "too far apart" in external.faults_of(task, t[rows], x[rows], u[rows])[0]
    limited = task | {"input": task["input"] | {"lower": [-0.1], "upper": [0.1]}}
    assert "exceeds its limits [-0.1] at t = 0 s" in external.faults_of(limited, t, x, u)[0]
    sampled = task | {"sampling": {"period": 0.1, "delay": 0.0}}
    assert "within a period of 0.1 s" in external.faults_of(sampled, t, x, u)[0]


def test_numbers_of_a_result(short):
    task, t, x, u = short
    e = x[:, 0] - np.sin(t)
    numbers = external.numbers_of(task, t, x, u)
    np.testing.assert_allclose(numbers["error"], np.abs(e[t >= 0.5]).max())
    np.testing.assert_allclose(numbers["RMS error"], np.sqrt(np.mean(e[t >= 0.5] ** 2)), rtol=0.02)
    np.testing.assert_allclose(numbers["margin"], 1.0 - np.abs(e).max() / 0.51)
    np.testing.assert_allclose(numbers["effort"], np.sqrt(np.trapezoid(u[:, 0] ** 2, t)))
    outside = external.violations_of(task, t, x + 0.1)
    assert outside == ["x1_1 leaves its bounds at t = 0 s"]
    held = task | {"constraints": ["room"]}
    function = {"arguments": ["t", "x"], "program": [["const", 0.5], ["sub", 1, 3]], "results": [4]}
    held["functions"] = task["functions"] | {"constraints": function}
    assert "room becomes negative at t = " in external.violations_of(held, t, x)[0]


@pytest.fixture
def of_another_program(short, tmp_path, monkeypatch):
    """The file of a result for a copy of its task, and the words that check it."""
    task, t, x, u = short
    (tmp_path / "liu_2018.json").write_text(json.dumps(task))
    monkeypatch.setattr(external, "TASKS", tmp_path)
    monkeypatch.setattr(external, "EXTERNAL", tmp_path / "external")
    path = tmp_path / "result.csv"
    table = np.concatenate([u, t[:, None], x], axis=1)
    np.savetxt(path, table, "%.9g", ",", header="u_1,t,x1_1,x2_1", comments="")
    words = ["check.py", "--result", "liu_2018", str(path), "--law", "textbook"]
    monkeypatch.setattr(sys, "argv", words)
    return path


def test_a_result_goes_into_the_page_of_the_benchmark_unless_it_is_refused(
    of_another_program, capsys
):
    assert check.main() == 0
    assert check.main() == 0  # replaces the row of the same law
    assert "is accepted" in capsys.readouterr().out
    (row,) = external.rows_of("liu_2018")
    assert row["sha256"] == external.digest(of_another_program)
    assert 0.0 < row["used tolerance"] <= 1.0
    part = field.Part("liu_2018", entry.load(entry.ENTRIES / "liu_2018"), {}, None, (row,))
    table = field.of_other_programs(part)
    assert f"| textbook | {row['RMS error']:.3g} |" in table
    assert row["sha256"][:12] in table
    other = part._replace(external=(row | {"sha256 of the task": "0"},))
    assert "the task has changed since" in field.of_other_programs(other)
    text = of_another_program.read_text()
    for old, new, reason in (
        ("x2_1", "v", "lacks the columns x2_1"),
        ("0,0.5,0\n", "0,0.6,0\n", "x1_1 starts at 0.6"),
    ):
        assert old in text
        of_another_program.write_text(text.replace(old, new, 1))
        assert check.main() == 1
        assert reason in capsys.readouterr().out
    assert external.rows_of("liu_2018") == [row]


def test_rows_of_the_repository_belong_to_their_tasks():
    for path in external.EXTERNAL.glob("*.json"):
        for row in external.rows_of(path.stem):
            assert row["sha256 of the task"] == external.digest(tasks.FOLDER / path.name), path


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("octave-cli"), reason="Octave is not installed")
def test_the_reader_of_octave_agrees_with_that_of_numpy(tmp_path):
    lines = [f"addpath('{tasks.FOLDER}');"]
    expected = []
    for name in EXPRESSED:
        task = TASKS[name]
        t, x, u = external.read_result(task, tasks.FOLDER / f"{name}.csv")
        rows = slice(None, None, 60)
        for part, value in (("t", t[rows][None]), ("x", x[rows].T), ("u", u[rows].T)):
            np.savetxt(tmp_path / f"{name}.{part}", value, "%.17g")
            lines.append(f"{part} = load('-ascii', '{tmp_path / name}.{part}');")
        lines += [
            f"task = read_task('{tasks.FOLDER / name}.json');",
            "y = [task.rates(t, x, u); task.evaluate('reference', t);",
            "task.evaluate('upper', t); task.evaluate('constraints', t, x)];",
            f"dlmwrite('{tmp_path / name}.y', y, 'precision', '%.17g');",
        ]
        values = [read_task.rates(task, t, x, u)]
        values += [read_task.evaluate(task, side, t) for side in ("reference", "upper")]
        values += [read_task.evaluate(task, "constraints", t, x)]
        expected.append(np.concatenate(values, axis=1)[rows].T)
    script = tmp_path / "compare.m"
    script.write_text("\n".join(lines))
    subprocess.run(["octave-cli", "--norc", str(script)], check=True, capture_output=True)
    for name, values in zip(EXPRESSED, expected, strict=True):
        found = np.loadtxt(tmp_path / f"{name}.y", delimiter=",", ndmin=2)
        scale = np.abs(np.where(np.isfinite(values), values, 0.0)).max(axis=1, keepdims=True)
        same = (found == values) | (np.isnan(found) & np.isnan(values))
        with np.errstate(invalid="ignore"):
            assert (same | (np.abs(found - values) <= 1e-10 * scale)).all(), name
