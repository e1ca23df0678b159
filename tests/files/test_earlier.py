"""Files that were written before the bounds and the signals of all levels had one form: commit
39377443 wrote those in `tests/data/earlier`."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.files.earlier import fields_of_line, order_of_leaves
from iblf_jax.simulation.paths import get

EARLIER = Path(__file__).parents[1] / "data" / "earlier"
PRESETS = {"robot": ij.presets.zhang_yan_2024_full_state, "plant": ij.presets.motor_driven_two_link}
VARIED = {
    "robot": ("velocity_bounds.upper.offset", "bounds[1].upper.offset"),
    "plant": ("state_bounds[1].upper.value", "bounds[2].upper.value"),
}
"""Path of the leaf whose first entry differs between many runs: the earlier and the present one."""
ABOVE = {"higher": "x", "e_higher": "e", "higher_lower": "level_lower"}


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    """Field -> array of the run in a file, read without this package."""
    with np.load(path) as archive:
        fields = json.loads(archive["result.json"])["result"]["fields"]
        given = {name: node for name, node in fields.items() if isinstance(node, dict)}
        return {name: archive[str(x["jax"])] for name, x in given.items() if "jax" in x}


@pytest.mark.parametrize("kind", PRESETS)
def test_a_scenario(kind):
    given, made = ij.load_scenario(EARLIER / f"{kind}.toml"), PRESETS[kind]()
    values = [{p.path: np.asarray(p.value) for p in ij.parameters(x)} for x in (given, made)]
    assert values[0].keys() == values[1].keys()
    for path, value in values[0].items():
        np.testing.assert_allclose(value, values[1][path], rtol=1e-14, err_msg=path)


@pytest.mark.parametrize("kind", PRESETS)
def test_bounds_of_levels_have_their_earlier_place_beside_the_regions(kind):
    """Before them for a robot, behind them for another plant; all other leaves keep their order."""
    field = "velocity_bounds" if kind == "robot" else "state_bounds"
    walls = (ij.regions.HalfSpace(normal=[0.0, 1.0], offset=0.45),)
    scenario = ij.with_parts(PRESETS[kind](), regions=walls)
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(scenario)]
    order = order_of_leaves({field: {}}, scenario)
    earlier = [paths[number] for number in order]
    above, regions = (
        [i for i, path in enumerate(earlier) if path.startswith(start)]
        for start in ((".bounds[1]", ".bounds[2]"), ".regions")
    )
    assert above and regions
    assert max(above) < min(regions) if kind == "robot" else min(above) > max(regions)
    others = [number for i, number in enumerate(order) if i not in above]
    assert others == sorted(others)


@pytest.mark.parametrize("ending", [".result", ".npz"])
@pytest.mark.parametrize("count", ["", "_many"])
@pytest.mark.parametrize("kind", PRESETS)
def test_runs(kind, count, ending):
    if (kind, count, ending) == ("robot", "_many", ".result"):
        with pytest.raises(ValueError, match=r"many scenarios of a FullState.*save_rollouts"):
            ij.load(EARLIER / "robot_many.result")
        return
    found = ij.load(EARLIER / f"{kind}{count}{ending}")
    run = found["many"] if isinstance(found, dict) else found
    stored = arrays_of(EARLIER / f"{kind}{count}.result")
    for name in ("t", "q", "dq", "tau", "e1", "e2", "lower", "dq_lower", "dq_upper", "alpha"):
        np.testing.assert_array_equal(getattr(run, name), stored[name], err_msg=name)
    for earlier, name in ABOVE.items():
        if earlier in stored:
            rows = np.asarray(getattr(run, name))[..., 2:, :]
            np.testing.assert_array_equal(rows, stored[earlier], err_msg=name)
    if count:
        value = get(run.scenario, VARIED[kind][1])
        np.testing.assert_allclose(value[1] / value[0], [1.1, 1.0], rtol=1e-14)
        np.testing.assert_array_equal(get(run.scenario, VARIED[kind][0]), value)


@pytest.mark.slow
@pytest.mark.parametrize("kind", PRESETS)
def test_a_run_can_be_done_again(kind):
    run = ij.load(EARLIER / f"{kind}.result")
    again = ij.simulate(run.scenario, duration=0.02, dt=1e-3, record_every=5)
    np.testing.assert_allclose(again.x, run.x, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(again.level_upper, run.level_upper, rtol=1e-14)


def test_the_name_of_a_stored_line_says_its_role():
    for name, role in {
        "inequality, case 2": "inequality",
        "inequality, own V": "own inequality",
        "weighted inequality, case 1": "weighted inequality",
        "weighted xi": "weighted",
        "envelope, case 2": "other",
    }.items():
        found = fields_of_line({"name": name, "counts": False, "first": 0.5})
        assert found == {"name": name, "enters_verdict": False, "first_broken": 0.5, "role": role}
        assert fields_of_line(found) == found
