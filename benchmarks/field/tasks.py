"""Writes the tasks of the benchmark of the field for programs in any language.

    python benchmarks/field/tasks.py [NAME ...]     # tasks/NAME.json and tasks/NAME.csv

A task is the plant, the reference, the bounds, the disturbance, the start, the limits and the
measured quantities of an entry, without its law.  Its functions are straight-line programs of
numbers, which are traced from the parts of the entry's scenario (`kernels.scalar_program`).  The
CSV file has a trajectory under the law of the entry.  `tasks/README.md` describes the format,
`tasks/schema.json` states it for programs, and `tasks/read_task.py` and `tasks/read_task.m` read
it.

A task that the format cannot express is a file with the `reason` in place of the functions.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import types
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE / "tasks")]

import entry
import external
import jax
import jax.numpy as jnp
import numpy as np
from task_laws import options_of

import iblf_jax as ij
from iblf_jax import kernels, sensors
from iblf_jax.core import taylor
from iblf_jax.simulation import levels
from iblf_jax.simulation.closed_loop import LoopState, continuous_law
from iblf_jax.simulation.scenario import canonical
from iblf_jax.world import plants, regions
from iblf_jax.world.bounds import bounds_at

FORMAT = "task of the benchmark of the field, version 1"
FOLDER = HERE / "tasks"
ROWS = 300
"""Of a trajectory."""
DIGITS = 9
"""Of the numbers of a trajectory."""
SAMPLES = 20
"""Random states at which a task is compared with its entry."""
AGREEMENT = 1e-10
"""Largest difference there, as a share of the largest value of the result."""


class InexpressibleError(ValueError):
    """A task that the format cannot express; the message is the reason."""


# ---------------------------------------------------------------------------- functions


class Function(NamedTuple):
    """A function of a task."""

    arguments: tuple[str, ...]
    """Of t, x, u, w, in this order."""
    value: Callable[..., Any]
    """Function (t, x, u, w) -> numbers, as far as it has these arguments; x is the flat state."""


class Sizes(NamedTuple):
    """Numbers of entries of the arguments of functions."""

    t: int
    x: int
    u: int
    w: int


class Plant(NamedTuple):
    """The plant of a scenario with its actuator, over one flat state."""

    scenario: ij.Scenario
    order: int
    n: int
    actuator: Any
    """The state of the actuator at the start."""

    @classmethod
    def of(cls, scenario: ij.Scenario) -> Plant:
        """Of a canonical scenario."""
        x = levels.start_levels(scenario)
        steady = levels.steady_input(scenario, x[0])
        return cls(scenario, *x.shape, scenario.actuator.init(steady))

    def start(self) -> np.ndarray:
        """The flat state at t = 0."""
        return self.flat(levels.start_levels(self.scenario), self.actuator)

    def flat(self, x: Any, actuator: Any) -> Any:
        """The flat state from the levels, (..., r, n), and the state of the actuator."""
        parts = [x, *jax.tree.leaves(actuator)]
        lead = x.shape[:-2]
        return np.concatenate([np.reshape(part, (*lead, -1)) for part in parts], axis=-1)

    def levels(self, x: jax.Array) -> jax.Array:
        """The levels, (r, n), of a flat state."""
        return x[: self.order * self.n].reshape(self.order, self.n)

    def rates(self, t: jax.Array, x: jax.Array, u: jax.Array, w: jax.Array) -> list[jax.Array]:
        """The rate of the flat state for a disturbance w."""
        leaves, structure = jax.tree.flatten(self.actuator)
        ends = self.order * self.n + np.cumsum([leaf.size for leaf in leaves], dtype=int)
        parts = [
            x[end - leaf.size : end].reshape(leaf.shape)
            for leaf, end in zip(leaves, ends, strict=True)
        ]
        state = jax.tree.unflatten(structure, parts)
        level = self.levels(x)
        delivered = self.scenario.actuator.at(t).deliver(u, level[1], state)
        loop = types.SimpleNamespace(
            plant=self.scenario.plant, model=self.scenario.model, disturbance=_Given(w)
        )
        rate = levels.motion(loop, t, level, delivered.tau)
        return [rate, *jax.tree.leaves(delivered.rate)]

    def disturbance(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """The disturbance w, (1 + r) n numbers: a torque, and rates of the levels."""
        scenario, level = self.scenario, self.levels(x)
        torque = levels.disturbance_torque(scenario, t, level[0], level[1])
        rates = scenario.disturbance.rates(t, level, scenario.plant.at(t), scenario.model)
        rates = jnp.zeros_like(level) if rates is None else rates
        return jnp.concatenate([torque, rates.ravel()])


class _Given:
    """A disturbance with given numbers."""

    def __init__(self, w: jax.Array) -> None:
        self.w = w

    def torque(self, t, q, dq, plant, model):
        """The first n numbers."""
        return self.w[: q.size]

    def rates(self, t, x, plant, model):
        """The others."""
        return self.w[x.shape[1] :].reshape(x.shape)


def functions_of(plant: Plant, constraints: dict[str, Callable]) -> dict[str, Function]:
    """The functions of a task by their names."""
    scenario, n = plant.scenario, plant.n

    def reference(t):
        return jnp.concatenate(taylor.in_time(scenario.reference.position, t, plant.order))

    found = {
        "rates": Function(("t", "x", "u", "w"), plant.rates),
        "disturbance": Function(("t", "x"), plant.disturbance),
        "reference": Function(("t",), reference),
        "lower": Function(("t",), lambda t: sides_of(plant, t)[0]),
        "upper": Function(("t",), lambda t: sides_of(plant, t)[1]),
        "steady_input": Function(("x",), lambda x: levels.steady_input(scenario, x[:n])),
        "constraints": Function(
            ("t", "x"), lambda t, x: [one(t, plant.levels(x)) for one in constraints.values()]
        ),
    }
    if has_own_model(scenario) and plants.order_of(scenario.model) == plant.order:
        known = plants.as_plant(scenario.model)
        found["model_rates"] = Function(
            ("t", "x", "u"), lambda t, x, u: plants.flow(known, t, plant.levels(x), u)
        )
    return found


def sides_of(plant: Plant, t: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Lower and upper bounds of all levels at t, (r n,) each; infinite where there are none, and
    where they follow a virtual control, which is no part of the task.
    """
    infinite = jnp.full((plant.n,), jnp.inf)
    reference = taylor.in_time(plant.scenario.reference.position, t, plant.order - 1)
    lower, upper = [], []
    for level, bounds in enumerate(plant.scenario.bounds):
        low, high = -infinite, infinite
        if bounds is not None and not follows_law(plant, level):
            low, high = bounds_at(bounds, t, reference[level])
        lower.append(low)
        upper.append(high)
    return jnp.concatenate(lower), jnp.concatenate(upper)


def follows_law(plant: Plant, level: int) -> bool:
    """Whether the bounds of a level, counted from 0, depend on the virtual control of the law."""
    bounds = plant.scenario.bounds[level]
    if bounds is None or level < plant.scenario.loop.plant.reference_levels:
        return False
    n = plant.n
    lowered = kernels.scalar_program(lambda z, _: bounds_at(bounds, z[0], z[1:]), 1 + n)
    return any(node.op == "carry" and node.value > 0 for node in lowered.program.nodes)


def constraints_of(plant: Plant, made: entry.Definition) -> dict[str, Callable]:
    """Name -> function (t, x) that must not become negative, one number."""
    found = {}
    robot = plant.scenario.loop.plant.robot
    for i, region in enumerate(plant.scenario.regions):
        words = f"distance of {regions.in_words(region, robot)} to the boundary {i + 1} [m]"
        found[words] = lambda t, x, i=i: regions.margins(plant.scenario.regions, robot, x[0])[i]
    for name, function in made.constraints.items():
        found[name] = lambda t, x, function=function: jnp.min(jnp.asarray(function(t, x)))
    return found


# ---------------------------------------------------------------------------- programs


ALIKE = frozenset(external.read_task.OPERATIONS) - {"truncate"}
"""Operations of scalar programs that the format has under the same name."""


class Writer:
    """Writes a program as instructions; numbers of all kinds are floats, and truths 0 and 1.

    Args:
      inputs: number of inputs, which are the first numbers of the program.
    """

    def __init__(self, inputs: int) -> None:
        self.inputs = inputs
        self.instructions: list[list[Any]] = []

    def add(self, op: str, *arguments: Any) -> int:
        """The place of the result of a new instruction."""
        self.instructions.append([op, *arguments])
        return self.inputs + len(self.instructions) - 1

    def constant(self, value: float) -> int:
        """The place of a constant; JSON has finite numbers only, so others are quotients by 0."""
        if math.isnan(value):
            return self.add("div", self.add("const", 0.0), self.add("const", 0.0))
        if math.isinf(value):
            sign = self.add("const", math.copysign(1.0, value))
            return self.add("div", sign, self.add("const", 0.0))
        return self.add("const", float(value))

    def node(self, node: kernels.Node, kinds: Sequence[str], args: Sequence[int]) -> int:
        """The place of a node, whose arguments have these kinds and places."""
        op, kind = node.op, node.kind
        if op == "const":
            return self.constant(node.value)
        if op == "carry":
            return node.value
        if op == "lookup":
            return self.add("lookup", args[0], [float(x) for x in node.value])
        if op == "convert":
            return args[0] if (kinds[0], kind) != ("f", "i") else self.add("truncate", args[0])
        if op == "div":
            quotient = self.add("div", *args)
            return quotient if kind == "f" else self.add("truncate", quotient)
        if op in ("and", "or", "xor", "not") and kind == "b":
            return self.logic(op, args)
        if op == "rsqrt":
            return self.add("div", self.constant(1.0), self.add("sqrt", *args))
        if op == "logistic":
            below = self.add("exp", self.add("neg", *args))
            one = self.constant(1.0)
            return self.add("div", one, self.add("add", one, below))
        if op in ALIKE:
            return self.add(op, *args)
        raise InexpressibleError(f"the format has no operation {op!r}")

    def logic(self, op: str, args: Sequence[int]) -> int:
        """The place of an operation on truths."""
        if op == "not":
            return self.add("eq", args[0], self.constant(0.0))
        return self.add({"and": "mul", "or": "max", "xor": "ne"}[op], *args)


def program_of(function: Function, sizes: Sizes) -> dict[str, Any]:
    """A function as the format has it."""
    dimension = sum(getattr(sizes, name) for name in function.arguments)
    try:
        lowered = kernels.scalar_program(
            lambda z, _: function.value(*_divided(z, function.arguments, sizes)), dimension
        )
    except kernels.UnsupportedError as error:
        raise InexpressibleError(f"a function has no straight-line program: {error}") from error
    program = kernels.written_out(lowered.program)
    writer = Writer(dimension)
    places: list[int] = []
    for node in program.nodes:
        kinds = [program.nodes[a].kind for a in node.args]
        places.append(writer.node(node, kinds, [places[a] for a in node.args]))
    return {
        "arguments": list(function.arguments),
        "program": writer.instructions,
        "results": [places[output] for output in program.outputs],
    }


def _divided(z: jax.Array, arguments: Sequence[str], sizes: Sizes) -> list[jax.Array]:
    """The arguments that a flat vector has."""
    parts, first = [], 0
    for name in arguments:
        count = getattr(sizes, name)
        parts.append(z[0] if name == "t" else z[first : first + count])
        first += count
    return parts


# ---------------------------------------------------------------------------- the file


def task_of(folder: Path) -> dict[str, Any]:
    """The task of an entry."""
    contents, made = entry.load(folder), entry.definition(folder)
    head = {
        "format": FORMAT,
        "name": folder.name,
        "title": contents.title,
        "plant": contents.plant,
        "source": source_of(contents),
    }
    head["citation"] = citation_of(folder.name, contents)
    try:
        check_expressible(made.scenario)
        return head | body_of(contents, made)
    except InexpressibleError as error:
        return head | {"reason": str(error)}


def source_of(contents: entry.Entry) -> dict[str, Any]:
    """The publication that the task is read from."""
    source = contents.source
    return {
        "authors": source.authors,
        "title": source.title,
        "where": source.where,
        "year": source.year,
        "link": source.link,
        "read": entry.READ[source.read],
        "edition": source.edition,
    }


def citation_of(name: str, contents: entry.Entry) -> str:
    """How a publication cites the task."""
    source = contents.source
    return (
        f"Task {name} of the benchmark of the field of iblf_jax, {FORMAT.rpartition(', ')[2]},"
        f" after {source.authors}, {source.title}, {source.where}, {source.year}, {source.link}"
    )


def check_expressible(scenario: ij.Scenario) -> None:
    """Raises InexpressibleError for a scenario with parts that the format does not have."""
    plant = scenario.plant
    if plants.has_modes(plant):
        raise InexpressibleError("the plant switches between modes at events")
    if isinstance(plant, plants.Agents):
        raise InexpressibleError("the plant has several agents, each with a law of its own")
    if scenario.process_noise is not None:
        raise InexpressibleError("the plant has process noise")
    if scenario.actuator.input_delay is not None:
        raise InexpressibleError("the input has a delay, so that the state has its history")
    if scenario.sampling is not None and scenario.sampling.trigger is not None:
        raise InexpressibleError("events decide when the law runs")


def body_of(contents: entry.Entry, made: entry.Definition) -> dict[str, Any]:
    """The numbers and functions of a task."""
    scenario = canonical(made.scenario)
    plant = Plant.of(scenario)
    start = plant.start()
    constraints = constraints_of(plant, made)
    sizes = Sizes(1, start.size, plant.n, (1 + plant.order) * plant.n)
    functions = functions_of(plant, constraints)
    following = [i for i in range(plant.order) if follows_law(plant, i)]
    law_words = [
        f"the bounds of level {i + 1}, which follow the virtual control of the law"
        for i in following
    ]
    return {
        "state": states_of(plant),
        "levels": plant.order,
        "components": plant.n,
        "input": inputs_of(contents, scenario),
        "measured": measured_of(plant),
        "not_in_the_task": law_words,
        "sampling": sampling_of(scenario),
        "start": start.tolist(),
        "duration": contents.run.duration,
        "jumps": sorted(set(np.asarray(scenario.jump_times()).tolist())),
        "parameters": parameters_of(scenario),
        "constraints": list(constraints),
        "functions": {name: program_of(one, sizes) for name, one in functions.items()},
    }


def states_of(plant: Plant) -> dict[str, list[str]]:
    """Names, units and meanings of the numbers of the state."""
    part = plant.scenario.plant
    components = plants.component_names(part)
    found: dict[str, list[str]] = {"names": [], "units": [], "meanings": []}
    for level, words in enumerate(plants.level_names(part)):
        for i in range(plant.n):
            found["names"].append(f"x{level + 1}_{i + 1}")
            found["units"].append(_of_component(plants.units_of(part)[level], i))
            found["meanings"].append(f"{words}, {components[i]}")
    for i in range(plant.start().size - plant.order * plant.n):
        found["names"].append(f"a_{i + 1}")
        found["units"].append("of the actuator")
        found["meanings"].append(f"state of the actuator, {i + 1}")
    return found


def _of_component(unit: Any, i: int) -> str:
    """The unit of a component of a level."""
    return unit if isinstance(unit, str) else str(unit[i])


def inputs_of(contents: entry.Entry, scenario: ij.Scenario) -> dict[str, Any]:
    """Names, units and limits of the inputs; no limits where none are stated."""
    n, unit = scenario.n, plants.units_of(scenario.plant)[-1]
    found: dict[str, Any] = {
        "names": [f"u_{i + 1}" for i in range(n)],
        "units": [_of_component(unit, i) for i in range(n)],
        "meaning": plants.input_name(scenario.plant),
        "lower": None,
        "upper": None,
    }
    for side in ("lower", "upper"):
        if limits := [getattr(limit, side) for limit in contents.input_limits]:
            found[side] = np.broadcast_to(limits, (n,)).tolist()
    return found


def measured_of(plant: Plant) -> list[str]:
    """The states that the law may read: those of the levels that the sensor measures."""
    sensor = plant.scenario.sensor
    measured: Sequence[int] = range(1, plant.order + 1)
    if isinstance(sensor, sensors.Levels):
        measured = sensor.measured
    return [f"x{level}_{i + 1}" for level in measured for i in range(plant.n)]


def sampling_of(scenario: ij.Scenario) -> dict[str, float] | None:
    """Period of the law, and delay of its input [s]; None in continuous time."""
    if scenario.sampling is None:
        return None
    return {name: float(getattr(scenario.sampling, name)) for name in ("period", "delay")}


def parameters_of(scenario: ij.Scenario) -> dict[str, Any]:
    """Path -> value of all numbers but those of the law and its observer."""
    left_out = ["controller", "observer", "sampling", "initial"]
    if not has_own_model(scenario):
        left_out.append("model")
    return {
        parameter.path: np.asarray(parameter.value, float).tolist()
        for parameter in ij.parameters(scenario, named=False)
        if parameter.path.partition(".")[0].partition("[")[0] not in left_out
    }


def has_own_model(scenario: ij.Scenario) -> bool:
    """Whether the law knows another plant than the simulated one."""
    (own, structure), (known, other) = map(jax.tree.flatten, (scenario.plant, scenario.model))
    return structure != other or not all(map(np.array_equal, own, known))


# ---------------------------------------------------------------------------- the trajectory


def motion_of(plant: Plant, run: ij.Rollout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, flat state and input of the recorded samples of a run."""
    u = run.tau
    if not isinstance(plant.scenario.actuator, ij.actuators.Ideal):
        u = commands_of(plant.scenario, run)
    x = plant.flat(np.asarray(run.x), run.actuator_state)
    return np.asarray(run.t), x, np.asarray(u)


def commands_of(scenario: ij.Scenario, run: ij.Rollout) -> np.ndarray:
    """The input before the actuator, (T, n): a run records the one behind it."""

    def command(t, x, *states):
        return continuous_law(scenario, t, LoopState(x, *states)).input

    states = run.controller_state, run.observer_state, run.actuator_state
    commands = jax.jit(jax.vmap(command))(jnp.asarray(run.t), jnp.asarray(run.x), *states)
    if scenario.sampling is None:
        return np.asarray(commands)
    if jax.tree.leaves(states[:2]) or float(scenario.sampling.delay) > 0.0:
        raise InexpressibleError("a sampled law with a state or a delay, and an actuator")
    period = float(scenario.sampling.period)
    # The command is that of the last instant of the law, at which there is a record.
    last = np.floor(run.t / period + 1e-6) * period
    return np.asarray(commands)[np.searchsorted(run.t, last - 1e-9)]


def chosen_rows(t: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The rows of a trajectory, at most `ROWS`, the closer the faster the columns change."""
    spread = np.ptp(columns, axis=0)
    moving = columns[:, spread > 0.0] / spread[spread > 0.0]
    travel = np.abs(np.diff(moving, axis=0)).sum(axis=1) / max(1, moving.shape[1])
    # Half of the rows are equidistant in time.
    share = np.diff(t) / t[-1] + travel / max(travel.sum(), 1e-300)
    place = np.concatenate([[0.0], np.cumsum(share)])
    wanted = np.linspace(0.0, place[-1], min(ROWS, len(t)))
    return np.unique(np.searchsorted(place, wanted).clip(max=len(t) - 1))


def write(folder: Path, out: Path = FOLDER) -> dict[str, Any]:
    """Writes the task and the trajectory of an entry; the task."""
    task = task_of(folder)
    if "reason" not in task:
        plant = Plant.of(canonical(entry.definition(folder).scenario))
        options = options_of(*vars(entry.load(folder).run).values())
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the pages of the entries report them
            run = ij.simulate(plant.scenario, **options)
        t, x, u = motion_of(plant, run)
        task["published"] = external.numbers_of(task, t, x, u)
        rows = chosen_rows(t, np.concatenate([x, u], axis=1))
        table = np.concatenate([t[:, None], x, u], axis=1)[rows]
        heading = ",".join(external.columns_of(task))
        np.savetxt(
            out / f"{folder.name}.csv",
            table,
            f"%.{DIGITS}g",
            delimiter=",",
            header=heading,
            comments="",
        )
    (out / f"{folder.name}.json").write_text(text_of(task), encoding="utf-8")
    return task


def text_of(task: dict[str, Any]) -> str:
    """A task as JSON, with a line for each entry and for each function."""
    lines = [f" {json.dumps(key)}: {_compact(value)}" for key, value in task.items()]
    for i, key in enumerate(task):
        if key == "functions":
            parts = [f"  {json.dumps(k)}: {_compact(value)}" for k, value in task[key].items()]
            lines[i] = ' "functions": {\n' + ",\n".join(parts) + "\n }"
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _compact(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))


# ---------------------------------------------------------------------------- comparison


def faults_of(folder: Path) -> list[str]:
    """Why the task file of an entry is not that of its scenario; empty if it is."""
    path = FOLDER / f"{folder.name}.json"
    command = f"python benchmarks/field/tasks.py {folder.name}"
    if not path.exists():
        return [f"tasks/{path.name} does not exist; {command} writes it"]
    written, task = external.read_task.read(path), task_of(folder)
    found = []
    for key in sorted(set(task) | set(written) - {"published"}):
        if key != "functions" and not _agree(written.get(key), task.get(key)):
            found.append(f"tasks/{path.name}: {key!r} is not that of the entry; run {command}")
    if "functions" not in task or "functions" not in written:
        return found
    for name, difference in differences(written, folder).items():
        if not difference <= AGREEMENT:
            found.append(
                f"tasks/{path.name}: {name} differs from that of the entry by {difference:.2g} of"
                f" its largest value; run {command}"
            )
    return found


def _agree(one: Any, other: Any) -> bool:
    """Whether two values of a file are equal, numbers up to rounding."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_agree(one[key], other[key]) for key in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_agree, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-12, abs_tol=1e-15)
    return bool(one == other)


def differences(task: dict[str, Any], folder: Path) -> dict[str, float]:
    """Name of a function -> the largest difference of its results from those of the package at
    random states, as a share of the largest one; infinite where one of both is not finite.
    """
    made = entry.definition(folder)
    plant = Plant.of(canonical(made.scenario))
    motion = external.read_result(task, FOLDER / f"{folder.name}.csv")
    rng = np.random.default_rng(0)
    ranges = [(part.min(axis=0), part.max(axis=0)) for part in motion]
    t, x, u = (rng.uniform(low, high, (SAMPLES, *low.shape)) for low, high in ranges)
    w = rng.normal(size=(SAMPLES, (1 + plant.order) * plant.n))
    given = {"t": t, "x": x, "u": u, "w": w}
    functions = functions_of(plant, constraints_of(plant, made))

    @jax.jit
    @jax.vmap
    def results(given):
        return {
            name: _flat(function.value(*(given[kind] for kind in function.arguments)))
            for name, function in functions.items()
        }

    found = {}
    for name, expected in results(given).items():
        arguments = [given[kind] for kind in functions[name].arguments]
        value = external.read_task.evaluate(task, name, *arguments)
        found[name] = _difference(value, np.asarray(expected))
    return found


def _flat(value: Any) -> jax.Array:
    """The numbers of a result."""
    parts = [jnp.ravel(part) for part in jax.tree.leaves(value)]
    return jnp.concatenate(parts) if parts else jnp.zeros(0)


def _difference(one: np.ndarray, other: np.ndarray) -> float:
    """The largest difference of finite numbers as a share of the largest of their column."""
    same = (one == other) | (np.isnan(one) & np.isnan(other))
    if not one.size or same.all():
        return 0.0
    scale = np.abs(np.where(np.isfinite(other), other, 0.0)).max(axis=0)
    with np.errstate(all="ignore"):
        share = np.where(same, 0.0, np.abs(one - other) / scale)
    return float(np.where(np.isfinite(share), share, np.inf).max())


def main() -> int:
    """Writes the tasks of the named entries; the exit code is the number of those that failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="entries; all if none is given")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    failed = 0
    for folder in [entry.ENTRIES / name for name in args.names] or entry.folders():
        try:
            task = write(folder)
            size = sum(len(one["program"]) for one in task.get("functions", {}).values())
            words = task.get("reason") or f"{size} operations"
        except Exception as error:  # one entry must not stop the others
            failed += 1
            words = f"{type(error).__name__}: {error}"
        print(f"{folder.name}: {words}", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
