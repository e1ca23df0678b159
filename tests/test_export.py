"""Laws out of Python: the C of every law and observer against JAX, and what a folder holds."""

from __future__ import annotations

import shutil
import subprocess

import jax
import jax.numpy as jnp
import members
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.deployment.control_law import Told, control_law, sample, start
from iblf_jax.deployment.write_c import CHECKED, Law, Vectors, written
from iblf_jax.simulation.scenario import canonical

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wconversion")
SANE = ("-g", "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover")
SAMPLES = 40


def built_and_run(folder, *flags, name="iblf_law", compiler=("gcc",)):
    """What the self-test of a folder prints, built with these flags."""
    command = [*compiler, *STRICT, *flags, f"{name}.c", "selftest.c", "-lm", "-o", "selftest"]
    made = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    ran = subprocess.run(["./selftest"], cwd=folder, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def walk(scenario, dtype, seed=0):
    """Positions and velocities that wander in the tube and touch its bounds."""
    rng = np.random.default_rng(seed)
    t = jnp.asarray(np.arange(SAMPLES) * 1e-3, dtype)
    tube = jax.vmap(scenario.setting.tube)(t)
    share = 0.5 + 0.6 * np.cumsum(rng.normal(size=(SAMPLES, scenario.n)), axis=0) / np.sqrt(SAMPLES)
    q = jnp.asarray(tube.lower + share * (tube.upper - tube.lower), dtype)
    return Told(t, q, jnp.asarray(0.3 * rng.normal(size=q.shape), dtype)), tube


@pytest.fixture(scope="module")
def base():
    scenario = ij.with_parts(ij.presets.zhang_yan_2024(), sampling=ij.Sampling(1e-3), velocity_bounds=ij.Bounds(ij.bounds.Constant(-2.0), ij.bounds.Constant(2.5)))
    return scenario


CASES = [(law, "momentum") for law in members.LAWS] + [("backstepping", observer) for observer in members.OBSERVERS]


def against_jax(folder, scenario, *, told_reference=False, dtype="float64"):
    """Writes a law with its answers to a random walk as vectors, and runs its self-test under the sanitizers."""
    scenario = canonical(ij.astype(scenario, dtype))
    asked, tube = walk(scenario, dtype)
    if told_reference:
        asked = Told(*asked[:3], tube.q_d, tube.dq_d, tube.ddq_d)
    first = jax.tree.map(lambda x: x[0], asked)

    def answers(scenario, first, asked):
        def one(memory, told):
            memory, said = sample(scenario, told, memory)
            return memory, said.tau

        return jax.lax.scan(one, start(scenario, first)[0], asked)[1]

    tau = np.asarray(jax.jit(answers)(scenario, first, asked))[::CHECKED]
    rows = [np.asarray(x) for x in asked[1:] if not isinstance(x, tuple)]
    vectors = Vectors(tuple(x[0] for x in rows), rows[0], rows[1], tuple(rows[2:]), tau)
    law = Law(scenario, control_law(scenario, told_reference), "iblf_law", told_reference, vectors, (), None)
    made = written(law)
    folder.mkdir(exist_ok=True)
    for name, text in made.files.items():
        (folder / name).write_text(text)
    print(built_and_run(folder, *SANE))
    return made


@pytest.mark.parametrize(("law", "observer"), CASES)
def test_every_law_and_observer_gives_in_c_what_it_gives_in_jax(base, tmp_path, law, observer):
    against_jax(tmp_path, ij.with_parts(base, controller=members.LAWS[law], observer=members.OBSERVERS[observer]))
