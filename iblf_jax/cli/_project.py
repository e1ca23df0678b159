"""The files of `new`: a scenario that was run, and a study, a tuning and a notebook of it."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from iblf_jax.core import checks

if TYPE_CHECKING:
    from iblf_jax.simulation.scenario import Scenario
    from iblf_jax.world.robots import Arm

PERIODS = (2e-3, 1e-3, 5e-4)
"""Sampling periods [s] that are tried, from the longest: the gains of `arm_scenario` are chosen for
500 Hz."""
SLOWER = 1.5
"""Factor of the motion's duration where it saturates the torques, at most SLOWINGS times."""
SLOWINGS = 4
LARGEST_TRAVEL = 0.8
"""Largest motion of a joint [rad or m]; a quarter of the range where this is less."""
LARGEST_DISTANCE = 0.15
"""Largest distance of the bounds from the motion [rad or m]; a tenth of the range where this is
less."""
RESOLVED = 2.0
"""Largest product of the decay of a joint's friction and the time step with `rotor_inertia`; RK4 is
stable up to 2.785, and links that a study makes lighter decay faster."""
HOLDING = 0.8
"""Largest share of a torque limit that gravity takes, with the payload of the study."""
DURATIONS = {"zhang_yan_2024": 4.0, "ur5": 4.0, "iiwa14": 4.0}
"""Preset that a project may start from -> length of its runs [s]."""


class Project(NamedTuple):
    """What the files of a project say."""

    scenario: Scenario
    text: str
    """The file scenario.toml, without its table [run]."""
    about: str
    """The scenario in a sentence."""
    duration: float
    """Length of a run [s]."""
    perturbations: dict[str, str]
    """Path -> the entry of the study, in TOML."""
    margin: float
    """Least distance to the bounds that the tuning requires [rad]."""
    rotor_inertia: Mapping[str, float] = MappingProxyType({})
    """Joint -> the inertia that `--rotor-inertia` added to the plant [kg m^2]."""

    @property
    def rotors(self) -> str:
        """The joints with an added inertia, each with its number [kg m^2]; empty without."""
        return ", ".join(f"{joint} {inertia:g}" for joint, inertia in self.rotor_inertia.items())

    @property
    def period(self) -> float:
        """The sampling period [s]."""
        return float(self.scenario.sampling.period)  # type: ignore[union-attr]

    @property
    def dt(self) -> float:
        """The time step [s]: half a sampling period."""
        return self.period / 2


def of_preset(name: str) -> Project:
    """The project of a preset, sampled at the longest of PERIODS at which its run is ok.

    Raises:
      ValueError: a preset that is not in DURATIONS.
    """
    from iblf_jax.files.scenario import scenario_to_toml
    from iblf_jax.presets import PRESETS

    checks.one_of("--preset", name, tuple(DURATIONS))
    start, duration = PRESETS[name](), DURATIONS[name]
    scenario = next(filter(None, (_at(start, period, duration) for period in PERIODS)))
    perturbations = {
        "plant.mass": '{ factor = "uniform", low = 0.9, high = 1.1 }',
        "initial.q": '{ offset = "uniform", low = -0.02, high = 0.02 }',
    }
    about = f"It is the preset {name}, with a sampled law."
    return Project(scenario, scenario_to_toml(scenario), about, duration, perturbations, 0.02)


def of_robot(
    file: Path, folder: Path, base: str | None, tip: str | None, rotor_inertia: bool = False
) -> Project:
    """The project of a robot in a URDF or MJCF file: a motion from rest to rest within the ranges
    of its joints, and bounds around it.

    The motion and the sampling are those of the first run without a failure and without saturated
    torques: a motion that saturates them becomes slower, and a loop that fails is sampled faster.

    Args:
      file: the robot's file.
      folder: the folder of the project, to which the path of the file is relative.
      base, tip: links, as for `iblf_jax.robots.load`.
      rotor_inertia: whether to add an inertia to the joints of the plant whose friction the time
        step does not resolve (`_rotor_inertia`).

    Raises:
      ValueError: a file that cannot be read, torque limits that do not hold the robot, friction
        that is too fast for the time step, or a robot for which no such run was found; the message
        names the remedy.
    """
    from iblf_jax.presets import arm_scenario
    from iblf_jax.world import references
    from iblf_jax.world.bounds import Bounds, Constant
    from iblf_jax.world.robots import load

    arm = load(file, base, tip)
    middle, half = _ranges(arm)
    start = np.round(middle - np.minimum(0.25 * half, 0.5 * LARGEST_TRAVEL), 4)
    end = np.round(middle + np.minimum(0.25 * half, 0.5 * LARGEST_TRAVEL), 4)
    distance = np.round(np.minimum(0.2 * half, LARGEST_DISTANCE), 4)
    positions = np.linspace(start, end, 9)
    payload = _payload(arm, positions, file)
    added = np.zeros(arm.n)
    if rotor_inertia:
        added = _rotor_inertia(arm, positions, PERIODS[0] / 2)
    plant, model = arm, None
    if added.any():
        plant, model = dataclasses.replace(arm, armature=np.asarray(arm.armature) + added), arm
    _refuse_stiff_friction(plant, start, file)
    bounds = Bounds(lower=Constant(start - distance), upper=Constant(end + distance))
    speeds = np.where(np.isfinite(arm.speed), np.asarray(arm.speed), np.pi)
    # The peak speed of a quintic motion is 15/8 of its mean.
    time = max(1.0, float(np.max(15 / 8 * (end - start) / (0.5 * speeds))))
    for _ in range(SLOWINGS):
        time = float(np.ceil(10 * time) / 10)
        motion = references.Quintic(start=start, end=end, duration=time)
        loop = arm_scenario(plant, motion, bounds=bounds, model=model)
        scenario = next(filter(None, (_at(loop, x, time + 0.5) for x in PERIODS)), None)
        if scenario is not None:
            break
        time *= SLOWER
    else:
        inertia = np.diag(arm.mass_matrix(start))
        least = int(np.argmin(inertia))
        raise checks.fail(
            "--robot",
            str(file),
            f"a robot whose law keeps it on a slow motion, sampled every {PERIODS[-1]:g} s",
            f"The lightest joint is {arm.joints[least]}, with {inertia[least]:.2g} kg m^2: check"
            " its inertia and that of its rotor (armature), or name a --tip before it.",
        )
    perturbations = {
        "plant.mass": '{ factor = "uniform", low = 0.9, high = 1.1 }  # each link',
        "plant.payload": f'{{ value = "uniform", low = 0.0, high = {payload} }}  # kg at the tip',
        "initial.q": _offsets(distance),
    }
    if not payload:
        del perturbations["plant.payload"]
    text = _scenario_text(
        file, folder, {"base": base, "tip": tip}, scenario, distance, is_changed=bool(added.any())
    )
    about = f"Its robot is `{file.name}`, with the joints {', '.join(arm.joints)}."
    margin = float(np.round(0.2 * np.min(distance), 4))
    larger = {name: float(x) for name, x in zip(arm.joints, added, strict=True) if x}
    return Project(scenario, text, about, time + 0.5, perturbations, margin, larger)


def _ranges(arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """Middle and half width of the part of each joint's range that is within half a turn (1 m) of
    the middle or of the finite limit, (n,) each.
    """
    lower, upper = np.asarray(arm.lower, float), np.asarray(arm.upper, float)
    reach = np.where(np.array(arm.kinds) == "prismatic", 1.0, np.pi)
    highest = np.where(np.isfinite(upper), upper, reach)
    low = np.where(np.isfinite(lower), lower, highest - 2 * reach)
    high = np.where(np.isfinite(upper), upper, low + 2 * reach)
    return (low + high) / 2, np.minimum((high - low) / 2, reach)


def _offsets(distance: np.ndarray) -> str:
    """The perturbation of the initial positions: a fifth of the distance to the bounds."""
    width = float(np.round(0.2 * np.min(distance), 4))
    return f'{{ offset = "uniform", low = {-width}, high = {width} }}  # rad, each joint'


def _payload(arm: Arm, positions: np.ndarray, file: Path) -> float:
    """A payload of at most 5 % of the arm's mass that its torque limits hold [kg].

    Raises:
      ValueError: the torque limits do not hold the arm itself.
    """
    limits = np.asarray(arm.effort)
    payload = float(np.round(0.05 * np.sum(np.asarray(arm.mass)), 2))
    for kg in (payload, round(payload / 4, 2), 0.0):
        loaded = dataclasses.replace(arm, payload=kg)
        shares = np.max([np.abs(loaded.gravity(q)) for q in positions], axis=0) / limits
        if np.all(shares <= HOLDING):
            return kg
    worst = int(np.argmax(shares))
    raise checks.fail(
        "--robot",
        str(file),
        "torque limits that hold the robot",
        f"Gravity takes {100 * shares[worst]:.0f} % of the limit {limits[worst]:g} N m of the joint"
        f" {arm.joints[worst]}: correct <limit effort> or forcerange in the file.",
    )


def _friction_slope(arm: Arm) -> np.ndarray:
    """The largest slope of the friction of each joint, which is that at rest, (n,) [N m s/rad]."""
    slope = np.asarray(arm.damping + arm.friction / arm.friction_width, float)
    return np.broadcast_to(slope, (arm.n,))


def _rotor_inertia(arm: Arm, positions: np.ndarray, step: float) -> np.ndarray:
    """An inertia J_i of some joints with which a time step resolves the friction at rest, (n,)
    [kg m^2]; zero if it does without.

        M^-1 D v = lambda v,   lambda step <= RESOLVED,   J_i = D_i step / RESOLVED

    With this J_i of every joint v^T D v <= lambda v^T (M + J) v for all v, since M is positive
    definite.  The joints receive it one after the other, those with the fastest decay
    D_i (M^-1)_ii first, until the eigenvalues at all positions are small enough.

    Args:
      arm: the robot.
      positions: positions of the motion, (K, n) [rad].
      step: the time step [s].
    """
    slope = _friction_slope(arm)
    masses = np.stack([np.asarray(arm.mass_matrix(q), float) for q in positions])
    added = np.zeros(arm.n)
    while True:
        mobility = np.linalg.inv(masses + np.diag(added))
        # The eigenvalues of D^(1/2) M^-1 D^(1/2), which is symmetric, are those of M^-1 D.
        scaled = np.sqrt(slope)[:, None] * mobility * np.sqrt(slope)
        if np.max(np.linalg.eigvalsh(scaled)) * step <= RESOLVED:
            return added
        decays = np.max(np.diagonal(scaled, axis1=1, axis2=2), axis=0)
        fastest = int(np.argmax(np.where(added > 0.0, 0.0, decays)))
        # Rounded up, so that the file has few digits.
        added[fastest] = math.ceil(1e4 * slope[fastest] * step / RESOLVED) / 1e4


def _refuse_stiff_friction(arm: Arm, q: np.ndarray, file: Path) -> None:
    """Raises ValueError for friction that the smallest time step does not resolve.

    At rest the velocities decay by the eigenvalues of M^-1 D with D the slope of the friction; the
    largest one is at least the largest D_ii (M^-1)_ii.
    """
    from iblf_jax.simulation.integrators import TABLEAUS

    slope = _friction_slope(arm)
    mobility = np.diag(np.linalg.inv(np.asarray(arm.mass_matrix(q))))
    decay = slope * mobility
    worst = int(np.argmax(decay))
    step = PERIODS[-1] / 2
    if decay[worst] * step <= TABLEAUS["rk4"].stability:
        return
    raise checks.fail(
        "--robot",
        str(file),
        f"a robot whose friction a time step of {step:g} s resolves",
        f"At rest the joint {arm.joints[worst]} has {slope[worst]:.3g} N m s/rad (damping +"
        f" friction/friction_width) on {1 / mobility[worst]:.2g} kg m^2, a decay of"
        f" {decay[worst]:.2g} 1/s. Either give the"
        " option --rotor-inertia, with which the simulated robot has the inertia of a rotor there,"
        " or correct <dynamics damping, friction>, or name a --tip before it.",
    )


def _at(scenario: Scenario, period: float, duration: float) -> Scenario | None:
    """The scenario sampled at a period; None if its run fails, saturates its torques or is sampled
    too slowly.
    """
    from iblf_jax.core.status import FAILED, Status, has_flag
    from iblf_jax.engine.diagnosis import SimulationWarning
    from iblf_jax.engine.simulate import simulate
    from iblf_jax.simulation.sampling import Sampling
    from iblf_jax.simulation.scenario import with_parts

    sampled = with_parts(scenario, sampling=Sampling(period=period))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SimulationWarning)  # the next attempt is the remedy
        run = simulate(sampled, duration=duration, dt=period / 2)
    unwanted = FAILED | Status.SAMPLING_TOO_SLOW | Status.TORQUE_SATURATED
    if has_flag(int(run.status), unwanted):
        return None
    return sampled


def write(project: Project, folder: Path) -> list[str]:
    """Writes the files of a project into a folder; returns their names."""
    run = f"[run]\nduration = {project.duration:g}  # s\ndt = {project.dt:g}  # s\n"
    files = {
        "scenario.toml": f"{project.text}\n{run}",
        "study.toml": _study_text(project),
        "tune.toml": _tuning_text(project),
        "project.ipynb": _notebook_text(folder.resolve().name),
        "README.md": _readme_text(project, folder.resolve().name),
    }
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return list(files)


def _scenario_text(
    file: Path,
    folder: Path,
    links: Mapping[str, str | None],
    scenario: Scenario,
    distance: np.ndarray,
    is_changed: bool,
) -> str:
    """The file scenario.toml of a robot, without its table [run]; with another armature of the
    plant if this `is_changed`.
    """
    path = json.dumps(os.path.relpath(file, folder))
    named = [f"{name} = {json.dumps(link)}" for name, link in links.items() if link is not None]
    robot = ["[robot]", f"file = {path}  # relative to this file", *named]
    if is_changed:
        plant: Any = scenario.plant
        armature = json.dumps(np.asarray(plant.armature, float).tolist())
        robot = [
            "[plant]  # the simulated robot",
            *robot[1:],
            f"armature = {armature}  # kg m^2, of the rotors, in place of the file's",
            "",
            "[model]  # the robot that the law knows",
            *robot[1:],
        ]
    motion: Any = scenario.reference
    bounds: Any = scenario.bounds[0]
    lines = [
        "# The gains, the weight of the barrier and the torque limits follow from the robot's",
        "# numbers (iblf_jax.presets.arm_scenario); a table [controller] replaces them.",
        *robot,
        "",
        "[reference]  # from rest to rest",
        'kind = "quintic"',
        f"start = {_row(motion.start)}  # rad",
        f"end = {_row(motion.end)}",
        f"duration = {float(motion.duration):g}  # s",
        "",
        f"[bounds.lower]  # {_row(distance)} rad from the motion, inside the joint limits",
        'kind = "constant"',
        f"value = {_row(bounds.lower.value)}",
        "",
        "[bounds.upper]",
        'kind = "constant"',
        f"value = {_row(bounds.upper.value)}",
        "",
        "[sampling]",
        f"period = {float(scenario.sampling.period):g}  # s",  # type: ignore[union-attr]
        "",
    ]
    return "\n".join(lines)


def _row(values: Any) -> str:
    return json.dumps(np.round(np.asarray(values, float), 4).tolist())


def _study_text(project: Project) -> str:
    entries = [f'"{path}" = {entry}' for path, entry in project.perturbations.items()]
    return "\n".join(
        [
            "# What is uncertain, and how many runs the study makes.",
            'scenario = "scenario.toml"',
            "",
            "[perturbations]",
            *entries,
            "",
            "[study]",
            "runs = 256",
            "seed = 0",
            "",
        ]
    )


def _tuning_text(project: Project) -> str:
    entries = [f'"{path}" = {entry}' for path, entry in project.perturbations.items()]
    limits: Any = project.scenario.plant.effort  # type: ignore[union-attr]
    torque = []
    if limits is not None and np.all(np.isfinite(limits)):
        torque = [
            "[[requirement]]  # below the limits of the file, which leave no derivative",
            'kind = "peak_torque_below"',
            f"limit = {_row(0.9 * np.asarray(limits))}  # N m",
            "",
        ]
    return "\n".join(
        [
            "# Which gains are tuned, what is minimised, and what is required.",
            'scenario = "scenario.toml"',
            "",
            "[tune]",
            "parameters = [",
            '  "controller.K2",  # one number for each joint',
            '  { path = "controller.k1", low = 1.0, high = 12.0, tied = true },  # one for all',
            '  { path = "observer.kf", low = 2.0, high = 60.0, tied = true },',
            "]",
            'effort = "quick"  # or "normal", "thorough"',
            "runs = 8  # perturbed runs of the search; the report makes others",
            "confirm = 0.01  # so seldom do fresh runs fail; the limits are tightened until then",
            "",
            "[tune.report]",
            "runs = 64",
            "",
            "[[objective]]",
            'kind = "tracking"',
            "[[objective]]",
            'kind = "effort"',
            "weight = 0.1",
            "",
            "[[requirement]]",
            'kind = "margin_above"',
            f"limit = {project.margin:g}  # rad",
            "",
            *torque,
            "[perturbations]  # those of study.toml",
            *entries,
            "",
        ]
    )


def _notebook_text(name: str) -> str:
    """The notebook: the scenario, a run, its figure and a study."""
    cells = [
        ("markdown", f"# {name}\n\nOne run of `scenario.toml`, and the study of `study.toml`."),
        (
            "code",
            "import jax\n\nimport iblf_jax as ij\nfrom iblf_jax.files.scenario import"
            " load_scenario_file\nfrom iblf_jax.files.study import load_study_file\n\n"
            'jax.config.update("jax_enable_x64", True)\n'
            'file = load_scenario_file("scenario.toml")\n'
            "run = ij.simulate(file.scenario, **file.run)\nrun",
        ),
        ("code", "run.plot();"),
        (
            "code",
            'plan = load_study_file("study.toml", "study")\n'
            "study = ij.monte_carlo(plan.scenario, plan.perturbations, progress=False,"
            " **plan.options)\nstudy",
        ),
        ("code", "study.plot();"),
        (
            "markdown",
            "`iblf-jax tune tune.toml --out tuned` writes the tuned scenario, which"
            ' `ij.load_scenario("tuned/scenario.toml")` reads.',
        ),
    ]
    notebook = {
        "cells": [_cell(i, kind, text) for i, (kind, text) in enumerate(cells)],
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(notebook, indent=1) + "\n"


def _cell(number: int, kind: str, text: str) -> dict[str, Any]:
    cell: dict[str, Any] = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}}
    if kind == "code":
        cell |= {"execution_count": None, "outputs": []}
    return cell | {"source": text.splitlines(keepends=True)}


COMMANDS = (
    ("iblf-jax simulate scenario.toml --out run", "one run: metrics and `run/overview.png`"),
    ("iblf-jax montecarlo study.toml --out study.nc", "256 runs with what is uncertain"),
    ("iblf-jax tune tune.toml --out tuned", "gains for these runs: `tuned/report.txt`"),
    ("iblf-jax export tuned/scenario.toml --out law", "the tuned law as C99"),
)
"""The commands of the README with their purposes: the next three, and the one after a tuning."""
DRIVES = (
    "[sensor]",
    'kind = "encoder"',
    "counts = 65536.0  # a turn",
    "",
    "[sensor.velocity]",
    'kind = "filtered_difference"',
    "cutoff = 300.0  # rad/s",
    "",
    "[actuator]",
    'kind = "motor"',
    "bandwidth = 200.0  # 1/s",
)
"""Tables of the README for encoders and motors in place of ideal ones."""
TIMES = (
    "They took 8, 12 and 46 s of processor time for the three joints of `examples/arm.urdf`, and 8,"
    " 13 and 74 s for the six of ur5 (jax 0.10.2, a shared machine of two cores). The tuning"
    " repeats its search with tighter limits until fresh runs confirm the requirements."
)
"""Processor time of the three commands, measured with iblf_jax 1.0.0rc1."""


def _about_rotors(rotors: str) -> list[str]:
    """What `--rotor-inertia` changed, a paragraph of the README; empty if it changed nothing."""
    if not rotors:
        return []
    return [
        "",
        "The friction of some joints is too fast for the time step; as a rule, the file has the"
        " friction of their drives and not the inertia of their rotors. The simulated robot has an"
        f" inertia there that is not in the file, chosen for the time step [kg m^2]: {rotors}. The"
        " friction is that of the file, and the law knows the robot of the file. Write the"
        " inertias of the rotors, which are the square of the gear ratio times those of the data"
        " sheets, into `armature` of [plant] and [model] if they are known.",
    ]


def _readme_text(project: Project, name: str) -> str:
    *three, last = COMMANDS
    return "\n".join(
        [
            f"# {name}",
            "",
            f"{project.about} The law runs every {1e3 * project.period:g} ms. It was run once"
            f" before these files were written: the run of {project.duration:g} s kept its bounds.",
            *_about_rotors(project.rotors),
            "",
            "The next three commands, in this folder:",
            "",
            "```bash",
            *(f"{command:<46} # {purpose}" for command, purpose in three),
            "```",
            "",
            TIMES,
            "",
            "When the report of the tuning says that its runs keep the bounds:",
            "",
            "```bash",
            f"{last[0]:<46} # {last[1]}",
            "```",
            "",
            "Without a tuning: `iblf-jax export scenario.toml --out untuned` writes the law with"
            " the gains of the scenario.",
            "",
            "| File | Content | Change |",
            "|---|---|---|",
            "| `scenario.toml` | robot, motion, bounds, sampling | the motion, and the bounds"
            " around it |",
            "| `study.toml` | what is uncertain | the ranges of masses, payload and start |",
            "| `tune.toml` | gains, objective, requirements | the requirements |",
            "| `project.ipynb` | run and study in Python | |",
            "",
            "Sensors and motors are ideal until `scenario.toml` has tables of them, such as",
            "",
            "```toml",
            *DRIVES,
            "```",
            "",
            "`iblf-jax doctor` shows what is installed, and"
            " `iblf-jax parameters scenario.toml` every number that can be changed.",
            "",
        ]
    )
