"""Proofs: statements about all states of a level set and all parameters of a box.

`prove` decides whether a level set of V_w is invariant, `largest_level`, `largest_parameters` and
`largest_period` search the greatest level, box or period of the samples for which that is proved,
and `gains_for_guarantee` chooses gains.

`arms.arm_problem` makes a `LevelSetProblem` of a rigid arm under the backstepping law, and
`search.search` decides by interval arithmetic and bisection whether V_w decreases everywhere on its
level set.
"""

from iblf_jax.proofs._prove import prove as prove
from iblf_jax.proofs.gains import GuaranteedGains as GuaranteedGains
from iblf_jax.proofs.gains import gains_for_guarantee as gains_for_guarantee
from iblf_jax.proofs.largest import largest_level as largest_level
from iblf_jax.proofs.largest import largest_parameters as largest_parameters
from iblf_jax.proofs.largest import largest_period as largest_period
from iblf_jax.proofs.proposal import LevelChoice as LevelChoice
from iblf_jax.proofs.result import DelayedStart as DelayedStart
from iblf_jax.proofs.result import GrowthPoint as GrowthPoint
from iblf_jax.proofs.result import GuaranteedTube as GuaranteedTube
from iblf_jax.proofs.result import Proof as Proof
from iblf_jax.proofs.result import Verdict as Verdict
from iblf_jax.proofs.torque import TorqueRange as TorqueRange
