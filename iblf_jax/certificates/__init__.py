"""Certificates: the claims about a closed loop, checked inequality by inequality (`certify`), and a
search for states that break them (`counterexample`).

    certify -> claims.claims_of -> summary.summarise -> reconstruction.steps_of -> terms, engine
            -> the lines of each claim (`claims`) -> lines
            -> result.Certificate

The claims are objects, and so are the terms that they have in common (`terms.Terms`): one record
for a plant of any order, with an entry for each claim.
"""

from iblf_jax.certificates._certify import certify as certify
from iblf_jax.certificates._counterexample import Counterexample as Counterexample
from iblf_jax.certificates._counterexample import counterexample as counterexample
from iblf_jax.certificates.lines import Line as Line
from iblf_jax.certificates.result import Certificate as Certificate
from iblf_jax.certificates.result import LevelTraces as LevelTraces
from iblf_jax.certificates.result import Traces as Traces

__all__ = [
    "Certificate",
    "Counterexample",
    "LevelTraces",
    "Line",
    "Traces",
    "certify",
    "counterexample",
]
