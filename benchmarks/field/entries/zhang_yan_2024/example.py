"""Time-varying asymmetric bounds (Zhang and Yan 2024): the paper's law with an integral barrier and
a disturbance observer, and its comparison with a logarithmic barrier.

`python -m iblf_jax reproduce --out out` writes the six figures and a report of every claim with its
numbers. [The paper's example](tube.md) shows the run of the integral barrier alone, and
[Printed and corrected](../theory/printed_and_corrected.md) derives two of the corrections.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij
from iblf_jax.cli.reproduce import check_claims

scenario = ij.presets.zhang_yan_2024()
compared = ij.compare(scenario, ["integral", "log"], duration=20.0, dt=1e-3)
integral, log = (compared.rollouts[name] for name in ("integral", "log"))
runs = {"integral barrier": integral, "logarithmic barrier": log}
figure, axes = plt.subplots(2, 2, figsize=(9, 4.6), layout="constrained")
for joint, (above, below) in enumerate(axes.T):
    for name, run in runs.items():
        above.plot(run.t, run.e1[:, joint], label=name)
        below.plot(run.t, run.e2[:, joint])
    for side in (integral.upper, integral.lower):
        above.plot(run.t, (side - integral.q_d)[:, joint], "k:", linewidth=0.8)
    above.set(title=f"joint {joint}", ylabel="error $e_1$ [rad]", xlim=(0.0, 5.0))
    below.set(xlabel="time $t$ [s]", ylabel="error $e_2$ [rad/s]", xlim=(0.0, 2.0))
    above.set(xlabel="time $t$ [s]")
axes[0, 0].legend()

# %% The statements of the paper, checked as by the command `reproduce`. "Late" is the second half
# of a run.
claims = check_claims(runs)
holds = {claim.claim: claim.confirmed for claim in claims}
details = {claim.claim: claim.detail for claim in claims}
print(compared)

# %% The gap of the printed proof: gains that meet the conditions of Theorem 2, no disturbance.
gap = ij.presets.printed_gap()
print(f"gains: K2 = {gap.controller.K2}, kf = {gap.observer.kf}")
print(f"start: q = {gap.initial.q}, q' = {gap.initial.dq}, eta = {gap.observer.eta0}")
gaps = {
    variant: ij.simulate(ij.presets.printed_gap(variant=variant), duration=0.1, dt=1e-5)
    for variant in ("printed", "corrected")
}
V2 = {variant: np.asarray(run.V) for variant, run in gaps.items()}
for variant, values in V2.items():
    print(f"{variant}: V2 starts at {values[0]:.4f}, largest {values.max():.4f}")

# %% The estimate of a disturbance of zero, on a faster motion.
motion = {
    "reference.frequency": 3.0,
    "disturbance.acceleration_amplitude": 0.0,
    "disturbance.velocity_amplitude": 0.0,
}
late, estimates = integral.t >= 10.0, {}
for name, observer in {
    "printed": ij.observers.AsPublished(kf=20.0),
    "with M0' q'": ij.observers.Momentum(kf=20.0),
}.items():
    faster = ij.with_parameters(ij.with_parts(scenario, observer=observer), motion)
    run = ij.simulate(faster, duration=20.0, dt=1e-3)
    estimates[name] = float(np.abs(run.disturbance_estimate[late]).max())
print(estimates)


# %% The signs of (3.11). Its error terms in (3.16) need f_hat' = kf (f - f_hat) for a constant M0;
# for each sign of the terms in eta', the largest difference along the run.
def momentum_and_load(q, dq, tau):
    """M0 q', and tau - C0 q' - G0."""
    arm = scenario.model
    return arm.mass_matrix(q) @ dq, tau - arm.coriolis(q, dq, dq) - arm.gravity(q)


p, load = map(np.asarray, jax.vmap(momentum_and_load)(integral.q, integral.dq, integral.tau))
f_hat, kf = np.asarray(integral.disturbance_estimate), np.asarray(scenario.observer.kf)
for first, second in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
    eta_rate = first * kf * (f_hat - kf * p) + second * kf * (load + kf * p)
    difference = np.abs(eta_rate + kf * (load + f_hat)).max()
    print(f"signs {first:+d}, {second:+d}: {difference:.1e} N m/s")


# %% The two barriers along the run of the integral law.
def value_of(barrier):
    """V1 of a barrier along the run."""
    tubes = [(scenario.context.tube(t), q) for t, q in zip(integral.t, integral.q, strict=True)]
    return np.array([barrier.value(tube, q) for tube, q in tubes[::200]])


identity = np.abs(value_of(ij.barriers.Integral()) - 2 * value_of(ij.barriers.Log())).max()
ratios = [
    float(np.linalg.norm(pair["log"].metrics.rmse) / np.linalg.norm(pair["integral"].metrics.rmse))
    for pair in (compared.rollouts, compared.equal_effort)
]
doubled = ij.with_parameters(log.scenario, {"controller.weight": 2.0})
same = ij.simulate(doubled, duration=20.0, dt=1e-3)
evidence = {
    "start": float(V2["printed"][0]),
    "printed": float(V2["printed"].max()),
    "corrected": float(V2["corrected"].max()),
    "without_term": estimates["printed"],
    "with_term": estimates["with M0' q'"],
    "identity": float(identity),
    "equal_gains": ratios[0],
    "equal_effort": ratios[1],
    "weight_two": float(np.abs(same.q - integral.q).max()),
    "K2": float(gap.controller.K2.min()),
    "kf": float(gap.observer.kf.min()),
}
print(evidence)
