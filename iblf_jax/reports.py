"""Presents results as HTML: a card in a notebook, or with `report` a file.

Both consist of the same content (`Shown`): a title, text, tables, and figures that are drawn when
they are needed.  A result of a class that is not in `KINDS` is presented by its text, and by its
figure if it has a method `plot`.
"""

from __future__ import annotations

import base64
import datetime
import html
import io
import platform
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.core import checks, notices, tables
from iblf_jax.core.attributes import has_members
from iblf_jax.core.presentation import Content, Result
from iblf_jax.core.progress import announced
from iblf_jax.core.pytree import wrapped_field
from iblf_jax.core.status import FAILED, describe, has_flag
from iblf_jax.core.tables import Table, number
from iblf_jax.core.units import as_text
from iblf_jax.kernels import without_garbage_collection
from iblf_jax.simulation.paths import get, parameters, unit_at
from iblf_jax.simulation.results import NUMBERED
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import PER_REGION
from iblf_jax.simulation.units import status_words
from iblf_jax.studies.statistics import worst_joint
from iblf_jax.world import plants

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from iblf_jax.certificates import Certificate
    from iblf_jax.proofs import Proof
    from iblf_jax.simulation.results import Rollout
    from iblf_jax.studies.comparison import Comparison
    from iblf_jax.studies.study import Study
    from iblf_jax.tuning import TuneResult

CARD_DPI, PAGE_DPI = 60, 110
"""Dots per inch of a figure, in a notebook and on a page."""

STYLE = """:root { color-scheme: light dark;
  --line: color-mix(in srgb, currentcolor 14%, transparent);
  --faint: color-mix(in srgb, currentcolor 5%, transparent); }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; }
h2 { font-size: 1.2rem; margin-top: 2rem; border-bottom: 1px solid var(--line); }
table { border-collapse: collapse; font-size: 0.85rem; }
td, th { padding: 0.15rem 0.6rem; border-bottom: 1px solid var(--line); text-align: left; }
img { max-width: 100%; }
@media (prefers-color-scheme: dark) { img { filter: invert(0.93) hue-rotate(180deg); } }
ul.words { padding-left: 1.2rem; overflow-wrap: anywhere; }
pre { background: var(--faint); padding: 0.8rem; overflow-x: auto; font-size: 0.8rem; }
.wide { overflow-x: auto; }
.wide img { max-width: max(100%, 36rem); }  /* on a phone it scrolls, as a table does */
footer { margin-top: 3rem; opacity: 0.65; font-size: 0.8rem; }"""
"""The design of all reports, which are light or dark as the browser asks for."""


class Shown(NamedTuple):
    """The content of a card or a report."""

    title: str
    words: Sequence[str]
    """Lines of text below the title."""
    tables: Mapping[str, str] = {}
    """Heading -> table in HTML; a card shows the first `on_card` of them."""
    figures: Mapping[str, Callable[[], Figure]] = {}
    """Heading -> the function that draws the figure; a card shows the first."""
    scenario: Scenario | None = None
    on_card: int = 1


def _contents(result: object) -> Content:
    """What a result prints; that of another object of this package is its text."""
    return result._content() if isinstance(result, Result) else repr(result).splitlines()


def _described(result: object) -> list[str]:
    """The lines of a result without the name of its class, which is in the title."""
    texts = [text for text in _contents(result) if isinstance(text, str)]
    lines = "\n".join(texts).split("\n")
    match = re.fullmatch(rf"{type(result).__name__}(?:\((.*)\)| of (.*)|: (.*))", lines[0])
    if match:
        lines[0] = next(filter(None, match.groups()))
    return lines


def _parts_of(scenario: Scenario) -> str:
    """The components of a scenario, as a table."""
    rows = []
    for name, part in vars(scenario).items():
        if part is None or part == () or (name == "model" and part is scenario.plant):
            continue
        if isinstance(part, tuple):
            kinds = [type(each).__name__ for each in part if each is not None]
            rows.append((name, ", ".join(kinds), ""))
            continue
        leaves = parameters(part, named=False)[:MAX_LEAVES]
        rows.append((name, _kind(part), _assignments(leaves, " = ")))
    return tables.as_html(("part", "kind", "parameters"), rows)


def _kind(part: object) -> str:
    """The class of a component, with the class of the law or the barrier inside it."""
    inner = getattr(part, wrapped_field(part) or "barrier", None)
    if inner is None:
        return type(part).__name__
    return f"{type(part).__name__} ({type(inner).__name__})"


def _assignments(leaves: Any, sign: str) -> str:
    return ", ".join(f"{leaf.path}{sign}{_short(leaf.value)}" for leaf in leaves)


MAX_LEAVES = 4
"""Largest number of parameters of a component in the table of a scenario."""


def _short(value: ArrayLike) -> str:
    if not checks.is_concrete(value):
        return "traced"
    options: dict[str, Any] = {"precision": 4, "threshold": 7, "edgeitems": 2, "separator": ", "}
    return np.array2string(np.asarray(value), **options).replace("\n", "")


def _scenario(scenario: Scenario) -> Shown:
    from iblf_jax import plotting

    figures: dict[str, Callable[[], Figure]] = {}
    if checks.is_concrete(scenario) and scenario.initial.q.ndim == 1:
        figures["Reference and bounds"] = lambda: plotting.tube(scenario)
    rows = [(p.path, p.unit, _short(p.value)) for p in parameters(scenario, named=False)]
    leaves = tables.as_html(("path", "unit", "value"), rows)
    plant = scenario.loop.plant
    names = ", ".join(plants.component_names(plant))
    words = [f"{plants.counted_components(plant, scenario.n)}: {names}"]
    if plant.notation.levels:
        level_names = [*plant.notation.levels, plants.input_name(plant)]
        units = [as_text(unit) for unit in plants.units_of(plant)]
        texts = [f"{name} [{unit}]" for name, unit in zip(level_names, units, strict=True)]
        words.append(f"{plant.order} levels: {', '.join(texts[:-1])}; input: {texts[-1]}")
    content = {"Parts": _parts_of(scenario), "Parameters": leaves}
    return Shown("Scenario", words, content, figures, scenario)


def metrics_table(runs: Mapping[str, Rollout]) -> Table:
    """Metrics of runs side by side, one column per joint, with units."""
    first = next(iter(runs.values()))
    n = first.n
    heading = ["metric", "unit", *plants.component_names(first.scenario.plant) * len(runs)]
    rows: list[list[str]] = []
    for name, unit in first.metrics.units.items():
        if name not in first.metrics:
            continue
        values = [np.ravel(run.metrics[name]) for run in runs.values()]
        size = values[0].size
        if name.endswith(NUMBERED):
            values = [np.where(x < 0, np.nan, x) for x in values]  # -1: no violation
        # A row has the joints of one level, or one region: there can be more regions than joints.
        width = 1 if name in PER_REGION or size % n else n
        labels, units = [name], [unit]
        if size > width or name in PER_REGION:
            labels = [f"{name}[{i}]" for i in range(size // width)]
            units = [*unit.split("; "), *[unit] * len(labels)]
        for i, label in enumerate(labels):
            row = [label, units[i]]
            for x in values:
                row += _padded(map(number, x[i * width : (i + 1) * width]), n)
            rows.append(row)
    if any(runs):  # the name of each run above its first joint
        rows.insert(0, heading)
        heading = ["", ""]
        for name in runs:
            heading += _padded([name], n)
    return Table(heading, rows, left=(0, 1))


def _padded(cells: Iterable[str], size: int) -> list[str]:
    """The cells of one run, filled up with empty ones."""
    cells = list(cells)
    return cells + [""] * (size - len(cells))


def _rollout(run: Rollout) -> Shown:
    from iblf_jax import plotting

    if not checks.is_concrete(run) or run.is_batch:
        return Shown("Run", _described(run))
    plant = run.scenario.plant
    figures: dict[str, Callable[[], Figure]] = {
        f"{plants.level_names(plant)[0].capitalize()}s": lambda: plotting.positions(run),
        "Overview": lambda: plotting.overview(run),
        "Relative errors": lambda: plotting.errors(run),
        f"{plants.input_name(plant).capitalize()}s": lambda: plotting.torques(run),
        "Uncertain terms": lambda: plotting.uncertain_terms(run),
    }
    contents = {"Metrics": metrics_table({"": run}).html(), "Peaks with their signs": _peaks(run)}
    words = [*_described(run), *_worst_of_run(run)]
    return Shown(f"Run: {_verdict_of_run(run)}", words, contents, figures, run.scenario)


def _verdict_of_run(run: Rollout) -> str:
    """Whether a run kept its bounds, and what else its status says."""
    status = int(run.status)
    words = describe(status, status_words(run.scenario))
    if has_flag(status, FAILED):
        return f"FAILED: {words}"
    verdict = "the bounds are kept"
    return verdict if run.ok else f"{verdict}; {words}"


def _worst_of_run(run: Rollout) -> list[str]:
    """The smallest margin, the largest error and the largest input of a run, with their joints."""
    names = plants.component_names(run.scenario.plant)
    lines = []
    for name, text, choose in (
        ("margin", "smallest margin", np.argmin),
        ("peak_error", "largest error", np.argmax),
        ("peak_torque", f"largest {plants.input_name(run.scenario.plant)}", np.argmax),
    ):
        if name not in run.metrics:
            continue
        values = np.ravel(run.metrics[name])
        i = int(choose(values))
        unit = run.metrics.units[name].split("; ")[0]
        lines.append(f"{text}: {number(values[i])} {unit}, {names[i % len(names)]}")
    return lines


def _peaks(run: Rollout) -> str:
    """The recorded peaks of a run, as a table."""
    from iblf_jax.plotting._curves import curves_of
    from iblf_jax.plotting._panels import peak_rows

    (curve,) = curves_of(run)
    return tables.as_html(("peak of", "unit", "joint", "value", "at [s]"), peak_rows(curve))


def _perturbation(drawn: Any) -> str:
    """A perturbation in words: "factor uniform, low 0.8, high 1.2"."""
    parts = [f"{drawn.kind} {type(drawn.distribution).__name__.lower()}"]
    parts.append(_assignments(parameters(drawn.distribution, named=False), " "))
    if drawn.shared:
        parts.append("shared")
    return ", ".join(filter(None, parts))


def quantiles_table(study: Study) -> Table:
    """Quantiles of each metric over the runs, a run counted by its worst joint."""
    rows = []
    for name in study.metrics if study.made.any() else ():
        numbers = worst_joint(study.metrics, name)[study.made]
        levels = np.quantile(numbers, (0.05, 0.5, 0.95), method="inverted_cdf")
        if name.endswith(NUMBERED):
            levels = np.where(levels < 0, np.nan, levels)  # -1: no violation
        rows.append((name, study.metrics.units.get(name, ""), *map(number, levels)))
    return Table(("metric, worst joint", "unit", "5 %", "50 %", "95 %"), rows, left=(0,))


def _study(study: Study) -> Shown:
    from iblf_jax import plotting
    from iblf_jax.plotting._studies import start_notes

    if not checks.is_concrete(study):
        return Shown("Monte-Carlo study", _described(study))
    perturbed = [(path, _perturbation(x)) for path, x in study.perturbations.items()]
    content = {
        "Metrics": quantiles_table(study).html(),
        "Perturbed": tables.as_html(("path", "perturbation"), perturbed),
    }
    first = "margin" if "margin" in study.metrics else next(iter(study.metrics))
    figures: dict[str, Callable[[], Figure]] = {
        f"Distribution of {first}": lambda: plotting.histograms(study, [first])
    }
    if first == "margin":
        figures["Overview"] = lambda: plotting.study_overview(study)
    figures["Every metric"] = lambda: plotting.histograms(study)
    words = [*_described(study), *start_notes(study, list(study.metrics))]
    left = study.violation_probability
    title = f"Monte-Carlo study: {left.runs - left.count} of {left.runs} runs keep the bounds"
    return Shown(title, words, content, figures, study.scenario)


def _certificate(found: Certificate) -> Shown:
    table, figure = {"Line by line": found.table_html()}, {"Along the run": found.plot}
    return Shown(f"Certificate: {found.headline}", [found.subject], table, figure)


def _tuning(found: TuneResult) -> Shown:
    words = [*str(found.report).splitlines(), f"Search: {_described(found)[0]}"]
    figures = {"Before and after, and the search": found.plot}
    title = f"Tuning: {found.report.title}"
    return Shown(title, words, {"Gains": _gains(found)}, figures, found.scenario)


def _gains(found: TuneResult) -> str:
    """The tuned numbers before and after, those at an end of their range first; a row a joint where
    a parameter has one number for each.
    """
    ends = found.at_limits
    joints = plants.component_names(found.scenario.plant)
    rows = []
    for path, value in found.values.items():
        before, after = np.asarray(get(found.start, path)), np.asarray(value)
        for index in np.ndindex(after.shape):
            name = path + "".join(f"[{i}]" for i in index)
            end = ends.get(name) or ends.get(path)
            joint = joints[index[0]] if after.shape == (len(joints),) else ""
            note = f"at its {end.side} limit" if end else ""
            cells = (joint, path, unit_at(found.start, path), number(before[index]))
            rows.append((*cells, number(after[index]), note))
    rows.sort(key=lambda row: not row[-1])
    heading = ("joint", "parameter", "unit", "before", "after", "range")
    return tables.as_html(heading, rows, [i for i, row in enumerate(rows) if row[-1]])


def _proof(found: Proof) -> Shown:
    rows = [
        (path, unit_at(found.scenario, path), f"{low:.6g}", f"{high:.6g}")
        for path, (low, high) in found.ranges.items()
    ]
    contents = {}
    if rows:
        contents["Uncertain parameters"] = tables.as_html(("path", "unit", "from", "to"), rows)
    points = [(f"{w:.4g}", f"{rate:+.4g}") for w, rate in found.rates.items()]
    contents["Largest V_w' found, by weight"] = tables.as_html(("w", "V_w'"), points)
    words = [found.sentence(), *found.details()]
    return Shown(f"Proof: {found.verdict}", words, contents, {"Tube": found.plot}, found.scenario)


FIGURES = {"Comparison": "Side by side", "Identification": "Numbers and residuals"}
"""Name of a result's class -> heading of its figure."""


def _other(result: Any) -> Shown:
    """The content of a result of any class: its text, its tables and its figure."""
    name = type(result).__name__
    found = {part.title: part.html() for part in _contents(result) if isinstance(part, Table)}
    figures = {}
    if has_members(result, "plot"):
        figures[FIGURES.get(name, "Figure")] = result.plot
    scenario = getattr(result, "scenario", None)
    if not isinstance(scenario, Scenario):  # that of a front is a method: one for each point
        scenario = None
    title = re.sub("(?<=[a-z])[A-Z]", lambda letter: f" {letter[0].lower()}", name)
    return Shown(title, _described(result), found, figures, scenario, on_card=len(found))


def _comparison(found: Comparison) -> Shown:
    laws = len(found.rollouts)
    title = f"Comparison: {laws - len(found.failed)} of {laws} laws without a failure"
    rows = [
        row
        for row in found.table.get("effort", ())
        if not has_flag(int(found.equal_effort[row.law].status), FAILED)
    ]
    if len(rows) > 1:
        best = min(rows, key=lambda row: row.rmse)
        title += f"; at equal effort {best.law} has the smallest rmse of {len(rows)}"
    return _other(found)._replace(title=title)


KINDS: dict[str, Callable[[Any], Shown]] = {
    "Scenario": _scenario,
    "Rollout": _rollout,
    "Study": _study,
    "Comparison": _comparison,
    "Certificate": _certificate,
    "TuneResult": _tuning,
    "Proof": _proof,
}
"""Name of a result's class -> the function that makes the content.  Names in place of classes avoid
the import of modules that are not used."""


def shown(result: Any) -> Shown:
    """The content of a result."""
    return KINDS.get(type(result).__name__, _other)(result)


@without_garbage_collection()  # the search takes a tenth of the time of a layout
def _image(figure: Figure, dpi: int, words: str) -> str:
    """A figure as an HTML image."""
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=dpi)
    data = base64.b64encode(picture.getvalue()).decode()
    return f'<img alt="{html.escape(words, quote=True)}" src="data:image/png;base64,{data}">'


def _lines(words: Sequence[str]) -> str:
    """Lines of text as a list, whose long lines are broken; those that are indented belong to the
    line before them.
    """
    if len(words) == 1:
        return f"<p>{html.escape(words[0])}</p>"
    items = "".join(f"<li>{html.escape(line.strip())}</li>" for line in words if line.strip())
    return f'<ul class="words">{items}</ul>' if items else ""


def card(result: object) -> str:
    """The card of a result in a notebook: title, text, first table and first figure, as HTML."""
    parts = shown(result)
    text = [f"<b>{html.escape(parts.title)}</b>", _lines(parts.words)]
    text += list(parts.tables.values())[: parts.on_card]
    for name, draw in list(parts.figures.items())[:1]:
        text.append(_image(draw(), CARD_DPI, name))
    return f"<div>{''.join(text)}</div>"


@notices.each_warning_once
@announced("writing a report; the bands of a study simulate its runs again")
def report(result: object, path: str | Path, *, title: str | None = None) -> Path:
    """Writes a result as one self-contained HTML file with text, tables, figures, the scenario and
    the versions.

    Args:
      result: a Scenario, Rollout, Study, Certificate, Comparison, TuneResult, Identification,
        Proof, or any other result of this package.
      path: the file, which must end in ".html"; its folder must exist.
      title: the heading; the kind of the result if not given.

    Returns:
      The path of the file.

    Raises:
      ValueError: a title that is not a text, a path with another ending, or an object that is not a
        result of this package.
      OSError: the file cannot be written.

    Source: design of this package.
    """
    if title is not None:
        checks.string("title", title, "a text")
    path = checks.file_to_write("path", path)
    if path.suffix not in (".html", ".htm"):
        raise checks.fail("path", str(path), 'a file that ends in ".html"')
    if not type(result).__module__.startswith("iblf_jax"):
        remedy = "ij.simulate and ij.tune, for example, return one."
        raise checks.fail("result", result, "a result of this package", remedy)
    path.write_text(_page(shown(result), title), encoding="utf-8")
    return path


def _page(parts: Shown, title: str | None) -> str:
    import iblf_jax
    from iblf_jax.files.scenario import scenario_to_toml

    heading = html.escape(title or parts.title)
    body = [f"<h1>{heading}</h1>"]
    if title:
        body.append(f"<p>{html.escape(parts.title)}</p>")
    body.append(_lines(parts.words))
    figures = [
        f'<h2>{html.escape(name)}</h2><div class="wide">{_image(draw(), PAGE_DPI, name)}</div>'
        for name, draw in parts.figures.items()
    ]
    # The main figure stands before the tables, which may have many lines.
    body += figures[:1]
    for name, table in parts.tables.items():
        body.append(f'<h2>{html.escape(name)}</h2><div class="wide">{table}</div>')
    body += figures[1:]
    if parts.scenario is not None:
        try:
            text = scenario_to_toml(parts.scenario)
        except ValueError:  # A file cannot hold a batch, or a class without a registered name.
            text = repr(parameters(parts.scenario, named=False))
        body.append(
            "<h2>As a file</h2><details><summary>the"
            f" scenario</summary><pre>{html.escape(text)}</pre></details>"
        )
    made = datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    versions = (
        f"iblf_jax {iblf_jax.__version__}, jax {jax.__version__}, numpy {np.__version__}, Python"
        f" {platform.python_version()}"
    )
    body.append(f"<footer>{made}; {versions}</footer>")
    head = (
        '<meta charset="utf-8"><meta name="viewport"'
        f' content="width=device-width"><title>{heading}</title><style>{STYLE}</style>'
    )
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>{"".join(body)}</body></html>\n'
    )
