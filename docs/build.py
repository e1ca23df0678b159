"""Builds the site: `python docs/build.py`; the result is out/site/html/index.html.

`--draft` executes no notebook: those that were not executed appear without their outputs.
`--version NAME` says which version the pages belong to; they are in out/site/html/NAME. The front
page leads to the last release there, or to "main", and `switcher.json` lists all of them.

The script assembles the pages in out/site/source: the pages of this folder, the notebooks and the
gallery as the tests executed them, and pages that are generated from docstrings, status flags,
barriers, CONTRIBUTING and benchmark results. It executes notebooks and scripts whose output is
missing or older than the source. Warnings of Sphinx and dead links (`links.py`) are errors.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]
os.environ.setdefault("MPLBACKEND", "Agg")

import nbformat
from contents import ON_THIS_PAGE, with_contents
from entry_tables import markdown_table
from gallery import digest
from packaging.version import InvalidVersion, Version
from PIL import Image

SITE = ROOT / "out" / "site"
SOURCE = SITE / "source"
HTML = SITE / "html"
EXECUTED = SITE / "notebooks"
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
KERNEL = ROOT / "docs" / "notebook_kernel.py"
DEVELOPMENT = "main"
"""Name of the version that is not a release."""
THUMBNAIL = 480
"""Width of a picture on the page of the gallery [pixels]."""


def digest_of(notebook: Path) -> str:
    """What the outputs of a notebook depend on: itself, and what its kernel runs before it."""
    return "".join(digest(source) for source in (notebook, KERNEL, ROOT / "docs" / "alt_text.py"))


def execute(notebook: Path, folder: Path) -> nbformat.NotebookNode:
    """A notebook with its outputs, run in a folder; kept for the site."""
    from nbclient import NotebookClient

    found = nbformat.read(notebook, as_version=4)
    NotebookClient(
        found,
        timeout=300,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
        extra_arguments=[f"--IPKernelApp.exec_files=['{KERNEL}']"],
    ).execute()
    found.metadata["source_digest"] = digest_of(notebook)
    EXECUTED.mkdir(parents=True, exist_ok=True)
    nbformat.write(found, EXECUTED / notebook.name)
    return found


def is_executed(notebook: Path) -> bool:
    """Whether this notebook, as it is now, was executed."""
    path = EXECUTED / notebook.name
    return path.exists() and nbformat.read(path, as_version=4).metadata.get(
        "source_digest"
    ) == digest_of(notebook)


def new_work_folder() -> Path:
    """An empty folder in which the notebooks run: a store of another version of the package cannot
    be continued.
    """
    work = SITE / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    return work


def outdated(work: Path, notebooks: Iterable[Path]) -> list[Callable[[], object]]:
    """The scripts, examples of flags and given notebooks whose output is missing or older than
    they.
    """
    import flags
    import gallery

    return [
        *(partial(execute, notebook, work) for notebook in notebooks if not is_executed(notebook)),
        *(partial(gallery.page, script) for script in gallery.PAGES if not gallery.is_made(script)),
        *(partial(flags.section, name) for name in flags.CASES if not flags.is_made(name)),
    ]


def execute_outdated(notebooks: Iterable[Path]) -> None:
    """Executes what is outdated, each processor one at a time."""
    tasks = outdated(new_work_folder(), notebooks)
    if not tasks:
        return
    # JAX hangs in processes that are forked from one that has used it.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(mp_context=context, initializer=enable_x64) as pool:
        for done in [pool.submit(task) for task in tasks]:
            done.result()


def enable_x64() -> None:
    """Scripts and examples are computed in float64."""
    import jax

    jax.config.update("jax_enable_x64", True)


def tutorial(notebook: Path) -> nbformat.NotebookNode:
    """A notebook as it was executed, whose pictures have the texts of its figures, with the list of
    its sections; one that was not executed is without outputs.
    """
    made = EXECUTED / notebook.name if is_executed(notebook) else notebook
    found = nbformat.read(made, as_version=4)
    found.cells[0].source += f"\n\n{ON_THIS_PAGE}"
    for cell in found.cells:
        shown = [output.get("data", {}) for output in cell.get("outputs", ())]
        texts = [data["text/plain"] for data in shown if "image/png" in data]
        if texts:
            cell.metadata["mystnb"] = {"image": {"alt": " Next figure: ".join(texts)}}
    return found


def page_of_tutorials() -> str:
    """The page that lists the notebooks, with what their second cells say of them."""
    rows = []
    for notebook in NOTEBOOKS:
        title, needs = (cell.source for cell in nbformat.read(notebook, as_version=4).cells[:2])
        found: Any = re.search(r"Knowledge: (.*)\. Extras: .* Time: about (\d+) minutes", needs)
        link = f"[{title.splitlines()[0].removeprefix('# ')}]({notebook.name})"
        rows.append([link, found[1], f"{found[2]} min"])
    return "\n".join(
        [
            "# Tutorials",
            "",
            "The notebooks of the repository with their output. To run them in a clone:",
            "",
            "```bash",
            'pip install ".[notebooks,robots,sweep]" && jupyter lab notebooks',
            "```",
            "",
            "In Colab or a similar service, the first cell of a notebook installs the package."
            " Begin with the first notebook; each one states its goals and what it needs.",
            "",
            markdown_table(["notebook", "knowledge", "time with exercises"], rows),
            "",
            "```{toctree}\n:hidden:\n",
            *(notebook.stem for notebook in NOTEBOOKS),
            "```",
            "",
        ]
    )


def with_thumbnails(index: str, folder: Path) -> str:
    """The page of the gallery with small pictures, which have the titles of their pages as text."""

    def small(card: re.Match[str]) -> str:
        title, options, name = card.groups()
        thumbnail = f"small_{Path(name).stem}.png"
        with Image.open(folder / name) as picture:
            reduced = picture.convert("RGB")
            reduced.thumbnail((THUMBNAIL, 4 * THUMBNAIL))
            reduced.quantize(128).save(folder / thumbnail, optimize=True)
        return f"{{grid-item-card}} {title}\n{options}:img-top: {thumbnail}\n:img-alt: {title}\n"

    card = r"\{grid-item-card\} (.*)\n((?::link.*\n)*):img-top: (.*)\n"
    return re.sub(card, small, index)


def copy_mathjax(folder: Path) -> None:
    """MathJax as a package of the extra `docs` has it: with it, no page loads anything from other
    hosts. Of the files that each contain all of MathJax the pages load one.
    """
    package = importlib.metadata.distribution("sphinx-mathjax-offline")
    found = Path(str(package.locate_file("sphinx-mathjax-offline/static/mathjax")))
    complete = {path.name for path in found.glob("*-*.js")} - {"tex-chtml.js"}
    shutil.copytree(found, folder, ignore=shutil.ignore_patterns("asciimath.js", *complete))


def assemble() -> None:
    """Puts all pages together."""
    import barriers
    import choosing
    import field
    import field_budget
    import flags
    import gallery
    import measured
    import reference

    import iblf_jax as ij

    shutil.rmtree(SOURCE, ignore_errors=True)
    shutil.copytree(ROOT / "docs", SOURCE, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    shutil.copy(ROOT / "docs" / "conf.py", SOURCE)
    copy_mathjax(SOURCE / "_static" / "mathjax")

    (SOURCE / "tutorials").mkdir()
    for notebook in NOTEBOOKS:
        nbformat.write(tutorial(notebook), SOURCE / "tutorials" / notebook.name)
    (SOURCE / "tutorials" / "index.md").write_text(page_of_tutorials(), encoding="utf-8")

    shutil.copytree(gallery.MADE, SOURCE / "gallery", ignore=shutil.ignore_patterns("*.md"))
    for script in gallery.PAGES:  # and no page of a script that is there no longer
        shutil.copy(gallery.MADE / f"{gallery.page_name(script)}.md", SOURCE / "gallery")
    index = with_thumbnails(gallery.index(), SOURCE / "gallery")
    (SOURCE / "gallery" / "index.md").write_text(index)

    (SOURCE / "extra").mkdir()
    laws = {
        law: ij.presets.zhang_yan_2024(law=law, variant="corrected")
        for law in ("integral", "log", "tan", "pd")
    }
    page = ij.explore(laws)
    if page.fallback:
        sys.exit('the live page needs ziglang: pip install ".[export]"')
    page.save(SOURCE / "extra" / "live_loop.html")
    reference.write(SOURCE / "reference")
    flags.write(SOURCE / "how_to")
    barriers.write(SOURCE / "theory")
    choosing.write(SOURCE / "how_to")
    field.write(SOURCE)
    field_budget.write(SOURCE)
    measured.write(SOURCE / "benchmarks.md")
    shutil.copy(ROOT / "benchmarks" / "README.md", SOURCE / "lab_notes.md")
    shutil.copy(ROOT / "benchmarks" / "field" / "README.md", SOURCE / "add_an_entry.md")
    shutil.copy(ROOT / "benchmarks" / "field" / "tasks" / "README.md", SOURCE / "tasks.md")
    for name, page in (("CONTRIBUTING", "contributing"), ("CHANGELOG", "changelog")):
        text = (ROOT / f"{name}.md").read_text(encoding="utf-8")
        text = text.replace("(benchmarks/field/README.md)", "(add_an_entry.md)")
        text = text.replace("(benchmarks/README.md)", "(lab_notes.md)")
        (SOURCE / f"{page}.md").write_text(text, encoding="utf-8")
    shutil.copy(ROOT / "CITATION.cff", SOURCE)
    for path in SOURCE.rglob("*.md"):
        path.write_text(with_contents(path.read_text(encoding="utf-8")), encoding="utf-8")


def release_of(name: str) -> Version | None:
    """The version that a folder of pages is named after; None for a version in development."""
    try:
        return Version(name)
    except InvalidVersion:
        return None


def write_versions(folder: Path) -> None:
    """Lists the versions that were built in a folder, and leads its front page to the last release,
    or to the version in development where there is none.
    """
    built = sorted(path.parent.name for path in folder.glob("*/objects.inv"))
    numbered = sorted(filter(release_of, built), key=Version, reverse=True)
    releases = [name for name in numbered if not Version(name).is_prerelease]
    development = [name for name in built if name not in numbered]
    preferred = (releases + development + numbered)[0]
    rows = []
    for name in [*development, *numbered]:
        label = f"{name} (last release)" if name in releases[:1] else name
        row = {"name": label, "version": name, "url": f"{name}/", "preferred": name == preferred}
        rows.append(row)
    (folder / "switcher.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    (folder / "index.html").write_text(
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>iblf_jax</title>\n'
        f'<meta http-equiv="refresh" content="0; url={preferred}/index.html"></head>\n'
        f'<body><a href="{preferred}/index.html">Documentation of iblf_jax</a></body></html>\n',
        encoding="utf-8",
    )


def main() -> int:
    """Assembles and builds; Sphinx's exit code."""
    import links

    parser = argparse.ArgumentParser(description="Builds the documentation site.")
    parser.add_argument("--version", default=DEVELOPMENT, help="which version the pages are of")
    parser.add_argument("--draft", action="store_true", help="without executing notebooks")
    options = parser.parse_args()
    name = options.version
    execute_outdated(() if options.draft else NOTEBOOKS)
    enable_x64()
    assemble()
    shutil.rmtree(HTML / name, ignore_errors=True)
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-j",
        "auto",
        "-W",
        "--keep-going",
        "-b",
        "html",
        "-d",
        str(SITE / "doctrees" / name),
        "-A",
        f"built_version={name}",
        str(SOURCE),
        str(HTML / name),
    ]
    code = subprocess.run(command, check=False).returncode
    # MyST-NB stores its pictures beside the output folder; Sphinx has copied them into it.
    shutil.rmtree(HTML / "jupyter_execute", ignore_errors=True)
    wrong = links.faults(HTML / name)
    print("\n".join(wrong))
    if code or wrong:
        print("the site was not built")
        return code or 1
    write_versions(HTML)
    print(f"written to {(HTML / 'index.html').relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
