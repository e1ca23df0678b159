"""The task of an entry, and the laws of the package at its scales.

The laws of robots are those of `benchmarks/laws.py`.  Their gains follow from the rate of the law
of the entry, and their boxes and limits from its run; `equal_budget.py` tunes them.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import entry
import laws
import numpy as np

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers
from iblf_jax.control.controllers import law_by_name
from iblf_jax.core.pytree import layers, unwrapped
from iblf_jax.simulation.metrics import AboveGravity, optional_folds, standard
from iblf_jax.world import plants

RECORDS = 4000
"""Recorded samples of a run, about."""
UNCERTAIN = ("mass", "payload", "inertia")
"""Beginnings of the names of uncertain parameters, where an entry does not name them."""
OF_ROBOTS = "laws of robots"
BARRIERS = {
    "Integral": barriers.Integral(),
    "Log": barriers.Log(),
    "Tan": barriers.Tan(),
    "State": barriers.StateBarrier(),
    "PrescribedPerformance": barriers.PrescribedPerformance(),
    "TransformedError": barriers.TransformedError(),
    "no bounds": barriers.Quadratic(),
}
"""Name in the table -> barrier of every level that has bounds."""


class Task(NamedTuple):
    """The task of an entry, and the scales of its published run."""

    scenario: ij.Scenario
    duration: float
    dt: float
    rate: float
    """Gain of the first level of the law of the entry, or 2 [1/s]."""
    half_width: np.ndarray
    """Half the least distance of the bounds over the published run, (n,)."""
    levels: np.ndarray
    """Largest absolute value of each level in the published run, (r, n)."""
    center: np.ndarray
    """Middle of the range of the first level in the published run, (n,)."""
    inputs: np.ndarray
    """Largest input of the published run, (n,)."""

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of `ij.simulate`."""
        return options_of(self.duration, self.dt)


def options_of(duration: float, dt: float) -> dict[str, Any]:
    """Arguments of `ij.simulate`, for about `RECORDS` recorded samples."""
    steps = round(duration / dt)
    every = max(1, steps // RECORDS)
    while steps % every:
        every -= 1
    return {"duration": duration, "dt": dt, "record_every": every}


def task_of(folder: Path, duration: float) -> tuple[Task, entry.Reproduction]:
    """The task of an entry."""
    made = entry.execute(folder)
    dt = entry.load(folder).run.dt
    published = with_standard_metrics(made.scenario, options_of(duration, dt))
    x = np.abs(np.asarray(published.x))
    positions = np.asarray(published.q)
    width = np.asarray(published.upper - published.lower)
    task = Task(
        scenario=made.scenario,
        duration=duration,
        dt=dt,
        rate=rate_of(made.scenario.controller),
        half_width=0.5 * width.min(axis=0),
        levels=np.maximum(x.max(axis=0), 1e-9),
        center=0.5 * (positions.max(axis=0) + positions.min(axis=0)),
        inputs=np.maximum(np.abs(np.asarray(published.tau)).max(axis=0), 1e-9),
    )
    return task, made


def rate_of(law: Any) -> float:
    """The gain of a law's first level [1/s]."""
    inner = unwrapped(law)
    for name in ("k1", "k", "a"):
        if hasattr(inner, name):
            return float(np.ravel(getattr(inner, name))[0])
    if hasattr(inner, "Kp") and isinstance(inner, controllers.ComputedTorque):
        return float(np.sqrt(np.ravel(inner.Kp)[0]))
    return 2.0


def with_standard_metrics(scenario: ij.Scenario, options: dict[str, Any]) -> ij.Rollout:
    """A run with the metrics of `ij.compare`, so that both share one program."""
    folds = (*standard(), *optional_folds(scenario), AboveGravity())
    return ij.simulate(scenario, metrics=folds, **options)


def uncertain_of(made: entry.Reproduction) -> tuple[str, ...]:
    """The uncertain parameters of an entry, without those that are zero."""
    known = {parameter.path: parameter.value for parameter in ij.parameters(made.scenario)}
    paths = made.uncertain
    if paths is None:
        paths = tuple(path for path in known if is_uncertain(path))
    return tuple(path for path in paths if np.any(np.asarray(known[path]) != 0.0))


def is_uncertain(path: str) -> bool:
    """Whether a path is that of a mass, a payload or an inertia of the plant."""
    return path.startswith("plant.") and path.rsplit(".", 1)[-1].startswith(UNCERTAIN)


def scaled_parameters(
    scenario: ij.Scenario, uncertain: tuple[str, ...], share: float
) -> dict[str, Any]:
    """Path -> value times a factor; of the plant only, so that the model remains."""
    known = {parameter.path: parameter.value for parameter in ij.parameters(scenario)}
    return {path: share * np.asarray(known[path]) for path in uncertain}


# ---------------------------------------------------------------------------- laws


def laws_of(task: Task, uncertain: tuple[str, ...]) -> dict[str, laws.Choice | str]:
    """Name -> law and the further parts of the scenario that it needs, or why it does not apply.

    The list for robots is that of `benchmarks/laws.py`, with gains and boxes at the scales of the
    task.  Plants of other families have `BarrierBackstepping` with each barrier, with exact
    derivatives and with filters.
    """
    plant = task.scenario.plant
    robot = plant
    chosen: dict[str, laws.Choice | str] = {}
    if plants.is_chain(plant):
        chosen = level_laws(task)
        robot = plants.robot_of(plant)
    if robot is None:
        return chosen | {OF_ROBOTS: "the plant is no robot"}
    for name, choice in laws.CHOICES.items():
        if name in chosen:
            continue
        try:
            chosen[name] = robot_law(name, choice, task, robot, uncertain)
        except ValueError as error:
            chosen[name] = first_sentence(error)
    return chosen


def level_laws(task: Task) -> dict[str, laws.Choice | str]:
    """`BarrierBackstepping` with each barrier on every level that has bounds."""
    found: dict[str, laws.Choice | str] = {}
    order = plants.order_of(task.scenario.plant)
    own = unwrapped(task.scenario.controller)
    gains: dict[str, Any] = {"k": geometric_gains(task.rate, order)}
    if isinstance(own, controllers.BarrierBackstepping):
        gains = {"k": own.k, "c": own.c, "weights": own.weights}
    filters = 0.1 / np.asarray(gains["k"])[: order - 1]
    for name, barrier in BARRIERS.items():
        chosen = tuple(barrier if x else barriers.Quadratic() for x in task.scenario.bounds)
        for words, filter_times in (("", None), (", filters", filters)):
            title = f"BarrierBackstepping({name}){words}"
            try:
                law = controllers.BarrierBackstepping(barriers=chosen, filter=filter_times, **gains)
                found[title] = laws.Choice(law)
            except ValueError as error:
                found[title] = first_sentence(error)
    return found


def geometric_gains(rate: float, order: int) -> tuple[float, ...]:
    """Gains from the rate of the first level to ten times it [1/s]."""
    return tuple(rate * 10.0 ** (i / (order - 1)) for i in range(order))


def robot_law(
    name: str, choice: laws.Choice, task: Task, robot: Any, uncertain: tuple[str, ...]
) -> laws.Choice | str:
    """A law of `benchmarks/laws.py` at the scales of a task."""
    law = choice.law
    if isinstance(law, str):
        law = law_by_name(law, variant="corrected")
    parts = dict(choice.parts)
    if "bounds" in parts:
        first, second, *others = task.scenario.bounds
        parts["bounds"] = (first, second or box(3.0 * task.levels[1]), *others)
    q = task.scenario.initial.q
    inertia = np.diag(np.asarray(robot.mass_matrix(np.broadcast_to(q, (robot.n,)))))
    if any(isinstance(part, controllers.AdaptiveParameters) for part in layers(law)):
        if not uncertain:
            return "no parameter of the plant is uncertain"
        if plants.is_chain(task.scenario.plant):
            return "the parameters of the robot inside a plant are not paths of its own model"
    scaled = scaled_law(law, task, inertia, uncertain)
    if isinstance(task.scenario.plant, plants.ElectricDrive):
        scaled = controllers.WithDrive(scaled, task.scenario.plant)
    return laws.Choice(scaled, parts)


def box(size: np.ndarray) -> ij.Bounds:
    """Constant bounds -size and size."""
    return ij.Bounds(lower=bounds.Constant(-size), upper=bounds.Constant(size))


def scaled_law(law: Any, task: Task, inertia: np.ndarray, uncertain: tuple[str, ...]) -> Any:
    """A law, and those that it wraps, with the numbers of `numbers_of`."""
    values = numbers_of(law, task, inertia, uncertain)
    wrapped = getattr(type(law), "wraps", None)
    if wrapped:
        values[wrapped] = scaled_law(getattr(law, wrapped), task, inertia, uncertain)
    return dataclasses.replace(law, **values)


def numbers_of(
    law: Any, task: Task, inertia: np.ndarray, uncertain: tuple[str, ...]
) -> dict[str, Any]:
    """Gains and boxes of a law of robots at the scales of a task, field by field.

    Rates are those of the law of the entry, and ten times as fast for the second level.  Torques
    per speed are rates times the diagonal of the mass matrix at the start.  A barrier has the
    weight with which its torque near e1 = 0 is K2 k1 e1.
    """
    rate, length, speed = task.rate, task.half_width, task.levels[1]
    damping = 10.0 * rate * inertia
    surface = 3.0 * (speed + rate * length)
    levels: dict[str, Any] = {"k1": rate, "K2": damping}
    if hasattr(law, "barrier") and hasattr(law, "weight"):
        has_unit = barriers_unit(law.barrier) != "1"
        levels["weight"] = damping * rate * (1.0 if has_unit else length**2)
    numbers = {
        controllers.Backstepping: levels,
        controllers.DynamicSurface: levels | {"filter": 0.01 / rate},
        controllers.AdaptiveRBF: levels
        | {
            "middle": task.center,
            "span_q": length,
            "span_dq": speed,
            "span_ddq": 3.0 * rate * speed,
        },
        controllers.BarrierBackstepping: {"k": geometric_gains(rate, 2)},
        controllers.SurfaceBarrier: {
            "a": rate,
            "K": damping * surface**2,
            "surface": box(surface),
        },
        controllers.TerminalSlidingMode: {
            "beta": rate,
            "K": 10.0 * rate * speed,
            "layer": 0.1 * length,
        },
        controllers.ComputedTorque: {"Kp": 10.0 * rate**2, "Kd": 11.0 * rate},
        controllers.PDGravity: {"Kp": damping * rate, "Kd": 1.1 * damping},
        controllers.SafetyFilter: {"a1": 5.0 * rate, "a2": 5.0 * rate},
        controllers.Saturated: {"limit": 1.2 * task.inputs, "auxiliary": 5.0 * rate},
        controllers.ReferenceGovernor: {},  # it has the numbers of the law that it wraps
    }
    if isinstance(law, controllers.AdaptiveParameters):
        return adaptation(task, uncertain)
    return dict(numbers[type(law)])


def barriers_unit(barrier: Any) -> str:
    """The unit of a barrier's value."""
    return getattr(barrier, "value_unit", "1")


def adaptation(task: Task, uncertain: tuple[str, ...]) -> dict[str, Any]:
    """Rates and boxes of the uncertain parameters that are not zero."""
    names, values = [], []
    known = {parameter.path: parameter.value for parameter in ij.parameters(task.scenario)}
    for path in uncertain:
        name = path.removeprefix("plant.")
        for i, value in enumerate(np.ravel(known[path])):
            if value != 0.0:
                names.append(f"{name}[{i}]" if np.ndim(known[path]) else name)
                values.append(float(value))
    theta = np.array(values)
    energy = float(np.max(task.inputs * task.half_width))
    Gamma = theta**2 / energy
    return {
        "parameters": tuple(names),
        "Gamma": Gamma,
        "lower": 0.5 * theta,
        "upper": 2.0 * theta,
        "sigma": 0.01 * task.rate / Gamma,
        "band": None,
    }


def first_sentence(error: Exception) -> str:
    """The first sentence of a message, on one line."""
    text = " ".join(str(error).split())
    return text.split(". ")[0].rstrip(".")
