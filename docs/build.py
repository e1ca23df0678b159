"""Builds the site: `python docs/build.py`; the result is out/site/html/index.html.

The script assembles the pages in out/site/source: the pages of this folder, the notebooks and the
gallery as the tests executed them, and pages that are generated from docstrings, status flags,
barriers, CONTRIBUTING and benchmark results. It executes notebooks and scripts whose output is
missing or older than the source. Warnings of Sphinx and dead links (`links.py`) are errors.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]
os.environ.setdefault("MPLBACKEND", "Agg")

import nbformat
from gallery import digest

SITE = ROOT / "out" / "site"
SOURCE = SITE / "source"
EXECUTED = SITE / "notebooks"
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def execute(notebook: Path, folder: Path) -> nbformat.NotebookNode:
    """A notebook with its outputs, run in a folder; kept for the site."""
    from nbclient import NotebookClient

    found = nbformat.read(notebook, as_version=4)
    NotebookClient(
        found, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    found.metadata["source_digest"] = digest(notebook)
    EXECUTED.mkdir(parents=True, exist_ok=True)
    nbformat.write(found, EXECUTED / notebook.name)
    return found


def is_executed(notebook: Path) -> bool:
    """Whether this notebook, as it is now, was executed."""
    path = EXECUTED / notebook.name
    return path.exists() and nbformat.read(path, as_version=4).metadata.get(
        "source_digest"
    ) == digest(notebook)


def missing() -> list[Callable[[], object]]:
    """The notebooks, scripts and examples of flags whose output is missing or older than they."""
    import flags
    import gallery

    work = SITE / "work"
    work.mkdir(parents=True, exist_ok=True)
    return [
        *(partial(execute, notebook, work) for notebook in NOTEBOOKS if not is_executed(notebook)),
        *(partial(gallery.page, script) for script in gallery.PAGES if not gallery.is_made(script)),
        *(partial(flags.section, name) for name in flags.CASES if not flags.is_made(name)),
    ]


def execute_missing() -> None:
    """Executes them, each processor one at a time."""
    tasks = missing()
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


def assemble() -> None:
    """Puts all pages together."""
    import barriers
    import choosing
    import field
    import flags
    import gallery
    import measured
    import reference

    import iblf_jax as ij

    shutil.rmtree(SOURCE, ignore_errors=True)
    shutil.copytree(ROOT / "docs", SOURCE, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    shutil.copy(ROOT / "docs" / "conf.py", SOURCE)

    (SOURCE / "tutorials").mkdir()
    for notebook in NOTEBOOKS:
        shutil.copy(EXECUTED / notebook.name, SOURCE / "tutorials")
    listed = "\n".join(notebook.stem for notebook in NOTEBOOKS)
    words = "The notebooks of the repository with their output."
    (SOURCE / "tutorials" / "index.md").write_text(
        f"# Tutorials\n\n{words}\n\n```{{toctree}}\n:maxdepth: 1\n\n{listed}\n```\n"
    )

    shutil.copytree(gallery.MADE, SOURCE / "gallery")
    (SOURCE / "gallery" / "index.md").write_text(gallery.index())

    (SOURCE / "extra").mkdir()
    laws = {
        law: ij.presets.zhang_yan_2024(law=law, reading="corrected")
        for law in ("integral", "log", "tan", "pd")
    }
    ij.explore(laws).save(SOURCE / "extra" / "live_loop.html")
    reference.write(SOURCE / "reference")
    flags.write(SOURCE / "how_to")
    barriers.write(SOURCE / "theory")
    choosing.write(SOURCE / "how_to")
    field.write(SOURCE)
    measured.write(SOURCE / "benchmarks.md")
    shutil.copy(ROOT / "benchmarks" / "README.md", SOURCE / "lab_notes.md")
    shutil.copy(ROOT / "CONTRIBUTING.md", SOURCE / "contributing.md")


def main() -> int:
    """Assembles and builds; Sphinx's exit code."""
    import links

    execute_missing()
    enable_x64()
    assemble()
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
        str(SOURCE),
        str(SITE / "html"),
    ]
    code = subprocess.run(command, check=False).returncode
    wrong = links.faults(SITE / "html")
    print("\n".join(wrong))
    code = code or int(bool(wrong))
    print(
        f"written to {SITE.relative_to(ROOT) / 'html' / 'index.html'}"
        if code == 0
        else "the site was not built"
    )
    return code


if __name__ == "__main__":
    sys.exit(main())
