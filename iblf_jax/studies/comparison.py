"""What `compare` gives back: runs by law, at their gains and at equal effort, and the table of
both.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.control.barriers import Integral, Log
from iblf_jax.core.presentation import Content, Result, present
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import FAILED, describe
from iblf_jax.core.tables import Table, number
from iblf_jax.core.units import INPUT, POSITION, VELOCITY
from iblf_jax.simulation.levels import stated_steady_input
from iblf_jax.simulation.metrics import Settling
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.units import status_words, unit_text
from iblf_jax.studies.equal_effort import NO_EFFORT, EffortSearch
from iblf_jax.world import plants

TITLES = {"gains": "Gains as given", "effort": "Equal effort"}

FACTOR_TWO = (
    "Equal gains favour the integral form: V_integral = 2 V_log (p = 1) identically, so its barrier"
    " term is twice the logarithmic one's at the same k1 and K2. Compare at equal effort."
)
MARGINS_OF_START = (
    "The margins to the bounds and 1-max|xi| are those of the start (at t = 0) in every run: they"
    " do not compare the laws."
)
OWN_GAINS = "Laws whose gains differ are comparable at equal effort only."


ROUNDING = 4.0
"""Error of a distance of two positions in units of the last place of the larger one."""


class Row(NamedTuple):
    """The line of one law: values of its worst joint, but efforts and chatter of all joints."""

    law: str
    factor: float
    """What the law's gains were multiplied by."""
    settling_time: float
    """Until |e1| is below the tolerance of `Comparison.settling` for good [s]; NaN where the bounds
    are not farther than that, so that every run that keeps them has settled from the start."""
    rmse: float
    """[rad]."""
    margin: float
    """Smallest distance to a bound [rad]."""
    xi_margin: float
    """1 - max |xi| [1]."""
    velocity_margin: float
    """Smallest distance of a velocity to its bound [rad/s]; NaN where velocities have none."""
    region_margin: float
    """Smallest distance of a point to the boundary of its region [m]; NaN without regions."""
    peak_torque: float
    """[N m]."""
    torque_rms: float
    """sqrt(mean |tau|^2) [N m]."""
    effort_above_gravity: float
    """sqrt(mean |tau - G0(q)|^2) [N m]; for a plant in strict-feedback form sqrt(mean |u - u_0|^2),
    u_0 its `steady_input`."""
    chatter: float
    """sum |tau_k+1 - tau_k| [N m]."""
    status: str


OPTIONAL = ("velocity_margin", "region_margin")
"""Columns of constraints that not every scenario has."""


def headings(scenario: Scenario) -> tuple[str, ...]:
    """The heading of each column of `Row`, with the units of the plant."""
    plant = scenario.loop.plant
    notation, speed = plant.notation, plants.level_names(plant)[1]
    first, second, of_input = (unit_text(scenario, unit) for unit in (POSITION, VELOCITY, INPUT))
    return (
        "law",
        "factor",
        "settling [s]",
        f"rmse [{first}]",
        f"margin [{first}]",
        "1-max|xi|",
        f"{speed} margin [{second}]",
        "region margin [m]",
        f"peak {notation.input_column} [{of_input}]",
        f"rms {notation.input_column} [{of_input}]",
        f"{notation.effort_column} [{of_input}]",
        f"chatter [{of_input}]",
        "status",
    )


def _verdict(run: Rollout) -> str:
    status = int(run.status)
    text = describe(status, status_words(run.scenario))
    return f"FAILED: {text}" if status & FAILED else text


def _is_settled_by_bounds(run: Rollout, settling: Settling) -> bool:
    """Whether the bounds of every component are no farther from the reference than the error at
    which it counts as settled, so that its settling time says nothing about the law.
    """
    q_d, lower, upper = (np.asarray(x) for x in (run.q_d, run.lower, run.upper))
    widest = np.maximum(upper - q_d, q_d - lower)
    # The difference of two rounded positions may exceed a tolerance equal to the bounds' distance.
    size = np.maximum(np.abs(q_d), np.maximum(np.abs(lower), np.abs(upper)))
    rounding = ROUNDING * np.finfo(widest.dtype).eps * size
    return bool(np.all(widest <= np.asarray(settling.tolerance) + rounding))


def row_of(law: str, factor: float, run: Rollout, settling: Settling) -> Row:
    """The line of one run, whose settling time is that of `settling`."""
    m = run.metrics

    def worst(name: str, reduce: Any = np.max) -> float:
        if name in OPTIONAL and name not in m:
            return math.nan
        return float(reduce(np.asarray(m[name])))

    return Row(
        law,
        factor,
        math.nan if _is_settled_by_bounds(run, settling) else worst("settling_time"),
        worst("rmse"),
        worst("margin", np.min),
        worst("xi_margin", np.min),
        worst("velocity_margin", np.min),
        worst("region_margin", np.min),
        worst("peak_torque"),
        float(np.sqrt(np.sum(np.asarray(m["torque_rms"]) ** 2))),
        float(m["effort_above_gravity"]),
        worst("torque_variation", np.sum),
        _verdict(run),
    )


def _is_closest_at_start(run: Rollout) -> bool:
    """Whether the smallest margins of a run, in position and in xi, are those of its start."""
    q, lower, upper, xi = (np.asarray(x[0]) for x in (run.q, run.lower, run.upper, run.xi))
    margin = np.min(np.minimum(q - lower, upper - q))
    found = np.min(run.metrics.margin), np.min(run.metrics.xi_margin)
    return np.allclose(found, (margin, 1.0 - np.max(np.abs(xi))), rtol=1e-6, atol=0.0)


class RunsAtEqualEffort(dict[str, Rollout]):
    """Law -> run at the first law's effort.  A law without a factor is missing, and an index and
    figures say why.
    """

    def __init__(self, runs: Mapping[str, Rollout], reasons: Mapping[str, str]) -> None:
        super().__init__(runs)
        self.reasons = reasons

    def __missing__(self, law: object) -> Rollout:
        if law in self.reasons:
            raise KeyError(
                f"{law!r} has no run at equal effort, because no factor was found: "
                f"{self.reasons[str(law)]}. `rollouts` has its run at the gains given; give the law"
                " other gains, or compare at the effort of another law by making that the first one"
            )
        remedy = f"there are {', '.join(self)}" if self else "`compare` had equal_effort=False"
        raise KeyError(f"no run of {law!r} at equal effort; {remedy}")


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Comparison(Result):
    """Several laws on one scenario.  Prints as two tables, each with what is equal in it."""

    rollouts: dict[str, Rollout]
    """Law -> run at the gains it has."""
    equal_effort: dict[str, Rollout]
    """Law -> run at the first law's effort; without the laws for which there is no factor, of which
    an index and figures say why.  The `scenario` of the run has the law with the scaled gains."""
    factors: dict[str, float]
    """Law -> the factor of its gains at equal effort; NaN where none was found."""
    reasons: dict[str, str]
    """Law -> why no factor was found."""
    gains: dict[str, str]
    """Law -> its gains in words."""
    searches: dict[str, EffortSearch] = dataclasses.field(default_factory=dict)
    """Law -> the search for its factor: all trials, with those that failed; without the first
    law."""
    settling: Settling = dataclasses.field(default_factory=Settling)
    """The metric of the settling times, with their tolerance."""

    def __post_init__(self) -> None:
        runs = RunsAtEqualEffort(self.equal_effort, self.reasons)
        object.__setattr__(self, "equal_effort", runs)

    @property
    def nearest(self) -> dict[str, tuple[float, float]]:
        """Law without a factor -> factor and effort [N m] of the trial whose effort is nearest to
        the first law's.
        """
        return {
            name: found.nearest
            for name, found in self.searches.items()
            if name not in self.equal_effort
        }

    @property
    def table(self) -> dict[str, tuple[Row, ...]]:
        """The lines of both tables: "gains" and "effort"."""
        as_given = tuple(
            row_of(name, 1.0, run, self.settling) for name, run in self.rollouts.items()
        )
        effort = tuple(
            row_of(name, self.factors[name], run, self.settling)
            for name, run in self.equal_effort.items()
        )
        if not self.factors:
            return {"gains": as_given}
        return {"gains": as_given, "effort": effort}

    @property
    def failed(self) -> dict[str, str]:
        """Law -> what went wrong, for the runs at given gains that failed."""
        return {
            name: describe(int(run.status) & FAILED, status_words(run.scenario))
            for name, run in self.rollouts.items()
            if int(run.status) & FAILED
        }

    @property
    def notes(self) -> dict[str, list[str]]:
        """What each table holds equal, and what it does not, in words."""
        first = next(iter(self.rollouts))
        groups: dict[str, list[str]] = {}
        for name, gains in self.gains.items():
            groups.setdefault(gains, []).append(name)
        in_words = "; ".join(f"{gains} ({', '.join(names)})" for gains, names in groups.items())
        barriers = {
            type(unwrapped(run.scenario.controller).barrier) for run in self.rollouts.values()
        }
        notes = {"gains": [f"Held equal: the scenario. Gains: {in_words}."]}
        if len(groups) > 1:
            notes["gains"].append(OWN_GAINS)
        if {Integral, Log} <= barriers:
            notes["gains"].append(FACTOR_TWO)
        if any(_is_settled_by_bounds(run, self.settling) for run in self.rollouts.values()):
            notes["gains"].append(self._settling_in_words)
        notes["gains"] += [f"{name} FAILED: {why}." for name, why in self.failed.items()]
        if self.factors:
            if int(self.rollouts[first].status) & NO_EFFORT:
                equal = "Nothing could be held equal."
            else:
                metrics = self.rollouts[first].metrics
                effort = float(metrics.effort_above_gravity)
                unit = metrics.units["effort_above_gravity"]
                equal = (
                    f"Held equal: the RMS {self._input_in_words} = {effort:.4g} {unit}, that of"
                    f" {first}."
                )
            scaled = (
                "Each law's gains (k1 and K2, or its own) are scaled by one factor: of those found"
                " from 1/32 to 32 that do it, the one nearest to 1 (by |ln factor|)."
            )
            # Why a law has no factor or one that says little, in one line; `searches` has the rest.
            notes["effort"] = [f"{equal} {scaled}"]
            notes["effort"] += [f"{name}: no factor; {why}." for name, why in self.reasons.items()]
            notes["effort"] += [
                f"{name}: factor {self.factors[name]:.4g}; {found.remark()}."
                for name, found in self.searches.items()
                if name not in self.reasons and found.remark()
            ]
        for kind, runs in (("gains", self.rollouts), ("effort", self.equal_effort)):
            if kind in notes and runs and all(map(_is_closest_at_start, runs.values())):
                notes[kind].append(MARGINS_OF_START)
        return notes

    @property
    def scenario(self) -> Scenario:
        """The scenario of the first law."""
        return next(iter(self.rollouts.values())).scenario

    @property
    def _settling_in_words(self) -> str:
        """Why the table has no settling times."""
        size = f"{float(np.max(self.settling.tolerance)):g} {unit_text(self.scenario, POSITION)}"
        return (
            f"Settling is the time until |e1| < {size} for good. It is not shown, because the"
            " bounds are no farther from the reference than that: give a smaller tolerance,"
            " metrics=(ij.metrics.Settling(tolerance=...),)."
        )

    @property
    def _input_in_words(self) -> str:
        """The input that is held equal at equal effort, with its formula."""
        plant, q = self.scenario.loop.plant, self.scenario.initial.q
        if jax.eval_shape(stated_steady_input, self.scenario, q) is None:
            name = plants.input_name(plant)
            return f"{name}, sqrt(mean |u - u_0|^2) with u_0 = 0 (the plant has no steady_input),"
        return plant.notation.effort_formula

    def _content(self) -> Content:
        run = next(iter(self.rollouts.values()))
        noun = plants.component_noun(run.scenario.plant)
        headline = (
            f"Comparison of {len(self.rollouts)} laws, {float(run.t[-1]):g} s, dt ="
            f" {float(run.dt):g} s, {run.method}; worst {noun}"
        )
        notes = self.notes
        tables = []
        for kind, rows in self.table.items():
            # Without the columns of constraints that the scenario lacks.
            shown = [
                name not in OPTIONAL or any(math.isfinite(row._asdict()[name]) for row in rows)
                for name in Row._fields
            ]
            heading, *lines = (
                tuple(itertools.compress(line, shown))
                for line in [headings(self.scenario), *(map(_cell, row) for row in rows)]
            )
            left = (0, len(heading) - 1)
            tables.append(Table(heading, lines, TITLES[kind], notes[kind], left=left))
        return [headline, *tables]

    def to_pandas(self):
        """A `pandas.DataFrame` (pandas comes with xarray), one line a law and table, columns as
        `Row`.
        """
        import pandas as pd

        lines = [
            {"held": kind, **row._asdict()} for kind, rows in self.table.items() for row in rows
        ]
        frame = pd.DataFrame(lines).set_index(["held", "law"])
        return frame.drop(columns=[name for name in OPTIONAL if frame[name].isna().all()])

    def plot(self, joint: int | str = 0, **options):
        """Overlaid figure of all laws, at their gains and at equal effort.  Options as
        `plotting.comparison`.
        """
        return present("comparison figure", self, joint, **options)


def _cell(value: object) -> str:
    if isinstance(value, str):
        return value
    return "never" if value == math.inf else number(value)
