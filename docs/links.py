"""Links of the built site: none is dead, and every page is three clicks from the front page at
most.
"""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlparse

CLICKS = 3
SPHINX = ("search.html", "genindex.html")
"""Pages of Sphinx's own, which its search box leads to."""


class _Page(HTMLParser):
    """Where a page leads, and the anchors that it has."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors, self.links = {""}, list[str]()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.anchors |= {name for name in (found.get("id"), found.get("name")) if name}
        for address in (found.get("href"), found.get("src")):
            if address and not urlparse(address).scheme and not address.startswith("//"):
                self.links.append(address)


def faults(folder: Path) -> list[str]:
    """What is wrong with the links of the pages in a folder, a line each."""
    folder = folder.resolve()
    pages = {
        path: _Page(path.read_text(encoding="utf-8"))
        for path in folder.rglob("*.html")
        if "_static" not in path.parts
    }
    wrong, leads = list[str](), dict[Path, set[Path]]()
    for path, page in pages.items():
        leads[path] = set()
        for address in page.links:
            place, anchor = urldefrag(unquote(address))
            target = (path.parent / place.split("?")[0]).resolve() if place else path
            target = target / "index.html" if target.is_dir() else target
            if not target.exists():
                wrong.append(f"{path.relative_to(folder)}: there is no {address}")
            elif target in pages and anchor not in pages[target].anchors:
                wrong.append(f"{path.relative_to(folder)}: {address} has no such place")
            else:
                leads[path].add(target)
    near = here = {folder / "index.html"}
    for _ in range(CLICKS):
        here = {target for path in here for target in leads.get(path, ())} - near
        near = near | here
    return wrong + [
        f"{path.relative_to(folder)} is more than {CLICKS} clicks away"
        for path in pages
        if path not in near and path.name not in SPHINX
    ]
