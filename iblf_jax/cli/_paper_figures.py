"""The figures of the paper beside those of these runs: what the paper states about each of them,
what these runs show, and what differs.

The paper prints no table of its results, so that its figures can only be compared by its text and
its captions (section 4).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from iblf_jax.core import tables
from iblf_jax.plotting._curves import Peak, curves_of, peak_of
from iblf_jax.plotting._panels import PEAKS, peak_rows

if TYPE_CHECKING:
    from iblf_jax.cli._claims import PaperClaim
    from iblf_jax.simulation.results import Rollout


class FigureComparison(NamedTuple):
    """A figure of the paper and that of these runs."""

    number: int
    caption: str
    of_paper: str
    """What the paper's text states about the figure."""
    claims: tuple[int, ...]
    """Numbers of the claims, from 1, that check these statements."""
    differs: str
    """What differs in the figure of these runs."""


EVERY_FIGURE = (
    "The paper draws its law red, the log-BLF black, and the upper and lower bounds magenta and"
    " green. Here the laws are a solid blue and a dashed orange line, which differ without colour,"
    " and the bounds are grey. The paper enlarges a part of figures 1 and 2. Here a second column"
    " enlarges the start of figures 1 to 5, and its title states why that part ends where it does."
    " x11 is the position of joint 0 of this package, x12 that of joint 1. The comparison"
    " uses the paper's text and captions; the curves of its figures were not digitised."
)

COMPARISONS = (
    FigureComparison(
        1,
        "The trajectories of x11 and e11",
        "Both laws keep the bounds and track the reference; the proposed law converges faster, and"
        " the laws differ most in the initial stage.",
        (1, 2, 3, 4),
        "Reference, bounds, start and gains are those that the paper prints. The masses and"
        " lengths change e11 only through e21.",
    ),
    FigureComparison(
        2,
        "The trajectories of x12 and e12",
        "As figure 1, for the second joint.",
        (1, 2, 3, 4),
        "As figure 1.",
    ),
    FigureComparison(
        3,
        "The trajectories of e21 and e22",
        "The overshoot of the velocity error is greater under the proposed law in the initial"
        " stage.",
        (5,),
        "e2 at t = 0 follows from the printed start, bounds and gains; its decay depends on the"
        " assumed masses and lengths.",
    ),
    FigureComparison(
        4,
        "The uncertain terms",
        "The estimates tend to the uncertain terms quickly.",
        (6, 7),
        "By equation (4.3) the uncertain term is formed with the arm's matrices M0 and C0, so that"
        " its size depends on the assumed masses and lengths.",
    ),
    FigureComparison(
        5,
        "The control inputs",
        "The paper's text gives no value of the torque.",
        (),
        "The torque holds the weight of the arm, so that its size depends on the assumed masses and"
        " lengths.",
    ),
    FigureComparison(
        6,
        "The phase portrait of x11 and x12",
        "The trajectory converges to the circle more quickly under the proposed law, with a smaller"
        " error.",
        (3, 4),
        "As figures 1 and 2, of which it shows the same signals.",
    ),
)


def peaks_table(runs: Mapping[str, Rollout]) -> str:
    """The peaks of errors and torques of every joint, with their signs and times, as text."""
    rows: list[tuple[str, ...]] = [("peak of", "unit", "run", "joint", "value", "at [s]")]
    for curve in curves_of(runs):
        for name, unit, *rest in peak_rows(curve):
            rows.append((name, unit, curve.name, *rest))
    return "\n".join(tables.as_text(rows, left=(0, 1, 2, 3)))


def peaks(runs: Mapping[str, Rollout]) -> dict[str, dict[str, list[Peak | None]]]:
    """The peaks of errors and torques of every joint, by run and signal, for a file."""
    return {
        curve.name: {
            field: [peak_of(curve, field, [joint]) for joint in range(curve.run.n)]
            for field in PEAKS
        }
        for curve in curves_of(runs)
    }


def as_markdown(claims: Sequence[PaperClaim], peaks_text: str, assumption: str, remark: str) -> str:
    """The report: the assumption, the peaks, the claims, and the figures one by one.

    Args:
      claims: of `_claims.paper_claims`.
      peaks_text: of `peaks_table`.
      assumption: the numbers that the paper does not print.
      remark: on the comparison of the two laws.
    """
    numbered = []
    for i, claim in enumerate(claims, 1):
        verdict = "held" if claim.confirmed else "did not hold"
        numbered.append(f"{i}. {claim.claim} **{verdict}**: {claim.detail}")
    parts = [
        "# The simulation of Zhang & Yan (2024), section 4",
        f"**Assumed:** {assumption}",
        "## Peaks",
        "The values farthest from zero, with their signs.",
        f"```text\n{peaks_text}\n```",
        "## Claims",
        "\n".join(numbered),
        f"Remark: {remark}",
        "## Figures",
        EVERY_FIGURE,
        *map(_figure_section, COMPARISONS),
    ]
    return "\n\n".join(parts) + "\n"


def _figure_section(one: FigureComparison) -> str:
    """The section of a figure."""
    caption = f"Figure {one.number}. {one.caption}"
    checked = ""
    if one.claims:
        checked = f" Checked by claim {', '.join(map(str, one.claims))}."
    lines = [
        f"### {caption}",
        f"![{caption}](figure_{one.number}.png)",
        "The masses and lengths of the arm are assumed.",
        f"- The paper: {one.of_paper}{checked}\n- What differs: {one.differs}",
    ]
    return "\n\n".join(lines)
