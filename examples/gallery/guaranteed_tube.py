"""A guaranteed tube: positions that no start of a level set and no mass of a box leave."""

import iblf_jax as ij

# %% The paper's arm, reference and bounds with a faster observer, without disturbance.
scenario = ij.with_parameters(
    ij.with_parts(
        ij.presets.zhang_yan_2024(reading="corrected"), disturbance=ij.disturbances.Nothing()
    ),
    {"controller.K2": 3.0, "observer.kf": 100.0},
)
proof = ij.prove(
    scenario,
    level=1.0,
    parameters={"plant.mass": ij.factor(ij.interval(0.99, 1.01))},
    progress=False,
)
figure = proof.plot()

# %% The proof is about all times, starts and masses; the runs are examples.
print(proof)
