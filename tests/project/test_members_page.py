"""docs/members.md is what the members' docstrings give, and every law, barrier and observer names
its source."""

import sys

import pytest
from conftest import ROOT

from iblf_jax import barriers, controllers, decays, observers

sys.path.append(str(ROOT / "docs"))
import members_page


def test_the_page_is_not_stale():
    text = members_page.text()
    assert members_page.TARGET.read_text(encoding="utf-8") == text, "run docs/members_page.py"
    assert all(f"`{name}`" in text for name in controllers.LAWS)


FAMILIES = (barriers, controllers, decays, observers)


@pytest.mark.parametrize("cls", [cls for family in FAMILIES for cls in family.MEMBERS.values()])
def test_every_member_says_what_it_is_and_where_it_comes_from(cls):
    assert len(members_page.first_line(cls)) > 5
    assert len(members_page.source(cls)) > 3
