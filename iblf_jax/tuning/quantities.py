"""What objectives and requirements are made of: smooth numbers of a run, each a fold over its samples.

Two kinds cover what gains are tuned for, over a signal y(t), a vector:

    TimeIntegral   sum_k dt |y(t_k)|^2
    Peak           max_k max_i y_i(t_k), in the loss as T log sum_k sum_i exp(y_i(t_k) / T), which is smooth and never below it

Both also give the matrix of their second derivatives without the second derivatives of the motion (Gauss-Newton), from the tangents
y_u of their signal (`derivatives.Outer`):

    TimeIntegral   2 sum dt y_u . y_v         Peak   (sum_w y_u y_v - mean_u mean_v) / T,  w the weights of the smooth maximum

`MetricResult` is a result of any metric's fold.  A quantity of one's own needs `init`, `update`, `finish`, and for second-order methods
`curvature` and `hessian`; `iblf_jax.testing.check_objective` looks at it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp

from iblf_jax.core import checks
from iblf_jax.core.pytree import component, leaf, static
from iblf_jax.engine.derivatives import Outer
from iblf_jax.simulation.metrics import Fold
from iblf_jax.simulation.signals import Sample

FAR = 1e6
"""Where a peak starts, below everything; in units of its scale."""
SOFT_EDGE = 0.1
"""Width of the soft edge of a tolerance, as a part of it."""


class Quantity(Protocol):
    """What the package asks of a quantity: a component with these methods."""

    def init(self, sample: Sample) -> Any:
        """The accumulator before the first sample."""
        ...

    def update(self, acc: Any, sample: Sample) -> Any:
        """The accumulator after one more sample."""
        ...

    def finish(self, acc: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
        """The smooth value, the exact one (the report's), and what `hessian` wants to know, () each."""
        ...


TUNED_SIGNALS = {"error": "rad", "torque": "N m", "torque_rate": "N m/s", "outside": "1", "deficit": "rad"}
"""Signal -> unit."""


def signal_of(name: str, sample: Sample, last: jax.Array, tolerance: Any) -> jax.Array:
    """A signal at one sample, (n,) or (2 n,).

    error e1; torque tau; torque_rate (tau - last tau) / dt; outside sqrt(sigmoid((|e1| - tolerance) / (SOFT_EDGE tolerance))), whose
    integral of squares is the time outside the tolerance; deficit (lower - q, q - upper), the largest of which is minus the margin.
    """
    if name == "error":
        return sample.e1
    if name == "torque":
        return sample.tau
    if name == "torque_rate":
        return (sample.tau - last) / jnp.where(sample.dt > 0, sample.dt, 1.0)
    if name == "outside":
        size = jnp.where(sample.e1 >= 0, sample.e1, -sample.e1)
        return jax.nn.sigmoid((size - tolerance) / (SOFT_EDGE * tolerance)) ** 0.5
    return jnp.concatenate([sample.lower - sample.q, sample.q - sample.upper])


@component
class TimeIntegral:
    """sum_k dt |y(t_k)|^2 over the samples with t >= after.

    Args:
      signal: "error", "torque", "torque_rate" or "outside"; "error" if not given.
      joints: weight of each joint, () or (n,) [1]; 1 if not given.
      after: count from this time on, () [s]; 0 if not given.
      tolerance: for "outside", on |e1|, () [rad], > 0; none if not given.
    """

    signal: str = static(default="error")
    joints: jax.Array = leaf("1", default=1.0)
    after: jax.Array = leaf("s", shape="scalar", default=0.0)
    tolerance: jax.Array | None = leaf("rad", sign="positive", shape="scalar", default=None)
    units: ClassVar[dict[str, str]] = {"error": "rad^2 s", "torque": "N^2 m^2 s", "torque_rate": "N^2 m^2/s", "outside": "s"}

    def check(self) -> None:
        """Raises ValueError for an unknown signal."""
        checks.one_of("TimeIntegral.signal", self.signal, tuple(self.units))

    def _at(self, acc, sample: Sample) -> jax.Array:
        y = self.joints * signal_of(self.signal, sample, acc[1], self.tolerance)
        return jnp.where(sample.t >= self.after * (1 - 1e-6), y, 0.0)

    def init(self, sample: Sample):
        """Zero; the first torque has no predecessor but itself."""
        return jnp.zeros_like(sample.t), sample.tau

    def update(self, acc, sample: Sample):
        """Adds one sample."""
        return acc[0] + sample.dt * jnp.sum(self._at(acc, sample) ** 2), sample.tau

    def finish(self, acc):
        """The integral, twice, and 1."""
        return acc[0], acc[0], jnp.ones_like(acc[0])

    def curvature(self, acc, sample: Sample) -> Outer:
        """2 dt y_u . y_v."""
        y = self._at(acc, sample)
        return Outer(y, jnp.broadcast_to(2 * sample.dt, y.shape))

    def hessian(self, products: jax.Array, gradient: jax.Array, weight: jax.Array) -> jax.Array:
        """The sum of products itself."""
        return products


@component
class Peak:
    """max over time and joints of a signal (of its size for error and torque), over the samples with t >= after.

    In the loss T log sum exp(y / T) with T = smoothing scale: above the maximum by at most T times the logarithm of the number of
    samples that come within T of it.

    Args:
      scale: the size of y that matters, () in its unit, > 0.
      signal: "error", "torque", "torque_rate" or "deficit"; "torque" if not given.
      joints: weight of each joint, () or (n,) [1]; 1 if not given.
      after: count from this time on, () [s]; 0 if not given.
      smoothing: T as a part of the scale, () [1], > 0; 0.01 if not given.
    """

    scale: jax.Array = leaf("", sign="positive", shape="scalar")
    signal: str = static(default="torque")
    joints: jax.Array = leaf("1", default=1.0)
    after: jax.Array = leaf("s", shape="scalar", default=0.0)
    smoothing: jax.Array = leaf("1", sign="positive", shape="scalar", default=0.01)
    units: ClassVar[dict[str, str]] = {name: unit for name, unit in TUNED_SIGNALS.items() if name != "outside"}

    def check(self) -> None:
        """Raises ValueError for an unknown signal."""
        checks.one_of("Peak.signal", self.signal, tuple(self.units))

    def _at(self, acc, sample: Sample) -> jax.Array:
        y = signal_of(self.signal, sample, acc[2], None)
        if self.signal != "deficit":
            y = self.joints * y
            y = jnp.concatenate([y, -y])
        return jnp.where(sample.t >= self.after * (1 - 1e-6), y / self.scale, -FAR)

    def _weights(self, acc, sample: Sample):
        """Scaled signal y / scale, the largest so far, the weights of this sample and the factor on what was before."""
        y = self._at(acc, sample)
        top = jnp.maximum(acc[0], jnp.max(jax.lax.stop_gradient(y)))
        return y, top, jnp.exp((y - top) / self.smoothing), jnp.exp((acc[0] - top) / self.smoothing)

    def init(self, sample: Sample):
        """Below everything."""
        far = jnp.full_like(sample.t, -FAR)
        return far, jnp.zeros_like(sample.t), sample.tau

    def update(self, acc, sample: Sample):
        """Adds one sample."""
        _, top, weights, decay = self._weights(acc, sample)
        return top, acc[1] * decay + jnp.sum(weights), sample.tau

    def finish(self, acc):
        """The smooth maximum, the maximum, and the sum of weights."""
        smooth = acc[0] + self.smoothing * jnp.log(acc[1])
        return self.scale * smooth, self.scale * acc[0], jax.lax.stop_gradient(acc[1])

    def curvature(self, acc, sample: Sample) -> Outer:
        """Weighted y_u . y_v, what was before scaled down when the maximum moves up."""
        y, _, weights, decay = self._weights(acc, sample)
        return Outer(y, weights, decay)

    def hessian(self, products: jax.Array, gradient: jax.Array, weight: jax.Array) -> jax.Array:
        """Matrix scale (sum w y_u y_v / sum w - mean_u mean_v) / smoothing."""
        mean = gradient / self.scale
        return self.scale * (products / weight - mean[:, None] * mean[None, :]) / self.smoothing


@component
class MetricResult:
    """sum_i joints_i m_i of a named result m of a metric's fold; m is one number or one a joint.

    It offers no matrix of second derivatives: `tune` learns that from the gradients along the way.

    Args:
      fold: the metric, any `iblf_jax.metrics.Fold`.
      name: which of its results; one of `fold.units`.
      joints: weight of each number of m, () or as m [1]; 1 if not given.
    """

    fold: Fold
    name: str = static()
    joints: jax.Array = leaf("1", shape="any", default=1.0)

    def check(self) -> None:
        """Raises ValueError for something that is not a fold, or a name that it does not return."""
        checks.conforms("MetricResult.fold", self.fold, Fold, "iblf_jax.metrics has them; iblf_jax.testing.check_fold looks at your own.")
        checks.one_of("MetricResult.name", self.name, tuple(self.fold.units))

    def init(self, sample: Sample):
        """The fold's accumulator."""
        return self.fold.init(sample)

    def update(self, acc, sample: Sample):
        """Adds one sample."""
        return self.fold.update(acc, sample)

    def finish(self, acc):
        """The weighted sum, twice, and 1."""
        found = self.fold.finish(acc)[self.name]
        if not jnp.issubdtype(found.dtype, jnp.floating):
            raise checks.fail("MetricResult.name", self.name, "a result that can be differentiated", f"This one is {found.dtype}.")
        if jnp.shape(self.joints) not in ((), found.shape):
            raise checks.fail("MetricResult.joints", self.joints, f"one number, or shape {found.shape} as {self.name!r} has")
        value = jnp.sum(self.joints * found)
        return value, value, jnp.ones_like(value)


MEMBERS = {"integral": TimeIntegral, "peak": Peak, "metric_result": MetricResult}
"""Every quantity by the name that a tuning file gives it."""


@component
class Quantities:
    """All quantities of a problem as one fold; results (K,) each.

    Args:
      parts: the quantities, a tuple.
    """

    parts: tuple
    units: ClassVar[dict[str, str]] = {"tuning_smooth": "", "tuning_exact": "", "tuning_weight": "1"}

    @property
    def curvatures(self) -> int:
        """How many `Outer` there are."""
        return len(self.parts)

    def init(self, sample: Sample):
        """The quantities' accumulators."""
        return tuple(part.init(sample) for part in self.parts)

    def update(self, acc, sample: Sample):
        """Adds one sample to each."""
        return tuple(part.update(a, sample) for part, a in zip(self.parts, acc, strict=True))

    def finish(self, acc) -> dict[str, jax.Array]:
        """Smooth values, exact values and weights."""
        found = [part.finish(a) for part, a in zip(self.parts, acc, strict=True)]
        return {name: jnp.stack(x) for name, x in zip(self.units, zip(*found, strict=True), strict=True)}

    def curvature(self, acc, sample: Sample) -> tuple[Outer, ...]:
        """One `Outer` a quantity; an empty one where it offers none."""
        none = Outer(jnp.zeros_like(sample.e1), jnp.zeros_like(sample.e1))
        return tuple(part.curvature(a, sample) if hasattr(part, "curvature") else none for part, a in zip(self.parts, acc, strict=True))

    def hessians(self, products: Sequence[jax.Array], gradients: jax.Array, weights: jax.Array) -> jax.Array:
        """Gauss-Newton matrix of each quantity, (K, D, D), from its products (D, D), gradients (D, K) and weights (K,)."""
        found = [
            part.hessian(products[k], gradients[:, k], weights[k]) if hasattr(part, "hessian") else jnp.zeros_like(products[k])
            for k, part in enumerate(self.parts)
        ]
        return jnp.stack(found)
