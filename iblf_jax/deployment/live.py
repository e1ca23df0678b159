"""`explore`: a page with sliders that computes a scenario's closed loop in the browser; a notebook
shows the same page in a frame.
"""

from __future__ import annotations

import base64
import html
import json
import re
import tempfile
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from iblf_jax.core import checks, notices, tables
from iblf_jax.core.status import FAILED, WORDS
from iblf_jax.deployment.cosimulate import check_single
from iblf_jax.deployment.export import export
from iblf_jax.kernels import ToolchainError, has_ziglang
from iblf_jax.reports import card
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.paths import sign_at
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world import plants

GAIN_RANGE = 5.0
"""The slider of a gain ranges from the gain divided by this to the gain times this."""
START_RANGE = 0.3
"""The slider of an initial position or of a bound reaches this far to both sides [rad]."""
WORDS_OF_GAINS = {
    "controller.k1": "Position decay k1",
    "controller.K2": "Velocity damping K2",
    "controller.o": "Margin for moving bounds o",
    "controller.weight": "Weight of the barrier",
    "controller.Kp": "Position gain Kp",
    "controller.Kd": "Velocity gain Kd",
    "controller.limit": "Torque limit",
    "observer.kf": "Observer gain kf",
    "observer.bandwidth": "Observer bandwidth",
}
"""Path of a gain -> the words of its slider; others have their path within law or observer."""
START = "initial.q"
BOUND = re.compile(r"bounds\[(\d+)\]\.(lower|upper)\.(?:offset|value)")
DRAWN_INSTANTS = 500
"""Approximate number of instants of a run that are drawn."""
HEIGHT = 640
"""Height of the frame in a notebook [pixels]."""


class Page:
    """A live page; a notebook shows it, `save` writes it."""

    def __init__(self, text: str, fallback: str = "") -> None:
        self.text, self.fallback = text, fallback

    def save(self, path: str | Path) -> Path:
        """Writes the page, one HTML file that needs nothing else; a double click opens it.  Without
        `ziglang`, of the extra `export`, the file says so and shows the scenario's table.
        """
        path = checks.file_to_write("path", path)
        path.write_text(self.fallback or self.text, encoding="utf-8")
        return path

    def _repr_html_(self) -> str:
        if self.fallback:
            return self.fallback
        return (
            f'<iframe srcdoc="{html.escape(self.text, quote=True)}" style="width: 100%; height:'
            f' {HEIGHT}px; border: 0"></iframe>'
        )


@notices.each_warning_once
def explore(
    scenario: Scenario | Mapping[str, Scenario],
    *,
    duration: float = 10.0,
    dt: float = 1e-3,
    method: str = "rk4",
) -> Page:
    """A page on which gains, start and bounds are moved by sliders, and the run follows while they
    move.

    The closed loop runs in the browser, as WebAssembly (`export`), without Python.  Where `ziglang`
    is not installed a notebook shows the scenario's table and figure instead.

    Args:
      scenario: what runs; or several by name, to choose from.  Each keeps its own sliders.
      duration: of a run [s].
      dt, method: as in `simulate`.

    Returns:
      A `Page`: the value of a notebook's cell, or `page.save("live.html")`.

    Raises:
      ValueError: bad arguments, or a loop that cannot be written out.
      ToolchainError: `ziglang` is installed, and failed or took too long.

    Source: design of this package.
    """
    steps = checks.whole_steps(duration, dt)
    tableau(method)
    several = _by_name(scenario)
    try:
        loops = {name: _loop(each, dt, method) for name, each in several.items()}
    except ToolchainError as error:
        if has_ziglang():
            raise  # The page would hide that the compiler was too slow, or failed.
        first = next(iter(several.values()))
        return Page("", f"<p>{html.escape(str(error))}; without it nothing moves.</p>{card(first)}")
    values = {
        "title": "iblf_jax",
        "loops": tables.as_script_data(loops),
        "steps": steps,
        "every": max(1, steps // DRAWN_INSTANTS),
        "state": _file("loops.js"),
    }
    return Page(Template(_file("live.html")).substitute(values))


def _by_name(scenario: Any) -> dict[str, Scenario]:
    """The scenarios of a page by name; one without a name has an empty one."""
    if not isinstance(scenario, Mapping):
        return {"": check_single(scenario)}
    expected = "a scenario, or a mapping from names to scenarios"
    if not scenario or not all(isinstance(name, str) for name in scenario):
        remedy = 'Such as {"integral": first, "log": second}.'
        raise checks.fail("scenario", scenario, expected, remedy)
    if "__proto__" in scenario:
        remedy = "JavaScript reserves this name: take another one."
        raise checks.fail("scenario", "__proto__", expected, remedy)
    return {name: check_single(each) for name, each in scenario.items()}


def _file(name: str) -> str:
    """The text of one of the page's files."""
    return (files("iblf_jax.deployment") / "page" / name).read_text(encoding="utf-8")


def _loop(scenario: Scenario, dt: float, method: str) -> dict[str, Any]:
    """A module and its table, with the sliders that its parameters get."""
    with tempfile.TemporaryDirectory() as folder:
        export(scenario, folder, target="wasm", dt=dt, method=method)
        module = base64.b64encode((Path(folder) / "iblf_loop.wasm").read_bytes()).decode()
        table = json.loads((Path(folder) / "iblf_loop.json").read_text())
    for row in table["parameters"]:
        row |= _slider(scenario, row)
    table["input"] = plants.input_name(scenario.plant)
    table["names"] = list(plants.component_names(scenario.plant))
    table["flags"] = [(int(flag), words) for flag, words in WORDS.items()]
    table["failed"] = int(FAILED)
    return {"wasm": module, "table": table}


def _slider(scenario: Scenario, row: dict[str, Any]) -> dict[str, Any]:
    """The ranges of a parameter's sliders: gains have one slider for all joints, initial positions
    and bounds have one per joint, and other parameters have none.
    """
    path, values = row["path"], np.ravel(row["value"])
    if len(row["shape"]) > 1 or any(x is None for x in values):
        return {}
    if path.startswith(("controller.", "observer.")) and sign_at(scenario, path) == "positive":
        first = float(values[0])
        ends = [[first / GAIN_RANGE, first * GAIN_RANGE]]
        words = {"words": _words_of_gain(path), "group": "Gains"}
        return {"slider": ends, "positive": True, "each": False} | words
    bound = BOUND.fullmatch(path)
    if path != START and not bound:
        return {}
    words = {"words": "Start", "group": "Start"}
    if bound:
        words = {
            "words": f"{bound[2].capitalize()} bound",
            "group": _level(scenario, int(bound[1])),
        }
    ends = [[float(x) - START_RANGE, float(x) + START_RANGE] for x in values]
    return {"slider": ends, "positive": False, "each": True} | words


def _words_of_gain(path: str) -> str:
    """The words of the slider of a gain."""
    part, _, rest = path.partition(".")
    owner = {"controller": "law", "observer": "observer"}[part]
    return WORDS_OF_GAINS.get(path, f"{rest} of the {owner}")


def _level(scenario: Scenario, level: int) -> str:
    """The words above the sliders of the bounds of a level, counted from 0."""
    names = plants.level_names(scenario.plant)
    return f"Bounds of the {names[level]}"
