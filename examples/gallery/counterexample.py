"""The gap of the printed proof: admissible gains and an initial state for which V2 increases."""

import iblf_jax as ij

printed, corrected = (
    ij.presets.printed_gap(variant=variant) for variant in ("printed", "corrected")
)
certificate = ij.certify(printed, duration=0.1, dt=1e-5)
figure = certificate.plot()

# %% The corrected law satisfies the inequality from the same initial state.
certified = ij.certify(corrected, duration=0.1, dt=1e-5)
print(certificate.verdict, "as printed,", certified.verdict, "as corrected")
