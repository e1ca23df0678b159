"""Scenario files: what is saved comes back equal, and errors say where they are."""

import copy
import dataclasses
import functools
import tomllib
from collections.abc import Callable
from typing import Any

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import members
import numpy as np
import pytest
import scenarios_of_members
import tomli_w
from loops_of_plants import flexible_joint, rigid_law, user_functions
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.core.pytree import layers
from iblf_jax.files import scenario as scenario_file
from iblf_jax.files.study import load_study_file


def assert_equal(a: ij.Scenario, b: ij.Scenario) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.shape == y.shape and x.dtype == y.dtype
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


OF_FUNCTIONS = (
    *("strict_feedback", "strict_feedback_diagonal", "diffusion", "diffusion_additive"),
    "barrier_backstepping_damped",
)
"""Members with fields that are functions, which no file holds."""
OWN_NUMBERS = (
    *("plant ", "sensor ", "actuator ", "process_noise ", "robot arm", "reference ellipse"),
    *("region half_space_of_the_elbow", "region sphere_inside"),
    *("law backstepping_corrected_log", "law barrier_backstepping_matrices"),
)
"""Families and members with conditions besides signs, which random bits do not fulfil."""
OWN_NUMBERS_OF_LAW = (
    ij.controllers.AdaptiveParameters,
    ij.controllers.EventCompensated,
    ij.controllers.TerminalSlidingMode,
)


def assert_comes_back(scenario: ij.Scenario) -> None:
    text = scenario_file.scenario_to_toml(scenario, run={"duration": 1.0})
    back = scenario_file.from_dict(tomllib.loads(text))
    assert_equal(scenario, back.scenario)
    assert back.run == {"duration": 1.0}
    tables = scenario_file.scenario_to_dict(scenario) | {"run": {"duration": 1.0}}
    assert tomllib.loads(text) == tables


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "decades"), [("float64", 300), ("float32", 30)])
def test_a_scenario_of_every_member_comes_back_equal(dtype, decades):
    """With its own numbers, and with random bits in every leaf. The queue of a sampled loop follows
    from its delay."""
    rng = np.random.default_rng(decades)

    def other(x):
        size = 10.0 ** rng.uniform(-decades, decades, x.shape)
        return jnp.asarray(np.abs(rng.standard_normal(x.shape)) * size, dtype)

    for name, make in (scenarios_of_members.scenarios() | {"plant rigid law": rigid_law}).items():
        if name.endswith(OF_FUNCTIONS):
            continue
        scenario = ij.astype(make(), dtype)
        if scenario.sampling is not None:
            sampling = ij.Sampling(period=2e-3, delay=5e-3)
            scenario = ij.astype(ij.with_parts(scenario, sampling=sampling), dtype)
        assert_comes_back(scenario)
        if name.startswith(OWN_NUMBERS):
            continue
        changed = jax.tree.map(other, scenario)
        if any(isinstance(layer, OWN_NUMBERS_OF_LAW) for layer in layers(scenario.controller)):
            # `dataclasses.replace` would check the combination of the parts.
            object.__setattr__(changed, "controller", scenario.controller)
        assert_comes_back(changed)


WALL = ij.Bounds(lower=ij.bounds.Constant(-1.5), upper=ij.bounds.Constant(2.0))


def test_bounds_are_a_table_or_one_for_each_level(paper, tmp_path):
    """A file with bounds of the first level alone has no list of tables."""
    place = tmp_path / "a.toml"
    for scenario, header in (
        (paper, "\n[bounds.lower]\n"),
        (ij.with_parts(paper, bounds=(paper.bounds[0], WALL)), "\n[[bounds]]\n"),
        (ij.presets.flexible_joint_two_link(), '\n    "none",\n'),
    ):
        ij.save_scenario(scenario, place)
        text = place.read_text()
        assert header in text and ("[[bounds]]" in text) == (header == "\n[[bounds]]\n")
        assert_equal(scenario, ij.load_scenario(place))


def of_earlier_version(scenario: ij.Scenario) -> dict[str, Any]:
    """The tables of versions that had the bounds of other levels in fields of their own."""
    tables = scenario_file.scenario_to_dict(scenario)
    first, *levels = tables["bounds"]
    tables["bounds"] = first
    if ij.plants.order_of(scenario.plant) > 2:
        return tables | {"state_bounds": levels}
    return tables | {"velocity_bounds": levels[0]}


def test_tables_of_earlier_versions_load_and_are_refused_where_they_contradict_each_other():
    """`data/earlier` has files with one of the forms of the law of two levels."""
    flexible = ij.presets.flexible_joint_two_link()
    tables = of_earlier_version(flexible)
    assert "none" in tables["state_bounds"]
    assert_equal(flexible, scenario_file.from_dict(tables).scenario)
    tables = of_earlier_version(ij.presets.zhang_yan_2024_full_state())
    speeds = tables["velocity_bounds"]
    same = scenario_file.from_dict(tables).scenario
    for levels in ([], ["none"]):
        assert_equal(scenario_file.from_dict(tables | {"state_bounds": levels}).scenario, same)
    for levels, message in (
        ([speeds], "state_bounds: .* either velocity_bounds or state_bounds"),
        (3, "state_bounds: got 3, expected a list"),
        (["none", speeds], "bounds: got '3 bounds', expected at most 2"),
    ):
        assert_refused(message, scenario_file.from_dict, tables | {"state_bounds": levels})
    numbers = {"K2": [20.0, 15.0], "c": 8.0, "weight": [0.5, 2.0], "o": 0.1}
    parts = {"second": ij.barriers.Tan(), "decays": ij.decays.FiniteTime(k_a=1.0)}
    present = members.two_barriers(**numbers, **parts)
    expected = ij.with_parts(ij.presets.zhang_yan_2024_full_state(), controller=present)
    law = {"kind": "full_state", "k1": 2.0, "K2": [20.0, 15.0], "c": 8.0, "o": 0.1}
    law |= {"weight": [0.5, 2.0], "decays": [{"kind": "finite_time", "k_a": 1.0}]}
    law |= {"barrier": {"kind": "integral"}, "velocity_barrier": {"kind": "tan"}}
    tables = scenario_file.scenario_to_dict(expected) | {"controller": law}
    found = scenario_file.from_dict(tables).scenario
    assert jax.tree.structure(found.controller) == jax.tree.structure(expected.controller)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    law["k_1"] = law.pop("k1")
    assert_refused("controller", scenario_file.from_dict, tables)


def test_the_same_robot_is_written_once_numbers_carry_their_units_and_defaults_are_filled_in(paper):
    tables = scenario_file.scenario_to_dict(paper)
    assert "robot" in tables and not {"plant", "model"} & set(tables)
    tables = scenario_file.scenario_to_dict(ij.with_parameters(paper, {"plant.payload": 0.5}))
    assert tables["plant"]["payload"] == 0.5 and tables["model"]["payload"] == 0.0
    text = scenario_file.scenario_to_toml(paper)
    assert "K2 = [20.0, 20.0]  # N m s/rad\n" in text
    assert "mass = [2.0, 0.85]  # kg\n" in text
    tables = scenario_file.scenario_to_dict(paper)
    tables["controller"] = {"kind": "backstepping", "k1": 2, "K2": 20}
    tables["observer"] = {"kind": "printed", "kf": 20}
    tables["initial"] = {"q": 0.8}
    assert_equal(scenario_file.from_dict(tables).scenario, paper)


def test_a_preset_with_arguments_and_parameters_by_short_and_earlier_paths(tmp_path):
    text = 'preset = "zhang_yan_2024"\n[arguments]\nlaw = "log"\np = 2\n'
    text += '[parameters]\n"robot.mass[1]" = 1.1\ncontroller.K2 = 30\n'
    (tmp_path / "a.toml").write_text(text)
    values = {"robot.mass[1]": 1.1, "controller.K2": 30.0}
    expected = ij.with_parameters(ij.presets.zhang_yan_2024(law="log", p=2), values)
    assert_equal(ij.load_scenario(tmp_path / "a.toml"), expected)
    text = """preset = "motor_driven_pendulum"
[parameters]
"bounds.lower.value" = -1.3
"velocity_bounds.upper.value" = 2.7
"state_bounds[1].lower.value" = -2.8
"bounds[2].upper.value" = 2.9
"""
    found = scenario_file.from_dict(tomllib.loads(text)).scenario.bounds
    assert float(found[0].lower.value[0]) == -1.3 and float(found[1].upper.value[0]) == 2.7
    assert [float(x[0]) for x in (found[2].lower.value, found[2].upper.value)] == [-2.8, 2.9]


def test_a_file_takes_the_tables_of_another_one(paper, tmp_path):
    (tmp_path / "below").mkdir()
    ij.save_scenario(paper, tmp_path / "below" / "a.toml", run={"duration": 3.0, "dt": 2e-3})
    own = 'scenario = "below/a.toml"\n[parameters]\ncontroller.K2 = 30\n[run]\ndt = 1e-3\n'
    (tmp_path / "b.toml").write_text(own)
    found = scenario_file.load_scenario_file(tmp_path / "b.toml")
    assert_equal(found.scenario, ij.with_parameters(paper, {"controller.K2": 30.0}))
    assert found.run == {"duration": 3.0, "dt": 1e-3}
    study = own + '[perturbations]\n"plant.mass" = { factor = "uniform", low = 0.9, high = 1.1 }\n'
    (tmp_path / "c.toml").write_text(study + "[study]\nruns = 4\n")
    assert load_study_file(tmp_path / "c.toml", "study").options["duration"] == 3.0
    for text, message in (
        (own + "[observer]\n", r"b\.toml: observer: got an unknown key"),
        ('scenario = "b.toml"', r"b\.toml: b\.toml\.scenario: got an unknown key"),
        ("scenario = 3", r"b\.toml: scenario: got 3, expected the path of a scenario file"),
    ):
        (tmp_path / "b.toml").write_text(text)
        assert_refused(message, ij.load_scenario, tmp_path / "b.toml")


def test_none_where_the_default_is_something_else(paper, monkeypatch):
    @ij.component
    class Limited:
        limit: jax.Array | None = ij.leaf("rad", default=None)
        word: str | None = ij.static(default="a")

        def at(self, t, q_d):
            return q_d + 1.0

    monkeypatch.setitem(ij.bounds.MEMBERS, "limited", Limited)
    for upper in (Limited(), Limited(limit=1.0), Limited(word=None)):
        mine = dataclasses.replace(paper, bounds=dataclasses.replace(paper.bounds[0], upper=upper))
        assert_equal(scenario_file.from_dict(scenario_file.scenario_to_dict(mine)).scenario, mine)


def test_what_cannot_be_saved(paper, tmp_path):
    start = jax.tree.map(lambda x: x * jnp.nan, paper.initial)
    for scenario, words in (
        (3, "scenario: got 3, expected a Scenario"),
        (dataclasses.replace(paper, initial=start), r"initial\.q: .*finite"),
        (jax.tree.map(lambda x: jnp.stack([x, x, x]), paper), "one by one"),
        (user_functions(), r"plant\.drift: got a function.*method of a class"),
    ):
        assert_refused(words, ij.save_scenario, scenario, tmp_path / "a.toml")
    assert_refused("traced", jax.jit(lambda s: ij.save_scenario(s, tmp_path / "a.toml")), paper)
    assert_refused(r"run\.dt: got 0", ij.save_scenario, paper, tmp_path / "a.toml", run={"dt": 0})
    assert not (tmp_path / "a.toml").exists()


def changed(tables: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A copy with one dotted key set, or removed for `...`."""
    tables = copy.deepcopy(tables)
    *way, last = key.split(".")
    inside = tables
    for name in way:
        inside = inside.setdefault(name, {})
    if value is ...:
        del inside[last]
    else:
        inside[last] = value
    return tables


STEP = {"kind": "step", "size": 1.0}
SPLINE = {"kind": "waypoint_spline", "times": [0.0, 1.0], "waypoints": [[0.0, 1.0]]}
WRONG = [
    ("contrller", {}, "contrller: got an unknown key, .*Did you mean controller"),
    ("controller.K3", 1.0, r"controller\.K3: got an unknown key, .*There are: k1, K2"),
    ("controller.kind", ..., "kind: got nothing, expected the name of one of the .*: backstepping"),
    ("controller.kind", "back_stepping", "kind: got 'back_stepping', .*Did you mean backstepping"),
    ("controller.K2", "20", r"K2: got '20', expected a number or a list of .*\[N m s/rad\]"),
    ("controller.K2", ..., r"controller\.K2: got nothing, .*Add K2 to \[controller\]"),
    ("controller.K2", -1.0, r"controller\.K2: got -1.*> 0"),
    ("controller.K2", [1.0, 2.0, 3.0], r"controller\.K2: .*one a joint.*shape is \(3,\)"),
    ("controller.K2", float("nan"), r"controller\.K2: got nan"),
    ("controller.variant", ["printed"], r"controller\.variant: .*a string, not a list"),
    ("controller.barrier", "log", r"controller\.barrier: got 'log', expected a table"),
    ("controller.barrier.kind", "lg", r"controller\.barrier\.kind: .*Did you mean log"),
    ("controller.barrier.guard", "small", r"guard: got 'small', expected a finite number"),
    ("bounds.lower", ..., r"bounds\.lower: got nothing"),
    ("robot.mass", ..., r"robot\.mass: got nothing, .*\[kg\].*Add mass to \[robot\]"),
    ("robot", ..., r"robot: got nothing, expected a table \[robot\], or \[plant\] and \[model\]"),
    ("plant", {"kind": "two_link"}, r"plant: got this table besides \[robot\]"),
    ("initial.q", 10**400, r"initial\.q: .*fits into a float"),
    ("disturbance", {"kind": "sum", "parts": 3}, r"parts: got 3, expected a list"),
    ("disturbance", {"kind": "sum", "parts": [STEP]}, r"parts\[0\]\.time: got nothing"),
    ("reference", SPLINE, r"reference\.waypoints: .*shape \(2, n\)"),
    ("reference", SPLINE | {"times": [1.0, "2"]}, r"reference\.times\[1\]: got '2'"),
    ("run.dt", 0, r"run\.dt: got 0"),
    ("run.method", "rk5", r"run\.method: got 'rk5'"),
    ("run", 3, r"run: got 3, expected a table"),
    ("dtype", "float65", "dtype: got 'float65'"),
    ("parameters.controller.K9", 3.0, r"parameters: .*Did you mean controller\.K2"),
    ("parameters.controller.K2", "x", r"parameters\.controller\.K2: got 'x'"),
    ("preset", "zhang_yan_2024", r"robot: got this table besides preset"),
]
PRESET = 'preset = "zhang_yan_2024"\n'
WRONG_TEXTS = [
    ('preset = "zhang_yan"', "preset: got 'zhang_yan'.*zhang_yan_2024"),
    (f'{PRESET}[arguments]\nlw = "log"', r"arguments\.lw: .*Did you mean law"),
    (f'{PRESET}[arguments]\np = "2"', r"arguments\.p: got '2', expected a whole number"),
    (f'{PRESET}[argument]\nlaw = "log"', r"argument: got an unknown key, .*arguments"),
    (f"{PRESET}[study]\nruns = 9", "study: got a table, .*`iblf-jax montecarlo` reads"),
    ("\x00", "not a TOML file"),
    ("", "robot: got nothing"),
    ("a = " + "[" * 100_000, "not a TOML file"),
]


def test_what_is_wrong_is_named(paper, tmp_path):
    tables = scenario_file.scenario_to_dict(paper)
    wrong = [(tomli_w.dumps(changed(tables, *change)), words) for *change, words in WRONG]
    path = tmp_path / "wrong.toml"
    for text, words in wrong + WRONG_TEXTS:
        path.write_text(text)
        assert_refused(rf"wrong\.toml: .*{words}", ij.load_scenario, path)
    path.write_bytes(b"\xff\xfe\x00")
    assert_refused("not a TOML file", ij.load_scenario, path)
    tables = scenario_file.scenario_to_dict(flexible_joint())
    with pytest.raises(ValueError, match=r"controller\.k: got nothing.*one per level"):
        scenario_file.from_dict(changed(tables, "controller.k", ...))
    with pytest.raises(FileNotFoundError):
        ij.load_scenario(tmp_path / "none.toml")


def _keys(tables: dict[str, Any], prefix: str = "") -> list[str]:
    found = []
    for key, value in tables.items():
        found.append(prefix + key)
        if isinstance(value, dict):
            found += _keys(value, prefix + key + ".")
    return found


ENTRY = st.floats() | st.integers() | st.text(max_size=2) | st.lists(st.floats(), max_size=3)
NAMES, VALUES = st.sampled_from(["kind", "a", "mass"]), st.sampled_from(["log", "sum", "none", 1.0])
JUNK = st.one_of(
    *(st.booleans(), st.integers(-(10**30), 10**30), st.floats(), st.text(max_size=5), st.dates()),
    *(st.lists(ENTRY, max_size=4), st.dictionaries(NAMES, VALUES, max_size=2), st.just(...)),
)


@functools.cache
def paper_file() -> str:
    return scenario_file.scenario_to_toml(ij.presets.zhang_yan_2024())


@pytest.mark.slow
@hypothesis.settings(max_examples=120)
@hypothesis.given(data=st.data())
def test_malformed_files_are_value_errors_only(data):
    tables = tomllib.loads(paper_file()) | {"run": {"duration": 1.0}}
    others = ["controller.x", "x", "parameters", "arguments", "preset", "dtype"]
    key = data.draw(st.sampled_from([*_keys(tables), *others]))
    value = data.draw(JUNK)
    hypothesis.assume(value is not ... or key in _keys(tables))
    text = tomli_w.dumps(changed(tables, key, value))
    error = refusal(lambda: scenario_file.from_dict(tomllib.loads(text), source="file.toml"))
    assert error is None or error.startswith("file.toml: ")


@pytest.mark.slow
@hypothesis.settings(max_examples=200)
@hypothesis.given(place=st.integers(0, 10_000), cut=st.integers(0, 20), insert=st.text(max_size=6))
def test_damaged_texts_are_value_errors_only(place, cut, insert, tmp_path_factory):
    text = paper_file()
    place %= len(text)
    path = tmp_path_factory.getbasetemp() / "damaged.toml"
    damaged = text[:place] + insert + text[place + cut :]
    path.write_text(damaged, encoding="utf-8", errors="surrogatepass")
    error = refusal(lambda: ij.load_scenario(path))
    assert error is None or error.startswith(str(path))


def refusal(load: Callable[[], Any]) -> str | None:
    """The text of the ValueError that `load` raises; an error of another kind passes through."""
    try:
        load()
    except ValueError as error:
        return str(error)
    return None
