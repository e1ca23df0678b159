"""Backstepping with a barrier on every level of a plant in strict-feedback form.

With alpha_0 = x_d and e_i = x_i - alpha_{i-1}, the bounds of x_i give e_i the tube

    -K_l < e_i < K_u,   K_u = upper_i - alpha_{i-1},   K_l = alpha_{i-1} - lower_i.

Each level has a barrier V_i with a weight w_i > 0; s_i is its slope and a_i its "virtual velocity",
for which s_i (a_i - alpha_{i-1}') + dV_i/dt <= -decay_i.  Level i chooses the level above,

    alpha_i = G_i^-1 [ a_i - c_i s_i - (e_i/(w_i s_i)) G_{i-1}^T (w_{i-1} s_{i-1})
                       - f_i - d_hat_i ],   u = alpha_r,                                     (S.2)

without the third term for i = 1, which cancels (w_{i-1} s_{i-1})^T G_{i-1} e_i exactly.  Without
disturbances (sum w_i V_i)' <= -sum w_i decay_i - sum c_i w_i |s_i|^2.

**Weights.**  They give sum w_i V_i one unit, and they set how fast the levels exchange energy: by
G_{i-1}^T w_{i-1} G_{i-1} / w_i [1/s^2].  With weights of 1 on a flexible joint that is (K/M)^2, and
with those of the energy K/M.  The plants of this package state the scales of their levels'
energies (`weights`); for others w = 1.

**Derivatives.**  alpha_{i-1}' is the derivative along the flow of the model, x_j' = f_j + G_j
x_{j+1} + d_hat_j, with the output of the observer held.

**Filters.**  With a `filter`, mu_i beta_i' + beta_i = alpha_i, beta_i(0) = alpha_i(0) of (S.2),
and beta_i' = (alpha_i - beta_i)/mu_i takes the place of alpha_i'.  No derivative is formed.  The
`filter_form` says what the errors contain:

    surface       e_{i+1} = x_{i+1} - beta_i
    derivative    e_{i+1} = x_{i+1} - alpha_i
    compensated   e_{i+1} = x_{i+1} - beta_i - xi_{i+1},   the bracket of (S.2) has the further
                  term -k_i xi_i, with the compensating signals xi_i of
                  xi_i' = -k_i xi_i + G_i (beta_i - alpha_i + xi_{i+1}),                     (S.4)
                  xi_i(0) = 0,   xi_r = 0

The first is the dynamic surface; there the lag of the filters remains as an error, and the bound
above becomes ultimate boundedness.  In the second the error of the derivative, beta_i' - alpha_i',
does.  In the third the barriers act on the compensated states y_i = x_i - xi_i, for which
y_i' = a_i - c_i s_i + G_i e_{i+1} - (the third term of (S.2)): the bound above holds for
V_i(e_i) exactly, whatever mu is, and lower_i < x_i - xi_i < upper_i is what is kept.

**Nonlinear damping.**  With a `regressor` phi_i(t, x_1 .. x_i), (n, m), and `damping` gamma_i,

    c_i + gamma_i |phi_i|^2   takes the place of c_i.                                        (S.5)

A disturbance phi_i theta of level i with an unknown bounded theta, (m,), then adds at most
w_i |theta|^2/(4 gamma_i) for each component to (sum w_i V_i)'.

**Matrices.**  A level without a barrier may have a gain K_i and a weight W_i that are matrices:

    V_i = 1/2 e_i^T W_i e_i,   s_i = W_i e_i,   a_i = alpha_{i-1}' - W_i^-1 K_i k_i e_i,
    and W_i^-1 G_{i-1}^T (w_{i-1} s_{i-1})/w_i as the third term of (S.2),                   (S.6)

so that with equal k_i the decay is w_i k_i e_i^T K_i e_i.  With W_2 = M and k_2 = 1 1/s, the force
of a vessel contains -K_2 e_2.

**Decays.**  The gain k_i of a level may depend on the time and on V_i (`decays`, for settling in
finite, fixed or prescribed time); decay_i then is that of the gain of the instant, and u contains
the derivatives of k_i(t, V_i).

**Smoothness.**  u contains the slope s_i of a level differentiated r - i - 1 times.  `Integral` and
`Log(p=1)` have a kink of the slope at e_i = 0 in an asymmetric tube, and on levels above the first
their e_i/s_i jumps there.  Such a barrier is refused below the last level.  On the last level u
jumps at e_r = 0 (`switching`), as the exact cancellation requires: for a robot with bounds on
positions and velocities the torque jumps by M0 s_1 (K_u^2 - K_l^2)/2.  `Tan`, `StateBarrier`,
`TransformedError` and `PrescribedPerformance` have no jump.

**Derivatives across the jump.**  In a continuous loop the derivative of a step that reaches e_r,i =
0 is that of the hybrid flow, with the jump of a perturbation at the crossing (`engine.switching`,
J.1), in every executor and in forward and reverse mode; that of a metric of the input contains the
jump of its integrand.  Limits:

- Where the inputs of both sides drive e_r,i towards 0, it slides along 0.  Derivatives of the state
  are then those of the sliding motion, of first order in dt; those of a metric of the input leave
  out how the input alternates.  Where e_r,i touches 0 without crossing it, no derivative exists.
- A sampled loop holds its input, so that its derivative needs no such term.  But its metrics, as
  functions of a gain, jump whenever a crossing moves from one sample to the next, and no derivative
  contains that.
- Second derivatives leave out the kink of the barrier's slope at e_1 = 0, as those of every law
  with asymmetric bounds do.
- A fixed step across the jump is of first order; `numerical_error` contains that error.
- Other solvers that take `VectorField` step across the jump in their own way: derivatives through
  them leave the term out.

**On a robot** with bounds on positions and velocities (order 2) the law is

    tau = C0 q' + G0 + M0 (a_2 - w_1 s_1 e_2/(w_2 s_2) - c_2 s_2) - f_hat,                     (F.1)

and with c_2 > 0 and a momentum observer it has the claim (F.3), which bounds the effect of the
estimation error in advance (`iblf_jax.certificates.claims.matched`).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.barriers import Barrier, Quadratic, TransformedError
from iblf_jax.control.barriers._base import (
    guard_is_active,
    has_ratio,
)
from iblf_jax.control.controllers._base import Command, Law, LawContext, State, decay_of
from iblf_jax.control.controllers._levels import (
    Design,
    Level,
    compensation_rates,
    compensations_of,
    exact_levels,
    filtered_levels,
)
from iblf_jax.control.controllers.backstepping import (
    check_barrier,
    check_definite,
    fit_decays,
    fit_o,
    stated_decay,
)
from iblf_jax.control.decays import Decay
from iblf_jax.core import checks, programs
from iblf_jax.core.linalg import inner, matvec
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.core.units import ByLevel, PlantUnit, resolved
from iblf_jax.world import plants
from iblf_jax.world.bounds import Bounds, Funnel, Tube

FORMS = ("surface", "derivative", "compensated")
"""What the errors of a law with filters contain."""


@component
class BarrierBackstepping(Law):
    """Backstepping with a barrier on every level, u = alpha_r, for a plant of any order r.

        alpha_i = G_i^-1 [ a_i - c_i s_i - (e_i/(w_i s_i)) G_{i-1}^T (w_{i-1} s_{i-1})
                           - f_i - d_hat_i ],   e_i = x_i - alpha_{i-1},   u = alpha_r      (S.2)

    V_i, s_i and a_i are the value, the slope and the virtual velocity of the barrier of level i.
    The page "Plants in strict-feedback form" has the claim and the choice of the weights.

    The law receives the state x, (r, n), of any plant in strict-feedback form, robots included.
    It keeps the bounds of every level that has a barrier, as long as alpha_{i-1} is inside the
    bounds of level i (`alpha_margin` > 0).

    With `Integral` or `Log` as the last barrier, u jumps at e_r = 0 where K_u and K_l differ.
    First derivatives of a run contain that jump (head of this module, with the limits).

    Args:
      k: gain of each level, r numbers or (r, n) [1/s], > 0.
      barriers: a `Barrier` for each level, `Quadratic()` where a level has no bounds.  A single
        barrier is that of the first level, with `Quadratic()` above;
        `(TransformedError(),)` if not given.
      c: gain of each level's slope s_i, which limits the effect of estimation errors, one number, r
        numbers or (r, n) [1], >= 0; 0 if not given.  On a robot with a momentum observer the claim
        (F.3) of case 2 asks for c_2 > w_2/(4 (kf - 1/2) lambda_min(M0)^2).
      weights: w_i of each level's V_i, r numbers or (r, n) [1], > 0; those of the model's energy if
        not given, with which w_i V_i is about half the scale of the level times e_i^2 near e_i = 0;
        1 for a model that states none.  The unit 1 of c and of the weights is that of a plant
        without units; `iblf_jax.parameters` shows the others, in which all w_i V_i have one unit.
        They depend on the barrier: in a tube of half-width k, w/k^2 with `TransformedError`
        equals w with `PrescribedPerformance` and `Log` near e_i = 0, so that a weight of 1 of these
        is large in a narrow tube.
      o: margin under the root of kappa, one number, r numbers or (r, n) [1/s^2], > 0, for barriers
        that have it and for no others; 0.1 for these, if not given.
      filter: mu_i of the filters, r - 1 numbers or (r - 1, n) [s], > 0; exact derivatives if not
        given.  They start at the virtual controls of (S.2), beta_i(0) = alpha_i(0).
      filter_form: "surface" (e_{i+1} = x_{i+1} - beta_i), "derivative" (e_{i+1} = x_{i+1} -
        alpha_i, with beta_i' for alpha_i') or "compensated" (S.4); "surface" if not given.
      decays: a `Decay` for each level, by which its gain depends on the time and on V_i; one alone
        is that of every level; exponential in k if not given.
      damping: gamma_i of the nonlinear damping (S.5), one number, r numbers or (r, n) [1], >= 0;
        none if not given.  In tables its unit is that for a phi_i in the unit of x_i'.
      regressor: function (t, x) -> phi, (r, n, m), of the time [s] and the state (r, n), for
        `damping`.  Row i may depend on t and on x[0] ... x[i] only.  None if not given.
      gain_matrices: K_i of (S.6), (r, n, n) [1], in the unit of W_i, with a positive definite
        symmetric part; the unit matrix for a level with a barrier.  W_i if not given, and k_i is
        the gain.  Tables state the unit 1, because the entries have different ones.
      weight_matrices: W_i of (S.6), (r, n, n) [1], symmetric and positive definite; the unit matrix
        for a level with a barrier.  The unit matrix if not given.  With them the default of
        `weights` is 1 on the levels without a barrier.

    Source: M. Krstic, I. Kanellakopoulos, P. Kokotovic, Nonlinear and Adaptive Control Design,
      1995 (backstepping); K. P. Tee, S. S. Ge, Automatica 47 (2011) 2511-2516 (barriers); W. He,
      Y. Chen, Z. Yin, IEEE Trans. Cybernetics 46 (2016) 620-629 (robots with bounds on positions
      and velocities); J. A. Farrell, M. Polycarpou, M. Sharma, W. Dong, IEEE Trans. Automatic
      Control 54 (2009) 1391-1395 (compensated filters, there of the second order); weights and
      full-state bounds of this package.
    """

    k: Leaf = leaf("1/s", sign="positive", shape="level")
    barriers: tuple[Barrier, ...] = (TransformedError(),)
    c: Leaf = leaf("1", sign="nonnegative", shape="level", default=0.0)
    weights: Leaf = leaf("1", sign="positive", shape="level", default=None)
    o: Leaf = leaf("1/s^2", sign="positive", shape="level", default=None)
    filter: Leaf = leaf("s", sign="positive", shape="level", default=None)
    decays: tuple[Decay, ...] = ()
    filter_form: str = static(default="surface")
    damping: Leaf = leaf("1", sign="nonnegative", shape="level", default=None)
    regressor: Callable[[jax.Array, jax.Array], jax.Array] | None = static(default=None)
    gain_matrices: Leaf = leaf("1", shape="any", default=None)
    weight_matrices: Leaf = leaf("1", shape="any", default=None)
    gains: ClassVar[tuple[str, ...]] = ("k",)
    factors: ClassVar[tuple[str, ...]] = ("c", "weights")
    takes_shift: ClassVar[bool] = True
    includes_e2: ClassVar[bool] = True

    def check(self) -> None:
        """Raises ValueError for barriers and gains that do not fit together; completes `c` and
        `o`.
        """
        if isinstance(self.barriers, list):
            object.__setattr__(self, "barriers", tuple(self.barriers))
        if not isinstance(self.barriers, tuple):
            object.__setattr__(self, "barriers", (self.barriers,))
        order = self._check_gains()
        above = order - len(self.barriers)
        if len(self.barriers) == 1:
            object.__setattr__(self, "barriers", (*self.barriers, *[Quadratic()] * above))
        elif above:
            expected = f"{order} barriers, one a level, as k has {order} rows"
            remedy = "Quadratic() is for a level without bounds."
            got = f"{len(self.barriers)} barriers"
            raise checks.fail("BarrierBackstepping.barriers", got, expected, remedy)
        for i, barrier in enumerate(self.barriers):
            check_barrier(self, f"barriers[{i}]", barrier, "TransformedError")
        fit_o(self, *self.barriers, like=jnp.zeros(order, self.k.dtype))
        levels = {"c": order, "weights": order, "o": order, "filter": order - 1, "damping": order}
        for name, rows in levels.items():
            self._fit_rows(name, rows)
        fit_decays(self, order)
        self._check_filter_form()
        self._check_damping()
        self._check_matrices()

    def _check_filter_form(self) -> None:
        """Raises ValueError for an unknown form, or a form without filters."""
        checks.one_of("BarrierBackstepping.filter_form", self.filter_form, FORMS)
        if self.filter is None and self.filter_form != "surface":
            remedy = "A form is one of filters; give their time constants, such as filter=0.01."
            expected = "filters"
            raise checks.fail("BarrierBackstepping.filter", None, expected, remedy)

    def _check_damping(self) -> None:
        """Raises ValueError for one of `damping` and `regressor` alone."""
        if self.damping is None and self.regressor is None:
            return
        if self.damping is None:
            expected = "the gain of the nonlinear damping, because a regressor is given"
            raise checks.fail("BarrierBackstepping.damping", None, expected)
        if not callable(self.regressor):
            expected = "a function (t, x) -> phi, (r, n, m), because damping is given"
            raise checks.fail("BarrierBackstepping.regressor", self.regressor, expected)

    def _check_matrices(self) -> None:
        """Raises ValueError for matrices of another shape, or for some that are not positive
        definite or belong to a level with a barrier.
        """
        for name in ("gain_matrices", "weight_matrices"):
            value = vars(self)[name]
            if value is None:
                continue
            field = f"BarrierBackstepping.{name}"
            shape = jnp.shape(value)
            if len(shape) != 3 or shape[0] != self.order or shape[1] != shape[2]:
                expected = f"one matrix a level, shape ({self.order}, n, n)"
                raise checks.fail(field, checks.Words(f"shape {shape}"), expected)
            if not checks.is_concrete(value):
                continue
            for i, matrix in enumerate(np.asarray(value)):
                _check_matrix(f"{field}[{i}]", matrix, self.barriers[i], name)

    def _check_gains(self) -> int:
        """The order r, which is the number of rows of `k`; ValueError for a single number."""
        if jnp.ndim(self.k) == 0 or self.k.shape[0] < 2:
            expected = "one gain a level, for at least two levels"
            remedy = "Such as k=(3.0, 20.0, 60.0)."
            raise checks.fail("BarrierBackstepping.k", self.k, expected, remedy)
        return int(self.k.shape[0])

    def _fit_rows(self, name: str, rows: int) -> None:
        """Repeats a single number for the levels; ValueError for another number of rows."""
        value = vars(self)[name]
        if value is None:
            return
        if jnp.ndim(value) == 0:
            object.__setattr__(self, name, jnp.broadcast_to(value, (rows,)))
        elif value.shape[0] != rows:
            expected = f"one number, or {rows} rows"
            got = f"shape {value.shape}"
            raise checks.fail(f"BarrierBackstepping.{name}", got, expected)

    @property
    def order(self) -> int:
        """Number of levels r."""
        return len(self.barriers)

    def leaf_units(self) -> dict[str, ByLevel]:
        """The units of c and of the weights, by those of each level's V_i."""
        c, weights, damping = [], [], []
        for i, barrier in enumerate(self.barriers):
            level = f"x{i + 1}"
            if barrier.value_unit == "1":
                c.append(PlantUnit("1", f"{level}^2/s"))
                damping.append(PlantUnit("1", "s"))
                weights.append(PlantUnit("1", "energy"))
            else:
                c.append(PlantUnit("1", "1/s"))
                damping.append(PlantUnit("1", f"s/{level}^2"))
                weights.append(PlantUnit("1", f"energy/{level}^2"))
        units = {"c": ByLevel(c), "weights": ByLevel(weights)}
        if self.damping is not None:
            units["damping"] = ByLevel(damping)
        return units

    def symbols_of_part(self, field: str, index: int, symbols: Any) -> Any:
        """The units of the symbols in a part of the law: that of z = sqrt(2V) in a decay."""
        if field != "decays":
            return symbols
        size: Any = "1"
        if self.barriers[index].value_unit != "1":
            size = resolved(PlantUnit("1", f"x{index + 1}"), symbols)
        return {**symbols, "z": size}

    # --- checks against a scenario ----------------------------------------------------------------

    def with_defaults(self, context: LawContext, x: jax.Array) -> BarrierBackstepping:
        """The law with weights, (r, n), that belong to its model and to a state x."""
        if self.weights is not None or plants.order_of(context.model) != self.order:
            return self
        weights = _default_weights(self.barriers, context, x)
        if self.weight_matrices is not None:
            free = [isinstance(barrier, Quadratic) for barrier in self.barriers]
            weights = jnp.where(jnp.array(free)[:, None], 1.0, weights)
        # The fields are checked already; `dataclasses.replace` would check them again.
        found = copy.copy(self)
        object.__setattr__(found, "weights", weights)
        return found

    def check_start(self, context: LawContext) -> None:
        """Raises ValueError for a model, bounds or a reference that do not fit the law."""
        order = plants.order_of(context.model)
        if order != self.order:
            kind = type(context.model).__name__
            expected = f"{order} levels, as the model ({kind}) has"
            remedy = "Give k, barriers and weights one entry a level."
            raise checks.fail("controller.k", f"{self.order} levels", expected, remedy)
        if self.filter is None and plants.as_plant(context.model).needs_filters:
            kind = type(context.model).__name__
            expected = f"filters in place of the derivatives that {kind} does not have"
            remedy = "Such as BarrierBackstepping(..., filter=0.01)."
            raise checks.fail("controller.filter", None, expected, remedy)
        self._check_regressor(context)
        smooth = context.reference.continuous_derivatives
        if self.filter is None and smooth < self.order:
            expected = f"a reference with {self.order} continuous derivatives, as u contains them"
            got = f"{type(context.reference).__name__}, which has {smooth}"
            remedy = (
                f"SmoothStep and WaypointSpline take derivatives={self.order}, and Sinusoid is"
                " smooth; or filter the virtual controls: BarrierBackstepping(filter=...)."
            )
            raise checks.fail("reference", checks.Words(got), expected, remedy)
        for i, barrier in enumerate(self.barriers):
            self._check_sides(context, i)
            self._check_level(context, i, barrier)
            self._check_decay(i)

    def _check_regressor(self, context: LawContext) -> None:
        """Raises ValueError for a regressor of another shape."""
        if self.regressor is None:
            return
        t = jax.ShapeDtypeStruct((), self.k.dtype)
        shape = (self.order, context.model.n)
        found = jax.eval_shape(self.regressor, t, jax.ShapeDtypeStruct(shape, self.k.dtype))
        if jnp.ndim(found) == 3 and found.shape[:2] == shape:
            return
        expected = f"phi of shape (r, n, m) = ({shape[0]}, {shape[1]}, m)"
        got = checks.Words(f"shape {found.shape}")
        raise checks.fail("controller.regressor", got, expected)

    def _check_sides(self, context: LawContext, i: int) -> None:
        """Raises ValueError for bounds of level i + 1 with too few continuous derivatives."""
        bounds = context.bounds[i]
        if self.filter is not None or bounds is None or isinstance(self.barriers[i], Quadratic):
            return
        name = f"bounds[{i}]"
        needed = self.order - i
        for side_name, side in (("lower", bounds.lower), ("upper", bounds.upper)):
            smooth = side.continuous_derivatives
            if smooth >= needed:
                continue
            expected = f"a side with {needed} continuous derivatives, as u contains them"
            got = f"{type(side).__name__}, which has {smooth}"
            remedy = (
                "bounds.Constant, Sinusoid and Funnel are smooth; or filter the virtual controls:"
                " BarrierBackstepping(filter=...)."
            )
            raise checks.fail(f"{name}.{side_name}", checks.Words(got), expected, remedy)

    def _check_level(self, context: LawContext, i: int, barrier: Barrier) -> None:
        """Raises ValueError for a barrier without bounds, or one that is not smooth enough."""
        name, kind = f"controller.barriers[{i}]", type(barrier).__name__
        if isinstance(barrier, Quadratic):
            return
        bounds = context.bounds[i]
        if bounds is None:
            field = f"bounds[{i}]"
            expected = f"bounds of level {i + 1} for the barrier {kind}"
            remedy = "Or take barriers.Quadratic() for that level."
            raise checks.fail(field, None, expected, remedy)
        last = i == self.order - 1
        if i > 0 and not has_ratio(barrier):
            expected = "a barrier with `error_over_slope` above the first level"
            raise checks.fail(name, kind, expected, "Such as TransformedError().")
        if last or self.filter is not None or _is_symmetric(context, i, bounds):
            return
        # Row i is level i + 1, whose slope u contains with r - (i + 1) - 1 derivatives.
        needed = self.order - i - 2
        smooth = barrier.slope_derivatives
        if i > 0 and barrier.ratio_jumps:
            expected = "a barrier whose e/s does not jump at e = 0"
        elif smooth < needed:
            expected = f"a barrier whose slope has {needed} continuous derivatives at e = 0"
        else:
            return
        centre = f", about alpha_{i},"
        others = "TransformedError() and PrescribedPerformance() are smooth."
        if i == 0:
            centre = ""
            log = f"Log(p={math.ceil(self.order / 2)})"
            others = f"TransformedError(), PrescribedPerformance() and {log} are smooth enough."
        remedy = (
            f"The tube of level {i + 1}{centre} is asymmetric, and the level is not the last."
            f" {others} Or filter the virtual controls: BarrierBackstepping(filter=...)."
        )
        raise checks.fail(name, kind, expected, remedy)

    def _check_decay(self, i: int) -> None:
        """Raises ValueError for a decay of level i + 1 with too few continuous derivatives."""
        if self.filter is not None:
            return
        decay = decay_of(self, i)
        needed, smooth = self.order - i - 1, decay.smooth_derivatives
        if smooth >= needed:
            return
        expected = f"a decay with {needed} continuous derivatives, as u contains them"
        got = f"{type(decay).__name__}, which has {smooth}"
        remedy = (
            "decays.FiniteTime and FixedTime are smooth; or filter the virtual controls:"
            " BarrierBackstepping(filter=...)."
        )
        raise checks.fail(f"controller.decays[{i}]", checks.Words(got), expected, remedy)

    # --- the law ----------------------------------------------------------------------------------

    @property
    def _designs(self) -> list[Design]:
        """The barrier and the gains of each level."""
        o: Any = self.o
        if o is None:
            o = [None] * self.order
        decays = [decay_of(self, i) for i in range(self.order)]
        rows = zip(self.barriers, self.k, o, self.c, self.weights, decays, strict=True)
        return [Design(*row)._replace(**self._optional_fields(i)) for i, row in enumerate(rows)]

    def _optional_fields(self, i: int) -> dict[str, Any]:
        """The matrices and the nonlinear damping of level i + 1, by their names in `Design`."""
        found: dict[str, Any] = {}
        if self.damping is not None:
            found |= {"damping": self.damping[i], "regressor": self.regressor}
        if not isinstance(self.barriers[i], Quadratic):
            return found
        if self.gain_matrices is not None:
            found["gain_matrix"] = self.gain_matrices[i]
        if self.weight_matrices is not None:
            W = self.weight_matrices[i]
            found["weight_matrix"] = 0.5 * (W + W.T)  # a derivative by W may be asymmetric
            found.setdefault("gain_matrix", found["weight_matrix"])
        return found

    @property
    def addition(self) -> str:
        """What the law has that no claim about (S.2) contains, in words; "" for nothing."""
        if self.filter is not None and self.filter_form != "surface":
            return f'filters of the form "{self.filter_form}"'
        if self.damping is not None:
            return "nonlinear damping"
        if self.gain_matrices is not None or self.weight_matrices is not None:
            return "matrices as gains or weights"
        return ""

    def init(self, x: jax.Array, context: LawContext) -> Any:
        """beta_i(0) = alpha_i(0) of (S.2), (r - 1, n), of a law with filters, and below them
        xi_i(0) = 0, (r - 1, n), of a compensated one; no state otherwise.

        With the derivatives of the virtual controls at the start, the filters begin without a
        transient, and the motion tends to that of (S.2) as they become faster.
        """
        if self.filter is None:
            return ()
        t = jnp.zeros((), x.dtype)
        levels, _ = exact_levels(self._designs, t, x, jnp.zeros_like(x), context)
        beta = jnp.stack([level.alpha for level in levels[:-1]])
        if self.filter_form != "compensated":
            return beta
        return jnp.concatenate([beta, jnp.zeros_like(beta)])

    def command(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> tuple[Command, Any]:
        """The input u, what belongs to it, and the rates of the filters.

        Args:
          t: time, () [s].
          x: state, (r, n).
          d_hat: estimate of the disturbance of each level, (r, n); or of the torque on the robot
            inside the plant, (n,) [N m].
          context: model, reference and bounds.
          state: as `init`.
        """
        levels, tubes = self.levels(t, x, d_hat, context, state)
        rates: Any = ()
        y = x
        if self.filter is not None:
            # Row by row, because `filter` may have one number a level.
            steps = zip(levels, state, self.filter, strict=False)
            rates = jnp.stack([(level.alpha - beta) / mu for level, beta, mu in steps])
        if self.filter_form == "compensated":
            y = x - compensations_of(state)
            of_xi = compensation_rates(self._designs, levels, t, x, context, state)
            rates = jnp.concatenate([rates, of_xi])
        V = jnp.zeros_like(x[0])
        guard_active = jnp.zeros(x[0].shape, bool)
        for i, (design, tube) in enumerate(zip(self._designs, tubes, strict=True)):
            V = V + self.weights[i] * design.value(tube, y[i])
            guard_active |= guard_is_active(tube, y[i], design.barrier.guard)
        saturated = jnp.zeros_like(guard_active)
        model = plants.as_plant(context.model)
        slope = plants.transposed_gain(model, self.order, t, x, levels[-1].slope)
        centres = [tube.q_d for tube in tubes]
        if self.filter_form == "compensated":
            # The error of a level is its state less what records show as alpha.
            centres = [centre + x[i] - y[i] for i, centre in enumerate(centres)]
        alpha_higher: Any = ()
        if self.order > 2:
            alpha_higher = jnp.stack(centres[2:])
        command = Command(
            tau=levels[-1].alpha,
            alpha=centres[1],
            V1=V,
            guard_active=guard_active,
            saturated=saturated,
            alpha_higher=alpha_higher,
            input_slope=slope,
        )
        return command, rates

    def levels(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> tuple[list[Level], list[Tube]]:
        """What each level computes, and the tube of x_i around alpha_{i-1}, or that of x_i - xi_i
        around beta_{i-1} with filters; arguments as `command`.
        """
        if self.filter is None:
            return exact_levels(self._designs, t, x, d_hat, context)
        return filtered_levels(
            self._designs, self.filter, self.filter_form, t, x, d_hat, context, state
        )

    def energy(self, t: jax.Array, x: jax.Array, context: LawContext) -> jax.Array:
        """Sum w_i V_i, (), of the law without filters."""
        _, tubes = self.levels(t, x, jnp.zeros_like(x), context, ())
        return jnp.sum(self._weighted_values(x, tubes))

    def energy_decay(self, t: jax.Array, x: jax.Array, context: LawContext) -> jax.Array:
        """Sum w_i decay_i + (c_i + gamma_i |phi_i|^2) w_i |s_i|^2, (), of the law without filters;
        the decay of a barrier that states none is 0.
        """
        levels, tubes = self.levels(t, x, jnp.zeros_like(x), context, ())
        values = self._weighted_values(x, tubes)
        total = jnp.zeros_like(t)
        for i, (level, design) in enumerate(zip(levels, self._designs, strict=True)):
            slope_gain: Any = design.slope_gain(i, t, x)
            total += jnp.sum(slope_gain * level.slope**2 / self.weights[i])
            if design.gain_matrix is None:
                total += jnp.sum(stated_decay(self.barriers[i], self.k[i], values[i]))
                continue
            error = x[i] - tubes[i].q_d
            feedback = matvec(design.gain_matrix, self.k[i] * error)
            total += inner(self.weights[i] * error, feedback)
        return total

    def _weighted_values(self, x: jax.Array, tubes: list[Tube]) -> jax.Array:
        """w_i V_i, (r, n)."""
        pairs = zip(self._designs, tubes, strict=True)
        values = [design.value(tube, x[i]) for i, (design, tube) in enumerate(pairs)]
        return jnp.stack([w * value for w, value in zip(self.weights, values, strict=True)])

    def switching(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> jax.Array | None:
        """e_r, (n,), where u jumps at e_r = 0; None for a last barrier without a jump."""
        if not self.barriers[-1].ratio_jumps:
            return None
        _, tubes = self.levels(t, x, d_hat, context, state)
        return x[-1] - tubes[-1].q_d


# --- checks ---------------------------------------------------------------------------------------


def _check_matrix(field: str, matrix: np.ndarray, barrier: Barrier, name: str) -> None:
    """Raises ValueError unless a matrix fits (S.6): positive definite, symmetric as a weight, and
    the unit matrix for a level with a barrier.
    """
    if not isinstance(barrier, Quadratic):
        if not np.array_equal(matrix, np.eye(len(matrix))):
            expected = f"the unit matrix, as the level has the barrier {type(barrier).__name__}"
            remedy = "A barrier acts on every component alone; its gains are k and weights."
            raise checks.fail(field, matrix, expected, remedy)
        return
    if name == "weight_matrices" and not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0):
        raise checks.fail(field, matrix, "a symmetric matrix")
    check_definite(field, matrix)


# One program: each of some fifty operations would be one.
@programs.jit(options=programs.SHORTEST_TO_COMPILE)
def _default_weights(barriers: tuple[Barrier, ...], context: LawContext, x: jax.Array) -> jax.Array:
    """The weights, (r, n), with which the levels have the scale of the energy of the model at a
    state x, (r, n).
    """
    scale = plants.as_plant(context.model).weights(x)
    if scale is None:
        return jnp.ones_like(x)
    # e_i/s_i at e_i = 0 and t = 0, with which the weights have the scale of e_i^2.
    t = jnp.zeros((), x.dtype)
    tube = context.tube(t)
    ratios = [_ratio(barriers[0], tube, tube.q_d)]
    for i in range(1, len(barriers)):
        tube = _tube_at_rest(context.bounds[i], t, jnp.zeros_like(x[i]))
        ratios.append(_ratio(barriers[i], tube, tube.q_d))
    return scale * jnp.stack(ratios)


def _ratio(barrier: Barrier, tube: Tube, x: jax.Array) -> jax.Array:
    """The ratio e/s of a barrier; 1 for a barrier that does not state it."""
    stated = barrier.error_over_slope(tube, x)
    if stated is None:
        return jnp.ones_like(x)
    return stated  # type: ignore[no-any-return]


def _tube_at_rest(bounds: Bounds | None, t: jax.Array, like: jax.Array) -> Tube:
    """The tube of a level at time t around the middle of its bounds, without rates; without bounds
    it reaches from -1 to 1.
    """
    zero = jnp.zeros_like(like)
    if bounds is None:
        return Tube(zero, zero, zero - 1.0, zero + 1.0, zero, zero)
    lower, upper = bounds.lower.at(t, zero), bounds.upper.at(t, zero)
    return Tube(0.5 * (lower + upper), zero, lower, upper, zero, zero)


TIMES = (0.0, 0.37, 1.1, 2.9, 7.3, 19.7)
"""Times [s] at which the bounds of the first level are compared with the reference."""


def _is_symmetric(context: LawContext, i: int, bounds: Bounds) -> bool:
    """Whether the tube of level i + 1 is symmetric about its centre at all `TIMES`; True for traced
    values, which an earlier call has checked.

    The centre of a tube above the first level is a virtual control, about which only two opposite
    funnels are symmetric, because they follow it.
    """
    if not checks.is_concrete((bounds, context.reference)):
        return True
    lower, upper = bounds.lower, bounds.upper
    if i > 0:
        if not isinstance(lower, Funnel) or not isinstance(upper, Funnel):
            return False
        return bool(
            np.allclose(lower.initial, -np.asarray(upper.initial))
            and np.allclose(lower.final, -np.asarray(upper.final))
            and np.allclose(lower.rate, upper.rate)
        )
    tubes = [context.tube(jnp.asarray(t)) for t in TIMES]
    return all(np.allclose(tube.k_l, tube.k_u, rtol=1e-9, atol=0.0) for tube in tubes)
