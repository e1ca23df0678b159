"""Joint limits by barrier functions (Shaw Cortez & Dimarogonas 2022): a safety filter around a law
that violates its bounds, compared with the authors' data. The reference leaves the bounds on
purpose.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij
from iblf_jax.files.scenario import load_scenario_file

here = Path(__file__)
scenario, options = load_scenario_file(here.with_name("scenario.toml"))
constraints = {"1.5 rad/s less |q'| [rad/s]": lambda t, x: 1.5 - abs(x[1])}
run = ij.simulate(scenario, **options)
wide = ij.Bounds(lower=ij.bounds.Constant(-9.0), upper=ij.bounds.Constant(9.0))
unfiltered = ij.simulate(
    ij.with_parts(scenario, controller=scenario.controller.law, bounds=wide), **options
)
runs = {"filtered": run, "without filter": unfiltered}
published = np.loadtxt(here.with_name("published.csv"), delimiter=",", skiprows=1)
lower, upper = scenario.bounds[0].lower.value, scenario.bounds[0].upper.value
figure, axes = plt.subplots(2, 2, figsize=(9, 5.0), sharex=True, layout="constrained")
for joint, (above, below) in enumerate(axes.T):
    above.plot(unfiltered.t, unfiltered.q[:, joint], color="0.7", label="without filter")
    above.plot(run.t, run.q[:, joint], label="filtered")
    above.plot(
        published[:, 0],
        published[:, 1 + joint],
        "o",
        markersize=4,
        fillstyle="none",
        label="the authors' data",
    )
    below.plot(unfiltered.t, unfiltered.dq[:, joint], color="0.7")
    below.plot(run.t, run.dq[:, joint])
    for panel, limits in ((above, (lower[joint], upper[joint])), (below, (-1.5, 1.5))):
        for limit in limits:
            panel.axhline(float(limit), color="k", linestyle=":", linewidth=0.8)
    above.set(title=f"joint {joint}", ylabel="position $q$ [rad]")
    below.set(xlabel="time $t$ [s]", ylabel=r"velocity $\dot q$ [rad/s]")
figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)


# %% Comparison with the data of the repository, and with the output of the published program.
def distance(run, columns):
    """The largest distance of the positions from columns of the file [rad]."""
    at = published[:, 0]
    return max(
        float(np.abs(np.interp(at, run.t, run.q[:, i]) - published[:, column]).max())
        for i, column in enumerate(columns)
    )


DATA, PROGRAM = (1, 2), (3, 4)
arm = ij.with_parameters(scenario, {"plant.inertia[0]": 1 / 12, "model.inertia[0]": 1 / 12})
without_term = ij.simulate(arm, **options)
reached = {
    "largest distance from the output of the program [rad]": distance(run, PROGRAM),
    "largest distance from the published data [rad]": distance(run, DATA),
}
evidence = {
    "with_term": distance(run, PROGRAM),
    "without_term": distance(without_term, PROGRAM),
}
print(reached | evidence)


def within(run):
    """Whether positions, velocities and torques of a run satisfy their limits, three answers."""
    inside = (run.q > lower) & (run.q < upper)
    limits = np.array([18.0, 10.0])
    return [
        bool(np.all(inside)),
        bool(np.all(np.abs(run.dq) < 1.5)),
        bool(np.all(np.abs(run.tau) <= limits)),
    ]


holds = {
    "with the filter, positions, velocities and torques satisfy their limits": all(within(run)),
    "without the filter, positions, velocities and torques violate their limits": not any(
        within(unfiltered)
    ),
}
for name, one in runs.items():
    print(
        f"{name}: {ij.Status(int(one.status))!r}, q from {one.q.min(axis=0).round(2)} to", end=" "
    )
    print(f"{one.q.max(axis=0).round(2)} rad, largest |q'| {np.abs(one.dq).max(axis=0).round(3)}")
    print(f"   rad/s, largest |tau| {np.abs(one.tau).max(axis=0).round(2)} N m")
