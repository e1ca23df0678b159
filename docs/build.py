"""Builds the site: `python docs/build.py`; the result is out/site/html/index.html.

The script assembles the pages in out/site/source: the pages of this folder, the notebooks and the
gallery as the tests executed them, and pages that are generated from docstrings, status flags,
barriers, CONTRIBUTING and benchmark results. It executes notebooks and scripts whose output is
missing or older than the source. Warnings of Sphinx and dead links (`links.py`) are errors.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
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


def assemble() -> None:
    """Puts all pages together."""
    import barriers
    import choosing
    import flags
    import gallery
    import measured
    import reference

    import iblf_jax as ij

    shutil.rmtree(SOURCE, ignore_errors=True)
    shutil.copytree(ROOT / "docs", SOURCE, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    shutil.copy(ROOT / "docs" / "conf.py", SOURCE)

    (SOURCE / "tutorials").mkdir()
    work = SITE / "work"
    work.mkdir(exist_ok=True)
    for notebook in NOTEBOOKS:
        if not is_executed(notebook):
            execute(notebook, work)
        shutil.copy(EXECUTED / notebook.name, SOURCE / "tutorials")
    listed = "\n".join(notebook.stem for notebook in NOTEBOOKS)
    words = "The notebooks of the repository with their output."
    (SOURCE / "tutorials" / "index.md").write_text(
        f"# Tutorials\n\n{words}\n\n```{{toctree}}\n:maxdepth: 1\n\n{listed}\n```\n"
    )

    for script in gallery.PAGES:
        if not gallery.is_made(script):
            gallery.page(script)
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
    measured.write(SOURCE / "benchmarks.md")
    shutil.copy(ROOT / "benchmarks" / "README.md", SOURCE / "lab_notes.md")
    shutil.copy(ROOT / "CONTRIBUTING.md", SOURCE / "contributing.md")


def main() -> int:
    """Assembles and builds; Sphinx's exit code."""
    import jax
    import links

    jax.config.update("jax_enable_x64", True)
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
