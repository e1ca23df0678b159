"""Parameters of the model that adapt while the law runs.

The law uses estimates theta_hat of some parameters of its model, such as masses, in the place of
the model's values.  Where the torque is affine in them, tau(theta_hat) = tau(theta) + Y theta_tilde
with theta_tilde = theta_hat - theta and the regressor Y = dtau/dtheta, which automatic
differentiation gives.  With V of the wrapped law for the true parameters theta and its derivative
along the input, s = dV/dx_r G_r (e2 for a robot),

    V_a = V + 1/2 theta_tilde^T Gamma^-1 theta_tilde,                                        (R.1)
    V_a' = -W + s . (Y theta_tilde + d) + theta_tilde^T Gamma^-1 theta_hat',

where W is the decay of V and d is what the model with the true parameters does not explain.  The
law of adaptation is the negative gradient of s . tau, a leak, and a projection P,

    theta_hat' = P(-Gamma (Y^T s + sigma (theta_hat - theta_0))),   theta_hat(0) = theta_0,  (R.2)

with theta_0 the values of the model.  Y theta_tilde cancels, and

    V_a' <= -W - sigma/2 |theta_tilde|^2 + s . d + sigma/2 |theta - theta_0|^2.              (R.3)

For d = 0 and sigma = 0, V_a does not grow and e1, e2 tend to 0; theta_hat tends to theta only if
the motion makes the parameters identifiable.  With sigma > 0 everything is ultimately bounded.

**Projection.**  P scales the rate of an estimate down to 0 within `band` of the bound that it moves
to, so that lower <= theta_hat <= upper and the rate is continuous.  It does not increase V_a where
lower + band <= theta <= upper - band.

**Which laws.**  In the robot's equation M e2' is what the torque changes, so that the inertia need
not be inverted: `Backstepping` in the corrected variant adapts all parameters in which M, C and G
are linear.  `BarrierBackstepping` inverts the gain G_r.  It adapts parameters of the last level,
f_r, on plants of any order, and refuses those of G_r and of the levels below, whose estimates the
virtual controls would have to differentiate.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from iblf_jax.control.controllers._base import (
    Command,
    LawContext,
    State,
    TrackingLaw,
    Wrapping,
    check_law,
    contract_of,
    decay_of,
    layers_with_states,
)
from iblf_jax.core import checks
from iblf_jax.core.component_paths import member_of, replaced, resolve
from iblf_jax.core.families import is_default
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.core.units import PlantUnit, of_entry
from iblf_jax.world import plants

SHARE_OF_BAND = 0.05
"""Width of the projection's band in that of the box, if none is given."""
POINTS = 8
"""Number of states at which `check_start` examines the dependence on the parameters."""
THETA = "theta"
"""Symbol of the units of the parameters, one for each."""
BOUNDS = ("lower", "upper", "band")


class AdaptiveState(NamedTuple):
    """State of `AdaptiveParameters`."""

    theta: jax.Array
    """theta_hat, (p,)."""
    law: Any
    """State of the wrapped law."""


@component
class AdaptiveParameters(Wrapping):
    """theta_hat' = P(-Gamma (Y^T s + sigma (theta_hat - theta_0))),   Y = dtau/dtheta,   s = e2 for
    a robot.

    The wrapped law commands with theta_hat in the model; symbols at the head of this module.  The
    estimate of an observer is not used.  Paths reach through: "controller.K2" is the wrapped law's
    K2.  The state is an `AdaptiveState`: `run.controller_state.theta` has theta_hat of a run.

    In units, theta stands for that of the parameter, and N m rad for that of V.

    Args:
      law: the law whose model adapts: `Backstepping` with variant="corrected", or
        `BarrierBackstepping` without filters.
      parameters: paths of p numbers of the model, without "model.": ("mass[0]", "payload").
      Gamma: rate of adaptation of each parameter, () or (p,) [theta^2/(N m rad)], > 0.
      lower: lower bound of each estimate, () or (p,) [theta].
      upper: upper bound of each estimate, () or (p,) [theta].
      sigma: leak towards the model's values, () or (p,) [N m rad/(theta^2 s)], >= 0; 0 if not
        given.
      band: distance from a bound within which the projection acts, () or (p,) [theta], > 0; a
        twentieth of the box if not given.

    Source: J. J. E. Slotine, W. Li, Int. J. Robotics Research 6 (1987) 49-59 (regressor);
      P. A. Ioannou, J. Sun, Robust Adaptive Control, 1996, sections 4.4 and 8.5 (projection, leak);
      with barriers as derived at the head of this module.
    """

    law: TrackingLaw
    parameters: tuple[str, ...] = static()
    Gamma: Leaf = leaf(
        PlantUnit("theta^2/(N m rad)", "theta^2/energy"), sign="positive", shape="any"
    )
    lower: Leaf = leaf(PlantUnit(THETA, THETA), shape="any")
    upper: Leaf = leaf(PlantUnit(THETA, THETA), shape="any")
    sigma: Leaf = leaf(
        PlantUnit("N m rad/(theta^2 s)", "energy/(theta^2 s)"),
        sign="nonnegative",
        shape="any",
        default=0.0,
    )
    band: Leaf = leaf(PlantUnit(THETA, THETA), sign="positive", shape="any", default=None)
    uses_observer: ClassVar[bool] = False

    def check(self) -> None:
        """Raises ValueError for a law that states no slope, or numbers that do not fit the
        parameters; completes `band` and repeats single numbers.
        """
        check_law("AdaptiveParameters.law", self.law, LAWS)
        self._check_law()
        names = self.parameters
        are_paths = isinstance(names, tuple | list) and all(isinstance(x, str) for x in names)
        if not names or not are_paths:
            expected = 'a tuple of paths, such as ("mass[0]", "payload")'
            raise checks.fail("AdaptiveParameters.parameters", names, expected)
        if len(set(names)) < len(names):
            raise checks.fail("AdaptiveParameters.parameters", names, "different paths")
        for name in ("Gamma", "lower", "upper", "sigma"):
            self._repeat(name)
        if self.band is None:
            object.__setattr__(self, "band", SHARE_OF_BAND * (self.upper - self.lower))
        self._repeat("band")
        if not checks.is_concrete((self.lower, self.upper, self.band)):
            return
        width = np.asarray(self.upper - self.lower)
        if not np.all(width > 0):
            expected = f"more than lower = {self.lower}"
            raise checks.fail("AdaptiveParameters.upper", self.upper, expected)
        if not np.all(2.0 * np.asarray(self.band) < width):
            expected = "less than half of upper - lower"
            raise checks.fail("AdaptiveParameters.band", self.band, expected)

    def _check_law(self) -> None:
        """Raises ValueError for a law whose Lyapunov function does not contain the torque's error
        as `input_slope` states.
        """
        law: Any = self.law
        field = "AdaptiveParameters.law"
        base = contract_of(law)
        stated = ((law.energy, base.energy), (law.energy_decay, base.energy_decay))
        if any(is_default(own, default) for own, default in stated):
            raise checks.fail(
                field, type(law).__name__, "a law that states `energy` and `energy_decay`", LAWS
            )
        if law.variant == "printed":
            remedy = "With C0 q' the term 1/2 e2^T M0' e2 remains. Take variant=\"corrected\"."
            raise checks.fail(f"{field}.variant", "printed", "corrected", remedy)
        second = decay_of(law, 1)
        if law.variant and not second.constant:
            remedy = "The energy of the second step contains the parameters, so that the torque is"
            remedy += " not affine in them."
            name = type(second).__name__
            raise checks.fail(f"{field}.decays[1]", name, "Exponential()", remedy)
        if law.filter is not None:
            expected = "exact derivatives"
            remedy = "The lag of filters leaves a term in V'. Leave `filter` out."
            raise checks.fail(f"{field}.filter", law.filter, expected, remedy)

    def _repeat(self, name: str) -> None:
        """Repeats a single number for all parameters; ValueError for another number of them."""
        value, count = vars(self)[name], len(self.parameters)
        if jnp.shape(value) not in ((), (count,)):
            expected = f"one number, or {count}, one for each parameter"
            raise checks.fail(f"AdaptiveParameters.{name}", value, expected)
        object.__setattr__(self, name, jnp.broadcast_to(value, (count,)))

    def unit_symbols(self, model: Any) -> dict[str, tuple[str, ...]]:
        """The units of the parameters, one for each, as the symbol theta."""
        units = []
        for path in self.parameters:
            try:
                units.append(_unit_at(model, resolve(model, path)[0]))
            except LookupError:
                units.append("1")
        return {THETA: tuple(units)}

    # --- checks against a scenario ----------------------------------------------------------------

    def check_start(self, context: LawContext) -> None:
        """Raises ValueError for paths that lead to no number of the model, values outside the box,
        or parameters for which (R.3) does not hold.
        """
        nominal = np.asarray(self._nominal(context.model))
        for j, path in enumerate(self.parameters):
            low, high = float(self.lower[j]), float(self.upper[j])
            if not low <= nominal[j] <= high:
                expected = f"between {low:g} and {high:g}, the box of AdaptiveParameters"
                raise checks.fail(f"model.{path}", float(nominal[j]), expected)
        self._check_dependence(context)

    def _check_dependence(self, context: LawContext) -> None:
        """Raises ValueError for a parameter in which the torque is not affine, on which
        the virtual controls or the slope of V depend, or that has no effect.
        """
        t, x = _points(context, self.Gamma.dtype)
        torque, others = (np.asarray(part) for part in _dependence(self, context, t, x))
        scale = np.sqrt(np.finfo(torque.dtype).eps)
        for j, path in enumerate(self.parameters):
            field = f"controller.parameters[{j}]"
            rows = torque[..., j]
            largest = np.nanmax(np.abs(rows))
            if largest == 0.0:
                expected = "a parameter that changes the torque of the law"
                raise checks.fail(field, path, expected)
            if np.nanmax(np.abs(others[..., j])) > 0.0:
                expected = "a parameter of the last level that its gain does not contain"
                remedy = (
                    "Virtual controls and V contain this one. For a robot take Backstepping with"
                    ' variant="corrected".'
                )
                raise checks.fail(field, path, expected, remedy)
            if np.nanmax(np.abs(rows - rows[0])) > scale * largest:
                expected = "a parameter in which the torque is affine"
                remedy = "Masses and inertias are such, lengths are not."
                raise checks.fail(field, path, expected, remedy)

    def _nominal(self, model: object) -> jax.Array:
        """theta_0, (p,): the values of the model."""
        return _values_at(model, self.parameters)

    def _with_parameters(self, context: LawContext, theta: jax.Array) -> LawContext:
        """The context whose model has these parameters."""
        model = context.model
        for path, value in zip(self.parameters, theta, strict=True):
            model = replaced(model, resolve(model, path)[0], value, path, None)
        return context._replace(model=model)

    # --- the law ----------------------------------------------------------------------------------

    def init(self, x: jax.Array, context: LawContext) -> AdaptiveState:
        """theta_hat(0) = theta_0, and the state of the wrapped law."""
        return AdaptiveState(self._nominal(context.model), self.inner.init(x, context))

    def command(
        self,
        t: jax.Array,
        x: jax.Array,
        d_hat: jax.Array,
        context: LawContext,
        state: AdaptiveState,
    ) -> tuple[Command, AdaptiveState]:
        """The wrapped law's command with theta_hat in its model, and the rates of the states.  The
        estimate is not used.
        """
        command, law_rate, gradient = self._command_and_gradient(t, x, d_hat, context, state)
        rate = self.projected(state.theta, self.unprojected(state.theta, gradient, context))
        return command, AdaptiveState(rate, law_rate)

    def _command_and_gradient(
        self,
        t: jax.Array,
        x: jax.Array,
        d_hat: jax.Array,
        context: LawContext,
        state: AdaptiveState,
    ) -> tuple[Command, Any, jax.Array]:
        """The wrapped law's command and the rate of its state with theta_hat, and Y^T s, (p,)."""
        zero = jnp.zeros_like(d_hat)

        def torque(theta):
            changed = self._with_parameters(context, theta)
            command, rate = self.inner.command(t, x, zero, changed, state.law)
            return command.tau, (command, rate)

        _, pullback, (command, rate) = jax.vjp(torque, state.theta, has_aux=True)
        return command, rate, pullback(command.input_slope)[0]

    def unprojected(self, theta: jax.Array, gradient: jax.Array, context: LawContext) -> jax.Array:
        """-Gamma (Y^T s + sigma (theta_hat - theta_0)), (p,).

        Args:
          theta: theta_hat, (p,).
          gradient: Y^T s, (p,).
          context: its model has theta_0.
        """
        leak = self.sigma * (self._nominal(context.model) - theta)
        return self.Gamma * (leak - gradient)

    def projected(self, theta: jax.Array, rate: jax.Array) -> jax.Array:
        """P(rate), (p,): 0 at the bound that an estimate moves to, unchanged at `band` from it."""
        distance = jnp.where(rate > 0.0, self.upper - theta, theta - self.lower)
        return rate * jnp.clip(distance / self.band, 0.0, 1.0)

    def switching(
        self,
        t: jax.Array,
        x: jax.Array,
        d_hat: jax.Array,
        context: LawContext,
        state: AdaptiveState,
    ) -> jax.Array | None:
        """The functions at whose zeros the wrapped law's command jumps."""
        changed = self._with_parameters(context, state.theta)
        return self.inner.switching(t, x, d_hat, changed, state.law)

    # --- the claim (R.3) --------------------------------------------------------------------------

    def lyapunov(
        self,
        t: jax.Array,
        x: jax.Array,
        d_tilde: jax.Array,
        context: LawContext,
        state: AdaptiveState,
    ) -> jax.Array:
        """V_a of (R.1), (), with the plant's parameters where the context has the plant, else the
        model's.
        """
        return self._value(t, x, self.true_parameters(t, context), context, state)

    def _value(
        self,
        t: jax.Array,
        x: jax.Array,
        theta: jax.Array,
        context: LawContext,
        state: AdaptiveState,
    ) -> jax.Array:
        """V_a for parameters theta, ()."""
        energy: Any = self.inner.energy(t, x, self._with_parameters(context, theta))
        return energy + 0.5 * jnp.sum((state.theta - theta) ** 2 / self.Gamma)

    def decay(
        self,
        t: jax.Array,
        x: jax.Array,
        d_tilde: jax.Array,
        context: LawContext,
        state: AdaptiveState,
    ) -> jax.Array:
        """W + sigma/2 |theta_tilde|^2 of (R.3), ()."""
        theta = self.true_parameters(t, context)
        decay: Any = self.inner.energy_decay(t, x, self._with_parameters(context, theta))
        return decay + 0.5 * jnp.sum(self.sigma * (state.theta - theta) ** 2)

    def disturbance_terms(
        self,
        t: jax.Array,
        x: jax.Array,
        d_tilde: jax.Array,
        dd: jax.Array,
        context: LawContext,
        state: AdaptiveState,
    ) -> jax.Array:
        """The other terms of (R.3), (): those of d and of the leak, what the projection adds for
        parameters outside its inner box, and the effect of parameters that change with time.
        """
        theta = self.true_parameters(t, context)
        error = state.theta - theta
        command, _, gradient = self._command_and_gradient(t, x, d_tilde, context, state)
        effect = self._effect_of_rest(t, x, command, theta, d_tilde, context)
        leak = 0.5 * jnp.sum(self.sigma * (theta - self._nominal(context.model)) ** 2)
        rate = self.unprojected(state.theta, gradient, context)
        removed = self.projected(state.theta, rate) - rate
        projection = jnp.sum(jnp.maximum(error * removed / self.Gamma, 0.0))

        def value_at(now):
            return self._value(t, x, self.true_parameters(now, context), context, state)

        change = jax.jvp(value_at, (t,), (jnp.ones_like(t),))[1]
        return effect + leak + projection + change

    def _effect_of_rest(
        self,
        t: jax.Array,
        x: jax.Array,
        command: Command,
        theta: jax.Array,
        disturbance: jax.Array,
        context: LawContext,
    ) -> jax.Array:
        """dV/dx . d, (), with d the disturbance of the model with the parameters theta.

        Args:
          t, x, context: as `command`.
          command: of the law at this state.
          theta: parameters, (p,).
          disturbance: of the model itself, f (n,) or d (r, n).
        """
        true = self._with_parameters(context, theta)
        model, true_model = map(plants.as_plant, (context.model, true.model))
        if disturbance.ndim == 1:
            disturbance = plants.torque_as_rates(model, x, disturbance)
        flow = plants.flow(model, t, x, command.tau)
        true_flow = plants.flow(true_model, t, x, command.tau)
        slopes = jax.grad(self.inner.energy, argnums=1)(t, x, true)
        return jnp.sum(slopes * (flow + disturbance - true_flow))

    def true_parameters(self, t: jax.Array, context: LawContext) -> jax.Array:
        """The true parameters theta at time t, (p,): those of the plant where the context has one
        with these parameters, else those of the model.
        """
        if context.plant is None:
            return self._nominal(context.model)
        try:
            return _values_at(context.plant.at(t), self.parameters)
        except ValueError:
            return self._nominal(context.model)


LAWS = (
    'Such as iblf_jax.controllers.Backstepping(k1=..., K2=..., variant="corrected"). Limits of the'
    " torque go around: Saturated(AdaptiveParameters(...))."
)


def adapting_part(
    law: TrackingLaw, state: State
) -> tuple[AdaptiveParameters, AdaptiveState] | None:
    """The law with adapting parameters among the layers of a law, and its state; None without one.

    Args:
      law: of a scenario.
      state: of the law.
    """
    for part, own in layers_with_states(law, state):
        if isinstance(part, AdaptiveParameters):
            return part, own
    return None


def _values_at(part: object, names: tuple[str, ...]) -> jax.Array:
    """The numbers at some paths, (p,); ValueError for a path that leads to no number."""
    values = []
    for path in names:
        try:
            _, value = resolve(part, path)
        except LookupError:
            expected = f"the path of a number of {type(part).__name__}"
            raise checks.fail("controller.parameters", path, expected) from None
        if jnp.ndim(value) != 0:
            expected = f"the path of one number, such as {path}[0]"
            raise checks.fail("controller.parameters", path, expected)
        values.append(jnp.asarray(value))
    return jnp.stack(values)


def _unit_at(part: Any, tokens: list[str | int]) -> str:
    """The unit that the field at a location declares."""
    unit: Any = "1"
    index: list[int] = []
    for token in tokens:
        if isinstance(token, str):
            unit, index = type(part).__dataclass_fields__[token].metadata.get("unit", "1"), []
        else:
            index.append(token)
        part = member_of(part, token)
    if not isinstance(unit, tuple):
        return str(unit)
    return str(of_entry(unit, tuple(index), len(index)))


# --- dependence on the parameters ---------------------------------------------------------------


def _points(context: LawContext, dtype: DTypeLike) -> tuple[jax.Array, jax.Array]:
    """Times (POINTS,) and states (POINTS, r, n) inside the bounds of the first level."""
    rng = np.random.default_rng(0)
    model = plants.as_plant(context.model)
    times = jnp.asarray(rng.uniform(0.0, 5.0, POINTS), dtype)
    spread = jnp.asarray(rng.uniform(-0.5, 0.5, (POINTS, model.order, model.n)), dtype)
    states = []
    for t, (q, dq, *above_second) in zip(times, spread, strict=True):
        tube = context.tube(t)
        q = tube.q_d + q * jnp.minimum(tube.k_l, tube.k_u)
        dq = tube.dq_d + dq
        steady = model.steady_levels(q, dq)
        if steady is not None and above_second:
            above_second = [*(jnp.stack(above_second) + steady)]
        states.append(jnp.stack([q, dq, *above_second]))
    return times, jnp.stack(states)


@jax.jit
def _dependence(
    law: AdaptiveParameters, context: LawContext, t: jax.Array, x: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Derivatives by the parameters at both ends of their box and in its middle: of the torque, (3,
    POINTS, n, p), and of virtual controls, V1 and the slope of V, (3, POINTS, m, p).
    """
    estimate = jnp.zeros(plants.as_plant(context.model).estimate_shape, x.dtype)

    def outputs(theta, t, x):
        changed = law._with_parameters(context, theta)
        state = law.inner.init(x, changed)
        command, _ = law.inner.command(t, x, estimate, changed, state)
        others = (command.alpha, command.V1, command.input_slope, command.alpha_higher)
        return command.tau, jnp.concatenate([jnp.ravel(part) for part in jax.tree.leaves(others)])

    derivatives = jax.vmap(jax.jacfwd(outputs), in_axes=(None, 0, 0))
    middle = 0.5 * (law.lower + law.upper)
    boxes = [derivatives(theta, t, x) for theta in (law.lower, middle, law.upper)]
    return jax.tree.map(lambda *parts: jnp.stack(parts), *boxes)
