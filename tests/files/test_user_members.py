"""A class of a user, in any table of members, is saved and loaded by its name."""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import members
import pytest
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.core.pytree import field_values
from iblf_jax.files import components


@functools.cache
def scenarios() -> tuple[ij.Scenario, ...]:
    sensor = members.SENSORS["encoder_measured"]
    arm = ij.with_parts(
        ij.presets.zhang_yan_2024(),
        controller=members.LAWS["backstepping_decays"],
        regions=(members.REGIONS["half_space"],),
        sampling=ij.Sampling(period=2e-3),
        sensor=sensor,
    )
    chain = ij.with_parts(
        ij.presets.flexible_joint_two_link(),
        sampling=ij.Sampling(period=2e-3),
        sensor=ij.sensors.Levels((sensor, *[ij.sensors.Direct()] * 2)),
        process_noise=members.PROCESS_NOISES["additive"],
    )
    moored = ij.with_parts(ij.presets.vessel(), plant=members.PLANTS["vessel_moored"])
    return arm, chain, moored


FAMILIES = {
    f"{protocol.__name__} {name}": (protocol, name)
    for protocol, family in components.FAMILIES.items()
    for name in family.tables
    if not family.module.startswith(("tuning", "studies", "metrics"))
}


def _changed(part: Any, change: Callable[[Any], Any]) -> Any:
    """A part with `change` applied to the components in it, the innermost first."""
    if isinstance(part, tuple):
        return tuple(_changed(x, change) for x in part)
    if not dataclasses.is_dataclass(part):
        return part
    values = {name: _changed(x, change) for name, x in field_values(part).items()}
    same = all(values[name] is x for name, x in field_values(part).items())
    return change(part if same else dataclasses.replace(part, **values))


def _classes(scenario: ij.Scenario) -> Iterator[type]:
    found: list[Any] = []

    def noted(part: Any) -> Any:
        found.append(part)
        return part

    _changed(scenario, noted)
    yield from map(type, found)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_class_of_a_user_in_a_scenario_file(family, tmp_path, monkeypatch):
    protocol, table = FAMILIES[family]
    found = components.FAMILIES[protocol].tables[table]
    scenario, member = next(
        (scenario, cls)
        for scenario in scenarios()
        for cls in _classes(scenario)
        if cls in found.values()
    )
    mine = ij.component(type("Mine", (member,), {"__annotations__": {}}))

    def as_mine(part: Any) -> Any:
        return mine(**field_values(part)) if type(part) is member else part

    given = _changed(scenario, as_mine)
    assert mine in set(_classes(given))
    assert_refused(rf'{table}\["my_name"\] = Mine', ij.save_scenario, given, tmp_path / "mine.toml")
    monkeypatch.setitem(found, "mine", mine)
    ij.save_scenario(given, tmp_path / "mine.toml")
    again = ij.load_scenario(tmp_path / "mine.toml")
    assert jax.tree.structure(again) == jax.tree.structure(given) and mine in set(_classes(again))
    monkeypatch.delitem(found, "mine")
    remedy = rf'kind: .*register it first: .*{table}\["mine"\] = TheClass'
    assert_refused(remedy, ij.load_scenario, tmp_path / "mine.toml")
