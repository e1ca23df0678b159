"""Reads identification files: scenario, log and parameters to identify, as validated TOML.

An identification file is a scenario file (`files.scenario`) with up to three more tables:

    preset = "zhang_yan_2024"        # or the complete scenario: the start of the search
    [identify]                       # arguments of `identify`: held_out, window, torque, delay, ...
    log = "log.csv"                  # relative to this file; a recording; or a list
    parameters = ["robot.mass", "disturbance.viscous"]
    [limits]                         # path -> [low, high]
    "robot.mass" = [0.1, 5.0]
    [priors]                         # path -> [mean, standard deviation]; of a vector, two lists
    "robot.mass" = [[2.0, 0.8], 0.1]

Every error is a ValueError that names the dotted key.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from iblf_jax.core import checks
from iblf_jax.files.scenario import from_dict, numbers_by_path, read_toml
from iblf_jax.files.values import Words, as_table, known_keys
from iblf_jax.identification import Identification, identify
from iblf_jax.identification.log import LOG_FILE

TABLES = ("identify", "limits", "priors")
ARGUMENTS = ("window", "torque", "delay", "loss", "widths", "iterations")
"""Keys of [identify] besides `log`, `parameters` and `held_out`."""


def load_identification_file(
    path: str | os.PathLike, *, modules: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The arguments of `identify` in an identification file, including the scenario.

    Args:
      path: a file in the format that the docstring of this module describes.
      modules: modules that the file cannot describe, as `load_scenario` takes them.

    Raises:
      ValueError: the file is not TOML or does not describe an identification; the message names
        file, key and remedy.
      OSError: the file cannot be read.
    """
    data, source, folder = read_toml(path), os.fspath(path), Path(path).parent
    file = from_dict(data, source, other_tables=TABLES, folder=folder, modules=modules)
    try:
        table = as_table(data.get("identify", {}), "identify")
        known_keys(table, "identify", ("log", "parameters", "held_out", *ARGUMENTS))
        if not isinstance(table.get("parameters"), list):
            given = table.get("parameters", Words("nothing"))
            expected = 'a list of paths, such as ["robot.mass"]'
            raise checks.fail("identify.parameters", given, expected)
        options: dict[str, Any] = {key: table[key] for key in ARGUMENTS if key in table}
        if "held_out" in table:
            options["held_out"] = table["held_out"]
            if not isinstance(table["held_out"], int | float):
                options["held_out"] = _logs(table["held_out"], "identify.held_out", folder)
        for name in ("limits", "priors"):
            given = numbers_by_path(data, name)
            options[name] = {key: _pair(x, f"{name}.{key}") for key, x in given.items()}
        log = _logs(table.get("log", Words("nothing")), "identify.log", folder)
    except ValueError as error:
        raise checks.with_location(source, error) from error
    return {"scenario": file.scenario, "log": log, "paths": table["parameters"], **options}


def _pair(value: object, key: str) -> tuple[Any, ...]:
    if not isinstance(value, list) or len(value) != 2:
        raise checks.fail(key, value, "a list of two, each a number or a list of numbers")
    return tuple(value)


def _logs(given: object, key: str, folder: Path) -> list[Path]:
    """The files of one log or of several, relative to the file that names them."""
    names = given if isinstance(given, list) and given else [given]
    found = []
    for name in names:
        text = None if isinstance(name, Words) else name
        found.append(folder / checks.string(key, text, f"the path of {LOG_FILE}"))
    return found


def identify_file(
    path: str | os.PathLike, *, modules: Mapping[str, Any] | None = None, **options: Any
) -> Identification:
    """Runs `identify` on an identification file; options replace the file's.

    Args:
      path: an identification file.
      modules: modules that the file cannot describe, as `load_scenario` takes them.
      options: arguments of `identify`.

    Raises:
      ValueError, OSError: as `load_identification_file` and `identify`.
    """
    return identify(**{**load_identification_file(path, modules=modules), **options})
