"""Opens every page of the built site in Chromium, 1280 and 390 pixels wide, light and dark, and
prints what is wrong: `python tools/check_site.py`.

It finds errors of the browser's console, requests to other hosts, pages and elements wider than the
screen, lines of code that are cut, images that fail, equations that MathJax does not read, pages
that are too large, and what `docs/links.py` finds. It needs Chromium with its driver, and the extra
`browser`. Addresses outside the site are not opened.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "docs"))
import links
from selenium import webdriver

WIDTHS = (1280, 390)
SCHEMES = ("light", "dark")
LARGEST_TEXT, LARGEST_PAGE = 1e6, 2e6
"""Largest size of the HTML of a page, and of it with its images [bytes]."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run"
    " --disable-background-networking --disable-component-update --disable-sync"
)
LOADED = """
const done = arguments[arguments.length - 1];
for (const image of document.images) image.loading = "eager";
for (const details of document.querySelectorAll("details")) details.open = true;
const images = [...document.images].map(image => image.decode().catch(() => {}));
const equations = window.MathJax?.startup?.promise ?? Promise.resolve();
Promise.all([equations, ...images]).then(() => requestAnimationFrame(() => done(true)));
"""
"""Ends when the equations and the images of a page are there."""
CONTENT = """
const found = [];
for (const image of document.images) {
  const name = image.src.slice(0, 100);
  if (!image.naturalWidth) found.push(`the image ${name} fails`);
}
for (const error of document.querySelectorAll("mjx-merror, [data-mjx-error]"))
  found.push(`MathJax: ${error.title || error.dataset.mjxError || error.textContent}`);
const loaded = performance.getEntriesByType("resource");
for (const {name} of loaded) {
  const isInside = name.startsWith(location.origin) || name.startsWith("data:");
  if (!isInside) found.push(`requests ${name}`);
}
const images = loaded.filter(each => each.initiatorType === "img");
const bytes = images.reduce((sum, each) => sum + each.encodedBodySize, 0);
return [found, bytes];
"""
"""What is wrong with the content of a page, and the size of its images."""
LAYOUT = """
const found = [], width = innerWidth;
function named(element) {
  const words = element.textContent.trim().replace(/\\s+/g, " ").slice(0, 50);
  return `${element.tagName.toLowerCase()} "${words}"`;
}
if (document.scrollingElement.scrollWidth > width + 1)
  found.push("the page is wider than the screen");
function scrolls(element) {
  for (let each = element.parentElement; each && each !== document.body; each = each.parentElement)
    if (["auto", "scroll"].includes(getComputedStyle(each).overflowX)) return true;
  return false;
}
const checked = "main :is(pre, table, img, p, dt, iframe), mjx-container, canvas";
for (const element of document.querySelectorAll(checked)) {
  const {right, width: own} = element.getBoundingClientRect();
  const isOff = own && right > width + 1 && !scrolls(element);
  if (isOff) found.push(`off the screen: ${named(element)}`);
}
const isWide = width > 768;
for (const block of document.querySelectorAll("pre")) {
  const isCut = block.scrollWidth > block.clientWidth + 1;
  const mayScroll = ["auto", "scroll"].includes(getComputedStyle(block).overflowX);
  if (isCut && (isWide || !mayScroll)) found.push(`cut code: ${named(block)}`);
}
return found;
"""
"""What is wrong with the layout of a page at the width that the screen has."""


class _QuietHandler(SimpleHTTPRequestHandler):
    """Serves files, and prints no line for each request."""

    def log_message(self, *_: Any) -> None:
        return


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address at which the files of a folder are served on this machine."""
    handler = partial(_QuietHandler, directory=str(folder))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()


@contextmanager
def opened_browser() -> Iterator[webdriver.Chrome]:
    """A browser of this machine; selenium downloads none."""
    program = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        raise SystemExit("Chromium and chromedriver are needed; Debian has them as chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in FLAGS.split():
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        browser.set_script_timeout(60)
        yield browser
    finally:
        browser.quit()


def show_as(browser: webdriver.Chrome, width: int, scheme: str) -> None:
    """Sets the width of the screen and the preferred colour scheme."""
    screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    preferred = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", preferred)


def faults_of_page(browser: webdriver.Chrome, address: str, size: int) -> list[str]:
    """What is wrong with one page, of which the HTML has so many bytes."""
    show_as(browser, WIDTHS[0], SCHEMES[0])
    browser.get(address)
    browser.execute_async_script(LOADED)
    found, images = browser.execute_script(CONTENT)
    if size > LARGEST_TEXT:
        found.append(f"the HTML has {size / 1e6:.2f} MB")
    if size + images > LARGEST_PAGE:
        found.append(f"the page has {(size + images) / 1e6:.2f} MB with its images")
    for width in WIDTHS:
        for scheme in SCHEMES:
            show_as(browser, width, scheme)
            wrong = browser.execute_script(LAYOUT)
            found += [f"{width} pixels, {scheme}: {each}" for each in wrong]
    errors = [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    found += [f"console: {entry['message']}" for entry in errors]
    return found


def faults(folder: Path, pattern: str = "") -> list[str]:
    """What is wrong with the site in a folder, a line each; of pages whose names have a pattern."""
    pages = [
        path
        for path in sorted(folder.rglob("*.html"))
        if "_static" not in path.parts and pattern in str(path.relative_to(folder))
    ]
    if not pages:
        raise SystemExit(f"there are no such pages in {folder}; `python docs/build.py` builds them")
    wrong = [] if pattern else links.faults(folder)
    # The list of versions is beside the folder of a version.
    with served(folder.parent) as address, opened_browser() as browser:
        for path in pages:
            name = path.relative_to(folder)
            place = f"{address}/{path.relative_to(folder.parent)}"
            wrong += [
                f"{name}: {each}" for each in faults_of_page(browser, place, path.stat().st_size)
            ]
    print(f"{len(pages)} pages, {len(WIDTHS) * len(SCHEMES)} views of each")
    return wrong


def main() -> int:
    """Prints the faults; 1 if there are any."""
    parser = argparse.ArgumentParser(description="Checks the built site in a browser.")
    default = ROOT / "out" / "site" / "html" / "main"
    parser.add_argument("folder", nargs="?", type=Path, default=default, help="of one version")
    parser.add_argument("--only", default="", help="a part of the names of the pages to check")
    arguments = parser.parse_args()
    wrong = faults(arguments.folder.resolve(), arguments.only)
    print("\n".join(wrong))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
