"""Writes docs/members.md from the docstrings of the package's own members: `python
docs/members_page.py`.

A test compares the file with the output of this script.
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from types import SimpleNamespace

from iblf_jax import (
    actuators,
    barriers,
    bounds,
    controllers,
    decays,
    disturbances,
    observers,
    plants,
    process_noise,
    references,
    regions,
    robots,
    sensors,
)
from iblf_jax.control.controllers.systems import observer_of

TARGET = Path(__file__).with_name("members.md")

FAMILIES = (
    ("Laws", controllers, "`iblf_jax.controllers`", ()),
    (
        "Barriers",
        barriers,
        "`iblf_jax.barriers`; decay of V1 at e2 = 0, and the bound on xi that V1 implies",
        ("decay_rate", "xi_bound"),
    ),
    ("Decays", decays, "`iblf_jax.decays`; z = sqrt(2V) of a level", ()),
    ("Observers", observers, "`iblf_jax.observers`", ()),
    ("Robots", robots, "`iblf_jax.robots`", ()),
    ("Plants", plants, "`iblf_jax.plants`", ()),
    (
        "Restoring forces of a vessel",
        SimpleNamespace(MEMBERS=plants.RESTORING),
        "`iblf_jax.plants`",
        (),
    ),
    ("References", references, "`iblf_jax.references`", ()),
    ("Bounds", bounds, "`iblf_jax.bounds`", ()),
    ("Regions", regions, "`iblf_jax.regions`", ()),
    ("Disturbances", disturbances, "`iblf_jax.disturbances`", ()),
    ("Process noise", process_noise, "`iblf_jax.process_noise`", ()),
    ("Sensors", sensors, "`iblf_jax.sensors`", ()),
    (
        "Sensors of one level",
        SimpleNamespace(MEMBERS=sensors.LEVEL_SENSORS),
        "`iblf_jax.sensors`, parts of `Levels`",
        (),
    ),
    (
        "Velocities of an encoder",
        SimpleNamespace(MEMBERS=sensors.VELOCITIES),
        "`iblf_jax.sensors`",
        (),
    ),
    ("Actuators", actuators, "`iblf_jax.actuators`", ()),
)


def first_line(thing: object) -> str:
    """The first paragraph of a docstring on one line, without its trailing full stop."""
    paragraph = (inspect.getdoc(thing) or "").split("\n\n")[0].split("Source:")[0]
    return without_pointers(" ".join(paragraph.split()))


def source(cls: type) -> str:
    """What follows "Source:" in a docstring."""
    match = re.search(r"Source:(.*?)(\n\n|$)", inspect.getdoc(cls) or "", re.DOTALL)
    return without_pointers(" ".join(match[1].split())) if match else ""


def without_pointers(words: str) -> str:
    """Words without what points at the head of a module, and without a last full stop."""
    return re.sub(
        r" ?\([^()]*head of this module\)|; [^;]*head of this module", "", words
    ).removesuffix(".")


def cell(text: str) -> str:
    """Text that a Markdown table takes as it is; `code` stays code."""
    parts = text.split("`")
    parts[::2] = [re.sub(r"([\\*_<>])", r"\\\1", part) for part in parts[::2]]
    return "`".join(parts).replace("|", r"\|") or "-"


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """A Markdown table."""
    lines = [head, tuple("---" for _ in head), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines]


def systems() -> list[str]:
    """The systems that the paper names, and what each is made of; the members have the sources."""
    rows = []
    for name in (*controllers.LAWS, *controllers.KEEPERS):
        law = controllers.law_by_name(name)
        barrier = getattr(law, "barrier", None)
        usual = observers.AsPublished(kf=20.0)
        inner = f" around {type(law.law).__name__}" if hasattr(law, "law") else ""
        parts = (
            type(law).__name__ + inner,
            type(barrier).__name__ if barrier else "-",
            "none" if observer_of(name, usual) is not usual else "any",
        )
        rows.append((f"`{name}`", *parts))
    return table(("system", "law", "barrier", "observer"), rows)


def text() -> str:
    """The page."""
    lines = [
        "# Members",
        "",
        "<!-- `python docs/members_page.py` writes this file. -->",
        "",
        "The page lists all members of all families; the [reference](reference/index.md) documents"
        " their arguments.",
        "",
        "## Systems of the paper",
        "",
    ]
    lines += [
        "`iblf_jax.presets.zhang_yan_2024(law=...)` and `iblf_jax.compare` take these names.",
        "",
        *systems(),
    ]
    for title, module, words, claims in FAMILIES:
        lines += ["", f"## {title}", "", f"{words}.", ""]
        rows = []
        for name, cls in module.MEMBERS.items():
            made = [cell(first_line(getattr(cls, claim))) for claim in claims]
            names = f"`{name}` `{cls.__name__}`"
            rows.append((names, cell(first_line(cls)), *made, cell(source(cls))))
        of_claims = (claim.replace("_", " ") for claim in claims)
        lines += table(("name and class", "what it is", *of_claims, "source"), rows)
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    TARGET.write_text(text(), encoding="utf-8")
