"""The gallery: runs every script of examples/gallery and examples/reproductions and writes its
page.

A page has the text, the figures and the printed output of its script. The docstring of a script is
the introduction, "Title: text". A block begins with "# %%" and a text, which may continue in the
comment lines below. A reproduction has a scenario file of the same name, and may have published
numbers in a CSV file of the same name.

The tests run the scripts by `page`, which writes to `out/site/gallery`. `docs/build.py` reads the
pages there, and runs the scripts whose page is missing or older.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import io
import itertools
import os
import warnings
from pathlib import Path
from typing import Any

from matplotlib import pyplot
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = sorted((ROOT / "examples" / "gallery").glob("*.py"))
REPRODUCTIONS = sorted((ROOT / "examples" / "reproductions").glob("*.py"))
PAGES = [*SCRIPTS, *REPRODUCTIONS]
MADE = ROOT / "out" / "site" / "gallery"
DPI = 110


def digest(source: Path) -> str:
    """What a page says of the script, or of the notebook, that it was made from, and of what lies
    beside it under the same name.
    """
    files = [source, *(source.with_suffix(suffix) for suffix in (".toml", ".csv"))]
    return hashlib.sha256(
        b"".join(file.read_bytes() for file in files if file.exists())
    ).hexdigest()[:16]


def is_of(page: Path, source: Path) -> bool:
    """Whether the page is there, and was made from the source as it is now."""
    return page.exists() and digest(source) in page.read_text()


def is_made(script: Path) -> bool:
    """Whether the page of this script, as it is now, is there."""
    return is_of(MADE / f"{script.stem}.md", script)


def page(script: Path) -> list[Path]:
    """Runs a script and writes its page; the pictures that it made."""
    MADE.mkdir(parents=True, exist_ok=True)
    text = script.read_text()
    title, _, rest = ast.get_docstring(ast.parse(text)).partition(": ")
    code = text.split('"""', 2)[2].strip()
    blocks = [block.strip() for block in f"\n{code}".split("\n# %%")]
    lines = [f"<!-- {digest(script)} -->", f"# {title}", "", f"{rest[0].upper()}{rest[1:]}", ""]
    names: dict[str, Any] = {"__name__": "__main__", "__file__": str(script)}
    pictures: list[Path] = []
    before = Path.cwd()
    os.chdir(MADE)
    try:
        for k, block in enumerate(blocks):
            words, source = _words(block) if k else ("", block)
            printed, seen = io.StringIO(), {id(x) for x in names.values()}
            with contextlib.redirect_stdout(printed), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                exec(compile(source, str(script), "exec", dont_inherit=True), names)
            lines += [words.strip(), ""] if words else []
            lines += ["```python", source.strip(), "```", ""] if source.strip() else []
            for name, value in list(names.items()):
                if id(value) not in seen and (found := _picture(value, f"{script.stem}_{name}")):
                    pictures.append(found)
                    lines += [f"![{title}: {name}]({found.name})", ""]
            if printed.getvalue().strip():
                lines += ["```text", printed.getvalue().rstrip(), "```", ""]
    finally:
        pyplot.close("all")
        os.chdir(before)
    beside = script.with_suffix(".toml")
    if beside.exists():
        lines += [
            f"The scenario file, `{beside.relative_to(ROOT).as_posix()}`:",
            "",
            "```toml",
            beside.read_text().rstrip(),
            "```",
            "",
        ]
    (MADE / f"{script.stem}.md").write_text("\n".join(lines), encoding="utf-8")
    return pictures


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
        "Published examples of other authors, in `examples/reproductions`: as scenario files, or as"
        " scripts where the plant is a function of the example. Each page lists the printed and the"
        " missing parameters, the results of this package, and what could not be reproduced."
    )
    toctree = "```{toctree}\n:hidden:\n\n" + "\n".join(script.stem for script in PAGES) + "\n```"
    parts = [
        "# Gallery",
        words,
        _cards(SCRIPTS),
        "(reproductions)=\n## Reproductions",
        others,
        _cards(REPRODUCTIONS),
        toctree,
    ]
    return "\n\n".join(parts) + "\n"


def _cards(scripts: list[Path]) -> str:
    """A grid of pages."""
    cards = []
    for script in scripts:
        text = (MADE / f"{script.stem}.md").read_text()
        title, picture = (
            text.split("\n# ", 1)[1].split("\n", 1)[0],
            text.split("![", 1)[1].split("](", 1)[1].split(")", 1)[0],
        )
        cards.append(
            f":::{{grid-item-card}} {title}\n:link: {script.stem}\n:link-type: doc\n:img-top:"
            f" {picture}\n:::"
        )
    return "::::{grid} 1 2 3 3\n:gutter: 2\n\n" + "\n".join(cards) + "\n\n::::"
