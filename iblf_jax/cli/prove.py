"""`prove`: decides whether a level set is invariant for all parameters of a box."""

from __future__ import annotations

import argparse
from typing import Any

HELP = "prove that a set of states is invariant for all parameters of a box"
DESCRIPTION = (
    "Decide by interval arithmetic whether every run that starts in {V_w <= level} stays in it, for"
    " all times and all parameters of a box; print the verdict, and what was proved or found."
)
EPILOG = (
    "Exit codes: 0 proved; 1 not proved, refuted or undecided; 2 bad arguments or files; 130"
    " interrupted."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    from iblf_jax.cli._common import add_scenario_arguments

    add_scenario_arguments(parser)
    parser.add_argument(
        "--level",
        type=float,
        metavar="C",
        help="level of V_w, in its unit (default: one whose set contains the start of a robot)",
    )
    parser.add_argument(
        "--parameter",
        action="append",
        default=[],
        metavar="PATH=KIND:LOW:HIGH",
        help=(
            "an uncertain parameter, such as plant.mass=factor:0.97:1.03; KIND is factor, offset or"
            " value; may be repeated"
        ),
    )
    parser.add_argument(
        "--weight",
        type=float,
        metavar="W",
        help="weight of the estimation error (default: searched)",
    )
    parser.add_argument(
        "--duration",
        type=float,
        metavar="S",
        help="length of the time interval [s] (default: a period)",
    )
    parser.add_argument(
        "--disturbance-rate",
        type=float,
        metavar="D",
        help="bound of the rate of a further disturbance [N m/s] (default: none)",
    )
    parser.add_argument("--max-boxes", type=float, metavar="N", help="boxes (default: 1e9)")
    parser.add_argument("--threads", type=int, metavar="N", help="threads (default: processors)")
    parser.add_argument(
        "--checkpoint", metavar="FILE", help="file from which an interrupted search continues"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="seed of the points (default: 0)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--out", metavar="FILE.html", help="write a report with the figure")


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from iblf_jax.cli._common import given_options, scenario_of
    from iblf_jax.core import checks
    from iblf_jax.proofs import prove
    from iblf_jax.reports import report

    names = ("weight", "duration", "disturbance_rate", "threads", "checkpoint", "seed")
    options: dict[str, Any] = given_options(args, *names)
    if args.max_boxes is not None:
        if not args.max_boxes.is_integer():
            raise checks.fail("--max-boxes", args.max_boxes, "a whole number, such as 1e8")
        options["max_boxes"] = int(args.max_boxes)
    found = prove(
        scenario_of(args).scenario,
        level=args.level,
        parameters=perturbations(args.parameter),
        progress=False if args.quiet else None,
        **options,
    )
    print(found)
    if args.out:
        print(f"\nwritten to {report(found, args.out)}")
    return int(not found.proved)


def perturbations(words: list[str]) -> dict[str, Any]:
    """The PATH=KIND:LOW:HIGH words as path -> perturbation by an interval."""
    from iblf_jax.core import checks
    from iblf_jax.studies.distributions import factor, interval, offset, value

    kinds = {"factor": factor, "offset": offset, "value": value}
    found = {}
    for word in words:
        path, _, text = word.rpartition("=")
        kind, *ends = text.split(":")
        try:
            low, high = map(float, ends)
            make = kinds[kind.strip()]
        except (KeyError, ValueError):
            expected = "PATH=KIND:LOW:HIGH, such as plant.mass=factor:0.97:1.03"
            raise checks.fail("--parameter", word, expected) from None
        found[path.strip()] = make(interval(low, high))
    return found
