"""What the kernel runs before the first cell of a notebook that the site shows: figures get a text
for readers who do not see them, and warnings are shown without the path of a temporary file.
"""


def _prepare() -> None:
    import sys
    import warnings
    from pathlib import Path

    from IPython import get_ipython
    from matplotlib.figure import Figure

    sys.path.append(str(Path(__file__).parent))
    from alt_text import describe

    plain = get_ipython().display_formatter.formatters["text/plain"]
    plain.for_type(Figure, lambda figure, printer, _: printer.text(describe(figure)))

    def without_path(message, category, filename, lineno, line=None) -> str:
        return f"{category.__name__}: {message}\n"

    warnings.formatwarning = without_path


_prepare()
del _prepare
