"""What the site shows is run: the gallery's scripts, and every block of Python on its pages."""

import json
import re
import subprocess
import sys
from types import ModuleType

import pytest
import run_page
from conftest import ROOT
from matplotlib.figure import Figure

sys.path.insert(0, str(ROOT / "docs"))  # before another package of the name `build`
import alt_text
import build
import contents
import equations
import flags
import gallery
import links
import reference

import iblf_jax as ij

FOLDERS = [ROOT / name for name in ("docs", "benchmarks", "examples")]
MARKDOWN = [ROOT.glob("*.md"), *(folder.rglob("*.md") for folder in FOLDERS)]
PAGES = [
    page
    for pages in MARKDOWN
    for page in sorted(pages)
    if run_page.blocks(page.read_text(encoding="utf-8"))
]
"""Every page with Python: README, CONTRIBUTING and what is beside them, and the documentation."""
ELSEWHERE = {"other_solvers", "ros2_demo"}
"""`test_vector_field` runs the page about other solvers, which needs a library of theirs, and
`test_demo` the one about a robot under ROS 2, which needs a law node."""
FIRST = {"README", "start"}
"""Every run of CI has these pages."""
LONG = {"guide", "tune_my_robot", "export_a_law", "own_law"}
"""They take more than a minute of a processor each and run before a release. The other pages are
the short forms of the guide; a notebook goes from the paper to a tuned robot."""
COMPILES_MOST = {"own_barrier"}
"""Optimising their kernels takes longer than what they compute."""
MARKS = dict.fromkeys(LONG, pytest.mark.release) | dict.fromkeys(FIRST, pytest.mark.site)


@pytest.mark.site
@pytest.mark.usefixtures("optimised_kernels")
@pytest.mark.parametrize("script", gallery.SCRIPTS, ids=gallery.page_name)
def test_a_script_of_the_gallery_makes_its_page(script):
    """`test_field` makes the pages of the entries of the benchmark of the field."""
    pictures = gallery.page(script)
    assert pictures and all(path.stat().st_size > 1000 for path in pictures)
    assert gallery.is_made(script)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_name_on_a_page_exists(page):
    assert run_page.unknown_names(page.read_text(encoding="utf-8"), ij) == []


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=MARKS.get(page.stem, pytest.mark.slow))
        for page in PAGES
        if page.stem not in ELSEWHERE
    ],
    ids=lambda page: page.stem,
)
def test_every_block_of_a_page_runs_in_a_process_of_its_own(page, tmp_path, request):
    """Nothing of this test reaches the page: neither its `__future__` flags, nor its settings of
    JAX, nor its names.

    The tests run on the oldest supported Python, 3.11, which evaluates annotations at once.  On
    3.14 and later `run_page` evaluates them after each block, so that a name which is missing from
    the package fails there too.
    """
    if page.stem == "sweeps":
        pytest.importorskip("zarr")
    if page.stem not in COMPILES_MOST:
        request.getfixturevalue("optimised_kernels")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    command = [sys.executable, str(ROOT / "tests" / "run_page.py"), str(page)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]


PAGE_OF_A_CLASS = """# A page

```python
{first_line}
import iblf_jax as ij


class Law:
    gain: ij.{name} = 1.0

    def command(self, q: ij.{name}) -> float:
        return ij.{name}
```
"""


@pytest.mark.parametrize(
    "first_line", ["", "from __future__ import annotations"], ids=["at-once", "lazily"]
)
def test_a_page_whose_annotation_names_nothing_fails(first_line, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(PAGE_OF_A_CLASS.format(first_line=first_line, name="Leaf"))
    assert run_page.run(page)["Law"].__annotations__
    assert run_page.unknown_names(page.read_text(), ij) == []
    page.write_text(PAGE_OF_A_CLASS.format(first_line=first_line, name="NoSuchType"))
    with pytest.raises(AttributeError, match="NoSuchType"):
        run_page.run(page)
    assert run_page.unknown_names(page.read_text(), ij) == ["ij.NoSuchType"]


@pytest.mark.site
@pytest.mark.parametrize("name", flags.CASES)
def test_a_run_raises_its_flag(name):
    assert f"## {name}" in flags.section(name)


def test_every_public_name_is_in_the_reference_and_every_flag_has_a_section():
    assert {flag.name for flag in ij.Status if flag} == set(flags.CASES)
    listed = {name for _, names in reference.PAGES.values() for name in names.split()}
    public = {name for name in dir(ij) if not name.startswith("_")} - {"TYPE_CHECKING"}
    things = {name for name in public if not isinstance(getattr(ij, name), ModuleType)}
    assert things <= listed | set(reference.FAMILIES)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("s = e1 / cos(theta)^2", r"s = e_{1} / \cos (\theta )^{2}"),
        (
            "V1 = int_0^xi 2 s ds    (2.6), (3.1)",
            r"V_{1} = \int _{0}^{\xi } 2 s\,\mathrm{d} s\quad\text{(2.6), (3.1)}",
        ),
        (
            "k = k_u if e1 > 0,   z_(k+1) <= 1",
            "k = k_{u}\\ \\text{if}\\ e_{1} > 0, \\\\\nz_{k+1} \\le  1",
        ),
    ],
)
def test_an_equation_for_terminals_is_one_in_tex(text, expected):
    assert equations.tex(text) == expected


def test_a_long_page_begins_with_a_list_of_its_sections():
    page = "# A\n\nwords\n\n(one)=\n## One\n\n## Two\n"
    assert contents.with_contents(page) == page
    listed = contents.with_contents(page + "x" * contents.LONG)
    assert listed.startswith(page.replace("(one)", f"{contents.ON_THIS_PAGE}\n\n(one)"))


def test_dead_links_and_pages_out_of_reach_are_named(tmp_path):
    (tmp_path / "deep").mkdir()
    chain = {"index": "a.html", "deep/b": "../c.html", "c": "d.html", "d": "#nowhere"}
    for name, to in chain.items():
        (tmp_path / f"{name}.html").write_text(
            f'<h1 id="here">x</h1><a href="{to}">y</a><a href="https://example.org/z">z</a>'
        )
    (tmp_path / "a.html").write_text(
        '<a href="deep/b.html#here">y</a><img src="gone.png"><a href="#here">z</a>'
        '<img src="a.html" alt="a plot"><pre>/tmp/x.py:1: a warning</pre>'
    )
    assert set(links.faults(tmp_path)) == {
        "a.html: #here has no such place",
        "a.html: there is no gone.png",
        "a.html: the image gone.png has no text",
        "a.html: the path /tmp/x.py:1: is shown",
        "d.html: #nowhere has no such place",
        "d.html is more than 3 clicks away",
    }


@pytest.mark.parametrize(
    ("path", "level", "expected"),
    [
        ("simulate", 2, "```{py:function} simulate(scenario: Scenario,"),
        ("proofs.Verdict", 2, "```{py:class} proofs.Verdict("),
        ("observers.RobotObserver", 3, "```{py:method} RobotObserver.estimate("),
    ],
)
def test_an_object_of_the_reference_is_defined_for_the_general_index(path, level, expected):
    text = reference.page_of(reference.named(path), path, level)
    assert expected in text and ":module: iblf_jax" in text


def test_the_text_of_a_figure_names_quantities_curves_and_colours():
    figure = Figure()
    left, right = figure.subplots(1, 2)
    figure.suptitle("Two runs\nstatus: ok")
    left.plot([0, 1], [0, 1], label=r"$\hat{f}$")
    left.legend()
    left.set(title="joint 0", xlabel="time $t$ [s]", ylabel=r"velocity $\dot{q}$ [rad/s]")
    image = right.imshow([[0, 1], [2, 3]])
    right.set(xlabel="$k_1$ [1/s]", ylabel="$K_2$")
    figure.colorbar(image, label="margin [rad]")
    assert alt_text.describe(figure) == (
        "Two runs, status: ok. 2 plots of joint 0 (velocity q' (rad/s) over time t (s));"
        " K_2 over k_1 (1/s). Legend: f_hat. Colours: margin (rad)"
    )
    assert alt_text.describe(Figure()) == "0 plots"


def test_the_citation_of_the_package_is_that_of_its_citation_file():
    page = (ROOT / "docs" / "citation.md").read_text(encoding="utf-8")
    first = page.split("```bibtex\n")[1].split("```")[0]
    assert first.startswith("@software{iblf_jax,")
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8").split("\nreferences:")[0]
    for name, key in (("title", "title"), ("version", "version"), ("url", "repository-code")):
        (value,) = re.findall(rf'^{key}: "?(.*?)"?$', cited, re.MULTILINE)
        assert re.search(rf"^  {name} += \{{{re.escape(value)}\}},$", first, re.MULTILINE)
    (year,) = re.findall(r"^date-released: (\d{4})-", cited, re.MULTILINE)
    assert f"{{{year}}}" in first


@pytest.mark.parametrize(
    ("built", "preferred"),
    [(["main", "1.0.0rc1"], "main"), (["main", "1.2.0", "1.10.0", "1.11.0rc1"], "1.10.0")],
)
def test_the_front_page_leads_to_the_last_release(built, preferred, tmp_path):
    for name in [*built, "not_a_version"]:
        (tmp_path / name).mkdir()
    for name in built:
        (tmp_path / name / "objects.inv").touch()
    build.write_versions(tmp_path)
    rows = {row["version"]: row for row in json.loads((tmp_path / "switcher.json").read_text())}
    assert set(rows) == set(built)
    assert [name for name, row in rows.items() if row["preferred"]] == [preferred]
    last = [name for name, row in rows.items() if row["name"].endswith("(last release)")]
    assert last == [name for name in [preferred] if name != "main"]
    assert f"url={preferred}/index.html" in (tmp_path / "index.html").read_text()
