"""Bad input is a ValueError that names the field, the value and the remedy; a doubtful one is a
warning."""

import contextlib
import dataclasses
import functools
import re
import warnings
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import entry_cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT, SHORT
from entry_cases import DRAWN, WEAK, Entered, readable, without_runs
from members import FAMILIES

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, disturbances, observers, references, robots
from iblf_jax.core import checks, notices
from iblf_jax.core.pytree import is_leaf_field


def refuses(call, *words):
    """The call raises ValueError with all these words in it."""
    with pytest.raises(ValueError, match=r"(?s)\w+.*: got .*, expected .+") as caught:
        call()
    for word in words:
        assert word in str(caught.value), str(caught.value)


# --- leaves, by what they declare -----------------------------------------------------------------

NO_NUMBERS = (
    *((float("nan"), ""), (True, "real numbers"), (1.0 + 2.0j, "real numbers")),
    *((np.ones(2, complex), "real numbers"), ("2.0", "number"), (np.str_("2"), "number")),
    *(({"a": 1.0}, "number"), ({1.0}, "number"), ([1.0, None], "number"), ([1.0, "2"], "number")),
    (np.ma.array([1.0, 2.0], mask=[False, True]), "number"),
    *((np.asarray([object()]), "number"), (Decimal("2.0"), "number"), (Fraction(2), "number")),
    *((10**400, "number"), (np.sin, "number"), (robots.TwoLink, "number"), ([], "at least one")),
)
OF_SIGN = {
    None: ((np.inf, "finite"),),
    "limit": (),
    "positive": ((np.inf, "finite"), (0.0, "> 0"), (-1.0, "> 0")),
    "positive limit": ((0.0, "> 0"), (-1.0, "> 0")),
    "nonnegative": ((np.inf, "finite"), (-1.0, ">= 0")),
}
OF_SHAPE = {
    "scalar": (([1.0, 2.0], "one number"), ([[1.0], [1.0, 2.0]], "rectangular")),
    "joint": ((np.ones((2, 2)), "(n,)"), ([[1.0], [1.0, 2.0]], "rectangular")),
    "level": ((np.ones((2, 2, 2)), "(m, n)"),),
    "any": (),
}
"""Declaration of a leaf -> values that it refuses, and a word of the message."""
MEMBERS = [
    pytest.param(member, id=f"{family}-{name}")
    for family, (instances, *_) in FAMILIES.items()
    for name, member in {type(x).__name__: x for x in instances.values()}.items()
    if any(map(is_leaf_field, dataclasses.fields(member)))
]


@pytest.mark.parametrize("member", MEMBERS)
def test_every_leaf_refuses_what_does_not_fit_its_declaration(member):
    for field in filter(is_leaf_field, dataclasses.fields(member)):
        declared = field.metadata
        bad = (*NO_NUMBERS, *OF_SIGN[declared["sign"]], *OF_SHAPE[declared["shape"]])
        if field.default is not None:
            bad = (*bad, (None, ""))
        for value, word in bad:
            call = functools.partial(dataclasses.replace, member, **{field.name: value})
            refuses(call, f"{type(member).__name__}.{field.name}", word)


@pytest.mark.parametrize(
    "value", [2, np.float32(2), np.int8(2), np.asarray(2.0), jnp.asarray(2), [2, 2], (2.0, 2)]
)
def test_numbers_that_are_fine(value):
    k1 = controllers.Backstepping(k1=value, K2=20.0).k1
    assert jnp.issubdtype(k1.dtype, jnp.floating)
    np.testing.assert_array_equal(k1, 2.0)


NO_SIZES = (0, -3, 1.5, True, "x", 10**30)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda x: ij.actuators.Delay(delay=1e-3, history=x), "history"),
        (lambda x: controllers.AdaptiveRBF(k1=2.0, K2=20.0, nodes=x), "nodes"),
        (lambda x: controllers.AdaptiveNetwork(k1=2.0, K2=20.0, nodes=x), "nodes"),
        (lambda x: barriers.Log(p=101 if x == 10**30 else x), "p"),
        (lambda x: references.Leader(WEAK.reference, (1.0,), components=x), "components"),
    ],
)
def test_sizes_of_a_component(make, name):
    for value in NO_SIZES:
        refuses(lambda value=value: make(value), name, "whole number")


# --- components and scenarios ---------------------------------------------------------------------

ARM = {"mass": [2.0, 0.85], "length": [0.35, 0.31], "centre": [0.2, 0.15], "inertia": [0.06, 0.02]}


def made(make, *fixed, **more):
    """Calls that make a component with other arguments."""
    return lambda *args, **options: lambda: make(*fixed, *args, **more | options)


arm = made(robots.TwoLink, **ARM)
chain = made(robots.PlanarChain, centre=0.1, inertia=0.1)
law = made(controllers.Backstepping, 2.0, 20.0)
spline = made(references.WaypointSpline)
preset = made(ij.presets.zhang_yan_2024)
COMPONENTS = {
    "TwoLink.mass | (2,)": arm(mass=[1.0] * 3),
    "PlanarChain.length | (2,)": chain(mass=[1.0, 1.0], length=[1.0]),
    "PlanarChain.mass | how many": chain(mass=1.0, length=1.0),
    "Backstepping.variant | 'printed', 'corrected'": law(variant="exact"),
    "variant | hashable": law(variant=np.asarray(["printed"])),
    "Backstepping.barrier | barriers.Integral()": law(barrier="integral"),
    "Backstepping.barrier | brackets": law(barrier=barriers.Log),
    "Integral.guard | between 0 and 1": made(barriers.Integral)(guard=1.5),
    "Log.guard | positive": made(barriers.Log)(guard=0.0),
    "AsPublished.start | 'matched'": made(observers.AsPublished)(kf=20.0, start="cold"),
    "Bounds.lower | Constant(value)": made(bounds.Bounds)(0.1, 0.9),
    "Sum.parts | tuple of disturbances": made(disturbances.Sum)((1.0, 2.0)),
    "Sum.parts | brackets": made(disturbances.Sum)(disturbances.Friction()),
    "WaypointSpline.times | increasing": spline((0.0, 0.0), [[0.0], [1.0]]),
    "WaypointSpline.waypoints | row": spline((0.0, 1.0), [[0.0], [1.0], [2.0]]),
    "WaypointSpline.times | tuple": spline([0.0, 1.0], [[0.0], [1.0]]),
    "law | 'integral', 'log'": preset(law="tangent"),
    "variant | 'printed'": preset(variant=None),
}


def with_part(**parts):
    return lambda: ij.simulate(dataclasses.replace(WEAK, **parts), **SHORT)


def between(lower, upper):
    return with_part(bounds=bounds.Bounds(lower, upper))


TUBE = WEAK.bounds[0]
CHAIN3 = robots.PlanarChain(mass=[1.0, 1.0, 1.0], length=0.3, centre=0.1, inertia=0.1)
MASSLESS = robots.TwoLink(mass=1.0, length=1.0, centre=0.0, inertia=0.0)
SPLINE3 = references.WaypointSpline((0.0, 1.0), [[0.5] * 3, [0.6] * 3])
FORCE3 = disturbances.TipForce(amplitude=[1.0, 2.0, 3.0])
funnel = bounds.Funnel
SCENARIOS = {
    "Scenario.plant | component": with_part(plant=None),
    "Scenario.plant | brackets": with_part(plant=robots.TwoLink),
    "Scenario.plant | lacks | mass_matrix": with_part(plant=bounds.Constant(1.0)),
    "Scenario.model | 3 joints | 2 joints": with_part(model=CHAIN3),
    "got | 3 (one a joint)": with_part(plant=CHAIN3, model=CHAIN3),
    "Scenario.reference | brackets": with_part(reference=references.Sinusoid),
    "reference.position | (3,) | (2,)": with_part(reference=SPLINE3),
    "Scenario.bounds | Bounds(lower=": with_part(bounds=bounds.Constant(0.1)),
    "bounds of joint 0 | lower < upper | Exchange": between(TUBE.upper, TUBE.lower),
    "bounds of joint 0 | as a lower side it takes negative numbers": between(
        funnel(0.3, 0.1, 1.0), funnel(0.3, 0.1, 1.0)
    ),
    "reference of joint 0 | as a lower side it takes negative numbers": between(
        funnel(0.2, 0.1, 1.0), funnel(0.3, 0.1, 1.0)
    ),
    "reference of joint 0 | as an upper side it takes positive numbers": between(
        funnel(-0.3, -0.1, 1.0), funnel(-0.2, -0.1, 1.0)
    ),
    "bounds[0].lower.value | 2 (one a joint)": between(bounds.Constant([0.1] * 3), TUBE.upper),
    "Scenario.controller | check_law": with_part(controller=object()),
    "disturbance.torque | (2,)": with_part(disturbance=FORCE3),
    "initial.q | 2 (one a joint)": with_part(initial=ij.Initial(q=[0.8] * 3)),
    "initial.q[0] | 1.05 | (0.34, 1.04) | Move the start": with_part(
        initial=ij.Initial(q=[1.05, 0.8])
    ),
    "initial.dq | 10000": with_part(initial=ij.Initial(q=0.8, dq=1e5)),
    "reference of joint 0 | Assumption 2": with_part(reference=references.Sinusoid(1.5, 0.1)),
    "plant.mass_matrix | positive definite": with_part(plant=MASSLESS),
    "scenario | float16 | float32": lambda: ij.simulate(ij.astype(WEAK, "float16"), **SHORT),
    "scenario | ij.presets": lambda: ij.simulate({"law": "integral"}, **SHORT),
}


def run_with(**options):
    return lambda: ij.simulate(WEAK, **SHORT | options)


def with_value(path, value=1.0):
    return lambda: ij.with_parameters(WEAK, {path: value})


TIMES = {
    "duration | whole number of steps": run_with(dt=1.0),
    "duration | at most": run_with(dt=1e-300),
    "duration | at most | Shorten": run_with(duration=1e300),
    "0.0105 | whole number | Take duration=0.01 or dt=0.00105": run_with(duration=0.0105),
    "record_every | Take record_every=": run_with(duration=1e6),
}
VALUES = {
    "path | controller.K2": with_value("controller.K3"),
    "path | parameters(scenario)": with_value("engine.power"),
    "path | plant.mass": with_value("plant.mass[2]"),
    "path | K2[0] (joint 0), K2[1] (joint 1)": with_value("controller.K2[elbow]"),
    "names joined by dots": with_value("plant.mass[0:1]"),
    "path: got 'plant.__class__'": with_value("plant.__class__"),
    "path: got 'controller.variant'": with_value("controller.variant"),
    "plant.mass | > 0": with_value("robot.mass", 0.0),
    "initial.q | finite": with_value("initial.q", float("nan")),
    "controller.K2 | (2,)": with_value("controller.K2", [1.0, 2.0, 3.0]),
    "controller.K2 | numbers": with_value("controller.K2", "20"),
    "controller.K2: got None": with_value("controller.K2", None),
    "controller.K2 | real numbers": with_value("controller.K2", 1j),
    "values | mapping": lambda: ij.with_parameters(WEAK, [("controller.K2", 1.0)]),
    "scenario: got 'paper' | ij.presets": lambda: ij.with_parameters("paper", {}),
}
MISSPELT = {
    "part | 'contoller' | Did you mean controller?": lambda: ij.with_parts(
        WEAK, contoller=WEAK.controller
    ),
    "'zzz' | robot, plant": lambda: ij.with_parts(WEAK, zzz=None),
    "Scenario | Did you mean reference?": lambda: dataclasses.replace(WEAK, refrence=1),
    "Backstepping | Did you mean barrier": law(barier=barriers.Log()),
}


REFUSED = COMPONENTS | SCENARIOS | TIMES | VALUES | MISSPELT
"""Words of the message -> a call."""


@pytest.mark.parametrize("words", REFUSED)
def test_words_of_a_refusal(words):
    refuses(REFUSED[words], *words.split(" | "))


def test_nan_that_came_in_by_a_tree_map_is_found_with_its_path():
    scenario = jax.tree.map(lambda x: x, WEAK)
    object.__setattr__(scenario.controller, "K2", jnp.asarray([20.0, jnp.nan]))
    refuses(lambda: ij.simulate(scenario, **SHORT), "controller.K2", "finite")


def test_a_duration_in_float32_is_taken_for_what_it_was():
    with without_runs(), pytest.raises(Entered):
        ij.simulate(WEAK, duration=np.float32(0.5), dt=np.float32(1e-3))
    assert checks.whole_steps(np.float32(0.5), np.float32(1e-3)) == 500


def test_a_traced_step_says_what_to_do():
    with pytest.raises(ValueError, match=r"dt: got a value that JAX is tracing.*static_argnames"):
        jax.jit(lambda dt: ij.simulate(WEAK, duration=0.5, dt=dt).q)(1e-3)


def test_with_parameters_changes_what_it_says_and_nothing_else(paper):
    values = {"controller.K2": 30, "plant.mass[1]": 1.1, "robot.g": 1.62, "initial.q[-1]": 0.7}
    other = ij.with_parameters(paper, values)
    got = {p.path: np.asarray(p.value) for p in ij.parameters(other)}
    expected = {p.path: np.array(p.value) for p in ij.parameters(paper)}
    again = ij.with_parameters(paper, expected)
    assert all(map(np.array_equal, jax.tree.leaves(again), jax.tree.leaves(paper)))
    expected["controller.K2"][:] = 30
    expected["plant.mass"][1] = 1.1
    expected["initial.q"][1] = 0.7
    expected["plant.g"] = expected["model.g"] = np.asarray(1.62)
    for path, value in expected.items():
        np.testing.assert_array_equal(got[path], value, err_msg=path)
    assert float(paper.plant.mass[1]) == 0.85
    assert jax.tree.structure(other) == jax.tree.structure(paper)


MISSING = {
    "Encoder.velocity | nothing | a Velocity | Encoder(velocity=...)": ij.sensors.Encoder,
    "Sampling.period | nothing | [s]": ij.Sampling,
    "Scenario.reference | a Reference": lambda: ij.Scenario(plant=WEAK.plant),
    "Backstepping.K2 | number": lambda: controllers.Backstepping(2.0),
    "Backstepping.k1 | two values": law(k1=3.0),
    "Log | 5 positional arguments": lambda: barriers.Log(1, 2, 3, 4, 5),
}


@pytest.mark.parametrize("words", MISSING)
def test_constructors_name_the_field_that_is_missing(words):
    refuses(MISSING[words], *words.split(" | "))
    # Python itself raises a TypeError, and programs that expect it go on.
    with pytest.raises(TypeError):
        MISSING[words]()


def test_a_component_with_a_constructor_of_its_own_keeps_its_errors():
    @ij.component
    class Own:
        k: float

        def __init__(self, twice: float) -> None:
            object.__setattr__(self, "k", 2.0 * twice)

    assert float(Own(3.0).k) == 6.0
    with pytest.raises(TypeError, match="twice"):
        Own()


# --- arguments, by their names --------------------------------------------------------------------

NAN = float("nan")
NO_WORDS = (None, [], {}, 3, b"rk4", ["rk4"], np.asarray(["rk4", "x"]), "nope", True, NAN)
NO_FACTORS = (None, "x", [], True, 0.0, -1.0, NAN, np.inf, 1j, np.ones(2))
NO_TIMES = (*NO_FACTORS, 5e-324, 3e-300, 1e300, 4e9, 10**30)
NO_SEEDS = (None, "x", [], True, -1, 1.5, NAN, 2**32, 10**30, np.ones(2))
NO_COUNTS = (None, "x", [], True, 0, -3, 1.5, NAN, np.inf, 10**30, 7 * 10**29, np.ones(2))
NO_SCENARIOS = (None, 3, [], {}, "paper", np.ones(2), ij.Scenario, robots.TwoLink)
NO_FLAGS = ("yes", 1, 0.0, [], np.ones(2))
NO_FOLDER = "/proc" if Path("/proc/self").exists() else "/dev/null"
"""A folder in which nobody can make a file."""
LONG_NAME = "a" * 300
NO_PATHS = (3, "a\0b", b"x", [], {}, 1.5, True, LONG_NAME, f"new/{LONG_NAME}/x", "/dev/null/x")

BY_NAME = {
    "scenario": (NO_SCENARIOS, "a Scenario", "ij.presets"),
    "seed": (NO_SEEDS, "whole number"),
    "method": (NO_WORDS, "'rk4'"),
    "backend": (NO_WORDS, "'auto'"),
    "mode": (NO_WORDS, "'forward'"),
    "executor": (("dask", 3, object()), "concurrent.futures.Executor"),
    "tolerance": ((None, "x", -1.0, NAN, 1.5, 1e300), "from 0 to 1"),
    "dt": (NO_FACTORS,),
    **dict.fromkeys(("duration", "period", "window"), (NO_TIMES,)),
    **dict.fromkeys(("record_every", "iterations", "patience"), (NO_COUNTS, "whole number")),
    **dict.fromkeys(("runs", "points", "replicates"), (NO_COUNTS,)),
    **dict.fromkeys(("throw", "equal_effort", "resample", "repair"), (NO_FLAGS, "True or False")),
}
"""Argument of whatever function: values that are refused, and words of the message besides the
argument's name.  None is fine where it is the default."""
OTHERWISE = {"cosimulate", "explore", "gains_for_guarantee", "prove", "save_rollouts", "tune_file"}
"""Functions that check other arguments first, or whose arguments of these names are different."""
OF_ONE = {
    "falsify starts": (NO_COUNTS,),
    "explore scenario": (NO_SCENARIOS,),
    "Sampling queue": ((-1, 1.5, "x", True, 2_000_000, 10**30), "whole number"),
    "Sampling period": ((1e300, 5e-324, 0.0, -1.0, "x", None),),
    "Sampling delay": ((1e300, 5e-324, -1.0, "x", 1e6),),
    "LocalExecutor chunk": (NO_COUNTS[1:], "whole number"),
    "LocalExecutor memory": ((None, "x", [], 0, -1, 5e-324, 1e300, 10**30, np.inf), "bytes"),
    "LocalExecutor devices": (([],), "at least one"),
    "StoreOptions unit": (NO_COUNTS[1:], "whole number"),
    "StoreOptions writer": (NO_WORDS, "'client'", "'worker'"),
    "sweep store": (NO_PATHS[:7], "path of a folder"),
    "monte_carlo runs": ((2**31,), "at most", "GiB"),
    "sensitivity points": ((2**30,), "at most", "GiB"),
    "Design points": ((2**31,), "GiB"),
    "simulate metrics": (([ij.metrics.Settling(tolerance=[0.1] * 3)],), "[0].tolerance", "2"),
    "sweep metrics": ((["rmse"],), "[0]: got 'rmse'", "ij.metrics.Tracking() returns it"),
    "tune objective": (
        (None, [], "rmse", "x", 3, {}, ij.objectives.tracking),
        "ij.objectives.tracking() + 0.1 * ij.objectives.effort()",
    ),
    "tune checkpoint": ((*NO_PATHS, f"{NO_FOLDER}/state.npz"),),
    "tune risk": (NO_WORDS, "'cvar'"),
    "tuning.Adam learning_rate": ((None, "x", 0.0, -1.0, NAN, 5e-324, 1e300, 10**30), "number"),
    "tuning.Adam batch": (NO_COUNTS[1:], "whole number"),
    "tuning.DifferentialEvolution population": (NO_COUNTS, "whole number"),
    "tuning.DifferentialEvolution reach": ((None, "x", 0.0, -1.0, NAN), "positive number"),
    "identify delay": (([], "x", np.ones(2), NAN, 1e300),),
    "excitation waypoints": (NO_COUNTS[1:], "whole number"),
    "export folder": ((None, *NO_PATHS, "/dev/null", f"{NO_FOLDER}/new/folder"), "folder"),
    "export name": ((LONG_NAME, "b" * 64, "", "1a", "a b", "int", 3, []), "C identifier"),
    "report path": ((None, *NO_PATHS, f"{NO_FOLDER}/page.html"),),
    "recommended_dt duration": ((3e7,), "at most"),
    "recommended_period radius": ((None, "x", 0.0, -1.0, NAN, 5e-324, 1e300), "number"),
    "recommended_period margin": ((None, "x", 0.5, NAN, 1e300, 10**30), "number"),
    "factor shared": (NO_FLAGS,),
    "objectives.margin_above allowed": ((5.0,), "0 to 1"),
    "save_scenario path": ((None, *NO_PATHS, f"{NO_FOLDER}/scenario.toml"),),
}
"""Arguments of one function, and those of the names above that differ; what is refused for its type
alone is in `test_random_input`."""


def cases_by_name():
    """The arguments of every function that have a name of the table."""
    for function in entry_cases.entries():
        parameters = {} if "." in function else entry_cases.arguments_of(function)
        for name in filter(parameters.__contains__, BY_NAME):
            if function not in OTHERWISE or (name == "scenario" and function != "explore"):
                values, *words = BY_NAME[name]
                is_optional = parameters[name].default is None
                fitting = [x for x in values if x is not None or not is_optional]
                yield f"{function} {name}", fitting, words


@pytest.mark.parametrize(
    ("case", "values", "words"),
    [
        pytest.param(case, values, words, id=case)
        for case, values, words in (
            *cases_by_name(),
            *((case, values, words) for case, (values, *words) in OF_ONE.items()),
        )
    ],
)
def test_arguments_of_every_function(case, values, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function, argument = case.split()
    for value in values:
        with pytest.raises(ValueError, match=r"(?s)\w+.*: got .*, expected .+") as caught:
            entry_cases.call(function, **{argument: value})
        message = readable(caught.value, value)
        assert argument in message.split(": got")[0], (value, message)
        for word in words:
            assert word in message, (value, message)
    assert not list(tmp_path.iterdir()), "nothing is written"


def test_a_size_that_a_solver_or_a_weight_states_is_refused():
    too_many = ij.tuning.SQP(starts=2**40)
    refuses(lambda: entry_cases.call("tune", solver=too_many), "starts", "at most", "GiB")
    refuses(lambda: entry_cases.call("falsify", starts=2**40), "GiB")
    weights = ij.objectives.effort(weights=[1.0] * 3)
    refuses(lambda: entry_cases.call("tune", objective=weights), "weights", "(3,)")


def test_a_file_or_folder_that_does_not_exist_is_named_with_its_argument(tmp_path):
    with pytest.raises(
        FileNotFoundError,
        match=r"checkpoint: got .*The folder .*none does not exist: create it first\.$",
    ):
        entry_cases.call("tune", checkpoint=tmp_path / "none" / "state.npz")
    refuses(lambda: ij.load(tmp_path / "none.nc"), "path", "Nothing is there.")
    with pytest.raises(ValueError, match=r"Nothing is there\.$"):
        ij.robots.load(tmp_path / "none.urdf")


# --- warnings -------------------------------------------------------------------------------------


ADVICE = "Sharpen the pencil first."
NO_LEAF = "controller.nope"
STOPS = {
    "perturbations": {NO_LEAF: DRAWN["plant.mass"]},
    "parameters": [NO_LEAF],
    "paths": [NO_LEAF],
    "varied": [NO_LEAF],
    "folder": "/dev/null/below",
}
"""Argument -> a value that is refused after the scenario was checked, so that a call takes no
time."""
SAMPLED = dataclasses.replace(WEAK, sampling=ij.Sampling(period=2e-3))
SILENT = {
    *("parameters", "with_parameters", "with_parts", "save_scenario", "vector_field"),
    *("cosimulate", "plotting.tube", "testing.check_law", "testing.check_objective"),
    *("largest_level", "largest_parameters", "largest_period", "gains_for_guarantee", "prove"),
    *("certificates.counterexample", "failure_probability"),
    *("deployment.bag_log", "deployment.read_bag"),
}
"""Functions that check a scenario with another law, or not as a run does, or after a recording."""
ADVISE = [
    name
    for name in entry_cases.entries()
    if "scenario" in entry_cases.arguments_of(name) and name not in SILENT
]
LONG = {"recommended_period", "compare", "explore"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in LONG)) for name in ADVISE]
)
def test_every_function_gives_a_warning_once_at_the_callers_line(name, monkeypatch):
    monkeypatch.setattr(controllers.Backstepping, "advice", lambda *_: [ADVICE], raising=False)
    # What comes after the run warns of nothing, and takes long.
    monkeypatch.setattr("iblf_jax.certificates._certify._certificate_of", lambda run: run)
    run_of = lambda scenario, *_: {"rows": ij.simulate(scenario, **SHORT).t.size}  # noqa: E731
    monkeypatch.setattr("iblf_jax.deployment.live._loop", run_of)
    arguments = entry_cases.arguments_of(name)
    given = {x: value for x, value in STOPS.items() if x in arguments}
    if name in ("export", "recommended_period"):
        given["scenario"] = SAMPLED
    if name == "explore":
        given["scenario"] = {"a": WEAK, "b": WEAK}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with contextlib.suppress(ValueError):
            entry_cases.call(name, **given)
    assert [str(w.message) for w in caught].count(ADVICE) == 1
    assert all(w.filename in (__file__, entry_cases.__file__) for w in caught)


def test_a_second_call_warns_again_and_what_is_muted_does_not_count(monkeypatch):
    monkeypatch.setattr(controllers.Backstepping, "advice", lambda *_: [ADVICE], raising=False)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            ij.simulate(WEAK, **SHORT)
        with notices.muted():
            ij.simulate(WEAK, **SHORT)
    assert len(caught) == 2

    @notices.each_warning_once
    def inner():
        with notices.muted():
            notices.warn("same")
        notices.warn("same")
        notices.warn("same")

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        inner()
    assert len(caught) == 1


def test_every_warning_of_the_package_looks_for_the_users_line():
    by_hand = re.compile(
        r"warnings\.warn(_explicit)?\(.*stacklevel|warnings\.warn\($", re.MULTILINE
    )
    for path in sorted((ROOT / "iblf_jax").rglob("*.py")):
        assert path.name == "notices.py" or not by_hand.search(path.read_text()), path
