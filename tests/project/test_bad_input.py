"""Bad input is a ValueError that names the field, the value and the remedy; a doubtful one is a
warning."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import inspect
import itertools
import re
import subprocess
import sys
import warnings
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT, SHORT

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, disturbances, observers, references, robots
from iblf_jax.core import checks, notices

ARM = {"mass": [2.0, 0.85], "length": [0.35, 0.31], "centre": [0.2, 0.15], "inertia": [0.06, 0.02]}


def refuses(call, *words):
    """The call raises ValueError with all these words in it."""
    with pytest.raises(ValueError, match=r"(?s)\w+.*: got .*, expected .+") as caught:
        call()
    for word in words:
        assert word in str(caught.value), str(caught.value)


BAD_NUMBERS = {
    "nan": (float("nan"), "finite"),
    "infinity": (np.inf, "finite"),
    "zero": (0.0, "> 0"),
    "negative": (-1.0, "> 0"),
    "one-negative": ([1.0, -1.0], "> 0"),
    "string": ("2.0", "number"),
    "numpy-string": (np.str_("2"), "number"),
    "none": (None, "number"),
    "bool": (True, "real numbers"),
    "complex": (1.0 + 2.0j, "real numbers"),
    "complex-array": (np.ones(2, complex), "real numbers"),
    "dict": ({"a": 1.0}, "number"),
    "masked": (np.ma.array([1.0, 2.0], mask=[False, True]), "number"),
    "set": ({1.0}, "number"),
    "ragged": ([[1.0], [1.0, 2.0]], "rectangular"),
    "list-with-none": ([1.0, None], "number"),
    "list-with-string": ([1.0, "2"], "number"),
    "matrix": (np.ones((2, 2)), "(n,)"),
    "object-array": (np.asarray([object()]), "numbers"),
    "decimal": (Decimal("2.0"), "numbers"),
    "fraction": (Fraction(2), "number"),
    "huge-int": (10**400, "numbers"),
    "function": (np.sin, "number"),
    "class": (robots.TwoLink, "number"),
}


@pytest.mark.parametrize("case", BAD_NUMBERS)
def test_numbers_of_a_component(case):
    value, word = BAD_NUMBERS[case]
    refuses(lambda: controllers.Backstepping(k1=value, K2=20.0), "Backstepping.k1", word)
    refuses(lambda: robots.TwoLink(**(ARM | {"mass": value})), "TwoLink.mass", word)
    refuses(lambda: observers.Momentum(kf=value), "Momentum.kf", word)


FINE = (2, np.float32(2), np.int8(2), np.asarray(2.0), jnp.asarray(2), [2, 2], (2.0, 2))


@pytest.mark.parametrize("value", FINE)
def test_numbers_that_are_fine(value):
    k1 = controllers.Backstepping(k1=value, K2=20.0).k1
    assert jnp.issubdtype(k1.dtype, jnp.floating)
    np.testing.assert_array_equal(k1, 2.0)


def made(make: Callable[..., Any], *fixed: Any, **more: Any) -> Callable[..., Any]:
    """Calls that make a component with other arguments."""
    return lambda *args, **options: lambda: make(*fixed, *args, **more | options)


arm = made(robots.TwoLink, **ARM)
chain = made(robots.PlanarChain, centre=0.1, inertia=0.1)
law = made(controllers.Backstepping, 2.0, 20.0)
spline = made(references.WaypointSpline)
COMPONENTS = {
    "two-link-of-three": (arm(mass=[1.0] * 3), "TwoLink.mass", "(2,)"),
    "chain-sizes": (chain(mass=[1.0, 1.0], length=[1.0]), "PlanarChain.length", "(2,)"),
    "chain-of-scalars": (chain(mass=1.0, length=1.0), "PlanarChain.mass", "how many"),
    "chain-of-none": (chain(mass=[], length=[]), "PlanarChain.mass", "at least one"),
    "payload-array": (arm(payload=[1.0, 2.0]), "TwoLink.payload", "one number"),
    "variant": (law(variant="exact"), "Backstepping.variant", "'printed', 'corrected'"),
    "reading-array": (law(variant=np.asarray(["printed"])), "variant", "hashable"),
    "barrier-name": (law(barrier="integral"), "Backstepping.barrier", "barriers.Integral()"),
    "barrier-class": (law(barrier=barriers.Log), "Backstepping.barrier", "brackets"),
    "guard": (lambda: barriers.Integral(guard=1.5), "Integral.guard", "between 0 and 1"),
    "guard-zero": (lambda: barriers.Log(guard=0.0), "Log.guard", "positive"),
    "p-zero": (lambda: barriers.Log(p=0), "Log.p", ">= 1"),
    "observer-start": (
        lambda: observers.AsPublished(kf=20.0, start="cold"),
        "AsPublished.start",
        "'matched'",
    ),
    "side-number": (lambda: bounds.Bounds(0.1, 0.9), "Bounds.lower", "Constant(value)"),
    "friction-width": (lambda: disturbances.Friction(width=0.0), "Friction.width", "> 0"),
    "sum-of-numbers": (lambda: disturbances.Sum((1.0, 2.0)), "Sum.parts", "tuple of disturbances"),
    "sum-of-one": (lambda: disturbances.Sum(disturbances.Friction()), "Sum.parts", "brackets"),
    "spline-order": (spline((0.0, 0.0), [[0.0], [1.0]]), "WaypointSpline.times", "increasing"),
    "spline-rows": (spline((0.0, 1.0), [[0.0], [1.0], [2.0]]), "WaypointSpline.waypoints", "row"),
    "spline-list": (spline([0.0, 1.0], [[0.0], [1.0]]), "WaypointSpline.times", "tuple"),
    "quintic": (lambda: references.Quintic(0.0, 1.0, duration=-2.0), "Quintic.duration", "> 0"),
    "preset-law": (lambda: ij.presets.zhang_yan_2024(law="tangent"), "law", "'integral', 'log'"),
    "preset-reading": (lambda: ij.presets.zhang_yan_2024(variant=None), "variant", "'printed'"),
    "dtype-int": (lambda: ij.astype(ij.presets.zhang_yan_2024(), "int32"), "dtype", "float32"),
}


@pytest.mark.parametrize("case", COMPONENTS)
def test_components(case):
    call, *words = COMPONENTS[case]
    refuses(call, *words)


def with_part(**parts):
    return lambda: ij.simulate(dataclasses.replace(ij.presets.zhang_yan_2024(), **parts), **SHORT)


TUBE = ij.presets.zhang_yan_2024().bounds[0]
CHAIN3 = robots.PlanarChain(mass=[1.0, 1.0, 1.0], length=0.3, centre=0.1, inertia=0.1)
funnel = bounds.Funnel


def between(lower, upper):
    return with_part(bounds=bounds.Bounds(lower, upper))


SCENARIOS = {
    "plant-none": (with_part(plant=None), "Scenario.plant", "component"),
    "plant-class": (with_part(plant=robots.TwoLink), "Scenario.plant", "brackets"),
    "plant-is-a-bound": (
        with_part(plant=bounds.Constant(1.0)),
        "Scenario.plant",
        "lacks",
        "mass_matrix",
    ),
    "model-of-three": (with_part(model=CHAIN3), "Scenario.model", "3 joints", "2 joints"),
    "plant-of-three": (with_part(plant=CHAIN3, model=CHAIN3), "got", "3 (one a joint)"),
    "reference-class": (with_part(reference=references.Sinusoid), "Scenario.reference", "brackets"),
    "reference-of-three": (
        with_part(reference=references.WaypointSpline((0.0, 1.0), [[0.5] * 3, [0.6] * 3])),
        "reference.position",
        "(3,)",
        "(2,)",
    ),
    "bounds-one-side": (with_part(bounds=bounds.Constant(0.1)), "Scenario.bounds", "Bounds(lower="),
    "bounds-exchanged": (
        between(TUBE.upper, TUBE.lower),
        "bounds of joint 0",
        "lower < upper",
        "Exchange",
    ),
    "lower-funnel-of-the-upper-sign": (
        between(funnel(0.3, 0.1, 1.0), funnel(0.3, 0.1, 1.0)),
        "bounds of joint 0",
        "as a lower side it takes negative numbers",
    ),
    "lower-funnel-below-the-upper-one": (
        between(funnel(0.2, 0.1, 1.0), funnel(0.3, 0.1, 1.0)),
        "reference of joint 0",
        "as a lower side it takes negative numbers",
    ),
    "upper-funnel-of-the-lower-sign": (
        between(funnel(-0.3, -0.1, 1.0), funnel(-0.2, -0.1, 1.0)),
        "reference of joint 0",
        "as an upper side it takes positive numbers",
    ),
    "bounds-wrong-n": (
        between(bounds.Constant([0.1] * 3), TUBE.upper),
        "bounds[0].lower.value",
        "2 (one a joint)",
    ),
    "controller-object": (with_part(controller=object()), "Scenario.controller", "check_law"),
    "controller-gains": (with_part(controller=[2.0, 20.0]), "Scenario.controller", "RobotLaw"),
    "tip-force-in-space": (
        with_part(disturbance=disturbances.TipForce(amplitude=[1.0, 2.0, 3.0])),
        "disturbance.torque",
        "(2,)",
    ),
    "initial-of-three": (
        with_part(initial=ij.Initial(q=[0.8, 0.8, 0.8])),
        "initial.q",
        "2 (one a joint)",
    ),
    "start-above": (
        with_part(initial=ij.Initial(q=[1.05, 0.8])),
        "initial.q[0]",
        "1.05",
        "(0.34, 1.04)",
        "Move the start",
    ),
    "start-too-fast": (with_part(initial=ij.Initial(q=0.8, dq=1e5)), "initial.dq", "10000"),
    "reference-outside": (
        with_part(reference=references.Sinusoid(1.5, 0.1)),
        "reference of joint 0",
        "Assumption 2",
    ),
    "massless-link": (
        with_part(plant=robots.TwoLink(mass=1.0, length=1.0, centre=0.0, inertia=0.0)),
        "plant.mass_matrix",
        "positive definite",
    ),
    "float16": (
        lambda: ij.simulate(ij.astype(ij.presets.zhang_yan_2024(), "float16"), **SHORT),
        "scenario",
        "float16",
        "float32",
    ),
    "not-a-scenario": (lambda: ij.simulate({"law": "integral"}, **SHORT), "scenario", "ij.presets"),
}


@pytest.mark.parametrize("case", SCENARIOS)
def test_scenarios(case):
    call, *words = SCENARIOS[case]
    refuses(call, *words)


def test_nan_that_came_in_by_a_tree_map_is_found_with_its_path():
    scenario = jax.tree.map(lambda x: x, ij.presets.zhang_yan_2024())
    object.__setattr__(scenario.controller, "K2", jnp.asarray([20.0, jnp.nan]))
    refuses(lambda: ij.simulate(scenario, **SHORT), "controller.K2", "finite")


ARGUMENTS = {
    "dt-too-long": ({"dt": 1.0}, "duration", "whole number of steps"),
    "dt-tiny": ({"dt": 1e-300}, "duration", "at most"),
    "duration-long": ({"duration": 1e300}, "duration", "at most", "Shorten"),
    "duration-broken": (
        {"duration": 0.0105},
        "0.0105",
        "whole number",
        "Take duration=0.01 or dt=0.00105",
    ),
    "too-many-samples": ({"duration": 1e6}, "record_every", "Take record_every="),
}
"""What `REFUSED` does not try at all functions."""


@pytest.mark.parametrize("case", ARGUMENTS)
def test_arguments_of_simulate(case, paper):
    options, *words = ARGUMENTS[case]
    refuses(lambda: ij.simulate(paper, **(SHORT | options)), *words)


def test_a_duration_in_float32_is_taken_for_what_it_was(paper):
    assert ij.simulate(paper, duration=np.float32(0.5), dt=np.float32(1e-3)).t.size == 501


def test_a_traced_step_says_what_to_do(paper):
    with pytest.raises(ValueError, match=r"dt: got a value that JAX is tracing.*static_argnames"):
        jax.jit(lambda dt: ij.simulate(paper, duration=0.5, dt=dt).q)(1e-3)


PATHS = {
    "unknown": ("controller.K3", "controller.K2"),
    "no-such-part": ("engine.power", "parameters(scenario)"),
    "a-part": ("controller", "path"),
    "static": ("controller.variant", "path"),
    "beyond-the-end": ("plant.mass[2]", "plant.mass"),
    "into-a-number": ("plant.g[0]", "plant.g"),
    "empty": ("", "names joined by dots"),
    "dots": ("plant..mass", "names joined by dots"),
    "slice": ("plant.mass[0:1]", "names joined by dots"),
    "private": ("plant.__class__", "path"),
    "number": (3, "names joined by dots"),
    "robot-alone": ("robot", "path"),
}


@pytest.mark.parametrize("case", PATHS)
def test_paths(case, paper):
    path, word = PATHS[case]
    refuses(lambda: ij.with_parameters(paper, {path: 1.0}), "path", word)


VALUES = {
    "negative": ("plant.mass[1]", -1.0, "> 0"),
    "zero": ("robot.mass", 0.0, "> 0"),
    "nan": ("initial.q", float("nan"), "finite"),
    "shape": ("controller.K2", [1.0, 2.0, 3.0], "(2,)"),
    "shape-of-an-entry": ("controller.K2[0]", [1.0, 2.0], "()"),
    "word": ("controller.K2", "20", "numbers"),
    "none": ("controller.K2", None, "numbers"),
    "bool": ("controller.K2", True, "real numbers"),
    "complex": ("controller.K2", 1j, "real numbers"),
    "part": ("controller.K2", barriers.Integral(), "numbers"),
}


@pytest.mark.parametrize("case", VALUES)
def test_values(case, paper):
    path, value, word = VALUES[case]
    refuses(lambda: ij.with_parameters(paper, {path: value}), path.replace("robot", "plant"), word)


def test_with_parameters_takes_a_mapping_and_a_scenario(paper):
    refuses(lambda: ij.with_parameters(paper, [("controller.K2", 1.0)]), "values", "mapping")
    refuses(lambda: ij.with_parameters("paper", {}), "scenario", "ij.presets")
    refuses(lambda: ij.parameters(ij.Scenario), "scenario", "ij.presets")


def test_with_parameters_changes_what_it_says_and_nothing_else(paper):
    values = {"controller.K2": 30, "plant.mass[1]": 1.1, "robot.g": 1.62, "initial.q[-1]": 0.7}
    other = ij.with_parameters(paper, values)
    got = {p.path: np.asarray(p.value) for p in ij.parameters(other)}
    expected = {p.path: np.array(p.value) for p in ij.parameters(paper)}
    expected["controller.K2"][:] = 30
    expected["plant.mass"][1] = 1.1
    expected["initial.q"][1] = 0.7
    expected["plant.g"] = expected["model.g"] = np.asarray(1.62)
    for path, value in expected.items():
        np.testing.assert_array_equal(got[path], value, err_msg=path)
    assert float(paper.plant.mass[1]) == 0.85
    assert jax.tree.structure(other) == jax.tree.structure(paper)


def test_every_parameter_can_be_written_back_by_its_path(paper):
    table = {p.path: p.value for p in ij.parameters(paper)}
    again = ij.with_parameters(paper, table)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(paper), strict=True)
    )


# ------------------------------------------------------- every function, before it does anything

WEAK = ij.presets.zhang_yan_2024()
DRAWN = {"plant.mass": ij.factor(ij.uniform(0.9, 1.1))}
TRACKING = ij.objectives.tracking()
SOLVERS = (
    *(ij.tuning.SQP, ij.tuning.LBFGS, ij.tuning.Adam, ij.tuning.Optax),
    *(ij.tuning.SLSQP, ij.tuning.DifferentialEvolution),
)
REQUIRED = inspect.Parameter.empty
INTERVAL = {"plant.mass": ij.factor(ij.interval(0.9, 1.1))}
GAINS = {"controller.K2": (1.0, 20.0)}
NO_FOLDER = "/proc" if Path("/proc/self").exists() else "/dev/null"
"""A folder in which nobody can make a file."""

GOOD = {
    "simulate": (ij.simulate, {}),
    "compare": (ij.compare, {"laws": ["integral"]}),
    "certify": (ij.certify, SHORT),
    "monte_carlo": (ij.monte_carlo, {"perturbations": DRAWN, "runs": 2}),
    "sweep": (ij.sweep, {"grid": {"controller.K2": [10.0, 20.0]}}),
    "LocalExecutor": (lambda **x: ij.studies.LocalExecutor(**x).checked(), {}),
    "StoreOptions": (lambda **x: ij.studies.StoreOptions("never.zarr", **x).checked(), {}),
    "sensitivity": (ij.sensitivity, {"perturbations": DRAWN, "points": 2}),
    "tune": (ij.tune, {"parameters": ["controller.K2"], "objective": TRACKING}),
    **{solver.__name__: (solver, {}) for solver in SOLVERS},
    "Effort": (ij.tuning.Effort, {}),
    "Report": (ij.tuning.Report, {}),
    "falsify": (ij.falsify, {"perturbations": DRAWN}),
    "pareto": (
        ij.pareto,
        {"parameters": ["controller.K2"], "objectives": (TRACKING, ij.objectives.effort())},
    ),
    "identify": (ij.identify, {"log": {}, "paths": ["plant.mass"]}),
    "excitation": (ij.excitation, {"paths": ["plant.mass"]}),
    "export": (ij.export, {"folder": "never", "period": 1e-3}),
    "export-loop": (ij.export, {"folder": "never", "target": "wasm"}),
    "cosimulate": (ij.cosimulate, {"plant": "never.xml", "period": 1e-3, "duration": 0.01}),
    "explain": (ij.explain, {}),
    "explore": (ij.explore, {}),
    "report": (ij.report, {"result": WEAK, "path": "never.html"}),
    "recommended_dt": (ij.recommended_dt, {}),
    "recommended_period": (ij.recommended_period, {}),
    "load": (robots.load, {"path": "never.urdf"}),
    "Sampling": (ij.Sampling, {"period": 1e-3}),
    "tunable": (ij.tunable, {"path": "controller.K2", "low": 1.0, "high": 2.0}),
    "factor": (ij.factor, {"distribution": ij.uniform(0.9, 1.1)}),
    "prove": (ij.prove, {"level": 0.1, "parameters": {}}),
    "largest_level": (ij.largest_level, {"parameters": {}, "between": (1.0, 2.0)}),
    "largest_parameters": (
        ij.largest_parameters,
        {"level": 0.1, "parameters": INTERVAL, "between": (0.5, 1.0)},
    ),
    "gains_for_guarantee": (
        ij.gains_for_guarantee,
        {"level": 0.1, "parameters": {}, "gains": GAINS},
    ),
    "failure_probability": (ij.failure_probability, {"perturbations": DRAWN}),
    "tune_file": (ij.tune_file, {}),
    "plotting.identification": (ij.plotting.identification, {}),
    "plotting.tuning": (ij.plotting.tuning, {}),
    "plotting.paths": (ij.plotting.paths, {}),
    "plotting.pareto": (ij.plotting.pareto, {}),
    "Delay": (ij.actuators.Delay, {"delay": 1e-3}),
    "AdaptiveRBF": (controllers.AdaptiveRBF, {"k1": 2.0, "K2": 20.0}),
    "AdaptiveNetwork": (controllers.AdaptiveNetwork, {"k1": 2.0, "K2": 20.0}),
    "Log": (barriers.Log, {}),
    "Leader": (references.Leader, {"motion": WEAK.reference, "weights": (1.0,)}),
    "save_scenario": (ij.save_scenario, {"path": "never.toml"}),
}
"""Function, and arguments that are fine besides the scenario and the duration."""


def defaults_of(function: Callable[..., Any]) -> dict[str, Any]:
    """Argument of a function -> its default; REQUIRED if it has none."""
    parameters = inspect.signature(function).parameters.values()
    return {x.name: x.default for x in parameters if x.kind != x.VAR_KEYWORD}


def call(entry: tuple[Callable[..., Any], dict[str, Any]], /, **changed: Any) -> Any:
    """Calls a function with arguments that are fine, except for what is changed."""
    function, arguments = entry
    defaults = defaults_of(function)
    fine = {"scenario": WEAK, "duration": SHORT["duration"]}
    needed = {key: x for key, x in fine.items() if defaults.get(key, WEAK) is REQUIRED}
    return function(**(needed | arguments | changed))


NO_WORDS = (None, [], {}, 3, b"rk4", ["rk4"], np.asarray(["rk4", "x"]), "nope", True, float("nan"))
NO_TIMES = (
    *(None, "x", [], True, 0.0, -1.0, float("nan"), np.inf, 5e-324, 3e-300, 1e300, 4e9, 10**30),
    *(1j, np.ones(2)),
)
NO_SEEDS = (None, "x", [], True, -1, 1.5, float("nan"), 2**32, 10**30, np.ones(2))
NO_COUNTS = (None, "x", [], True, 0, -3, 1.5, float("nan"), np.inf, 10**30, 7 * 10**29, np.ones(2))
NO_SCENARIOS = (None, 3, [], {}, "paper", np.ones(2), ij.Scenario, robots.TwoLink)
NO_SIZES = (0, -3, 1.5, True, "x", 10**30)
NO_FLAGS = ("yes", 1, 0.0, [], np.ones(2))
NO_PATHS = (3, "a\0b", b"x", [], {}, 1.5, True, "n" * 300, f"new/{'m' * 270}/x", "/dev/null/x")
LONG_NAME = "a" * 300

BY_NAME = {
    "scenario": (NO_SCENARIOS, ["a Scenario", "ij.presets"]),
    "seed": (NO_SEEDS, ["whole number"]),
    "method": (NO_WORDS, ["'rk4'"]),
    "backend": (NO_WORDS, ["'auto'"]),
    "mode": (NO_WORDS, ["'forward'"]),
    "tolerance": ((None, "x", -1.0, float("nan"), 1.5, 1e300), ["from 0 to 1"]),
    "dt": ((None, "x", [], True, 0.0, -1.0, float("nan"), np.inf, 1j, np.ones(2)), []),
    **dict.fromkeys(("duration", "period", "window"), (NO_TIMES, [])),
    **dict.fromkeys(("record_every", "iterations", "patience"), (NO_COUNTS, ["whole number"])),
    **dict.fromkeys(("runs", "points", "replicates"), (NO_COUNTS, [])),
    **dict.fromkeys(("throw", "equal_effort", "resample", "repair"), (NO_FLAGS, ["True or False"])),
}
"""Argument of whatever function: values that are refused, and words of the message besides the
argument's name.  None is fine where it is the default."""
LATE = {"cosimulate", "prove", "gains_for_guarantee", "plotting.tuning", "plotting.paths"}
"""Functions that check other arguments first."""

REFUSED = {
    **{
        f"{function} {name}": (
            [x for x in BY_NAME[name][0] if x is not None or default is not None],
            BY_NAME[name][1],
        )
        for function in GOOD
        for name, default in defaults_of(GOOD[function][0]).items()
        if name in BY_NAME and (name == "scenario" or function not in LATE)
    },
    # Arguments of one function, and those of the names above that differ.
    "falsify starts": (NO_COUNTS, []),
    "explore scenario": (NO_SCENARIOS, []),
    "plotting.identification known": ((None, 3, WEAK), ["ij.identify"]),
    "plotting.tuning result": ((None, 3, WEAK), ["ij.tune"]),
    "plotting.paths result": ((None, 3, WEAK), ["ij.tune"]),
    "plotting.pareto front": ((None, 3, WEAK), ["ij.pareto"]),
    "Sampling queue": ((-1, 1.5, "x", True, 2_000_000, 10**30), ["whole number"]),
    "Delay history": (NO_SIZES, ["whole number"]),
    "AdaptiveRBF nodes": (NO_SIZES, ["whole number"]),
    "AdaptiveNetwork nodes": (NO_SIZES, ["whole number"]),
    "Log p": ((*NO_SIZES, 101), ["<= 100"]),
    "Leader components": (NO_SIZES, ["whole number"]),
    "compare laws": ((None, [], {}, 3, "nope", ["nope"]), []),
    "LocalExecutor chunk": (NO_COUNTS[1:], ["whole number"]),
    "LocalExecutor memory": ((None, "x", [], 0, -1, 5e-324, 1e300, 10**30, np.inf), ["bytes"]),
    "StoreOptions unit": (NO_COUNTS[1:], ["whole number"]),
    "StoreOptions writer": (NO_WORDS, ["'client'", "'worker'"]),
    "StoreOptions shared": ((None, "yes", 1, []), ["True or False"]),
    "sweep store": (NO_PATHS[:7], ["path of a folder"]),
    "sensitivity output": ((None, [], 3, "nope", "", LONG_NAME), []),
    "tune objective": (
        (None, [], "rmse", "x", 3, {}, ij.objectives.tracking),
        ["ij.objectives.tracking() + 0.1 * ij.objectives.effort()"],
    ),
    "tune parameters": ((None, [], {}, "controller.K2", [None], [3], [["controller.K2"]]), []),
    "tune effort": ((None, "x", "", 3, [], ij.tuning.Effort), ["'thorough'"]),
    "Adam learning_rate": ((None, "x", 0.0, -1.0, float("nan"), 5e-324, 1e300, 10**30), ["number"]),
    "tune checkpoint": ((*NO_PATHS, f"{NO_FOLDER}/state.npz"), []),
    "tune solver": (("nope", "", LONG_NAME, 3, [], ij.tuning.SQP), ["'sqp'"]),
    "tune report": ((3, [], "x", ij.tuning.Report), ["ij.tuning.Report"]),
    "tune risk": (NO_WORDS, ["'cvar'"]),
    "Adam batch": (NO_COUNTS[1:], ["whole number"]),
    "Optax optimiser": (("lion", 3, [], {}), ["optax.GradientTransformation"]),
    "DifferentialEvolution population": (NO_COUNTS, ["whole number"]),
    "DifferentialEvolution reach": ((None, "x", 0.0, -1.0, float("nan")), ["positive number"]),
    "identify delay": (([], "x", np.ones(2), float("nan"), 1e300), []),
    "identify loss": (NO_WORDS, ["'huber'"]),
    "excitation waypoints": (NO_COUNTS[1:], ["whole number"]),
    "export folder": ((None, *NO_PATHS, "/dev/null", f"{NO_FOLDER}/new/folder"), ["folder"]),
    "export name": ((LONG_NAME, "b" * 64, "", "1a", "a b", "int", 3, []), ["C identifier"]),
    "export target": (NO_WORDS, ["'wasm'"]),
    "export-loop folder": ((None, *NO_PATHS), ["folder"]),
    "cosimulate plant": ((None, 3, [], "", "a\0b", LONG_NAME), []),
    "cosimulate integrator": (NO_WORDS[1:], ["'RK4'"]),
    "report path": ((None, *NO_PATHS, f"{NO_FOLDER}/page.html"), []),
    "report title": ((3, [], True), []),
    "recommended_dt perturbations": ((0, "", [], False, 3, "x", np.ones(2)), ["mapping"]),
    "recommended_period radius": ((None, "x", 0.0, -1.0, float("nan"), 5e-324, 1e300), ["number"]),
    "recommended_period margin": ((None, "x", 0.5, float("nan"), 1e300, 10**30), ["number"]),
    "load path": ((None, 3, [], "a\0b", LONG_NAME), []),
    "Sampling period": ((1e300, 5e-324, 0.0, -1.0, "x", None), []),
    "Sampling delay": ((1e300, 5e-324, -1.0, "x", 1e6), []),
    "tunable low": (([], float("nan"), "x"), []),
    "tunable high": (([], float("nan"), "x"), []),
    "factor shared": (NO_FLAGS, []),
    "factor distribution": (
        (None, float("nan"), 3.0, ij.uniform),
        ["ij.factor(ij.uniform(low, high))"],
    ),
    "save_scenario path": ((None, *NO_PATHS, f"{NO_FOLDER}/scenario.toml"), []),
}


@pytest.mark.parametrize("case", REFUSED)
def test_arguments_of_every_function(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function, argument = case.split()
    values, words = REFUSED[case]
    for value in values:
        with pytest.raises(ValueError, match=r"(?s)\w+.*: got .*, expected .+") as caught:
            call(GOOD[function], **{argument: value})
        message = str(caught.value)
        named = message.split(": got")[0]
        assert argument in named, (value, message)
        assert len(message) < 1500, value
        for word in words:
            assert word in message, (value, message)
    assert not list(tmp_path.iterdir()), "nothing is written"


def test_a_duration_that_no_step_can_be_tried_on_is_refused(monkeypatch):
    from iblf_jax.engine import step_size

    monkeypatch.setattr(step_size, "run_one", None)  # nothing is run
    monkeypatch.setattr(step_size, "side_by_side", None)
    refuses(lambda: ij.recommended_dt(WEAK, duration=3e7), "duration", "at most")
    sampled = dataclasses.replace(WEAK, sampling=ij.Sampling(period=1e-3))
    refuses(lambda: ij.recommended_dt(sampled, duration=3e7), "duration", "at most")


def test_a_file_or_folder_that_does_not_exist_is_named_with_its_argument(tmp_path):
    gains, place = ["controller.K2"], tmp_path / "none" / "state.npz"
    with pytest.raises(
        FileNotFoundError,
        match=r"checkpoint: got .*The folder .*none does not exist: create it first\.$",
    ):
        ij.tune(WEAK, gains, ij.objectives.tracking(), duration=0.01, dt=1e-3, checkpoint=place)
    refuses(lambda: ij.load(tmp_path / "none.nc"), "path", "Nothing is there.")
    with pytest.raises(ValueError, match=r"Nothing is there\.$"):
        ij.robots.load(tmp_path / "none.urdf")


def test_misspelt_parts_and_fields_get_a_suggestion():
    refuses(
        lambda: ij.with_parts(WEAK, contoller=WEAK.controller),
        "part",
        "'contoller'",
        "Did you mean controller?",
    )
    refuses(lambda: ij.with_parts(WEAK, zzz=None), "'zzz'", "robot, plant")
    refuses(
        lambda: dataclasses.replace(WEAK, refrence=WEAK.reference),
        "Scenario",
        "Did you mean reference?",
    )
    refuses(
        lambda: controllers.Backstepping(2.0, K2=20.0, barier=barriers.Log()),
        "Backstepping",
        "Did you mean barrier",
    )


def test_constructors_name_the_field_that_is_missing():
    for call, *words in (
        (
            lambda: ij.sensors.Encoder(),
            "Encoder.velocity",
            "nothing",
            "a Velocity",
            "Encoder(velocity=...)",
        ),
        (lambda: ij.Sampling(), "Sampling.period", "nothing", "[s]"),
        (lambda: ij.Scenario(plant=WEAK.plant), "Scenario.reference", "a Reference"),
        (lambda: controllers.Backstepping(2.0), "Backstepping.K2", "number"),
        (lambda: controllers.Backstepping(2.0, 20.0, k1=3.0), "Backstepping.k1", "two values"),
        (lambda: barriers.Log(1, 2, 3, 4, 5), "Log", "5 positional arguments"),
    ):
        refuses(call, *words)
        with pytest.raises(
            TypeError
        ):  # what Python itself raises, so that programs that expect it go on
            call()


def test_a_component_with_a_constructor_of_its_own_keeps_its_errors():
    @ij.component
    class Own:
        k: float

        def __init__(self, twice: float) -> None:
            object.__setattr__(self, "k", 2.0 * twice)

    assert float(Own(3.0).k) == 6.0
    with pytest.raises(TypeError, match="twice"):
        Own()


# -------------------------------------------------------------------------------------- warnings


@pytest.mark.slow
def test_a_warning_points_at_the_callers_line(paper):
    weak = ij.with_parameters(paper, {"controller.K2": 0.4})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ij.simulate(weak, **SHORT)
    advice = [w for w in caught if "Theorem 2" in str(w.message)]
    assert len(advice) == 1
    assert advice[0].filename == __file__


ADVICE = "Sharpen the pencil first."
NO_LEAF = {"controller.nope": DRAWN["plant.mass"]}
"""It is refused after the scenario was checked, so that a call takes no time."""
SAMPLED = dataclasses.replace(WEAK, sampling=ij.Sampling(period=2e-3))
CALLS_THAT_ADVISE = {
    "simulate": lambda: ij.simulate(WEAK, **SHORT),
    "certify": lambda: ij.certify(WEAK, **SHORT),
    "compare": lambda: ij.compare(WEAK, ["integral"], equal_effort=False, **SHORT),
    "sweep": lambda: ij.sweep(WEAK, {"controller.k1": [1.0]}, perturbations=NO_LEAF, **SHORT),
    "monte_carlo": lambda: ij.monte_carlo(WEAK, NO_LEAF, runs=2, **SHORT),
    "sensitivity": lambda: ij.sensitivity(WEAK, NO_LEAF, points=2, **SHORT),
    "falsify": lambda: ij.falsify(WEAK, NO_LEAF, **SHORT),
    "tune": lambda: ij.tune(WEAK, ["controller.nope"], TRACKING, **SHORT),
    "pareto": lambda: ij.pareto(
        WEAK, ["controller.nope"], (TRACKING, ij.objectives.effort()), **SHORT
    ),
    "excitation": lambda: ij.excitation(WEAK, ["controller.nope"], duration=1.0),
    "identify": lambda: ij.identify(WEAK, {}, ["controller.nope"]),
    "export": lambda: ij.export(SAMPLED, "/dev/null/below"),
    "explore": lambda: ij.explore({"a": WEAK, "b": WEAK}),
    "recommended_dt": lambda: ij.recommended_dt(WEAK, duration=0.1, perturbations=NO_LEAF),
    "recommended_period": lambda: ij.recommended_period(SAMPLED, duration=0.1),
    "explain": lambda: ij.explain(WEAK, varied=["controller.nope"]),
}
"""Function -> a call that checks its scenario, most of them more than once."""


LONG_CALLS = {"recommended_period", "compare"}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in LONG_CALLS))
        for name in CALLS_THAT_ADVISE
    ],
)
def test_every_function_gives_a_warning_once_at_the_callers_line(name, monkeypatch):
    from iblf_jax.certificates import _certify
    from iblf_jax.deployment import live

    monkeypatch.setattr(controllers.Backstepping, "advice", lambda *_: [ADVICE], raising=False)
    monkeypatch.setattr(
        _certify, "_certificate_of", lambda run: run
    )  # what comes after the run warns of nothing, and takes long
    monkeypatch.setattr(
        live, "_loop", lambda scenario, *_: {"rows": ij.simulate(scenario, **SHORT).t.size}
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with contextlib.suppress(ValueError):
            CALLS_THAT_ADVISE[name]()
    assert [str(w.message) for w in caught].count(ADVICE) == 1
    assert all(w.filename == __file__ for w in caught)


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


@pytest.mark.slow
def test_a_warning_shows_no_line_of_the_package(tmp_path):
    """In a process of its own, as a user sees it: the text is there once, with the user's line
    below."""
    script = tmp_path / "mine.py"
    script.write_text(
        "import iblf_jax as ij\n"
        "from iblf_jax.core import notices\n"
        "@notices.each_warning_once\n"
        "def work():\n"
        "    for _ in range(3):\n"
        "        notices.warn('Look at this.')\n"
        "work()\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stderr.count("Look at this.") == 2, (
        "the message, and the line of the user's that gave it"
    )
    assert "mine.py:6: UserWarning" in done.stderr and "stacklevel" not in done.stderr


def test_every_warning_of_the_package_looks_for_the_users_line():
    for path in sorted((ROOT / "iblf_jax").rglob("*.py")):
        uses = re.search(
            r"warnings\.warn(_explicit)?\(.*stacklevel|warnings\.warn\($",
            path.read_text(),
            re.MULTILINE,
        )
        assert not uses or path.name == "notices.py", path


# --------------------------------------------------------------------------------------- grammar


def test_the_article_of_a_noun():
    for article, nouns in {
        "a": ("Uniform", "user", "Universal", "unit", "hinge", "one-sided"),
        "an": ("Actuator", "Ideal", "unimportant part"),
    }.items():
        assert [checks.with_article(noun) for noun in nouns] == [f"{article} {x}" for x in nouns]


@pytest.mark.slow
def test_no_message_has_a_fixed_article_before_a_name_that_varies():
    """An f-string with "a " or "an " right before a value, unless the value is one of those words
    that are known."""
    known = {"kind", "'number >= 0' if zero else 'positive number'", "noun"}
    found = []
    for path in sorted((ROOT / "iblf_jax").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            pairs = itertools.pairwise(node.values) if isinstance(node, ast.JoinedStr) else ()
            for before, after in pairs:
                has_article = isinstance(before, ast.Constant) and re.search(
                    r"(?i)\ban? $", str(before.value)
                )
                if (
                    has_article
                    and isinstance(after, ast.FormattedValue)
                    and ast.unparse(after.value) not in known
                ):
                    found.append(f"{path.name}:{after.lineno}: {ast.unparse(after.value)}")
    assert not found
