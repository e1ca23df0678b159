"""A certificate: Theorem 2 along one run, inequality by inequality."""

import iblf_jax as ij

scenario = ij.presets.zhang_yan_2024(reading="corrected")
certificate = ij.certify(scenario, duration=4.0, dt=1e-3)
figure = certificate.plot()

# %% Line by line, with the smallest margin and where it is.
print(certificate)
