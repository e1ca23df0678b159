"""Certificates: the claims of Theorem 2 about a loop, checked inequality by inequality (`certify`),
and a search for states that break them (`counterexample`).

    certify -> run_summary.summarise -> reconstruction.steps_of -> proof_terms, engine
            -> rate_lines, theorem_lines, decay_lines, law_claim_lines -> lines
            -> result.Certificate
"""

from iblf_jax.certificates._certify import certify as certify
from iblf_jax.certificates._counterexample import Counterexample as Counterexample
from iblf_jax.certificates._counterexample import counterexample as counterexample
from iblf_jax.certificates.lines import Line as Line
from iblf_jax.certificates.result import Certificate as Certificate
from iblf_jax.certificates.result import Traces as Traces

__all__ = ["Certificate", "Counterexample", "Line", "Traces", "certify", "counterexample"]
