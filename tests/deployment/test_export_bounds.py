"""The functions of the exported C: where their results are, and the bounds at a time against the
scenario's own."""

from __future__ import annotations

import collections
import ctypes
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.deployment.control_law import FLAGS, bounds_at, inputs_at_start
from iblf_jax.deployment.write_c import C_TYPES, fill_template
from iblf_jax.simulation.scenario import canonical

PERIOD = 0.01


NUMBERED = """
static void count(F *r, int size) { while (size-- > 0) r[size] = size; }
static void law_start(const law_parameters *p, const F *t, const F *q, const F *dq, F *r) {
  count(r, 5);
}
static void law_sample(const law_parameters *p, const F *m, const F *t, const F *q, const F *dq,
    F *r) {
  count(r, 9);
  r[9] = r[11] = 1;
  r[10] = r[12] = 0;
}
static void law_tube(const law_parameters *p, const F *t, const F *q, const F *dq, F *r) {
  count(r, 4);
}
"""
"""Programs of a law with a memory of three numbers, whose results are their own places."""


def compiled(folder, name):
    """The library of the law in a folder."""
    command = ["cc", "-std=c99", "-shared", "-fPIC", f"{name}.c", "-lm", "-o", "law.so"]
    subprocess.run(command, cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "law.so"))


def test_each_result_is_where_the_header_says(tmp_path):
    """Memory, torques, virtual velocities, estimate and flags; the lower bounds before the upper
    ones."""
    names = {"name": "law", "upper": "LAW", "guard": "LAW_H", "parameters": "  double one;"}
    sizes = {"joints": 2, "memory_count": 3, "memory_size": 3, "estimate_size": 2}
    keep = dict.fromkeys(
        ("keep_start", "keep_sample"), "memcpy(s->memory, result, sizeof s->memory);"
    )
    code = {"start": NUMBERED, "defaults": "{0}", "default_unread": "(void)zero;"}
    values = collections.defaultdict(str, C_TYPES[False] | names | sizes | keep | code)
    values["flags"] = len(FLAGS)
    values["prelude"] = fill_template("prelude.c", values)
    for ending in ("h", "c"):
        (tmp_path / f"law.{ending}").write_text(fill_template(f"law.{ending}", values))
    law, parameters = compiled(tmp_path, "law"), ctypes.c_double(0.0)
    state, zero, lower, upper, tau = (np.zeros(x) for x in (9, 2, 2, 2, 2))
    at = [ctypes.c_void_p(x.ctypes.data) for x in (state, zero, zero)]
    assert law.law_init(ctypes.byref(parameters), *at) == 0
    np.testing.assert_array_equal(state, [0, 1, 2, 3, 4, 0, 0, 0, 0])
    torque = ctypes.c_void_p(tau.ctypes.data)
    status = law.law_step(ctypes.byref(parameters), at[0], ctypes.c_double(0.0), *at[1:], torque)
    np.testing.assert_array_equal(state, np.arange(9))
    np.testing.assert_array_equal(tau, [3, 4])
    assert status == 2 | 8
    sides = [ctypes.c_void_p(x.ctypes.data) for x in (lower, upper)]
    law.law_bounds(ctypes.byref(parameters), ctypes.c_double(0.0), *sides)
    np.testing.assert_array_equal([lower, upper], [[0, 1], [2, 3]])


def bounds_of_c(folder, size, t, *reference):
    """The bounds of the law in a folder at a time."""
    library = compiled(folder, "iblf_law")
    lower, upper = (np.empty(size) for _ in range(2))
    pointers = [np.ascontiguousarray(x, float) for x in (*reference, lower, upper)]
    pointers[-2:] = lower, upper
    defaults = ctypes.c_char.in_dll(library, "iblf_law_defaults")
    arguments = [ctypes.c_void_p(x.ctypes.data) for x in pointers]
    library.iblf_law_bounds.restype = None
    library.iblf_law_bounds(ctypes.byref(defaults), ctypes.c_double(t), *arguments)
    return lower, upper


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "reference"),
    [("motor_driven_pendulum", "inside"), ("zhang_yan_2024_funnel", "given")],
)
def test_bounds_are_a_function_of_time_and_reference(name, reference, tmp_path):
    scenario = ij.with_parts(getattr(ij.presets, name)(), sampling=ij.Sampling(PERIOD))
    ij.export(scenario, tmp_path, reference=reference)
    scenario = canonical(scenario)
    inputs, given = inputs_at_start(scenario)._replace(t=jnp.asarray(0.7)), []
    if reference == "given":
        given = [np.array(x) for x in ([0.3, 0.4], [0.1, -0.2], [0.0, 0.5])]
        q_d, dq_d, ddq_d = map(jnp.asarray, given)
        inputs = inputs._replace(q_d=q_d, dq_d=dq_d, ddq_d=ddq_d)
    expected = np.asarray(jax.jit(bounds_at)(scenario, inputs))
    found = bounds_of_c(tmp_path, scenario.n, 0.7, *given)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    if given:
        moved = bounds_of_c(tmp_path, scenario.n, 0.7, given[0] + 0.1, *given[1:])
        np.testing.assert_allclose(moved, expected + 0.1, rtol=1e-12)
