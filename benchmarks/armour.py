"""Guaranteed tubes of two controllers of an arm whose masses are uncertain: the corrected barrier
law with the level set that `ij.prove` proves, and the robust passivity controller of ARMOUR.

    python benchmarks/armour.py [--quick] [--json FILE]

The two-link arm and the reference of Zhang & Yan 2024 without disturbance.  The mass and the moment
of inertia of each link have a factor of their own within +-`masses`.  Each level set is followed by
ARMOUR's controller with the V_M for which its tube of positions is the same; the last two rows have
more uncertain masses and the published V_M.

- `guarantee`: the verdict of `ij.prove`.  A tube of a level that is not proved is no guarantee.
- `position`, `velocity`: largest half-width of the tube over time, of the worse joint.
- `robust input`: ARMOUR's bound of it, the largest of a grid of points of the tube.
- `error`, `velocity error`: the largest ones of the runs that start on the reference, one for each
  corner of the box of masses, and `feedback` their largest difference from the torque that the
  model needs on the reference.
- `period`: the longest period of `PERIODS` for which this and every shorter period leaves these
  runs inside the guaranteed tube, with a zero-order hold.  Neither guarantee covers it.

Source of ARMOUR: J. Michaux et al., Can't Touch This, arXiv 2301.13308; constants of the repository
  roahmlab/armour.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import warnings
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from _timing import report

import iblf_jax as ij

DT = 1e-4
"""s; the robust input of the widest box has a rate of 4e3/s at the edge of the tube."""
DURATION = 12.6
"""Two periods of the reference [s]."""
PERIODS = (1e-3, 2e-3, 4e-3, 8e-3, 16e-3, 32e-3)
"""s."""
WEIGHT = 2e-3
"""w_f of the proofs."""
K_R, ALPHA, PUBLISHED_V_M = 5.0, 10.0, 1e-2
"""Constants of ARMOUR's Kinova arm without gripper [1/s, 1/s, N m rad]."""
BY_DESIGN = "by design"
"""Instead of a verdict: the control law has the guarantee for every uncertainty."""
GUARANTEED = (BY_DESIGN, str(ij.proofs.Verdict.PROVED))
COLUMNS = [
    "controller",
    "masses",
    "constants",
    "guarantee",
    "position [mrad]",
    "velocity [rad/s]",
    "robust input [N m]",
    "error [mrad]",
    "velocity error [rad/s]",
    "feedback [N m]",
    "period [ms]",
]


class Case(NamedTuple):
    """A proof."""

    K2: float
    kf: float
    width: float
    """Relative half-width of the intervals of masses and inertias."""
    level: float


QUICK = Case(3.0, 100.0, 0.01, 1e-4)
CASES = (
    Case(3.0, 100.0, 0.03, 1.0),
    Case(3.0, 100.0, 0.03, 1e-4),
    Case(3.0, 100.0, 0.1, 1e-3),
    Case(10.0, 200.0, 0.01, 1.0),
)
WIDE = 0.3
"""Half-width of a last row; the largest one in the publication's comparison of controllers."""


class Guarantee(NamedTuple):
    """A closed loop and its guaranteed tube."""

    controller: str
    constants: str
    scenario: ij.Scenario
    width: float
    verdict: str
    """Of `ij.prove`, or `BY_DESIGN`."""
    position: float
    """rad."""
    velocity: float
    """rad/s."""
    robust_input: Any
    """N m; "-" where no bound is stated."""


@ij.component
class RobustPassivity:
    """tau = M0 v' + C0 v + G0 + lambda r,   v = q_d' + k_r e,   e = q_d - q,   r = v - q'.

    With V = r^T M r / 2 and the disturbance w of the uncertain parameters, |w_i| <= w_bound_i,

        lambda = max(0, alpha (V_bound - V_M) + |r|^T w_bound) / |r|^2

    makes {V <= V_M} invariant.

    Args:
      k_r: gain of the position error, () [1/s], > 0.
      alpha: rate at which V may approach V_M, () [1/s], > 0.
      V_M: level of V, () [N m rad], > 0.
      width: relative half-width of the interval of each link's mass and inertia, (n,) [1].
    """

    k_r: ij.Leaf = ij.leaf("1/s", sign="positive", shape="scalar")
    alpha: ij.Leaf = ij.leaf("1/s", sign="positive", shape="scalar")
    V_M: ij.Leaf = ij.leaf("N m rad", sign="positive", shape="scalar")
    width: ij.Leaf = ij.leaf("1", sign="nonnegative")
    uses_observer: ClassVar[bool] = False

    def command(self, t, q, dq, f_hat, context, state):
        """The torque."""
        tube, model = context.tube(t), context.model
        v = tube.dq_d + self.k_r * (tube.q_d - q)
        dv = tube.ddq_d + self.k_r * (tube.dq_d - dq)
        r = v - dq
        parts = link_torques(model, q, dq, v, dv)
        tau = jnp.sum(parts, axis=1) + self.gain(model, q, r, parts) * r
        never = jnp.zeros(q.shape, bool)
        return ij.controllers.Command(tau, v, 0.0 * q, never, never), ()

    def gain(self, model, q, r, parts):
        """lambda, () [N m s/rad]."""
        energies = jax.jacfwd(lambda factors: energy(scaled(model, factors), q, r))
        V_bound = jnp.sum((1.0 + self.width) * energies(jnp.ones(model.n)))
        w_bound = jnp.abs(parts) @ self.width
        needed = self.alpha * (V_bound - self.V_M) + jnp.abs(r) @ w_bound
        # `needed` is negative at r = 0, so that the constant only prevents 0/0.
        return jnp.maximum(needed, 0.0) / jnp.maximum(r @ r, 1e-30)


def scaled(robot, factors):
    """A robot with the mass and the moment of inertia of each link times a factor."""
    return dataclasses.replace(robot, mass=robot.mass * factors, inertia=robot.inertia * factors)


def energy(robot, q, r):
    """r^T M r / 2, () [N m rad]."""
    return 0.5 * r @ (robot.mass_matrix(q) @ r)


def link_torques(robot, q, dq, v, dv):
    """The contribution of each link to M v' + C v + G, (n, n) [N m], one column for each link.

    The torque is linear in the factors of the links.
    """

    def torque(factors):
        one = scaled(robot, factors)
        return one.mass_matrix(q) @ dv + one.coriolis(q, dq, v) + one.gravity(q)

    return jax.jacfwd(torque)(jnp.ones(robot.n))


def eigenvalues(robot, width: float) -> tuple[float, float]:
    """The least and the largest eigenvalue of M over all positions and parameters [kg m^2].

    M is a sum of positive semidefinite terms, one for each link, and depends on q2 only.
    """
    angles = jnp.linspace(0.0, np.pi, 721)
    matrices = jax.vmap(robot.mass_matrix)(jnp.stack([0.0 * angles, angles], axis=1))
    values = np.linalg.eigvalsh(matrices)
    return float((1.0 - width) * values.min()), float((1.0 + width) * values.max())


def loop(case: Case) -> ij.Scenario:
    """The barrier law with the gains of a case; the start is on the reference, with f_hat = 0."""
    paper = ij.presets.zhang_yan_2024(variant="corrected")
    tube = paper.context.tube(jnp.asarray(0.0))
    base = ij.with_parts(
        paper,
        disturbance=ij.disturbances.Nothing(),
        observer=ij.observers.Momentum(kf=case.kf, start="matched"),
        initial=ij.Initial(q=tube.q_d, dq=tube.dq_d),
    )
    return ij.with_parameters(base, {"controller.K2": case.K2})


def runs(scenario: ij.Scenario, width: float, duration: float) -> Iterator[ij.Rollout]:
    """A run for each corner of the box of masses."""
    for signs in itertools.product([-1.0, 1.0], repeat=scenario.n):
        true = scaled(scenario.model, 1.0 + width * jnp.array(signs))
        yield ij.simulate(ij.with_parts(scenario, plant=true), duration=duration, dt=DT)


def level_of_start(scenario: ij.Scenario, width: float) -> float:
    """The largest V_w of the starts; their e1 and e2 are zero."""
    errors = [run.disturbance[0] - run.disturbance_estimate[0] for run in runs(scenario, width, DT)]
    return max(0.5 * WEIGHT * float(error @ error) for error in errors)


def level_set(case: Case) -> Guarantee:
    """The level set of a case, and the verdict on it."""
    scenario = loop(case)
    masses = ij.factor(ij.interval(1.0 - case.width, 1.0 + case.width))
    proof = ij.prove(
        scenario,
        level=case.level,
        parameters={"plant.mass, plant.inertia": masses},
        weight=WEIGHT,
        progress=False,
    )
    if level_of_start(scenario, case.width) > case.level:
        raise SystemExit(f"The runs start outside the level set of {case}.")
    tube = proof.tube
    position = np.max(np.abs([tube.upper - tube.reference, tube.lower - tube.reference]))
    return Guarantee(
        "barrier law",
        f"K2 = {case.K2:g}, kf = {case.kf:g}, level {case.level:g}",
        scenario,
        case.width,
        str(proof.verdict),
        float(position),
        velocity_of_level(scenario, case.level, proof.duration),
        "-",
    )


def velocity_of_level(scenario: ij.Scenario, level: float, duration: float) -> float:
    """The largest |q' - q_d'| in {V_w <= level}, of a grid of times and position errors [rad/s].

    q' = alpha + e2, and |e2_i| <= sqrt(2 (level - V1) (M0^-1)_ii).
    """
    law: Any = scenario.controller
    sides = jnp.array(list(itertools.product([False, True], repeat=scenario.n)))
    angles, share = jnp.linspace(0.0, np.pi / 2, 13), jnp.linspace(0.0, 1.0, 17)
    directions = jnp.stack([jnp.cos(angles) ** 2, jnp.sin(angles) ** 2], axis=1)
    energies = (level * share[:, None, None] * directions).reshape(-1, scenario.n)

    def speeds(t, above, V1):
        tube = scenario.context.tube(t)
        q = tube.q_d + law.barrier.error_at(V1 / law.weight, tube, above)
        zero = jnp.zeros(scenario.n)
        alpha = law.command(t, q, zero, zero, scenario.context, ())[0].alpha
        inverse = jnp.diagonal(jnp.linalg.inv(scenario.model.mass_matrix(q)))
        left = jnp.maximum(level - jnp.sum(V1), 0.0)
        return jnp.abs(alpha - tube.dq_d) + jnp.sqrt(2.0 * left * inverse)

    of_times = jax.vmap(speeds, (0, None, None))
    of_all = jax.vmap(jax.vmap(of_times, (None, 0, None)), (None, None, 0))
    times = jnp.linspace(0.0, duration, 129)
    return float(jnp.max(jax.jit(of_all)(times, sides, energies)))


def robust_passivity(case: Case, V_M: float) -> Guarantee:
    """ARMOUR's controller and its tube: |r| <= eps, |e_j| <= eps/k_r, |e_j'| <= 2 eps."""
    base = loop(case)
    law = RobustPassivity(k_r=K_R, alpha=ALPHA, V_M=V_M, width=[case.width] * base.n)
    scenario = ij.with_parts(base, controller=law, observer=ij.observers.NoObserver())
    eps = float(np.sqrt(2.0 * V_M / eigenvalues(base.model, case.width)[0]))
    return Guarantee(
        "ARMOUR",
        f"k_r = {K_R:g}, alpha = {ALPHA:g}, V_M = {V_M:.2g}",
        scenario,
        case.width,
        BY_DESIGN,
        eps / K_R,
        2.0 * eps,
        robust_input_bound(scenario, case.width, eps),
    )


def level_of_tube(case: Case, position: float) -> float:
    """V_M for which ARMOUR's tube of positions has a half-width [rad]."""
    sigma_m, _ = eigenvalues(loop(case).model, case.width)
    return 0.5 * sigma_m * (K_R * position) ** 2


def robust_input_bound(scenario: ij.Scenario, width: float, eps: float) -> float:
    """The largest (alpha eps (sigma_M - sigma_m) + |w| + w_j)/2 of a grid of the tube [N m]."""
    law: Any = scenario.controller
    sigma_m, sigma_M = eigenvalues(scenario.model, width)
    errors = eps / K_R * jnp.array(list(itertools.product([-1.0, 0.0, 1.0], repeat=scenario.n)))
    angles = jnp.linspace(0.0, 2 * np.pi, 33)
    surfaces = eps * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)

    def bound(t, e, r):
        tube = scenario.context.tube(t)
        de = r - K_R * e
        v, dv = tube.dq_d + K_R * e, tube.ddq_d + K_R * de
        w = jnp.abs(link_torques(scenario.model, tube.q_d - e, v - r, v, dv)) @ law.width
        rise = law.alpha * eps * (sigma_M - sigma_m)
        return 0.5 * (rise + jnp.linalg.norm(w) + w)

    of_times = jax.vmap(bound, (0, None, None))
    of_all = jax.vmap(jax.vmap(of_times, (None, 0, None)), (None, None, 0))
    return float(jnp.max(jax.jit(of_all)(jnp.linspace(0.0, 2 * np.pi, 65), errors, surfaces)))


class Measured(NamedTuple):
    """The largest numbers of some runs."""

    error: float
    """rad."""
    velocity_error: float
    """rad/s."""
    feedback: float
    """N m."""


def measured(guarantee: Guarantee, duration: float, period: float | None = None) -> Measured:
    """The largest numbers of the runs of the corners, of a continuous or a sampled law."""
    scenario = guarantee.scenario
    if period is not None:
        scenario = ij.with_parts(scenario, sampling=ij.Sampling(period=period))
    model = scenario.model

    @jax.jit
    @jax.vmap
    def needed(t):
        tube = scenario.context.tube(t)
        return jnp.sum(link_torques(model, tube.q_d, tube.dq_d, tube.dq_d, tube.ddq_d), axis=1)

    found = []
    for run in runs(scenario, guarantee.width, duration):
        numbers = (run.e1, run.dq - run.dq_d, run.tau - needed(run.t))
        found.append([float(jnp.max(jnp.abs(x))) for x in numbers])
    return Measured(*np.max(found, axis=0).tolist())


def is_inside(found: Measured, guarantee: Guarantee) -> bool:
    """Whether runs stay inside the tube."""
    return found.error <= guarantee.position and found.velocity_error <= guarantee.velocity


def longest_period(guarantee: Guarantee, duration: float, periods: tuple[float, ...]) -> float:
    """The longest period [ms] up to which the runs stay inside the tube; 0 for none."""
    longest = 0.0
    for period in periods:
        if not is_inside(measured(guarantee, duration, period), guarantee):
            break
        longest = 1e3 * period
    return longest


def row(guarantee: Guarantee, duration: float, periods: tuple[float, ...]) -> list[Any]:
    """The numbers of a guarantee.

    Raises:
      RuntimeError: a continuous run leaves a tube that is guaranteed.
    """
    found = measured(guarantee, duration)
    if guarantee.verdict in GUARANTEED and not is_inside(found, guarantee):
        raise RuntimeError(f"{guarantee} is violated by {found}.")
    return [
        guarantee.controller,
        f"{100 * guarantee.width:g} %",
        guarantee.constants,
        guarantee.verdict,
        1e3 * guarantee.position,
        guarantee.velocity,
        guarantee.robust_input,
        1e3 * found.error,
        found.velocity_error,
        found.feedback,
        longest_period(guarantee, duration, periods),
    ]


def guarantees(cases: tuple[Case, ...]) -> list[Guarantee]:
    """Both controllers for each case; ARMOUR's for more uncertain masses, and with the published
    V_M.
    """
    found = []
    for case in cases:
        barrier_law = level_set(case)
        found += [barrier_law, robust_passivity(case, level_of_tube(case, barrier_law.position))]
    small = min(found, key=lambda one: one.position)
    wide = cases[0]._replace(width=WIDE)
    return [
        *found,
        robust_passivity(wide, level_of_tube(wide, small.position)),
        robust_passivity(cases[0], PUBLISHED_V_M),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="0.2 s of motion, one proof")
    parser.add_argument("--json", help="also write the table to this file")
    args = parser.parse_args()
    cases, duration, periods = CASES, DURATION, PERIODS
    if args.quick:
        cases, duration, periods = (QUICK,), 0.2, PERIODS[:1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ARMOUR knows no bounds; periods grow until they fail
        rows = [row(one, duration, periods) for one in guarantees(cases)]
    title = f"Guaranteed tubes of uncertain masses, {duration:.3g} s of the paper's motion"
    report(title, COLUMNS, rows, args.json)


if __name__ == "__main__":
    main()
