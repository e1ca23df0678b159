"""Multiple shooting: the simulation error over windows of the log, each window with its own
initial state.

    minimise over z, d and the starts s_w
        1/2 sum_w sum_k sum_i rho((y_i(t_k) - q_i(t_k; s_w, x(z), d)) / sigma_i)

Here y are the logged positions, and q those of the plant under the logged torque, delayed by d
seconds.  The starts s_w, 2 n numbers for each window, are eliminated.  With C = J_s^T W J_s and
B = J_s^T W J_z of a window, the information matrix and the score of z are

    A_w = J_z^T W J_z - B^T C^-1 B,     g_w = ... - B^T C^-1 h

and the objective sums them over the windows.  Only y is noisy, and not q", so the estimate is
unbiased.  Two windows are independent given z, and the spread of g_w between windows therefore
measures the uncertainty of z for any noise within a window.

Near the standstill of joints whose friction is identified, torques may be free (`standstill`).
They are eliminated together with the starts.

sigma_i is estimated in turn: it is the median over the windows of the residual of joint i, and in a
window with more than OUTLIER_RATIO times the median it is the residual of that window.  Windows
with effects that the model lacks (a contact, backlash) therefore get a small weight.
"""

from __future__ import annotations

import dataclasses
import math
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.identification.coordinates import Coordinates, to_x
from iblf_jax.identification.levenberg_marquardt import (
    WEAK_PRIOR,
    QuadraticModel,
    levenberg_marquardt,
)
from iblf_jax.identification.log import Log
from iblf_jax.identification.replay import (
    InverseDynamics,
    WindowInputs,
    inverse_dynamics_for_torque,
    position_sensitivities,
    simulate_windows,
)
from iblf_jax.identification.smoothing import local_polynomial
from iblf_jax.identification.standstill import NO_FRICTION_WIDTH, FreeTorques

if TYPE_CHECKING:
    from iblf_jax.simulation.scenario import Scenario


HUBER = 1.345
"""Standard deviations beyond which the Huber loss is linear: 95 % efficiency for normal noise."""
MIN_STEPS = 8
USUAL_DELAY = 0.01
"""The first window of a segment starts this much later, so that the torque is logged from its start
on for any delay up to this value [s]."""
SIGMA_TOLERANCE = 0.02
"""Relative change of sigma below which it has converged."""
OUTLIER_RATIO = 1.5
MAX_NOISE_UPDATES, LATER_STEPS = 6, 8
"""Estimates of sigma at most, and Gauss-Newton steps after the first of them."""
MODE_POINTS, MAX_PHASE = 200, 1.4
"""Points at which the modes are evaluated, and the largest phase of the fastest mode in one step
[rad]: half of the stability limit of RK4."""


class Windows(NamedTuple):
    """The windows of all logs."""

    t: np.ndarray
    """(W, K + 1) [s]."""
    y: np.ndarray
    """(W, K + 1, n) [rad]."""
    log: np.ndarray
    """Which log, (W,)."""
    kept: np.ndarray
    """Which are fitted, (W,) bool; the others are held back."""
    q: np.ndarray
    """Starts, (W, n)."""
    dq: np.ndarray


class TorqueIntegral:
    """The integral of a log's torque over time; the torque is constant between samples (zero-order
    hold) or interpolated.
    """

    def __init__(self, log: Log, hold: bool) -> None:
        dt = np.diff(log.t)[:, None]
        zero = np.zeros((1, log.tau.shape[1]))
        rate = np.diff(log.tau, axis=0) / dt
        if hold:
            rate = np.zeros_like(rate)
        self.t = log.t
        self.tau = log.tau
        self.rate = np.concatenate([rate, zero])
        steps = log.tau[:-1] * dt + 0.5 * rate * dt**2
        self.sum = np.concatenate([zero, np.cumsum(steps, axis=0)])

    def until(self, t: np.ndarray) -> np.ndarray:
        """The integral from the first sample to t, (..., n)."""
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 1)
        s = (t - self.t[k])[..., None]
        # Before the first sample (s < 0) the torque is constant.
        ramp = 0.5 * self.rate[k] * np.maximum(s, 0.0) ** 2
        return self.sum[k] + self.tau[k] * s + ramp

    def means(self, t: np.ndarray, delay: float) -> np.ndarray:
        """The mean torque of each step between times (..., K + 1), delayed by `delay`,
        (..., K, n).
        """
        integral = self.until(t - delay)
        return np.diff(integral, axis=-2) / np.diff(t, axis=-1)[..., None]


def windows(logs: list[Log], length: float, held_back: list[float], hold: bool) -> Windows:
    """The windows of the logs, all with the same number of steps.

    Args:
      logs: the checked logs.
      length: length of a window [s].
      held_back: share of each log, at its end, that is not fitted.
      hold: whether the torque is constant between samples.
    """
    steps = max(MIN_STEPS, round(length / max(log.step for log in logs)))
    t: list[Any] = []
    y, log_index, kept, q, dq = [], [], [], [], []
    for i, log in enumerate(logs):
        count_before = len(t)
        for segment in log.segments:
            start = segment.start + math.ceil(USUAL_DELAY / log.step)
            for first in range(start, segment.stop - steps, steps + 1):
                samples = slice(first, first + steps + 1)
                t.append(log.t[samples])
                y.append(log.q[samples])
                polynomial, _, _ = local_polynomial(log, segment, float(log.t[first]), hold)
                q.append(polynomial[0])
                dq.append(polynomial[1])
                log_index.append(i)
        count = len(t) - count_before
        not_fitted = round(held_back[i] * count)
        kept += [True] * (count - not_fitted) + [False] * not_fitted
    return Windows(*(np.array(x) for x in (t, y, log_index, kept, q, dq)))


class WindowStatistics(NamedTuple):
    """The residuals and the derivatives of the objective, window by window."""

    residuals: np.ndarray
    """y - q, (W, K + 1, n)."""
    information: np.ndarray
    """A_w, (W, p + 1, p + 1); the last row and column belong to the delay."""
    scores: np.ndarray
    """g_w, (W, p + 1)."""


class Prior(NamedTuple):
    """Prior knowledge of x: a mean and a precision matrix."""

    mean: np.ndarray
    precision: np.ndarray
    """(p, p); zero where there is no prior knowledge."""


class Refinement(NamedTuple):
    """The fit at the end of the search."""

    z: np.ndarray
    """(p + 1,), the delay last."""
    statistics: WindowStatistics
    rms: np.ndarray
    """Root mean square of the residuals of each joint over the fitted windows, (n,) [rad],
    corrected for the parameters that each window has of its own."""
    free: FreeTorques
    """The free torques that replaced the friction law."""
    steps: int


class Simulation(NamedTuple):
    """The simulated motion of all windows."""

    starts: np.ndarray
    """Initial states and free torques, (W, s)."""
    inputs: WindowInputs
    q: np.ndarray
    """(W, K + 1, n) [rad]."""
    dq: np.ndarray
    sensitivities: Any = None
    """dq/d(start, z) and the inverse dynamics that it is made of; None before they are computed."""


class Point(NamedTuple):
    """A point of the search."""

    simulation: Simulation
    statistics: WindowStatistics
    starts_step: np.ndarray
    """Step of the starts for constant z, (W, s)."""
    starts_by_z: np.ndarray
    """Derivative of the best starts by z, (W, s, p + 1)."""


class Penalty(NamedTuple):
    """The prior terms of the objective: a weak one of z about the start, and the user's of x."""

    coordinates: Coordinates
    start: np.ndarray
    """z at the start of the search, (p + 1,)."""
    precision: np.ndarray
    """Precision of the weak prior, (p + 1,)."""
    prior: Prior

    def value(self, z: np.ndarray) -> float:
        """The penalty at z."""
        offset = to_x(self.coordinates, z[:-1])[0] - self.prior.mean
        weak = np.sum(self.precision * (z - self.start) ** 2)
        return 0.5 * float(weak + offset @ self.prior.precision @ offset)

    def added_to(
        self, z: np.ndarray, gradient: np.ndarray, hessian: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """A gradient (p + 1,) and a Gauss-Newton Hessian (p + 1, p + 1) with the penalty at z."""
        x, x_by_z = to_x(self.coordinates, z[:-1])
        gradient = gradient + self.precision * (z - self.start)
        hessian = hessian + np.diag(self.precision)
        gradient[:-1] += x_by_z.T @ self.prior.precision @ (x - self.prior.mean)
        hessian[:-1, :-1] += x_by_z.T @ self.prior.precision @ x_by_z
        return gradient, hessian


@dataclasses.dataclass(eq=False)
class ShootingProblem:
    """The least-squares problem that the docstring of this module states."""

    scenario: Scenario
    c: Coordinates
    w: Windows
    logs: list[Log]
    hold: bool
    """Whether the torque is constant between samples."""
    loss: str
    substeps: int
    """Integrator steps between two samples."""
    free: FreeTorques

    @cached_property
    def torque_integrals(self) -> list[TorqueIntegral]:
        """The integral of the torque of each log."""
        return [TorqueIntegral(log, self.hold) for log in self.logs]

    @cached_property
    def step(self) -> float:
        """The shortest time between samples of all logs [s]."""
        return min(log.step for log in self.logs)

    def torque(self, delay: float) -> np.ndarray:
        """Mean torque of each step, (W, K, n) [N m]."""
        found = np.empty((*self.w.t[:, 1:].shape, self.w.y.shape[-1]))
        for i, integral in enumerate(self.torque_integrals):
            of_log = self.w.log == i
            found[of_log] = integral.means(self.w.t[of_log], delay)
        return found

    def _parameters_at(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x, with which the plant is simulated, and dx/dz; fixed entries do not depend on z."""
        x, x_by_z = to_x(self.c, z[:-1])
        fixed = self.free.fixed
        return np.where(fixed, NO_FRICTION_WIDTH, x), np.where(fixed[:, None], 0.0, x_by_z)

    def simulate(
        self, z: np.ndarray, starts: np.ndarray
    ) -> tuple[WindowInputs, np.ndarray, np.ndarray]:
        """The motion in the windows: what is simulated, q and q' (W, K + 1, n)."""
        n = self.w.y.shape[-1]
        x, _ = self._parameters_at(z)
        free_torque = np.einsum("wknm,wm->wkn", self.free.torque, starts[:, 2 * n :])
        tau = self.torque(z[-1]) + self.free.by_x @ x + free_torque
        arrays = (self.w.t, starts[:, :n], starts[:, n : 2 * n], tau)
        inputs = WindowInputs(*(jnp.asarray(a) for a in arrays))
        q, dq = simulate_windows(
            self.scenario, jnp.asarray(x), inputs, places=self.c.places, substeps=self.substeps
        )
        return inputs, np.asarray(q), np.asarray(dq)

    def weights(self, r: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """The weight of each residual, (W, K + 1, n): 1 / sigma^2, and with the Huber loss less
        beyond HUBER sigma.
        """
        if self.loss == "squares":
            return np.broadcast_to(1.0 / sigma**2, r.shape)
        size = np.abs(r) / sigma
        return np.where(size > HUBER, HUBER / np.maximum(size, 1e-300), 1.0) / sigma**2

    def cost(self, r: np.ndarray, starts: np.ndarray, sigma: np.ndarray) -> float:
        """The sum of rho over the fitted windows, and the penalty of their free torques."""
        size = (np.abs(r) / sigma)[self.w.kept]
        rho = 0.5 * size**2
        if self.loss == "huber":
            rho = np.where(size > HUBER, HUBER * (size - 0.5 * HUBER), rho)
        free_torques = starts[self.w.kept, 2 * self.w.y.shape[-1] :]
        return float(np.sum(rho) + 0.5 * np.sum(free_torques**2))

    def refine(
        self,
        z: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
        scale: np.ndarray,
        sigma: np.ndarray,
        prior: Prior,
        max_steps: int,
        rms_limit: np.ndarray | float = np.inf,
    ) -> Refinement:
        """The minimum, by Gauss-Newton steps that alternate with estimates of sigma.

        Args:
          z: start of the search, (p + 1,), the delay last.
          limits: lower and upper limits of z.
          scale: scale of z.
          sigma: first noise level of each joint, (n,) [rad].
          prior: prior knowledge of x.
          max_steps: largest number of Gauss-Newton steps for the first sigma.
          rms_limit: `Refinement.rms` above which the search stops early, (n,) [rad].

        Raises:
          ValueError: the simulation from the start diverges.
        """
        starts, residuals = self.best_starts(z, sigma)
        if not np.all(np.isfinite(residuals)):
            came = checks.Words("windows in which the simulation diverges")
            raise checks.fail("window", came, "shorter windows", "Such as window=0.1.")
        sigma = np.maximum(sigma, self._noise_levels(residuals))
        penalty = Penalty(self.c, z, 1.0 / (WEAK_PRIOR * scale) ** 2, prior)
        simulation = Simulation(starts, *self.simulate(z, starts))
        total = 0
        for again in range(MAX_NOISE_UPDATES):
            if again:
                max_steps = LATER_STEPS
            here = self._linearized(z, simulation, sigma, penalty)
            z, here, steps = levenberg_marquardt(
                here,
                z,
                limits,
                scale,
                partial(self._trial, sigma=sigma, penalty=penalty),
                partial(self._linearized, sigma=sigma, penalty=penalty),
                max_steps,
            )
            total += steps
            simulation, statistics = here.data.simulation, here.data.statistics
            previous = sigma
            sigma = self._noise_levels(statistics.residuals)
            rms = self._rms(statistics.residuals)
            if np.any(rms > rms_limit):
                break
            substeps = substeps_for(simulation.sensitivities[1], self.step)
            change = np.abs(sigma / previous - 1.0)
            if substeps > self.substeps:  # a narrower friction width needs shorter steps
                self.substeps = substeps
                simulation = Simulation(simulation.starts, *self.simulate(z, simulation.starts))
            elif max(np.median(change), np.mean(change)) < SIGMA_TOLERANCE:
                break
        return Refinement(z, statistics, rms, self.free, total)

    def _linearized(
        self, z: np.ndarray, simulation: Simulation, sigma: np.ndarray, penalty: Penalty
    ) -> QuadraticModel:
        """The quadratic model of the objective at z."""
        if simulation.sensitivities is None:
            found = self._sensitivities(z, simulation.inputs, simulation.q, simulation.dq)
            simulation = simulation._replace(sensitivities=found)
        J, _ = simulation.sensitivities
        residuals = self.w.y - simulation.q
        statistics, own_step, by_z = self._eliminate_starts(residuals, J, sigma, simulation.starts)
        scores = np.sum(statistics.scores[self.w.kept], axis=0)
        information = np.sum(statistics.information[self.w.kept], axis=0)
        gradient, hessian = penalty.added_to(z, scores, information)
        cost = self.cost(residuals, simulation.starts, sigma) + penalty.value(z)
        return QuadraticModel(
            cost, gradient, hessian, Point(simulation, statistics, own_step, by_z)
        )

    def _trial(
        self,
        here: QuadraticModel,
        z: np.ndarray,
        step: np.ndarray,
        sigma: np.ndarray,
        penalty: Penalty,
    ) -> tuple[float, Simulation]:
        """The objective after a step, and the simulation there."""
        point = here.data
        starts = point.simulation.starts + point.starts_by_z @ step + point.starts_step
        simulation = Simulation(starts, *self.simulate(z + step, starts))
        cost = self.cost(self.w.y - simulation.q, starts, sigma) + penalty.value(z + step)
        return cost, simulation

    def _rms(self, residuals: np.ndarray) -> np.ndarray:
        """Root mean square of each joint over the windows that are fitted, (n,) [rad]."""
        mean_squares = self._noise_correction() * np.mean(residuals**2, axis=1)
        return np.sqrt(np.mean(mean_squares[self.w.kept], axis=0))

    def best_starts(self, z: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The starts that fit best for given z, (W, s), and the residuals, (W, K + 1, n)."""
        free_torques = np.zeros((len(self.w.q), self.free.torque.shape[-1]))
        starts = np.concatenate([self.w.q, self.w.dq, free_torques], axis=1)
        for _ in range(2):
            inputs, q, dq = self.simulate(z, starts)
            J, _ = self._sensitivities(z, inputs, q, dq)
            _, step, _ = self._eliminate_starts(self.w.y - q, J, sigma, starts)
            starts = starts + step
        return starts, self.w.y - self.simulate(z, starts)[1]

    def _noise_levels(self, r: np.ndarray) -> np.ndarray:
        """Sigma of each window and joint, as in the docstring of this module, (W, 1, n) [rad]."""
        if self.loss == "squares":
            own = np.sqrt(self._noise_correction() * np.mean(r**2, axis=1))
        else:
            own = 1.4826 * np.median(np.abs(r), axis=1)
        usual = np.median(own[self.w.kept], axis=0) + 1e-12
        return np.where(own > OUTLIER_RATIO * usual, own, usual)[:, None]

    def _noise_correction(self) -> np.ndarray:
        """Noise variance relative to the mean square residual, (W, n): each window and joint has
        two parameters of its own, and its free torques.
        """
        K = self.w.y.shape[1]
        return K / np.maximum(K - 2.0 - self.free.pieces, 1.0)

    def _sensitivities(
        self, z: np.ndarray, inputs: WindowInputs, q: np.ndarray, dq: np.ndarray
    ) -> tuple[np.ndarray, InverseDynamics]:
        """dq/d(start, z), (W, K + 1, n, s + p + 1), and the inverse dynamics that it is made of."""
        n = q.shape[-1]
        x, x_by_z = self._parameters_at(z)
        h = np.diff(self.w.t)[..., None]
        middle_t = self.w.t[:, :-1] + 0.5 * h[..., 0]
        middle_q = 0.5 * (q[:, 1:] + q[:, :-1]) - 0.125 * h * np.diff(dq, axis=1)
        middle_dq = 0.5 * (dq[:, 1:] + dq[:, :-1])
        points = (middle_t, middle_q, middle_dq, np.asarray(inputs.tau))
        flat = [jnp.asarray(a.reshape(-1, *a.shape[2:])) for a in points]
        dynamics = inverse_dynamics_for_torque(
            self.scenario, jnp.asarray(x), *flat, places=self.c.places
        )
        dynamics = InverseDynamics(*(np.asarray(a) for a in dynamics))
        free_by_x = self.free.by_x.reshape(dynamics.by_x.shape)
        dynamics = dynamics._replace(by_x=dynamics.by_x - free_by_x)
        late, early = self.torque(z[-1] + 0.5 * self.step), self.torque(z[-1] - 0.5 * self.step)
        torque_by_delay = ((late - early) / self.step)[..., None]
        torque_by_input = np.concatenate([self.free.torque, torque_by_delay], axis=-1)
        J = position_sensitivities(inputs, dynamics, torque_by_input)
        columns = [2 * n, 2 * n + len(x), J.shape[-1] - 1]
        by_start, by_x, by_free, by_delay = np.split(J, columns, axis=-1)
        return np.concatenate([by_start, by_free, by_x @ x_by_z, by_delay], axis=-1), dynamics

    def _eliminate_starts(
        self, r: np.ndarray, J: np.ndarray, sigma: np.ndarray, starts: np.ndarray
    ) -> tuple[WindowStatistics, np.ndarray, np.ndarray]:
        """The statistics of the windows without the starts, the step of the starts for constant z
        (W, s), and the derivative of the best starts by z (W, s, p + 1).
        """
        W, s, m = len(r), starts.shape[1], self.free.torque.shape[-1]
        root_weights = np.sqrt(self.weights(r, sigma))
        weighted_J = (root_weights[..., None] * J).reshape(W, -1, J.shape[-1])
        weighted_r = (root_weights * r).reshape(W, -1)
        N = np.swapaxes(weighted_J, 1, 2) @ weighted_J
        g = -np.einsum("wma,wm->wa", weighted_J, weighted_r)
        free = np.arange(s - m, s)
        N[:, free, free] += 1.0
        g[:, free] += starts[:, free]
        C, B, A = N[:, :s, :s], N[:, :s, s:], N[:, s:, s:]
        solved = np.linalg.solve(C, np.concatenate([B, g[:, :s, None]], axis=-1))
        starts_by_z, starts_step = -solved[..., :-1], -solved[..., -1]
        B_transposed = np.swapaxes(B, 1, 2)
        information = A + B_transposed @ starts_by_z
        scores = g[:, s:] + np.einsum("wab,wb->wa", B_transposed, starts_step)
        return WindowStatistics(r, information, scores), starts_step, starts_by_z


def substeps_for(dynamics: InverseDynamics, step: float) -> int:
    """Number of RK4 steps between two samples, a power of two, for which the fastest mode of the
    plant is well inside the stability region.

    Args:
      dynamics: at points of the motion, of which at most MODE_POINTS and the stiffest are used.
      step: time between samples [s].
    """
    mass, by_q, by_dq = (np.asarray(x) for x in (dynamics.mass, dynamics.by_q, dynamics.by_dq))
    n, count = mass.shape[-1], len(mass)
    chosen = np.linspace(0, count - 1, min(MODE_POINTS, count)).astype(int)
    stiffest = np.argmax(np.max(np.abs(by_dq), axis=(1, 2)))
    chosen = np.append(chosen, stiffest)
    F = np.zeros((len(chosen), 2 * n, 2 * n))
    F[:, :n, n:] = np.eye(n)
    forces = np.concatenate([by_q[chosen], by_dq[chosen]], axis=-1)
    F[:, n:] = -np.linalg.solve(mass[chosen], forces)
    fastest = float(np.max(np.abs(np.linalg.eigvals(F))))
    return 2 ** int(np.clip(np.ceil(np.log2(step * fastest / MAX_PHASE)), 0, 5))
