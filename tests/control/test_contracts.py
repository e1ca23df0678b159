"""Every member of every family fits its contract; and the checkers notice members that do not
(test_testing.py).

The default run checks one instance of every class, the first that `members.py` lists: shapes and
types only in the families whose numbers are dear, and derivatives nowhere but where they are cheap.
With the mark `members`, CI checks every instance completely.
"""

import pytest
from members import FAMILIES, FOLDS, further

import iblf_jax as ij
from iblf_jax import metrics
from iblf_jax.testing import _contract, laws, observers, plants

LONG = {"arm"}
"""Compiles for ten seconds."""
BEFORE_A_RELEASE = {
    "barrier_backstepping_mixed",
    "adaptive_parameters_levels",
    "backstepping_decays",
}
"""Further members of a class that compile long; another member of the class is in the default
run."""
FIRST_NUMBER = {
    "law": (laws, "check_function"),
    "plant": (plants, "at_each"),
    "observer": (observers, "check_function"),
}
"""Families of which the default run checks shapes and types, and what computes the first number.
The numbers of laws, plants and observers are those of a few steps in `test_time_step.py`, and of
independent programs."""
WITH_NUMBERS = {
    *("backstepping", "saturated", "computed_torque"),
    *("driven_pendulum", "strict_feedback", "momentum", "level"),
}
"""Members of these families that the default run checks with numbers all the same: a plain one, one
around another one, and one of each kind of state."""
DIFFERENTIATED_BY_CI = {*FIRST_NUMBER, "robot", "reference", "barrier"}
"""Families whose derivatives are not in the default run: they take about half of a check."""


def of_default_run(family: str) -> list[str]:
    instances = FAMILIES[family][0]
    return [name for name in instances if name not in further(instances) | LONG]


def cases(family: str):
    for name in FAMILIES[family][0]:
        is_later = name not in of_default_run(family) or family in DIFFERENTIATED_BY_CI
        marks = [pytest.mark.slow, pytest.mark.members]
        if name in BEFORE_A_RELEASE:
            marks = [pytest.mark.release]
        yield pytest.param(family, name, marks=marks if is_later else [])


@pytest.mark.parametrize(
    ("family", "name"), [case for family in FAMILIES if family != "fold" for case in cases(family)]
)
def test_member_fits_its_contract(family, name):
    instances, _, check = FAMILIES[family]
    check(instances[name])


def without_derivatives(monkeypatch):
    for function in ("_slopes", "_same_slopes"):
        monkeypatch.setattr(_contract, function, lambda *_: None)


def stop(*_, **__):
    raise _contract.StoppedCheckError


@pytest.mark.parametrize(
    ("family", "name"),
    [(family, name) for family in sorted(DIFFERENTIATED_BY_CI) for name in of_default_run(family)],
)
def test_member_fits_its_contract_apart_from_derivatives(family, name, monkeypatch):
    without_derivatives(monkeypatch)
    # `test_programs_of_members.py` runs the closed loop of every law.
    monkeypatch.setattr(laws, "_closed_loop", lambda *_: None)
    if family in FIRST_NUMBER and name not in WITH_NUMBERS:
        monkeypatch.setattr(*FIRST_NUMBER[family], stop)
    instances, _, check = FAMILIES[family]
    check(instances[name])


@ij.component
class Together(metrics.Fold):
    """Metrics as one: a program of all takes less than half of the time of a program of each."""

    folds: tuple[metrics.Fold, ...]

    @property
    def units(self):
        return {name: unit for fold in self.folds for name, unit in fold.units.items()}

    def init(self, sample):
        return tuple(fold.init(sample) for fold in self.folds)

    def update(self, acc, sample):
        return tuple(fold.update(x, sample) for fold, x in zip(self.folds, acc, strict=True))

    def finish(self, acc):
        found = [fold.finish(x) for fold, x in zip(self.folds, acc, strict=True)]
        assert [set(x) for x in found] == [set(fold.units) for fold in self.folds]
        return {name: value for results in found for name, value in results.items()}


@pytest.mark.parametrize(
    "differentiated", [False, pytest.param(True, marks=[pytest.mark.slow, pytest.mark.members])]
)
def test_metrics_fit_their_contract(differentiated, monkeypatch):
    if not differentiated:
        without_derivatives(monkeypatch)
    together = Together(tuple(FOLDS.values()))
    assert len(together.units) == sum(len(fold.units) for fold in FOLDS.values())
    ij.testing.check_fold(together)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_member_is_listed(family):
    instances, registry, _ = FAMILIES[family]
    missing = set(registry.values()) - {type(x) for x in instances.values()}
    assert not missing, f"add an instance of {missing} to tests/members.py"


@ij.component
class Halved(ij.controllers.RobotLaw):
    """Half of the torque of another law, as a law of q and q'."""

    law: ij.controllers.TrackingLaw

    def init(self, q, dq, context):
        return self.law.init(q, dq, context)

    def command(self, t, q, dq, f_hat, context, state):
        command, rate = self.law.command(t, q, dq, f_hat, context, state)
        return command._replace(tau=0.5 * command.tau), rate


@pytest.mark.slow
def test_a_law_of_q_and_dq_that_calls_a_law_of_x_is_told_what_to_change():
    scenario = ij.presets.zhang_yan_2024()
    plain = ij.with_parts(scenario, controller=Halved(scenario.controller))
    assert ij.simulate(plain, duration=0.01).ok
    saturated = ij.controllers.Saturated(scenario.controller, limit=10.0)
    with pytest.raises(ValueError, match=r"Halved\.law: got a Saturated, a law of x, .*law_of_x"):
        ij.simulate(ij.with_parts(scenario, controller=Halved(saturated)), duration=0.01)
