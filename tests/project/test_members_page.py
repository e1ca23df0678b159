"""docs/members.md is what the members' docstrings give, and every law, barrier and observer names
its source."""

import runpy
from pathlib import Path

import pytest

from iblf_jax import barriers, controllers, decays, observers

PAGE = runpy.run_path(str(Path(__file__).resolve().parents[2] / "docs" / "members_page.py"))


def test_the_page_is_not_stale():
    assert PAGE["TARGET"].read_text(encoding="utf-8") == PAGE["text"](), (
        "run `python docs/members_page.py`"
    )


FAMILIES = (barriers, controllers, decays, observers)


@pytest.mark.parametrize("cls", [cls for family in FAMILIES for cls in family.MEMBERS.values()])
def test_every_member_says_what_it_is_and_where_it_comes_from(cls):
    assert len(PAGE["first_line"](cls)) > 5
    assert len(PAGE["source"](cls)) > 3


def test_every_system_is_on_the_page():
    assert all(f"`{name}`" in PAGE["text"]() for name in controllers.LAWS)
