"""Distributions of uncertain parameters, and how a draw acts on a leaf.

A distribution is defined by its quantile function F^-1, which maps a uniform number u in (0, 1) to
a draw:

    uniform       low + u (high - low)
    normal        mean + std Phi^-1(u)
    log_uniform   low (high / low)^u
    choice        the first value whose cumulative weight reaches u
    joint_normal  mean + sum_k rows_k Phi^-1(u_k)
    joint_samples the sample of the group whose cumulative weight reaches u

The leaves of a `joint_normal` or `joint_samples` group share their u, so that they vary together.
Independent draws, Latin hypercubes and Sobol points differ in their u only.  A draw z changes a
leaf that holds x0 to

    factor   x0 z        offset   x0 + z        value   z

`factor(uniform(0.7, 1.3))` is thirty per cent around nominal.  A vector leaf gets an independent
draw for each entry, unless `shared=True`.  All of these are pytrees whose numbers are leaves: new
numbers do not recompile a study.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.attributes import has_members
from iblf_jax.core.families import Part, adopt, attribute, required_members
from iblf_jax.core.pytree import component, leaf, static

KINDS = ("factor", "offset", "value")
"""How a draw acts on the nominal value."""


class Distribution(Part):
    """The contract of a distribution."""

    is_discrete: ClassVar[bool] = False
    """Whether its draws are not continuous in u."""

    @attribute
    def group(self) -> str:
        """The name of the draws that leaves which vary together share; "" for other leaves."""
        return ""

    @attribute
    def draws(self) -> int:
        """The number of uniform numbers that `quantile` takes for a group."""
        return 0

    @abc.abstractmethod
    def quantile(self, u: jax.Array) -> jax.Array:
        """F^-1(u), elementwise, for u in (0, 1)."""

    def of_normal(self, z: jax.Array) -> jax.Array:
        """F^-1(Phi(z)).  Where Phi(z) rounds to 1, a distribution may compute it by other means."""
        limits = jnp.finfo(z.dtype)
        u = jax.scipy.special.ndtr(z)
        return self.quantile(jnp.clip(u, limits.tiny, 1 - limits.eps / 2))

    @abc.abstractmethod
    def support(self) -> tuple[np.ndarray, np.ndarray]:
        """The smallest and the largest draw; infinite where the distribution is unbounded."""


@component
class Uniform(Distribution):
    """Evenly between `low` and `high`.

    Args:
      low: the lower end, () or as the leaf, in its unit.
      high: the upper end, () or as the leaf, in its unit.
    """

    low: jax.Array = leaf("", shape="any")
    high: jax.Array = leaf("", shape="any")

    def check(self) -> None:
        """Raises ValueError unless low < high."""
        _increasing("uniform", self.low, self.high)

    def quantile(self, u: jax.Array) -> jax.Array:
        """F^-1(u) = low + u (high - low)."""
        return self.low + u * (self.high - self.low)

    def support(self) -> tuple[np.ndarray, np.ndarray]:
        """The two ends."""
        return np.asarray(self.low), np.asarray(self.high)


@component
class Normal(Distribution):
    """Gaussian, with mean `mean` and standard deviation `std`.

    Args:
      mean: centre of the draws, () or as the leaf, in its unit.
      std: standard deviation, () or as the leaf, in its unit, > 0.
    """

    mean: jax.Array = leaf("", shape="any")
    std: jax.Array = leaf("", sign="positive", shape="any")

    def quantile(self, u: jax.Array) -> jax.Array:
        """F^-1(u) = mean + std Phi^-1(u)."""
        return self.of_normal(jax.scipy.special.ndtri(u))

    def of_normal(self, z: jax.Array) -> jax.Array:
        """F^-1(Phi(z)) = mean + std z."""
        return self.mean + self.std * z

    def support(self) -> tuple[np.ndarray, np.ndarray]:
        """The whole line."""
        shape = np.broadcast_shapes(np.shape(self.mean), np.shape(self.std))
        return np.full(shape, -np.inf), np.full(shape, np.inf)


@component
class LogUniform(Distribution):
    """Evenly between `low` and `high` on a logarithmic scale.

    Args:
      low: the lower end, () or as the leaf, in its unit, > 0.
      high: the upper end, () or as the leaf, in its unit, > 0.
    """

    low: jax.Array = leaf("", sign="positive", shape="any")
    high: jax.Array = leaf("", sign="positive", shape="any")

    def check(self) -> None:
        """Raises ValueError unless low < high."""
        _increasing("log_uniform", self.low, self.high)

    def quantile(self, u: jax.Array) -> jax.Array:
        """F^-1(u) = low (high / low)^u."""
        return self.low * jnp.exp(u * jnp.log(self.high / self.low))

    def support(self) -> tuple[np.ndarray, np.ndarray]:
        """The two ends."""
        return np.asarray(self.low), np.asarray(self.high)


@component
class Choice(Distribution):
    """One of a list of numbers, with weights.

    Args:
      values: (m,) numbers, in the leaf's unit.
      weights: (m,) numbers >= 0, of any sum.
    """

    values: jax.Array = leaf("", shape="any")
    weights: jax.Array = leaf("", sign="nonnegative", shape="any")
    is_discrete: ClassVar[bool] = True

    def check(self) -> None:
        """Raises ValueError unless there is one weight a value and one that is not zero."""
        if self.values.ndim != 1 or self.values.size == 0:
            raise checks.fail(
                "choice: values",
                self.values,
                "a list of numbers",
                "Give a vector leaf one choice for each entry's path.",
            )
        _check_weights("choice: weights", self.weights, self.values.shape)

    def quantile(self, u: jax.Array) -> jax.Array:
        """The first value whose cumulative weight reaches u."""
        return self.values[_first_that_reaches(u, self.weights)]

    def of_normal(self, z: jax.Array) -> jax.Array:
        """F^-1(Phi(z))."""
        return self.values[_first_that_reaches_normal(z, self.weights)]

    def support(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and the greatest value of positive weight."""
        values = np.asarray(self.values)[np.asarray(self.weights) > 0]
        return values.min(), values.max()


@component
class JointNormal(Distribution):
    """Gaussian, of leaves that vary together.

    Args:
      mean: centre of the draws, () or as the leaf, in its unit.
      rows: what each draw of the group adds per standard deviation, (d,) or, for m numbers, (m, d),
        in the leaf's unit: with the rows of all leaves of the group as a matrix L, L L^T is their
        covariance.
      group: name of the draws, d of them, that the leaves share.
    """

    mean: jax.Array = leaf("", shape="any")
    rows: jax.Array = leaf("", shape="any")
    group: str = static()

    def check(self) -> None:
        """Raises ValueError for rows that do not fit the mean, or a group without a name."""
        if self.rows.ndim != self.mean.ndim + 1 or self.rows.shape[:-1] != self.mean.shape:
            raise checks.fail(
                "joint_normal: rows",
                self.rows,
                f"shape {(*self.mean.shape, 'd')}: d numbers for each of the mean's",
            )
        if not isinstance(self.group, str) or not self.group:
            raise checks.fail("joint_normal: group", self.group, "a name")

    @property
    def draws(self) -> int:
        """How many uniform numbers the group has, d."""
        return self.rows.shape[-1]

    def quantile(self, u: jax.Array) -> jax.Array:
        """Mean + rows Phi^-1(u), for the u of the group, (d,)."""
        return self.of_normal(jax.scipy.special.ndtri(u))

    def of_normal(self, z: jax.Array) -> jax.Array:
        """Mean + rows z, for the standard normal numbers of the group, (d,)."""
        return self.mean + jnp.sum(self.rows * z, axis=-1)

    def support(self) -> tuple[np.ndarray, np.ndarray]:
        """The whole line."""
        return np.full(self.mean.shape, -np.inf), np.full(self.mean.shape, np.inf)


@component
class Interval:
    """All numbers between `low` and `high`, without probabilities: a set for proofs.

    It has no quantile: studies that draw, design or search runs refuse it.

    Args:
      low: the lower end, () or as the leaf, in its unit.
      high: the upper end, () or as the leaf, in its unit.
    """

    low: jax.Array = leaf("", shape="any")
    high: jax.Array = leaf("", shape="any")

    def check(self) -> None:
        """Raises ValueError unless low < high."""
        _increasing("interval", self.low, self.high)

    def support(self) -> tuple[np.ndarray, np.ndarray]:
        """The two ends."""
        return np.asarray(self.low), np.asarray(self.high)


def is_distribution(value: object) -> bool:
    """Whether a value is an interval, or has what a distribution requires; its class is then
    adopted by the family.
    """
    if isinstance(value, Distribution | Interval):
        return True
    fits = not isinstance(value, type) and has_members(value, *required_members(Distribution))
    if fits:
        adopt(type(value), Distribution)
    return fits


def is_interval(perturbation: object) -> bool:
    """Whether a perturbation states a set of values and no distribution."""
    return isinstance(perturbation, Perturbation) and isinstance(
        perturbation.distribution, Interval
    )


@component
class JointSamples(Distribution):
    """One of a list of samples, of leaves that vary together.

    Args:
      values: the leaf in each of m samples, (m,) or (m, ...), in the leaf's unit.
      weights: (m,) numbers >= 0, of any sum.
      group: name of the draw that the leaves share.
    """

    values: jax.Array = leaf("", shape="any")
    weights: jax.Array = leaf("", sign="nonnegative", shape="any")
    group: str = static()
    draws: ClassVar[int] = 1
    is_discrete: ClassVar[bool] = True

    def check(self) -> None:
        """Raises ValueError for no sample, weights that do not fit, or a group without a name."""
        if self.values.ndim == 0 or self.values.size == 0:
            expected = "the leaf in each of the samples, at least one"
            raise checks.fail("joint_samples: values", self.values, expected)
        _check_weights("joint_samples: weights", self.weights, self.values.shape[:1])
        if not isinstance(self.group, str) or not self.group:
            raise checks.fail("joint_samples: group", self.group, "a name")

    def quantile(self, u: jax.Array) -> jax.Array:
        """The first sample whose cumulative weight reaches u, for the u of the group, (1,)."""
        return self.values[_first_that_reaches(u[0], self.weights)]

    def of_normal(self, z: jax.Array) -> jax.Array:
        """F^-1(Phi(z)), for the standard normal number of the group, (1,)."""
        return self.values[_first_that_reaches_normal(z[0], self.weights)]

    def support(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and the greatest value of positive weight."""
        values = np.asarray(self.values)[np.asarray(self.weights) > 0]
        return values.min(axis=0), values.max(axis=0)


def _check_weights(name: str, weights: jax.Array, shape: tuple[int, ...]) -> None:
    checks.shape_is(name, weights, shape)
    if checks.is_concrete(weights) and not np.sum(np.asarray(weights)) > 0:
        raise checks.fail(name, weights, "at least one weight > 0")


def _first_that_reaches(u: jax.Array, weights: jax.Array) -> jax.Array:
    """The index of the first entry whose cumulative weight reaches u, elementwise."""
    edges = jnp.cumsum(weights) / jnp.sum(weights)
    index = jnp.sum(u[..., None] > edges, axis=-1)
    return jnp.minimum(index, weights.size - 1)


def _first_that_reaches_normal(z: jax.Array, weights: jax.Array) -> jax.Array:
    """The same for u = Phi(z), elementwise, with the weights of the last entries exact.

    In the upper half 1 - u = Phi(-z) is compared with the weight that follows an entry: in float32,
    u itself does not resolve weights below 6e-8 of the sum.
    """
    total = jnp.sum(weights)
    until = jnp.cumsum(weights) / total
    following = jnp.flip(jnp.cumsum(jnp.flip(weights))) / total
    after = jnp.append(following[1:], jnp.zeros((), following.dtype))
    lower = jax.scipy.special.ndtr(z)[..., None] > until
    upper = jax.scipy.special.ndtr(-z)[..., None] < after
    index = jnp.sum(jnp.where(until < 0.5, lower, upper), axis=-1)
    return jnp.minimum(index, weights.size - 1)


@component
class Perturbation:
    """A distribution and how its draw acts on a leaf; made by `factor`, `offset` and `value`.

    Args:
      distribution: of the draw, any `Distribution`, or an `Interval`; of a factor [1], else in the
        leaf's unit.
      kind: "factor", "offset" or "value"; "value" if not given.
      shared: whether all entries of a vector leaf get the same draw; False if not given.
    """

    distribution: Distribution | Interval
    kind: str = static(default="value")
    shared: bool = static(default=False)

    def check(self) -> None:
        """Raises ValueError for something that is not a distribution."""
        if not is_distribution(self.distribution):
            raise _no_distribution(self.kind, self.distribution)
        checks.one_of("Perturbation.kind", self.kind, KINDS)
        object.__setattr__(self, "shared", checks.boolean("Perturbation.shared", self.shared))

    @property
    def group(self) -> str:
        """Name of the draws that the leaf shares with others; "" if it shares none."""
        return "" if isinstance(self.distribution, Interval) else self.distribution.group

    def apply(self, nominal: jax.Array, u: jax.Array) -> jax.Array:
        """The perturbed leaf, from its nominal value and the uniform number(s) of this draw; the
        shape of `nominal`.
        """
        distribution: Any = self.distribution
        draw = jnp.broadcast_to(distribution.quantile(u).astype(nominal.dtype), nominal.shape)
        if self.kind == "factor":
            return nominal * draw
        if self.kind == "offset":
            return nominal + draw
        return draw

    def range(self, nominal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The least and the greatest value that the leaf can take."""
        low, high = self.distribution.support()
        if self.kind == "factor":
            with np.errstate(invalid="ignore"):
                ends = np.stack([nominal * low, nominal * high])
            ends[np.isnan(ends)] = 0.0  # 0 times infinity
            return ends.min(0), ends.max(0)
        if self.kind == "offset":
            return nominal + low, nominal + high
        return np.broadcast_to(low, nominal.shape), np.broadcast_to(high, nominal.shape)


def _increasing(name: str, low: jax.Array, high: jax.Array) -> None:
    if checks.is_concrete((low, high)) and not np.all(np.asarray(low) < np.asarray(high)):
        raise checks.fail(
            f"{name}(low, high)",
            (np.asarray(low).tolist(), np.asarray(high).tolist()),
            "low < high",
            "Exchange or widen them.",
        )


def uniform(low: Any, high: Any) -> Uniform:
    """Evenly between two numbers.

        z = low + u (high - low),   u uniform on (0, 1)

    Args:
      low, high: the ends, numbers or arrays that fit the perturbed leaf.

    Returns:
      A distribution for `factor`, `offset` or `value`.

    Raises:
      ValueError: unless low < high.
    """
    return Uniform(low, high)


def interval(low: Any, high: Any) -> Interval:
    """All numbers between two ends, for proofs; it has no probabilities.

        low <= z <= high

    Args:
      low, high: the ends, numbers or arrays that fit the leaf.

    Returns:
      A set for `factor`, `offset` or `value`, which proofs take; `uniform(low, high)` is the
      distribution for studies.  Ends that have to be rounded, because JAX stores single-precision
      numbers by default, are rounded outward.

    Raises:
      ValueError: unless low < high.
    """
    stored = Interval(low, high)
    return Interval(
        _rounded_outward(low, stored.low, -np.inf), _rounded_outward(high, stored.high, np.inf)
    )


def _rounded_outward(end: Any, stored: jax.Array, outward: float) -> Any:
    """The stored end, or its neighbour if the stored one lies inside the given end."""
    if isinstance(end, jax.Array):
        return end  # it has its own precision
    exact = np.asarray(end, float)
    numbers = np.asarray(stored)
    is_inside = (numbers - exact) * np.sign(outward) < 0.0
    return np.where(is_inside, np.nextafter(numbers, numbers.dtype.type(outward)), numbers)


def normal(mean: Any = 0.0, std: Any = 1.0) -> Normal:
    """Gaussian.

        z = mean + std Phi^-1(u),   u uniform on (0, 1)

    On a leaf that must be positive, a run that draws an inadmissible value is not made and is
    flagged `Status.INADMISSIBLE_DRAW`; `log_uniform` and `uniform` avoid that.

    Args:
      mean, std: mean and standard deviation, numbers or arrays that fit the perturbed leaf.

    Returns:
      A distribution for `factor`, `offset` or `value`.

    Raises:
      ValueError: unless std > 0.
    """
    return Normal(mean, std)


def log_uniform(low: Any, high: Any) -> LogUniform:
    """Evenly between two positive numbers on a logarithmic scale.

        z = low (high / low)^u,   u uniform on (0, 1)

    Args:
      low, high: the ends, numbers > 0 or arrays that fit the perturbed leaf.

    Returns:
      A distribution for `factor`, `offset` or `value`.

    Raises:
      ValueError: unless 0 < low < high.
    """
    return LogUniform(low, high)


def joint_normal(mean: Any, rows: Any, group: str) -> JointNormal:
    """Gaussian, of leaves that vary together.

        z = mean + rows w,   w standard normal, (d,), the same for all leaves of the group

    Args:
      mean: as the perturbed leaf.
      rows: (..., d), as the leaf with one number more for each of its entries: L of the covariance
        L L^T of all leaves of the group.
      group: name of the draws that they share.

    Returns:
      A distribution for `factor`, `offset` or `value`.

    Raises:
      ValueError: rows that do not fit the mean, or no name.

    Source: `Identification.perturbations` is made of them.
    """
    return JointNormal(mean, rows, group)


def joint_samples(values: Any, group: str, weights: Any = None) -> JointSamples:
    """One of a list of samples, of leaves that vary together.

        z = values[min {j : w_0 + ... + w_j >= u sum w}],   u the same for all leaves of the group

    Args:
      values: (m, ...), the perturbed leaf in each of m samples.
      group: name of the draw that the leaves share.
      weights: (m,) numbers >= 0, not necessarily of sum 1; equal if not given.

    Returns:
      A distribution for `factor`, `offset` or `value`.

    Raises:
      ValueError: no sample, weights that do not fit, or no name.

    Source: `FailureProbability.rare_draws` is made of them.
    """
    if weights is None:
        count = checks.as_floats("joint_samples: values", values).shape[:1]
        weights = jnp.ones(count)
    return JointSamples(values, weights, group)


def choice(values: Any, weights: Any = None) -> Choice:
    """One of a list of numbers.

        z = values[min {j : w_0 + ... + w_j >= u sum w}],   u uniform on (0, 1)

    Args:
      values: (m,) numbers.
      weights: (m,) numbers >= 0, not necessarily of sum 1; equal if not given.

    Returns:
      A distribution for `factor`, `offset` or `value`.

    Raises:
      ValueError: an empty list, or weights that do not fit it.
    """
    if weights is None:
        weights = jnp.ones(checks.as_floats("choice: values", values).shape)
    return Choice(values, weights)


def _perturbation(kind: str, distribution: Any, shared: Any) -> Perturbation:
    """A perturbation; ValueError for an invalid distribution."""
    if not is_distribution(distribution):
        raise _no_distribution(kind, distribution)
    return Perturbation(distribution, kind, shared)


def _no_distribution(kind: str, given: object) -> ValueError:
    remedy = f"Write ij.{kind}(ij.uniform(low, high)), for example."
    return checks.fail(f"{kind}: distribution", given, "a distribution", remedy)


def factor(distribution: Distribution | Interval, *, shared: bool = False) -> Perturbation:
    """The leaf is its nominal value times a draw.

        x = x0 z

    Args:
      distribution: of z [1].
      shared: one draw for all entries of a vector leaf, rather than one each.

    Returns:
      A perturbation for `monte_carlo`, `sweep`, `sensitivity` and `tune`; of an `interval`, for
      proofs.

    Raises:
      ValueError: not a distribution.

    Source: design of this package.
    """
    return _perturbation("factor", distribution, shared)


def offset(distribution: Distribution | Interval, *, shared: bool = False) -> Perturbation:
    """The leaf is its nominal value plus a draw.

        x = x0 + z

    Args:
      distribution: of z, in the leaf's unit.
      shared: one draw for all entries of a vector leaf, rather than one each.

    Returns:
      A perturbation for `monte_carlo`, `sweep`, `sensitivity` and `tune`; of an `interval`, for
      proofs.

    Raises:
      ValueError: not a distribution.

    Source: design of this package.
    """
    return _perturbation("offset", distribution, shared)


def value(distribution: Distribution | Interval, *, shared: bool = False) -> Perturbation:
    """The leaf is a draw.

        x = z

    Args:
      distribution: of z, in the leaf's unit.
      shared: one draw for all entries of a vector leaf, rather than one each.

    Returns:
      A perturbation for `monte_carlo`, `sweep`, `sensitivity` and `tune`; of an `interval`, for
      proofs.

    Raises:
      ValueError: not a distribution.

    Source: design of this package.
    """
    return _perturbation("value", distribution, shared)


MEMBERS = {
    "uniform": Uniform,
    "normal": Normal,
    "log_uniform": LogUniform,
    "choice": Choice,
    "joint_normal": JointNormal,
    "joint_samples": JointSamples,
}
"""Every distribution by the name that files give it."""
