"""The gallery: runs every script of examples/gallery and every entry of benchmarks/field and writes
its page.

A page has the text, the figures and the printed output of its script. The docstring of a script is
the introduction, "Title: text". A block begins with "# %%" and a text, which may continue in the
comment lines below. The page of an entry also has the tables of its `entry.toml`, and its scenario
file; the numbers that the entry reached are written to a JSON file of the same name.

The tests run the scripts by `page`, which writes to `out/site/gallery`. `docs/build.py` reads the
pages there, and runs the scripts whose page is missing or older.  `python docs/gallery.py NAME`
writes one page, to look at it before the site is built.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import io
import itertools
import os
import sys
import warnings
from pathlib import Path
from typing import Any

import alt_text
import entry_tables
from matplotlib import pyplot
from matplotlib.figure import Figure

sys.path.append(str(Path(__file__).resolve().parents[1] / "benchmarks" / "field"))

import entry

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = sorted((ROOT / "examples" / "gallery").glob("*.py"))
ENTRIES = [folder / "example.py" for folder in entry.folders()]
PAGES = [*SCRIPTS, *ENTRIES]
MADE = ROOT / "out" / "site" / "gallery"
DPI = 110
GENERATORS = [
    Path(__file__),
    *(Path(module.__file__) for module in (alt_text, entry_tables, entry)),
]
"""Modules on which the text of every page depends."""
PRECISION = (
    "The output was computed in float64: to obtain the same numbers, put"
    ' `import jax; jax.config.update("jax_enable_x64", True)` before the script.'
)


def page_name(script: Path) -> str:
    """The name of the page of a script: that of the script, or of the folder of an entry."""
    return script.parent.name if script.name == "example.py" else script.stem


def digest(source: Path) -> str:
    """What a page states of the script, or of the notebook, that it was made from; for an entry, of
    its folder, and for every script of the gallery also of the modules that make its page.
    """
    files = [source]
    if source in PAGES:
        files += GENERATORS
    if source.name == "example.py":
        files += sorted(
            path for path in source.parent.iterdir() if path.suffix in (".toml", ".csv")
        )
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


def is_of(page: Path, source: Path) -> bool:
    """Whether the page is there, and was made from the source as it is now."""
    return page.exists() and digest(source) in page.read_text()


def is_made(script: Path) -> bool:
    """Whether the page of this script, as it is now, is there."""
    return is_of(MADE / f"{page_name(script)}.md", script)


def page(script: Path) -> list[Path]:
    """Runs a script and writes its page; the pictures that it made."""
    MADE.mkdir(parents=True, exist_ok=True)
    name = page_name(script)
    title, _, rest = ast.get_docstring(ast.parse(script.read_text())).partition(": ")
    lines = [f"<!-- {digest(script)} -->", f"# {title}", "", f"{rest[0].upper()}{rest[1:]}", ""]
    executed, pictures, defined = _executed(script, name, title)
    shown = executed
    if "jax_enable_x64" not in script.read_text():
        shown = [PRECISION, "", *executed]
    if script.name == "example.py":
        contents = entry.load(script.parent)
        made = entry.REPRODUCTIONS[script.parent] = entry.reproduction(defined)
        (MADE / f"{name}.json").write_text(entry_tables.computed(made), encoding="utf-8")
        before = entry_tables.before_the_script(contents, made)
        after = entry_tables.after_the_script(contents) + _scenario_file(script.parent)
        shown = [*_as_lines(before), *shown, *_as_lines(after)]
    (MADE / f"{name}.md").write_text("\n".join(lines + shown), encoding="utf-8")
    return pictures


def _as_lines(parts: list[str]) -> list[str]:
    """Parts of a page, with an empty line after each."""
    return [line for part in parts for line in (part, "")]


def _executed(script: Path, name: str, title: str) -> tuple[list[str], list[Path], dict[str, Any]]:
    """The blocks of a script with their output, its pictures, and the names that it defines."""
    code = script.read_text().split('"""', 2)[2].strip()
    blocks = [block.strip() for block in f"\n{code}".split("\n# %%")]
    lines: list[str] = []
    names: dict[str, Any] = {"__name__": "__main__", "__file__": str(script)}
    pictures: list[Path] = []
    before = Path.cwd()
    os.chdir(MADE)
    try:
        for k, block in enumerate(blocks):
            words, source = _words(block) if k else ("", block)
            printed, known = io.StringIO(), list(names.values())
            with contextlib.redirect_stdout(printed), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                exec(compile(source, str(script), "exec", dont_inherit=True), names)
            lines += [words.strip(), ""] if words else []
            lines += ["```python", source.strip(), "```", ""] if source.strip() else []
            for variable, value in list(names.items()):
                if any(value is other for other in known):
                    continue
                if found := _picture(value, f"{name}_{variable}"):
                    pictures.append(found)
                    shown = alt_text.describe(value) if isinstance(value, Figure) else "animation"
                    lines += [f"![{title}: {shown}]({found.name})", ""]
            if printed.getvalue().strip():
                lines += ["```text", printed.getvalue().rstrip(), "```", ""]
    finally:
        pyplot.close("all")
        os.chdir(before)
    return lines, pictures, names


def _scenario_file(folder: Path) -> list[str]:
    """The scenario file of an entry, where there is one."""
    path = folder / "scenario.toml"
    if not path.exists():
        return []
    place = path.relative_to(ROOT).as_posix()
    return ["## Scenario file", f"`{place}`:", f"```toml\n{path.read_text().rstrip()}\n```"]


def _words(block: str) -> tuple[str, str]:
    """What a block says, its first line and the comment below it, and its code."""
    words, *rest = block.split("\n")
    comment = list(itertools.takewhile(lambda line: line.startswith("#"), rest))
    return "\n".join([words.strip(), *(line[1:].strip() for line in comment)]), "\n".join(
        rest[len(comment) :]
    )


def _picture(value: Any, stem: str) -> Path | None:
    """The file of a figure or a film; None of anything else."""
    if isinstance(value, Path) and value.suffix == ".gif":
        return MADE / value.name
    if not isinstance(value, Figure):
        return None
    path = MADE / f"{stem}.png"
    value.savefig(path, dpi=DPI)
    return path


def index() -> str:
    """The page that shows all of them, by their first picture."""
    words = "Each figure has a script in `examples/gallery`, which the tests run."
    others = (
        "Published examples of other authors, in `benchmarks/field/entries`. Each page lists the"
        " printed, corrected and missing parameters, the published numbers beside those that this"
        " package reached, and what was not reproduced. On the tasks of some of them laws are"
        " compared with [the same budget of tuning](../field_equal_budget.md)."
    )
    toctree = "```{toctree}\n:hidden:\n\n" + "\n".join(map(page_name, PAGES)) + "\n```"
    parts = [
        "# Gallery",
        words,
        "## Figures of the package",
        _cards(SCRIPTS),
        "(reproductions)=\n## Published examples",
        others,
        _cards(ENTRIES),
        toctree,
    ]
    return "\n\n".join(parts) + "\n"


def _cards(scripts: list[Path]) -> str:
    """A grid of pages."""
    cards = []
    for script in scripts:
        name = page_name(script)
        text = (MADE / f"{name}.md").read_text()
        title, picture = (
            text.split("\n# ", 1)[1].split("\n", 1)[0],
            text.split("![", 1)[1].split("](", 1)[1].split(")", 1)[0],
        )
        cards.append(
            f":::{{grid-item-card}} {title}\n:link: {name}\n:link-type: doc\n:img-top:"
            f" {picture}\n:::"
        )
    return "::::{grid} 2 3 4 4\n:gutter: 2\n\n" + "\n".join(cards) + "\n\n::::"


def main() -> None:
    """Writes the pages whose names are given."""
    import jax
    import matplotlib

    jax.config.update("jax_enable_x64", True)
    matplotlib.use("Agg")
    scripts = {page_name(script): script for script in PAGES}
    for name in sys.argv[1:]:
        if name not in scripts:
            sys.exit(f"There is no page {name}; there are {', '.join(scripts)}.")
        page(scripts[name])
        print(MADE / f"{name}.md")


if __name__ == "__main__":
    main()
