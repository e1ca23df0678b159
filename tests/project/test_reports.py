"""Results show themselves: cards in notebooks, pages that need nothing else."""

import re

import arm_cases
import jax
import numpy as np
import pytest
from stored_results import stored

import iblf_jax as ij


class Results(dict):
    """A result of each kind, read from its file when it is first needed."""

    def __missing__(self, kind):
        self[kind] = stored(f"{kind}_0")
        return self[kind]


@pytest.fixture(scope="module")
def results(paper, short_run):
    return Results(Scenario=paper, Rollout=short_run)


SAYS = {
    "Scenario": ["K2 = [20., 20.]", "Backstepping (Integral)"],
    "Rollout": ["rmse", "joint 1"],
    "Study": ["16 runs", "xi_margin"],
    "Certificate": ["inequality, case 2", "Backstepping"],
    "Comparison": ["rmse [rad]", "Held equal", "without a failure; at equal effort log"],
    "TuneResult": ["controller.K2", "before", ">joint 0</td>"],
}
PAGES = ("Rollout", "Study", "Certificate")
"""Kinds of which the page is looked at, too."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", SAYS)
def test_a_card_has_words_a_table_and_a_picture_and_a_page_needs_nothing_else(
    results, kind, tmp_path
):
    result = results[kind]
    card = result._repr_html_()
    assert type(result).__name__ == kind
    assert card.count("<table>") == (2 if kind == "Comparison" else 1)
    assert "data:image/png;base64," in card and len(card) < 300_000
    assert [words for words in SAYS[kind] if words not in card] == []
    if kind not in PAGES:
        return
    path = ij.report(result, tmp_path / "page.html", title="A <title>")
    text = path.read_text()
    assert "A &lt;title&gt;" in text and "A <title>" not in text
    assert all(source.startswith("data:") for source in re.findall(r'(?:src|href)="([^"]*)', text))
    assert f"iblf_jax {ij.__version__}" in text and f"jax {jax.__version__}" in text
    assert [words for words in SAYS[kind] if words not in text] == []
    # The scenario as a file, of what keeps it.
    assert ("[controller]" in text) == (kind != "Certificate")
    assert ("factor uniform, low 0.8, high 1.2" in text) == (kind == "Study")


@pytest.mark.slow
def test_numbers_are_those_of_the_result(results):
    run, study = results["Rollout"], results["Study"]
    assert f"{float(run.metrics.rmse[0]):.4g}" in run._repr_html_()
    worst = np.sort(study.metrics.margin, axis=0)[7].min()  # the median of 16 runs
    row = re.search(r"<td[^>]*>margin</td>.*?</tr>", study._repr_html_())[0]
    assert f"{worst:.4g}" in row


@pytest.mark.slow
def test_names_from_files_are_escaped(tmp_path):
    names = ("<script>alert(1)</script>", '"><img src=x>')
    robot = arm_cases.random_arm(2, seed=3, prismatic=0.0, joints=names)
    around = ij.Bounds(ij.bounds.Constant(-1.0), ij.bounds.Constant(1.0))
    law = ij.controllers.PDGravity(Kp=20.0, Kd=5.0)
    scenario = ij.Scenario(robot, ij.references.Sinusoid(0.1, 0.2), around, law, ij.Initial(q=0.1))
    for text in (scenario._repr_html_(), ij.report(scenario, tmp_path / "a.html").read_text()):
        assert "<script>" not in text and "<img src=x>" not in text and "&lt;script&gt;" in text


def test_what_is_traced_or_many_shows_in_words(results):
    seen = []

    @jax.jit
    def look(run):
        seen.extend([run._repr_html_(), run.scenario._repr_html_()])
        return run.q

    look(results["Rollout"])
    assert "being traced" in seen[0] and "<img" not in seen[1]


def test_a_result_without_a_card_has_a_page(results, tmp_path):
    found = ij.explain(results["Scenario"])
    assert "operations" in ij.report(found, tmp_path / "b.html").read_text()
    with pytest.raises(ValueError, match="html"):
        ij.report(results["Scenario"], tmp_path / "page.pdf")
