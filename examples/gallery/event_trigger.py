"""Event-triggered commands: fewer messages to the drives for a given accuracy."""

import iblf_jax as ij
from iblf_jax import plotting

scenario = ij.presets.motor_driven_pendulum()
loops = {
    "every sample": None,
    "absolute 0.2 V": ij.EventTrigger(absolute=0.2),
    "relative 5 %, absolute 0.02 V": ij.EventTrigger(relative=0.05, absolute=0.02),
}
runs = {}
for name, trigger in loops.items():
    sampling = ij.Sampling(period=1e-3, trigger=trigger)
    runs[name] = ij.simulate(ij.with_parts(scenario, sampling=sampling), duration=3.0, dt=1e-3)
figure = plotting.torques(runs)

# %% The dots are the events. A smaller threshold sends more commands and tracks more accurately;
# sending every command needs no trigger and is the better choice where messages cost nothing.
for name, run in runs.items():
    if run.scenario.sampling.trigger is None:
        print(f"{name}: 3001 commands, |e1| <= {float(abs(run.e1[1000:]).max()):.4f} rad")
        continue
    print(
        f"{name}: {float(run.metrics.event_count):.0f} commands, shortest interval"
        f" {float(run.metrics.shortest_interval):.3f} s,"
        f" |e1| <= {float(abs(run.e1[1000:]).max()):.4f} rad"
    )
errors = plotting.errors(runs)

# %% The compensation bounds the Lyapunov rate whatever the threshold is. On the paper's arm it
# sends more commands than the law itself, as a steep function of e2 holds the weight of the arm.
arm = ij.presets.zhang_yan_2024(reading="corrected")
trigger = ij.EventTrigger(relative=0.05, absolute=0.1)
laws = {
    "law": arm.controller,
    "law with compensation": ij.controllers.EventCompensated(
        arm.controller, relative=0.05, absolute=0.12, epsilon=0.5
    ),
}
for name, law in laws.items():
    loop = ij.with_parts(arm, controller=law, sampling=ij.Sampling(period=1e-3, trigger=trigger))
    run = ij.simulate(loop, duration=3.0, dt=1e-3)
    print(
        f"{name}: {float(run.metrics.event_count):.0f} commands,"
        f" largest |e2| after 1 s {float(abs(run.e2[1000:]).max()):.4f} rad/s"
    )
