"""The backstepping law of the paper, for any barrier.

Step one: with q' = alpha(t, q), the barrier's V1 decays.  Step two: the torque drives
e2 = q' - alpha to zero,

    tau = C0 q' + G0 + M0 alpha' - f_hat - K2 e2 - w s,                                       (3.14)

with s = dV1/dq the barrier's slope ("Con" in the paper) and alpha' the total time derivative of
alpha, taken by jvp along (1, q').  The paper has w = 1.  Another weight w_i > 0 scales the Lyapunov
function of its joint, V1 = sum_i w_i V1_i, and leaves its decay rate as it is.  The integral
barrier acts on a joint as a spring of 2 w/k^2 at e1 = 0, whatever K2 and kf are: on a joint of
small inertia a sampled loop needs a small weight.

That is the law as `printed`.  Its proof drops 1/2 e2^T M0' e2; the `corrected` variant has C0 alpha
in place of C0 q', which cancels that term by skew symmetry, and then the claim of Theorem 2 is
exact.

**Decays.**  The gain k1 may depend on the time and on V1, k1(t, V1) >= k1 (`decays`), and then
V1' <= -rate(k1(t, V1)) V1 + s . e2.  The second step has a decay of its own, of the energy
W = 1/2 e2^T M0 e2 with a gain k2(t, W) that all joints share:

    tau = ... - k2(t, W) M0 e2,   W' = -2 k2(t, W) W - e2^T K2 e2 + e2 . f_tilde - w s . e2    (D.1)

in the corrected variant, because e2^T (k2 M0 e2) = 2 k2 W.  V = sum w V1 + W then obeys

    V' <= -sum w rate(k1(t, V1)) V1 - 2 (mu + k2(t, W)) W + e2 . f_tilde,  mu = lambda_min(M0^-1 K2)

With a decay of finite, fixed or prescribed time in both steps, so does V.

**A full matrix as gain.**  With `gain_matrix` K the feedback is -K K2 e2 and W' contains
-e2^T K K2 e2, which the symmetric part of K K2 determines.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.barriers import Barrier, Integral
from iblf_jax.control.barriers._base import guard_is_active
from iblf_jax.control.controllers._base import Command, LawContext, RobotLaw, decay_of
from iblf_jax.control.decays import Decay
from iblf_jax.control.decays._base import (
    energy_gain,
    gain_at,
)
from iblf_jax.core import checks
from iblf_jax.core.linalg import inner, matvec
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.world.bounds import Tube
from iblf_jax.world.robots import inverse_dynamics, momentum

VARIANTS = ("printed", "corrected")


def weight_units(law: Any) -> dict[str, str]:
    """`leaf_units` of a law with a barrier: the weight w has a unit for which w s is a torque."""
    return {"weight": "N m/rad" if law.barrier.value_unit == "rad^2" else "N m rad"}


ROOT_OF_ENERGY = "N^0.5 m^0.5 rad^0.5"
"""Unit of sqrt(2 W), W = 1/2 e2^T M0 e2."""


def symbols_of_energy(law: Any, field: str, index: int, symbols: Any) -> Any:
    """The units of the symbols in a part of a law whose second decay is that of the energy W."""
    if field != "decays":
        return symbols
    sizes = ("rad" if law.barrier.value_unit == "rad^2" else "1", ROOT_OF_ENERGY)
    return {**symbols, "z": sizes[index]}


@component
class Backstepping(RobotLaw):
    """tau = C0 v + G0 + M0 alpha' - f_hat - K2 e2 - w s,   v = q' (printed) or alpha (corrected).

    It is (3.14) of the paper.

    Args:
      k1: gain of the virtual velocity, () or (n,) [1/s], > 0.
      K2: diagonal of the velocity error's gain, () or (n,) [N m s/rad], > 0; the paper's Theorem 2
        asks for more than 1/2.
      o: margin under the root of kappa (3.7), () or (n,) [1/s^2], > 0, for barriers that compensate
        a moving bound by kappa and for no others; 0.1, the paper's, for these, if not given.
      barrier: any `Barrier`; `Integral()` if not given.
      variant: "printed" or "corrected"; "printed" if not given.
      weight: w of the barrier's V1, () or (n,) [N m rad] ([N m/rad] for a barrier whose V1 is in
        rad^2), > 0; 1, the paper's, if not given.
      decays: a `Decay` of V1 and one of the energy 1/2 e2^T M0 e2; one alone is that of both;
        exponential in k1 and K2 if not given.
      gain_matrix: K of the feedback -K K2 e2, (n, n) [1], for which the symmetric part of K K2 is
        positive definite; with K2 = 1 N m s/rad its entries are those of a full gain.  The unit
        matrix if not given.

    Source: Zhang & Yan 2024, (3.5), (3.14); `corrected` as said at the head of this module.
    """

    k1: Leaf = leaf("1/s", sign="positive")
    K2: Leaf = leaf("N m s/rad", sign="positive")
    o: Leaf = leaf("1/s^2", sign="positive", default=None)
    barrier: Barrier = Integral()
    variant: str = static(default="printed")
    weight: Leaf = leaf("N m rad", sign="positive", default=None)
    decays: tuple[Decay, ...] = ()
    gain_matrix: Leaf = leaf("1", shape="any", default=None)
    factors: ClassVar[tuple[str, ...]] = ("weight",)
    takes_shift: ClassVar[bool] = True
    leaf_units = weight_units
    symbols_of_part = symbols_of_energy

    def check(self) -> None:
        """Raises ValueError for an unknown variant or a matrix that is no gain; completes `o` (0.1,
        the paper's, if the barrier needs one) and `weight`.
        """
        checks.one_of("Backstepping.variant", self.variant, VARIANTS)
        check_barrier(self, "barrier", self.barrier)
        fit_o(self, self.barrier)
        fit_weight(self)
        fit_decays(self, 2)
        if self.gain_matrix is None:
            return
        shape = jnp.shape(self.gain_matrix)
        if len(shape) != 2 or shape[0] != shape[1]:
            words = checks.Words(f"shape {shape}")
            raise checks.fail("Backstepping.gain_matrix", words, "one matrix, shape (n, n)")
        fits = jnp.shape(self.K2) in ((), shape[:1])
        if fits and checks.is_concrete((self.K2, self.gain_matrix)):
            check_definite("Backstepping.gain_matrix", np.asarray(self.full_gain))

    def check_start(self, context: LawContext) -> None:
        """Raises ValueError for a matrix of another number of joints."""
        n = context.model.n
        if self.gain_matrix is not None and len(self.gain_matrix) != n:
            words = checks.Words(f"shape {self.gain_matrix.shape}")
            raise checks.fail("controller.gain_matrix", words, f"one matrix, shape ({n}, {n})")

    def advice(self) -> list[str]:
        """What is lost of Theorem 2 where the printed law, whose weight is 1, has a gain outside
        its conditions.  For the corrected law the claim with weights, which holds for every K2 > 0,
        takes its place.
        """
        gains = (self.K2, self.weight, self.gain_matrix)
        if self.variant == "corrected" or not checks.is_concrete(gains):
            return []
        is_papers = np.asarray(self.weight) == 1.0
        if not np.any(is_papers & (np.asarray(self.least_gain) <= 0.5)):
            return []
        need = "Theorem 2 needs K2 > 1/2 on every joint, condition (3.17) of the paper"
        lost = "Below it the paper's bound on V2 is not proven"
        rest = (
            'with variant="corrected" and observers.Momentum, ij.certify computes another bound,'
            ' its claim "weighted", which holds for every K2 > 0'
        )
        gain = f"controller.K2 = {self.K2}"
        if self.gain_matrix is not None:
            gain = f"the least eigenvalue of K K2 is {self.least_gain[0]:.4g} N m s/rad"
        return [f"{gain}: {need}. {lost}; {rest}."]

    def feedback(self, e2: jax.Array) -> jax.Array:
        """K K2 e2, (n,) [N m]."""
        if self.gain_matrix is None:
            return self.K2 * e2
        return matvec(self.gain_matrix, self.K2 * e2)

    @property
    def full_gain(self) -> jax.Array:
        """K K2, (n, n), or K2, (n,), without a matrix [N m s/rad]."""
        return self.K2 if self.gain_matrix is None else self.gain_matrix * self.K2

    @property
    def least_gain(self) -> jax.Array:
        """K2, or for each joint the least eigenvalue of the symmetric part of K K2, of which
        e2^T K K2 e2 is at least |e2|^2 times; (n,) [N m s/rad].
        """
        full = self.full_gain
        if self.gain_matrix is None:
            return full
        least = jnp.linalg.eigvalsh(0.5 * (full + full.T))[0]
        return jnp.full(len(full), least)

    def command(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_hat: jax.Array,
        context: LawContext,
        state: tuple[()],
    ) -> tuple[Command, tuple[()]]:
        """The torque (3.14) and what belongs to it."""
        alpha, dalpha = alpha_and_rate(self, t, q, dq, context)
        tube = context.tube(t)
        v = alpha if self.variant == "corrected" else dq
        feedforward = inverse_dynamics(context.model, q, dq, v, dalpha)
        tau = feedforward - f_hat - self.feedback(dq - alpha)
        tau = tau - self.weight * self.barrier.slope(tube, q)
        tau = with_energy_decay(self, t, q, dq - alpha, context, tau)
        command = barrier_command(self, tube, q, alpha, tau)
        return command._replace(input_slope=dq - alpha), ()

    def energy(self, t: jax.Array, q: jax.Array, dq: jax.Array, context: LawContext) -> jax.Array:
        """V1 + 1/2 e2^T M0 e2, () [N m rad]."""
        e2 = dq - virtual_velocity(self, t, q, context)
        V1 = self.weight * self.barrier.value(context.tube(t), q)
        return jnp.sum(V1) + 0.5 * inner(e2, momentum(context.model, q, e2))

    def energy_decay(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, context: LawContext
    ) -> jax.Array:
        """The decay of V1, which is 0 for a barrier that states none, + e2^T K K2 e2, ()
        [N m rad/s], of the corrected variant.
        """
        e2 = dq - virtual_velocity(self, t, q, context)
        V1 = self.weight * self.barrier.value(context.tube(t), q)
        return jnp.sum(stated_decay(self.barrier, self.k1, V1)) + inner(e2, self.feedback(e2))


def barrier_command(law, tube: Tube, q: jax.Array, alpha: jax.Array, tau: jax.Array) -> Command:
    """The command of a law with `barrier` and `weight` that cuts no torque: V1 is w times the
    barrier's.
    """
    guard_active = guard_is_active(tube, q, law.barrier.guard)
    V1 = law.weight * law.barrier.value(tube, q)
    return Command(tau, alpha, V1, guard_active, jnp.zeros_like(guard_active))


def stated_decay(barrier: Barrier, gain: jax.Array, V: jax.Array) -> jax.Array:
    """The decay of V, (n,), that a barrier states for a gain; 0 for one that states none."""
    rate = barrier.decay_rate(gain)
    if rate is None:
        return jnp.zeros_like(V)
    return rate * V  # type: ignore[no-any-return]


def check_barrier(law, field: str, barrier: object, example: str = "Integral") -> None:
    """Raises ValueError unless a field of a law holds a barrier."""
    name = f"{type(law).__name__}.{field}"
    checks.conforms(name, barrier, Barrier, f"Such as iblf_jax.barriers.{example}().")


def check_definite(field: str, matrix: np.ndarray) -> None:
    """Raises ValueError unless the symmetric part of a matrix is positive definite."""
    smallest = np.min(np.linalg.eigvalsh(0.5 * (matrix + matrix.T)))
    if smallest <= 0.0:
        got = f"a matrix whose symmetric part has the eigenvalue {smallest:.4g}"
        raise checks.fail(field, checks.Words(got), "a positive definite symmetric part")


def fit_o(law, *barriers: Barrier, like: jax.Array | None = None) -> None:
    """Fits `o` of a law under construction to its barriers: 0.1, the paper's, if one of them needs
    it and none was given; of the shape of `like`, which is k1 if not given.

    Raises:
      ValueError: an `o` for barriers of which none has a kappa.
    """
    uses_o = any(barrier.uses_o for barrier in barriers)
    if uses_o and law.o is None:
        shape_of = law.k1 if like is None else like
        object.__setattr__(law, "o", jnp.full_like(shape_of, 0.1))
    if not uses_o and law.o is not None:
        names = " and ".join(type(barrier).__name__ for barrier in barriers)
        expected = f"None with the barrier {names}"
        remedy = "That barrier has no kappa; leave `o` out."
        if len(barriers) > 1:
            remedy = "Neither has a kappa; leave `o` out."
        raise checks.fail(f"{type(law).__name__}.o", law.o, expected, remedy)


def fit_weight(law) -> None:
    """Gives a law under construction the paper's weight of the barrier, 1, if none was given."""
    if law.weight is None:
        object.__setattr__(law, "weight", jnp.full_like(law.k1, 1.0))


def fit_decays(law, count: int) -> None:
    """Fits `decays` of a law under construction to its levels: a single decay is that of each.

    Raises:
      ValueError: something that is no decay, or another number of them.
    """
    name = f"{type(law).__name__}.decays"
    decays = law.decays
    if not isinstance(decays, tuple | list):
        decays = (decays,)
    for i, decay in enumerate(decays):
        remedy = "Such as iblf_jax.decays.FiniteTime(k_a=2.0)."
        checks.conforms(f"{name}[{i}]", decay, Decay, remedy)
    if len(decays) == 1:
        decays = tuple(decays) * count
    if len(decays) not in (0, count):
        remedy = "decays.Exponential() is for a level with a constant gain."
        expected = f"{count} decays, one a level, or one for all"
        raise checks.fail(name, f"{len(decays)} decays", expected, remedy)
    object.__setattr__(law, "decays", tuple(decays))


def with_energy_decay(
    law, t: jax.Array, q: jax.Array, e2: jax.Array, context: LawContext, tau: jax.Array
) -> jax.Array:
    """A torque with the decay of the energy W of e2 added, tau - k2(t, W) M0 e2, (n,) [N m]; (D.1).

    Args:
      law: with `decays`.
      t: time, () [s].
      q, e2: position [rad] and velocity error [rad/s], (n,).
      context: its model is used.
      tau: torque, (n,) [N m].
    """
    decay = decay_of(law, 1)
    if decay.constant:
        return tau
    of_error = momentum(context.model, q, e2)
    return tau - energy_gain(decay, t, 0.5 * inner(e2, of_error), e2) * of_error


def virtual_velocity(law, t: jax.Array, q: jax.Array, context: LawContext) -> jax.Array:
    """The virtual velocity alpha, (n,) [rad/s], of a law with `barrier`, `k1` and `o`, with or
    without `decays`.
    """
    tube = context.tube(t, acceleration=False)
    k1 = gain_at(decay_of(law, 0), t, law.k1, law.barrier, tube, q)
    return law.barrier.virtual_velocity(tube, q, k1, law.o)


def alpha_and_rate(
    law, t: jax.Array, q: jax.Array, dq: jax.Array, context: LawContext
) -> tuple[jax.Array, jax.Array]:
    """Virtual velocity [rad/s] and its total time derivative alpha' [rad/s^2] along q', each (n,),
    for a law with `barrier`, `k1`, `o`; with the context's shift.
    """

    def alpha_at(t, q):
        return virtual_velocity(law, t, q, context)

    return context.shifted(*jax.jvp(alpha_at, (t, q), (jnp.ones_like(t), dq)))
