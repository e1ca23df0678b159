"""`new`: writes a small project for a robot: scenario, study, tuning, notebook and README."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "write a small project for a robot, ready to run"
DESCRIPTION = (
    "Write scenario.toml, study.toml, tune.toml, a notebook and a README with the next commands"
    " into a new folder, for the robot of a URDF or MJCF file or for a preset.  The scenario is"
    " run before it is written: its motion, bounds, gains and sampling suit the robot."
)
EPILOG = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    parser.add_argument("folder", metavar="FOLDER", help="a folder that is new or empty")
    parser.add_argument("--robot", metavar="FILE", help="the robot, a URDF or MJCF file")
    parser.add_argument(
        "--base", metavar="LINK", help="the link that is fixed (default: the root of the file)"
    )
    parser.add_argument(
        "--tip", metavar="LINK", help="the last link (default: the end of the only chain)"
    )
    parser.add_argument(
        "--rotor-inertia",
        action="store_true",
        help="add an inertia to the joints whose friction a time step of 1 ms does not resolve; of"
        " the simulated robot only, the law knows that of the file",
    )
    parser.add_argument(
        "--preset",
        metavar="NAME",
        help="without --robot: zhang_yan_2024, ur5 or iiwa14 (default: zhang_yan_2024)",
    )


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.cli import _project
    from iblf_jax.cli._common import output_folder
    from iblf_jax.core import checks

    folder = Path(args.folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise checks.fail("FOLDER", args.folder, "a folder that is new or empty")
    if args.robot is None:
        for option in ("base", "tip"):
            if getattr(args, option) is not None:
                raise checks.fail(f"--{option}", getattr(args, option), "--robot beside it")
        if args.rotor_inertia:
            raise checks.fail("--rotor-inertia", True, "--robot beside it")
        project = _project.of_preset(args.preset or "zhang_yan_2024")
    elif args.preset is not None:
        raise checks.fail("--preset", args.preset, "either --robot or --preset")
    else:
        try:
            project = _project.of_robot(
                Path(args.robot), folder, args.base, args.tip, args.rotor_inertia
            )
        except ImportError as error:
            raise ValueError(str(error)) from error
    names = _project.write(project, output_folder(args.folder, "FOLDER"))
    print(f"written to {folder}: {', '.join(names)}")
    if project.rotors:
        print(
            f"inertia added to the simulated robot [kg m^2]: {project.rotors}; README.md says why"
        )
    print(f"\nNext:\n  cd {folder}")
    for command, purpose in _project.COMMANDS[:3]:
        print(f"  {command:<46} # {purpose}")
    return 0
