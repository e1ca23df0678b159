"""What can be found in the pages of the built site without a browser: dead links, pages that are
more than three clicks from the front page, images without a text, and paths of temporary files.

`tools/check_site.py` opens the pages in a browser.
"""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlparse

CLICKS = 3
SPHINX = ("search.html", "genindex.html")
"""Pages of Sphinx's own, which its search box leads to."""
TEMPORARY = re.compile(r"/tmp/\S*|ipykernel_\S*")


class _Page(HTMLParser):
    """Where a page leads, the anchors that it has, and what is wrong in itself."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors, self.links, self.wrong = {""}, list[str](), list[str]()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.anchors |= {name for name in (found.get("id"), found.get("name")) if name}
        for address in (found.get("href"), found.get("src")):
            if address and not urlparse(address).scheme and not address.startswith("//"):
                self.links.append(address)
        text = found.get("alt") or ""
        # Without a text, the name of the file takes its place.
        if tag == "img" and (not text.strip() or "_images/" in text):
            self.wrong.append(f"the image {(found.get('src') or '')[:80]} has no text")

    def handle_data(self, data: str) -> None:
        self.wrong += [f"the path {path} is shown" for path in TEMPORARY.findall(data)]


def faults(folder: Path) -> list[str]:
    """What is wrong with the pages in a folder, a line each."""
    folder = folder.resolve()
    pages = {
        path: _Page(path.read_text(encoding="utf-8"))
        for path in folder.rglob("*.html")
        if "_static" not in path.parts
    }
    wrong, leads = list[str](), dict[Path, set[Path]]()
    for path, page in pages.items():
        leads[path] = set()
        wrong += [f"{path.relative_to(folder)}: {fault}" for fault in page.wrong]
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
