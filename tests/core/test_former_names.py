"""Former public names are refused with what to write in their place."""

import dataclasses
import importlib
import re

import pytest

import iblf_jax as ij
from iblf_jax.core.former_names import NAMES

RENAMED = [(module, *pair) for module, names in NAMES.items() for pair in names.items()]


@pytest.mark.parametrize(("module", "former", "present"), RENAMED)
def test_a_former_name_is_refused_with_the_present_one(module, former, present):
    found = importlib.import_module(module)
    assert not hasattr(found, former)
    with pytest.raises(AttributeError, match=f"{former}.*now named {re.escape(present)}"):
        getattr(found, former)
    assert hasattr(found, re.match(r"\w+", present)[0])


def test_a_former_argument_is_refused_with_the_present_one():
    scenario = ij.presets.zhang_yan_2024()
    for call in (ij.presets.zhang_yan_2024, ij.controllers.Backstepping):
        with pytest.raises(TypeError, match=r"Write variant=\.\.\. in its place"):
            call(reading="corrected")
    with pytest.raises(ValueError, match=r"Write bounds=\(positions, velocities\) in its place"):
        ij.with_parts(scenario, velocity_bounds=scenario.bounds[0])
    # An argument is a former one only where the present one is known.
    with pytest.raises(TypeError, match="reading") as error:
        ij.presets.zhang_yan_2024_full_state(reading="corrected")
    assert "in its place" not in str(error.value)


@pytest.mark.parametrize(
    ("former", "member", "present"),
    [("filters", True, "has_slack"), ("completed", lambda law, context, x: law, "with_defaults")],
)
def test_a_former_member_of_a_law_is_refused_with_the_present_one(former, member, present):
    scenario = ij.presets.zhang_yan_2024()
    cls = type("Own", (ij.controllers.PDGravity,), {former: member})
    law = ij.controllers.Saturated(ij.controllers.PDGravity(Kp=60.0, Kd=20.0), limit=50.0)
    own = ij.component(cls)(Kp=60.0, Kd=20.0)
    with pytest.raises(ValueError, match=rf"Scenario\.controller\.{former}.*`{present}`"):
        ij.with_parts(scenario, controller=own)
    with pytest.raises(ValueError, match=rf"Saturated\.law\.{former}.*`{present}`"):
        dataclasses.replace(law, law=own)
