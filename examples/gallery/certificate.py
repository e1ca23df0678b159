"""A certificate: each inequality of Theorem 2, checked along one run."""

import iblf_jax as ij

scenario = ij.presets.zhang_yan_2024(variant="corrected")
certificate = ij.certify(scenario, duration=4.0, dt=1e-3)
figure = certificate.plot()

# %% Each line has the smallest margin of an inequality and its location.
print(certificate)
