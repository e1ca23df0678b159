"""`reproduce`: runs the paper's simulation, draws its six figures and checks its claims."""

from __future__ import annotations

import argparse
import textwrap
import time
from typing import TYPE_CHECKING, Any

from iblf_jax.cli._common import output_folder, status_and_metrics, write_json

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from iblf_jax.cli._claims import PaperClaim
    from iblf_jax.simulation.results import Rollout

NAMES = {"integral": "integral BLF", "log": "log-BLF"}
"""Law of the preset -> name of the run in tables, figures and files."""


HELP = "reproduce the paper's simulation and its six figures"
DESCRIPTION = (
    "Run the paper's law (integral barrier) and its comparison (log barrier), write the six"
    " figures, an animation of the arm, a report, the data and the metrics, and report which of"
    " the paper's claims hold. The paper prints no masses and lengths of its arm; the runs"
    " assume values, and the output, the report and the figures state them."
)
EPILOG = "Source: T. Zhang, P. Yan, AIMS Mathematics 9(1) (2024) 319-339."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    parser.add_argument(
        "--out", required=True, metavar="DIR", help="write everything into this folder"
    )
    parser.add_argument(
        "--variant",
        choices=("printed", "corrected"),
        default="printed",
        help=(
            "the law and observer as printed, or corrected so that Theorem 2 is exact (default:"
            " printed)"
        ),
    )
    parser.add_argument(
        "--duration",
        type=float,
        default=20.0,
        metavar="S",
        help="length of the run [s] (default: 20, the paper's)",
    )
    parser.add_argument(
        "--dt", type=float, default=1e-3, metavar="S", help="time step [s] (default: 0.001)"
    )


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.cli._claims import assumed, assumed_briefly, remark
    from iblf_jax.cli._paper_figures import as_markdown, peaks, peaks_table
    from iblf_jax.core.status import FAILED, describe, has_flag
    from iblf_jax.reports import metrics_table

    begin = time.perf_counter()
    folder = output_folder(args.out)
    runs, seconds = _simulate_both(args)
    print(
        f"Zhang & Yan 2024, section 4, as {args.variant}: {args.duration:g} s, dt = {args.dt:g} s,"
        " rk4, float64"
    )
    print("; ".join(f"{name}: {describe(int(one.status))}" for name, one in runs.items()) + "\n")
    assumption = assumed(runs)
    print(textwrap.fill(f"Assumed: {assumption}", 118) + "\n")
    print(*metrics_table(runs).lines(), "", sep="\n")
    claims = check_claims(runs)
    note = remark(runs)
    peaks_text = peaks_table(runs)
    print(
        "Peaks with their signs; the metrics peak_error and peak_torque are absolute values\n"
        f"{peaks_text}\n"
    )
    print("The claims of the paper, and what these runs show")
    for i, claim in enumerate(claims, 1):
        verdict = "HELD" if claim.confirmed else "DID NOT HOLD"
        print(f"{i}. {verdict:12}  {claim.claim}")
        print(textwrap.fill(claim.detail, 118, initial_indent=" " * 5, subsequent_indent=" " * 5))
    print(textwrap.fill(f"Remark: {note}", 118))
    findings = {"assumed": assumption, "peaks": peaks(runs), "claims": claims, "remark": note}
    _write_data(folder, args, runs, findings, seconds)
    report = as_markdown(claims, peaks_text, assumption, note)
    (folder / "report.md").write_text(report, encoding="utf-8")
    _draw(folder, runs, assumed_briefly(runs))
    print(
        f"\nsimulations: {seconds['first']:.2f} s with compilation, {seconds['again']:.2f} s"
        f" without compilation; the whole command: {time.perf_counter() - begin:.1f} s"
    )
    print(
        f"written to {folder}: report.md, figure_1 ... figure_6 (.png, .pdf), arm.gif,"
        " rollouts.nc, metrics.json"
    )
    return int(any(has_flag(int(one.status), FAILED) for one in runs.values()))


def _simulate_both(args: argparse.Namespace) -> tuple[dict[str, Rollout], dict[str, float]]:
    """Simulates both laws twice; returns the runs and the seconds of each pass.

    The first pass compiles, so that only the second one measures the cost of the runs.
    """
    import jax

    from iblf_jax.engine.simulate import simulate
    from iblf_jax.presets import zhang_yan_2024

    def both() -> tuple[dict[str, Rollout], float]:
        start = time.perf_counter()
        runs = {
            name: simulate(
                zhang_yan_2024(law=law, variant=args.variant), duration=args.duration, dt=args.dt
            )
            for law, name in NAMES.items()
        }
        jax.block_until_ready(runs)
        return runs, time.perf_counter() - start

    runs, first = both()
    return runs, {"first": first, "again": both()[1]}


def check_claims(runs: Mapping[str, Rollout]) -> list[PaperClaim]:
    """The claims of the paper, each with the verdict and the numbers of two runs.

    Args:
      runs: two runs by name, of the integral and the logarithmic law, in this order.
    """
    from iblf_jax.cli._claims import paper_claims

    return paper_claims(runs)


def _write_data(
    folder: Path,
    args: argparse.Namespace,
    runs: dict[str, Rollout],
    findings: dict[str, Any],
    seconds: dict[str, float],
) -> None:
    import jax

    import iblf_jax
    from iblf_jax.files.rollouts import save_rollouts

    save_rollouts(runs, folder / "rollouts.nc")
    report: dict[str, Any] = {
        "source": "Zhang & Yan 2024, section 4",
        "run": {"variant": args.variant, "duration": args.duration, "dt": args.dt, "method": "rk4"},
        "versions": {"iblf_jax": iblf_jax.__version__, "jax": jax.__version__},
        "runs": {name: status_and_metrics(one) for name, one in runs.items()},
        "assumed": findings["assumed"],
        "peaks": {
            run: {
                signal: [peak and peak._asdict() for peak in peaks]
                for signal, peaks in signals.items()
            }
            for run, signals in findings["peaks"].items()
        },
        "claims": [claim._asdict() for claim in findings["claims"]],
        "remark": findings["remark"],
        "seconds": {"with compilation": seconds["first"], "the two runs alone": seconds["again"]},
    }
    write_json(folder / "metrics.json", report)


def _draw(folder: Path, runs: dict[str, Rollout], note: str) -> None:
    from iblf_jax import plotting

    plotting.save(plotting.paper_figures(runs, note=note), folder, formats=("png", "pdf"))
    plotting.animate(runs, folder / "arm.gif", note=note)
