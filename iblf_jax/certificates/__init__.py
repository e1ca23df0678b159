"""Certificates: what Theorem 2 claims about a loop, checked inequality by inequality.  `certify` is the entry, `falsify` the adversary."""

from iblf_jax.certificates._certify import certify as certify
from iblf_jax.certificates._falsify import Counterexample as Counterexample
from iblf_jax.certificates._falsify import falsify as falsify
from iblf_jax.certificates.result import Certificate as Certificate
from iblf_jax.certificates.result import Line as Line
from iblf_jax.certificates.result import Traces as Traces

__all__ = ["Certificate", "Counterexample", "Line", "Traces", "certify", "falsify"]
