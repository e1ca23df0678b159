"""The page on stability names every public name once."""

import pkgutil
import re

from conftest import ROOT

import iblf_jax as ij

PAGE = (ROOT / "docs" / "stability.md").read_text(encoding="utf-8")
LISTS = ("stable", "provisional", "internal")
NO_PROMISE = {"TYPE_CHECKING", "__version__"}
MODULES = {module.name for module in pkgutil.iter_modules(ij.__path__) if module.name[0] != "_"}
PUBLIC = (set(dir(ij)) | MODULES) - NO_PROMISE
"""A module is an attribute of the package from its first import on."""


def names_in(page: str, mark: str) -> set[str]:
    """The names in code of a table's first columns; the last one says something about them."""
    rows = page.split(f"<!-- {mark} -->\n", 1)[1].split("\n\n", 1)[0].splitlines()
    cells = [row.split("|")[1:-1] for row in rows]
    columns = slice(1, None) if mark == "stable" else slice(0, 1)
    return {name for row in cells for cell in row[columns] for name in re.findall(r"`(\w+)`", cell)}


def wrong(page: str, public: set[str]) -> dict[str, set[str]]:
    """Public names that no list has, listed names that do not exist, and names of two lists."""
    listed = {mark: names_in(page, mark) for mark in LISTS}
    together = set.union(*listed.values())
    twice = {name for name in together if sum(name in names for names in listed.values()) > 1}
    return {"missing": public - together, "unknown": together - public, "twice": twice}


def test_every_public_name_is_in_one_list_and_this_test_can_fail():
    assert wrong(PAGE, PUBLIC) == {"missing": set(), "unknown": set(), "twice": set()}
    page = PAGE.replace("`simulate` ", "").replace("`tune` `TuneResult`", "`tuen` `TuneResult`")
    found = wrong(page.replace("| `explain` |", "| `certify` |"), PUBLIC)
    assert found["missing"] == {"simulate", "tune", "explain"}
    assert found["unknown"] == {"tuen"}
    assert found["twice"] == {"certify"}
