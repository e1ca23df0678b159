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
