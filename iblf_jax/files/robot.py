"""Reads robots of scenario files that name a robot description file.

    [robot]                         # or [plant], and [model] if the law uses another model
    file = "arm.urdf"               # URDF or MJCF; the path is relative to the scenario file
    base = "base_link"              # optional, as are
    tip = "tool0"
    locked = { gripper_joint = 0.02 }
    gravity = [0.0, 0.0, -9.81]
    repair = true                   # correct errors of the file; see `iblf_jax.robots.load`
    armature = [0.01, 0.005]        # kg m^2, the inertia of the rotors, in place of the file's

    [reference]                     # and other tables that differ from
    ...                             # `iblf_jax.presets.arm_scenario`: bounds, controller, ...

The weight of the default law's barrier follows from the bounds of the file.  A law in the file is
limited to the largest torques of the robot, unless it is of `kind = "saturated"`.  The scenario
contains the numbers of the arm: a saved copy needs neither the robot file nor the package that
reads it.
"""

from __future__ import annotations

import dataclasses
import os
from typing import Any

from iblf_jax.control.controllers import TrackingLaw, within_effort
from iblf_jax.core import checks
from iblf_jax.files.components import construct, decode, encode_fields
from iblf_jax.files.modules import ReadPart
from iblf_jax.files.values import as_table, known_keys, missing, numbers
from iblf_jax.presets.arms import arm_scenario
from iblf_jax.world.bounds import Bounds
from iblf_jax.world.disturbances import Disturbance
from iblf_jax.world.references import Reference
from iblf_jax.world.robots import Robot, load

KEYS = ("file", "base", "tip", "locked", "gravity", "repair", "armature")
ROBOTS = ("robot", "plant", "model")


def names_a_file(tables: dict[str, Any]) -> bool:
    """Whether one of the robots is described by a separate file."""
    return any(isinstance(tables.get(name), dict) and "file" in tables[name] for name in ROBOTS)


def with_robots_read(tables: dict[str, Any], folder: str | os.PathLike) -> dict[str, Any]:
    """The tables of a scenario with its robots read, and defaults for missing tables.

    Args:
      tables: the tables of the scenario file.
      folder: folder of the scenario file; paths of robot files are relative to it.

    Raises:
      ValueError: a robot file that cannot be read, or tables that do not fit; the message names the
        dotted key.
    """
    robots = {name: _robot(tables[name], name, folder) for name in ROBOTS if name in tables}
    plant = robots.get("robot", robots.get("plant"))
    if plant is None:
        remedy = "Rename [model] to [robot] if it describes both."
        raise missing("plant", "a table [plant] beside [model]", remedy)
    given = {name: table for name, table in tables.items() if name not in ROBOTS}
    if "reference" not in given:
        raise missing("reference", "a table [reference]", "It has no default.")
    parts: dict[str, Any] = {"reference": decode(given["reference"], Reference, "reference")}
    if "disturbance" in given:
        parts["disturbance"] = decode(given["disturbance"], Disturbance, "disturbance")
    parts |= {"robot": plant, "model": robots.get("model")}
    if "bounds" in given:  # The weight of the barrier depends on them.
        levels = decode(given["bounds"], tuple[Bounds | None, ...], "bounds")
        parts["bounds"] = next(iter(levels), None)
    default = construct(arm_scenario, parts, "robot")
    if "controller" in given:
        law = within_effort(decode(given["controller"], TrackingLaw, "controller"), plant)
        if as_table(given["controller"], "controller").get("kind") != "saturated":
            given["controller"] = ReadPart(law)
    filled = encode_fields(default, "")
    del filled["plant"], filled["model"]
    return {name: ReadPart(robot) for name, robot in robots.items()} | filled | given


def _robot(table: object, name: str, folder: str | os.PathLike) -> Robot:
    """The robot of one table: from the file that it names, or from its numbers."""
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
        arm = load(os.path.join(folder, table["file"]), **options)
    except (ValueError, ImportError) as error:
        raise checks.with_location(f"{name}.file", error) from error
    if "armature" not in table:
        return arm
    armature = numbers(table["armature"], f"{name}.armature", "kg m^2")
    try:
        return dataclasses.replace(arm, armature=armature)
    except ValueError as error:
        raise checks.with_location(name, error) from error
