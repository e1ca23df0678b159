#!/usr/bin/env python3
"""Prints the test files that a change reaches, the nearest ones first.

    python3 tools/select_tests.py [BASE]

A change is the difference between the commit BASE and the working tree, new files included; the
variable $BASE may name it, too, and an empty one selects all tests.  Without BASE it is all that a
branch adds to main, and in a merge all that the merge adds to its first parent; elsewhere nobody
knows where the change begins, and all tests are selected.  The last commit alone is never taken: a
change may have several.

**Files of the package.**  All tests import `iblf_jax`, so imports of modules select nothing.  The
nodes of the graph are the names that modules define:

- `ij.tune` and `from iblf_jax import tune` lead to `tune`, where it is defined: through the
  `__init__` files, and through the tables of names that are imported when first used.
- A definition leads to the names in it, also to those that a function imports, and to the
  statements that its module runs when it is imported.
- A method counts if its class is reached and something that is reached uses its name, as an
  attribute or in a text; so does an entry of a table of modules, as in `core/presentation.py`.
- A module that is used otherwise than by its attributes leads to all of its names: `getattr(ij, x)`
  to all of `ij`.
- In tests, texts with code and texts that name a module lead where they would lead as code; a text
  that names the package, or a folder of programs that use it, leads to all of it.

**Other files.**  Data in the package counts as the modules of its folder.  Any other file selects
the tests that name it, or a folder in which it is, in a text.  What is in EVERYTHING, and what
selects no test by these rules, selects all; those that it reaches are still the first.
"""

from __future__ import annotations

import ast
import fnmatch
import functools
import math
import os
import re
import subprocess
import sys
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "iblf_jax"
EVERYTHING = (
    *("iblf_jax/__init__.py", "iblf_jax/core/", "iblf_jax/kernels/"),
    *("iblf_jax/engine/", "iblf_jax/simulation/"),
    *("pyproject.toml", "constraints.txt", "tests/conftest.py", ".ci/", "tools/"),
)
"""What all tests depend on."""
PROGRAMS = {"docs", "notebooks", "benchmarks", "paper"}
"""Folders of programs that use the whole package."""
NO_NAMES = {"tests", "data"}
"""Folders whose names say nothing about what a test reads."""
LONGEST_WORD = 100
"""Characters of a text that may be the name of a method, an entry or a file."""
ALL, BODY = "*", ""
OF_EVERY_MODULE = ("__file__", "__name__")
"""Names that no statement defines."""


class Node(NamedTuple):
    """A name of a module, or a member of a class or of a table; ALL stands for all names of the
    module, and BODY for the statements that define none.
    """

    module: str
    name: str
    member: str = ""


class Uses(NamedTuple):
    """What a node leads to."""

    nodes: set[Node]
    words: set[str]
    """Names and texts that occur in it."""
    members: dict[str, Node]
    """Word -> what it leads to wherever this word occurs."""


def imports_of(statement: ast.AST) -> dict[str, Node]:
    """Local name -> what an import binds to it; empty for other statements."""
    found = {}
    if isinstance(statement, ast.Import):
        for alias in statement.names:
            found[alias.asname or alias.name.split(".")[0]] = Node(
                alias.name if alias.asname else alias.name.split(".")[0], ALL
            )
    elif isinstance(statement, ast.ImportFrom):
        for alias in statement.names:
            found[alias.asname or alias.name] = Node(statement.module or "", alias.name)
    return found


def entries_of(table: ast.AST) -> dict[str, Node]:
    """The entries of a table of names, key -> (module, name or None for the module itself); empty
    for anything else.
    """
    try:
        entries = ast.literal_eval(table) if isinstance(table, ast.Dict) else {}
        found = {key: Node(module, name or ALL) for key, (module, name) in entries.items()}
    except (TypeError, ValueError):
        return {}
    return found if all(str(x.module).startswith(PACKAGE) for x in found.values()) else {}


def names_of(statement: ast.stmt) -> list[str]:
    """The names that a statement defines."""
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return [statement.name]
    targets: list[ast.expr] = []
    if isinstance(statement, ast.Assign):
        targets = statement.targets
    elif isinstance(statement, ast.AnnAssign | ast.AugAssign):
        targets = [statement.target]
    return [x.id for target in targets for x in ast.walk(target) if isinstance(x, ast.Name)]


class Module:
    """A source file.

    Args:
      name: of the module.
      source: its text.
    """

    def __init__(self, name: str, source: str) -> None:
        self.name = name
        self.in_package = name.split(".")[0] == PACKAGE
        self.imports_by_name = "import_module(" in source
        self.imports: dict[str, Node] = {}
        self.definitions: dict[str, list[ast.stmt]] = defaultdict(list)
        tree = ast.parse(source)
        self._read(tree.body)
        if "on_first_use(" in source:
            for part in ast.walk(tree):
                self.imports |= entries_of(part)

    def _read(self, statements: Sequence[ast.stmt]) -> None:
        for statement in statements:
            if imported := imports_of(statement):
                self.imports |= imported
            elif isinstance(statement, ast.If) and ast.unparse(statement.test) == "TYPE_CHECKING":
                self._read(statement.orelse)
            elif isinstance(statement, ast.If | ast.Try | ast.With):
                for part in ast.iter_child_nodes(statement):
                    if isinstance(part, ast.ExceptHandler):
                        self._read(part.body)
                    elif isinstance(part, ast.stmt):
                        self._read([part])
                    else:
                        self.definitions[BODY].append(ast.Expr(part))
            else:
                for name in names_of(statement) or [BODY]:
                    self.definitions[name].append(statement)


class Graph:
    """The names of the package and of the tests, and what they use.

    Args:
      root: folder of the repository.
    """

    def __init__(self, root: Path = ROOT) -> None:
        self.root = root
        self.paths: dict[str, str] = {}
        self.modules: dict[str, Module] = {}
        for path in sorted((root / PACKAGE).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            self._add(".".join(parts[: -1 if parts[-1] == "__init__" else None]), path)
        for path in sorted((root / "tests").rglob("*.py")):
            self._add(path.stem, path)
        self._files = {*self.paths.values()}
        self.tests = [name for name in self.modules if name.startswith("test_")]
        self._uses: dict[Node, Uses] = {}

    def _add(self, name: str, path: Path) -> None:
        self.paths[name] = path.relative_to(self.root).as_posix()
        self.modules[name] = Module(name, path.read_text(encoding="utf-8"))

    def module_named(self, dotted: str) -> Module | None:
        """The module with a name, such as `iblf_jax.robots`, which is `iblf_jax.world.robots`; None
        outside of the package and of the tests.
        """
        if dotted in self.modules:
            return self.modules[dotted]
        parent, _, name = dotted.rpartition(".")
        return self.module_of(Node(parent, name)) if parent else None

    def module_of(self, node: Node) -> Module | None:
        """The module that a node stands for; None if it stands for something else."""
        module = self.module_named(node.module)
        if module is None or node.name == ALL:
            return module
        if node.name in module.definitions:
            return None
        inner = self.modules.get(f"{module.name}.{node.name}")
        target = module.imports.get(node.name, node)
        return inner if target == node else self.module_of(target)

    def attribute(self, origin: Node, names: Sequence[str]) -> set[Node]:
        """The nodes of `origin.a.b`: the attribute, and the modules that it is found through."""
        found, node = set(), origin
        for name in names:
            module = self.module_of(node)
            if module is None:
                break
            found.add(Node(module.name, BODY))
            node = Node(module.name, name)
        return {*found, node}

    def everything(self, prefix: str = "") -> set[Node]:
        """All names of the modules of the package whose names begin with a text."""
        return {
            Node(name, ALL)
            for name, module in self.modules.items()
            if module.in_package and name.startswith(prefix)
        }

    def uses(self, node: Node) -> Uses:
        """What a node leads to directly."""
        if node not in self._uses:
            self._uses[node] = self._find_uses(node)
        return self._uses[node]

    def _find_uses(self, node: Node) -> Uses:
        module = self.module_named(node.module)
        if module is None:
            return Uses(set(), set(), {})
        if node.name == ALL:
            # What a test imports counts where the test uses it.
            names = {*module.definitions, *(module.imports if module.in_package else ())}
            return Uses({Node(module.name, name) for name in names}, set(), {})
        body = {Node(module.name, BODY)}
        if node.name not in (BODY, *OF_EVERY_MODULE, *module.definitions):
            inner = f"{module.name}.{node.name}"
            target = module.imports.get(node.name)
            if target is None or target == node:
                target = Node(inner if inner in self.modules else module.name, ALL)
            return Uses({target, *body}, set(), {})
        parts, members = self._divided(node, module.definitions.get(node.name, []))
        reader = Reader(self, module)
        reader.read(parts)
        return Uses(reader.nodes | body, reader.words, members)

    def _divided(
        self, node: Node, statements: Sequence[ast.stmt]
    ) -> tuple[Sequence[ast.AST], dict[str, Node]]:
        """What always counts of a definition, and its members."""
        first = statements[0] if statements else None
        if isinstance(first, ast.ClassDef):
            methods = [x for x in first.body if isinstance(x, ast.FunctionDef)]
            if node.member:
                return [x for x in methods if x.name == node.member], {}
            methods = [x for x in methods if not x.name.startswith("__")]
            return (
                [x for x in ast.iter_child_nodes(first) if x not in methods],
                {x.name: node._replace(member=x.name) for x in methods},
            )
        if isinstance(first, ast.Assign) and (entries := entries_of(first.value)):
            return [], entries
        return statements, {}

    def reached(self, test: str) -> dict[Node, int]:
        """All that a test file leads to -> how many nodes are between, at least."""
        distance: dict[Node, int] = {}
        words: set[str] = set()
        members: dict[str, list[Node]] = defaultdict(list)
        front, steps = {Node(test, ALL)}, 0
        while front:
            distance |= dict.fromkeys(front, steps)
            found = [self.uses(node) for node in front]
            words.update(*(uses.words for uses in found))
            for uses in found:
                for word, node in uses.members.items():
                    members[word].append(node)
            front = set().union(*(uses.nodes for uses in found))
            for word in words & members.keys():
                front.update(members.pop(word))
            front -= distance.keys()
            steps += 1
        return distance

    @functools.cached_property
    def distances(self) -> dict[str, dict[str, int]]:
        """Test file -> file that it reaches -> how many nodes are between, at least."""
        found: dict[str, dict[str, int]] = {}
        for test in self.tests:
            files = found[self.paths[test]] = {}
            for node, distance in self.reached(test).items():
                module = self.module_named(node.module)
                if module is not None:
                    files.setdefault(self.paths[module.name], distance)
        return found

    @functools.cached_property
    def _words(self) -> dict[str, set[str]]:
        """Test file -> the parts of paths, and the patterns, that its texts may name."""
        of_files = {
            self.paths[name]: {
                part
                for name_in_file in module.definitions
                for word in self.uses(Node(name, name_in_file)).words
                for part in word.split("/")
            }
            for name, module in self.modules.items()
            if not module.in_package
        }
        shared = of_files.get("tests/conftest.py", set())
        return {
            test: shared.union(*(of_files.get(file, ()) for file in files))
            for test, files in self.distances.items()
        }

    def reaching(self, path: str) -> dict[str, int]:
        """The test files that reach a file of the package or of the tests -> how many nodes are
        between, at least.  Data of the package counts as the modules of its folder, or of the next
        folder above that has any.
        """
        files, folder = {path}, Path(path)
        while path.startswith(f"{PACKAGE}/") and not files & self._files:
            folder = folder.parent
            files = {x for x in self._files if Path(x).parent == folder}
        return {
            test: min(distances[x] for x in files & distances.keys())
            for test, distances in self.distances.items()
            if files & distances.keys()
        }

    def tests_of(self, path: str) -> dict[str, float]:
        """The test files that a changed file reaches -> how many nodes are between, at least; empty
        if it is not known which.  A test that names the file is as near as one that uses it.
        """
        found: dict[str, float] = {**self.reaching(path)}
        if path in self._files:
            return found
        parts = {*Path(path).parts} - NO_NAMES
        return {test: 1 for test, words in self._words.items() if names(words, parts)} | found


def names(words: Iterable[str], parts: set[str]) -> bool:
    """Whether a word is one of the parts of a path, or a pattern of one."""
    patterns = (word for word in words if "*" in word and word.strip("*."))
    return not parts.isdisjoint(words) or any(fnmatch.filter(parts, x) for x in patterns)


class Reader(ast.NodeVisitor):
    """Finds the nodes and the words of code.

    Args:
      graph: what the names may lead to.
      module: of the code.
    """

    def __init__(self, graph: Graph, module: Module) -> None:
        self.graph = graph
        self.module = module
        self.imports = dict(module.imports)
        self.nodes: set[Node] = set()
        self.words: set[str] = set()

    def read(self, parts: Sequence[ast.AST]) -> None:
        """Reads parts of the code of one definition."""
        for part in parts:
            for inner in ast.walk(part):
                self.imports |= imports_of(inner)
        for part in parts:
            self.visit(part)

    def name(self, name: str, attributes: Sequence[str] = ()) -> None:
        """A name, with the attributes that are read from it."""
        self.words.update((name, *attributes))
        if name in self.imports:
            self.nodes |= self.graph.attribute(self.imports[name], attributes)
        elif name in self.module.definitions:
            self.nodes.add(Node(self.module.name, name))
        elif not self.module.in_package:
            self.fixture(name)

    def fixture(self, name: str) -> None:
        """A name that may be that of a fixture for all tests."""
        if "conftest" in self.graph.modules and name in self.graph.modules["conftest"].definitions:
            self.nodes.add(Node("conftest", name))

    def visit_Attribute(self, node: ast.Attribute) -> None:
        """A chain of attributes."""
        attributes: list[str] = []
        origin: ast.expr = node
        while isinstance(origin, ast.Attribute):
            attributes.insert(0, origin.attr)
            origin = origin.value
        if isinstance(origin, ast.Name):
            self.name(origin.id, attributes)
        else:
            self.words.update(attributes)
            self.visit(origin)

    def visit_Name(self, node: ast.Name) -> None:
        """A name."""
        self.name(node.id)

    def visit_arg(self, node: ast.arg) -> None:
        """An argument, of a test the name of a fixture."""
        if not self.module.in_package:
            self.name(node.arg)
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        """A statement; docstrings lead nowhere."""
        if not isinstance(node.value, ast.Constant):
            self.visit(node.value)

    def visit_Constant(self, node: ast.Constant) -> None:
        """A constant, which may be a text."""
        if isinstance(node.value, str):
            self.text(node.value)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """A text with values; as a name of a module it leads to all that it may name."""
        inserted = [x for x in node.values if not isinstance(x, ast.Constant)]
        texts = ["" if x in inserted else x.value for x in node.values]
        self.text("".join(texts))
        for part in inserted:
            self.visit(part)
        if self.module.imports_by_name and texts[0].startswith(f"{PACKAGE}."):
            self.nodes |= self.graph.everything(texts[0])

    def text(self, text: str) -> None:
        """A text, which may name something or be code."""
        if len(text) <= LONGEST_WORD:
            self.words.add(text)
        if self.module.in_package:
            if self.module.imports_by_name and "." in text and text in self.graph.modules:
                self.nodes.add(Node(text, ALL))
            return
        self.fixture(text)
        self.nodes |= {Node(x, ALL) for x in re.findall(r"(\w+)\.py\b", text)}
        if PROGRAMS.intersection(text.split("/")):
            self.nodes |= self.graph.everything()
        if PACKAGE in text:
            self.code(text)

    def code(self, text: str) -> None:
        """A text of a test with the name of the package."""
        try:
            statements = ast.parse(textwrap.dedent(text)).body
        except SyntaxError:
            statements = []
        inner = Reader(self.graph, Module("text", textwrap.dedent(text) if statements else ""))
        if inner.module.imports:
            inner.read(statements)
            self.nodes |= inner.nodes
            self.words |= inner.words
            return
        for dotted in re.findall(rf"\b{PACKAGE}((?:\.\w+)*)", text):
            if not dotted:
                self.nodes |= self.graph.everything()
            self.nodes |= self.graph.attribute(Node(PACKAGE, ALL), dotted.split(".")[1:])


def selected(graph: Graph, changed: Iterable[str]) -> list[str]:
    """The test files that a change reaches, the nearest ones first.

    Args:
      graph: the names of the working tree.
      changed: files that were changed, added or removed, relative to its root.
    """
    distance: dict[str, float] = {}
    for path in changed:
        removed_test = re.fullmatch(r"tests/(.*/)?test_\w+\.py", path) and (
            path not in graph.paths.values()
        )
        if removed_test:
            continue
        reached = graph.tests_of(path)
        if path.startswith(EVERYTHING) or not reached:
            print(f"all tests, because of {path}", file=sys.stderr)
            reached = dict.fromkeys(graph.distances, math.inf) | reached
        for test, nodes in reached.items():
            distance[test] = min(nodes, distance.get(test, math.inf))
    return sorted(distance, key=lambda test: (distance[test], test))


def git(*arguments: str) -> str | None:
    """What git prints; None if it fails."""
    try:
        done = subprocess.run(
            ("git", *arguments), cwd=ROOT, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def base_of_change() -> str | None:
    """The commit at which the change in the working tree begins; None if it is not known."""
    head = git("rev-parse", "HEAD")
    for main in ("origin/main", "main"):
        if (base := git("merge-base", "HEAD", main)) not in (None, head):
            return base
    is_merge = git("rev-parse", "--verify", "HEAD^2") is not None
    return git("rev-parse", "HEAD^1") if is_merge else None


def changed_files(base: str) -> list[str] | None:
    """The files that differ from a commit; None if that is not known."""
    lists = (
        git("diff", "--name-only", "--no-renames", "-z", base),
        git("ls-files", "--others", "--exclude-standard", "-z"),
    )
    if None in lists:
        return None
    return sorted({name for names in lists for name in (names or "").split("\0") if name})


def main() -> None:
    """Prints the selection."""
    base = sys.argv[1] if sys.argv[1:] else os.environ.get("BASE")
    if base is None:
        base = base_of_change()
    changed = changed_files(base) if base else None
    graph = Graph()
    if changed is None:
        print("all tests, because it is not known where the change begins", file=sys.stderr)
        files = sorted(graph.distances)
    else:
        files = selected(graph, changed)
        print(f"{len(changed)} files changed; {len(files)} files of tests", file=sys.stderr)
    print(*files, sep="\n")


if __name__ == "__main__":
    main()
