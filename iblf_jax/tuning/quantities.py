"""Objectives and requirements consist of quantities: smooth numbers of a run, each a fold over its
samples.

Two kinds suffice for most objectives, over a signal y(t), a vector:

    TimeIntegral   int |y|^2 dt = sum_k dt_k |y(t_k)|^2, with the weights of the samples
                   (`Sample.dt`: the trapezoidal rule)
    Peak           max_j p_j, where p_j is the largest y_i(t_k) of one entry i of the signal within
                   one window of time

The pieces p_j are smooth where their maximum is not: a requirement on a peak is one on each of its
pieces.  In a term of the objective the maximum is T log sum_j exp(p_j / T), which is smooth and
never below the maximum.

Both also provide the matrix of their second derivatives without the second derivatives of the
motion (Gauss-Newton), from the tangents y_u of their signal (`Outer`) or p_ju of their pieces:

    TimeIntegral   2 sum dt y_u . y_v
    Peak           (sum_j w_j p_ju p_jv - mean_u mean_v) / T,  w the weights of the smooth maximum

`MetricResult` is a result of any metric's fold.  A user's own quantity needs `init`, `update`,
`finish`; for second-order methods `hessian`, and `curvature` if the matrix is made of tangents
along the run; `iblf_jax.testing.check_objective` checks it.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.families import Part, attribute
from iblf_jax.core.joints import Selection, indices, selection
from iblf_jax.core.pytree import component, leaf, static
from iblf_jax.core.units import INPUT, POSITION, VELOCITY, PlantUnit
from iblf_jax.engine import Outer
from iblf_jax.simulation.metrics import Fold
from iblf_jax.simulation.signals import Sample

INITIAL_PEAK = 1e6
"""Minus the initial value of a peak, in units of its scale."""
EDGE_WIDTH = 0.1
"""Width of the soft edge of a tolerance, as a part of it."""


class Quantity(Part):
    """The contract of a quantity."""

    signal: str = "torque"
    """What it is computed from, one of `TUNED_SIGNALS`; a user's quantity is assumed to depend on
    the torque."""
    smoothing: jax.Array | None = None
    """Of a maximum, a leaf that `tune` decreases; None for a quantity that is smooth itself."""

    @attribute
    def needs(self) -> str | None:
        """The optional signal of a run that it reads."""
        return None

    @abc.abstractmethod
    def init(self, sample: Sample) -> Any:
        """The accumulator before the first sample."""

    @abc.abstractmethod
    def update(self, acc: Any, sample: Sample) -> Any:
        """The accumulator after one more sample."""

    @abc.abstractmethod
    def finish(self, acc: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
        """The smooth value and the exact one (the report's), () each, and the pieces of which the
        exact one is the largest, (m,).
        """

    def curvature(self, acc: Any, sample: Sample) -> Outer | None:
        """What one more sample adds to `products`; None for a quantity without them."""
        return None

    def hessian(
        self, products: jax.Array, pieces: jax.Array, slopes: jax.Array
    ) -> jax.Array | None:
        """The Gauss-Newton matrix, (D, D); None for a quantity without one.

        Args:
          products: sum of the products of the tangents that `curvature` gives, (D, D).
          pieces: of `finish`, (m,).
          slopes: their gradients, (D, m).
        """
        return None


def has_curvature(quantity: Quantity) -> bool:
    """Whether a quantity states `curvature`."""
    return type(quantity).curvature is not Quantity.curvature


def has_hessian(quantity: Quantity) -> bool:
    """Whether a quantity states `hessian`."""
    return type(quantity).hessian is not Quantity.hessian


DEFICITS = {"deficit": POSITION, "velocity_deficit": VELOCITY, "region_deficit": "m"}
"""Signals of which the largest is minus a margin -> unit; their sign counts, not their absolute
value."""
SIGNAL_OF_MARGIN = {
    "positions": "deficit",
    "velocities": "velocity_deficit",
    "regions": "region_deficit",
}
"""What may be violated -> the deficit that is minus its margin."""
OF_LIMIT = "of the limit"
"""Unit of a peak that is measured in limits, one for each joint."""
TUNED_SIGNALS = {
    "error": POSITION,
    "torque": INPUT,
    "torque_rate": PlantUnit("N m/s", "u/s"),
    "outside": "1",
} | DEFICITS
"""Signal -> unit."""
NEEDS = {"velocity_deficit": "dq_lower", "region_deficit": "region_margin"}
"""Signal -> the optional signal of the run that it is computed from."""


def _indices(joints: Selection, n: int, field: str) -> tuple[int, ...]:
    return indices(field, joints, tuple(f"joint {i}" for i in range(n)))


def chosen_of(values: jax.Array, joints: Selection, field: str) -> jax.Array:
    """The entries (k,) of the selected joints, from one number for each joint, (n,)."""
    if joints is None:
        return values
    return jnp.stack([values[i] for i in _indices(joints, values.shape[-1], field)])


def weights_of(weights: jax.Array, joints: Selection, n: int, field: str) -> jax.Array:
    """The weights of the selected joints, () or (k,), from one number, one for each joint, or one
    for each selected joint.

    Raises:
      ValueError: another number of weights.
    """
    shape = jnp.shape(weights)
    count = len(_indices(joints, n, field))
    if shape in ((), (count,)):
        return weights
    if shape == (n,):
        return chosen_of(weights, joints, field)
    expected = f"one number, or {count}, one for each of the joints that count"
    raise checks.fail(field, weights, expected, f"Its shape is {shape}.")


def _check_choice(owner: str, joints: Selection, weights: jax.Array | float) -> None:
    """Raises ValueError for a selection that is not normalised, or weights of more dimensions than
    one.
    """
    is_tuple = joints is None or isinstance(joints, tuple)
    if not is_tuple or selection(f"{owner}.joints", joints) != joints:
        raise checks.fail(f"{owner}.joints", joints, "a tuple of indices, names or truth values")
    if jnp.ndim(weights) > 1:
        raise checks.fail(f"{owner}.weights", weights, "one number, or one for each joint")


def signal_of(
    name: str,
    sample: Sample,
    last: jax.Array,
    tolerance: Any,
    joints: Selection = None,
) -> jax.Array:
    """A signal of the selected joints at one sample, (k,), (2 k,) or one number a region.

    | Name | Signal |
    |---|---|
    | error | e1 |
    | torque | tau |
    | torque_rate | (tau - last tau) / step, the mean over the last step, jumps included |
    | outside | sqrt(sigmoid((abs(e1) - tolerance) / (EDGE_WIDTH tolerance))); the integral of its
      square is the time outside the tolerance |
    | deficit | (lower - q, q - upper), the largest of which is minus the margin |
    | velocity_deficit | the same of the velocities |
    | region_deficit | minus the distances to the boundaries of the regions |
    """

    def of_joints(values: jax.Array) -> jax.Array:
        return chosen_of(values, joints, "joints")

    if name == "error":
        return of_joints(sample.e1)
    if name == "torque":
        return of_joints(sample.tau)
    if name == "torque_rate":
        change = of_joints(sample.tau - last)
        moved = sample.step > 0
        return jnp.where(moved, change / jnp.where(moved, sample.step, 1.0), 0.0)
    if name == "outside":
        e1 = of_joints(sample.e1)
        size = jnp.where(e1 >= 0, e1, -e1)
        return jax.nn.sigmoid((size - tolerance) / (EDGE_WIDTH * tolerance)) ** 0.5
    if name == "region_deficit":
        return -sample.region_margin
    if name == "velocity_deficit":
        below = of_joints(sample.dq_lower - sample.dq)
        above = of_joints(sample.dq - sample.dq_upper)
        return jnp.concatenate([below, above])
    return jnp.concatenate([of_joints(sample.lower - sample.q), of_joints(sample.q - sample.upper)])


def _last_torque(acc, sample: Sample) -> jax.Array:
    """The torque of the last instant; a second sample at a jump is not an instant of its own."""
    return jnp.where((sample.step > 0) | (sample.t <= 0), sample.tau, acc[1])


@component
class TimeIntegral(Quantity):
    """int |w y|^2 dt over the samples with t >= after.

    Args:
      signal: "error", "torque", "torque_rate" or "outside"; "error" if not given.
      weights: w, () or (n,), or one for each selected joint [1]; 1 if not given.
      after: count from this time on, () [s]; 0 if not given.
      tolerance: for "outside", on |e1|, () [rad], > 0; none if not given.
      joints: which ones count, a tuple of indices, names or truth values (`core.joints`); None,
        all, if not given.
    """

    signal: str = static(default="error")
    weights: jax.Array = leaf("1", shape="any", default=1.0)
    after: jax.Array = leaf("s", shape="scalar", default=0.0)
    tolerance: jax.Array | None = leaf(POSITION, sign="positive", shape="scalar", default=None)
    joints: tuple | None = static(default=None)
    units: ClassVar[dict[str, str]] = {
        "error": PlantUnit("rad^2 s", "x1^2 s"),
        "torque": PlantUnit("N^2 m^2 s", "u^2 s"),
        "torque_rate": PlantUnit("N^2 m^2/s", "u^2/s"),
        "outside": "s",
    }

    def check(self) -> None:
        """Raises ValueError for an unknown signal, or a selection that is none."""
        checks.one_of("TimeIntegral.signal", self.signal, tuple(self.units))
        _check_choice("TimeIntegral", self.joints, self.weights)

    def _at(self, acc, sample: Sample) -> jax.Array:
        weights = weights_of(self.weights, self.joints, sample.q.size, "TimeIntegral.weights")
        y = weights * signal_of(self.signal, sample, acc[1], self.tolerance, self.joints)
        return jnp.where(sample.t >= self.after * (1 - 1e-6), y, 0.0)

    def _weight(self, acc, sample: Sample) -> jax.Array:
        """Weight of a sample, () [s]."""
        if self.signal == "torque_rate":
            return sample.step  # the difference quotient holds for all of the step before
        # The weight contains half of the time since the last sample.  Where counting begins within
        # that time, only the rest of it counts.
        before = acc[2]
        left = jnp.maximum(sample.t - self.after, 0.0)
        return jnp.where(
            before < self.after, sample.dt - 0.5 * (sample.t - before) + left, sample.dt
        )

    def init(self, sample: Sample):
        """Zero; the predecessor of the first torque is the torque itself."""
        return jnp.zeros_like(sample.t), sample.tau, sample.t

    def update(self, acc, sample: Sample):
        """Adds one sample."""
        total = acc[0] + self._weight(acc, sample) * jnp.sum(self._at(acc, sample) ** 2)
        return total, _last_torque(acc, sample), sample.t

    def finish(self, acc):
        """The integral, three times."""
        return acc[0], acc[0], acc[0][None]

    def curvature(self, acc, sample: Sample) -> Outer:
        """2 dt y_u . y_v."""
        y = self._at(acc, sample)
        return Outer(y, jnp.broadcast_to(2 * self._weight(acc, sample), y.shape))

    def hessian(self, products: jax.Array, pieces: jax.Array, slopes: jax.Array) -> jax.Array:
        """The sum of products itself."""
        return products


@component
class Peak(Quantity):
    """max over time and joints of w_i y_i (of its size for error and torque), over the samples with
    t >= after.

    Its pieces are the maxima of each entry of the signal within each window of time.  In a term of
    the objective it is T log sum exp(piece / T) with T = smoothing scale: above the maximum by at
    most T times the logarithm of the number of pieces that come within T of it.

    Args:
      scale: the size of y that matters, () in its unit, > 0.
      signal: "error", "torque", "torque_rate", "deficit", "velocity_deficit" or "region_deficit";
        "torque" if not given.
      weights: w, () or (n,), or one for each selected joint [1]; 1 if not given.
      after: count from this time on, () [s]; 0 if not given.
      smoothing: T as a part of the scale, () [1], > 0; 0.01 if not given.
      windows: when each window of time after the first begins, (W,) [s]; one window if not given.
        `tune` sets them.
      joints: which ones count, a tuple of indices, names or truth values (`core.joints`); None,
        all, if not given.
      relative: whether the weights are 1 / limit of each joint, so that the peak is a number of
        limits; False if not given.
    """

    scale: jax.Array = leaf("", sign="positive", shape="scalar")
    signal: str = static(default="torque")
    weights: jax.Array = leaf("1", shape="any", default=1.0)
    after: jax.Array = leaf("s", shape="scalar", default=0.0)
    smoothing: jax.Array = leaf("1", sign="positive", shape="scalar", default=0.01)
    windows: jax.Array | None = leaf("s", shape="any", default=None)
    joints: tuple | None = static(default=None)
    relative: bool = static(default=False)
    units: ClassVar[dict[str, str]] = {
        name: unit for name, unit in TUNED_SIGNALS.items() if name != "outside"
    }

    @property
    def needs(self) -> str | None:
        """The optional signal of a run that it reads."""
        return NEEDS.get(self.signal)

    @property
    def sign(self) -> float:
        """-1 where it is minus a margin, 1 otherwise."""
        return -1.0 if self.signal in DEFICITS else 1.0

    def check(self) -> None:
        """Raises ValueError for an unknown signal, or a selection that is none."""
        checks.one_of("Peak.signal", self.signal, tuple(self.units))
        _check_choice("Peak", self.joints, self.weights)
        if self.signal == "region_deficit" and self.joints is not None:
            remedy = "A region does not belong to a joint."
            raise checks.fail("Peak.joints", self.joints, "None for regions", remedy)

    @property
    def unit(self) -> str:
        """Of its values."""
        return OF_LIMIT if self.relative else self.units[self.signal]

    def _at(self, acc, sample: Sample) -> jax.Array:
        y = signal_of(self.signal, sample, acc[1], None, self.joints)
        has_sides = self.signal != "region_deficit"
        count = sample.q.size if has_sides else y.size
        weights = weights_of(self.weights, self.joints, count, "Peak.weights")
        if self.signal not in DEFICITS:
            y = weights * y
            y = jnp.concatenate([y, -y])
        elif jnp.ndim(weights) == 1:  # margins have no weights, but a limit for each joint
            y = y * (jnp.concatenate([weights, weights]) if has_sides else weights)
        return jnp.where(sample.t >= self.after * (1 - 1e-6), y / self.scale, -INITIAL_PEAK)

    def init(self, sample: Sample):
        """Far below zero, (W, 2 k) for k joints, or (W, m) for m regions; the predecessor of the
        first torque is the torque itself.
        """
        windows = 1
        if self.windows is not None:
            windows += self.windows.size
        if self.signal == "region_deficit":
            entries = sample.region_margin.size
        else:
            entries = 2 * chosen_of(sample.q, self.joints, "joints").size
        return jnp.full((windows, entries), -INITIAL_PEAK, sample.t.dtype), sample.tau

    def update(self, acc, sample: Sample):
        """Adds one sample to the window that it is in."""
        y = jnp.broadcast_to(self._at(acc, sample), acc[0].shape)
        above = y > acc[0]
        if self.windows is not None:
            edge = self.windows * (1 - 1e-6)
            begun, none = sample.t >= edge, jnp.zeros((1,), bool)
            inside = jnp.concatenate([~none, begun]) & ~jnp.concatenate([begun, none])
            above = above & inside[:, None]
        return jnp.where(above, y, acc[0]), _last_torque(acc, sample)

    def finish(self, acc):
        """The smooth maximum, the maximum, and the pieces."""
        pieces = acc[0].ravel()
        top = jnp.max(jax.lax.stop_gradient(pieces))
        smooth = top + self.smoothing * jnp.log(jnp.sum(jnp.exp((pieces - top) / self.smoothing)))
        return self.scale * smooth, self.scale * top, self.scale * pieces

    def hessian(self, products: jax.Array, pieces: jax.Array, slopes: jax.Array) -> jax.Array:
        """Matrix (sum_j w_j p_ju p_jv - mean_u mean_v) / T."""
        T = self.smoothing * self.scale
        weights = jax.nn.softmax(pieces / T)
        mean = slopes @ weights
        return ((slopes * weights) @ slopes.T - mean[:, None] * mean[None, :]) / T


@component
class MetricResult(Quantity):
    """sum_i w_i m_i of a named result m of a metric's fold; m is one number or one a joint.

    It has no matrix of second derivatives: `tune` estimates that from changes of the gradient.

    Args:
      fold: the metric, any `iblf_jax.metrics.Fold`.
      name: which of its results; one of `fold.units`.
      weights: w, () or (k,) as m has k numbers [1]; 1 if not given.
      joints: which entries of m count, a tuple of indices, names or truth values; all if not given.
    """

    fold: Fold
    name: str = static()
    weights: jax.Array = leaf("1", shape="any", default=1.0)
    joints: tuple | None = static(default=None)

    def check(self) -> None:
        """Raises ValueError for something that is not a fold, or a name that it does not return."""
        remedy = "iblf_jax.metrics has them; iblf_jax.testing.check_fold checks your own."
        checks.conforms("MetricResult.fold", self.fold, Fold, remedy)
        checks.one_of("MetricResult.name", self.name, tuple(self.fold.units))
        _check_choice("MetricResult", self.joints, 1.0)

    @property
    def needs(self) -> str | None:
        """The optional signal of a run that its fold reads."""
        return self.fold.needs

    def init(self, sample: Sample):
        """The fold's accumulator."""
        return self.fold.init(sample)

    def update(self, acc, sample: Sample):
        """Adds one sample."""
        return self.fold.update(acc, sample)

    def finish(self, acc):
        """The weighted sum, three times."""
        found = self.fold.finish(acc)[self.name]
        if not jnp.issubdtype(found.dtype, jnp.floating):
            expected = "a result that can be differentiated"
            remedy = f"This one is {found.dtype}."
            raise checks.fail("MetricResult.name", self.name, expected, remedy)
        value = jnp.sum(self._weighted(found))
        return value, value, value[None]

    def _weighted(self, found: jax.Array) -> jax.Array:
        field = "MetricResult.weights"
        shape = jnp.shape(self.weights)
        if self.joints is None:
            if shape not in ((), found.shape):
                expected = f"one number, or shape {found.shape} as {self.name!r} has"
                raise checks.fail(field, self.weights, expected, f"Its shape is {shape}.")
            return self.weights * found
        if found.ndim != 1:
            expected = f"None, as {self.name!r} is not one number a joint"
            remedy = f"Its shape is {found.shape}."
            raise checks.fail("MetricResult.joints", self.joints, expected, remedy)
        chosen = chosen_of(found, self.joints, "MetricResult.joints")
        return weights_of(self.weights, self.joints, found.size, field) * chosen


MEMBERS = {"integral": TimeIntegral, "peak": Peak, "metric_result": MetricResult}
"""Every quantity by the name that a tuning file gives it."""


@component
class Quantities(Fold):
    """All quantities of a problem as one fold; results (K,) each.

    Args:
      parts: the quantities, a tuple.
    """

    parts: tuple
    units: ClassVar[dict[str, str]] = {"tuning_smooth": "", "tuning_exact": "", "tuning_pieces": ""}

    @property
    def curvatures(self) -> int:
        """Number of `Outer`."""
        return sum(has_curvature(part) for part in self.parts)

    def init(self, sample: Sample):
        """The quantities' accumulators."""
        return tuple(part.init(sample) for part in self.parts)

    def update(self, acc, sample: Sample):
        """Adds one sample to each."""
        return tuple(part.update(a, sample) for part, a in zip(self.parts, acc, strict=True))

    def finish(self, acc) -> dict[str, jax.Array]:
        """Smooth values and exact values, (K,) each, and all pieces, one quantity after the
        other.
        """
        found = [part.finish(a) for part, a in zip(self.parts, acc, strict=True)]
        smooth, exact, pieces = zip(*found, strict=True)
        return {
            "tuning_smooth": jnp.stack(smooth),
            "tuning_exact": jnp.stack(exact),
            "tuning_pieces": jnp.concatenate(pieces),
        }

    def counts(self, sample: Sample) -> tuple[int, ...]:
        """The number of pieces of each quantity, from the shapes of a sample."""
        return tuple(
            jax.eval_shape(lambda s, part=part: part.finish(part.init(s))[2], sample).size
            for part in self.parts
        )

    def curvature(self, acc, sample: Sample) -> tuple[Outer, ...]:
        """One `Outer` for each quantity that offers one."""
        pairs = zip(self.parts, acc, strict=True)
        return tuple(part.curvature(a, sample) for part, a in pairs if has_curvature(part))

    def hessians(
        self,
        products: Sequence[jax.Array],
        pieces: Sequence[jax.Array],
        slopes: Sequence[jax.Array],
    ) -> jax.Array:
        """Gauss-Newton matrix of each quantity, (K, D, D); zero where it has none.

        Args:
          products: (D, D), of the quantities that have a `curvature`.
          pieces: of each quantity, (m,).
          slopes: their gradients, (D, m).
        """
        remaining = iter(products)
        size = slopes[0].shape[0]
        none = jnp.zeros((size, size), slopes[0].dtype)
        found = []
        for part, own, slope in zip(self.parts, pieces, slopes, strict=True):
            product = next(remaining) if has_curvature(part) else none
            hessian = part.hessian(product, own, slope)
            found.append(none if hessian is None else hessian)
        return jnp.stack(found)
