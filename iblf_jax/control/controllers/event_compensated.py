"""The compensation of an event trigger, with which the claim of a law survives held commands.

The command is sent where |u_i - u_held,i| > delta_i |u_held,i| + m_i (`EventTrigger`), so that
between two events

    u_i = (1 + a delta_i) u_held,i + b m_i,   |a| <= 1, |b| <= 1,
    z_i u_held,i <= z_i u_i / (1 + delta_i) + |z_i| m_i / (1 - delta_i)   where z_i u_i <= 0.

With z = G_r^T w_r s_r, the derivative of the Lyapunov function along the input, and the input v of
the law in continuous time, the command

    u = -(1 + delta) (v tanh(z v/epsilon) + m_bar tanh(z m_bar/epsilon)),                    (E.2)
    m_bar > m/(1 - delta),

has z_i u_i <= 0, and |y| - y tanh(y/epsilon) <= 0.2785 epsilon for every y gives

    z . u_held <= z . v + 0.557 epsilon n,                                                   (E.3)

so that V' exceeds that of the law in continuous time by 0.557 epsilon n at most.  (E.3) holds where
the condition of the trigger is checked: at the samples.

Without the compensation V' grows by at most

    sum_i |z_i| (delta_i |u_held,i| + m_i),                                                   (E.1)

which vanishes with z as fast as z: the error e_r stays in a band whose size grows with the
threshold.  The compensation replaces v by (1 + delta) |v| with the sign of -z: a command of the
size of v near z = 0 needs a z of the size epsilon/|v|, and the slope of u by z is about v^2/epsilon
there.  A small epsilon therefore needs a short period.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.control.controllers._base import (
    Command,
    LawContext,
    State,
    TrackingLaw,
    Wrapping,
    check_law,
)
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, is_absent, leaf
from iblf_jax.core.units import INPUT

TANH_GAP = 0.2785
"""The largest value of y - y tanh(y) over y >= 0, rounded up."""


@component
class EventCompensated(Wrapping):
    """u = -(1 + delta) (v tanh(z v/epsilon) + m_bar tanh(z m_bar/epsilon)), v the input of a law.

    z is the derivative of the law's Lyapunov function along its input (`Command.input_slope`), e2
    for the laws of robots.  Paths reach through: "controller.K2" is the wrapped law's K2.

    Args:
      law: any law with an `input_slope`, such as `Backstepping` or `BarrierBackstepping`.
      relative: delta of the trigger, () or (n,) [1], >= 0 and < 1.
      absolute: m_bar, () or (n,) [N m], >= 0: more than m/(1 - delta) of the trigger.
      epsilon: width of the tanh, () or (n,) in the unit of z times that of v [N m rad/s], > 0.

    Source: L. Xing, C. Wen, Z. Liu, H. Su, J. Cai, IEEE Trans. Automatic Control 62 (2017)
      2071-2076; for several inputs component by component, as derived at the head of this module.
    """

    law: TrackingLaw
    relative: Leaf = leaf("1", sign="nonnegative")
    absolute: Leaf = leaf(INPUT, sign="nonnegative")
    epsilon: Leaf = leaf("N m rad/s", sign="positive")

    def check(self) -> None:
        """Raises ValueError for something that is not a law, or a delta of 1 or more."""
        check_law("EventCompensated.law", self.law, "iblf_jax.controllers has them.")
        check_relative("EventCompensated.relative", self.relative)

    @property
    def takes_shift(self) -> bool:
        """Whether the wrapped law takes the shift of an auxiliary state."""
        return self.law.takes_shift

    def command(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> tuple[Command, State]:
        """The wrapped law's command with the input (E.2).

        Raises:
          ValueError: a law without a Lyapunov function, or with another input than its torque.
        """
        command, rate = self.inner.command(t, x, d_hat, context, state)
        z, v = command.input_slope, command.tau
        if is_absent(z) or not is_absent(command.input):
            expected = "a law whose command has an `input_slope`, and a torque as its input"
            remedy = "Such as iblf_jax.controllers.Backstepping."
            raise checks.fail("EventCompensated.law", type(self.law).__name__, expected, remedy)
        terms = [y * jnp.tanh(z * y / self.epsilon) for y in (v, self.absolute)]
        return command._replace(tau=-(1.0 + self.relative) * (terms[0] + terms[1])), rate


def excess(law: EventCompensated) -> jax.Array:
    """The largest growth of V' by the trigger, sum_i 2 0.2785 epsilon_i, of (E.3), ()."""
    return jnp.sum(2.0 * TANH_GAP * law.epsilon)


def check_relative(name: str, value: ArrayLike) -> None:
    """Raises ValueError for a relative threshold of 1 or more."""
    if checks.is_concrete(value) and np.any(np.asarray(value) >= 1.0):
        expected = "less than 1"
        raise checks.fail(name, value, expected, "From 1 on a held command of any size is kept.")
