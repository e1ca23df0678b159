"""Time of one call of exported laws: `iblf_law_step` over the samples of a simulated run, in cycles
of the processor's time stamp counter.

    python benchmarks/export.py [--quick] [--json FILE]

Rows: laws of the presets, double and float, built by the system's C compiler with -O2.  `cycles` is
  the median; 999 calls of a thousand
take less than `99.9 %`, which other programs of the machine make long.  `x JAX`: how much longer
the same sample takes as a jitted one.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
import warnings
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from _timing import interleaved, report

import iblf_jax as ij
from iblf_jax.deployment.build import c_compiler
from iblf_jax.deployment.control_law import SampleInputs, sample, start
from iblf_jax.simulation.scenario import canonical

DRIVER = """
#include "iblf_law.h"
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include "vectors.h"
#if defined(__x86_64__)
static double now(void) { return (double)__builtin_ia32_rdtsc(); }
#else
static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}
#endif
static int by_size(const void *a, const void *b) {
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}
int main(void) {
  iblf_law_parameters p = iblf_law_defaults;
  iblf_law_state s;
  iblf_law_real tau[IBLF_LAW_JOINTS];
  static double spent[SAMPLES];
  struct timespec a, b;
  double begin, seconds, ticks;
  int k, round;
  iblf_law_init(&p, &s, first_q, first_dq);
  for (round = 0; round < 2; round++) {
    clock_gettime(CLOCK_MONOTONIC, &a);
    ticks = now();
    for (k = 0; k < SAMPLES; k++) {
      begin = now();
      iblf_law_step(&p, &s, (iblf_law_real)(k * 1e-3), q[k], dq[k], tau);
      spent[k] = now() - begin;
    }
    ticks = now() - ticks;
    clock_gettime(CLOCK_MONOTONIC, &b);
  }
  seconds = (double)(b.tv_sec - a.tv_sec) + 1e-9 * (double)(b.tv_nsec - a.tv_nsec);
  qsort(spent, SAMPLES, sizeof *spent, by_size);
  printf("%g %g %g\\n", spent[SAMPLES / 2], spent[(int)(0.999 * SAMPLES)], ticks / seconds);
  return 0;
}
"""


def in_jax(scenario) -> float:
    """Seconds of a sample as a jitted function."""
    scenario = canonical(scenario)
    told = SampleInputs(jnp.zeros(()), scenario.initial.q, scenario.initial.dq)
    memory, one = start(scenario, told)[0], jax.jit(sample)
    jax.block_until_ready(one(scenario, told, memory))

    def some():
        for _ in range(100):
            found = one(scenario, told, memory)
        return found

    return interleaved({"jax": some}, 3)["jax"] / 100


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="the paper's law alone, as double")
    parser.add_argument("--json", help="also write the table to this file")
    args = parser.parse_args()
    names = ["zhang_yan_2024"] if args.quick else ["zhang_yan_2024", "ur5", "iiwa14"]
    rows = []
    for name in names:
        scenario = ij.with_parts(getattr(ij.presets, name)(), sampling=ij.Sampling(1e-3))
        jitted = in_jax(scenario)
        for dtype in ["double"] if args.quick else ["double", "float"]:
            with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
                warnings.simplefilter("ignore")
                made = ij.export(scenario, folder, dtype=dtype)
                (Path(folder) / "driver.c").write_text(DRIVER)
                begin = time.perf_counter()
                command = [
                    *c_compiler(),
                    "-std=gnu99",
                    "-O2",
                    "iblf_law.c",
                    "driver.c",
                    "-lm",
                    "-o",
                    "driver",
                ]
                subprocess.run(command, cwd=folder, check=True)
                built = time.perf_counter() - begin
                best = np.min(
                    [
                        [
                            float(x)
                            for x in subprocess.check_output(["./driver"], cwd=folder).split()
                        ]
                        for _ in range(3)
                    ],
                    axis=0,
                )
                size = sum(made.operations.values())
                median, late, rate = best
                rows.append(
                    [
                        name,
                        dtype,
                        size,
                        made.sizes["state"],
                        built,
                        median,
                        late,
                        1e6 * median / rate,
                        jitted / (median / rate),
                    ]
                )
    columns = [
        "law",
        "type",
        "operations",
        "state bytes",
        "compile s",
        "cycles",
        "99.9 %",
        "us",
        "x JAX",
    ]
    report("One call of an exported law", columns, rows, args.json)


if __name__ == "__main__":
    main()
