"""What the page on Simulink and microcontrollers says of the C law: its blocks of C are compiled
and run, and the law needs no C library but `memcpy`, `memset` and functions of `math.h`."""

import json
import platform
import re
import shutil
import subprocess
import sys
from importlib.resources import files

import numpy as np
import pytest
from conftest import ROOT

import iblf_jax as ij
from iblf_jax.deployment.control_law import control_law
from iblf_jax.deployment.export import vectors
from iblf_jax.deployment.write_c import Law, generate
from iblf_jax.simulation.scenario import canonical

PAGE = (ROOT / "docs" / "how_to" / "simulink_and_microcontrollers.md").read_text(encoding="utf-8")
STUBS = ROOT / "tests" / "deployment" / "stubs"
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1")
CORTEX = ("-target", "thumb-linux-musleabihf", "-mcpu=cortex_m4+vfp4d16sp")
BARE = ("-std=c99", "-ffreestanding", "-fno-unwind-tables", "-fno-asynchronous-unwind-tables")
MEMORY = {"memcpy", "memset"}
MATH = set(re.findall(r"FN\((\w+)\)", (files("iblf_jax.kernels") / "c" / "plain.h").read_text()))
OWN = {"sin", "cos", "sqrt", "expm1", "fabs"}
"""Functions of `math.h` that the law of the page needs."""

pytestmark = [
    pytest.mark.skipif(not shutil.which("cc"), reason="there is no C compiler"),
    pytest.mark.skipif(platform.system() != "Linux", reason="objects are read by nm of Linux"),
]


def run(command, folder):
    done = subprocess.run([str(x) for x in command], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def undefined(path):
    """The names that an object needs from elsewhere."""
    return set(re.findall(r" U (\w+)", run(["nm", "-u", path], path.parent)))


def writable(path):
    return re.findall(r" [bBdDcC] (\w+)", run(["nm", path], path.parent))


def names_needed_by(name, folder, *options):
    """The names that a law needs from elsewhere; it has no writable data."""
    object_ = f"{name}.o"
    run(["cc", *BARE, "-fno-stack-protector", *options, "-c", f"{name}.c", "-o", object_], folder)
    assert writable(folder / object_) == []
    return undefined(folder / object_) - {"_GLOBAL_OFFSET_TABLE_"}


def block_of(name):
    """The block of C or JavaScript on the page whose comment begins with a file name."""
    (text,) = re.findall(rf"```(?:c|js)\n(/\* {name}: .*?)```", PAGE, re.DOTALL)
    return text


def folder_of(scenario, folder):
    """Writes the law of a scenario as `arm_law`; its self-test has the vectors of a run of 20 s."""
    scenario = canonical(scenario)
    found = vectors(scenario, False)
    law = Law(scenario, control_law(scenario, False), "arm_law", False, found, (), None)
    folder.mkdir(exist_ok=True)
    for name, text in generate(law).files.items():
        (folder / name).write_text(text)
    return folder


@pytest.fixture(scope="module")
def sampled():
    gains = {"controller.K2": 4.0, "observer.kf": 4.0}
    scenario = ij.with_parameters(ij.presets.zhang_yan_2024(variant="corrected"), gains)
    return ij.with_parts(scenario, sampling=ij.Sampling(1e-3, delay=1e-3))


@pytest.fixture(scope="module")
def law(sampled, tmp_path_factory):
    return folder_of(sampled, tmp_path_factory.mktemp("law"))


@pytest.fixture(scope="module")
def small_law(sampled, tmp_path_factory):
    return folder_of(ij.astype(sampled, "float32"), tmp_path_factory.mktemp("small_law"))


BLOCK_TEST = """
#include <math.h>
#include <stdio.h>
#include "arm_law.h"
#include "vectors.h"

void arm_law_block_reset(void);
void arm_law_block(double t, const double q[2], const double dq[2], double tau[2]);

int main(void) {
  double tau[2], worst = 0.0, largest = 1.0;
  int k, i, round;
  for (round = 0; round < 2; round++) {
    arm_law_block_reset();
    for (k = 0; k < SAMPLES; k++) {
      arm_law_block(k * 1e-3, q[k], dq[k], tau);
      for (i = 0; i < 2 && k % CHECKED == 0; i++) {
        largest = fmax(largest, fabs(torque[k / CHECKED][i]));
        worst = fmax(worst, fabs(tau[i] - torque[k / CHECKED][i]));
      }
    }
  }
  (void)first_q, (void)first_dq;
  printf("%.3g\\n", worst / largest);
  return 0;
}
"""


@pytest.mark.slow
def test_the_blocks_of_the_page_return_the_torques_of_the_self_test(law):
    """The C Caller block, also in a second run after a reset, and the S-function."""
    (law / "block_test.c").write_text(BLOCK_TEST)
    for block, includes, *sources in (
        ("arm_law_block.c", (), "block_test.c"),
        ("arm_law_sfun.c", ("-I", STUBS, "-I", law)),
    ):
        (law / block).write_text(block_of(block))
        sources += [block, "arm_law.c"]
        run(["cc", *STRICT, *includes, *sources, "-lm", "-o", "block_test"], law)
        # The start of the run of the self-test is not rounded, and its samples are.
        worst, *status = map(float, run(["./block_test"], law).split())
        assert worst < 1e-6 and not any(status)


TIMER_TEST = """
#include <stdio.h>
#include "arm_law.h"

int arm_law_begin(const arm_law_real *q, const arm_law_real *dq);
int arm_law_tick(arm_law_real t, const arm_law_real *q, const arm_law_real *dq, arm_law_real *tau);

int main(void) {
  const arm_law_real rest[2] = {0, 0}, far[2] = {5, 5};
  const arm_law_real inside[2] = {(arm_law_real)0.5, (arm_law_real)0.5};
  arm_law_real tau[2];
  int refused = arm_law_begin(far, rest), started = arm_law_begin(inside, rest), first, later;
  first = arm_law_tick(0, inside, rest, tau);
  later = arm_law_tick((arm_law_real)1e-3, far, rest, tau);
  printf("%d %d %d %d %g %g\\n", refused, started, first, later, (double)tau[0], (double)tau[1]);
  return 0;
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "float"])
def test_the_timer_of_the_page_checks_the_bounds_and_clips_the_torque(precision, law, small_law):
    folder = small_law if precision == "float" else law
    (folder / "arm_law_timer.c").write_text(block_of("arm_law_timer.c"))
    (folder / "timer_test.c").write_text(TIMER_TEST)
    sources = ("timer_test.c", "arm_law_timer.c", "arm_law.c")
    run(["cc", *STRICT, *sources, "-lm", "-o", "timer_test"], folder)
    refused, started, first, later, *torques = map(float, run(["./timer_test"], folder).split())
    assert (refused, started, first, later) == (2, 0, 0, 2)
    assert [abs(x) for x in torques] == [20.0, 20.0]


@pytest.mark.slow
def test_the_check_of_the_page_prints_the_end_of_the_run(sampled, tmp_path):
    pytest.importorskip("ziglang", reason="ziglang of the extra `export` is not installed")
    node = shutil.which("node")
    if node is None:
        pytest.skip("there is no node")
    ij.export(sampled, tmp_path / "arm_loop", target="wasm", name="arm_loop")
    (tmp_path / "check.mjs").write_text(block_of("check.mjs"))
    expected = ij.simulate(sampled, duration=1.0, dt=1e-3, seed=0).q[-1]
    np.testing.assert_allclose(json.loads(run([node, "check.mjs"], tmp_path)), expected, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["", "f"])
def test_the_law_of_the_page_needs_the_functions_that_it_lists(suffix, law, small_law):
    needed = names_needed_by("arm_law", small_law if suffix else law, "-O2")
    assert needed == MEMORY | {f"{name}{suffix}" for name in OWN}
    words = r"The others that can occur in other laws are (.*?)\. newlib"
    assert set(re.findall(r"`(\w+)`", re.search(words, PAGE, re.DOTALL)[1])) == MATH - OWN


@pytest.mark.slow
def test_the_law_compiles_for_a_cortex_m4(small_law):
    pytest.importorskip("ziglang", reason="ziglang of the extra `export` is not installed")
    assert " ".join(CORTEX) in PAGE
    compiler = [sys.executable, "-m", "ziglang", "cc", *CORTEX, *BARE, "-Os"]
    run([*compiler, "-c", "arm_law.c", "-o", "m4.o"], small_law)
    data = (small_law / "m4.o").read_bytes()
    assert data[:5] == b"\x7fELF\x01" and int.from_bytes(data[18:20], "little") == 40  # 32-bit Arm
    assert undefined(small_law / "m4.o") == MEMORY | {f"{name}f" for name in OWN}
    assert writable(small_law / "m4.o") == []
    size = int(run(["size", "m4.o"], small_law).splitlines()[1].split()[0])
    assert "The code has 4 kB in single precision" in PAGE and 3000 < size < 5500
