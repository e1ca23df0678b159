"""`benchmarks/losses.py` names what lost, and measures again before it does."""

import importlib

import pytest
from conftest import ROOT


@pytest.fixture
def losses(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("losses")


@pytest.fixture
def numbers(losses, monkeypatch):
    """Gives the turns of each tree in place of processes; the last number stays."""

    def given(**turns: list[float]) -> dict[str, int]:
        taken = dict.fromkeys(turns, 0)

        def measured(tree, measure):
            taken[tree] += 1
            number = turns[tree][: taken[tree]][-1]
            return [number] * len(measure.rows)

        monkeypatch.setattr(losses, "measured", measured)
        return taken

    return given


@pytest.mark.parametrize(
    ("before", "after", "turns", "change"),
    [
        ([1.0], [1.5, 1.02], 2, 2.0),
        ([1.0], [1.5, 1.5, 1.5, 1.0], 4, 0.0),
        ([0.8, 1.0], [1.0], 3, 0.0),
        ([1.0], [1.2], 6, 20.0),
    ],
)
def test_a_loss_is_measured_again(losses, numbers, before, after, turns, change):
    taken = numbers(before=before, after=after)
    (row,) = losses.table(("before", "after"), [losses.Measure(("a [s]",), "")])
    assert row == ["a [s]", min(before), min(after), pytest.approx(change)]
    assert taken == {"before": turns, "after": turns}


def test_losses_of_more_than_5_percent_are_named_and_large_ones_fail(losses):
    rows = [["a", 1.0, 1.04, 4.0], ["b", 1.0, 1.1, 10.0], ["c", 1.0, 0.5, -50.0]]
    assert losses.verdict(rows[:1], 15.0) == ("no row lost more than 5 %", False)
    assert losses.verdict(rows, 15.0) == ("lost: b +10 %", False)
    assert losses.verdict(rows, 8.0) == ("lost: b +10 %", True)


@pytest.mark.slow
def test_a_process_imports_the_package_of_its_tree(losses, tmp_path):
    (tmp_path / "iblf_jax").mkdir()
    (tmp_path / "iblf_jax" / "__init__.py").write_text("value = 7")
    code = "import iblf_jax\nfound = [iblf_jax.value, seconds(lambda: None)]"
    found = losses.measured(tmp_path, losses.Measure(("value", "seconds"), code))
    assert found[0] == 7
    assert 0 <= found[1] < 1
