"""What certificates print: of every kind of claim, law, barrier, observer and plant, of those that
hold, that fail and that do not apply.

`tests/data/certificates.txt` has them.  The tests compare words, order and columns exactly, and
numbers to one in the last printed digit (`compared_texts`): another version of JAX rounds
otherwise.  Margins below 1e-9 are rounding only, and so is their place.  After a change that is
meant to move them,

    python tests/certificates/test_certificate_texts.py --write

writes the file anew.
"""

from __future__ import annotations

import functools
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")
TESTS = Path(__file__).parents[1]
if __name__ == "__main__":
    sys.path.insert(0, str(TESTS))

import jax
import pytest
import test_level_certificates as levels
from compared_texts import same_row
from test_certificates import Passive

import iblf_jax as ij

FILE = TESTS / "data" / "certificates.txt"
RUN: dict[str, Any] = {"duration": 0.1, "dt": 1e-3, "method": "euler"}
HEADING = "=== "
QUICK = ("printed gap, printed", "own claim, order 2, that fails")
"""Cases of the default tests."""

# ------------------------------------------------------------ the cases


def paper(parts: dict[str, Any] | None = None, **preset: Any) -> ij.Scenario:
    """The paper's scenario with other parts."""
    return ij.with_parts(ij.presets.zhang_yan_2024(**preset), **(parts or {}))


def under(law: Any, **parts: Any) -> ij.Scenario:
    """The paper's scenario under a law, with the momentum observer."""
    return paper({"controller": law, **parts}, variant="corrected")


def backstepping(**fields: Any) -> Any:
    """The paper's law at its gains."""
    return ij.controllers.Backstepping(**({"k1": 2.0, "K2": 20.0, "o": 0.1} | fields))


def own(**fields: float) -> ij.Scenario:
    """The paper's arm with more load than its model, under a law that states its own claim."""
    law = Passive(slope=[3.0, 4.0], K=[8.0, 2.0], **fields)
    scenario = paper({"controller": law, "observer": ij.observers.NoObserver()})
    return ij.with_parameters(scenario, {"plant.payload": 0.4})


def without_disturbance() -> ij.Scenario:
    """Case 1: f' = 0."""
    return paper({"disturbance": ij.disturbances.Nothing()}, variant="corrected")


def fourth_order() -> ij.Scenario:
    """One link on a spring."""
    plant = ij.plants.FlexibleJoint(levels.LINK, stiffness=300.0, motor_inertia=0.02)
    return levels.robot_scenario(plant, 4)


def rigid_law_on_springs() -> ij.Scenario:
    """A law of robots on a plant of order 4."""
    plant = ij.plants.FlexibleJoint(levels.LINK, stiffness=300.0, motor_inertia=0.02)
    law = backstepping(K2=5.0, barrier=ij.barriers.Integral())
    return levels.robot_scenario(plant, 2, law, model=levels.LINK)


def outside() -> ij.Scenario:
    """A virtual control outside the bounds of its level."""
    law = ij.controllers.BarrierBackstepping(k=(2.0, 5.0), barriers=(levels.MAPPING,) * 2)
    return levels.double_integrator(
        law,
        reference=ij.references.Sinusoid(offset=0.0, amplitude=0.4),
        bounds=(levels.between(-3.0, 3.0), levels.between(-0.38, 0.38)),
        initial=ij.Initial(x=[[0.05], [0.0]]),
    )


def disturbed(law: Any = None, **parts: Any) -> ij.Scenario:
    """The pendulum of order 3 with a disturbance on every level."""
    return levels.pendulum(law, disturbance=levels.DISTURBANCES, **parts)


def certificate_of(scenario: ij.Scenario) -> Any:
    """The certificate of a short run."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return ij.certify(scenario, **RUN)


def of_many_runs() -> Any:
    """The certificate of three runs with other gains."""
    scenario = levels.pendulum()
    study = ij.monte_carlo(
        scenario,
        {"controller.k": ij.factor(ij.uniform(0.8, 1.2))},
        runs=3,
        duration=0.1,
        dt=1e-3,
        progress=False,
    )
    return ij.certify(scenario, study, worst=None)


def event_triggered() -> ij.Scenario:
    """A law that compensates the trigger of its commands."""
    law = ij.controllers.EventCompensated(backstepping(), relative=0.1, absolute=0.3, epsilon=0.5)
    trigger = ij.EventTrigger(relative=0.1, absolute=0.25)
    return under(law, sampling=ij.Sampling(period=1e-3, trigger=trigger))


def saturated(limit: Any, edge: str = "hard") -> ij.Scenario:
    """The paper's law with a limit of its torque."""
    return ij.presets.zhang_yan_2024_saturated(limit=limit, edge=edge)


CASES: dict[str, Callable[[], Any]] = {
    # Theorem 2
    "printed": paper,
    "corrected": lambda: paper(variant="corrected"),
    "printed gap, printed": ij.presets.printed_gap,
    "printed gap, corrected": lambda: ij.presets.printed_gap(variant="corrected"),
    "case 1": without_disturbance,
    "barrier Log": lambda: paper(law="log", variant="corrected"),
    "barrier Log, p = 2": lambda: paper(law="log", variant="corrected", p=2),
    "barrier Tan": lambda: paper(law="tan", variant="corrected"),
    "barrier StateBarrier": lambda: paper(law="state", variant="corrected"),
    "barrier TransformedError": lambda: paper(law="mapping", variant="corrected"),
    "funnel": ij.presets.zhang_yan_2024_funnel,
    "with a weight": lambda: under(backstepping(weight=0.3)),
    "with a weight, failing gains": lambda: under(
        backstepping(weight=[0.3, 2.0], K2=0.2), observer=ij.observers.Momentum(kf=0.6)
    ),
    "with decays": lambda: under(
        backstepping(
            o=None,
            barrier=ij.barriers.TransformedError(),
            decays=(ij.decays.FixedTime(k_a=1.0, k_b=1.0),) * 2,
        )
    ),
    "bounds on velocities": ij.presets.zhang_yan_2024_full_state,
    "bounds on velocities, failing c": lambda: ij.presets.zhang_yan_2024_full_state(kf=20.0, c=0.3),
    # limits and loops without a claim
    "saturated for a while": lambda: saturated((7.2, 1.5)),
    "saturated smoothly": lambda: saturated((20.0, 9.0), "smooth"),
    "without an observer": lambda: under(backstepping(), observer=ij.observers.NoObserver()),
    "no barrier": lambda: paper(law="backstepping", variant="corrected"),
    "dynamic surface": lambda: paper(law="dynamic_surface", variant="corrected"),
    "adaptive": lambda: paper(law="adaptive_rbf", variant="corrected"),
    "computed torque": lambda: paper(law="computed_torque", variant="corrected"),
    "PD": lambda: paper(law="pd", variant="corrected"),
    "sampled": lambda: paper({"sampling": ij.Sampling(period=2e-3)}, variant="corrected"),
    "actuator": lambda: under(backstepping(), actuator=ij.actuators.Motor(bandwidth=200.0)),
    "event trigger": event_triggered,
    "rigid law on springs": rigid_law_on_springs,
    # claims of laws
    "own claim": own,
    "own claim that fails": lambda: own(share=0.98, late=9.0),
    "own claim, order 2": lambda: levels.double_integrator(levels.WithClaim()),
    "own claim, order 2, that fails": lambda: levels.double_integrator(
        levels.WithClaim(factor=1.2)
    ),
    "no claim, order 2": lambda: levels.double_integrator(levels.TwoLevels()),
    # levels
    "order 2, robot": lambda: levels.robot_scenario(levels.LINK, 2),
    "order 2, vessel": ij.presets.vessel,
    "order 2, alpha outside": outside,
    "order 3": levels.pendulum,
    "order 3, many runs": of_many_runs,
    "order 3, disturbed": disturbed,
    "order 3, observed": lambda: disturbed(
        observer=ij.observers.LevelObserver(gain=(20.0, 20.0, 20.0))
    ),
    "order 3, wrong observer": lambda: disturbed(observer=levels.WrongObserver(gain=20.0)),
    "order 3, wrong law": lambda: levels.pendulum(levels.WithoutExchange(**levels.GAINS)),
    "order 3, filters": lambda: disturbed(
        ij.controllers.BarrierBackstepping(filter=0.01, **levels.GAINS)
    ),
    "order 3, limit": lambda: levels.pendulum(
        ij.controllers.Saturated(ij.controllers.BarrierBackstepping(**levels.GAINS), limit=5.0)
    ),
    "order 3, sampled": lambda: levels.pendulum(sampling=ij.Sampling(period=4e-3)),
    "order 3, drives": ij.presets.motor_driven_pendulum,
    "order 4": fourth_order,
}


@functools.cache
def text_of(case: str) -> str:
    """What the certificate of a case prints."""
    made = CASES[case]()
    return str(certificate_of(made) if isinstance(made, ij.Scenario) else made)


@functools.cache
def stored_texts() -> dict[str, str]:
    """Case -> stored text."""
    parts = FILE.read_text().split(HEADING)[1:]
    pairs = (part.split("\n", 1) for part in parts)
    return {name: text.rstrip("\n") for name, text in pairs}


def test_every_case_is_stored():
    assert list(stored_texts()) == list(CASES)


@pytest.mark.parametrize(
    "case", [x if x in QUICK else pytest.param(x, marks=pytest.mark.slow) for x in CASES]
)
def test_text(case):
    found, stored = (x.splitlines() for x in (text_of(case), stored_texts()[case]))
    pairs = zip(found, stored, strict=False)
    differences = [f"- {b}\n+ {a}" for a, b in pairs if not same_row(a, b)]
    assert not differences, "\n".join(["", *differences])
    assert len(found) == len(stored)


def test_rows_may_differ_in_the_last_digit_only():
    row = "equality        (S.3)         holds   {}        joint 0, t = {} s"
    assert same_row(row.format("0.4915 1/s", "0.1"), row.format("0.4916 1/s", "0.1"))
    assert same_row(row.format("0.4 1/s", "0.1"), row.format("0.4001 1/s", "0.1"))
    assert not same_row(row.format("0.4915 1/s", "0.1"), row.format("0.4918 1/s", "0.1"))
    assert not same_row(row.format("0.4 1/s", "0.1"), row.format("0.5 1/s", "0.1"))
    assert not same_row(row.format("0.4 1/s", "0.1"), row.format("0.4 1/s", "0.2"))
    assert same_row(row.format("-4e-15 1/s", "0.1"), row.format("2.1e-16 1/s", "0.014"))
    assert not same_row(row.format("-4e-15 1/s", "0.1"), row.format("-4e-15 rad", "0.1"))
    assert not same_row("18 lines do not apply", "19 lines do not apply")


def main() -> None:
    """Writes the file."""
    from conftest import choose_compilers

    if sys.argv[1:] != ["--write"]:
        raise SystemExit(__doc__)
    choose_compilers(plain=True)
    jax.config.update("jax_enable_x64", True)
    FILE.write_text("\n".join(f"{HEADING}{case}\n{text_of(case)}\n" for case in CASES))


if __name__ == "__main__":
    main()
