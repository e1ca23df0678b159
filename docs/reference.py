"""The reference: one page for each family, from the docstrings of the public names."""

from __future__ import annotations

import functools
import inspect
import re
from pathlib import Path
from typing import Any

import equations
import public_types

import iblf_jax as ij

SECTIONS = ("Args", "Returns", "Raises", "Source")
PAGES: dict[str, tuple[str, str]] = {
    "runs": (
        "Scenarios and runs",
        (
            "Scenario Initial Bounds Sampling EventTrigger with_parts simulate Runs Rollout Metrics"
            " Status SimulationError SimulationWarning parameters with_parameters recommended_dt"
            " recommended_period vector_field VectorField explain component leaf Leaf static astype"
        ),
    ),
    "presets": (
        "Presets, and robots from files",
        (
            "robots.load robots.from_energy presets.arm_scenario presets.zhang_yan_2024"
            " presets.zhang_yan_2024_full_state presets.zhang_yan_2024_funnel"
            " presets.zhang_yan_2024_saturated presets.printed_gap presets.customary_two_link"
            " presets.ur5 presets.iiwa14 presets.flexible_joint_two_link"
            " presets.flexible_joint_iiwa14 presets.motor_driven_two_link"
            " presets.motor_driven_pendulum presets.cybership_ii"
        ),
    ),
    "velocities": (
        "Velocities of an encoder",
        "sensors.Measured sensors.FilteredDifference sensors.Tracking",
    ),
    "studies": (
        "Studies",
        (
            "monte_carlo Study sweep load_sweep StoreError sensitivity Sensitivity compare"
            " Comparison failure_probability FailureProbability factor offset value"
            " uniform normal log_uniform choice joint_normal joint_samples interval"
        ),
    ),
    "certificates": ("Certificates", "certify Certificate Counterexample"),
    "proofs": (
        "Proofs",
        (
            "prove Proof largest_level largest_parameters largest_period gains_for_guarantee"
            " GuaranteedGains proofs.Verdict proofs.GrowthPoint proofs.GuaranteedTube"
            " proofs.DelayedStart"
        ),
    ),
    "tuning": (
        "Tuning",
        (
            "tune TuneResult tunable pareto ParetoFront falsify WorstCase cvar tune_file"
            " tuning.SQP tuning.LBFGS tuning.Adam tuning.Optax tuning.SLSQP"
            " tuning.TrustConstr tuning.DifferentialEvolution tuning.CMAES tuning.Optuna tuning.Uno"
            " tuning.Report tuning.Confirmation tuning.Solver"
        ),
    ),
    "objectives": (
        "Objectives and requirements",
        (
            "objectives.tracking objectives.effort objectives.torque_rate objectives.settle"
            " objectives.peak_torque objectives.margin objectives.velocity_margin"
            " objectives.region_margin objectives.metric objectives.error_below"
            " objectives.peak_torque_below objectives.margin_above"
            " objectives.velocity_margin_above objectives.region_margin_above"
            " objectives.violation_probability_below objectives.failure_probability_below"
            " objectives.Objective objectives.Requirement objectives.Term"
            " objectives.Quantity objectives.Outer"
        ),
    ),
    "identification": ("Identification", "identify Identification excitation"),
    "out": (
        "Export, files and reports",
        (
            "export Exported explore cosimulate report load_scenario save_scenario load"
            " save_rollouts deployment.bag_log deployment.read_bag"
        ),
    ),
    "testing": (
        "Checkers for user-written classes",
        (
            "testing.check_law testing.check_barrier testing.check_decay testing.check_observer"
            " testing.check_sensor testing.check_actuator testing.check_robot"
            " testing.check_plant testing.check_reference testing.check_side"
            " testing.check_region testing.check_disturbance testing.check_fold"
            " testing.check_objective testing.check_process_noise testing.ContractError"
        ),
    ),
}
"""Page -> its title and the names that it explains."""
FAMILIES = (
    "controllers",
    "barriers",
    "decays",
    "observers",
    "robots",
    "plants",
    "references",
    "bounds",
    "regions",
    "disturbances",
    "process_noise",
    "sensors",
    "actuators",
    "metrics",
)
OWN_TYPES = "Base classes and types for user-written classes"
"""Heading of the base classes and records of a family."""


def page_of(thing: Any, name: str, level: int = 2, module: str = "iblf_jax") -> str:
    """One public object in Markdown; `name` is its name in a module."""
    if public_types.is_contract(thing) or public_types.is_record(thing):
        return public_types.page(thing, name, level, body, defined)
    documented_in = public_types.ALIASES.get(name)
    if documented_in is not None:
        text = body(public_types.alias_text(documented_in, name))
        kind, signature = "data", ""
    else:
        text = _with_notes(body(inspect.getdoc(thing) or ""), thing)
        kind, signature = _kind(thing), _signature(thing) if callable(thing) else ""
    return "\n".join(
        [f"{'#' * level} {name}", "", defined(kind, module, name, signature), text, ""]
    )


def _with_notes(text: str, thing: Any) -> str:
    """The text about an object, followed by the head of its module if the text refers to it."""
    text, at_head = re.subn(r"at the head\s+of\s+this\s+module", "in the notes below", text)
    text, other = re.subn(r"head\s+of\s+this\s+module", "notes below", text)
    if not at_head + other:
        return text
    head = inspect.getdoc(inspect.getmodule(thing)) or ""
    return f"{text}\n\n**Notes**\n\n{body(head)}"


def _kind(thing: Any) -> str:
    """What Sphinx calls such an object."""
    if inspect.isclass(thing):
        return "class"
    return "function" if callable(thing) else "data"


def defined(kind: str, module: str, name: str, signature: str = "") -> str:
    """The definition of an object, which the general index lists under its name; its signature is
    shown if there is one.
    """
    options = [f":module: {module}"] if signature else [f":module: {module}", ":no-typesetting:"]
    return "\n".join([f"```{{py:{kind}}} {name}{signature}", *options, "```", ""])


def _signature(thing: Any) -> str:
    try:
        text = str(inspect.signature(thing))
    except (TypeError, ValueError):
        return "(...)"
    text = re.sub(r": '([^']*)'", r": \1", re.sub(r"iblf_jax(\.\w+)+\.(\w+)", r"\2", text)).replace(
        " -> None", ""
    )
    text = re.sub(r"Annotated\[(\w+), (\w+)\]", r"\1 | \2", text)
    return re.sub(r"-> '([^']*)'", r"-> \1", re.sub(r"<[^>]*>", "...", text)).replace("'", '"')


def body(doc: str) -> str:
    """A docstring in Markdown: sections as lists, what is set in as an equation, or as code where
    it is Python's.
    """
    out, section, set_in = list[str](), "", list[str]()
    first, _, rest = doc.partition("\n")
    if re.match(r"[\w']+ = ", first):
        out, doc = [equations.block([first])], rest
    for line in [*doc.splitlines(), ""]:
        head = re.fullmatch(rf"({'|'.join(SECTIONS)}):(.*)", line)
        if line.startswith("    ") and not section:
            set_in.append(line[4:])
            continue
        if set_in:
            python = any(text.startswith(("@", "class ", "def ")) for text in set_in)
            out += ["\n```python", *set_in, "```\n"] if python else ["", equations.block(set_in)]
            set_in = []
        if head:
            section = head[1]
            out.append(f"\n**{section}**{head[2] and ':' + head[2]}\n")
        elif section in ("Args", "Raises") and re.match(r"  \S", line):
            what, _, rest = line.strip().partition(": ")
            out.append(f"- **{what}**: {rest}" if rest else f"- {what}")
        else:
            out.append(line.strip() if section else line)
    return "\n".join(out)


def named(name: str) -> Any:
    """What a public name stands for; one of a module of the package's has a dot,
    "testing.check_law".
    """
    return functools.reduce(getattr, name.split("."), ij)


def write(folder: Path) -> None:
    """Writes all pages into a folder."""
    folder.mkdir()
    names = []
    for page, (title, listed) in PAGES.items():
        texts = [page_of(named(name), name) for name in listed.split()]
        (folder / f"{page}.md").write_text(f"# {title}\n\n" + "\n".join(texts))
        names.append(page)
    for family in FAMILIES:
        module = getattr(ij, family)
        members = {cls.__name__: cls for cls in module.MEMBERS.values()}
        texts = [page_of(cls, name, 2, f"iblf_jax.{family}") for name, cls in members.items()]
        texts += [f"## {OWN_TYPES}\n"]
        texts += [
            page_of(thing, f"{family}.{name}", 3)
            for name, thing in public_types.types_of(module).items()
        ]
        (folder / f"{family}.md").write_text(
            f"# {family.capitalize()}\n\n{body(inspect.getdoc(module) or '')}\n\n"
            + "\n".join(texts)
        )
        names.append(family)
    listed = "\n".join(names)
    (folder / "index.md").write_text(
        "# Reference\n\nThe reference documents the public functions and classes; `help()` shows"
        " the same texts. [All members in one"
        f" table](../members.md).\n\n```{{toctree}}\n:maxdepth: 2\n\n{listed}\n```\n"
    )
