"""`check_law` with laws that receive the state of a plant in strict-feedback form."""

from __future__ import annotations

import jax.numpy as jnp
import loops_of_plants
import pytest
from iblf_jax.controllers import Command

import iblf_jax as ij


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [pytest.param("electric drive", marks=pytest.mark.release), "user functions"]
)
def test_laws_of_plants_pass_in_their_scenario(case):
    scenario = loops_of_plants.CASES[case]()
    assert ij.testing.check_law(scenario.controller, scenario=scenario) == ()


def test_a_law_of_another_order_says_what_it_needs():
    law = ij.controllers.BarrierBackstepping(k=(2.0, 20.0, 30.0))
    with pytest.raises(ij.testing.ContractError, match=r"3 levels.*expected 2 levels"):
        ij.testing.check_law(law)


@ij.component
class WrongShape:
    """A law whose input has a row for every level."""

    k: ij.Leaf = ij.leaf("1/s", default=1.0)
    receives_x = True

    def init(self, x, context):
        return ()

    def command(self, t, x, d_hat, context, state):
        """An input (r, n) in the place of (n,)."""
        inside = jnp.zeros(x.shape[1:], bool)
        return Command(-self.k * x, x[1], jnp.zeros_like(x[0]), inside, inside), ()


def test_an_input_of_the_wrong_shape_is_found():
    scenario = loops_of_plants.user_class()
    with pytest.raises(ij.testing.ContractError, match=r"Command\.tau"):
        ij.testing.check_law(WrongShape(), scenario=scenario)
