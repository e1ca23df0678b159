"""Sphinx's settings; `docs/build.py` calls it on the pages that it puts together in
out/site/source.
"""

import iblf_jax

project = "iblf_jax"
author = "The iblf_jax authors"
version = release = iblf_jax.__version__
extensions = ["myst_nb", "sphinx_design", "sphinx.ext.mathjax"]
myst_enable_extensions = ["colon_fence", "dollarmath", "html_image"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # what is shown was executed by the tests
nb_render_text_lexer = "none"
exclude_patterns = ["README.md", "contributing.md"]  # the second is part of architecture.md
smartquotes = False  # q' is a velocity
html_theme = "sphinx_book_theme"
html_title = "iblf_jax"
html_theme_options = {"show_toc_level": 2, "home_page_in_toc": True, "use_download_button": False}
html_copy_source = False
html_extra_path = ["extra"]
suppress_warnings = ["myst.header", "mystnb.unknown_mime_type"]
