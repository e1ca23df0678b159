"""The common period of parts of a scenario, and the parts at a later time."""

import math

import jax.numpy as jnp
import members
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.proofs.periods import AperiodicError, period_of, shifted

Q, DQ = jnp.asarray([[0.3, 0.5], [0.2, -0.4]])
ROBOT = members.TWO_LINK
PARTS = {
    "reference": (members.REFERENCES["sinusoid"], lambda part, t: part.position(t)),
    "side": (members.SIDES["sinusoid"], lambda part, t: part.at(t, Q)),
    **{
        name: (members.DISTURBANCES[name], lambda part, t: part.torque(t, Q, DQ, *[ROBOT] * 2))
        for name in ("model_shaped", "sinusoids", "tip_force", "friction")
    },
}
"""A part that is constant or a sinusoid, and its value at a time."""


@pytest.mark.parametrize("name", PARTS)
def test_a_part_that_is_moved_in_time_has_its_values_earlier(name):
    """The part at time s is the moved one at time s - t, and so after a period."""
    part, value = PARTS[name]
    s, t = 1.3, 0.4
    expected = value(part, s)
    np.testing.assert_allclose(value(shifted(part, t), s - t), expected, rtol=1e-12)
    np.testing.assert_allclose(value(part, s + period_of({name: part})), expected, rtol=1e-9)


def test_the_period_is_that_of_the_greatest_common_divisor_and_a_part_without_one_is_named():
    for frequencies, common in (([1.0], 1.0), ([1.0, 1.5], 0.5), ([0.75, 0.5], 0.25), ([], np.inf)):
        parts = {str(w): ij.references.Sinusoid(0.0, 0.1, w) for w in frequencies}
        assert period_of(parts) == 2.0 * math.pi / common, frequencies
    with pytest.raises(AperiodicError, match=r"the period of reference \(Quintic\) is not known"):
        period_of({"reference": members.REFERENCES["quintic"]})
