"""Certificates: the claims of Theorem 2, or of (S.3), about a loop, checked inequality by
inequality (`certify`), and a search for states that break them (`counterexample`).

    certify -> run_summary.summarise -> reconstruction.steps_of -> proof_terms, engine
            -> rate_lines, theorem_lines, decay_lines, law_claim_lines -> lines
            -> result.Certificate

Laws that receive the levels of a plant in strict-feedback form have the claim (S.3):

    certify -> _level_certificate -> level_summary -> reconstruction.steps_of -> level_terms
                                  -> level_lines, law_claim_lines -> lines
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
