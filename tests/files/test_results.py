"""Every result of a public function has `save`, and `ij.load` returns an equal result."""

import dataclasses
import functools
import importlib
import inspect
import io
import json
import operator
import re
import typing
import zipfile
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT
from matplotlib.figure import Figure
from refused import assert_refused
from stored_results import stored

import iblf_jax as ij
from iblf_jax.core.presentation import Result
from iblf_jax.core.pytree import field_values
from iblf_jax.files.results import RECORDS
from iblf_jax.identification import excitation
from iblf_jax.simulation.closed_loop import initial_state
from iblf_jax.simulation.scenario import canonical

MODULES = ("certificates", "deployment", "proofs", "studies", "tuning")
NOT_RESULTS = {
    "Line": "a part of a Certificate",
    "Scenario": "has a file of its own, save_scenario",
    "ParameterTable": "a view of a scenario",
    "VectorField": "a function of a scenario",
    "Tunable": "an argument of tune",
    "Risk": "an argument of tune",
    "Exported": "is about files that were written",
    "Page": "has a file of its own, HTML",
    "SimulatedRobot": "runs a simulation",
}
"""Class that a public function returns -> why it is no result."""

MASS = {"plant.mass": ij.factor(ij.uniform(0.8, 1.2))}
TIMES = {"duration": 0.1, "dt": 2e-3}
QUIET = {"progress": False}
BRIEF = TIMES | QUIET
PAPER = ij.presets.zhang_yan_2024()
PENDULUM = ij.Scenario(
    plant=ij.robots.PlanarChain(mass=[2.0], length=[0.5], centre=[0.25], inertia=[0.05]),
    reference=ij.references.Sinusoid(0.0, 0.2),
    bounds=ij.bounds.Bounds(ij.bounds.Constant(-0.8), ij.bounds.Constant(0.8)),
    controller=ij.controllers.Backstepping(2.0, 3.0, variant="corrected"),
    observer=ij.observers.Momentum(100.0),
    initial=ij.Initial(0.0),
)
"""One joint: what proves, tunes and searches compiles soon."""
NARROW = {"plant.mass": ij.factor(ij.interval(0.99, 1.01))}


def _public_functions() -> Iterator[Callable]:
    for module in (ij, *(importlib.import_module(f"iblf_jax.{name}") for name in MODULES)):
        for name in dir(module):
            member = getattr(module, name)
            if inspect.isfunction(member) and not name.startswith("_"):
                yield member


def _returned(function: Callable) -> Iterator[type]:
    """The classes of the package in the annotation of what a function returns."""
    try:
        hint = typing.get_type_hints(function).get("return")
    except NameError:  # of a class that only type checkers import
        return
    for option in typing.get_args(hint) or (hint,):
        if isinstance(option, type) and option.__module__.startswith("iblf_jax"):
            yield option


def _result_classes() -> list[type]:
    """The classes that public functions return, and the methods of these classes."""
    found: dict[str, type] = {}
    functions = list(_public_functions())
    while functions:
        for cls in _returned(functions.pop()):
            is_component = "_registered_component" in vars(cls)
            if cls.__name__ in found or cls.__name__ in NOT_RESULTS or is_component:
                continue
            found[cls.__name__] = cls
            members = inspect.getmembers(cls, inspect.isfunction)
            functions += [x for name, x in members if name == "__getitem__" or name[0] != "_"]
    return [found[name] for name in sorted(found)]


CLASSES = _result_classes()


def test_every_result_has_save_and_a_name_in_files_which_leads_to_it():
    for cls in CLASSES:
        assert cls.save is Result.save, cls
        assert (cls.__module__.removeprefix("iblf_jax."), cls.__qualname__) in RECORDS.values()
    names = {cls.__name__ for cls in CLASSES}
    assert names >= {"Rollout", "Study", "FirstExit", "Proof", "Certificate", "TuningReport"}
    places = list(RECORDS.values())
    assert len(set(places)) == len(places)
    for module, name in places:
        assert isinstance(getattr(importlib.import_module(f"iblf_jax.{module}"), name), type)


@functools.cache
def _study() -> Any:
    perturbations = MASS | {"initial.q": ij.offset(ij.normal(0.0, 0.05))}
    metrics = (*ij.metrics.standard(), ij.metrics.FirstExit())
    return ij.monte_carlo(PAPER, perturbations, runs=16, metrics=metrics, **BRIEF)


@functools.cache
def _tuned() -> Any:
    goal = ij.objectives.tracking() + ij.objectives.peak_torque_below(60.0)
    effort = ij.tuning.Effort(values=0, starts=1, iterations=2)
    options = {"runs": 2, "solver": ij.tuning.SQP(), "report": ij.tuning.Report(runs=4)} | TIMES
    options |= {"perturbations": MASS, "effort": effort} | QUIET
    return ij.tune(PENDULUM, ["controller.K2"], goal, **options)


@functools.cache
def _failure() -> Any:
    law = ij.with_parameters(PAPER, {"initial.q": 0.88})
    start = {"initial.q": ij.offset(ij.normal(0.0, 0.03))}
    return ij.failure_probability(law, start, estimator="monte_carlo", runs=400, **BRIEF)


@functools.cache
def _proof() -> Any:
    options = {"parameters": NARROW, "weight": 0.01, "max_boxes": 2000}
    return ij.prove(PENDULUM, level=0.5, disturbance_rate=0.1, **options, **QUIET)


def _front() -> Any:
    goals = (ij.objectives.tracking(), ij.objectives.effort())
    options = {"points": 3, "iterations": 2} | TIMES | QUIET
    return ij.pareto(PENDULUM, ["controller.k1", "controller.K2"], goals, **options)


def _counterexample() -> Any:
    start = {"initial.q": ij.offset(ij.uniform(-0.01, 0.01))}
    return ij.certificates.counterexample(ij.presets.printed_gap(), start, starts=2)


def _gains() -> Any:
    ranges = {"controller.K2": (1.0, 10.0)}
    options = {"parameters": NARROW, "tries": 2, "max_boxes": 2000}
    return ij.gains_for_guarantee(PENDULUM, ranges, level=0.5, **options, **QUIET)


def _certificate(scenario: ij.Scenario) -> Any:
    return ij.certify(scenario, ij.simulate(scenario, **TIMES))


def _identification() -> Any:
    scenario = ij.with_parts(PAPER, reference=excitation(PAPER, ["robot.mass"], duration=2.0))
    run = ij.simulate(scenario, duration=2.0, dt=2e-3, record_every=5)
    log = {name: np.asarray(getattr(run, name)) for name in ("t", "q", "tau")}
    return ij.identify(scenario, log, ["robot.mass"])


@functools.cache
def _sampled() -> ij.Rollout:
    scenario = ij.with_parts(
        ij.presets.motor_driven_pendulum(),
        observer=ij.observers.StateObserver(bandwidth=60.0, measured=(1,)),
        sampling=ij.Sampling(period=2e-3),
        sensor=ij.sensors.Levels((ij.sensors.Direct(), None, None)),
    )
    return ij.simulate(scenario, throw=False, **TIMES)


@functools.cache
def _many() -> ij.Rollout:
    def run(gain: jax.Array) -> ij.Rollout:
        return ij.simulate(ij.with_parameters(PAPER, {"controller.K2": gain}), **TIMES)

    return jax.vmap(run)(jnp.array([[10.0, 12.0], [20.0, 24.0]]))


EXAMPLES: dict[str, tuple[Callable[[], Any], ...]] = {
    "WorstCase": (lambda: ij.falsify(PENDULUM, MASS, starts=2, iterations=2, **BRIEF),),
    "Certificate": (
        lambda: _certificate(PAPER),
        lambda: _certificate(ij.presets.motor_driven_pendulum()),
    ),
    "Comparison": (lambda: ij.compare(PAPER, laws=("integral", "log"), **TIMES),),
    "Counterexample": (_counterexample,),
    "Explanation": (lambda: ij.explain(PAPER),),
    "FailureProbability": (_failure,),
    "FirstExit": (lambda: _study().first_exit(),),
    "ParetoFront": (_front,),
    "GuaranteedGains": (_gains,),
    "Identification": (_identification,),
    "OneRun": (lambda: _study()[3],),
    "Probability": (lambda: _study().violation_probability,),
    "Proof": (_proof,),
    "Rollout": (_many, _sampled),
    "Sensitivity": (lambda: ij.sensitivity(PENDULUM, MASS, output="rmse", points=8, **BRIEF),),
    "Study": (_study,),
    "TuneResult": (_tuned,),
    "TuningReport": (lambda: _tuned().report,),
}
"""Name of a class -> what makes examples of it."""
FROM_FILES = {
    *("Certificate", "Comparison", "Counterexample", "Explanation", "GuaranteedGains"),
    *("Identification", "ParetoFront", "Sensitivity", "WorstCase"),
}
"""Classes whose examples `stored_results` has computed.  A field that a class gets afterwards is
not in these files, which have to be computed anew then, so that it is saved there."""


def assert_equal(a: Any, b: Any, key: str) -> None:
    """Raises where two results differ in a class, a type of number or a bit."""
    assert type(a) is type(b) or isinstance(a, jax.Array), f"{key}: {type(a)}, {type(b)}"
    if isinstance(a, np.ndarray | np.generic | jax.Array):
        x, y = np.asarray(a), np.asarray(b)
        assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes()), key
    elif isinstance(a, float):
        assert np.float64(a).tobytes() == np.float64(b).tobytes(), key
    elif isinstance(a, Mapping) and not isinstance(a, ij.Metrics):
        assert list(a) == list(b), key
        for name in a:
            assert_equal(a[name], b[name], f"{key}[{name}]")
    elif isinstance(a, tuple | list):
        assert len(a) == len(b), key
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_equal(x, y, f"{key}[{i}]")
    elif dataclasses.is_dataclass(a):
        before, after = field_values(a), field_values(b)
        for name in before:
            assert_equal(before[name], after[name], f"{key}.{name}")
    else:
        assert a == b, key


@pytest.mark.slow
@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_a_saved_result_comes_back(cls, tmp_path):
    for i, make in enumerate(EXAMPLES[cls.__name__]):
        name = cls.__name__
        result = stored(f"{name}_{i}") if name in FROM_FILES else make()
        text = repr(result), str(result)
        assert result.save(tmp_path / f"{i}") == tmp_path / f"{i}"
        again = ij.load(tmp_path / f"{i}")
        assert type(again) is cls
        assert_equal(result, again, cls.__name__)
        assert (repr(again), str(again)) == text
        if hasattr(cls, "plot") and not getattr(again, "is_batch", False):
            figure = Figure()
            assert again.plot(figure=figure) is figure and figure.axes
            panels = Figure().subplots(len(figure.axes), squeeze=False)
            if name in ("FirstExit", "ParetoFront", "Proof"):
                assert again.plot(ax=panels) is panels
            elif name != "Study":  # Its overview is a table of panels, as its other figures are.
                assert_refused("expected figure= in its place", again.plot, ax=panels)


@pytest.mark.slow
def test_a_loaded_result_replays_its_runs_finds_its_problem_and_computes_nothing_again(tmp_path):
    for result, arguments in ((_study(), (3,)), (_failure().most_likely_failure, ())):
        result.save(tmp_path / "result")
        expected, run = result.replay(*arguments), ij.load(tmp_path / "result").replay(*arguments)
        assert_equal(expected, run, "replay")
    proof = _proof()
    assert proof.problem.names  # Now the proof keeps the problem, which no file can hold.
    proof.save(tmp_path / "proof")
    again = ij.load(tmp_path / "proof")
    (run,), (expected,) = again.adversarial_runs(1, dt=0.01), proof.adversarial_runs(1, dt=0.01)
    assert_equal(expected, run, "run")
    assert again.problem.assumptions == proof.assumptions
    # The text of a tuning states its report, which takes many runs.
    result = _tuned()
    assert "fresh runs" in repr(result) and result.report
    result.save(tmp_path / "tuned")
    again = ij.load(tmp_path / "tuned")
    assert {"report", "step_check"} <= vars(again).keys()
    assert str(again.report) == str(result.report)


@pytest.fixture(scope="module")
def run() -> ij.Rollout:
    return ij.simulate(PAPER, **TIMES)


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".NC", ".npz"])
def test_runs_of_save_rollouts_come_back_as_rollouts(run, ending, tmp_path):
    path = tmp_path / f"runs{ending}"
    ij.save_rollouts(run, path)
    assert_equal(run, ij.load(path), "run")
    runs = {"one": run, "many-runs 2": _many(), "levels": _sampled()}
    ij.save_rollouts(runs, path)
    assert_equal(runs, ij.load(path), "runs")


@pytest.mark.slow
@pytest.mark.parametrize("enabled", [False, True])
def test_numbers_keep_their_precision_in_both_modes_of_jax(enabled, tmp_path):
    with jax.enable_x64(True):
        run = ij.simulate(ij.astype(PAPER, jnp.float64), **TIMES)
    with jax.enable_x64(False):
        single = ij.simulate(ij.astype(PAPER, jnp.float32), **TIMES)
    for name, result in (("double", run), ("single", single)):
        with jax.enable_x64(not enabled):
            result.save(tmp_path / name)
        with jax.enable_x64(enabled):
            again = ij.load(tmp_path / name)
        assert_equal(result, again, name)


@ij.component
class Push:
    size: ij.Leaf = ij.leaf("N m")

    def torque(self, t, q, dq, plant, model):
        return jnp.broadcast_to(self.size, q.shape)

    def jump_times(self):
        return jnp.zeros(0)


class Pair(NamedTuple):
    one: jax.Array
    other: jax.Array


@ij.component
class WithPair(ij.actuators.Actuator):
    """An actuator whose state is a record of the user's."""

    def init(self, tau):
        return Pair(tau, 2.0 * tau)

    def deliver(self, command, dq, state):
        return ij.actuators.Delivered(command, jnp.zeros(command.shape, bool), state)


def test_states_come_back_and_a_class_of_a_user_needs_a_name(run, tmp_path, monkeypatch):
    monkeypatch.setitem(ij.actuators.MEMBERS, "with_pair", WithPair)
    law, observer = ij.controllers.AdaptiveRBF(2.0, 20.0, nodes=2), ij.observers.ExtendedState(40.0)
    parts = {"controller": law, "observer": observer, "actuator": WithPair()}
    scenario = ij.with_parts(PAPER, **parts)
    start = initial_state(canonical(scenario))
    states = {f"{part}_state": getattr(start, part) for part in parts}
    assert all(map(jax.tree.leaves, states.values()))
    with_states = dataclasses.replace(run, scenario=scenario, **states)
    with_states.save(tmp_path / "run")
    assert_equal(with_states, ij.load(tmp_path / "run"), "run")
    mine = dataclasses.replace(run, scenario=ij.with_parts(PAPER, disturbance=Push(0.5)))
    with pytest.raises(ValueError, match=r'scenario: disturbance: .*disturbances.MEMBERS\["my_'):
        mine.save(tmp_path / "mine")
    assert not (tmp_path / "mine").exists()
    monkeypatch.setitem(ij.disturbances.MEMBERS, "push", Push)
    mine.save(tmp_path / "mine")
    assert_equal(mine, ij.load(tmp_path / "mine"), "mine")
    monkeypatch.delitem(ij.disturbances.MEMBERS, "push")
    with pytest.raises(ValueError, match=r'mine: result.scenario: .*MEMBERS\["push"\] = TheClass'):
        ij.load(tmp_path / "mine")


UNREADABLE = [
    (object(), ": got"),
    (lambda: 0, ": got"),
    (np.array([None]), ": got"),
    (np.zeros(2, [("a", float)]), r": got an array of type \[\('a'"),
    *(
        (
            {"x": jax.device_put(np.zeros(2, jnp.dtype(dtype)))},
            rf"\[x\]: got an array of type {dtype}",
        )
        for dtype in ("int4", "float8_e4m3fn", "float8_e5m2")
    ),
    *(
        ({"inner": {key: 1.0}}, rf"\[inner\]: got a dict with the key {re.escape(repr(key))}")
        for key in ((0, 1), None, np.int64(1))
    ),
]


def test_what_could_not_be_read_is_not_saved(run, tmp_path, monkeypatch):
    for value, words in UNREADABLE:
        odd = dataclasses.replace(run, measured=value)
        assert_refused(rf"Rollout\.measured{words}", odd.save, tmp_path / "odd")
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda x: dataclasses.replace(run, x=x).save(tmp_path / "odd"))(run.x)
    assert not list(tmp_path.iterdir())
    path = tmp_path / "run"
    path.write_bytes(b"old")

    def full(*words, **options):
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "save", full)
    assert_refused("no space", run.save, path, error=OSError)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


DEEP = functools.reduce(lambda node, _: {"list": [node]}, range(100), 1)
MEMBER = {"member": "barriers.none", "fields": {}}
VERDICT = {"enum": "ProofVerdict", "value": "maybe"}
SCENARIO = "result.fields.scenario"
CHANGES = [
    ("result.fields.speed", 1.0, "result.speed: got an unknown key"),
    ("result.fields.status", ..., "result.status: got nothing"),
    ("result.fields.steps", "many", "result.steps: .*expected one of type int"),
    ("result.record", "Popen", "result: got 'Popen'"),
    ("result.fields.steps", {"call": "os.system"}, "result.steps: got .*a node"),
    ("result.fields.steps", DEEP, "result.steps.*nodes inside each other"),
    ("result.fields.steps", MEMBER, r'got .barriers.none.*barriers.MEMBERS\["none"\]'),
    ("result.fields.steps", VERDICT, "result.steps: got 'maybe', expected a Verdict"),
    ("result.fields.steps", {"dict": [[1]]}, "result.steps: got .*a pair"),
    ("result.fields.x.jax", 999, "result.x: .*999.npy"),
    ("result.fields.x.type", "int32", "x: got an array of type float.*expected type int32"),
    ("result.fields.x.shape", [3], "result.x: .*shape"),
    (f"{SCENARIO}.leaves", ..., "result.scenario: got None, expected a list"),
    (f"{SCENARIO}.leaves", [], "result.scenario.leaves: got .*arrays"),
    (f"{SCENARIO}.scenario.robot.speed", 1.0, "result.scenario: robot.speed: got an unknown key"),
    ("version", 2, "version: got 2, expected 1"),
    ("result", ..., "result: got nothing"),
]
"""Key of a description, another value (... for none), and what the error says."""


def test_a_changed_file_is_refused_with_its_key(run, tmp_path):
    with zipfile.ZipFile(run.save(tmp_path / "run")) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    text, other = files.pop("result.json"), tmp_path / "changed"

    def assert_named(description, files, words):
        with zipfile.ZipFile(other, "w") as archive:
            for name, content in files.items():
                archive.writestr(name, content)
            archive.writestr("result.json", json.dumps(description))
        assert_refused(f"changed: .*{words}", ij.load, other)

    for key, value, words in CHANGES:
        description = json.loads(text)
        *path, last = key.split(".")
        node = functools.reduce(operator.getitem, path, description)
        node[last] = value
        if value is ...:
            del node[last]
        assert_named(description, files, words)
    description, content = json.loads(text), io.BytesIO()
    np.save(content, np.array([print], object), allow_pickle=True)
    number = description["result"]["fields"]["x"]["jax"]
    objects = files | {f"{number}.npy": content.getvalue()}
    assert_named(description, objects, "result.x: got no array that can be read")


def test_damaged_and_foreign_files_are_refused_with_their_name(run, tmp_path):
    content = run.save(tmp_path / "run").read_bytes()
    place = tmp_path / "damaged"
    cut = [content[:size] for size in (0, 1, 10, len(content) // 2, len(content) - 1)]
    for text in (*cut, b"PK", b"CDF", b"{", b"hello", np.random.default_rng(0).bytes(1000)):
        place.write_bytes(text)
        assert_refused("damaged", ij.load, place)
    with zipfile.ZipFile(place, "w") as archive:
        archive.writestr("other.txt", "text")
    assert_refused(r"damaged: result\.json: got nothing", ij.load, place)
    assert_refused("Nothing is there", ij.load, tmp_path / "none", error=FileNotFoundError)
    generator, place = np.random.default_rng(0), tmp_path / "flipped"
    for position in generator.integers(0, len(content), 60):
        changed = bytearray(content)
        changed[position] ^= 1 << int(generator.integers(8))
        place.write_bytes(changed)
        message = ""
        try:
            again = ij.load(place)
        except ValueError as error:
            message = str(error)
        if message:
            assert "flipped" in message
        else:  # The bit was one of a date, for example.
            assert_equal(run, again, "run")


def test_numpy_reads_an_archive_and_scenarios_and_earlier_tunings_are_loaded_too(run, tmp_path):
    with np.load(run.save(tmp_path / "run.npz"), allow_pickle=False) as archive:
        number = json.loads(archive["result.json"])["result"]["fields"]["x"]["jax"]
        np.testing.assert_array_equal(archive[str(number)], run.x)
    ij.save_scenario(PAPER, tmp_path / "paper.toml")
    assert isinstance(ij.load(tmp_path / "paper.toml"), ij.Scenario)
    earlier = ij.load(ROOT / "tests" / "data" / "tuning_before_weights.json")
    assert earlier.names == ("controller.k1[0]", "controller.k1[1]")
