"""Every member of every family fits its contract; and the checkers notice members that do not
(test_testing.py).

The default run checks one instance of every class, the first that `members.py` lists; CI checks all
of them.
"""

from __future__ import annotations

import jax
import numpy as np
import pytest
from members import FAMILIES, ROBOTS

import iblf_jax as ij
from iblf_jax.testing import robots
from iblf_jax.testing._contract import Findings

LONG = {"arm"}
"""Takes a minute to compile: the default run holds it to a part of its contract, in a test of its
own."""
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


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG)
def test_a_long_robot_has_the_shapes_and_the_physics_of_its_contract(name, rng):
    robot, findings = ROBOTS[name], Findings(ROBOTS[name], "Robot")
    q, v, u = rng.uniform(-2, 2, (3, robot.n))
    robots._shapes(findings, robot, q)
    findings.stop_if_any()
    numbers = jax.jit(robots._identities)(robot, q, v, u)
    robots._physics(findings, {name: np.asarray(x)[None] for name, x in numbers.items()})
    findings.stop_if_any()


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
