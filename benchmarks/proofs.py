"""Proofs of invariant level sets: verdict, boxes and seconds of `ij.prove`.

    python benchmarks/proofs.py [--quick] [--json FILE] [--boxes 1e9] [--only WORDS]

The two-link arm and the reference of Zhang & Yan 2024 without disturbance, if the row does not say
otherwise.  "masses" are masses and moments of inertia, those of each link with a factor of its own.
The seconds are those of the whole call with a compiled kernel: each case is proved twice.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from _timing import report

import iblf_jax as ij

COLUMNS = [
    *("case", "K2", "kf", "level", "parameters"),
    *("verdict", "boxes", "expected boxes", "share", "seconds", "largest torque [N m]"),
]
MASSES = "plant.mass, plant.inertia"


class Case(NamedTuple):
    """One call of `prove`."""

    name: str
    K2: float
    kf: float
    level: float
    parameters: str
    uncertain: dict[str, Any]
    weight: float
    scenario: Callable[[], ij.Scenario]
    limits: tuple[float, ...] | None = None
    """Of the torque of each joint [N m]; None without limits."""


def percent(path: str, width: float, *, shared: bool = False) -> dict[str, Any]:
    """A relative interval of a width in per cent."""
    interval = ij.interval(1.0 - 0.01 * width, 1.0 + 0.01 * width)
    return {path: ij.factor(interval, shared=shared)}


def two_links() -> ij.Scenario:
    """The paper's loop, corrected, without disturbance."""
    return dataclasses.replace(disturbed(), disturbance=ij.disturbances.Nothing())


def sampled(period: float) -> Callable[[], ij.Scenario]:
    """The same loop with a held torque."""
    sampling = ij.Sampling(period=period, observer="poles")
    return lambda: dataclasses.replace(two_links(), sampling=sampling)


def disturbed() -> ij.Scenario:
    """The paper's loop, corrected."""
    return ij.presets.zhang_yan_2024(variant="corrected")


def chain(joints: int) -> ij.Scenario:
    """A planar arm of equal links on a slow sine between constant bounds."""
    robot = ij.robots.PlanarChain(
        mass=[2.0, 0.85, 0.4][:joints],
        length=[0.35, 0.31, 0.25][:joints],
        centre=[0.175, 0.155, 0.125][:joints],
        inertia=[0.06125, 0.02042125, 0.00625][:joints],
    )
    middle = [0.5] * joints
    return ij.Scenario(
        plant=robot,
        reference=ij.references.Sinusoid(offset=middle, amplitude=[0.14] * joints, frequency=1.0),
        bounds=ij.Bounds(
            lower=ij.bounds.Constant([0.0] * joints), upper=ij.bounds.Constant([1.0] * joints)
        ),
        controller=ij.controllers.Backstepping(k1=2.0, K2=3.0, variant="corrected"),
        observer=ij.observers.Momentum(kf=100.0),
        initial=ij.Initial(q=middle, dq=[0.0] * joints),
    )


def one_link() -> ij.Scenario:
    return chain(1)


def three_links() -> ij.Scenario:
    return chain(3)


def pairs(*cases: tuple[float, float, float, float, float]) -> list[Case]:
    """Cases with an interval of the masses: K2, kf, level, per cent, weight."""
    return [
        Case(
            "two links", K2, kf, level, f"masses {width:g} %", percent(MASSES, width), w, two_links
        )
        for K2, kf, level, width, w in cases
    ]


QUICK = Case("one link", 3.0, 100.0, 1.0, "masses 3 %", percent(MASSES, 3.0), 3e-3, one_link)
PAYLOAD = {"plant.payload": ij.value(ij.interval(0.0, 0.01))}
CASES = [
    QUICK,
    *pairs(
        (3.0, 100.0, 1.0, 1.0, 2e-3),
        (3.0, 100.0, 1.0, 2.0, 2e-3),
        (3.0, 100.0, 1.0, 3.0, 2e-3),
        (3.0, 100.0, 1.0, 4.0, 2e-3),
        (10.0, 200.0, 1.0, 1.0, 2e-3),
        (5.0, 60.0, 0.5, 1.0, 3e-3),
        (5.0, 60.0, 0.5, 2.0, 3e-3),
        (20.0, 20.0, 0.5, 0.02, 2e-3),
        (20.0, 20.0, 0.5, 0.05, 2e-3),
        (20.0, 20.0, 0.5, 0.1, 2e-3),
        (20.0, 20.0, 0.5, 0.2, 2e-3),
        (20.0, 20.0, 0.5, 0.3, 2e-3),
    ),
    *[
        Case(
            "two links, the paper's disturbance", 10.0, 200.0, level, "masses 1 %",
            percent(MASSES, 1.0), 2e-3, disturbed,
        )
        for level in (1.0, 2.28)
    ],
    Case(
        "two links", 3.0, 100.0, 1.0, "masses 1 %, both centres of mass 1 %",
        percent(MASSES, 1.0) | percent("plant.centre", 1.0, shared=True), 2e-3, two_links,
    ),
    Case(
        "two links", 3.0, 100.0, 1.0, "all masses 1 %, payload 0 to 10 g",
        percent(MASSES, 1.0, shared=True) | PAYLOAD, 2e-3, two_links,
    ),
    *[
        Case(
            f"two links, sampled every {1e3 * period:g} ms", 3.0, 100.0, 0.1, "masses 1 %",
            percent(MASSES, 1.0), 3e-3, sampled(period),
        )
        for period in (0.5e-3, 1e-3)
    ],
    Case(
        "two links, torque limited to 42 and 41 N m", 3.0, 100.0, 1.0, "masses 1 %",
        percent(MASSES, 1.0), 3e-3, two_links, (42.0, 41.0),
    ),
    Case(
        "three links", 3.0, 100.0, 0.5, "all masses 1 %",
        percent(MASSES, 1.0, shared=True), 2e-3, three_links,
    ),
]  # fmt: skip


def row(case: Case, boxes: int) -> list[Any]:
    gains = {"controller.K2": case.K2, "observer.kf": case.kf}
    scenario = ij.with_parameters(case.scenario(), gains)
    if case.limits is not None:
        law = ij.controllers.Saturated(scenario.controller, limit=list(case.limits))
        scenario = dataclasses.replace(scenario, controller=law)

    def prove(most: int) -> ij.Proof:
        return ij.prove(
            scenario,
            level=case.level,
            parameters=case.uncertain,
            weight=case.weight,
            max_boxes=most,
            progress=False,
        )

    prove(5000)  # compiles
    proof = prove(boxes)
    expected, _ = proof.expected_boxes or (float("nan"), 0.0)
    torque = ""
    if proof.torque is not None and proof.torque.is_proved:
        torque = ", ".join(f"{size:.3g}" for size in proof.torque.largest)
    return [
        case.name,
        case.K2,
        case.kf,
        case.level,
        case.parameters,
        str(proof.verdict),
        proof.boxes,
        float(f"{expected:.2g}"),
        round(float(proof.done), 4),
        round(proof.seconds, 2),
        torque,
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json")
    parser.add_argument("--boxes", type=float, default=1e9, help="largest number of boxes")
    parser.add_argument("--only", default="", help="only cases whose name and parameters have this")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    cases = [QUICK] if args.quick else CASES
    chosen = [case for case in cases if args.only in f"{case.name}, {case.parameters}"]
    rows = [row(case, int(args.boxes)) for case in chosen]
    report("Proofs of invariant level sets", COLUMNS, rows, args.json)


if __name__ == "__main__":
    main()
