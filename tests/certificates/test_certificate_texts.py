"""What certificates print: each kind of line and of note, of certificates that hold, that fail and
that do not apply.

`tests/data/certificates.txt` has them.  The tests compare words, order and columns exactly, and
numbers to one in the last printed digit (`compared_texts`): another version of JAX rounds
otherwise.  Margins below 1e-9 are rounding only, and so is their place.  After a change that is
meant to move them,

    python tests/certificates/test_certificate_texts.py --write

writes the file anew.  `certificate_steps.pickle.gz` beside it has the terms at all steps of some
cases, of which the default tests make the same texts: their claims and lines compute in NumPy, so
that only their few inner programs are compiled.
"""

import functools
import gzip
import os
import pickle
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

os.environ.setdefault("JAX_ENABLE_X64", "1")
TESTS = Path(__file__).parents[1]
if __name__ == "__main__":
    sys.path.insert(0, str(TESTS))

import jax
import pytest
import test_level_certificates as levels
from compared_texts import same_row

import iblf_jax as ij
from iblf_jax.certificates import summary
from iblf_jax.simulation.results import Rollout

FILE = TESTS / "data" / "certificates.txt"
STEPS = TESTS / "data" / "certificate_steps.pickle.gz"
RUN: dict[str, Any] = {"duration": 0.1, "dt": 1e-3, "method": "euler"}
HEADING = "=== "
WITH_STEPS = (
    *("printed gap, printed", "case 1", "with a weight, failing gains"),
    *("failing gains, with weights", "with decays", "bounds on velocities, failing c"),
    *("no barrier", "saturated smoothly", "own claim, order 2, that fails", "order 2, vessel"),
    *("an observer that states another gain", "a disturbance of q", "a limit of the input"),
)
"""Cases whose terms are stored: of every claim one that holds, fails or does not apply."""
TERMS_ELSEWHERE = (
    *("printed gap, printed", "case 1", "with a weight, failing gains", "no barrier"),
    *("order 2, vessel", "an observer that states another gain", "a disturbance of q"),
)
"""Those of them whose claims other cases or `test_certificates` and `test_level_certificates`
compute, each with a program of its own."""


def paper(parts: dict[str, Any] | None = None, **preset: Any) -> ij.Scenario:
    return ij.with_parts(ij.presets.zhang_yan_2024(**preset), **(parts or {}))


def under(law: Any, **parts: Any) -> ij.Scenario:
    return paper({"controller": law, **parts}, variant="corrected")


def backstepping(**fields: Any) -> Any:
    return ij.controllers.Backstepping(**({"k1": 2.0, "K2": 20.0, "o": 0.1} | fields))


def certificate_of(scenario: ij.Scenario) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return ij.certify(scenario, **RUN)


def of_many_runs() -> Any:
    scenario = levels.pendulum()
    ways, options = {"controller.k": ij.factor(ij.uniform(0.8, 1.2))}, {"duration": 0.1, "dt": 1e-3}
    study = ij.monte_carlo(scenario, ways, runs=3, progress=False, **options)
    return ij.certify(scenario, study, worst=None)


def light(weight: Any) -> ij.Scenario:
    """Gains below the conditions of Theorem 2, under which the claim with weights holds."""
    law = backstepping(K2=[0.3, 0.1], weight=weight, variant="corrected")
    return under(law, observer=ij.observers.Momentum(kf=[0.4, 0.9]))


def event_triggered() -> ij.Scenario:
    """A law that compensates the trigger of its commands."""
    law = ij.controllers.EventCompensated(backstepping(), relative=0.1, absolute=0.3, epsilon=0.5)
    trigger = ij.EventTrigger(relative=0.1, absolute=0.25)
    return under(law, sampling=ij.Sampling(period=1e-3, trigger=trigger))


OF_Q = ij.disturbances.Levels((ij.disturbances.Sinusoids(0.1, 2.0),))


def of_levels(filter: Any = None, **parts: Any) -> ij.Scenario:
    law = ij.controllers.BarrierBackstepping(filter=filter, **levels.GAINS)
    return levels.pendulum(law, **parts)


def observed(kind: Any) -> ij.Scenario:
    return of_levels(disturbance=levels.DISTURBANCES, observer=kind(gain=20.0))


def limited(limit: float) -> ij.Scenario:
    law = ij.controllers.BarrierBackstepping(**levels.GAINS)
    return levels.pendulum(ij.controllers.Saturated(law, limit=limit))


CASES: dict[str, Callable[[], Any]] = {
    # Theorem 2
    "printed": paper,
    "printed gap, printed": ij.presets.printed_gap,
    "case 1": lambda: paper({"disturbance": ij.disturbances.Nothing()}, variant="corrected"),
    "barrier Tan": lambda: paper(law="tan", variant="corrected"),
    "with a weight, failing gains": lambda: under(
        backstepping(weight=[0.3, 2.0], K2=0.2), observer=ij.observers.Momentum(kf=0.6)
    ),
    "failing gains": lambda: light(1.0),
    "failing gains, with weights": lambda: light([0.5, 0.05]),
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
    "saturated smoothly": lambda: ij.presets.zhang_yan_2024_saturated(
        limit=(20.0, 9.0), edge="smooth"
    ),
    "no barrier": lambda: paper(law="backstepping", variant="corrected"),
    "dynamic surface": lambda: paper(law="dynamic_surface", variant="corrected"),
    "actuator": lambda: under(backstepping(), actuator=ij.actuators.Motor(bandwidth=200.0)),
    "event trigger": event_triggered,
    # levels
    "own claim, order 2, that fails": lambda: levels.double_integrator(
        levels.WithClaim(factor=1.2)
    ),
    "order 2, vessel": ij.presets.vessel,
    "order 3, many runs": of_many_runs,
    "an observer of levels": lambda: observed(ij.observers.LevelObserver),
    # (S.3) is evaluated with the true rate of the estimate.
    "an observer that states another gain": lambda: observed(levels.WrongObserver),
    "a wrong law": lambda: levels.pendulum(levels.WithoutExchange(**levels.GAINS)),
    "dynamic surface of levels": lambda: of_levels(disturbance=levels.DISTURBANCES, filter=0.01),
    "own claim, order 2": lambda: levels.double_integrator(levels.WithClaim()),
    "no claim, order 2": lambda: levels.double_integrator(levels.TwoLevels()),
    "a disturbance of q": lambda: levels.robot_scenario(levels.LINK, 2, disturbance=OF_Q),
    "a limit of the input": lambda: limited(5.0),
    "a limit all the time": lambda: limited(1e-3),
    "a sampled loop of levels": lambda: of_levels(sampling=ij.Sampling(period=2e-3)),
    "an actuator of levels": lambda: of_levels(actuator=ij.actuators.Motor(bandwidth=100.0)),
}


@functools.cache
def text_of(case: str) -> str:
    made = CASES[case]()
    return str(certificate_of(made) if isinstance(made, ij.Scenario) else made)


@functools.cache
def stored_texts() -> dict[str, str]:
    parts = FILE.read_text().split(HEADING)[1:]
    pairs = (part.split("\n", 1) for part in parts)
    return {name: text.rstrip("\n") for name, text in pairs}


def test_every_case_is_stored_and_rows_may_differ_in_the_last_digit_only():
    assert list(stored_texts()) == list(CASES)
    row = "equality        (S.3)         holds   {}        joint 0, t = {} s"
    assert same_row(row.format("0.4915 1/s", "0.1"), row.format("0.4916 1/s", "0.1"))
    assert same_row(row.format("0.4 1/s", "0.1"), row.format("0.4001 1/s", "0.1"))
    assert not same_row(row.format("0.4915 1/s", "0.1"), row.format("0.4918 1/s", "0.1"))
    assert not same_row(row.format("0.4 1/s", "0.1"), row.format("0.5 1/s", "0.1"))
    assert not same_row(row.format("0.4 1/s", "0.1"), row.format("0.4 1/s", "0.2"))
    assert same_row(row.format("-4e-15 1/s", "0.1"), row.format("2.1e-16 1/s", "0.014"))
    assert not same_row(row.format("-4e-15 1/s", "0.1"), row.format("-4e-15 rad", "0.1"))
    assert not same_row("18 lines do not apply", "19 lines do not apply")


def with_steps(case: str) -> tuple[Rollout, list[Any]]:
    """The run of a case and what `summary` reads of its steps."""
    kept: list[tuple[Rollout, list[Any]]] = []
    of_engine = summary.steps_of

    def steps_of(run: Rollout, *grid_and_claims: Any) -> list[Any]:
        kept.append((run, list(of_engine(run, *grid_and_claims))))
        return kept[-1][1]

    with mock.patch.object(summary, "steps_of", steps_of):
        certificate_of(CASES[case]())
    return kept[-1]


@functools.cache
def stored_steps() -> dict[str, tuple[Rollout, list[Any]]]:
    return pickle.loads(gzip.decompress(STEPS.read_bytes()))


@pytest.mark.parametrize("case", WITH_STEPS)
def test_text_of_stored_terms(case, monkeypatch):
    run, steps = stored_steps()[case]
    monkeypatch.setattr(summary, "steps_of", lambda *_: steps)
    certificate = ij.certify(run.scenario, run)
    assert_same(str(certificate), case)
    assert certificate.plot().axes


@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in CASES if case not in TERMS_ELSEWHERE])
def test_text(case):
    assert_same(text_of(case), case)


def assert_same(text: str, case: str) -> None:
    """A text is that of a case, but for rounding."""
    found, stored = (x.splitlines() for x in (text, stored_texts()[case]))
    pairs = zip(found, stored, strict=False)
    differences = [f"- {b}\n+ {a}" for a, b in pairs if not same_row(a, b)]
    assert not differences, "\n".join(["", *differences])
    assert len(found) == len(stored)


def main() -> None:
    from conftest import choose_compilers

    if sys.argv[1:] != ["--write"]:
        raise SystemExit(__doc__)
    choose_compilers(plain=True)
    jax.config.update("jax_enable_x64", True)
    FILE.write_text("\n".join(f"{HEADING}{case}\n{text_of(case)}\n" for case in CASES))
    kept = pickle.dumps({case: with_steps(case) for case in WITH_STEPS})
    STEPS.write_bytes(gzip.compress(kept, mtime=0))


if __name__ == "__main__":
    main()
