"""A law and a simulated robot as two processes under ROS 2: timing of the loop, distance from
`cosimulate`, lost messages, and a law node that is killed and restarted.

    python benchmarks/ros2.py [--quick] [--json FILE] [--priority N] [--duration S]

The robot is MuJoCo's `examples/two_link.xml`, at rest on the reference at the start, and the law
that of `presets.zhang_yan_2024` without its disturbance, with gains K2 = kf = 5 that tolerate a
delay of two periods.  In lock-step each state waits for its torque; in real time the robot
publishes its state every period, and the law samples with a timer of its own or with each state.

`distance`: largest distance of a joint from its position in `cosimulate` at the same time, with the
same model, integrator (RK4), step (0.5 ms) and period, over all steps.  `second half`: the same in
the second half of the motion.  `with delay`: from `cosimulate` with the median delay of the row,
from the nominal instant of a state to its torque.  `missed`: share of the periods without a torque.
`latency`: from the publication of a state to the next torque.  `jitter`: distance of the interval
between two torques from the period.  `gap`: longest interval between two torques.  `torque`:
largest torque, relative to its limit.  `load`: runnable processes of the machine before the row.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np
from _timing import report

import iblf_jax as ij
from iblf_jax.deployment.ros2.demo import (
    DiagnosticsListener,
    ProcessOfNode,
    cosimulated,
    export_and_build,
    interrupts_raised,
    law_command,
    priority_command,
    robot_command,
    without_parts_of_the_robot,
)
from iblf_jax.deployment.ros2.robot_motion import RobotMotion
from iblf_jax.simulation.scenario import canonical

ARM = Path(__file__).parents[1] / "examples" / "two_link.xml"
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 200)  # no other nodes of the machine
JOINTS = ("shoulder", "elbow")
DT = 5e-4
GAINS = {"controller.K2": 5.0, "observer.kf": 5.0}
TORQUE_LIMITS = [40.0, 15.0]
LONGEST = 300.0
"""Time after which a row is given up [s]."""
LATENESS = 20
"""Periods after which the law takes a state for stale in the rows that tolerate lost states."""
COLUMNS = (
    "case",
    "period [ms]",
    "priority",
    "missed",
    "latency [ms]",
    "latency 99 % [ms]",
    "longest [ms]",
    "jitter 99 % [ms]",
    "gap [ms]",
    "distance [rad]",
    "second half [rad]",
    "with delay [rad]",
    "mode",
    "torque",
    "load",
)


class Case(NamedTuple):
    """One row."""

    name: str
    period: float = 2e-3
    real_time: bool = False
    priority: int | None = None
    parameters: Mapping[str, str] = {}
    """Of the law node."""
    robot: Mapping[str, Any] = {}
    """Options of the robot."""
    restarts: bool = False


class Bench:
    """What all rows share: scenarios, packages and runs of `cosimulate`, by period."""

    def __init__(self, folder: Path, duration: float) -> None:
        self.folder, self.duration = folder, duration
        self.prepared: dict[float, tuple[Any, Path, Any]] = {}

    def prepare(self, period: float) -> tuple[Any, Path, Any]:
        """The scenario, the folder of its built package, and its run by `cosimulate`."""
        if period not in self.prepared:
            slower = ij.with_parameters(ij.presets.zhang_yan_2024(), GAINS)
            start = ij.Initial(q=slower.reference.position(0.0))
            scenario = ij.with_parts(slower, sampling=ij.Sampling(period), initial=start)
            scenario = canonical(without_parts_of_the_robot(scenario))
            package = self.folder / f"package_{1e6 * period:.0f}"
            export_and_build(scenario, package, torque_limits=TORQUE_LIMITS)
            run = cosimulated(scenario, ARM, JOINTS, self.duration, {"dt": DT})
            self.prepared[period] = scenario, package, run
        return self.prepared[period]

    def row(self, case: Case) -> list[Any]:
        """Runs a case and returns its row."""
        scenario, package, expected = self.prepare(case.period)
        load = os.getloadavg()[0]
        prefix = priority_command(case.priority)
        robot = prefix + robot_command(
            scenario,
            ARM,
            JOINTS,
            self.duration,
            self.folder,
            case.real_time,
            {"dt": DT, **case.robot},
        )
        parameters = {"trigger": "state"} | dict(case.parameters)
        law = prefix + law_command(package, "iblf_law", JOINTS, **parameters)
        motion, values = self.run(case, law, robot)
        timing = motion.timing()
        largest = np.max(np.abs(motion.tau) / np.array(TORQUE_LIMITS))
        delayed: Any = ""
        if case.real_time:
            delay = float(np.nanmedian(motion.latency + motion.lateness))
            options = {"dt": DT, "delay": delay}
            run = cosimulated(scenario, ARM, JOINTS, self.duration, options)
            delayed = distance(motion, run, 0.0)
        return [
            case.name,
            1e3 * case.period,
            "ordinary" if case.priority is None else f"FIFO {case.priority}",
            timing["missed"],
            1e3 * timing["latency, median"],
            1e3 * timing["latency, 99 %"],
            1e3 * timing["latency, longest"],
            1e3 * timing["jitter, 99 %"] if case.real_time else "",
            1e3 * timing["gap"] if case.real_time else "",
            distance(motion, expected, 0.0),
            distance(motion, expected, 0.5 * self.duration),
            delayed,
            values.get("mode", ""),
            float(largest),
            load,
        ]

    def run(
        self, case: Case, law: Sequence[str], robot: Sequence[str]
    ) -> tuple[RobotMotion, dict[str, str]]:
        """The motion of a case, and the last diagnostics of the law before its end."""
        log = self.folder / "robot.log"
        with contextlib.ExitStack() as stack:
            stack.enter_context(interrupts_raised())
            robot_process = stack.enter_context(ProcessOfNode(robot, log))
            law_process = stack.enter_context(ProcessOfNode(law, self.folder / "law.log"))
            listener = stack.enter_context(DiagnosticsListener())
            if case.restarts:
                law_process = stack.enter_context(self.restarted(law, law_process, log))
            listener.listen(robot_process, law_process, LONGEST)
        motion = ij.load(self.folder / "motion.npz")
        return motion, listener.last_before(motion.ended)

    def restarted(self, law: Sequence[str], process: ProcessOfNode, log: Path) -> ProcessOfNode:
        """Kills the law node in motion, and starts another that continues the reference."""
        words = "in motion, t = 0 at "
        while words not in (text := log.read_text()):
            if process.has_ended():
                raise ChildProcessError(process.last_lines())
            time.sleep(0.02)
        origin = int(text.partition(words)[2].split()[0])
        time.sleep(0.15 * self.duration)
        process.kill()
        again = [*law, "-p", f"time_origin:={origin * 1e-9!r}"]
        return ProcessOfNode(again, self.folder / "law_again.log")


def distance(motion: RobotMotion, expected: Any, since: float) -> float:
    """The largest distance of a joint from its position in `cosimulate` from a time on [rad]."""
    found = motion.q[motion.instant]
    wanted = np.asarray(expected.q)[: len(found)]
    after = np.asarray(expected.t)[: len(found)] >= since
    return float(np.max(np.abs(found - wanted)[after]))


def cases(priority: int) -> list[Case]:
    """All rows."""
    rows = [Case("lock-step"), Case("lock-step", period=1e-3)]
    for rank in (None, priority):
        for trigger in ("timer", "state"):
            for period in (2e-3, 1e-3):
                parameters = {"trigger": trigger, "state_timeout": repr(LATENESS * period)}
                name = f"real time, by {trigger}"
                rows.append(Case(name, period, True, rank, parameters))
    tolerant = {"trigger": "state", "state_timeout": repr(LATENESS * 2e-3)}
    for share in (0.01, 0.05, 0.2):
        lost = {"state_dropout": share}
        rows.append(Case(f"{share:.0%} of states lost", robot=lost))
        rows.append(
            Case(f"{share:.0%} of states lost, tolerated", 2e-3, False, None, tolerant, lost)
        )
    for share in (0.01, 0.05, 0.2):
        lost = {"effort_dropout": share}
        rows.append(Case(f"{share:.0%} of torques lost", robot=lost))
    rows.append(Case("restart in lock-step", restarts=True))
    timer = {"trigger": "timer", "state_timeout": repr(LATENESS * 2e-3)}
    rows.append(Case("restart in real time", 2e-3, True, priority, timer, restarts=True))
    held = {"brake": "always"}
    name = "restart in real time, with brake"
    rows.append(Case(name, 2e-3, True, priority, timer, held, restarts=True))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="one short row of each kind")
    parser.add_argument("--json", help="also write the table to this file")
    parser.add_argument(
        "--priority", type=int, default=50, help="of the rows with a real-time priority"
    )
    parser.add_argument("--duration", type=float, default=10.0, help="of a motion [s]")
    args = parser.parse_args()
    selected, duration = cases(args.priority), args.duration
    if args.quick:
        duration = 1.0
        selected = [selected[0], selected[2], selected[11]]
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(Path(name), duration)
        rows = []
        for case in selected:
            rows.append(bench.row(case))
            print(*rows[-1], flush=True)
    title = "A law and a simulated robot under ROS 2"
    report(title, COLUMNS, rows, args.json)


if __name__ == "__main__":
    main()
