"""Scenario files that name a robot's own file.

    [robot]                         # or [plant], and [model] if the law knows another
    file = "arm.urdf"               # URDF or MJCF, beside the scenario file if the path is relative
    base = "base_link"              # optional, as are
    tip = "tool0"
    locked = { gripper_joint = 0.02 }
    gravity = [0.0, 0.0, -9.81]
    repair = true                   # mend what can be mended, as `iblf_jax.robots.load` says

    [reference]                     # and whatever else is to differ from
    ...                             # `iblf_jax.presets.arm_scenario`: bounds, controller, observer, initial

A law that is written out is kept within the file's largest torques, unless it is `kind =
"saturated"` itself.  The scenario that is made holds the arm's numbers: saved again, it needs
neither the file nor the package that reads it.
"""

from __future__ import annotations

import os
from typing import Any

from iblf_jax.control.controllers import Controller, within_effort
from iblf_jax.core import checks
from iblf_jax.files.components import construct, decode, encode, encode_fields
from iblf_jax.files.values import Words, as_table, known_keys, numbers
from iblf_jax.presets.arms import arm_scenario
from iblf_jax.world.disturbances import Disturbance
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import Robot, load

KEYS = ("file", "base", "tip", "locked", "gravity", "repair")
ROBOTS = ("robot", "plant", "model")


def names_a_file(tables: dict[str, Any]) -> bool:
    """Whether one of the robots is to be read from a file of its own."""
    return any(isinstance(tables.get(name), dict) and "file" in tables[name] for name in ROBOTS)


def with_robots_read(tables: dict[str, Any], folder: str | os.PathLike) -> dict[str, Any]:
    """The tables of a scenario with its robots' files read, and what they leave out filled in.

    Args:
      tables: as in the file.
      folder: of the scenario file; paths of robots' files are relative to it.

    Raises:
      ValueError: a robot's file that cannot be read, or tables that do not fit; the message names
        the dotted key.
    """
    robots = {name: _robot(tables[name], name, folder) for name in ROBOTS if name in tables}
    plant = robots.get("robot", robots.get("plant"))
    if plant is None:
        raise checks.fail(
            "plant",
            Words("nothing"),
            "a table [plant] beside [model]",
            "Or call it [robot], for both.",
        )
    given = {name: table for name, table in tables.items() if name not in ROBOTS}
    if "reference" not in given:
        raise checks.fail(
            "reference", Words("nothing"), "a table [reference]", "Say what the arm should do."
        )
    parts: dict[str, Any] = {"reference": decode(given["reference"], Reference, "reference")}
    if "disturbance" in given:
        parts["disturbance"] = decode(given["disturbance"], Disturbance, "disturbance")
    usual = construct(
        arm_scenario, {"robot": plant, "model": robots.get("model"), **parts}, "robot"
    )
    if "controller" in given:
        law = within_effort(decode(given["controller"], Controller, "controller"), plant)
        if as_table(given["controller"], "controller").get("kind") != "saturated":
            given["controller"] = encode(law, Controller, "controller")
    own = {name: encode(robot, Robot, name) for name, robot in robots.items()}
    filled = {
        name: table
        for name, table in encode_fields(usual, "").items()
        if name not in ("plant", "model")
    }
    return {**own, **filled, **given}


def _robot(table: Any, name: str, folder: str | os.PathLike) -> Robot:
    """The robot of one table: from the file that it names, or written out."""
    table = as_table(table, name)
    if "file" not in table:
        return decode(table, Robot, name)
    known_keys(table, name, KEYS)
    for key in ("file", "base", "tip"):
        if key in table and not isinstance(table[key], str):
            raise checks.fail(f"{name}.{key}", table[key], "a string")
    if not isinstance(table.get("repair", False), bool):
        raise checks.fail(f"{name}.repair", table["repair"], "true or false")
    options: dict[str, Any] = {key: table[key] for key in ("base", "tip", "repair") if key in table}
    if "locked" in table:
        locked = as_table(table["locked"], f"{name}.locked")
        options["locked"] = {
            joint: numbers(at, f"{name}.locked.{joint}", "rad") for joint, at in locked.items()
        }
    if "gravity" in table:
        options["gravity"] = numbers(table["gravity"], f"{name}.gravity", "m/s^2")
    try:
        return load(os.path.join(folder, table["file"]), **options)
    except (ValueError, ImportError) as error:
        raise checks.inside(f"{name}.file", error) from error
