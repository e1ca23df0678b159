"""The bounds at a time as a function of the exported C, against the scenario's own."""

from __future__ import annotations

import ctypes
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.deployment.control_law import bounds_at, inputs_at_start
from iblf_jax.simulation.scenario import canonical

PERIOD = 0.01


def bounds_of_c(folder, size, t, *reference):
    """The bounds of the law in a folder at a time."""
    command = ["cc", "-std=c99", "-shared", "-fPIC", "iblf_law.c", "-lm", "-o", "law.so"]
    subprocess.run(command, cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "law.so"))
    lower, upper = (np.empty(size) for _ in range(2))
    pointers = [np.ascontiguousarray(x, float) for x in (*reference, lower, upper)]
    pointers[-2:] = lower, upper
    defaults = ctypes.c_char.in_dll(library, "iblf_law_defaults")
    arguments = [ctypes.c_void_p(x.ctypes.data) for x in pointers]
    library.iblf_law_bounds.restype = None
    library.iblf_law_bounds(ctypes.byref(defaults), ctypes.c_double(t), *arguments)
    return lower, upper


@pytest.mark.slow
@pytest.mark.parametrize("name", ["zhang_yan_2024_funnel", "motor_driven_pendulum"])
def test_bounds_are_a_function_of_time(name, tmp_path):
    scenario = ij.with_parts(getattr(ij.presets, name)(), sampling=ij.Sampling(PERIOD))
    ij.export(scenario, tmp_path)
    scenario = canonical(scenario)
    inputs = inputs_at_start(scenario)._replace(t=jnp.asarray(0.7))
    expected = jax.jit(bounds_at)(scenario, inputs)
    found = bounds_of_c(tmp_path, scenario.n, 0.7)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.slow
def test_bounds_around_a_given_reference(tmp_path):
    scenario = ij.with_parts(ij.presets.zhang_yan_2024_funnel(), sampling=ij.Sampling(PERIOD))
    ij.export(scenario, tmp_path, reference="given")
    scenario = canonical(scenario)
    reference = [np.asarray(x) for x in ([0.3, 0.4], [0.1, -0.2], [0.0, 0.5])]
    q_d, dq_d, ddq_d = map(jnp.asarray, reference)
    inputs = inputs_at_start(scenario)
    inputs = inputs._replace(t=jnp.asarray(0.7), q_d=q_d, dq_d=dq_d, ddq_d=ddq_d)
    expected = jax.jit(bounds_at)(scenario, inputs)
    found = bounds_of_c(tmp_path, scenario.n, 0.7, *reference)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    changed = bounds_of_c(tmp_path, scenario.n, 0.7, reference[0] + 0.1, *reference[1:])
    np.testing.assert_allclose(changed, np.asarray(expected) + 0.1, rtol=1e-12)
