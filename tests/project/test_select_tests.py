"""Which tests a change selects (`tools/select_tests.py`), in a small package and in this one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT / "tools"))
import select_tests
from select_tests import Graph, selected

FILES = {
    "iblf_jax/__init__.py": """
        from iblf_jax.first_use import on_first_use
        from iblf_jax.world import robots as robots
        TABLE = {"tune": ("iblf_jax.tuning", "tune"), "proofs": ("iblf_jax.proofs", None)}
        __getattr__ = on_first_use(__name__, TABLE)
        """,
    "iblf_jax/first_use.py": """
        import importlib
        def on_first_use(package, table):
            return lambda name: importlib.import_module(table[name][0])
        """,
    "iblf_jax/world/__init__.py": "",
    "iblf_jax/world/robots.py": """
        from iblf_jax.presentation import present
        from iblf_jax.world.links import LENGTH
        class Arm:
            def plot(self):
                return present("arm figure")
            def length(self):
                return LENGTH
        def load(): ...
        """,
    "iblf_jax/world/links.py": "LENGTH = 1.0",
    "iblf_jax/presentation.py": """
        import importlib
        TABLE = {"arm figure": ("iblf_jax.plotting", "arm"), "page": ("iblf_jax.proofs", "page")}
        def present(name):
            module, function = TABLE[name]
            return getattr(importlib.import_module(module), function)()
        """,
    "iblf_jax/plotting.py": "def arm(): ...",
    "iblf_jax/tuning/__init__.py": "from iblf_jax.tuning.search import tune as tune",
    "iblf_jax/tuning/search.py": """
        def tune():
            from iblf_jax.tuning.starts import first
            return first()
        """,
    "iblf_jax/tuning/starts.py": "def first(): ...",
    "iblf_jax/tuning/c/tune.h": "",
    "iblf_jax/proofs.py": "def page(): ...",
    "iblf_jax/files.py": """
        import importlib
        COMMANDS = ("starts",)
        def command(name):
            return importlib.import_module(f"iblf_jax.tuning.{name}")
        """,
    "iblf_jax/registry.py": """
        from iblf_jax.world.links import LENGTH
        register(LENGTH)
        NAMES = ()
        """,
    "iblf_jax/core/checks.py": "",
    "tests/conftest.py": """
        import iblf_jax as ij
        def tuned():
            return ij.tune()
        """,
    "tests/cases.py": """
        import iblf_jax as ij
        CASES = [ij.tune]
        """,
    "tests/data/arm.urdf": "",
    "docs/page.md": "",
    "README.md": "",
    "LICENSE": "",
}
TESTS = {
    "robot": "import iblf_jax as ij\ndef test(): ij.robots.load()",
    "length": "from iblf_jax.world.robots import Arm\ndef test(): Arm().length()",
    "plot": "import iblf_jax as ij\ndef test(): ij.robots.Arm().plot()",
    "tune": "import iblf_jax as ij\ndef test(): ij.tune()",
    "fixture": "def test(tuned): ...",
    "helper": "from cases import CASES\ndef test(): CASES",
    "proof": "import iblf_jax as ij\ndef test(): ij.proofs.page()",
    "all_names": "import iblf_jax as ij\ndef test(): [getattr(ij, x) for x in dir(ij)]",
    "script": "CODE = 'import iblf_jax as ij\\nij.tune()'\ndef test(): run(CODE)",
    "command": "def test(): run('python', '-m', 'iblf_jax', 'tune')",
    "by_name": "from iblf_jax.files import command\ndef test(): command('starts')",
    "registered": "from iblf_jax.registry import NAMES\ndef test(): NAMES",
    "data": "def test(): open('data/arm.urdf')",
    "pages": "def test(): ROOT.glob('*.md')",
    "site": "def test(): ROOT / 'docs' / 'page.md'",
}


@pytest.fixture(scope="module")
def graph(tmp_path_factory) -> Graph:
    root = tmp_path_factory.mktemp("repository")
    tests = {f"tests/folder/test_{name}.py": text for name, text in TESTS.items()}
    for name, text in (FILES | tests).items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(select_tests.textwrap.dedent(text))
    return Graph(root)


def names(graph: Graph, *changed: str) -> set[str] | None:
    """The tests that a change selects; None for all."""
    found = selected(graph, changed)
    is_all = len(found) == len(graph.tests)
    return None if is_all else {Path(x).stem.removeprefix("test_") for x in found}


USE_ALL = {"all_names", "command", "site"}
"""Tests that use the whole package."""
TUNE = {"tune", "fixture", "helper", "script"} | USE_ALL


@pytest.mark.parametrize(
    ("changed", "tests"),
    [
        ("iblf_jax/world/robots.py", {"robot", "length", "plot"} | USE_ALL),
        ("iblf_jax/world/links.py", {"length", "registered"} | USE_ALL),
        ("iblf_jax/plotting.py", {"plot", "command", "site"}),
        ("iblf_jax/tuning/search.py", {"by_name"} | TUNE),
        ("iblf_jax/tuning/starts.py", {"by_name"} | TUNE),
        ("iblf_jax/proofs.py", {"proof"} | USE_ALL),
        ("iblf_jax/tuning/c/tune.h", {"by_name"} | TUNE),
        ("tests/cases.py", {"helper"}),
        ("tests/data/arm.urdf", {"data"}),
        ("tests/folder/test_tune.py", {"tune"}),
        ("tests/folder/test_that_was_removed.py", set()),
        ("docs/page.md", {"pages", "site"}),
        ("README.md", {"pages"}),
    ],
)
def test_a_file_selects_the_tests_that_reach_it(graph, changed, tests):
    assert names(graph, changed) == tests


@pytest.mark.parametrize(
    "changed",
    ["LICENSE", "iblf_jax/core/checks.py", "tests/conftest.py", "pyproject.toml", ".ci/run", "new"],
)
def test_what_all_depend_on_or_nobody_knows_selects_all(graph, changed):
    assert names(graph, "tests/folder/test_tune.py", changed) is None


def changed() -> list[str] | None:
    base = select_tests.base_of_change()
    return None if base is None else select_tests.changed_files(base)


def test_a_change_is_what_a_branch_or_a_merge_adds_to_main(tmp_path, monkeypatch):
    """With two commits of a branch that has two more than main; on main itself it is not known."""
    for name in [x for x in os.environ if x.startswith("GIT_")]:
        monkeypatch.delenv(name)
    monkeypatch.setattr(select_tests, "ROOT", tmp_path)

    def git(words: str) -> None:
        command = ["git", "-c", "user.name=A", "-c", "user.email=a@b.c", *words.split()]
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)

    git("init --initial-branch=main")
    for name in "abcd":
        if name == "c":
            git("checkout -b branch")
        (tmp_path / name).write_text(name)
        git(f"add {name}")
        git(f"commit -m {name}")
    (tmp_path / "new").write_text("")
    (tmp_path / "b").unlink()
    assert changed() == ["b", "c", "d", "new"]
    (tmp_path / "new").unlink()
    git("checkout --force main")
    assert changed() is None
    git("merge --no-ff branch")
    assert changed() == ["c", "d"]
    assert select_tests.changed_files("0" * 40) is None


def test_an_empty_base_selects_all(graph, monkeypatch, capsys):
    monkeypatch.setattr(select_tests, "Graph", lambda: graph)
    monkeypatch.setattr(sys, "argv", ["select_tests.py"])
    monkeypatch.setenv("BASE", "")
    select_tests.main()
    printed = capsys.readouterr()
    assert printed.out.split() == sorted(graph.distances)
    assert "not known where the change begins" in printed.err


@pytest.mark.slow
def test_changes_of_this_package():
    """A barrier reaches what is about laws, a proof what is about proofs."""
    graph = Graph()
    proofs = names(graph, "iblf_jax/proofs/arms.py")
    assert proofs >= {"arm_proofs", "attacks", "prove", "cli", "results", "site", "field"}
    assert not proofs & {"arm", "decays"}
    assert len(proofs) < len(graph.tests) / 2
    assert names(graph, "iblf_jax/control/barriers/tan.py") >= {"decays", "laws"}
    assert names(graph, "iblf_jax/deployment/ros2/templates/setup.cfg") >= {"ros_package"}
    assert names(graph, "tests/data/costs.json") >= {"costs"}
    assert names(graph, "tests/independent_chains.py") >= {"strict_feedback", "decays"}
    for data in (ROOT / "tests" / "data").iterdir():
        assert graph.tests_of(data.relative_to(ROOT).as_posix()), data
    assert names(graph, "iblf_jax/kernels/c/interval.h") is None
