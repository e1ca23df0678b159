"""Default ranges of what is tuned: within the conditions of Theorem 2, and within what step, period
and drive can bear.

Below, k1 > 0, K2 > 1/2, kf > 1, for a leaf whose entries all start there, else its sign.  Above, a
gain x may grow to f x0, f <= MOST, while the loop at the start and along its reference keeps

    dt |lambda|_max <= SHARE * (the integrator's stability range)                  where the law
    runs all the time, rho(map from a period to the next) < 1
    where it is sampled, the drive, at rest, can give each torque of |d tau / d y_j| r_j  and
    (sum_kj (d tau / d w_kj)^2)^(1/2)      where there is a sensor:

one count r_j of a joint's encoder, and one standard deviation of all its noise w, are steps of the
command that no motion asked for; where one alone asks a drive for more torque, or a higher rate of
it (bandwidth times the step, behind a lag), than it has, what is tracked is the encoder.  A drive
of which the starting gains already ask as much sets no limit.

Each gain is looked at alone first, the others at their start.  Then all that have default ranges
are moved together, each to f_i^s x0: s is the largest number up to 1 with which the same still
holds.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.simulation.closed_loop import LoopState, run_sampled_law
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.tuning.runs import fastest_along, radius_at, start_and_along

CONDITIONS = {"controller.k1": 0.05, "controller.K2": 0.505, "observer.kf": 1.01}
"""Default lower limits: just inside Theorem 2's conditions (3.17), (3.25) on the gains of the
paper's law."""
SHARE = 0.7
"""Part of the integrator's stability range that gains may use up by default."""
TIMES = np.linspace(0.0, 6.0, 7)
"""Along the reference, where is looked for how fast a loop is, and what it makes of a count [s]."""
MOST = 1e2
"""How far above its start a gain may go by default, as a factor, where nothing else sets a
limit."""
HALVINGS = 10
ROOM = 1.01
"""Where the start itself is too much, the range ends so far above it, as a factor."""
GIVEN, THEOREM, SIGN, NONE = "as given", "the conditions of Theorem 2", "its sign", "none"
FACTOR = f"{MOST:g} times its start"
STEP, PERIOD = (
    "beyond it the step dt is too long for the loop",
    "beyond it the loop is unstable at its sampling period",
)
COUNT = (
    "beyond it a count of the encoder asks for more torque, or a higher rate of it, than the drive"
    " gives"
)
NOISE = (
    "beyond it the sensor's noise asks for more torque, or a higher rate of it, than the drive"
    " gives"
)
TOGETHER = ", with all gains at their upper ends"


def default_low(path: str, sign: str | None, start: np.ndarray) -> tuple[float, str]:
    """The lower end of the range of a leaf that starts at `start`, and what set it."""
    leaf = re.sub(r"(\[\d+\])+$", "", path)
    if leaf in CONDITIONS and np.all(start >= CONDITIONS[leaf]):
        return CONDITIONS[leaf], THEOREM
    return (0.0, SIGN) if sign in ("positive", "nonnegative") else (-np.inf, NONE)


def default_highs(
    scenario: Scenario, values: dict[str, np.ndarray], dt: float, method: str
) -> dict[str, tuple[np.ndarray, str]]:
    """The upper ends of the ranges of some leaves, and what set each.

    Args:
      scenario: canonical.
      values: path -> where the leaf starts.
      dt, method: how runs are stepped.
    """
    gains = {
        path: x
        for path, x in values.items()
        if path.startswith(("controller.", "observer.")) and np.all(x > 0)
    }
    ends: dict[str, tuple[np.ndarray, str]] = {
        path: (np.full(x.shape, np.inf), NONE) for path, x in values.items() if path not in gains
    }
    by_drive = not too_much_for_drive(scenario)

    def unfit(scaled: dict[str, float]) -> str:
        changed = with_parameters(
            scenario, {path: jnp.asarray(gains[path] * np.exp(x)) for path, x in scaled.items()}
        )
        if changed.sampling is None:
            fits = dt * fastest_along(changed, TIMES) <= SHARE * tableau(method).stability
            return "" if fits else STEP
        return (
            PERIOD
            if sampled_too_slowly(changed)
            else too_much_for_drive(changed)
            if by_drive
            else ""
        )

    def one(path: str, share: float) -> str:
        return unfit({path: share * float(np.log(MOST))})

    reach, why = {}, {}
    for path in gains:
        share, reason = _longest(partial(one, path))
        reach[path], why[path] = share * np.log(MOST), reason or FACTOR
    share, reason = (
        _longest(lambda s: unfit({path: s * x for path, x in reach.items()}))
        if len(gains) > 1
        else (1.0, "")
    )
    for path, x in gains.items():
        shortened = reason and reach[path] > 0
        factor = np.exp(share * reach[path]) if reach[path] > 0 else 1.0
        ends[path] = max(factor, ROOM) * x, reason + TOGETHER if shortened else why[path]
    return ends


def _longest(unfit: Callable[[float], str]) -> tuple[float, str]:
    """The largest share s up to 1 that is fit, 0 if none is found, and what is wrong beyond it."""
    if not (reason := unfit(1.0)):
        return 1.0, ""
    if first := unfit(0.0):
        return 0.0, first
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        found = unfit(middle)
        low, high, reason = (low, middle, found) if found else (middle, high, reason)
    return low, reason


def sampled_too_slowly(scenario: Scenario) -> bool:
    """Whether the law is sampled and its loop grows from one period to the next."""
    sampling = scenario.sampling
    return sampling is not None and not radius_at(scenario, float(sampling.period), TIMES) < 1.0


def too_much_for_drive(scenario: Scenario) -> str:
    """What of the sensor, a count or its noise, asks for more than the actuator gives from rest;
    empty where nothing does.
    """
    if scenario.sampling is None or not hasattr(scenario.actuator, "unlimited"):
        return ""
    asked = _asked(scenario, jnp.asarray(TIMES, scenario.initial.q.dtype))
    zero = jnp.zeros_like(scenario.initial.q)
    rest = scenario.actuator.init(zero)
    for reason, torques in zip((COUNT, NOISE), asked, strict=True):
        limited = jax.vmap(lambda tau: scenario.actuator.deliver(tau, zero, rest).limited)(
            torques.reshape(-1, scenario.n)
        )
        if bool(jnp.any(limited)):
            return reason
    return ""


@jax.jit
def _asked(scenario: Scenario, times: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Steps of the command by one count of each joint (T + 1, n, n), and the standard deviation by
    the noise (T + 1, n), [N m].
    """
    sensor = scenario.sensor
    smooth = dataclasses.replace(scenario, sensor=getattr(sensor, "unrounded", sensor))
    count = jnp.broadcast_to(
        jnp.asarray(getattr(sensor, "resolution", 0.0), times.dtype), (scenario.n,)
    )

    def command(t: jax.Array, state: LoopState, q: jax.Array, normal: jax.Array) -> jax.Array:
        return run_sampled_law(smooth, t, state._replace(q=q), normal).sampled.commands[0]

    def at(t: jax.Array, state: LoopState) -> tuple[jax.Array, jax.Array]:
        normal = jnp.zeros((sensor.draws, scenario.n), times.dtype)
        by_q, by_noise = jax.jacfwd(partial(command, t, state), argnums=(0, 1))(state.q, normal)
        return by_q.T * count[:, None], jnp.sqrt(jnp.sum(by_noise**2, axis=(1, 2)))

    return jax.vmap(at)(
        jnp.concatenate([jnp.zeros_like(times[:1]), times]), start_and_along(scenario, times)
    )
