"""A disturbance observer for every level of a plant in strict-feedback form.

    x_j' = f_j + G_j x_{j+1} + d_j   (S.1),   d_hat_j = eta_j + kappa_j x_j,
    eta_j' = -kappa_j (f_j + G_j x_{j+1} + d_hat_j).

Then d_tilde = d - d_hat obeys d_tilde_j' = d_j' - kappa_j d_tilde_j: each level is independent of
the others.  The observer estimates disturbances that do not act where the input does, which no
observer of the input torque finds.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from iblf_jax.control.observers._base import Observer
from iblf_jax.control.observers._eta import STARTS
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.core.units import RATES
from iblf_jax.world import plants
from iblf_jax.world.plants import Plant


@component
class LevelObserver(Observer):
    """d_hat_j = eta_j + kappa_j x_j,   eta_j' = -kappa_j (f_j + G_j x_{j+1} + d_hat_j),   j = 1..r.

    Then d_tilde_j' = d_j' - kappa_j d_tilde_j exactly.  Noise of a measured level j appears in
    d_hat_j amplified by kappa_j: a scenario whose sensor has noise warns with the numbers.  A law
    of robots receives the torque M0(q) d_hat_2.

    Args:
      gain: kappa of each level, one number, r numbers or (r, n) [1/s], >= 0; 0 for a level without
        an estimate.
      eta0: eta(0), added to what `start` says, one number, r numbers or (r, n) [1], in the unit of
        each level per second; 0 if not given.
      start: "matched": eta(0) = eta0 - kappa x(0), so that d_hat(0) = eta0; "zero": eta(0) = eta0;
        "matched" if not given.

    Source: W.-H. Chen, D. J. Ballance, P. J. Gawthrop, J. O'Reilly, IEEE Trans. Industrial
      Electronics 47 (2000) 932-938 (the form eta + p(x)), applied to every level.
    """

    gain: Leaf = leaf("1/s", sign="nonnegative", shape="level")
    eta0: Leaf = leaf(RATES, shape="level", default=0.0)
    start: str = static(default="matched")

    def check(self) -> None:
        """Raises ValueError for an unknown `start`."""
        checks.one_of("LevelObserver.start", self.start, STARTS)

    def check_model(self, model: Plant) -> None:
        """Raises ValueError for another number of levels than the model has."""
        for name, value in (("gain", self.gain), ("eta0", self.eta0)):
            check_rows(f"observer.{name}", value, model)

    @property
    def noise_gain(self) -> jax.Array:
        """The factor from the noise of x to that of d_hat: kappa, (), (r,) or (r, n) [1/s]."""
        return self.gain

    @property
    def error_gain(self) -> jax.Array:
        """The rate kappa of d_tilde' = d' - kappa d_tilde, (), (r,) or (r, n) [1/s]."""
        return self.gain

    def init(self, x: jax.Array, model: Plant) -> jax.Array:
        """eta(0), (r, n)."""
        eta0 = jnp.broadcast_to(self.eta0, x.shape)
        if self.start == "zero":
            return eta0
        return eta0 - self.gain * x

    def estimate(self, t: jax.Array, x: jax.Array, model: Plant, state: jax.Array) -> jax.Array:
        """d_hat, (r, n)."""
        return state + self.gain * x

    def derivative(
        self, t: jax.Array, x: jax.Array, u: jax.Array, model: Plant, state: jax.Array
    ) -> jax.Array:
        """eta', (r, n)."""
        d_hat = self.estimate(t, x, model, state)
        return -self.gain * (plants.flow(model, t, x, u) + d_hat)

    def advance(
        self,
        t: jax.Array,
        x: jax.Array,
        u: jax.Array,
        model: Plant,
        state: jax.Array,
        period: jax.Array,
    ) -> jax.Array:
        """The state eta a period later for constant x and u, (r, n).

        It is exact: eta' = kappa (eta* - eta) with a constant eta*, so that eta* - eta falls by the
        factor exp(-kappa period).
        """
        rate = self.derivative(t, x, u, model, state)
        # (1 - exp(-k)) / k is the mean of exp(-k s) for s from 0 to 1, 1 at k = 0.
        k = self.gain * period
        is_zero = k == 0.0
        mean_decay = jnp.where(is_zero, 1.0, -jnp.expm1(-k) / jnp.where(is_zero, 1.0, k))
        return state + period * mean_decay * rate

    def at_period(self, period: jax.Array) -> LevelObserver:
        """The observer with the gains (1 - exp(-kappa period)) / period, for which 1 - gain period
        is what is left of an error after a period.
        """
        return dataclasses.replace(self, gain=-jnp.expm1(-self.gain * period) / period)


def check_rows(name: str, value: jax.Array, model: Plant) -> None:
    """Raises ValueError for a leaf with another number of rows than a model has levels."""
    if jnp.ndim(value) == 0 or len(value) == model.order:
        return
    expected = f"one number, or {model.order} rows, as the model has {model.order} levels"
    raise checks.fail(name, f"{len(value)} rows", expected)
