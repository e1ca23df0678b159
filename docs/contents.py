"""The list of sections at the top of a long page."""

import re

ON_THIS_PAGE = "\n".join(
    ["```{contents} On this page", ":local:", ":depth: 1", ":backlinks: none", "```"]
)
"""Directive of the list."""
LONG = 6000
"""Characters of a page that is longer than about six screens of 1280 x 800 pixels."""


def with_contents(page: str) -> str:
    """A page with the list of its sections before the first one, if it is long and has at least
    two; `site.css` hides the list where a sidebar has it.
    """
    introduction, *sections = re.split(r"^(?=(?:\(\S+\)=\n)?## )", page, flags=re.MULTILINE)
    if len(page) < LONG or len(sections) < 2:
        return page
    return f"{introduction}{ON_THIS_PAGE}\n\n{''.join(sections)}"
