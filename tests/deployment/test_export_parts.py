"""Laws with observers of levels, states of their own and event triggers as C, and closed loops with
process noise and switched plants as FMUs: the numbers of `simulate`."""

from __future__ import annotations

import re
import warnings

import members
import numpy as np
import pytest
from exported import built_and_run, run_fmu
from iblf_jax.sensors import Direct, Encoder, FilteredDifference, Levels
from loops_of_plants import electric_drive, flexible_joint

import iblf_jax as ij
from iblf_jax.deployment import export
from iblf_jax.simulation.scenario import canonical

SAMPLING = ij.Sampling(period=1e-3)
DURATION = 0.08


def robot(**parts):
    """The paper's loop, sampled."""
    return ij.with_parts(ij.presets.zhang_yan_2024(), **({"sampling": SAMPLING} | parts))


def measured(loop, parts, levels):
    """A sampled loop with these sensors of levels; its observer estimates the other levels."""
    return ij.with_parts(
        loop,
        sampling=SAMPLING,
        sensor=Levels(parts),
        observer=ij.observers.StateObserver(bandwidth=100.0, measured=levels),
    )


def noisy():
    """A loop with process noise."""
    return robot(process_noise=ij.process_noise.Additive(0.2))


def switched():
    """A loop whose plant changes its mass."""
    plant = ij.presets.zhang_yan_2024().plant
    return robot(plant=ij.plants.Switched(plant, {"mass[1]": (0.85, 1.5)}, [0.04]))


FILTERED = Encoder(velocity=FilteredDifference(cutoff=200.0))
OBSERVED = {
    "robot": lambda: measured(robot(), (Direct(), None), (1,)),
    "drive": lambda: measured(electric_drive(), (Direct(), None, None), (1,)),
    "current": lambda: measured(electric_drive(), (Direct(), None, Direct()), (1, 3)),
    "motor": lambda: measured(flexible_joint(), (FILTERED, Direct(), None), (1, 2, 3)),
}
"""Name -> a loop that estimates levels."""
UNREAD = {"robot": {"dq"}, "drive": {"dq", "x_3"}, "current": {"dq"}, "motor": {"dq", "x_4"}}
"""Name -> the inputs that a sample does not read."""
LAWS = {
    "trigger": lambda: robot(
        sampling=ij.Sampling(1e-3, trigger=ij.EventTrigger(relative=0.1, absolute=[0.3, 0.1]))
    ),
    "decays": lambda: robot(
        controller=members.LAWS["backstepping_decays"], observer=ij.observers.NoObserver()
    ),
}


def release(names, quick):
    """Names as parameters of a test, of which all but one run before a release."""
    marked = [pytest.param(name, marks=pytest.mark.release) for name in names if name != quick]
    return [quick, *marked]


@pytest.fixture(autouse=True)
def short_run(monkeypatch):
    """The run of a self-test is short."""
    monkeypatch.setattr("iblf_jax.deployment.export.VECTORS_DURATION", DURATION)


@pytest.mark.slow
@pytest.mark.parametrize("case", release(OBSERVED, "robot"))
@pytest.mark.filterwarnings("ignore:the simulated run")
def test_a_law_that_estimates_levels_reads_the_measured_ones(tmp_path, case):
    scenario = canonical(OBSERVED[case]())
    ij.export(scenario, tmp_path)
    built_and_run(tmp_path, "-O0")
    source = (tmp_path / "iblf_law.c").read_text()
    assert set(re.findall(r"if \((\w+) == NULL\)", source)) == UNREAD[case]
    run = ij.simulate(scenario, duration=DURATION, dt=1e-3)
    torques = export.vectors(scenario, external_reference=False).tau
    np.testing.assert_allclose(torques, run.tau[:-1:10], rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_the_run_of_the_self_test_has_the_time_step_of_the_scenario(tmp_path):
    """Friction that decays by about 4500 1/s: RK4 diverges with steps of 1 ms."""
    stiff = robot(disturbance=ij.disturbances.Friction(viscous=100.0))
    with pytest.warns(UserWarning, match="the simulated run"):
        ij.export(stiff, tmp_path / "coarse")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ij.export(stiff, tmp_path / "fine", dt=2.5e-4)


@pytest.mark.slow
@pytest.mark.parametrize("case", release(LAWS, "trigger"))
@pytest.mark.filterwarnings("ignore:the simulated run")
def test_the_c_of_a_law_with_a_state_of_its_own_passes_its_self_test(tmp_path, case):
    ij.export(LAWS[case](), tmp_path)
    built_and_run(tmp_path, "-O0")


@pytest.mark.release
@pytest.mark.parametrize(("case", "method"), [(noisy, "euler_maruyama"), (switched, "rk4")])
def test_a_sampled_closed_loop_as_an_fmu_is_simulate(tmp_path, case, method):
    ij.export(case(), tmp_path, target="fmu-loop", method=method, seed=3)
    run = ij.simulate(case(), duration=DURATION, dt=1e-3, method=method, seed=3)
    found = run_fmu(tmp_path / "iblf_loop.fmu", ["q", "tau"], DURATION, 1e-3)
    np.testing.assert_allclose(found["q"], run.q, atol=1e-9)
    np.testing.assert_allclose(found["tau"], run.tau, atol=1e-9)


@pytest.mark.parametrize("target", ["fmu-loop", "wasm"])
def test_a_closed_loop_with_noise_needs_a_stochastic_method(tmp_path, target):
    with pytest.raises(ValueError, match=r"method: got 'rk4'.*as the plant has process noise"):
        ij.export(noisy(), tmp_path, target=target)
