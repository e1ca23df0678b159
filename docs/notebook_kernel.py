"""What the kernel runs before the first cell of a notebook that the site shows: figures get a text
for readers who do not see them, warnings are shown without the path of a temporary file, and lines
of progress are not stored.
"""


def _prepare() -> None:
    import os
    import sys
    import warnings
    from pathlib import Path

    from matplotlib.figure import Figure

    os.environ["IBLF_JAX_PROGRESS"] = "0"
    sys.path.append(str(Path(__file__).parent))
    from alt_text import describe

    # A formatter of IPython would be removed by `%matplotlib inline`.
    Figure.__repr__ = describe

    def without_path(message, category, filename, lineno, line=None) -> str:
        return f"{category.__name__}: {message}\n"

    warnings.formatwarning = without_path


_prepare()
del _prepare
