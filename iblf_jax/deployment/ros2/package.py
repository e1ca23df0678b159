"""Writes a law as a ROS 2 package of type ament_python: the C law, a node around it in Python, a
launch file and a file of parameters.
"""

from __future__ import annotations

import json
import keyword
import math
import re
import shlex
import sys
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.sax.saxutils import escape

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax import __version__
from iblf_jax.core import checks, notices
from iblf_jax.deployment.build import write_files
from iblf_jax.deployment.c_names import Parameters, comment
from iblf_jax.deployment.control_law import bounds_at, inputs_at_start
from iblf_jax.deployment.ros2.escaped_text import (
    check_printable,
    markdown_code,
    yaml_name,
    yaml_names,
    yaml_number,
    yaml_numbers,
)
from iblf_jax.deployment.ros2.node.supervisor import ARRIVAL_TIMEOUT, STALE_PERIODS
from iblf_jax.deployment.ros2.ros2_control import controller_package, ros2_control_files
from iblf_jax.deployment.write_c import (
    CHECK_INTERVAL,
    GeneratedLaw,
    Law,
    fill_template,
    title_of,
)
from iblf_jax.simulation import paths
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.draws import check_paths
from iblf_jax.world import plants
from iblf_jax.world.robots._base import mass_matrix_at

if TYPE_CHECKING:
    from iblf_jax.tuning.parameters import Tunable

NODE = "iblf_jax.deployment.ros2.node"
"""The modules of a node; in a package, its own name replaces this one."""
NODE_MODULES = ("c_law.py", "monitor.py", "supervisor.py", "law_node.py")
"""The modules of `node/` that a package contains."""
TEMPLATES = "ros2/templates"
"""Folder of the templates."""
POLICIES = ("hold", "zero")
"""Torques of a fault: those that hold the position, or zero."""
HOLD_BANDWIDTH = 5.0
"""Bandwidth of the hold for a joint alone [rad/s]."""
HOLD_BANDWIDTH_TIMES_PERIOD = 0.02
"""Largest product of this bandwidth and the period: the inertia of a joint in an arm may be ten
times smaller than that of the joint alone."""
PACKAGE_NAME = r"[a-z](?:_?[a-z0-9])+"
"""Names of ROS packages: lower case, digits and single underscores (REP 144)."""
PERIOD = "sampling.period"


class GainOption(NamedTuple):
    """A gain of the node: a leaf, or entries of one, with its range."""

    path: str
    unit: str
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    tied: bool
    """Whether one number sets all entries."""


class RosOptions(NamedTuple):
    """The validated options of a package."""

    gains: tuple[GainOption, ...]
    torque_limits: np.ndarray
    """(n,) [N m]."""
    on_fault: str


def check_ros_name(name: str) -> None:
    """Raises ValueError for a name that no ROS package or no Python module can have."""
    is_module = name in sys.stdlib_module_names or keyword.iskeyword(name)
    if re.fullmatch(PACKAGE_NAME, name) and not is_module:
        return
    expected = "lower case, digits and single underscores, and no module of Python"
    raise checks.fail("name", name, expected, 'It names the ROS package: name="arm_law".')


def ros_options(
    scenario: Scenario, gains: Any, torque_limits: ArrayLike | None, on_fault: str
) -> RosOptions:
    """The options of a package.

    Args:
      scenario: canonical, sampled.
      gains: paths and `Tunable`s of the gains that can be changed while the node runs; None for
        none.
      torque_limits: largest torques, () or (n,) [N m]; None for those of the model.
      on_fault: "hold" or "zero".

    Raises:
      ValueError: an invalid option, or a model with levels that no joint state has.
    """
    checks.one_of("on_fault", on_fault, POLICIES)
    if scenario.loop.model.robot is not scenario.model:
        expected = "a robot, whose state is q and q'"
        remedy = "sensor_msgs/JointState has no further levels; export to C instead."
        raise checks.fail("scenario.model", type(scenario.model).__name__, expected, remedy)
    remedy = "Rename the joint in the robot's file, and in its driver."
    check_printable("joints", plants.declared_joints(scenario.model), remedy)
    limits = _torque_limits(scenario, torque_limits)
    return RosOptions(_gains(scenario, gains), limits, on_fault)


def _torque_limits(scenario: Scenario, given: ArrayLike | None) -> np.ndarray:
    """The largest torques, (n,) [N m]: the given ones, at most those of the model."""
    n = scenario.n
    effort = scenario.model.effort
    largest = np.full(n, math.inf)
    if effort is not None:
        largest = np.broadcast_to(np.asarray(effort, float), (n,))
    if given is None:
        if np.all(np.isfinite(largest)):
            return largest
        expected = "the largest torque of every joint [N m]"
        remedy = "The model has no finite `effort`: give torque_limits=[50.0, 20.0]."
        raise checks.fail("torque_limits", None, expected, remedy)
    limits = np.asarray(checks.as_floats("torque_limits", given), float)
    if limits.shape not in ((), (n,)):
        raise checks.fail("torque_limits", given, f"one number, or {n} numbers [N m]")
    limits = np.broadcast_to(limits, (n,))
    if np.all((limits > 0) & np.isfinite(limits) & (limits <= largest)):
        return limits
    expected = "finite numbers > 0"
    if np.any(np.isfinite(largest)):
        expected += f", at most the model's efforts {largest.tolist()} N m"
    raise checks.fail("torque_limits", given, expected, "Give the limits of the drives.")


def _gains(scenario: Scenario, given: Any) -> tuple[GainOption, ...]:
    """The gains with their ranges, those of `tune` where none are given."""
    if given is None:
        return ()
    # Importing `tuning` takes half a second, which other targets do not need.
    from iblf_jax.tuning.parameters import as_tunable, in_units, layout

    example = '[ij.tunable("controller.K2", 5.0, 50.0)]'
    entries = checks.nonempty_list("gains", given, example)
    tunables = [as_tunable(f"gains[{i}]", entry) for i, entry in enumerate(entries)]
    check_paths(scenario, [x.path for x in tunables], "gains")
    check_printable("gains", [x.path for x in tunables], "Rename the link in the robot's file.")
    if any(x.path == PERIOD for x in tunables):
        expected = "leaves of law, observer or model"
        remedy = "The period of a node is fixed: export once for each period."
        raise checks.fail("gains", PERIOD, expected, remedy)
    for item in tunables:
        value = np.asarray(paths.get(scenario, item.path), float)
        if item.tied and np.any(value != value.flat[0]):
            # One number would replace different ones.
            remedy = f'Such as ij.with_parameters(scenario, {{"{item.path}": {value.flat[0]:g}}}).'
            raise checks.fail(f"gains: {item.path}", value, "equal numbers for a tied gain", remedy)
    period = float(scenario.sampling.period)  # type: ignore[union-attr]
    blocks, box = layout(scenario, tunables, period, "rk4")
    low, high = in_units(blocks, box.low), in_units(blocks, box.high)
    found = []
    for item, block in zip(tunables, blocks, strict=True):
        part = slice(block.start, block.start + block.size)
        least, most = _range_end(item.low, low[part]), _range_end(item.high, high[part])
        gain = _gain(scenario, item, least, most)
        found.append(gain)
        if item.low is None or item.high is None:
            ends = [np.array2string(x, precision=4) for x in (gain.low, gain.high)]
            notices.warn(
                f"gains: {gain.path}: the range {' to '.join(ends)} has a default end, from a"
                " linear analysis near the reference that changes one gain at a time. The loop may"
                " be unstable within it, elsewhere or with other gains. Give limits that you have"
                f' simulated: ij.tunable("{gain.path}", low, high).'
            )
    return tuple(found)


def _range_end(given: ArrayLike | None, numbers: np.ndarray) -> np.ndarray:
    """An end of a range: the given one, as that of `tune` has passed through a logarithm."""
    if given is None or np.size(given) not in (1, numbers.size):
        return numbers
    return np.broadcast_to(np.asarray(given, float).reshape(-1), numbers.shape)


def _gain(scenario: Scenario, item: Tunable, low: np.ndarray, high: np.ndarray) -> GainOption:
    """A gain whose range is admissible."""
    value = np.asarray(paths.get(scenario, item.path), float)
    for name, end in (("low", low), ("high", high)):
        if not np.all(np.isfinite(end)):
            remedy = f'Give both: ij.tunable("{item.path}", low, high).'
            raise checks.fail(f"gains: {item.path}: {name}", end, "finite limits", remedy)
        complete = np.broadcast_to(end, value.shape) if item.tied else end.reshape(value.shape)
        reason = paths.why_inadmissible(scenario, {item.path: jnp.asarray(complete)})
        if reason:
            raise checks.fail(f"gains: {item.path}: {name}", end, "an admissible value", reason)
    return GainOption(item.path, paths.unit_at(scenario, item.path), value, low, high, item.tied)


def _description(law: Law, generated: GeneratedLaw, options: RosOptions) -> dict[str, Any]:
    """The content of `law.json`."""
    scenario = law.scenario
    period = float(scenario.sampling.period)  # type: ignore[union-attr]
    # The hold has critical damping of each joint alone at the start, to two digits.
    bandwidth = min(HOLD_BANDWIDTH, HOLD_BANDWIDTH_TIMES_PERIOD / period)
    inertia = np.diag(np.asarray(mass_matrix_at(scenario.model, scenario.initial.q)))
    return {
        "name": law.name,
        "version": __version__,
        "joints": list(law.joints or (f"joint_{i + 1}" for i in range(law.scenario.n))),
        "has_joint_names": bool(law.joints),
        "period": period,
        "reads_velocity": "dq" not in law.unread_levels,
        "torque_limits": options.torque_limits.tolist(),
        "on_fault": options.on_fault,
        "hold_stiffness": [float(f"{x:.2g}") for x in bandwidth**2 * inertia],
        "hold_damping": [float(f"{x:.2g}") for x in 2 * bandwidth * inertia],
        "gains": [_gain_row(scenario, generated.parameters, gain) for gain in options.gains],
    }


def _gain_row(scenario: Scenario, parameters: Parameters, gain: GainOption) -> dict[str, Any]:
    """A gain in `law.json`."""
    starts, offset = {}, 0
    for field in parameters.fields:
        starts[field.path] = (offset, field.shape)
        offset += math.prod(field.shape)
    rows = zip(paths.leaves(scenario, gain.path), paths.places(scenario, gain.path), strict=True)
    found = [(leaf, tokens) for leaf, tokens in rows if leaf in starts]
    if not found:
        remedy = checks.did_you_mean(gain.path, [field.path for field in parameters.fields])
        raise checks.fail("gains", gain.path, "a parameter that the law reads", remedy)
    leaf, tokens = found[0]
    start, shape = starts[leaf]
    index = tuple(int(token) for token in tokens[len(paths.parse(leaf)) :])
    # Indices of the numbers of the gain in the struct of parameters.
    numbers = np.ravel((start + np.arange(math.prod(shape))).reshape(shape)[index])
    offsets = [[int(x)] for x in numbers]
    if gain.tied:
        offsets = [[int(x) for x in numbers]]
    return {
        "path": gain.path,
        "unit": gain.unit,
        "is_scalar": gain.tied or gain.value.ndim == 0,
        "low": gain.low.reshape(-1).tolist(),
        "high": gain.high.reshape(-1).tolist(),
        "offsets": offsets,
    }


def _gain_lines(options: RosOptions) -> str:
    """The gains in the file of parameters."""
    lines = []
    for gain in options.gains:
        text = _yaml_value(gain)
        low, high = gain.low.reshape(-1).tolist(), gain.high.reshape(-1).tolist()
        limits = f"{yaml_numbers(low)} to {yaml_numbers(high)}"
        unit = comment(gain.unit)
        lines.append(f"    {yaml_name(gain.path)}: {text}  # [{unit}], from {limits}")
    return "\n".join(lines) or "    # This law was exported without gains that can be changed."


def _yaml_value(gain: GainOption) -> str:
    """The value of a gain as YAML: one number, or one for each joint."""
    numbers = gain.value.reshape(-1).tolist()
    if gain.tied or gain.value.ndim == 0:
        return yaml_number(numbers[0])
    return yaml_numbers(numbers)


def ros_files(law: Law, generated: GeneratedLaw, options: RosOptions) -> dict[str, str]:
    """The files of the package, and in a folder of it those of the package of a controller of
    ros2_control: path -> text.
    """
    name = law.name
    description = _description(law, generated, options)
    values = {
        "name": name,
        "title": title_of(law.scenario),
        "version": __version__,
        "joints": yaml_names(description["joints"]),
        "period": yaml_number(description["period"]),
        "state_timeout": yaml_number(STALE_PERIODS * description["period"]),
        "arrival_timeout": yaml_number(ARRIVAL_TIMEOUT),
        "torque_limits": yaml_numbers(description["torque_limits"]),
        "on_fault": description["on_fault"],
        "hold_stiffness": yaml_numbers(description["hold_stiffness"]),
        "hold_damping": yaml_numbers(description["hold_damping"]),
        "gains": _gain_lines(options),
        "n": law.scenario.n,
        "rate": f"{1.0 / description['period']:.6g}",
        **_readme_values(law, options, description),
    }
    texts = {
        "package.xml": fill_template(
            "package.xml", values | {"title": escape(values["title"])}, TEMPLATES
        ),
        "setup.py": fill_template("setup.py.txt", values, TEMPLATES),
        "setup.cfg": fill_template("setup.cfg", values, TEMPLATES),
        "README.md": fill_template("README.md", values, TEMPLATES),
        f"resource/{name}": "",
        f"launch/{name}.launch.py": fill_template("launch.py.txt", values, TEMPLATES),
        f"config/{name}.yaml": fill_template("parameters.yaml", values, TEMPLATES),
        "test/test_law.py": fill_template("test_law.py.txt", values, TEMPLATES),
        f"{name}/__init__.py": f'"""{values["title"]}."""\n',
        f"{name}/law.json": f"{json.dumps(description, indent=1)}\n",
        f"c/{name}_library.c": fill_template("library.c", values, TEMPLATES),
    }
    node = files(NODE)
    for module in NODE_MODULES:
        text = (node / module).read_text(encoding="utf-8")
        texts[f"{name}/{module}"] = text.replace(NODE, name)
    for file, text in generated.files.items():
        texts[f"c/{file}"] = text
    controller = controller_package(name)
    for file, text in ros2_control_files(law, generated, description).items():
        texts[f"{controller}/{file}"] = text
    return texts


def _readme_values(law: Law, options: RosOptions, description: Mapping[str, Any]) -> dict[str, str]:
    """The sentences and the table of the README that depend on the law."""
    # How a gain is changed while the node runs.
    set_gain = "This law was exported without gains that can be changed while the node runs."
    if options.gains:
        gain = options.gains[0]
        value = f"{shlex.quote(gain.path)} {json.dumps(_yaml_value(gain))}"
        set_gain = (
            "The gains among them can be changed while the node runs, within their ranges there;"
            " the torque makes a step. Simulate the ends of the ranges with the delay of your"
            f" loop.\n\n    ros2 param set /{law.name} {value}"
        )
    # What the law reads, and what a lost state does.
    velocity = "positions and velocities"
    lost_state = "the torques of the state before act for one more period."
    if not description["reads_velocity"]:
        velocity = "positions (the law filters velocities from them)"
        lost_state = (
            "the velocity filter divides by the period, so that one lost state doubles the"
            " difference of the next, and the torques have an error for some periods."
        )
    # Reference and bounds of every joint at t = 0.
    inputs = inputs_at_start(law.scenario)
    position, sides = law.scenario.reference.position(inputs.t), bounds_at(law.scenario, inputs)
    lines = ["| joint | reference [rad] | bounds [rad] |", "|---|---|---|"]
    for joint, q, low, high in zip(description["joints"], position, *sides, strict=True):
        lines.append(f"| {markdown_code(joint)} | {q:.4g} | {low:.4g} to {high:.4g} |")
    return {
        "set_gain": set_gain,
        "velocity": velocity,
        "lost_state": lost_state,
        "start_table": "\n".join(f"  {line}" for line in lines),
    }


def write_package(
    law: Law, generated: GeneratedLaw, options: RosOptions, folder: Path
) -> tuple[str, ...]:
    """Writes the package into a folder; returns the names of its files."""
    positions = jnp.asarray(law.vectors.q[::CHECK_INTERVAL])
    gravity = np.abs(jax.vmap(law.scenario.model.gravity)(positions)).max(axis=0)
    if not np.all(gravity <= options.torque_limits):
        needed, given = (np.array2string(x, precision=4) for x in (gravity, options.torque_limits))
        notices.warn(
            f"torque_limits: gravity takes up to {needed} N m in the simulated run, but the node"
            f" clips at {given} N m: the drives can neither hold nor move the robot there. Give the"
            " limits of the drives, or a scenario that they can carry."
        )
    texts = ros_files(law, generated, options)
    for name in {str(Path(name).parent) for name in texts}:
        (folder / name).mkdir(parents=True, exist_ok=True)
    write_files(folder, texts)
    return tuple(texts)
