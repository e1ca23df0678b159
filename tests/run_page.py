"""Runs every block of Python on a page as a reader would: `python tests/run_page.py PAGE` is a
process of its own.

This file has no `from __future__` line, and `compile` inherits none: a block is compiled as it is
pasted.  Python 3.14 and later do not evaluate an annotation before something reads it, and nor does
a block under `from __future__ import annotations`, so every annotation is evaluated here after its
block has run.
"""

import ast
import inspect
import re
import sys
import types
import warnings
from pathlib import Path
from typing import Any

BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)


def blocks(text: str) -> list[str]:
    """The blocks of Python of a page in Markdown, each on the lines that it has on the page."""
    return ["\n" * text.count("\n", 0, found.start(1)) + found[1] for found in BLOCK.finditer(text)]


def evaluate_annotations(names: dict[str, Any]) -> None:
    """Raises what an annotation of a class or a function raises that the page defined."""
    for thing in list(names.values()):
        defined_here = getattr(thing, "__module__", "") == names["__name__"]
        if not defined_here or not isinstance(thing, type | types.FunctionType):
            continue
        methods = vars(thing).values() if isinstance(thing, type) else ()
        functions = [x for x in methods if isinstance(x, types.FunctionType)]
        # A class also has functions that the package gives it.
        functions = [x for x in functions if x.__module__ == names["__name__"]]
        for annotated in (thing, *functions):
            inspect.get_annotations(annotated, globals=names, eval_str=True)


def run(page: Path) -> dict[str, Any]:
    """Runs the blocks of a page from top to bottom; what they leave behind, by name."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks(page.read_text(encoding="utf-8")):
        exec(compile(block, str(page), "exec", dont_inherit=True), names)
        evaluate_annotations(names)
    return names


def unknown_names(text: str, package: types.ModuleType) -> list[str]:
    """Dotted names of a page's blocks that start at the package, `ij.a.b`, and are not there."""
    trees = [ast.parse(block) for block in blocks(text)]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    aliases = {
        alias.asname or alias.name
        for node in nodes
        if isinstance(node, ast.Import)
        for alias in node.names
        if alias.name == package.__name__
    }
    dotted = {ast.unparse(node) for node in nodes if isinstance(node, ast.Attribute)}
    return sorted(name for name in dotted if _is_unknown(name, aliases, package))


def _is_unknown(dotted: str, aliases: set[str], package: types.ModuleType) -> bool:
    first, *rest = dotted.split(".")
    if first not in aliases or not all(name.isidentifier() for name in rest):
        return False
    thing: Any = package
    for name in rest:
        if not isinstance(thing, types.ModuleType | type):
            return False
        if not hasattr(thing, name):  # only instances of a class have its fields
            return name not in getattr(thing, "__annotations__", {})
        thing = getattr(thing, name)
    return False


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    run(Path(sys.argv[1]))
