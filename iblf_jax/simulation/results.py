"""The result of a run: `Rollout`, and the named `Metrics` in it.

Both are pytrees, so `jax.vmap(ij.simulate...)` returns a Rollout of many runs, with the time axis
after the run axis; an index selects a run.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.presentation import Content, Result, present
from iblf_jax.core.pytree import Pytree
from iblf_jax.core.status import Status, describe
from iblf_jax.simulation.error_estimate import RELATIVE
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import Signals
from iblf_jax.simulation.units import status_words
from iblf_jax.world import plants

NUMBERED = tuple(f"violation_{what}" for what in ("joint", "region", "level", "component"))
"""Ends of the names of metrics that are a number of something, -1 for none."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Metrics(Mapping):
    """Named results of the folds: `metrics.rmse` or `metrics["rmse"]`; `list(metrics)` names them,
    `units` has their units.  The text has "none" for what did not happen or is not there: a time of
    a violation, of settling, or a margin to no bound (infinite), and the joint of no violation
    (-1).
    """

    values_by_name: dict[str, jax.Array]
    unit_pairs: tuple[tuple[str, str], ...] = dataclasses.field(metadata={"static": True})

    @property
    def units(self) -> dict[str, str]:
        """Name -> SI unit."""
        return dict(self.unit_pairs)

    def __getitem__(self, name: str) -> jax.Array:
        try:
            return self.values_by_name[name]
        except KeyError:
            raise KeyError(
                f"no metric {name!r}; there are {', '.join(self.values_by_name)}"
            ) from None

    def __getattr__(self, name: str) -> jax.Array:
        if name.startswith("_") or name in ("values_by_name", "unit_pairs"):
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(error.args[0]) from None

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.values_by_name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.values_by_name)

    def __len__(self) -> int:
        return len(self.values_by_name)

    def __repr__(self) -> str:
        rows = []
        order = [*self.units, *self.values_by_name]  # as the metrics were given, then further ones
        for name in dict.fromkeys(name for name in order if name in self.values_by_name):
            value = self.values_by_name[name]
            shown, unit = str(value), self.units.get(name, "")
            if checks.is_concrete(value):
                shown = np.array2string(np.asarray(value), precision=4, threshold=8)
                shown = " ".join(shown.split("\n ")).replace("inf", "none")
                if name.endswith(NUMBERED):
                    shown = shown.replace("-1", "none")
            if shown == "none":
                unit = ""
            rows.append(f"  {name:22s} {shown} {unit}".rstrip())
        return "Metrics(\n" + "\n".join(rows) + "\n)"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Rollout(Result, Signals):
    """One run of a scenario, or many: every array below has a leading run axis then.

    Its signals, `run.t`, `run.q`, `run.tau` ..., are those of `simulation.signals`, (T,) or (T, n)
    for T recorded samples and n joints; signals that the scenario does not have (bounds of the
    velocities) are `()`.  Every `record_every`-th step from t = 0 is recorded; metrics and status
    cover every step.
    """

    scenario: Scenario
    """The scenario of the run."""
    controller_state: Pytree
    """State of the law, time axis first; `()` if it has none."""
    observer_state: Pytree
    """State of the observer, time axis first; `()` if it has none."""
    metrics: Metrics
    """Results of the folds; and `numerical_error`, (n,) [rad], and `relative_numerical_error`, ()
    [1]: the estimated error of the positions that the time step causes, absolute and relative to
    the width of the tube (`error_estimate`); NaN under process noise, for which there is no
    estimate."""
    status: jax.Array
    """Bit flags of `Status`, () int32; 0 is ok."""
    fastest_mode: jax.Array
    """Rate of the fastest measured mode of the closed loop, () [1/s]; dt times this decides whether
    the step was too large."""
    dt: jax.Array
    """Time step, () [s]."""
    method: str = dataclasses.field(metadata={"static": True})
    """The integrator."""
    steps: int | None = dataclasses.field(default=None, metadata={"static": True})
    """Number of steps, recorded or not; None if it is unknown whether there were steps after the
    last sample."""
    actuator_state: Pytree = ()
    """State of the actuator, time axis first; `()` if it has none."""
    measured: Any = ()
    """What the law received at the last sample, `measured.q` [rad] and `measured.dq` [rad/s],
    (T, n); `()` where the law is not sampled.  Samples are the rows at whole multiples of the
    period; the rows between them repeat the last one."""

    @property
    def ok(self) -> bool:
        """Whether no flag is set (for one run), including the flags that are no failure; a run has
        failed if it has a flag of `status.FAILED`.
        """
        return int(self.status) == int(Status.OK)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.x.shape[-1]

    @property
    def is_batch(self) -> bool:
        """Whether this holds many runs."""
        return np.ndim(self.status) > 0

    def __bool__(self) -> bool:
        if not self.is_batch:
            raise TypeError("a run has no truth value; run.ok is whether no flag is set")
        return len(self) > 0

    def __len__(self) -> int:
        if not self.is_batch:
            raise TypeError("this Rollout is one run; use run.t.size for its samples")
        return self.status.shape[0]

    def __getitem__(self, index) -> Rollout:
        """The run (or runs) with this index."""
        if not self.is_batch:
            raise TypeError(
                "this Rollout is one run and cannot be indexed; index its arrays, run.q[0]"
            )
        return jax.tree.map(lambda x: x[index], self)

    def _content(self) -> Content:
        if not checks.is_concrete(self):
            return ["Rollout(being traced)"]
        components = plants.counted_components(self.scenario.plant, self.n)
        shape = (
            f"{self.x.shape[-3]} samples, {components}, dt = {float(np.ravel(self.dt)[0]):g} s,"
            f" {self.method}"
        )
        if self.is_batch:
            bad = int(np.sum(np.asarray(self.status) != 0))
            return [f"Rollout({len(self)} runs, {shape}; {bad} with a flag)"]
        accuracy = ""
        if RELATIVE in self.metrics and not np.isnan(self.metrics[RELATIVE]):
            accuracy = f"; accurate to {float(self.metrics[RELATIVE]):.1g} of the tube"
        status = describe(int(self.status), status_words(self.scenario))
        return [f"Rollout({shape}; status: {status}{accuracy})"]

    def to_xarray(self):
        """An `xarray.Dataset` with named dimensions, units, and the scenario's parameters in its
        attributes.
        """
        return present("rollout dataset", self)

    def plot(self, **options):
        """Overview figure: tube, errors, torque, estimate, phase portrait.  Options as
        `plotting.overview`.
        """
        return present("rollout figure", self, **options)
