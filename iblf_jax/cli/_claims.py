"""The claims of the paper about its figures (section 4), each checked against the two runs.

The text of each claim names the numbers and the tolerance that decide it.  "Late" means the second
half of a run; the initial stage is its first second.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from iblf_jax.core.status import Status, has_flag

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from iblf_jax.control.barriers import Barrier
    from iblf_jax.simulation.results import Rollout

Pair = Mapping[str, "Rollout"]
"""The two runs by name: the integral form first, then the logarithmic one."""
ByName = Mapping[str, np.ndarray]
"""One number per joint, (n,), for each run by name."""

INITIAL_STAGE = 1.0
"""s."""
NEIGHBOURHOOD = 0.01
"""A late error below this share of its own peak counts as a very small neighbourhood of zero."""
ESTIMATE_SHARE = 0.1
"""The estimate follows the uncertain term if its late error stays below this share of the term's
peak."""
SETTLED = 0.01
"""rad; the tolerance of the metric settling_time."""


class PaperClaim(NamedTuple):
    """One claim of the paper, whether the runs confirm it, and the numbers that decide it."""

    claim: str
    confirmed: bool
    detail: str
    numbers: dict[str, Any]


def paper_claims(runs: Pair) -> list[PaperClaim]:
    """Checks every claim.

    Args:
      runs: two runs by name, of the integral and the logarithmic law, in this order.
    """
    return [
        bounds_kept(runs),
        both_track(runs),
        faster(runs),
        more_accurate(runs),
        overshoot_of_e2(runs),
        estimate_follows(runs),
        small_neighbourhood(runs),
        theorem_1(runs),
    ]


def each_joint(values: ArrayLike, unit: str) -> str:
    """One number per joint as text, such as 0.99 / 0.71 s."""
    numbers = np.ravel(np.asarray(values, float))
    shown = " / ".join(f"{x:.3g}" if np.isfinite(x) else "never" for x in numbers)
    return f"{shown} {unit}".rstrip()


def _versus(by_name: Mapping[str, Any], unit: str) -> str:
    return ", ".join(f"{name} {each_joint(values, unit)}" for name, values in by_name.items())


def _peak(values: ArrayLike) -> np.ndarray:
    return np.abs(np.asarray(values)).max(axis=0)


def _late_peak(run: Rollout, values: ArrayLike) -> np.ndarray:
    """The peak over the second half of a run, (n,)."""
    t = np.asarray(run.t)
    return _peak(np.asarray(values)[t >= 0.5 * t[-1]])


def _are_below(values: ByName, share: float, peaks: ByName) -> bool:
    """Whether the values of every run and joint are below a share of their peaks."""
    return all(bool(np.all(values[name] < share * peaks[name])) for name in values)


def _metric(runs: Pair, name: str) -> ByName:
    return {label: np.asarray(run.metrics[name]) for label, run in runs.items()}


def bounds_kept(runs: Pair) -> PaperClaim:
    """Claim: the constraint boundaries are not broken."""
    margins = _metric(runs, "margin")
    flagged = [
        name for name, run in runs.items() if has_flag(int(run.status), Status.BOUND_VIOLATED)
    ]
    confirmed = not flagged and all(np.all(m > 0) for m in margins.values())
    detail = f"smallest distance to a bound, joint by joint: {_versus(margins, 'rad')}."
    return PaperClaim(
        "Neither law violates its time-varying asymmetric bounds.",
        confirmed,
        detail,
        {"margin [rad]": margins},
    )


def both_track(runs: Pair) -> PaperClaim:
    """Claim: the robot tracks the reference under both laws."""
    times = _metric(runs, "settling_time")
    confirmed = all(np.all(np.isfinite(x)) for x in times.values())
    detail = f"|e1| stays under {SETTLED:g} rad from: {_versus(times, 's')}."
    return PaperClaim(
        "Both laws track the reference.", confirmed, detail, {"settling_time [s]": times}
    )


def faster(runs: Pair) -> PaperClaim:
    """Claim: the trajectory converges more quickly under the proposed law."""
    times = _metric(runs, "settling_time")
    proposed, compared = times.values()
    confirmed = bool(np.all(np.isfinite(proposed)) and np.all(proposed < compared))
    detail = f"settling times {_versus(times, 's')}"
    if confirmed and np.all(np.isfinite(compared)):
        detail += f": sooner by {each_joint(100.0 * (1.0 - proposed / compared), '%')}"
    return PaperClaim(
        "The integral form converges faster.", confirmed, f"{detail}.", {"settling_time [s]": times}
    )


def more_accurate(runs: Pair) -> PaperClaim:
    """Claim: the control accuracy is slightly higher, the tracking error smaller."""
    rmse = _metric(runs, "rmse")
    late = {name: _late_peak(run, run.e1) for name, run in runs.items()}
    confirmed = _first_is_smaller(rmse) and _first_is_smaller(late)
    detail = f"rms of e1 {_versus(rmse, 'rad')}; largest late |e1| {_versus(late, 'rad')}."
    return PaperClaim(
        "The integral form is slightly more accurate.",
        confirmed,
        detail,
        {"rmse [rad]": rmse, "late |e1| [rad]": late},
    )


def _first_is_smaller(values: ByName) -> bool:
    proposed, compared = values.values()
    return bool(np.all(proposed < compared))


def overshoot_of_e2(runs: Pair) -> PaperClaim:
    """Claim: the overshoot of the velocity error is greater in the initial stage."""
    overshoots = {}
    for name, run in runs.items():
        e2 = np.asarray(run.e2)[np.asarray(run.t) <= INITIAL_STAGE]
        overshoots[name] = np.maximum(0.0, (-np.sign(e2[0]) * e2).max(axis=0))
    proposed, compared = overshoots.values()
    shown = _versus(overshoots, "rad/s")
    detail = f"overshoot of e2 beyond zero in the first {INITIAL_STAGE:g} s: {shown}."
    confirmed = bool(np.all(proposed > compared))
    return PaperClaim(
        "The integral form overshoots more in e2 at the start.",
        confirmed,
        detail,
        {"overshoot of e2 [rad/s]": overshoots},
    )


def _estimate_errors(runs: Pair) -> tuple[ByName, ByName]:
    """The largest late |f - f_hat| and the peak of |f| of each run, each (n,) [N m]."""
    late = {
        name: _late_peak(run, run.disturbance - run.disturbance_estimate)
        for name, run in runs.items()
    }
    peak = {name: _peak(run.disturbance) for name, run in runs.items()}
    return late, peak


def estimate_follows(runs: Pair) -> PaperClaim:
    """Claim: the observer's estimate tends to the uncertain term."""
    late, peak = _estimate_errors(runs)
    confirmed = _are_below(late, ESTIMATE_SHARE, peak)
    share = {name: 100.0 * late[name] / peak[name] for name in runs}
    detail = (
        f"largest late |f - f_hat|: {_versus(late, 'N m')}; as a share of the peak of |f|:"
        f" {_versus(share, '%')} (confirmed if under {100 * ESTIMATE_SHARE:g} %; the observer"
        " lags by 1/kf, so about |f'|/kf remains)."
    )
    return PaperClaim(
        "The observer's estimate tends to the uncertain term.",
        confirmed,
        detail,
        {"late |f - f_hat| [N m]": late, "peak |f| [N m]": peak},
    )


def small_neighbourhood(runs: Pair) -> PaperClaim:
    """Claim: e1, e2 and f_tilde tend to a very small neighbourhood of zero."""
    e1 = {name: _late_peak(run, run.e1) for name, run in runs.items()}
    e2 = {name: _late_peak(run, run.e2) for name, run in runs.items()}
    f_tilde, peak = _estimate_errors(runs)
    confirmed = (
        _are_below(e1, NEIGHBOURHOOD, {name: _peak(run.e1) for name, run in runs.items()})
        and _are_below(e2, NEIGHBOURHOOD, {name: _peak(run.e2) for name, run in runs.items()})
        and _are_below(f_tilde, ESTIMATE_SHARE, peak)
    )
    detail = (
        f"largest late values: |e1| {_versus(e1, 'rad')}; |e2| {_versus(e2, 'rad/s')}; |f_tilde|"
        f" {_versus(f_tilde, 'N m')} (confirmed if e1 and e2 are under {100 * NEIGHBOURHOOD:g} % of"
        f" their peaks, f_tilde under {100 * ESTIMATE_SHARE:g} % of the peak of |f|)."
    )
    numbers = {"late |e1| [rad]": e1, "late |e2| [rad/s]": e2, "late |f_tilde| [N m]": f_tilde}
    return PaperClaim(
        "The error signals tend to a very small neighbourhood of zero.", confirmed, detail, numbers
    )


def _along(run: Rollout, barrier: Barrier) -> tuple[np.ndarray, np.ndarray]:
    """V1 of a barrier and xi at every sample of a run, (T, n) each.

    Both come from one evaluation of the bounds, so that no rounding separates them.
    """
    import jax

    def at(t, q):
        tube = run.scenario.context.tube(t)
        return barrier.value(tube, q), tube.xi(q)

    V1, xi = jax.jit(jax.vmap(at))(run.t, run.q)
    return np.asarray(V1), np.asarray(xi)


def theorem_1(runs: Pair) -> PaperClaim:
    """Claim: xi^2/2 <= V1 <= xi^2/(1 - xi^2) (Theorem 1) along the run of the integral form."""
    from iblf_jax.control.barriers import Integral

    run = next(iter(runs.values()))
    V1, xi = _along(run, Integral())
    low = 0.5 * xi**2
    high = xi**2 / (1.0 - xi**2)
    rounding = 8 * np.finfo(V1.dtype).eps * high + np.finfo(V1.dtype).tiny
    kept = (low <= V1 + rounding) & (high + rounding >= V1)
    broken = int(np.sum(~kept))
    at = np.unravel_index(np.argmax(np.abs(xi)), xi.shape)
    detail = (
        f"checked at {V1.size} samples of xi, broken at {broken}; at the largest |xi| ="
        f" {abs(xi[at]):.4g}: {low[at]:.4g} <= {V1[at]:.4g} <= {high[at]:.4g}."
    )
    numbers = {
        "samples": V1.size,
        "broken": broken,
        "largest |xi|": abs(xi[at]),
        "lower": low[at],
        "V1": V1[at],
        "upper": high[at],
    }
    return PaperClaim(
        "Theorem 1 holds along the run: xi^2/2 <= V1 <= xi^2/(1 - xi^2).",
        broken == 0,
        detail,
        numbers,
    )


def assumed(runs: Pair) -> str:
    """The numbers of the arm, which the paper does not print, as text."""
    arm: Any = next(iter(runs.values())).scenario.plant  # the preset's TwoLink
    numbers = (
        ("masses", arm.mass, "kg"),
        ("lengths", arm.length, "m"),
        ("centres of mass", arm.centre, "m"),
        ("moments of inertia", arm.inertia, "kg m^2"),
    )
    values = ", ".join(f"{name} {_all_digits(value)} {unit}" for name, value, unit in numbers)
    return (
        "the paper prints no masses, lengths, centres of mass or inertias of its arm. "
        "These runs ASSUME the numbers that are customary in this literature: "
        f"{values}, g = {float(arm.g):g} m/s^2. "
        "Torques, errors and times depend on them and need not be those of the paper's figures."
    )


def assumed_briefly(runs: Pair) -> str:
    """The assumed masses and lengths in a sentence, for the title of a figure."""
    arm: Any = next(iter(runs.values())).scenario.plant
    masses, lengths = _all_digits(arm.mass), _all_digits(arm.length)
    return f"Masses {masses} kg and lengths {lengths} m are assumed: the paper prints none."


def _all_digits(values: ArrayLike) -> str:
    """One number per joint as text, in six significant digits."""
    return " / ".join(f"{x:.6g}" for x in np.ravel(np.asarray(values, float)))


def remark(runs: Pair) -> str:
    """A remark on the comparison: the two barriers differ by a factor of two."""
    from iblf_jax.control.barriers import Integral, Log

    run = next(iter(runs.values()))
    integral, _ = _along(run, Integral())
    log, _ = _along(run, Log(p=1))
    worst = float(np.max(np.abs(integral - 2.0 * log)))
    return (
        "V_integral = 2 V_log (p = 1) identically (largest difference along this run:"
        f" {worst:.1g}). So with equal gains the integral form has twice the barrier term in its"
        " torque, and that factor is the only difference between these two runs: a log law whose"
        " barrier term is doubled is the same law. The comparison shows the gain of the barrier"
        " term, not the form of the barrier."
    )
