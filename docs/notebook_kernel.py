"""What the kernel runs before the first cell of a notebook that the site shows: figures get a text
for readers who do not see them, and warnings are shown without the path of a temporary file.
"""


def _prepare() -> None:
    import sys
    import warnings
    from pathlib import Path

    from matplotlib.figure import Figure

    sys.path.append(str(Path(__file__).parent))
    from alt_text import describe

    # A formatter of IPython would be removed by `%matplotlib inline`.
    Figure.__repr__ = describe

    def without_path(message, category, filename, lineno, line=None) -> str:
        return f"{category.__name__}: {message}\n"

    warnings.formatwarning = without_path


_prepare()
del _prepare
