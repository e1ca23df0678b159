"""What a figure draws: the runs that were given, on the host, checked, cut where they broke and
thinned for drawing.

A run whose state ran away was frozen there by the simulator; it is drawn up to that sample.  Lines
are thinned so that no peak is lost: every piece of the time axis keeps its first, lowest and
  highest sample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from iblf_jax.control.actuators import Ideal as IdealActuator
from iblf_jax.control.sensors import Ideal as IdealSensor
from iblf_jax.core import checks
from iblf_jax.core.status import FAILED, Status, describe
from iblf_jax.simulation.results import Rollout
from iblf_jax.world.robots import joint_names

POINTS = 2400
"""About as many points as a line of a figure can show."""

DERIVED = {
    "error_lower": lambda run: np.asarray(run.lower) - np.asarray(run.q_d),
    "error_upper": lambda run: np.asarray(run.upper) - np.asarray(run.q_d),
    "wall_lower": lambda run: -np.ones(run.q.shape),
    "wall_upper": lambda run: np.ones(run.q.shape),
    "estimate_error": (
        lambda run: np.asarray(run.disturbance) - np.asarray(run.disturbance_estimate)
    ),
    "measured_q": lambda run: run.measured.q,
    "measured_dq": lambda run: run.measured.dq,
    "region_wall": lambda run: np.zeros(np.shape(run.region_margin)),
}
"""Signals that follow from those of a Rollout: the bounds -k_l and k_u of e1, those of xi, f -
f_hat, what was measured, walls."""

HELD = {"tau", "alpha", "disturbance_estimate", "measured_q", "measured_dq"}
"""Signals of a sampled law that stay as they are from sample to sample."""

GIVEN = {
    "t",
    "q_d",
    "dq_d",
    "lower",
    "upper",
    "error_lower",
    "error_upper",
    "wall_lower",
    "wall_upper",
    "dq_lower",
    "dq_upper",
    "region_wall",
}
"""Signals that do not depend on the state, and are drawn to the end whatever became of it."""

SAME = 0.03
"""Signals that differ by less than this part of their range are drawn once for all runs."""


@dataclass(frozen=True, eq=False)
class Curve:
    """One run as figures see it: `curve["q"]` is an array (T, n), shorter than `curve.t` if the run
    was frozen before its end.

    A signal that the run's scenario does not have is no number.
    """

    name: str
    """What the caller called it; empty for a run that came alone."""
    run: Rollout
    samples: int
    """How many samples are worth drawing."""

    def __getitem__(self, field: str) -> np.ndarray:
        values = DERIVED[field](self.run) if field in DERIVED else getattr(self.run, field)
        values = (
            np.full(self.run.q.shape, np.nan) if isinstance(values, tuple) else np.asarray(values)
        )
        return values if field in GIVEN else values[: self.samples]

    @property
    def t(self) -> np.ndarray:
        """Time, (T,) [s]."""
        return self["t"]

    def at(self, field: str, t: np.ndarray) -> np.ndarray:
        """A signal at other times t [s], linearly between its samples and constant after its end,
        (len(t), n).
        """
        values = self[field]
        return np.stack(
            [np.interp(t, self.t[: len(values)], column) for column in values.T], axis=-1
        )

    def is_held(self, field: str) -> bool:
        """Whether a signal goes in steps: the law is sampled, and no drive makes something else of
        its torque.
        """
        scenario = self.run.scenario
        return (
            scenario.sampling is not None
            and field in HELD
            and (field != "tau" or isinstance(scenario.actuator, IdealActuator))
        )

    @property
    def is_measured(self) -> bool:
        """Whether the law was told something else than what was."""
        return not isinstance(self.run.scenario.sensor, IdealSensor)

    @property
    def has_speed_limits(self) -> bool:
        """Whether its velocities have bounds."""
        return not isinstance(self.run.dq_lower, tuple)

    @property
    def has_regions(self) -> bool:
        """Whether points of its robot must stay in regions."""
        return not isinstance(self.run.region_margin, tuple)

    @property
    def ok(self) -> bool:
        """Whether the run has no flag."""
        return self.run.ok

    @property
    def failed(self) -> bool:
        """Whether the run did not do its job."""
        return bool(int(self.run.status) & FAILED)

    @property
    def status(self) -> str:
        """The run's flags in words."""
        return describe(int(self.run.status))

    def called(self, joint: int) -> str:
        """What a joint is called in a figure."""
        return called(getattr(self.run.scenario, "plant", None), self.run.n)[joint]

    def break_index(self) -> int | None:
        """The first sample at which the run was outside its bounds or regions, or its last one if
        it ran away; None if neither.
        """
        lower, upper = self["lower"][: self.samples], self["upper"][: self.samples]
        inside = ((lower < self["q"]) & (self["q"] < upper)).all(axis=1)
        if self.has_regions:
            inside &= (self["region_margin"] > 0).all(axis=1)
        outside = np.flatnonzero(~inside)
        if outside.size:
            return int(outside[0])
        return self.samples - 1 if int(self.run.status) & Status.NOT_FINITE else None


def called(robot: Any, n: int) -> list[str]:
    """What the joints of a robot are called in a figure: as in the robot's file, if it has
    names.
    """
    return [plain(name) for name in joint_names(robot, n)]


def plain(name: str) -> str:
    """A name from a file as it is: matplotlib takes $ for mathematics, and leaves what begins with
    _ out of legends.
    """
    return (" " if name.startswith("_") else "") + name.replace("$", r"\$")


def _sound_samples(run: Rollout) -> int:
    """How many samples there are until the state was frozen: all, unless the run ran away."""
    q, dq = np.asarray(run.q), np.asarray(run.dq)
    if not int(run.status) & Status.NOT_FINITE or len(q) < 2:
        return len(q)
    moved = np.any((np.diff(q, axis=0) != 0) | (np.diff(dq, axis=0) != 0), axis=1)
    finite = np.isfinite(q).all(axis=1)
    last = np.flatnonzero(moved & finite[1:])
    return int(last[-1]) + 2 if last.size else len(q)


def _checked(name: str, run: Any) -> Curve:
    called = f"runs[{name!r}]" if name else "run"
    if not isinstance(run, Rollout):
        raise checks.fail(
            called,
            type(run).__name__,
            "a Rollout",
            "Draw what ij.simulate returns, or a dict of such runs.",
        )
    if not checks.is_concrete(run):
        raise checks.fail(
            called,
            "a run that is being traced",
            "one with numbers",
            "Draw outside of jit, vmap and grad.",
        )
    if run.is_batch:
        raise checks.fail(called, f"a batch of {len(run)} runs", "one run", "Select a run: run[0].")
    return Curve(name, run, _sound_samples(run))


def curves_of(runs: Rollout | Mapping[str, Rollout]) -> list[Curve]:
    """The runs to draw, in the order given.

    Args:
      runs: one run, or a dict of such runs by name; they may differ in length and in what they
        recorded.

    Raises:
      ValueError: nothing to draw, a batch, something that is no Rollout, or runs of robots with
        different numbers of joints.
    """
    if not isinstance(runs, Mapping):
        return [_checked("", runs)]
    if not runs:
        raise checks.fail("runs", runs, "at least one run")
    curves = [_checked(str(name), run) for name, run in runs.items()]
    joints = {curve.name: curve.run.n for curve in curves}
    if len(set(joints.values())) > 1:
        raise checks.fail(
            "runs", joints, "runs with one number of joints", "Draw the robots one by one."
        )
    return curves


def check_joint(curves: Sequence[Curve], joint: Any, field: str = "joint") -> int:
    """The index of a joint, given by its index or its name, if the robot has it; ValueError if
    not.
    """
    n = curves[0].run.n
    names = joint_names(getattr(curves[0].run.scenario, "plant", None), n)
    if isinstance(joint, str) and joint in names:
        return names.index(joint)
    if isinstance(joint, bool) or not isinstance(joint, int | np.integer) or not 0 <= joint < n:
        raise checks.fail(field, joint, f"a joint, 0 to {n - 1}")
    return int(joint)


def distinct(curves: Sequence[Curve], fields: Sequence[str], joints: Sequence[int]) -> list[Curve]:
    """The curves that can be told apart in these fields on the time they share, longest first; one,
    if all follow one reference.
    """
    kept: list[Curve] = []
    for curve in sorted(curves, key=lambda c: -float(c.t[-1])):
        if all(_differ(curve, other, fields, joints) for other in kept):
            kept.append(curve)
    return kept


def _differ(a: Curve, b: Curve, fields: Sequence[str], joints: Sequence[int]) -> bool:
    t = np.linspace(0.0, min(a.t[-1], b.t[-1]), 400)
    for field in fields:
        for joint in joints:
            one, two = (c.at(field, t)[:, joint] for c in (a, b))
            if not np.allclose(one, two, rtol=0.0, atol=SAME * np.ptp(one) + 1e-9, equal_nan=True):
                return True
    return False


def thinned(t: np.ndarray, y: np.ndarray, points: int = POINTS) -> tuple[np.ndarray, np.ndarray]:
    """At most about `points` of the samples (t, y), with every peak among them.

    Args:
      t: time, (T,) [s].
      y: signal, (T,).
      points: how many to keep.
    """
    if len(t) <= points:
        return t, y
    width = int(np.ceil(3 * len(t) / points))
    whole = len(t) // width * width
    pieces = np.nan_to_num(y[:whole], posinf=np.inf, neginf=-np.inf).reshape(-1, width)
    starts = np.arange(0, whole, width)
    rest = np.append(np.arange(whole, len(t)), len(t) - 1)
    picked = np.concatenate(
        [starts, starts + pieces.argmin(axis=1), starts + pieces.argmax(axis=1), rest]
    )
    index = np.unique(picked)
    return t[index], y[index]
