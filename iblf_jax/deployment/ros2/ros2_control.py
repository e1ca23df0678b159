"""Writes a law as a controller plugin of ros2_control: a package of type ament_cmake around the
exported C law.
"""

from __future__ import annotations

import string
from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from xml.sax.saxutils import escape

from iblf_jax import __version__
from iblf_jax.core import notices
from iblf_jax.deployment.c_names import comment
from iblf_jax.deployment.ros2.escaped_text import (
    markdown_code,
    yaml_name,
    yaml_names,
    yaml_numbers,
)
from iblf_jax.deployment.write_c import GeneratedLaw, Law, fill_template, title_of

RATE_TOLERANCE = 1e-9
"""Relative distance of a rate from a whole number of Hz."""
FOLDER = "ros2/templates/ros2_control"
"""Of the templates."""
TEMPLATES = {
    "package.xml": "package.xml",
    "CMakeLists.txt": "CMakeLists.txt",
    "law_controller.xml": "law_controller.xml",
    "README.md": "README.md",
    "config/controllers.yaml": "controllers.yaml",
    "include/{package}/law_controller.hpp": "law_controller.hpp",
    "src/law_controller.cpp": "law_controller.cpp",
}
"""Path in the package -> its template."""
PLAIN_CHARACTERS = frozenset(
    string.ascii_letters + string.digits + " !#$%&'()*+,-./:;<=>@[]^_`{|}~"
)
"""Characters that a C++ string contains as they are: no quote, backslash or question mark."""


def controller_package(name: str) -> str:
    """The name of the package of a law's controller."""
    return f"{name}_controller"


def ros2_control_files(
    law: Law, generated: GeneratedLaw, description: Mapping[str, Any]
) -> dict[str, str]:
    """The files of the package: path in its folder -> text.

    There are none, with a warning, for a period whose rate is not a whole number of Hz, as
    ros2_control has no such rates.

    Args:
      law: the law, of a robot, with its reference inside.
      generated: its C code, of double precision.
      description: "joints" (n names), "has_joint_names" (whether they are those of the robot's
        file), "reads_velocity", "torque_limits", "hold_stiffness", "hold_damping" (n numbers each),
        "on_fault" and "gains": for each gain "path", "unit", "low" and "high" (its range) and
        "offsets" (for each of its numbers the places in the struct of parameters).
    """
    period = float(law.scenario.sampling.period)  # type: ignore[union-attr]
    rate = round(1.0 / period)
    if rate < 1 or abs(rate * period - 1.0) > RATE_TOLERANCE:
        notices.warn(
            f"period = {period:g} s is not the period of a whole number of Hz, so no controller for"
            " ros2_control is written. Export with period=1e-3, 2e-3 or another such period."
        )
        return {}
    package = controller_package(law.name)
    values = _values(law, generated, description, rate) | {"package": package}
    texts = {
        path.format(package=package): fill_template(name, values, FOLDER)
        for path, name in TEMPLATES.items()
    }
    texts[f"include/{package}/{law.name}.h"] = generated.files[f"{law.name}.h"]
    texts[f"src/{law.name}.c"] = generated.files[f"{law.name}.c"]
    return texts


def _values(
    law: Law, generated: GeneratedLaw, description: Mapping[str, Any], rate: int
) -> dict[str, Any]:
    """The values for the placeholders of the templates."""
    period = float(law.scenario.sampling.period)  # type: ignore[union-attr]
    joints, gains = description["joints"], description["gains"]
    states = ["`position`"]
    if description["reads_velocity"]:
        states.append("`velocity`")
    rows = []
    for gain in gains:
        places = ", ".join(f"{{{', '.join(map(str, entry))}}}" for entry in gain["offsets"])
        low, high = _cpp_numbers(gain["low"]), _cpp_numbers(gain["high"])
        rows.append(f"\n    {{{cpp_string(gain['path'])}, {{{low}}}, {{{high}}}, {{{places}}}}}")
    gain_names = "the law was exported without gains that can be changed."
    if gains:
        names = ", ".join(markdown_code(gain["path"]) for gain in gains)
        gain_names = f"the gains {names} within the exported ranges."
    values = {
        "name": law.name,
        "upper": law.name.upper(),
        "guard": f"{controller_package(law.name).upper()}__LAW_CONTROLLER_HPP_",
        "version": __version__,
        "title": escape(title_of(law.scenario)),
        "n": law.scenario.n,
        "period": repr(period),
        "period_ns": round(period * 1e9),
        "rate": rate,
        "joints": yaml_names(joints),
        "joint_list": ", ".join(map(markdown_code, joints)),
        "state_interfaces": " and ".join(states),
        "on_fault": description["on_fault"],
        "reads_velocity": _cpp_bool(description["reads_velocity"]),
        "has_joint_names": _cpp_bool(description["has_joint_names"]),
        "cpp_names": ", ".join(map(cpp_string, joints)),
        "cpp_gains": ",".join(rows),
        "gains": _gain_lines(generated, gains),
        "gain_names": gain_names,
    }
    for name in ("torque_limits", "hold_stiffness", "hold_damping"):
        values[name] = yaml_numbers(description[name])
        values[f"cpp_{name}"] = _cpp_numbers(description[name])
    return values


def cpp_string(text: str) -> str:
    """A literal of C++ of any text in UTF-8: ASCII without trigraphs."""
    encoded = (
        chr(byte) if chr(byte) in PLAIN_CHARACTERS else f"\\{byte:03o}" for byte in text.encode()
    )
    return f'"{"".join(encoded)}"'


def _cpp_bool(value: bool) -> str:
    return "true" if value else "false"


def _cpp_numbers(numbers: Iterable[float]) -> str:
    return ", ".join(repr(float(x)) for x in numbers)


def _gain_lines(generated: GeneratedLaw, gains: Sequence[Mapping[str, Any]]) -> str:
    """The gains in the file of parameters."""
    numbers = [x for field in generated.parameters.fields for x in field.value.reshape(-1).tolist()]
    lines = []
    for gain in gains:
        values = yaml_numbers(numbers[places[0]] for places in gain["offsets"])
        limits = f"{yaml_numbers(gain['low'])} to {yaml_numbers(gain['high'])}"
        unit = comment(gain["unit"])
        lines.append(f"    {yaml_name(gain['path'])}: {values}  # [{unit}], from {limits}")
    return "\n".join(lines) or "    # The law was exported without gains that can be changed."
