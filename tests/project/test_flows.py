"""What users see of short flows through the package, from a scenario to texts, figures and files.

`tests/data/flows.txt` has the printed results, and of every array and all that a figure shows what
its numbers add up to, with generic weights.  The flows have one joint and few steps, so that what
they compile is small, but they go through studies, certificates, proofs, identification
and figures, with the parts that other tests leave at their defaults.  Results of every class come
from files (`stored_results`).  No figure is rendered, which takes longer than to make it.  Words
must be equal, and numbers but for rounding (`compared_texts`).  After a change that is meant to
move them,

    python tests/project/test_flows.py

writes the file anew.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
TESTS = Path(__file__).parents[1]
if __name__ == "__main__":
    sys.path.insert(0, str(TESTS))

import jax
import numpy as np
import pytest
from compared_texts import same_row, same_text
from made_up_runs import Arm3D, chain, made_up
from matplotlib.colors import to_rgba_array
from proof_cases import pendulum, within
from stored_results import FOLDER, stored

import iblf_jax as ij
from iblf_jax import reports
from iblf_jax.core.status import Status
from iblf_jax.engine import diagnosis
from iblf_jax.files.scenario import scenario_to_toml
from iblf_jax.simulation.error_growth import BOUND
from iblf_jax.simulation.stability import RADIUS

FILE = TESTS / "data" / "flows.txt"
HEADING = "=== "
RUN: dict[str, Any] = {"duration": 0.1, "dt": 5e-3, "method": "euler"}
SECONDS = re.compile(r"(?<=(?:bes|xes|eps), )[\d.]+ s\b")
"""How long so many probes, boxes or steps took."""
SLOW = ("comparisons", "proofs", "Proof_0")
"""Flows that take several seconds of a processor."""

# ------------------------------------------------------------ what is shown of a result


def total(values: Any) -> str:
    """The sum of some numbers with generic weights, relative to their size."""
    values = np.asarray(values, float).ravel()
    values = np.where(np.isfinite(values), values, 7.0)
    weights = np.cos(1.0 + np.arange(values.size))
    return f"{values.size} numbers, {float(values @ weights):.6g}"


def arrays(name: str, tree: Any) -> Iterator[str]:
    """A line for each array of a pytree or of an xarray.Dataset."""
    if hasattr(tree, "data_vars"):
        tree = {key: x.values for key, x in tree.variables.items()}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if isinstance(leaf, np.ndarray | jax.Array | float | int):
            yield f"{name}{jax.tree_util.keystr(path)}: {total(leaf)}"


def drawn(figure: Any) -> Iterator[str]:
    """The words of each panel, and what its curves and patches add up to."""
    for axes in figure.axes:
        curves = [line.get_xydata() for line in axes.lines]
        patches = [patch.get_path().vertices for patch in axes.patches]
        areas = [path.vertices for x in axes.collections for path in x.get_paths()]
        words = [axes.get_title(), axes.get_xlabel(), axes.get_ylabel()]
        words += [text.get_text() for text in axes.texts]
        if axes.get_legend() is not None:
            words += [text.get_text() for text in axes.get_legend().get_texts()]
        counts = [
            total(np.concatenate([np.ravel(x) for x in group]) if group else [])
            for group in (curves, patches, areas)
        ]
        yield " | ".join([*filter(None, words), *counts]).replace("\n", " ")
        yield f"looks: {total(np.concatenate([np.ravel(x) for x in looks(axes)]))}"
    yield "figure of {:.6g} x {:.6g} inches".format(*figure.get_size_inches())


LOOKS = (
    *("color", "facecolor", "edgecolor", "alpha", "zorder", "linewidth", "markersize", "sizes"),
    *("position", "fontsize", "rotation"),
)


def looks(axes: Any) -> Iterator[Any]:
    """Numbers of where a panel is, of its axes, and of how each artist in it looks."""
    yield from (axes.get_position().bounds, axes.get_xlim(), axes.get_ylim(), axes.get_xticks())
    yield from (np.asarray(x.get_array(), float) for x in axes.images)
    for artist in (*axes.lines, *axes.patches, *axes.collections, *axes.texts):
        for name in LOOKS:
            value = getattr(artist, f"get_{name}", tuple)()
            if value is not None:
                yield to_rgba_array(value) if "color" in name else value


def printed(result: Any) -> Iterator[str]:
    """The lines of a result."""
    for line in SECONDS.sub("- s", str(result)).splitlines():
        yield line.rstrip()


# ------------------------------------------------------------ the flows


@functools.cache
def loop() -> ij.Scenario:
    """A pendulum with a disturbance, an observer that starts wrong, and weights that are not 1."""
    law = ij.controllers.Backstepping(
        k1=2.0, K2=[3.0], o=0.1, variant="corrected", weight=0.4, barrier=ij.barriers.Log()
    )
    rubbing = ij.disturbances.Friction(viscous=0.05, coulomb=0.1, width=0.1)
    return pendulum(controller=law, disturbance=rubbing)


MASS = {"plant.mass": ij.factor(ij.uniform(0.8, 1.1))}


def of_studies() -> Iterator[str]:
    study = ij.monte_carlo(loop(), MASS, runs=16, seed=3, progress=False, **RUN)
    yield from printed(study)
    yield from arrays("metrics", dict(study.metrics.items()))
    yield from arrays("quantiles", study.quantiles((0.025, 0.5)))
    yield from arrays("bands", study.bands((0.125, 0.5)))
    yield from drawn(study.plot())


def of_sweeps() -> Iterator[str]:
    grid = {"controller.K2": [2.0, 4.0], "observer.kf": [20.0, 50.0, 60.0]}
    table = ij.sweep(loop(), grid, perturbations=MASS, runs=8, seed=1, progress=False, **RUN)
    yield from arrays("sweep", table)
    yield from drawn(ij.plotting.heat_map(table, ["violated", "margin"]))
    yield from drawn(ij.plotting.parallel(table))


def of_comparisons() -> Iterator[str]:
    scenario = ij.with_parts(loop(), observer=ij.observers.Momentum(kf=[20.0]))
    table = ij.compare(scenario, laws=["log", "tan"], **RUN)
    yield from printed(table)
    yield from drawn(table.plot())


def of_certificates() -> Iterator[str]:
    certificate = ij.certify(loop(), **RUN)
    yield from printed(certificate)
    yield from drawn(certificate.plot())


def of_level_certificates() -> Iterator[str]:
    drive = ij.presets.motor_driven_pendulum()
    certificate = ij.certify(drive, duration=0.05, dt=5e-3, method="heun")
    yield from printed(certificate)
    yield from drawn(certificate.plot())


def of_proofs() -> Iterator[str]:
    proof = ij.prove(pendulum(), parameters=within(1.0), level=0.1, max_boxes=200)
    yield from printed(proof)
    yield from drawn(proof.plot())


def of_identification() -> Iterator[str]:
    run = ij.simulate(loop(), duration=1.0, dt=5e-3, method="euler")
    log = {"t": run.t, "q": run.q + 1e-4 * np.cos(77.0 * run.t)[:, None], "tau": run.tau}
    before = ij.with_parameters(loop(), {"plant.mass": 1.8})
    result = ij.identify(before, log, ["robot.mass", "disturbance.viscous"])
    yield from printed(result)
    yield from drawn(result.plot())


def of_runs() -> Iterator[str]:
    yield from scenario_to_toml(loop()).splitlines()
    failing = ij.with_parts(loop(), actuator=ij.actuators.Motor(limit=0.5))
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        run = ij.simulate(failing, duration=0.5, dt=5e-3)
    yield from (str(x.message) for x in shown)
    yield from printed(run)
    yield from arrays("metrics", dict(run.metrics.items()))
    yield from drawn(run.plot())


def of_messages() -> Iterator[str]:
    run = stored("Rollout_1")
    values = run.metrics.values_by_name | {RADIUS: np.array(1.2), BOUND: np.array(0.1)}
    values |= {"first_level_violation_level": 3, "first_level_violation_component": 0}
    metrics = dataclasses.replace(run.metrics, values_by_name=values)
    for flag in sorted(set(Status) - {Status.FILTER_INFEASIBLE, Status.MODES_EXHAUSTED}):
        flagged = dataclasses.replace(run, metrics=metrics, status=np.int32(flag))
        if flag in (Status.SAMPLING_TOO_SLOW, Status.STEP_TOO_LARGE):
            # A smaller loop, of which a term is found.
            law = ij.controllers.PDGravity(Kp=60.0, Kd=[20.0])
            parts = {"observer": ij.observers.NoObserver(), "sampling": ij.Sampling(period=0.02)}
            scenario = pendulum(controller=law, **parts)
            flagged = dataclasses.replace(flagged, scenario=scenario, x=run.x[:, :2])
        with warnings.catch_warnings(record=True) as shown:
            warnings.simplefilter("always")
            try:
                diagnosis.report(flagged, 50, throw=False)
            except ValueError as error:
                yield str(error)
        yield from (str(x.message) for x in shown)
    comparison = stored("Comparison_0")
    flagged = {
        name: dataclasses.replace(run, status=np.int32(Status.BOUND_VIOLATED))
        for name, run in comparison.rollouts.items()
    }
    yield str(dataclasses.replace(comparison, rollouts=flagged).failed)


def of_derivatives() -> Iterator[str]:
    def loss(gain: Any) -> Any:
        scenario = ij.with_parameters(loop(), {"controller.K2": gain})
        run = ij.simulate(scenario, **RUN)
        return (run.e1**2).sum() + run.metrics["rmse"].sum()

    yield from arrays("gradient", jax.grad(loss)(np.array([3.0])))


def of_figures() -> Iterator[str]:
    """Those that no result has of its own, of runs in the plane and in space."""
    yield from drawn(ij.plotting.tube(loop(), duration=3.0))
    run = made_up(chain(2), duration=0.5)
    for figure in ij.plotting.paper_figures({"a": run, "b": run}, note="made up").values():
        yield from drawn(figure)
    for robot in (chain(2), Arm3D(3)):
        run = made_up(robot, duration=0.5)
        point = run.scenario.loop.plant.robot.skeleton(run.q[0])[-1]
        ball = ij.regions.Sphere(centre=point + 0.1, radius=0.15, keep="outside")
        wall = ij.regions.HalfSpace(normal=1.0 + 0.0 * point, offset=float(point.sum()) + 0.1)
        holder = dataclasses.replace(run.scenario, regions=(ball, wall))
        near = dataclasses.replace(run, scenario=holder, region_margin=run.q[:, :2])
        yield from drawn(ij.plotting.workspace(near))
    yield from drawn(ij.plotting.region_margins(near))


FLOWS: dict[str, Callable[[], Iterator[str]]] = {
    name.removeprefix("of_"): flow for name, flow in globals().items() if name.startswith("of_")
}

# ------------------------------------------------------------ results from files


def figures_of(result: Any) -> Iterator[Any]:
    """The figures of a result, or of a run of it."""
    if isinstance(result, ij.Study):
        yield ij.plotting.histograms(result)
        yield ij.plotting.scatter(result)
    elif isinstance(result, ij.Rollout):
        run = result[1] if result.is_batch else result
        pair = {"a": run, "b": made_up(chain(run.n), duration=0.05)}
        if run.x.shape[1] > 2:
            yield from (draw(run) for draw in OF_LEVELS)
            return
        yield from (draw(run) for draw in OF_RUNS)
        yield from (draw(pair) for draw in OF_PAIRS)
    elif hasattr(result, "plot"):
        yield result.plot()


OF_LEVELS = (ij.plotting.overview, ij.plotting.levels, ij.plotting.torques)
OF_PAIRS = (
    *(ij.plotting.positions, ij.plotting.velocities, ij.plotting.errors, ij.plotting.torques),
    *(ij.plotting.uncertain_terms, ij.plotting.velocity_errors, ij.plotting.phase_portrait),
)
OF_RUNS = (ij.plotting.overview, ij.plotting.velocity_portrait, ij.plotting.workspace)


def page_of(result: Any) -> Iterator[str]:
    """The report of a result without its figures, its scenario and its last line."""
    page = reports._page(reports.shown(result)._replace(figures={}), None)
    body = re.split("<body>|<h2>As a file|<footer>", page)[1]
    yield from re.split(r"(?=<(?:tr|h2|li|p)\b)", body.replace(LEFT, "<td left>"))


LEFT = '<td style="text-align:left">'


def of_file(name: str) -> Iterator[str]:
    result = stored(name)
    yield from printed(result)
    for figure in figures_of(result):
        yield from drawn(figure)
    if hasattr(result, "to_dict"):
        yield from arrays("dict", result.to_dict())
    yield from page_of(result)


FLOWS |= {
    path.stem: functools.partial(of_file, path.stem) for path in sorted(FOLDER.glob("*.result"))
}


@functools.cache
def lines_of(flow: str) -> tuple[str, ...]:
    """What a flow shows."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return tuple(FLOWS[flow]())


def stored_lines() -> dict[str, list[str]]:
    """Flow -> the lines of the file."""
    found: dict[str, list[str]] = {}
    for line in FILE.read_text(encoding="utf-8").splitlines():
        if line.startswith(HEADING):
            found[line.removeprefix(HEADING)] = rows = []
        else:
            rows.append(line)
    return found


def is_same(found: str, expected: str) -> bool:
    """Whether two lines are equal but for rounding: a sum to 5 digits, and all else as printed."""
    if " numbers, " in expected:
        return same_text(found, expected, digits=5)
    return same_row(found, expected)


@pytest.mark.parametrize(
    "flow", [pytest.param(x, marks=pytest.mark.slow) if x in SLOW else x for x in FLOWS]
)
def test_flow(flow):
    found, expected = lines_of(flow), stored_lines()[flow]
    pairs = zip(found, expected, strict=False)
    moved = [f"- {old}\n+ {new}" for new, old in pairs if not is_same(new, old)]
    assert not moved, "\n".join(moved)
    assert len(found) == len(expected)


def main() -> None:
    """Writes the file."""
    from conftest import choose_compilers

    choose_compilers(plain=True)
    rows = [row for flow in FLOWS for row in (HEADING + flow, *lines_of(flow))]
    FILE.write_text("\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
