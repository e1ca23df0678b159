"""Choosing a law: accuracy, peak torque and robustness of laws whose gains have one factor.

    python benchmarks/laws.py [--quick] [--json FILE] [--only NAME]

The paper's arm, reference, bounds and disturbance.  The gains of each law are scaled by the factor
at which its RMS torque above gravity is that of the first law (`ij.compare`).  Errors are the
largest |e1| of both joints in the second half of a run, so that the start does not count:

- `error`: continuous law, exact model.
- `peak torque`: of the entire run.
- `error, masses +-30 %`: the larger error of two plants whose masses are 0.7 and 1.3 times those of
  the model.
- `error, encoder and 10 ms`: law and observer run once in 10 ms and read an encoder of 65536
  counts, with filtered differences as velocities.
- `ripple`: the RMS difference of the torque with this encoder, at a period of 1 ms, from that of
  the continuous law.
- `delay`: the longest delay of the torque of the list `DELAYS`, with this encoder at a period of
  1 ms, for which this and every shorter delay leaves the arm inside its bounds.

"left" is a run that leaves the bounds or diverges, and "own" a law that has no factor in [1/32, 32]
at which its effort is that of the first law, and runs at its own gains.  A new law is one entry of
`CHOICES`; `docs/choosing.py` makes the page.  `AdaptiveNetwork` has no row, because its program
takes minutes to compile.

The JSON file also has `settings`, the error of the first law at a period of 10 ms for other K2 and
encoders, and `messages`, its commands with an event trigger.  A trigger belongs to the loop and not
to a law, and is therefore no column.
"""

from __future__ import annotations

import argparse
import dataclasses
import warnings
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np
from _timing import report

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, decays, observers, sensors

DT = 1e-3
"""s."""
DURATION = 4.0
"""s."""
DELAYS = (1e-3, 2e-3, 4e-3, 8e-3, 16e-3, 32e-3)
"""s."""
K2 = 2.0
"""N m s/rad, a tenth of the paper's, so that a period of 10 ms is possible."""
COUNTS = 65536
"""Of the encoder, as of a geared joint.  `settings` has the errors with other K2 and counts."""
PERIOD = 1e-2
"""s, the longer period; the shorter one is `DT`."""
ENCODER = sensors.Encoder(counts=COUNTS, velocity=sensors.FilteredDifference(cutoff=200.0))
TRIGGER = ij.EventTrigger(relative=0.05, absolute=0.02)
LEFT, OWN = "left", "own"
COLUMNS = [
    "law",
    "factor",
    "error [mrad]",
    "peak torque [N m]",
    "error, masses +-30 % [mrad]",
    "error, encoder and 10 ms [mrad]",
    "ripple [N m]",
    "delay [ms]",
]


class Choice(NamedTuple):
    """A law of the table."""

    law: Any
    """A name of `ij.compare`, or a law."""
    parts: dict[str, Any] = {}  # noqa: RUF012 - a constant
    """Parts of the scenario that the law needs, such as bounds on velocities."""


def _box(limit: float) -> ij.Bounds:
    """The same two constant bounds for all joints."""
    return ij.Bounds(lower=bounds.Constant(-limit), upper=bounds.Constant(limit))


NODES = 16
"""Of the networks; the time to compile grows with them."""
CORRECTED = controllers.Backstepping(k1=2.0, K2=K2, variant="corrected")
POSITIONS = ij.presets.zhang_yan_2024().bounds[0]
CHOICES = {
    "Backstepping(Integral)": Choice("integral"),
    "Backstepping(Log)": Choice("log"),
    "Backstepping(Tan)": Choice("tan"),
    "Backstepping(TransformedError)": Choice(
        controllers.Backstepping(
            k1=2.0, K2=K2, barrier=barriers.TransformedError(), variant="corrected"
        )
    ),
    "Backstepping(TransformedError), finite time": Choice(
        controllers.Backstepping(
            k1=2.0,
            K2=K2,
            barrier=barriers.TransformedError(),
            variant="corrected",
            decays=decays.FiniteTime(k_a=0.2),
        )
    ),
    "Backstepping(Integral), q measured": Choice(
        "integral", {"observer": observers.StateObserver(bandwidth=100.0)}
    ),
    "Saturated(auxiliary)": Choice(controllers.Saturated(law=CORRECTED, limit=7.0, auxiliary=10.0)),
    "AdaptiveParameters(masses)": Choice(
        controllers.AdaptiveParameters(
            law=CORRECTED,
            parameters=("mass[0]", "mass[1]"),
            Gamma=[3.0, 3.0],
            lower=0.1,
            upper=4.0,
            sigma=0.01,
        )
    ),
    "AdaptiveRBF": Choice(controllers.AdaptiveRBF(k1=2.0, K2=K2, nodes=NODES)),
    "AdaptiveRBF, normalised": Choice(
        controllers.AdaptiveRBF(
            k1=2.0, K2=K2, nodes=NODES, normalised=True, Gamma=2000.0, sigma=1e-4, width=1.0
        )
    ),
    "Backstepping, no bounds": Choice("backstepping"),
    "BarrierBackstepping(TransformedError)": Choice(controllers.BarrierBackstepping(k=(2.0, 20.0))),
    "BarrierBackstepping(Integral, Integral)": Choice(
        "full_state", {"bounds": (POSITIONS, _box(3.0))}
    ),
    "DynamicSurface": Choice("dynamic_surface"),
    "SurfaceBarrier": Choice(controllers.SurfaceBarrier(a=2.0, K=K2, surface=_box(9.0))),
    "SafetyFilter": Choice("safety_filter"),
    "ReferenceGovernor": Choice("reference_governor"),
    "TerminalSlidingMode": Choice(controllers.TerminalSlidingMode(beta=2.0, K=20.0, layer=0.05)),
    "ComputedTorque": Choice("computed_torque"),
    "PDGravity": Choice("pd"),
}
"""Name in the table -> law.  The first one sets the effort."""


def row(name: str, duration: float = DURATION) -> list[Any]:
    """The numbers of a law."""
    first = next(iter(CHOICES))
    choice = CHOICES[name]
    base = ij.with_parts(_first(K2), **choice.parts)
    laws = {first: CHOICES[first].law, name: choice.law}
    compared = ij.compare(base, laws, duration=duration, dt=DT)
    run = compared.equal_effort.get(name, compared.rollouts[name])
    factor: Any = OWN
    if name in compared.equal_effort:
        factor = float(compared.factors[name])
    one = run.scenario
    errors_of_masses = []
    for scale in (0.7, 1.3):
        changed = ij.with_parts(one, plant=_with_masses_scaled(one.plant, scale))
        errors_of_masses.append(_error(_run(changed, duration)))
    # One structure, and therefore one compiled program, for all periods and delays.
    queue = round(DELAYS[-1] / DT) + 1
    fast = ij.with_parts(one, sensor=ENCODER, sampling=ij.Sampling(period=DT, queue=queue))
    slow = ij.with_parameters(fast, {"sampling.period": PERIOD})
    return [
        name,
        factor,
        _error(run),
        float(np.max(np.abs(run.tau))),
        _worst(errors_of_masses),
        _error(_run(slow, duration)),
        _ripple(run, _run(fast, duration)),
        _longest_delay(fast, duration),
    ]


def _first(gain: float) -> ij.Scenario:
    """The paper's scenario under the first law."""
    paper = ij.presets.zhang_yan_2024(variant="corrected")
    return ij.with_parameters(paper, {"controller.K2": gain})


def settings(duration: float = DURATION) -> list[dict[str, Any]]:
    """The error of the first law at the longer period, by K2 and encoder."""
    measured: dict[str, Any] = {
        "none, velocity measured": sensors.Ideal(),
        f"{COUNTS} counts": ENCODER,
        "4096 counts": dataclasses.replace(ENCODER, counts=4096),
    }
    rows = []
    for gain in (K2, 20.0):
        for words, sensor in measured.items():
            sampling = ij.Sampling(period=PERIOD)
            sampled = ij.with_parts(_first(gain), sensor=sensor, sampling=sampling)
            error = _error(_run(sampled, duration))
            rows.append({"K2 [N m s/rad]": gain, "encoder": words, "error, 10 ms [mrad]": error})
    return rows


def messages(duration: float = DURATION) -> list[dict[str, Any]]:
    """The commands that the first law sends with the encoder, without and with the trigger."""
    named = f"EventTrigger(relative={TRIGGER.relative:g}, absolute={TRIGGER.absolute:g})"
    rows = []
    for words, trigger in {"none": None, named: TRIGGER}.items():
        sampling = ij.Sampling(period=DT, trigger=trigger)
        run = _run(ij.with_parts(_first(K2), sensor=ENCODER, sampling=sampling), duration)
        rate = 1.0 / DT
        if trigger is not None:
            rate = float(run.metrics.event_count) / duration
        rows.append({"trigger": words, "messages per s": rate, "error [mrad]": _error(run)})
    return rows


def _with_masses_scaled(robot: Any, factor: float) -> Any:
    """A robot with all its masses and inertias times a factor."""
    values = {"mass": robot.mass * factor, "inertia": robot.inertia * factor}
    fields = {name: vars(robot)[name] for name in ("length", "centre")}
    return type(robot)(**fields, **values)


def _run(scenario: ij.Scenario, duration: float) -> ij.Rollout:
    return ij.simulate(scenario, duration=duration, dt=DT)


def _has_left(run: ij.Rollout) -> bool:
    """Whether a run left the bounds of the positions, or diverged."""
    return bool(int(run.status) & int(ij.Status.BOUND_VIOLATED | ij.Status.NOT_FINITE))


def _second_half(values: Any) -> np.ndarray:
    return np.asarray(values)[len(values) // 2 :]


def _error(run: ij.Rollout) -> Any:
    """The largest |e1| in the second half of a run [mrad]."""
    if _has_left(run):
        return LEFT
    return 1e3 * float(np.max(np.abs(_second_half(run.e1))))


def _worst(errors: list[Any]) -> Any:
    return LEFT if LEFT in errors else max(errors)


def _ripple(ideal: ij.Rollout, noisy: ij.Rollout) -> Any:
    """The RMS difference of two torques in the second half [N m]."""
    if _has_left(ideal) or _has_left(noisy):
        return LEFT
    return float(np.sqrt(np.mean(_second_half(noisy.tau - ideal.tau) ** 2)))


def _longest_delay(sampled: ij.Scenario, duration: float) -> float:
    """The longest of `DELAYS` [ms] up to which the arm stays inside its bounds; 0 for none."""
    longest = 0.0
    for delay in DELAYS:
        delayed = ij.with_parameters(sampled, {"sampling.delay": delay})
        if _has_left(_run(delayed, duration)):
            break
        longest = 1e3 * delay
    return longest


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="0.2 s of motion, one law")
    parser.add_argument("--only", nargs="+", choices=CHOICES, help="these rows")
    parser.add_argument("--json", help="also write the table to this file")
    args = parser.parse_args()
    names = list(CHOICES)
    if args.quick:
        names = names[:1]
    if args.only:
        names = args.only
    duration = 0.2 if args.quick else DURATION
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the table reports runs that leave the bounds
        rows = [row(name, duration) for name in names]
        further = {"settings": settings(duration), "messages": messages(duration)}
    title = f"Laws with one factor on their gains: {duration:g} s of the paper's motion"
    report(title, COLUMNS, rows, args.json, further)


if __name__ == "__main__":
    main()
