"""Sphinx's settings; `docs/build.py` calls it on the pages that it puts together in
out/site/source.
"""

import tomllib
from pathlib import Path

import iblf_jax

ROOT = Path(__file__).resolve().parents[3]
"""The repository; this file is read in out/site/source."""
URLS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]
"""Addresses of the project outside the site."""

project = "iblf_jax"
author = "The iblf_jax authors"
project_copyright = author
version = release = iblf_jax.__version__
extensions = [
    "myst_nb",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx.ext.extlinks",
    "sphinx.ext.mathjax",
]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "html_image"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # what is shown was executed by the tests
nb_render_text_lexer = "none"
exclude_patterns = ["README.md"]
smartquotes = False  # q' is a velocity
add_module_names = False
toc_object_entries = False  # each object has a heading
python_maximum_signature_line_length = 80
python_use_unqualified_type_names = True
extlinks = {"repository": (f"{URLS['Repository']}/%s", "%s")}
mathjax_path = "mathjax/tex-chtml.js"
mathjax3_config = {"chtml": {"scale": 0.95}}
copybutton_prompt_text = "$ "
html_theme = "sphinx_book_theme"
html_title = "iblf_jax"
html_context = {"default_mode": "auto"}
html_favicon = "_static/favicon.svg"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = [("versions.js", {"defer": "defer"})]
templates_path = ["_templates"]
html_sidebars = {
    "**": [
        "navbar-logo.html",
        "versions.html",
        "icon-links.html",
        "search-button-field.html",
        "sbt-sidebar-nav.html",
    ]
}
html_theme_options = {
    "show_toc_level": 2,
    "home_page_in_toc": True,
    "use_download_button": False,
    "navbar_persistent": [],  # the sidebar has the search
    "secondary_sidebar_items": {
        "**": ["page-toc.html"],
        "members": [],  # the tables of these two are wide
        "how_to/choosing_a_law": [],
    },
    "icon_links": [
        {"name": "Repository", "url": URLS["Repository"], "icon": "fa-brands fa-github"},
        {"name": "Paper", "url": URLS["Paper"], "icon": "fa-solid fa-file-lines"},
    ],
}
html_copy_source = False
html_extra_path = ["extra"]
suppress_warnings = ["myst.header", "mystnb.unknown_mime_type"]
