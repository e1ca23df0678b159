"""Scenario files: what is saved comes back equal, and what is wrong is a ValueError that says
where."""

from __future__ import annotations

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

import iblf_jax as ij
from iblf_jax.core.pytree import layers
from iblf_jax.files import scenario as scenario_file
from iblf_jax.files.study import load_study_file


def assert_equal(a: ij.Scenario, b: ij.Scenario) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.shape == y.shape
        assert x.dtype == y.dtype
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


TWO_JOINTS = [robot for robot in members.ROBOTS.values() if robot.n == 2]
IN_THE_PLANE = [members.REGIONS[name] for name in ("half_space", "sphere")]
TWO_JOINTS.append(ij.robots.PlanarChain(mass=[1.0, 2.0], length=0.3, centre=0.1, inertia=0.02))

WITH_CONDITIONS = (
    ij.controllers.AdaptiveParameters,
    ij.controllers.EventCompensated,
    ij.controllers.TerminalSlidingMode,
)
"""Laws whose numbers have conditions besides their signs, which random bits do not fulfil."""


@st.composite
def scenarios(draw) -> ij.Scenario:
    """Any combination of members, with random bits in every leaf."""

    def one(family):
        return draw(st.sampled_from(list(family.values())))

    def both_sides():
        return ij.bounds.Bounds(one(members.SIDES), one(members.SIDES))

    plant, law = draw(st.sampled_from(TWO_JOINTS)), one(members.LAWS)
    limited = members.keeps_velocities(law) or draw(st.booleans())
    scenario = ij.Scenario(
        plant=plant,
        model=draw(st.sampled_from([plant, *TWO_JOINTS])),
        reference=one(members.REFERENCES),
        bounds=(both_sides(), both_sides() if limited else None),
        controller=law,
        observer=one(members.OBSERVERS),
        disturbance=one(members.DISTURBANCES),
        initial=ij.Initial(q=0.5),
        regions=tuple(draw(st.lists(st.sampled_from(IN_THE_PLANE), max_size=2))),
    )
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    dtype = draw(st.sampled_from(["float64", "float32"]))
    scenario = ij.astype(scenario, dtype)
    decades = 30 if dtype == "float32" else 300

    def other(x):
        return jnp.asarray(
            np.abs(rng.standard_normal(x.shape)) * 10.0 ** rng.uniform(-decades, decades, x.shape),
            dtype,
        )

    if draw(st.booleans()):
        return scenario
    changed = jax.tree.map(other, scenario)
    if any(isinstance(layer, WITH_CONDITIONS) for layer in layers(law)):
        # `dataclasses.replace` would check the combination of the parts.
        object.__setattr__(changed, "controller", scenario.controller)
    return changed


@pytest.mark.slow
@hypothesis.settings(max_examples=40)
@hypothesis.given(scenarios())
def test_a_saved_scenario_comes_back_equal(scenario):
    text = scenario_file.scenario_to_toml(scenario, run={"duration": 1.0})
    back = scenario_file.from_dict(tomllib.loads(text))
    assert_equal(scenario, back.scenario)
    assert back.run == {"duration": 1.0}
    assert tomllib.loads(text) == scenario_file.scenario_to_dict(scenario) | {
        "run": {"duration": 1.0}
    }


OTHER_FAMILIES = ("plant ", "sensor ", "actuator ", "process_noise ")
OF_FUNCTIONS = ("strict_feedback", "strict_feedback_diagonal", "diffusion", "diffusion_additive")
"""Members with fields that are functions, which no file holds."""


@pytest.mark.slow
def test_members_of_the_other_families_come_back_equal():
    """With the sampling of the loop, whose queue follows from its delay."""
    for name, make in scenarios_of_members.scenarios().items():
        if not name.startswith(OTHER_FAMILIES) or name.endswith(OF_FUNCTIONS):
            continue
        scenario = make()
        if scenario.sampling is not None:
            sampling = ij.Sampling(period=2e-3, delay=5e-3)
            scenario = ij.with_parts(scenario, sampling=sampling)
        text = scenario_file.scenario_to_toml(scenario)
        assert_equal(scenario, scenario_file.from_dict(tomllib.loads(text)).scenario)


@pytest.mark.parametrize("robot", ["chain_1", "chain_3"])
def test_other_numbers_of_joints(robot, tmp_path):
    scenario = ij.Scenario(
        plant=members.ROBOTS[robot],
        reference=ij.references.Sinusoid(0.0, 0.1),
        bounds=ij.bounds.Bounds(ij.bounds.Constant(-1.0), ij.bounds.Constant(1.0)),
        controller=ij.controllers.Backstepping(2.0, 20.0),
        initial=ij.Initial(0.1),
    )
    ij.save_scenario(scenario, tmp_path / "a.toml")
    assert_equal(scenario, ij.load_scenario(tmp_path / "a.toml"))


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
        assert header in text
        assert ("[[bounds]]" in text) == (header == "\n[[bounds]]\n")
        assert_equal(scenario, ij.load_scenario(place))


def of_earlier_version(scenario: ij.Scenario) -> dict[str, Any]:
    """The tables as versions wrote them that had the bounds of other levels in fields of their
    own.
    """
    tables = scenario_file.scenario_to_dict(scenario)
    first, *levels = tables["bounds"]
    tables["bounds"] = first
    if ij.plants.order_of(scenario.plant) > 2:
        return tables | {"state_bounds": levels}
    return tables | {"velocity_bounds": levels[0]}


@pytest.mark.parametrize(
    ("preset", "header"),
    [
        ("zhang_yan_2024_full_state", "\n[velocity_bounds.lower]\n"),
        ("motor_driven_pendulum", "\n[[state_bounds]]\n"),
        ("flexible_joint_two_link", "state_bounds = ["),
    ],
)
def test_files_of_earlier_versions_load(preset, header, tmp_path):
    scenario = ij.presets.PRESETS[preset]()
    text = tomli_w.dumps(of_earlier_version(scenario))
    assert header in text
    (tmp_path / "a.toml").write_text(text)
    assert_equal(scenario, ij.load_scenario(tmp_path / "a.toml"))


def test_tables_of_earlier_versions_that_contradict_each_other_are_refused():
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
        with pytest.raises(ValueError, match=message):
            scenario_file.from_dict(tables | {"state_bounds": levels})


def test_parameters_of_a_file_have_short_and_earlier_paths():
    text = """preset = "motor_driven_pendulum"
[parameters]
"bounds.lower.value" = -1.3
"velocity_bounds.upper.value" = 2.7
"state_bounds[1].lower.value" = -2.8
"bounds[2].upper.value" = 2.9
"""
    found = scenario_file.from_dict(tomllib.loads(text)).scenario.bounds
    assert float(found[0].lower.value[0]) == -1.3
    assert float(found[1].upper.value[0]) == 2.7
    assert [float(x[0]) for x in (found[2].lower.value, found[2].upper.value)] == [-2.8, 2.9]


def test_the_same_robot_is_written_once(paper):
    tables = scenario_file.scenario_to_dict(paper)
    assert "robot" in tables
    assert "plant" not in tables
    assert "model" not in tables
    other = ij.with_parameters(paper, {"plant.payload": 0.5})
    tables = scenario_file.scenario_to_dict(other)
    assert tables["plant"]["payload"] == 0.5
    assert tables["model"]["payload"] == 0.0


def test_numbers_carry_their_units(paper):
    text = scenario_file.scenario_to_toml(paper)
    assert "K2 = [20.0, 20.0]  # N m s/rad\n" in text
    assert "mass = [2.0, 0.85]  # kg\n" in text


def test_scalars_and_defaults_are_filled_in(paper):
    tables = scenario_file.scenario_to_dict(paper)
    tables["controller"] = {"kind": "backstepping", "k1": 2, "K2": 20}
    tables["observer"] = {"kind": "printed", "kf": 20}
    tables["initial"] = {"q": 0.8}
    assert_equal(scenario_file.from_dict(tables).scenario, paper)


def test_a_preset_with_arguments_and_parameters(tmp_path):
    (tmp_path / "a.toml").write_text(
        'preset = "zhang_yan_2024"\n[arguments]\nlaw = "log"\np = 2\n[parameters]\n"robot.mass[1]"'
        " = 1.1\ncontroller.K2 = 30\n"
    )
    expected = ij.with_parameters(
        ij.presets.zhang_yan_2024(law="log", p=2), {"robot.mass[1]": 1.1, "controller.K2": 30.0}
    )
    assert_equal(ij.load_scenario(tmp_path / "a.toml"), expected)


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
        with pytest.raises(ValueError, match=message):
            ij.load_scenario(tmp_path / "b.toml")


def test_users_classes_are_refused_until_they_have_a_name(paper, monkeypatch):
    @ij.component
    class Doubled:
        inner: ij.controllers.RobotLaw
        factor: jax.Array = ij.leaf("1", shape="scalar", default=2.0)
        label: str = ij.static(default="twice")

        def init(self, q, dq, context):
            return self.inner.init(q, dq, context)

        def command(self, t, q, dq, f_hat, context, state):
            command, rate = self.inner.command(t, q, dq, f_hat, context, state)
            return command._replace(tau=self.factor * command.tau), rate

    mine = dataclasses.replace(paper, controller=Doubled(paper.controller))
    with pytest.raises(
        ValueError,
        match=(
            r"controller: got an object of class Doubled.*backstepping.*MEMBERS\[.my_name.\] ="
            r" Doubled"
        ),
    ):
        scenario_file.scenario_to_dict(mine)
    monkeypatch.setitem(ij.controllers.MEMBERS, "doubled", Doubled)
    text = scenario_file.scenario_to_toml(mine)
    assert "[controller.inner.barrier]" in text
    assert_equal(scenario_file.from_dict(tomllib.loads(text)).scenario, mine)
    monkeypatch.delitem(ij.controllers.MEMBERS, "doubled")
    remedy = (
        r"controller\.kind.*If it is your own class, register it first:"
        r" iblf_jax\.controllers\.MEMBERS\[.doubled.\] = TheClass"
    )
    with pytest.raises(ValueError, match=remedy):
        scenario_file.from_dict(tomllib.loads(text))


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
    with pytest.raises(ValueError, match="scenario: got 3, expected a Scenario"):
        ij.save_scenario(3, tmp_path / "a.toml")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"initial\.q: .*finite"):
        ij.save_scenario(_with_start_times(paper, jnp.nan), tmp_path / "a.toml")
    with pytest.raises(ValueError, match="one by one"):
        ij.save_scenario(jax.tree.map(lambda x: jnp.stack([x, x, x]), paper), tmp_path / "a.toml")
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda s: ij.save_scenario(s, tmp_path / "a.toml"))(paper)
    with pytest.raises(ValueError, match=r"run\.dt: got 0"):
        ij.save_scenario(paper, tmp_path / "a.toml", run={"dt": 0})
    assert not (tmp_path / "a.toml").exists()


def _with_start_times(scenario: ij.Scenario, value: Any) -> ij.Scenario:
    initial = jax.tree.map(lambda x: x * value, scenario.initial)
    return dataclasses.replace(scenario, initial=initial)


# --- bad files


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


WRONG = [
    ("contrller", {}, "contrller: got an unknown key, .*Did you mean controller"),
    ("controller.K3", 1.0, r"controller\.K3: got an unknown key, .*There are: k1, K2"),
    (
        "controller.kind",
        ...,
        r"controller\.kind: got nothing, expected the name of one of the controllers: backstepping",
    ),
    (
        "controller.kind",
        "back_stepping",
        r"controller\.kind: got 'back_stepping', .*Did you mean backstepping",
    ),
    ("controller.kind", 3, r"controller\.kind: got 3"),
    (
        "controller.K2",
        "20",
        r"controller\.K2: got '20', expected a number or a list of numbers \[N m s/rad\]",
    ),
    ("controller.K2", True, r"controller\.K2: got True"),
    ("controller.K2", ..., r"controller\.K2: got nothing, .*Add K2 to \[controller\]"),
    ("controller.K2", -1.0, r"controller\.K2: got -1.*> 0"),
    ("controller.K2", [1.0, 2.0, 3.0], r"controller\.K2: .*one a joint.*shape is \(3,\)"),
    ("controller.K2", [1.0, [2.0]], r"controller\.K2: .*rectangular"),
    ("controller.K2", float("nan"), r"controller\.K2: got nan"),
    ("controller.variant", "prnted", r"controller\.variant: got 'prnted'"),
    ("controller.variant", ["printed"], r"controller\.variant: .*a string, not a list"),
    ("controller.barrier", "log", r"controller\.barrier: got 'log', expected a table"),
    ("controller.barrier.kind", "lg", r"controller\.barrier\.kind: .*Did you mean log"),
    (
        "controller.barrier.guard",
        "small",
        r"controller\.barrier\.guard: got 'small', expected a finite number",
    ),
    ("controller.barrier.guard", float("inf"), r"controller\.barrier\.guard: got inf"),
    ("bounds.lower", ..., r"bounds\.lower: got nothing"),
    ("bounds.kind", "bounds", r"bounds\.kind: got an unknown key"),
    ("robot.mass", [1.0, 2.0, 3.0], r"robot\.mass: .*shape \(2,\)"),
    ("robot.mass", ..., r"robot\.mass: got nothing, .*\[kg\].*Add mass to \[robot\]"),
    ("robot", ..., r"robot: got nothing, expected a table \[robot\], or \[plant\] and \[model\]"),
    ("plant", {"kind": "two_link"}, r"plant: got this table besides \[robot\]"),
    ("initial.q", 10**400, r"initial\.q: .*fits into a float"),
    ("initial.q", [], r"initial\.q: .*shape is \(0,\)"),
    ("disturbance", {"kind": "sum", "parts": 3}, r"disturbance\.parts: got 3, expected a list"),
    (
        "disturbance",
        {"kind": "sum", "parts": [{"kind": "step", "size": 1.0}]},
        r"disturbance\.parts\[0\]\.time: got nothing",
    ),
    (
        "reference",
        {"kind": "waypoint_spline", "times": [0.0, 1.0], "waypoints": [[0.0, 1.0]]},
        r"reference\.waypoints: .*shape \(2, n\)",
    ),
    (
        "reference",
        {"kind": "waypoint_spline", "times": [1.0, "2"], "waypoints": [[0.0, 1.0]]},
        r"reference\.times\[1\]: got '2'",
    ),
    ("run.dt", 0, r"run\.dt: got 0"),
    ("run.method", "rk5", r"run\.method: got 'rk5'"),
    ("run.steps", 1, r"run\.steps: got an unknown key"),
    ("run", 3, r"run: got 3, expected a table"),
    ("dtype", "float65", "dtype: got 'float65'"),
    ("parameters.controller.K9", 3.0, r"parameters: .*controller\.K9.*Did you mean controller\.K2"),
    ("parameters.controller.K2", "x", r"parameters\.controller\.K2: got 'x'"),
    ("preset", "zhang_yan_2024", r"robot: got this table besides preset"),
]


@pytest.mark.parametrize(
    ("key", "value", "message"), WRONG, ids=[f"{key}={value}"[:40] for key, value, _ in WRONG]
)
def test_what_is_wrong_is_said(key, value, message, paper, tmp_path):
    path = tmp_path / "wrong.toml"
    path.write_text(tomli_w.dumps(changed(scenario_file.scenario_to_dict(paper), key, value)))
    with pytest.raises(ValueError, match=r"wrong\.toml: " + message):
        ij.load_scenario(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('preset = "zhang_yan"', "preset: got 'zhang_yan'.*zhang_yan_2024"),
        ("preset = 3", "preset: got 3"),
        (
            'preset = "zhang_yan_2024"\n[arguments]\nlw = "log"',
            r"arguments\.lw: .*Did you mean law",
        ),
        (
            'preset = "zhang_yan_2024"\n[arguments]\np = "2"',
            r"arguments\.p: got '2', expected a whole number",
        ),
        ('preset = "zhang_yan_2024"\n[arguments]\nlaw = "lag"', r"law: got 'lag'"),
        (
            'preset = "zhang_yan_2024"\n[argument]\nlaw = "log"',
            r"argument: got an unknown key, .*arguments",
        ),
        ("a = ", "not a TOML file"),
        ("\x00", "not a TOML file"),
        ("", "robot: got nothing"),
        ("a = " + "[" * 100_000, "not a TOML file"),
    ],
)
def test_wrong_texts(text, message, tmp_path):
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"wrong\.toml: .*" + message):
        ij.load_scenario(path)


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(FileNotFoundError):
        ij.load_scenario(tmp_path / "none.toml")
    (tmp_path / "a.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="not a TOML file"):
        ij.load_scenario(tmp_path / "a.toml")


def _keys(tables: dict[str, Any], prefix: str = "") -> list[str]:
    found = []
    for key, value in tables.items():
        found.append(prefix + key)
        if isinstance(value, dict):
            found += _keys(value, prefix + key + ".")
    return found


JUNK = st.one_of(
    st.booleans(),
    st.integers(-(10**30), 10**30),
    st.floats(),
    st.text(max_size=5),
    st.dates(),
    st.lists(
        st.one_of(
            st.floats(), st.integers(), st.text(max_size=2), st.lists(st.floats(), max_size=3)
        ),
        max_size=4,
    ),
    st.dictionaries(
        st.sampled_from(["kind", "a", "mass"]),
        st.sampled_from(["log", "sum", "none", 1.0]),
        max_size=2,
    ),
    st.just(...),
)


@functools.cache
def paper_file() -> str:
    """The file of the paper's scenario."""
    return scenario_file.scenario_to_toml(ij.presets.zhang_yan_2024())


@pytest.mark.slow
@hypothesis.settings(max_examples=120)
@hypothesis.given(data=st.data())
def test_malformed_files_are_value_errors_only(data):
    tables = tomllib.loads(paper_file()) | {"run": {"duration": 1.0}}
    key = data.draw(
        st.sampled_from(
            [*_keys(tables), "controller.x", "x", "parameters", "arguments", "preset", "dtype"]
        )
    )
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
    path.write_text(
        text[:place] + insert + text[place + cut :], encoding="utf-8", errors="surrogatepass"
    )
    error = refusal(lambda: ij.load_scenario(path))
    assert error is None or error.startswith(str(path))


def refusal(load: Callable[[], Any]) -> str | None:
    """The text of the ValueError that `load` raises; an error of another kind passes through."""
    try:
        load()
    except ValueError as error:
        return str(error)
    return None


OF_AN_EARLIER_VERSION = """
kind = "full_state"
k1 = 2.0  # 1/s
K2 = [20.0, 15.0]  # 1/s
c = 8.0  # rad^2/s^3
o = 0.1  # 1/s^2
weight = [0.5, 2.0]

[barrier]
kind = "integral"

[velocity_barrier]
kind = "tan"

[[decays]]
kind = "finite_time"
k_a = 1.0
"""


def test_a_file_of_an_earlier_version_may_have_the_law_of_two_levels(tmp_path):
    path = tmp_path / "scenario.toml"
    ij.save_scenario(ij.presets.zhang_yan_2024_full_state(), path)
    data = tomllib.loads(path.read_text())
    data["controller"] = tomllib.loads(OF_AN_EARLIER_VERSION)
    path.write_text(tomli_w.dumps(data))
    law = members.two_barriers(
        K2=[20.0, 15.0],
        c=8.0,
        second=ij.barriers.Tan(),
        weight=[0.5, 2.0],
        o=0.1,
        decays=ij.decays.FiniteTime(k_a=1.0),
    )
    expected = ij.with_parts(ij.presets.zhang_yan_2024_full_state(), controller=law)
    found = ij.load_scenario(path)
    assert jax.tree.structure(found.controller) == jax.tree.structure(expected.controller)
    for one, same in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, same)
    path.write_text(path.read_text().replace("k1 = 2.0", "k_1 = 2.0"))
    with pytest.raises(ValueError, match="controller"):
        ij.load_scenario(path)
