"""The public functions, classes of options and methods of results, with arguments that are fine,
and what a user may put in the place of any of them.

They are found by their signatures and docstrings: a new function, argument or method is called
without a new line here, with None where no value of the argument's name is listed.
"""

import contextlib
import dataclasses
import datetime
import functools
import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import members
import numpy as np
from conftest import SHORT
from made_up_runs import made_up
from test_public_api import NAMES, public

import iblf_jax as ij
from iblf_jax.core.status import Status
from iblf_jax.engine import CompiledBatch
from iblf_jax.engine.plan import ExecutionPlan
from iblf_jax.simulation.results import Metrics
from iblf_jax.studies.options import RunOptions
from iblf_jax.studies.study_setup import prepare
from iblf_jax.tuning.parameters import layout
from iblf_jax.tuning.result import TuneSetup
from iblf_jax.tuning.robust import as_risk

WEAK = ij.presets.zhang_yan_2024()
HELD = dataclasses.replace(WEAK, sampling=ij.Sampling(period=1e-3, observer="poles"))
DRAWN = {"plant.mass": ij.factor(ij.uniform(0.9, 1.1))}
INTERVAL = {"plant.mass": ij.factor(ij.interval(0.9, 1.1))}
TRACKING = ij.objectives.tracking(scale=1.0)
TUBE = jax.jit(ij.bounds.tube_at)(WEAK.reference, WEAK.bounds[0], 0.1)
RUNS = (
    *("engine.simulate.run_one", "engine.explain.program_of"),
    *("studies.blocks._execute", "studies.blocks.traced"),
    *("tuning.problem.rollouts", "tuning.evaluation.Evaluator.__call__", "tuning.result._slice"),
    *("tuning._falsify._margins", "certificates._certify._certificate_of"),
    *("proofs._prove.problem_of", "plotting._style.new_figure"),
    *("deployment.export._export_law", "deployment.export._export_loop"),
    *(
        f"testing.{checker}.shape_of"
        for checker in ("_contract", "laws", "metrics", "observers", "robots", "world")
    ),
    "testing.objectives.shape_of",
)
"""What begins runs, drawings and the evaluations of a checker."""


class Entered(Exception):  # noqa: N818
    """The arguments were accepted; nothing is computed in these tests."""


def entered(*args, **options):
    raise Entered


@contextlib.contextmanager
def without_runs() -> Iterator[None]:
    """Whatever would run or draw raises Entered."""
    by_scan = ExecutionPlan((), reports_unsupported=True)
    with contextlib.ExitStack() as stack:
        for place in RUNS:
            stack.enter_context(mock.patch(f"iblf_jax.{place}", entered))
        stack.enter_context(
            mock.patch(
                "iblf_jax.studies.study_setup.compile_batch",
                lambda request, *_: CompiledBatch(request, by_scan),
            )
        )
        yield


# --- functions, and classes of options ------------------------------------------------------------

SAY_NOTHING = """
Sampling tuning.Effort tuning.Report bounds.positive_width objectives.complete parameters
objectives.margin_above objectives.sharper plotting.identification plotting.pareto
regions.joint_names robots.at_time robots.energy_gradient robots.friction_torque
robots.inverse_dynamics robots.mass_matrix_rate
"""
"""Functions and classes that check although their docstrings have no ValueError."""
INNER = """
disturbances.jump_times_of metrics.as_folds objectives.fitted objectives.for_scenario
objectives.indices objectives.selection references.jump_times_of plotting.adaptation
tuning.on_slice
"""
"""They receive arguments that other functions have checked, or draw more than `results` has."""


def with_a_design(kind="random", points=4):
    """A sweep over random gains."""
    grid = {"controller.K2": ij.uniform(1.0, 2.0)}
    return ij.sweep(WEAK, grid, design=ij.studies.Design(kind, points), duration=0.01)


def executor(devices=None, memory=1e9, chunk=None):
    return ij.studies.LocalExecutor(devices, memory, chunk).checked()


def store(path="never.zarr", unit=None, writer="client", shared=False):
    return ij.studies.StoreOptions(path, unit, writer, shared).checked()


@functools.cache
def entries() -> dict[str, Callable[..., Any]]:
    """Every public function that says that it raises a ValueError, and classes of options."""
    things = {name: getattr(ij, name) for name in NAMES}
    for family in [name for name, thing in things.items() if inspect.ismodule(thing)]:
        things |= {f"{family}.{name}": x for name, x in public(things[family]).items()}
    found = {"Design": with_a_design, "LocalExecutor": executor, "StoreOptions": store}
    for name, thing in things.items():
        document = inspect.getdoc(thing) or ""
        is_solver = inspect.isclass(thing) and issubclass(thing, ij.tuning.Solver)
        is_checked = re.search(r"Raises:\n(.*\n)*?\s+.*ValueError", document) or (
            name in SAY_NOTHING.split() or is_solver
        )
        is_entry = inspect.isfunction(thing) or inspect.isclass(thing)
        if is_entry and is_checked and name not in INNER and thing not in found.values():
            found[name] = thing
    return found


FINE = (
    {family: next(iter(instances.values())) for family, (instances, *_) in members.FAMILIES.items()}
    | dict.fromkeys(("q", "dq", "v", "u", "acceleration"), (0.1, 0.2))
    | {"scenario": WEAK, "duration": SHORT["duration"], "perturbations": DRAWN, "runs": 2}
    | {"parameters": ["controller.K2"], "objective": TRACKING, "grid": {"controller.K2": [1.0]}}
    | {"objectives": (TRACKING, ij.objectives.effort()), "paths": ["plant.mass"], "log": {}}
    | {"folder": "never", "path": "never.toml", "result": WEAK, "tree": WEAK, "dtype": "float32"}
    | {"distribution": ij.uniform(0.9, 1.1), "low": 1.0, "high": 2.0, "level": 0.1, "limit": 0.1}
    | {"between": (0.5, 1.0), "gains": {"controller.K2": (1.0, 20.0)}, "values": [1.0]}
    | {"bounds": WEAK.bounds[0], "tube": TUBE, "guard": 1e-3, "k": 1.0, "t": 0.1, "n": 2}
    | {"period": 1e-3}
    | {"mass_matrix": members.TWO_LINK.mass_matrix, "start": [1.0], "factor": 2.0, "name": "rmse"}
)
"""Argument -> a value that is fine."""
OWN = {
    "tunable": {"path": "controller.K2"},
    "with_parameters": {"values": {}},
    "cosimulate": {"plant": "never.xml", "period": 1e-3, "duration": 0.01},
    "export": {"period": 1e-3},
    "prove": {"level": 1.0, "parameters": INTERVAL, "runs": 0},
    "largest_level": {"parameters": {}},
    "largest_parameters": {"parameters": INTERVAL},
    "largest_period": {"parameters": {}, "scenario": HELD},
    "gains_for_guarantee": {"parameters": {}},
    "compare": {"laws": ["integral"]},
    "sensitivity": {"points": 2},
    "certify": SHORT,
    "presets.arm_scenario": {"law": "log", "robot": WEAK.plant, "reference": WEAK.reference},
}
"""Entry -> arguments that differ, or that make the call short."""


def arguments_of(entry: str) -> dict[str, inspect.Parameter]:
    parameters = inspect.signature(entries()[entry]).parameters
    return {
        name: x for name, x in parameters.items() if x.kind not in (x.VAR_POSITIONAL, x.VAR_KEYWORD)
    }


def call(entry: str, **changed: Any) -> Any:
    """Calls an entry with arguments that are fine, except for what is changed."""
    parameters = arguments_of(entry)
    needed = {name: FINE.get(name) for name, x in parameters.items() if x.default is x.empty}
    if entry.startswith("plotting."):
        kinds = {"runs": "run", "result": "tuning"} | dict(zip(KINDS, KINDS, strict=True))
        needed |= {name: results()[kinds[name]] for name in needed if name in kinds}
    return entries()[entry](**(needed | OWN.get(entry, {}) | changed))


# --- methods of results ---------------------------------------------------------------------------


@functools.cache
def results() -> dict[str, Any]:
    """One result of every kind, which no simulator made."""
    run = made_up(WEAK.plant, duration=0.1)
    options = RunOptions(duration=0.01, dt=1e-3, method="rk4", backend="vmap", runs=4, seed=0)
    ways = {"controller.K2": ij.factor(ij.uniform(0.9, 1.1))}
    with without_runs():
        setup = prepare(WEAK, ways, options, metrics=None)
    values = {"margin": np.full((4, 2), 0.1), "rmse": np.full((4, 2), 0.01)}
    found = Metrics(values, (("margin", "rad"), ("rmse", "rad")))
    samples = {"controller.K2": np.full((4, 2), 20.0)}
    study = ij.Study(WEAK, found, np.zeros(4, np.int32), np.ones(4), samples, setup)
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
        objective=TRACKING,
        report=ij.tuning.Report(runs=4, seed=1),
        limits=((1.0, 100.0), (1.0, 100.0)),
    )
    names = ("controller.K2[0]", "controller.K2[1]")
    best = {"controller.K2": np.full(2, 20.0)}
    words = ("done", "newton", "forward", 1.0)
    tuned = ij.TuneResult(WEAK, WEAK, best, names, history, 0, *words, setup)
    vars(tuned)["nominal"] = (run, run)
    twos, (blocks, _) = np.ones((2, 2)), layout(WEAK, ["controller.K2"], 1e-3, "rk4")
    return {
        "run": run,
        "study": study,
        "tuning": tuned,
        "front": ij.ParetoFront(
            ("a", "b"), twos, twos, names, twos, twos[0], WEAK, blocks, twos, 1.0
        ),
        "attack": ij.WorstCase(
            *(WEAK, {}, 0.1, 0.1, 0, twos, 4, {"duration": 0.01, "dt": 1e-3, "method": "rk4"})
        ),
        "comparison": ij.Comparison({"log": run}, {}, {}, {}, {"log": "K2 = 20"}),
    }


OF_METHODS = {
    "event": Status.BOUND_VIOLATED,
    "index": 0,
    "path": "controller.K2",
    "quantiles": [0.5],
    "first": "controller.K2[0]",
    "second": "controller.K2[1]",
}
"""Argument of a method -> a value that is fine."""
KINDS = {
    "run": ij.Rollout,
    "study": ij.Study,
    "tuning": ij.TuneResult,
    "front": ij.ParetoFront,
    "attack": ij.WorstCase,
    "comparison": ij.Comparison,
}


def methods() -> dict[str, list[str]]:
    """ "kind.method" of every public method of a result, and the arguments that it names."""
    found = {}
    for kind, cls in KINDS.items():
        for name, function in inspect.getmembers(cls, inspect.isfunction):
            _, *parameters = inspect.signature(function).parameters.values()
            named = [x.name for x in parameters if x.kind is not x.VAR_KEYWORD]
            if named and not name.startswith("_") and f"{kind}.{name}" not in INNER:
                found[f"{kind}.{name}"] = named
    return found | {"study.__getitem__": ["index"]}


def call_method(method: str, **changed: Any) -> Any:
    """Calls a method of a result with arguments that are fine, except for what is changed."""
    kind, _, name = method.partition(".")
    function = getattr(results()[kind], name)
    needed = [x for x in inspect.signature(function).parameters.values() if x.default is x.empty]
    fine = {x.name: (FINE | OF_METHODS).get(x.name) for x in needed if x.kind is not x.VAR_KEYWORD}
    return function(**(fine | changed))


# --- what a user may give -------------------------------------------------------------------------

DEEP: list = [1.0]
for _ in range(5000):
    DEEP = [DEEP]


class Broken:
    """Nothing can be asked of it."""

    def __bool__(self):
        raise RuntimeError

    __len__ = __iter__ = __array__ = __float__ = __repr__ = __eq__ = __bool__
    __hash__ = None


NASTY = (
    {"none": None, "long": "x" * 5000, "null-byte": "a\0b.npz", "surrogate": "\ud800.nc"}
    | {"huge": 10**5000, "2**40": 2**40, "int8": np.int8(-3), "nan": float("nan"), "bytes": b"abc"}
    | {"key": jax.random.key(0), "keys": jax.random.split(jax.random.key(0)), "class": int}
    | {"array": np.ones(3), "objects": np.asarray([object(), None]), "ragged": [[1.0], [1.0, 2.0]]}
    | {"deep": DEEP, "mixed-dict": {1: 2, "a": DEEP}, "date": datetime.date(2020, 1, 1)}
    | {"generator": (x for x in (1.0, 2.0)), "words": ["cpu"], "folder": Path("/")}
    | {"empty": [], "complex": 1j, "cube": np.ones((2, 3, 4)), "words of words": {"a": 1}}
    | {"broken": Broken()}
)


def depth_left(n: int = 500) -> bool:
    """Whether a deep list that reached JAX has not spoilt the interpreter's count of recursions."""
    return n == 0 or depth_left(n - 1)


def readable(error: ValueError, case: object) -> str:
    """The message of an error, which says what came in one line that can be read."""
    said = str(error)
    assert ": got " in said and "\n" not in said, (case, said)
    assert len(said) < 1500, case
    return said
