"""Names and prose use standard terms: a list of words stays out of both.

The words have no fixed meaning in control engineering or numerical computing, so a reader would
have to learn them first. CONTRIBUTING.md has the terms that take their place.
"""

import ast
import io
import json
import re
import symtable
import tokenize

import pytest
from conftest import ROOT

PACKAGE = ROOT / "iblf_jax"
NAMES = {
    *("said", "told", "asked", "alone", "foretold", "believed", "around", "way", "way_in"),
    *("mended", "mend", "judged", "unseen", "stranger", "there", "kicked", "wanted", "whole"),
    *("sound", "plain", "still", "moving", "held", "lane", "lanes", "setting", "settings"),
    *("said_by", "asked_for", "prices", "bends"),
}
WORDS = (
    *("told", "tells", "foretold", "mend", "mends", "mended", "way in", "stranger", "strangers"),
    *("kicked", "believed", "unseen", "asked for", "taken out", "nobody's", "stands in one place"),
    *("is no number", "the wall", "the walls", "past its wall", "past the wall", "way of"),
    "said by",
)
PROSE = re.compile(rf"\b({'|'.join(WORDS)})\b", re.IGNORECASE)
FOLDERS = sorted({path.relative_to(PACKAGE).parts[0] for path in PACKAGE.rglob("*.py")})
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]


def names_in(source: str) -> set[str]:
    """All names that a source file defines: functions, classes, arguments and variables."""
    found, tables = set(), [symtable.symtable(source, "source", "exec")]
    while tables:
        table = tables.pop()
        tables += table.get_children()
        found |= {x.get_name() for x in table.get_symbols() if x.is_assigned() or x.is_parameter()}
    return found


def private_names(source: str) -> set[str]:
    return {name for name in names_in(source) if name.strip("_").lower() in NAMES}


def prose_in(source: str) -> str:
    constants = (x.value for x in ast.walk(ast.parse(source)) if type(x) is ast.Expr)
    texts = [str(x.value) for x in constants if isinstance(x, ast.Constant)]
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    texts += [token.string for token in tokens if token.type == tokenize.COMMENT]
    return "\n".join(texts)


def private_words(text: str) -> list[str]:
    lower = text.lower()
    if not any(word in lower for word in WORDS):  # much faster than the pattern
        return []
    return [match.group(0) for match in PROSE.finditer(text)]


@pytest.mark.parametrize("folder", FOLDERS)
def test_names_docstrings_and_comments_are_standard_terms(folder):
    place = PACKAGE / folder
    for path in [place] if place.is_file() else place.rglob("*.py"):
        source = path.read_text()
        assert not private_names(source), path
        if private_words(source):  # in code, too, where it is none
            assert not private_words(prose_in(source)), path


def test_pages_and_notebooks_use_standard_terms():
    texts = {path: path.read_text(encoding="utf-8") for path in PAGES}
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        texts[path] = "\n".join("".join(cell["source"]) for cell in cells)
    found = {path: private_words(text) for path, text in texts.items()}
    assert not {path: words for path, words in found.items() if words}


def test_these_tests_can_fail():
    source = '"""What is told."""\n\ndef judged(lanes):\n    held = 1  # past the wall\n'
    assert private_names(source) == {"judged", "lanes", "held"}
    assert private_words(prose_in(source)) == ["told", "past the wall"]
    assert private_names("def requested(runs):\n    sampled = 1\n") == set()
