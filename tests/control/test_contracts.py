"""Every member of every family fits its contract; and the checkers notice members that do not
(test_testing.py).

The default run checks one instance of every class, the first that `members.py` lists, some of them
without derivatives; CI checks all of them.
"""

import pytest
from members import FAMILIES, FOLDS, further

import iblf_jax as ij
from iblf_jax import metrics
from iblf_jax.testing import _contract, laws

LONG = {"arm"}
"""Compiles for ten seconds."""
BEFORE_A_RELEASE = {
    "barrier_backstepping_mixed",
    "adaptive_parameters_levels",
    "backstepping_decays",
}
"""Further members of a class that compile long; another member of the class is in the default
run."""
RUN = {"adaptive_rbf", "with_drive"}
"""Laws whose closed loop is in the default run: with a state, and around another law with a plant
of its own.  A closed loop takes a third of a check; `test_programs_of_members.py` runs that of
every law, and `test_time_step.py` makes a few steps of it."""
DIFFERENTIATED_BY_CI = {"law", "plant", "observer"}
"""Families whose derivatives are not in the default run: they take about half of a check."""


def of_default_run(family: str) -> list[str]:
    instances = FAMILIES[family][0]
    return [name for name in instances if name not in further(instances) | LONG]


def cases(family: str):
    for name in FAMILIES[family][0]:
        is_later = name not in of_default_run(family) or family in DIFFERENTIATED_BY_CI
        mark = pytest.mark.release if name in BEFORE_A_RELEASE else pytest.mark.slow
        yield pytest.param(family, name, marks=[mark] if is_later else [])


@pytest.mark.parametrize(
    ("family", "name"), [case for family in FAMILIES if family != "fold" for case in cases(family)]
)
def test_member_fits_its_contract(family, name):
    instances, _, check = FAMILIES[family]
    check(instances[name])


@pytest.mark.parametrize(
    ("family", "name"),
    [(family, name) for family in sorted(DIFFERENTIATED_BY_CI) for name in of_default_run(family)],
)
def test_member_fits_its_contract_apart_from_derivatives(family, name, monkeypatch):
    for function in ("_slopes", "_same_slopes"):
        monkeypatch.setattr(_contract, function, lambda *_: None)
    if family == "law" and name not in RUN:
        monkeypatch.setattr(laws, "_closed_loop", lambda *_: None)
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


def test_metrics_fit_their_contract():
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
