"""A network with one hidden layer, both of whose layers adapt, with a barrier: no model, no
observer.

    tau = W_hat^T phi(V_hat^T z) - K2 e2 - w s,   phi = tanh, entry by entry,

where z, (4n + 1,), holds (q, q', alpha, alpha') over their spans, and a 1 for the thresholds of the
hidden layer.  With phi_hat = phi(V_hat^T z), its slope D = diag(1 - phi_hat^2), the function to
learn F = M alpha' + C alpha + G - f = W^T phi(V^T z) + epsilon, and W_tilde = W_hat - W,
V_tilde = V_hat - V,

    W_hat^T phi_hat - F = W_tilde^T (phi_hat - D V_hat^T z) + W_hat^T D V_tilde^T z + r,     (H.1)
    r = W_tilde^T D V^T z - W^T (phi(V^T z) - phi_hat + D V_tilde^T z) - epsilon,

which is an identity.  The rates cancel the terms that are linear in the errors of the weights,

    W_hat' = -Gamma ((phi_hat - D V_hat^T z) e2^T + sigma W_hat),
    V_hat' = -Gamma_h (z (D W_hat e2)^T + sigma_h (V_hat - V_0)),                            (H.2)

with V_0 = V_hat(0), so that V1 + 1/2 e2^T M e2 + 1/2 sum_i |W_tilde_i|^2/Gamma_i
+ |V_tilde|^2/(2 Gamma_h) has the rate

    <= -(decay of V1) - e2^T K2 e2 + e2 . r - sum_i sigma_i/2 (|W_tilde_i|^2 - |W_i|^2)
       - sigma_h/2 (|V_tilde|^2 - |V - V_0|^2).                                              (H.3)

**Claim.**  r is bounded while z and the weights are, so that e1 and e2 are ultimately bounded as
long as the motion stays in the range on which F is approximated.  It is a local claim, and weaker
than that of a network that is linear in its weights, whose r has epsilon alone.  `certify` has no
line for it, because W, V and epsilon are unknown.

**Bounded weights.**  The entries of phi_hat - D V_hat^T z, tanh x - x/cosh^2 x, lie between -1 and
1, so that the leak bounds column i by |W_hat_i| <= sqrt(nodes) sup|e2_i| / sigma_i in every case,
and |V_hat - V_0| <= sup |z| |W_hat e2| / sigma_h.

**Start.**  W_hat(0) = 0.  The columns of V_0 are points of a Sobol sequence in [-1, 1]^(4n+1),
because with equal columns, or with V_0 = 0, the nodes would remain equal.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers import Barrier, Log
from iblf_jax.control.controllers._base import Command, LawContext, RobotLaw
from iblf_jax.control.controllers.adaptive_rbf import scaled_input, sobol_centres
from iblf_jax.control.controllers.backstepping import (
    alpha_and_rate,
    barrier_command,
    check_barrier,
    fit_o,
    fit_weight,
    weight_units,
)
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf, static


class NetworkWeights(NamedTuple):
    """State of `AdaptiveNetwork`."""

    output: jax.Array
    """W_hat, (nodes, n) [N m]."""
    hidden: jax.Array
    """V_hat, (4n + 1, nodes) [1]; the last row has the thresholds."""


@component
class AdaptiveNetwork(RobotLaw):
    """tau = W_hat^T tanh(V_hat^T z) - K2 e2 - w s, with the rates (H.2) of both layers.

    s and alpha are the barrier's; no model is used, and f_hat is not.  The state is a
    `NetworkWeights`; symbols at the head of this module.

    Args:
      k1: gain of the virtual velocity, () or (n,) [1/s], > 0.
      K2: diagonal of the velocity error's gain, () or (n,) [N m s/rad], > 0.
      o: as `Backstepping.o`, () or (n,) [1/s^2], > 0; 0.1 for a barrier that needs it, if not
        given.
      Gamma: rate of adaptation of the output weights of each joint, () or (n,) [N m/rad], > 0; 50
        if not given.
      Gamma_h: rate of adaptation of the hidden weights, () [1/(N m rad)], >= 0, where 0 leaves the
        hidden layer as it starts; 5 if not given.
      sigma: leak that bounds the output weights, () or (n,) [rad/(N m s)], > 0; 0.001 if not given.
      sigma_h: leak of the hidden weights towards their start, () [N m rad/s], > 0; 0.01 if not
        given.
      middle: position at the centre of the inputs' range, () or (n,) [rad]; 0.5 if not given.
      span_q: half the range of q, () or (n,) [rad], > 0; 0.5 if not given.
      span_dq: half the range of q' and alpha, () or (n,) [rad/s], > 0; 1 if not given.
      span_ddq: half the range of alpha', () or (n,) [rad/s^2], > 0; 3 if not given.
      barrier: any `Barrier`; `Log()` if not given.
      nodes: number of hidden nodes, a whole number; 10 if not given.
      weight: w of the barrier's V1, () or (n,) [N m rad] ([N m/rad] for a barrier whose V1 is in
        rad^2), > 0; 1, the paper's, if not given.

    Source: F. L. Lewis, A. Yesildirek, K. Liu, IEEE Trans. Neural Networks 7 (1996) 388-399 (rates
      of both layers, there with a leak that grows with |e2|); with barriers, and with a constant
      leak, as derived at the head of this module; numbers of this package.
    """

    k1: Leaf = leaf("1/s", sign="positive")
    K2: Leaf = leaf("N m s/rad", sign="positive")
    o: Leaf = leaf("1/s^2", sign="positive", default=None)
    Gamma: Leaf = leaf("N m/rad", sign="positive", default=50.0)
    Gamma_h: Leaf = leaf("1/(N m rad)", sign="nonnegative", shape="scalar", default=5.0)
    sigma: Leaf = leaf("rad/(N m s)", sign="positive", default=0.001)
    sigma_h: Leaf = leaf("N m rad/s", sign="positive", shape="scalar", default=0.01)
    middle: Leaf = leaf("rad", default=0.5)
    span_q: Leaf = leaf("rad", sign="positive", default=0.5)
    span_dq: Leaf = leaf("rad/s", sign="positive", default=1.0)
    span_ddq: Leaf = leaf("rad/s^2", sign="positive", default=3.0)
    barrier: Barrier = Log()
    nodes: int = static(default=10)
    weight: Leaf = leaf("N m rad", sign="positive", default=None)
    factors: ClassVar[tuple[str, ...]] = ("weight",)
    uses_observer: ClassVar[bool] = False
    takes_shift: ClassVar[bool] = True
    leaf_units = weight_units

    def check(self) -> None:
        """Raises ValueError for a bad barrier or number of nodes; completes `o` and `weight`."""
        checks.positive_integer("AdaptiveNetwork.nodes", self.nodes, most=checks.MAX_ENTRIES)
        check_barrier(self, "barrier", self.barrier, "Log")
        fit_o(self, self.barrier)
        fit_weight(self)

    def init(self, q: jax.Array, dq: jax.Array, context: LawContext) -> NetworkWeights:
        """W_hat(0) = 0 and V_hat(0) = V_0."""
        output = jnp.zeros((self.nodes, q.size), q.dtype)
        return NetworkWeights(output, self._first_hidden(4 * q.size + 1, q.dtype))

    def _first_hidden(self, inputs: int, dtype: jax.typing.DTypeLike) -> jax.Array:
        """V_0, (inputs, nodes)."""
        return jnp.asarray(sobol_centres(self.nodes, inputs).T, dtype)

    def command(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_hat: jax.Array,
        context: LawContext,
        state: NetworkWeights,
    ) -> tuple[Command, NetworkWeights]:
        """The torque, what belongs to it, and the rates of both layers."""
        alpha, dalpha = alpha_and_rate(self, t, q, dq, context)
        tube, e2 = context.tube(t), dq - alpha
        scaled = scaled_input(self, q, dq, alpha, dalpha)
        z = jnp.concatenate([scaled, jnp.ones_like(scaled[:1])])
        activation = jnp.sum(z[:, None] * state.hidden, axis=0)
        phi = jnp.tanh(activation)
        slope = 1.0 - phi**2
        learned = jnp.sum(phi[:, None] * state.output, axis=0)
        tau = learned - self.K2 * e2 - self.weight * self.barrier.slope(tube, q)
        regressor = phi - slope * activation
        rate = -self.Gamma * (regressor[:, None] * e2 + self.sigma * state.output)
        hidden_error = slope * jnp.sum(state.output * e2, axis=1)
        departure = state.hidden - self._first_hidden(z.size, z.dtype)
        hidden_rate = -self.Gamma_h * (z[:, None] * hidden_error + self.sigma_h * departure)
        command = barrier_command(self, tube, q, alpha, tau)._replace(input_slope=e2)
        return command, NetworkWeights(rate, hidden_rate)
