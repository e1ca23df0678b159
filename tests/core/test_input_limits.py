"""Limits of an input that are not symmetric, beside those that are."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.core.input_limits import is_beyond, lower_or_opposite


@pytest.mark.parametrize("lower", [None, -1.0, -2.0, 0.0, 1.0])
def test_an_input_is_beyond_its_limits_where_clipping_changes_it(lower):
    x, upper = jnp.array([-3.0, -1.5, -0.5, 0.5, 1.5, 3.0]), 2.0
    least = -upper if lower is None else lower
    assert lower_or_opposite(lower, upper) == least
    np.testing.assert_array_equal(is_beyond(x, lower, upper), np.clip(x, least, upper) != x)


LAW = ij.controllers.PDGravity(Kp=60.0, Kd=20.0)


@pytest.mark.parametrize(
    "limited", [ij.actuators.Motor, partial(ij.controllers.Saturated, LAW)], ids=("Motor", "law")
)
def test_a_lower_limit_is_below_an_upper_one(limited):
    for lower, upper in ((2.0, 1.0), (2.0, 2.0), ([0.0, 3.0], 2.0)):
        with pytest.raises(ValueError, match=r"lower_limit: got .*less than the limit"):
            limited(limit=upper, lower_limit=lower)
    with pytest.raises(ValueError, match=r"Motor.lower_limit: got 0., expected a limit, too"):
        ij.actuators.Motor(lower_limit=0.0)
