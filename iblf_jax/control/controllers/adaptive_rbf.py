"""Adaptive radial-basis network with a barrier: no model, no observer, weights that are part of the
loop's state.

What the backstepping law takes from the model, M0 alpha' + C0 alpha + G0 - f, a network of
Gaussians learns while it runs:

    W_hat^T S(Z),   S_j(Z) = exp(-|z - c_j|^2 / width^2),   Z = (q, q', alpha, alpha'),
    z = ((q - middle)/span_q, q'/span_dq, alpha/span_dq, alpha'/span_ddq),
    W_hat' = Gamma (-S(Z) e2^T - sigma W_hat),   W_hat(0) = 0.

The sigma-modification bounds the weights in every case: as |S| <= sqrt(nodes), the column of joint
i obeys |W_hat_i| <= sqrt(nodes) sup|e2_i| / sigma.  The literature places the centres on a lattice,
which in the 4n dimensions of Z has nodes^(4n) points; here they are a fixed number of points of a
Sobol sequence in the box [-1, 1]^(4n).

**Fuzzy system.**  With `normalised`, S_j(Z)/sum_i S_i(Z) takes the place of S_j(Z).  That is a
fuzzy system: rule j is "if z_1 is near c_j1 and ... and z_4n is near c_j4n, the torque is
W_hat_j", with Gaussian membership functions, product inference, singleton consequents and the
weighted mean of the rules.  Its basis sums to 1, so that the torque is a mean of the rows of W_hat,
also between and beyond the centres, where Gaussians fade out.  The derivation of W_hat' does not
depend on the basis, and |S| <= 1 gives |W_hat_i| <= sup|e2_i| / sigma.  With one rule it is the
integral of e2 with a leak, W_hat' = -Gamma (e2 + sigma W_hat).  The speed of adaptation is
Gamma |S|^2, which the division makes smaller: Gamma is larger than without it.

**Claim.**  With F = M alpha' + C alpha + G - f = W^T S(Z) + epsilon and W_tilde = W_hat - W,

    V = V1 + 1/2 e2^T M e2 + 1/2 sum_i |W_tilde_i|^2/Gamma_i,
    V' <= -(decay of V1) - e2^T K2 e2 - e2 . epsilon - sum_i sigma_i/2 (|W_tilde_i|^2 - |W_i|^2):

e1, e2 and the weights are ultimately bounded as long as Z stays where epsilon is bounded.  W and
epsilon are unknown, so that `certify` has no line for it.

ASSUMPTION: the source's own node count, centres and gains could not be found; all numbers here are
  this package's.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.barriers import Barrier, Log
from iblf_jax.control.controllers._base import Command, LawContext, RobotLaw
from iblf_jax.control.controllers.backstepping import (
    alpha_and_rate,
    barrier_command,
    check_barrier,
    fit_o,
    fit_weight,
    weight_units,
)
from iblf_jax.core import checks
from iblf_jax.core.caches import memoised
from iblf_jax.core.pytree import Leaf, component, leaf, static


@component
class AdaptiveRBF(RobotLaw):
    """tau = -w s - K2 e2 + W_hat^T S(Z),   W_hat' = Gamma (-S(Z) e2^T - sigma W_hat).

    s and alpha are the barrier's; no model is used, and f_hat is not.  The state is W_hat, (nodes,
    n) [N m].

    Args:
      k1: gain of the virtual velocity, () or (n,) [1/s], > 0.
      K2: diagonal of the velocity error's gain, () or (n,) [N m s/rad], > 0.
      o: as `Backstepping.o`, () or (n,) [1/s^2], > 0; 0.1 for a barrier that needs it, if not
        given.
      Gamma: rate of adaptation of each joint's weights, () or (n,) [N m/rad], > 0; 20 if not given.
      sigma: leak that bounds the weights, () or (n,) [rad/(N m s)], > 0; what it forgets stays as
        an error; 0.005 if not given.
      middle: position at the centre of the nodes' box, () or (n,) [rad]; 0.5 if not given.
      span_q: half the box in q, () or (n,) [rad], > 0; 0.5 if not given.
      span_dq: half the box in q' and alpha, () or (n,) [rad/s], > 0; 1 if not given.
      span_ddq: half the box in alpha', () or (n,) [rad/s^2], > 0; 3 if not given.
      width: width of the Gaussians in half boxes, () [1], > 0; 2 if not given.
      barrier: any `Barrier`; `Log()` if not given.
      nodes: number of Gaussians, a whole number; 64 if not given.
      normalised: whether the Gaussians are divided by their sum, so that the network is a fuzzy
        system (head of this module); False if not given.
      weight: w of the barrier's V1, () or (n,) [N m rad] ([N m/rad] for a barrier whose V1 is in
        rad^2), > 0; 1, the paper's, if not given.

    Source: Y. J. Liu, S. Lu, S. Tong, IEEE Trans. Syst. Man Cybern. Syst. 47 (2017) 2060-2068;
      L. X. Wang, IEEE Trans. Fuzzy Systems 1 (1993) 146-155 (normalised: fuzzy basis functions);
      the numbers are those of this package.
    """

    k1: Leaf = leaf("1/s", sign="positive")
    K2: Leaf = leaf("N m s/rad", sign="positive")
    o: Leaf = leaf("1/s^2", sign="positive", default=None)
    Gamma: Leaf = leaf("N m/rad", sign="positive", default=20.0)
    sigma: Leaf = leaf("rad/(N m s)", sign="positive", default=0.005)
    middle: Leaf = leaf("rad", default=0.5)
    span_q: Leaf = leaf("rad", sign="positive", default=0.5)
    span_dq: Leaf = leaf("rad/s", sign="positive", default=1.0)
    span_ddq: Leaf = leaf("rad/s^2", sign="positive", default=3.0)
    width: Leaf = leaf("1", sign="positive", shape="scalar", default=2.0)
    barrier: Barrier = Log()
    nodes: int = static(default=64)
    normalised: bool = static(default=False)
    weight: Leaf = leaf("N m rad", sign="positive", default=None)
    factors: ClassVar[tuple[str, ...]] = ("weight",)
    uses_observer: ClassVar[bool] = False
    takes_shift: ClassVar[bool] = True
    leaf_units = weight_units

    def check(self) -> None:
        """Raises ValueError for a bad barrier or number of nodes; completes `o` and `weight`."""
        checks.positive_integer("AdaptiveRBF.nodes", self.nodes, most=checks.MAX_ENTRIES)
        check_barrier(self, "barrier", self.barrier, "Log")
        fit_o(self, self.barrier)
        fit_weight(self)

    def init(self, q: jax.Array, dq: jax.Array, context: LawContext) -> jax.Array:
        """W_hat(0) = 0, (nodes, n) [N m]."""
        return jnp.zeros((self.nodes, q.size), q.dtype)

    def basis(self, q: jax.Array, dq: jax.Array, alpha: jax.Array, dalpha: jax.Array) -> jax.Array:
        """S(Z), (nodes,) [1]."""
        z = scaled_input(self, q, dq, alpha, dalpha)
        offset = z - jnp.asarray(sobol_centres(self.nodes, z.size), z.dtype)
        squares = jnp.sum(offset**2, axis=1)
        if not self.normalised:
            return jnp.exp(-squares / self.width**2)
        # The largest one is 1, so that the sum does not vanish far from all centres.
        S = jnp.exp((jnp.min(squares) - squares) / self.width**2)
        return S / jnp.sum(S)

    def command(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_hat: jax.Array,
        context: LawContext,
        state: jax.Array,
    ) -> tuple[Command, jax.Array]:
        """The torque, what belongs to it, and W_hat'."""
        alpha, dalpha = alpha_and_rate(self, t, q, dq, context)
        tube, e2 = context.tube(t), dq - alpha
        S = self.basis(q, dq, alpha, dalpha)
        learned = jnp.sum(S[:, None] * state, axis=0)
        tau = learned - self.K2 * e2 - self.weight * self.barrier.slope(tube, q)
        command = barrier_command(self, tube, q, alpha, tau)._replace(input_slope=e2)
        return command, -self.Gamma * (S[:, None] * e2 + self.sigma * state)


def scaled_input(
    law: Any, q: jax.Array, dq: jax.Array, alpha: jax.Array, dalpha: jax.Array
) -> jax.Array:
    """The input z of a network, Z relative to its spans, (4n,) [1], of a law with `middle`,
    `span_q`, `span_dq`, `span_ddq`.
    """
    position = (q - law.middle) / law.span_q
    rates = [dq / law.span_dq, alpha / law.span_dq, dalpha / law.span_ddq]
    return jnp.concatenate([position, *rates])


@memoised(16)
def sobol_centres(nodes: int, dimensions: int) -> np.ndarray:
    """The first `nodes` points of the unscrambled Sobol sequence, centred in their cells, in [-1,
    1]^dimensions.
    """
    from scipy.stats import qmc

    order = math.ceil(math.log2(nodes))
    points = qmc.Sobol(dimensions, scramble=False).random_base2(order)[:nodes]
    return 2.0 * (points + 0.5 / 2**order) - 1.0
