"""What a step of a run costs, and what a first call compiles, in counts: they are exact, where
seconds would flicker.

`tests/data/costs.json` holds them.  After a change that is meant to move them,

    python tests/engine/test_costs.py

writes the file anew; the difference is what the change costs or gains.  Operations are those of one
release of JAX, which the file names: another one may write a derivative otherwise (that of a
  maximum did in 0.12).
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import jax
import pytest

import iblf_jax as ij
from iblf_jax import barriers, bounds, controllers, observers, references
from iblf_jax.kernels import cpu

FILE = Path(__file__).parents[1] / "data" / "costs.json"
JAX = ".".join(jax.__version__.split(".")[:2])


def planar_chain(n: int) -> ij.Scenario:
    """n equal links, each joint with the paper's kind of path and gains."""
    return ij.Scenario(
        plant=ij.robots.PlanarChain(
            mass=[1.0] * n, length=[0.3] * n, centre=[0.15] * n, inertia=0.02
        ),
        reference=references.Sinusoid(offset=[0.5] * n, amplitude=0.14, frequency=1.0),
        bounds=bounds.Bounds(lower=bounds.Constant(0.1), upper=bounds.Constant(0.9)),
        controller=controllers.Backstepping(k1=2.0, K2=20.0, o=0.1, barrier=barriers.Integral()),
        observer=observers.Momentum(kf=20.0),
        initial=ij.Initial(q=[0.6] * n, dq=0.0),
    )


SCENARIOS = {
    f"zhang_yan_2024, {law}": lambda law=law: ij.presets.zhang_yan_2024(law=law)
    for law in ij.presets.LAWS
}
PLANTS = ("motor_driven_pendulum", "flexible_joint_two_link", "vessel")
"""Presets without a mass of a robot at "plant.mass[1]"; their runs differ in their start only."""
COUNTED = ("zhang_yan_2024_full_state", "zhang_yan_2024_saturated", "iiwa14", *PLANTS)
"""Presets whose programs differ from those of all others by more than numbers or joints."""
SCENARIOS |= {name: ij.presets.PRESETS[name] for name in COUNTED}
SCENARIOS["planar chain of 12"] = lambda: planar_chain(12)


def step_counts(name: str) -> dict[str, dict[str, int]]:
    """How often -> operation -> how many in a step of Runge-Kutta with the standard metrics, where
    runs differ in start and, where a robot is the plant, in a mass."""
    varied = "initial.q" if name in PLANTS else "plant.mass[1]"
    counts = ij.explain(SCENARIOS[name](), varied=[varied]).counts
    return {often: dict(sorted(counter.items())) for often, counter in counts.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_operations_of_a_step(name):
    table = json.loads(FILE.read_text())
    if table["jax"] != JAX:
        pytest.skip(f"counted with jax {table['jax']}")
    # If a change is intended, `python tests/engine/test_costs.py` writes the file anew.
    assert step_counts(name) == table["a step"][name]


CALLS = {
    "certify": lambda paper: ij.certify(paper, **SHORT),
    "tune": lambda paper: (
        ij.tune(
            paper, ["controller.K2"], ij.objectives.tracking(), progress=False, **EFFORT, **SHORT
        ).report
    ),
}
"""First calls of `simulate` and `monte_carlo` are timed by `benchmarks/losses.py`."""
EFFORT = {"effort": ij.tuning.Effort(iterations=2)}
SHORT = {"duration": 0.1, "dt": 1e-3}
OPERATION = re.compile(r"^\s*(?:%\S+ = )?\"?(?:stablehlo|chlo|func\.call|call)\b", re.MULTILINE)
SLACK = 1.02
"""A bound is what was counted and a little more: a release of JAX may write a function of its own
otherwise."""


def count_of(call: str) -> dict[str, int]:
    """What a first call makes, in this process, which must be a fresh one."""
    traced, sources = [], []
    mass_matrix, built = ij.robots.TwoLink.mass_matrix, cpu.built

    def counted_matrix(self, q):
        traced.append(q.shape)
        return mass_matrix(self, q)

    def counted_source(source, *args, **kwargs):
        sources.append(source)
        return built(source, *args, **kwargs)

    paper = ij.presets.zhang_yan_2024()
    with tempfile.TemporaryDirectory() as folder:
        jax.config.update("jax_dump_ir_to", folder)
        ij.robots.TwoLink.mass_matrix, cpu.built = counted_matrix, counted_source
        CALLS[call](paper)
        programs = [path.read_text() for path in Path(folder).glob("*.mlir")]
    return {
        "mass matrices traced": len(traced),
        "programs for XLA": len(programs),
        "operations in them": sum(len(OPERATION.findall(text)) for text in programs),
        "characters of C": sum(map(len, sources)),
    }


def in_a_fresh_process(call: str) -> dict[str, int]:
    command = [sys.executable, __file__, call]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=280)
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize("call", CALLS)
def test_what_a_first_call_compiles(call):
    found, most = in_a_fresh_process(call), json.loads(FILE.read_text())["a first call"][call]
    over = {what: (n, most[what]) for what, n in found.items() if n > SLACK * most[what]}
    assert not over, f"{call}: {over} (counted, counted in {FILE.name})"
    assert min(found["mass matrices traced"], found["operations in them"]) > 0


def as_text(table: dict[str, Any]) -> str:
    rows = []
    for name in ("a step", "a first call"):
        lines = [f"  {json.dumps(key)}: {json.dumps(x)}" for key, x in table[name].items()]
        rows.append(f" {json.dumps(name)}: {{\n" + ",\n".join(lines) + "\n }")
    return "{\n" + ",\n".join([f' "jax": {json.dumps(table["jax"])}', *rows]) + "\n}\n"


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(count_of(sys.argv[1])))
    else:
        table = {
            "jax": JAX,
            "a step": {x: step_counts(x) for x in SCENARIOS},
            "a first call": {x: in_a_fresh_process(x) for x in CALLS},
        }
        FILE.write_text(as_text(table))
