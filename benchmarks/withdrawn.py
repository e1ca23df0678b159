"""Results that were removed, and the reason, which pages state where a table stood.

A name leaves its list when it is measured again.
"""

from __future__ import annotations

REASON = (
    "measured with JAX 0.11.2, with which the package could silently run the program of another"
    " structure than the requested one"
)
BENCHMARKS = ("gpu",)
"""Names in `benchmarks/results`."""
FIELD = (
    "ames_2014",
    "bechlioulis_2013",
    "breeden_2022",
    "cao_2021",
    "cohen_molnar_2024",
    "cruz_ancona_2022",
    "dennstaedt_2026",
    "dimanidis_2018",
    "gonzalez_prieto_2025",
    "liu_2018",
    "mahmud_2021",
    "mcilvanna_2024",
    "mishra_jagtap_2024",
    "molnar_2023",
    "pasandi_pucci_2023",
    "pourmohammad_2023",
    "shaw_cortez_2022",
    "tangent_barrier_2013",
    "tee_ge_2012",
    "tissat_2026",
    "wang_2023",
    "zhang_2022",
    "zhang_yan_2024",
)
"""Names in `benchmarks/field/results`."""
