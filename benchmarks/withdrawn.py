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
    "choi_2023",
    "dimanidis_observer_2018",
    "breeden_2022",
    "cao_2021",
    "cohen_molnar_2024",
    "bartelt_2024",
    "dennstaedt_2026",
    "dimanidis_2018",
    "gonzalez_prieto_2025",
    "liu_2018",
    "mahmud_2021",
    "mcilvanna_2024",
    "damodaran_2024",
    "molnar_2023",
    "pasandi_pucci_2023",
    "pourmohammad_2023",
    "shaw_cortez_2022",
    "xernicrose_2024",
    "goel_2020",
    "brendaaaaaa_2026",
    "wang_2023",
    "zhang_2022",
    "zhang_yan_2024",
)
"""Names in `benchmarks/field/results`."""
