"""Certificates: Theorem 2's claims about a loop, checked line by line (`certify`), and broken if it
can be (`counterexample`).
"""

from iblf_jax.certificates._certify import certify as certify
from iblf_jax.certificates._counterexample import Counterexample as Counterexample
from iblf_jax.certificates._counterexample import counterexample as counterexample
from iblf_jax.certificates.result import Certificate as Certificate
from iblf_jax.certificates.result import Line as Line
from iblf_jax.certificates.result import Traces as Traces

__all__ = ["Certificate", "Counterexample", "Line", "Traces", "certify", "counterexample"]
