"""Complete scenarios, each with its source.  `PRESETS` names them for the command line and for
files.
"""

from iblf_jax.control.controllers import LAWS as LAWS
from iblf_jax.presets.arms import arm as arm
from iblf_jax.presets.arms import arm_scenario as arm_scenario
from iblf_jax.presets.arms import iiwa14 as iiwa14
from iblf_jax.presets.arms import ur5 as ur5
from iblf_jax.presets.paper import customary_two_link as customary_two_link
from iblf_jax.presets.paper import printed_gap as printed_gap
from iblf_jax.presets.paper import zhang_yan_2024 as zhang_yan_2024
from iblf_jax.presets.paper import zhang_yan_2024_full_state as zhang_yan_2024_full_state
from iblf_jax.presets.paper import zhang_yan_2024_funnel as zhang_yan_2024_funnel
from iblf_jax.presets.paper import zhang_yan_2024_saturated as zhang_yan_2024_saturated
from iblf_jax.presets.plants import cybership_ii as cybership_ii
from iblf_jax.presets.plants import flexible_joint_iiwa14 as flexible_joint_iiwa14
from iblf_jax.presets.plants import flexible_joint_two_link as flexible_joint_two_link
from iblf_jax.presets.plants import motor_driven_pendulum as motor_driven_pendulum
from iblf_jax.presets.plants import motor_driven_two_link as motor_driven_two_link
from iblf_jax.presets.plants import vessel as vessel
from iblf_jax.presets.table import PRESETS as PRESETS
