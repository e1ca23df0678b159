"""A switched plant: an arm takes up and puts down a load that its model does not contain, and an
observer compensates for it. That helps where the load stays for longer than the observer needs.
"""

import iblf_jax as ij
from iblf_jax import plotting

paper = ij.presets.zhang_yan_2024()
LOADS = (0.0, 0.5, 0.0, 0.5, 0.0)
plant = ij.plants.Switched(paper.plant, {"payload": LOADS}, times=[1.0, 2.0, 3.0, 4.0])
OBSERVERS = {
    "with observer": ij.observers.Momentum(kf=20.0),
    "without observer": ij.observers.NoObserver(),
}

# %% The root mean square of the error over both joints while the load comes and goes: the observer
# is the better choice for loads that stay for 0.3 s and more, and of no use at 0.03 s, which is
# less than its time constant 1/kf = 0.05 s.
runs = {}
print("dwell time [s]  " + "  ".join(f"{name:>16s}" for name in OBSERVERS))
for dwell in (1.0, 0.3, 0.1, 0.03):
    errors = []
    for name, observer in OBSERVERS.items():
        scenario = ij.with_parts(
            paper, plant=plant, observer=observer, disturbance=ij.disturbances.Nothing()
        )
        times = [1.0 + k * dwell for k in range(4)]
        scenario = ij.with_parameters(scenario, {"plant.times": times})
        run = ij.simulate(scenario, duration=6.0, dt=1e-3, record_every=5)
        assert float(run.metrics["switches"]) == len(times)
        during = (run.t > times[0]) & (run.t <= times[-1] + dwell)
        errors.append(float((run.e1[during] ** 2).mean() ** 0.5))
        runs[name, dwell] = run
    print(f"{dwell:14.2f}  " + "  ".join(f"{error:16.5f}" for error in errors))

# %% The estimate of the observer follows a load that stays for a second
slow = plotting.uncertain_terms(runs["with observer", 1.0])

# %% and lags behind one that stays for a tenth of a second
fast = plotting.uncertain_terms(runs["with observer", 0.1])
