"""Every member of every family fits its contract; and the checkers notice members that do not (test_testing.py)."""

from __future__ import annotations

import pytest
from members import FAMILIES

CASES = [
    pytest.param(check, member, id=f"{family}-{name}")
    for family, (members, _, check) in FAMILIES.items()
    for name, member in members.items()
]


@pytest.mark.slow
@pytest.mark.parametrize(("check", "member"), CASES)
def test_member_fits_its_contract(check, member):
    check(member)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_member_is_listed(family):
    instances, registry, _ = FAMILIES[family]
    missing = set(registry.values()) - {type(x) for x in instances.values()}
    assert not missing, f"add an instance of {missing} to tests/members.py"
