"""Scenario files of plants in strict-feedback form."""

from __future__ import annotations

import jax
import loops_of_plants
import numpy as np
import pytest

import iblf_jax as ij


@pytest.mark.slow
@pytest.mark.parametrize("case", ["flexible joint", "electric drive", "rigid law"])
def test_a_file_gives_the_same_scenario(tmp_path, case):
    scenario = (loops_of_plants.CASES | {"rigid law": loops_of_plants.rigid_law})[case]()
    ij.save_scenario(scenario, tmp_path / "scenario.toml")
    loaded = ij.load_scenario(tmp_path / "scenario.toml")
    assert jax.tree.structure(loaded) == jax.tree.structure(scenario)
    for ours, theirs in zip(jax.tree.leaves(scenario), jax.tree.leaves(loaded), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_level_without_bounds_stays_without(tmp_path):
    levels = (loops_of_plants.band(0.1, 0.9), None, loops_of_plants.band(-60.0, 60.0))
    barriers = (
        ij.barriers.TransformedError(),
        ij.barriers.Quadratic(),
        ij.barriers.TransformedError(),
    )
    law = ij.controllers.BarrierBackstepping(k=(3.0, 20.0, 60.0), barriers=barriers)
    scenario = loops_of_plants.electric_drive(bounds=levels, controller=law)
    ij.save_scenario(scenario, tmp_path / "scenario.toml")
    assert ij.load_scenario(tmp_path / "scenario.toml").bounds[1] is None


def test_a_plant_of_functions_says_what_can_be_saved(tmp_path):
    with pytest.raises(ValueError, match=r"plant\.drift: got a function.*method of a class"):
        ij.save_scenario(loops_of_plants.user_functions(), tmp_path / "scenario.toml")


def test_a_missing_gain_of_the_levels_is_named(tmp_path):
    ij.save_scenario(loops_of_plants.flexible_joint(), tmp_path / "scenario.toml")
    text = (tmp_path / "scenario.toml").read_text()
    start, end = text.index("k = ["), text.index("barriers = [")
    (tmp_path / "other.toml").write_text(text[:start] + text[end:])
    with pytest.raises(ValueError, match=r"controller\.k: got nothing.*one per level"):
        ij.load_scenario(tmp_path / "other.toml")
