"""The list of sections at the top of a page that a generator writes."""

ON_THIS_PAGE = "\n".join(
    ["```{contents} On this page", ":local:", ":depth: 1", ":backlinks: none", "```"]
)
"""Directive of the list, for pages that are longer than six screens."""
