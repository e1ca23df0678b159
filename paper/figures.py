"""Makes the figures of the article and checks its table: `python paper/figures.py [--check]`.

Without an option the figures are written beside this file.  With `--check` they are made in a
temporary folder, and the exit code is 1 if the table of `paper.md` is not that of
`benchmarks/results` or if `paper.md` shows a figure that this program does not make.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "benchmarks"))

import comparison

import iblf_jax as ij

SPREAD = 0.2
"""Of the masses of the arm, relative to those of the model."""


def bounds_figure() -> Figure:
    """Positions between their bounds and errors, for arms with other masses than the model."""
    scenario = ij.presets.zhang_yan_2024(variant="corrected")
    factors = (1.0, 1.0 - SPREAD, 1.0 + SPREAD)
    runs = [ij.simulate(heavier(scenario, factor), duration=10.0, dt=1e-3) for factor in factors]
    figure, axes = plt.subplots(1, 3, figsize=(11.0, 3.2), layout="constrained")
    for joint, panel in enumerate(axes[:2]):
        panel.plot(runs[0].t, runs[0].lower[:, joint], "0.5", label="bounds")
        panel.plot(runs[0].t, runs[0].upper[:, joint], "0.5")
        panel.plot(runs[0].t, runs[0].q_d[:, joint], "k:", label="reference")
        panel.plot(runs[0].t, runs[0].q[:, joint], label="position")
        panel.set(xlabel="time $t$ [s]", ylabel=f"$q_{joint + 1}$ [rad]")
    axes[0].legend(fontsize="x-small", loc="upper right")
    for factor, run in zip(factors, runs, strict=True):
        error = 1e3 * np.max(np.abs(np.asarray(run.e1)), axis=1)
        axes[2].semilogy(run.t, error, label=f"{factor:g} times the model's masses")
    axes[2].set(xlabel="time $t$ [s]", ylabel="larger $|e_1|$ of both joints [mrad]")
    axes[2].legend(fontsize="x-small")
    return figure


def heavier(scenario: ij.Scenario, factor: float) -> ij.Scenario:
    """The scenario with other masses of the plant; the law keeps its model."""
    masses = factor * np.asarray(scenario.plant.mass)
    return ij.with_parameters(scenario, {"plant.mass": masses})


def readings_figure() -> Figure:
    """V2 under the law as printed and as corrected, at gains that satisfy the conditions."""
    figure, axes = plt.subplots(figsize=(5.0, 3.0), layout="constrained")
    for variant in ("printed", "corrected"):
        run = ij.simulate(ij.presets.printed_gap(variant=variant), duration=0.1, dt=1e-5)
        axes.plot(1e3 * np.asarray(run.t), run.V, label=variant)
    axes.set(xlabel="time $t$ [ms]", ylabel="$V_2$")
    axes.legend(title="variant")
    return figure


FIGURES = {
    "bounds.png": bounds_figure,
    "readings.png": readings_figure,
}


def write(folder: Path) -> None:
    """Makes all figures."""
    for name, make in FIGURES.items():
        make().savefig(folder / name, dpi=200)
        print(folder / name)
    plt.close("all")


def faults() -> list[str]:
    """What is wrong with the article."""
    text = (HERE / "paper.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"!\[.*?\]\((\S+?\.png)\)", text, re.DOTALL))
    found = [f"paper.md shows {name}, which is not made" for name in shown - set(FIGURES)]
    found += [f"paper.md does not show {name}" for name in set(FIGURES) - shown]
    if comparison.replaced(text) != text:
        found.append("paper.md has another table: run python benchmarks/comparison.py --write")
    return found


def main() -> int:
    """Writes or checks."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--check", action="store_true")
    if not parser.parse_args().check:
        write(HERE)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder))
    found = faults()
    print("\n".join(found))
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
