"""A generated ROS 2 package, built and installed as colcon does it for packages of ament_python."""

import os
import random
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import iblf_jax as ij

NAME = "arm_law"
PERIOD = 0.01


def take_domain() -> None:
    """A domain of this process alone, so that tests beside each other do not hear each other.

    Two workers of one run differ in the last digit.  The ports of domains above 100 are those that
    Linux gives to clients.
    """
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
    os.environ["ROS_DOMAIN_ID"] = str(10 * random.SystemRandom().randrange(1, 10) + worker % 10)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


class Package(NamedTuple):
    """A package in a workspace, and where it is installed."""

    scenario: ij.Scenario
    source: Path
    prefix: Path

    @property
    def modules(self) -> Path:
        return site_packages(self.prefix)


def site_packages(prefix: Path) -> Path:
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    return prefix / "lib" / version / "site-packages"


def install(source: Path, prefix: Path) -> None:
    base = prefix.parent / f"build_{prefix.name}"
    base.mkdir()
    command = [sys.executable, "setup.py", "-q", "egg_info", "--egg-base", str(base)]
    command += ["build", "--build-base", str(base), "install", "--prefix", str(prefix)]
    command += ["--single-version-externally-managed", "--record", str(base / "install.log")]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def law_scenario() -> ij.Scenario:
    """The paper's arm with gains that a period of 10 ms allows."""
    scenario = ij.with_parts(ij.presets.zhang_yan_2024(), sampling=ij.Sampling(PERIOD))
    gains = {"controller.k1": 1.0, "controller.K2": 2.0, "observer.kf": 3.0}
    return ij.with_parameters(scenario, gains)


def made_package(folder: Path) -> Package:
    scenario = law_scenario()
    source, prefix = folder / "src" / NAME, folder / "install"
    gains = [
        ij.tunable("controller.K2", [1.0, 1.5], [4.0, 3.5]),
        ij.tunable("controller.k1", 0.5, 4.0, tied=True),
        ij.tunable("observer.kf[1]", 2.0, 8.0),
    ]
    options = {"target": "ros2", "name": NAME, "torque_limits": [40.0, 15.0], "gains": gains}
    ij.export(scenario, source, **options)
    install(source, prefix)
    return Package(scenario, source, prefix)
