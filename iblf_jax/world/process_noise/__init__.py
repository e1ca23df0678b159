"""Process noise: white noise on levels of the plant.  The contract is
`ProcessNoise`.
"""

from iblf_jax.world.process_noise._base import ProcessNoise as ProcessNoise
from iblf_jax.world.process_noise._base import check_structure as check_structure
from iblf_jax.world.process_noise.additive import Additive as Additive
from iblf_jax.world.process_noise.diffusion import Diffusion as Diffusion
from iblf_jax.world.process_noise.proportional import Proportional as Proportional

MEMBERS = {
    "additive": Additive,
    "diffusion": Diffusion,
    "proportional": Proportional,
}
"""Every process noise by the name that a scenario file gives it."""

__all__ = [
    "MEMBERS",
    "Additive",
    "Diffusion",
    "ProcessNoise",
    "Proportional",
    "check_structure",
]
