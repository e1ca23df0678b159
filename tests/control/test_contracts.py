"""Every member of every family fits its contract; and the checkers notice members that do not
(test_testing.py).

The default run checks one instance of every class, the first that `members.py` lists; CI checks all
of them.
"""

from __future__ import annotations

import pytest
from members import FAMILIES

import iblf_jax as ij

LONG = {"arm"}
"""Compiles for ten seconds."""
BEFORE_A_RELEASE = {
    "barrier_backstepping_mixed",
    "adaptive_parameters_levels",
    "backstepping_decays",
}
"""Further members of a class that compile long; another member of the class is in the default
run."""


def marks_of(name: str, is_further: bool) -> list:
    """The marks of the test of a member; `is_further` says that its class has another one."""
    if name in BEFORE_A_RELEASE:
        return [pytest.mark.release]
    if is_further or name in LONG:
        return [pytest.mark.slow]
    return []


def cases():
    for family, (members, _, check) in FAMILIES.items():
        seen = set()
        for name, member in members.items():
            again = type(member) in seen
            seen.add(type(member))
            marks = marks_of(name, again)
            yield pytest.param(check, member, id=f"{family}-{name}", marks=marks)


@pytest.mark.parametrize(("check", "member"), list(cases()))
def test_member_fits_its_contract(check, member):
    check(member)


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


def test_a_law_of_q_and_dq_that_calls_a_law_of_x_is_told_what_to_change():
    scenario = ij.presets.zhang_yan_2024()
    plain = ij.with_parts(scenario, controller=Halved(scenario.controller))
    assert ij.simulate(plain, duration=0.01).ok
    saturated = ij.controllers.Saturated(scenario.controller, limit=10.0)
    with pytest.raises(ValueError, match=r"Halved\.law: got a Saturated, a law of x, .*law_of_x"):
        ij.simulate(ij.with_parts(scenario, controller=Halved(saturated)), duration=0.01)
