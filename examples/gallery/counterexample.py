"""The gap of the printed proof: gains that it admits, and a start from which V2 grows."""

import iblf_jax as ij

printed, corrected = (
    ij.presets.printed_gap(reading=reading) for reading in ("printed", "corrected")
)
certificate = ij.certify(printed, duration=0.1, dt=1e-5)
figure = certificate.plot()

# %% The corrected law from the same start keeps the inequality.
kept = ij.certify(corrected, duration=0.1, dt=1e-5)
print(certificate.verdict, "as printed,", kept.verdict, "as corrected")
