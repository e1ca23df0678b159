"""Digests of programs: equal ones compute the same."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.core.program_digest import CallsPythonError, program_digest

TABLE = np.linspace(0.0, 1.0, 2000)


def looked_up(table):
    """A function whose only difference is an entry in the middle of a long table."""
    return lambda x: jnp.interp(x, jnp.arange(2000.0), table)


def scaled(factor):
    return lambda x: jax.lax.fori_loop(0, 3, lambda i, y: y * factor, x)


def with_rule(factor):
    """A function with a rule of its own, which the derivative reads."""

    @jax.custom_jvp
    def square(x):
        return x * x

    square.defjvp(lambda primals, tangents: (square(*primals), factor * tangents[0]))
    return jax.grad(square)


CASES = {
    "a table": (looked_up(TABLE), looked_up(TABLE + 1e-12 * (np.arange(2000) == 1000))),
    "a number in a loop": (scaled(2.0), scaled(2.0 + 1e-15)),
    "the sign of a zero": (lambda x: jnp.arctan2(0.0, x), lambda x: jnp.arctan2(-0.0, x)),
    "a rule of differentiation": (with_rule(2.0), with_rule(3.0)),
    "a captured array of JAX": (
        lambda x: x + jnp.asarray(TABLE)[3:5],
        lambda x: x + jnp.asarray(TABLE)[4:6],
    ),
}


def digest(function, x=1.0):
    return program_digest(jax.jit(function).trace(x))


@pytest.mark.parametrize("case", CASES)
def test_programs_that_differ_have_two_digests(case):
    one, other = CASES[case]
    assert digest(one) != digest(other)
    assert digest(one) == digest(one)


CALLS = {
    "pure_callback": lambda x: jax.pure_callback(np.sin, x, x),
    "debug_callback": lambda x: (jax.debug.callback(print, x), x)[1],
    "debug_print": lambda x: (jax.debug.print("{x}", x=x), x)[1],
}


@pytest.mark.parametrize("call", CALLS)
def test_a_program_that_calls_python_has_no_digest(call):
    with pytest.raises(CallsPythonError, match=r"callback|debug_print"):
        digest(lambda x: jax.lax.cond(x > 0, CALLS[call], lambda x: x, x), jnp.ones(()))


def digest_of_a_run() -> str:
    scenario = ij.presets.zhang_yan_2024()

    def tau(k1):
        changed = ij.with_parameters(scenario, {"controller.k1": k1})
        return ij.simulate(changed, duration=0.02, dt=1e-3).tau

    return digest(tau)


@pytest.mark.slow
def test_two_processes_agree():
    environment = os.environ | {"PYTHONHASHSEED": "1", "JAX_ENABLE_X64": "1"}
    command = [sys.executable, __file__]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    assert len(done.stdout.strip()) == 64 and done.stdout.strip() == digest_of_a_run()


if __name__ == "__main__":
    print(digest_of_a_run())
