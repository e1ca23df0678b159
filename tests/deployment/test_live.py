"""The live page: its sliders, and its curves against `simulate`, in Node.js and in a browser where
there is one."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from refused import assert_refused

import iblf_jax as ij
from iblf_jax.deployment import build, live
from iblf_jax.deployment.loop_program import shape_of
from iblf_jax.kernels import ToolchainError
from iblf_jax.world import plants

NODE = shutil.which("node")
LAWS = {"integral": {"K2": 20.0}, "log": {"K2": 12.0, "q": 0.6}}
"""Law -> where it starts on the page with two laws."""


@pytest.fixture(scope="module")
def page():
    """A page with one scenario, whose joints have different gains."""
    uneven = ij.with_parameters(ij.presets.zhang_yan_2024(), {"controller.K2": [20.0, 33.0]})
    return ij.explore(uneven, duration=0.25, dt=5e-4)


@pytest.fixture(scope="module")
def two_laws():
    """A page with two laws of the same names of parameters, with other numbers."""
    changed = {"controller.K2": 12.0, "initial.q[0]": 0.6}
    laws = {
        "integral": ij.presets.zhang_yan_2024(),
        "log": ij.with_parameters(ij.presets.zhang_yan_2024(law="log"), changed),
    }
    return ij.explore(laws, duration=0.25, dt=5e-4)


def in_node(page, tmp_path: Path, actions: list, address: str = "") -> list[dict]:
    """What the page shows after each action: its run, the words and the places of its sliders."""
    if NODE is None:
        pytest.skip("Node.js is not installed")
    (tmp_path / "page.html").write_text(page.text, encoding="utf-8")
    (tmp_path / "actions.json").write_text(json.dumps(actions), encoding="utf-8")
    script = Path(__file__).with_name("live_page.js")
    command = [NODE, str(script), "page.html", "actions.json", address]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    # A name may contain U+2028, at which `splitlines` divides.
    return [json.loads(line) for line in done.stdout.strip().split("\n")]


def simulated(law: str, **changed: float):
    """The run that belongs to sliders of these numbers."""
    values = {"controller.K2": LAWS[law]["K2"], "initial.q[0]": LAWS[law].get("q", 0.8)} | changed
    scenario = ij.with_parameters(ij.presets.zhang_yan_2024(law=law), values)
    return np.asarray(ij.simulate(scenario, duration=0.25, dt=5e-4).q).T


@pytest.mark.slow
def test_sliders_and_curves_agree_after_a_switch_of_the_law(two_laws, tmp_path):
    actions = [
        {},
        {"move": "controller.K2", "to": np.log(37.0)},
        {"move": "initial.q[0]", "to": 0.7},
        {"law": "log"},
        {"move": "initial.q[0]", "to": 0.5},
        {"law": "integral"},
        {"law": "log"},
        {"reset": True},
    ]
    found = in_node(two_laws, tmp_path, actions)
    laws = ["integral"] * 3 + ["log"] * 2 + ["integral", "log", "log"]
    assert [one["law"] for one in found] == laws
    assert all(one["menu"] == ["Control law"] for one in found)
    for one in found:
        K2, start = np.exp(one["places"]["controller.K2"]), one["places"]["initial.q[0]"]
        assert one["shown"]["controller.K2"].startswith(f"{K2:.3g}"[:4].rstrip("."))
        assert one["shown"]["initial.q[0]"].startswith(f"{start:.3f}"[:4])
        np.testing.assert_allclose(one["q"][0][0], start, atol=1.5e-3)
        expected = simulated(one["law"], **{"controller.K2": K2, "initial.q[0]": one["q"][0][0]})
        np.testing.assert_allclose(one["q"], expected, atol=1e-3)
    np.testing.assert_array_equal(found[5]["q"], found[2]["q"])  # a law keeps its own numbers
    np.testing.assert_array_equal(found[6]["q"], found[4]["q"])
    np.testing.assert_array_equal(found[7]["q"], found[3]["q"])  # as before its slider was moved
    assert np.abs(np.subtract(found[2]["q"], found[0]["q"])).max() > 1e-2


@pytest.mark.slow
def test_numbers_of_the_address_are_those_of_sliders_and_curves(two_laws, tmp_path):
    """Values that are not used are named."""
    address = "?law=log&controller.K2=130&initial.q[0]=0.55&observer.kf=many&initial.q[1]="
    actions = [{}, {"law": "integral"}, {"law": "log"}]
    begin, other, back = in_node(two_laws, tmp_path, actions, address)
    assert (begin["law"], other["law"]) == ("log", "integral")
    for one in (begin, other, back):
        # It is beyond the usual end of the slider.
        np.testing.assert_allclose(np.exp(one["places"]["controller.K2"]), 130.0)
        assert one["shown"]["controller.K2"].startswith("130 ")
        assert one["q"][0][0] == 0.55
        assert "NaN" not in str(one["shown"])
    np.testing.assert_array_equal(begin["q"], back["q"])
    expected = simulated("log", **{"controller.K2": 130.0, "initial.q[0]": 0.55})
    np.testing.assert_allclose(begin["q"], expected, atol=1e-9)
    assert in_node(two_laws, tmp_path, [{}], "?law=constructor")[0]["law"] == "integral"
    plain, good = (
        in_node(two_laws, tmp_path, [{}], address)[0]
        for address in ("", "?controller.K2=30&initial.q[1]=0.7")
    )
    assert plain["unused"] == good["unused"] == ""
    given = ["controller.K2=8,1", "controller.k1[0]=8", "observer.kf=-1", "nonsense=3", "law=none"]
    bad = in_node(two_laws, tmp_path, [{}], "?" + "&".join([*given, "controller.o=0.2"]))[0]
    assert f"address: {', '.join(given)}." in bad["unused"]
    assert bad["q"] != good["q"]


@pytest.mark.slow
def test_gains_that_differ_between_joints_are_all_shown_until_the_slider_is_moved(page, tmp_path):
    before, after = in_node(page, tmp_path, [{}, {"move": "controller.K2", "to": np.log(20.0)}])
    assert before["shown"]["controller.K2"].startswith("20.0, 33.0 ")
    assert after["shown"]["controller.K2"].startswith("20.0 ")
    assert before["q"] != after["q"]
    assert after["words"]["controller.K2"] == "Velocity damping K2 "
    assert after["words"]["initial.q[1]"] == "Start, joint 1 "
    assert after["words"]["bounds[0].upper.offset[0]"] == "Upper bound, joint 0 "
    assert not any("." in words for words in after["words"].values())


@pytest.mark.slow
def test_a_page_names_what_leaves_its_bounds_and_where(two_laws, tmp_path):
    inside, outside = in_node(two_laws, tmp_path, [{}, {"move": "initial.q[0]", "to": 1.1}])
    assert inside["message"].startswith("ok: inside the bounds")
    assert "a bound was violated" in outside["message"]
    assert "joint 0 is above its upper bound from 0.00 s to 0." in outside["message"]
    assert "joint 1" not in outside["message"]


def test_a_planar_arm_is_drawn_with_the_ends_of_its_links_at_the_bounds():
    arm, vessel = ij.presets.zhang_yan_2024().plant, ij.presets.vessel().plant
    q, q_d, lower, upper = jnp.array([[0.3, 0.4], [0.2, 0.5], [0.1, 0.2], [0.7, 0.9]])
    shape = shape_of(plants.as_plant(arm), q, q_d, lower, upper)
    np.testing.assert_allclose(shape.points, arm.skeleton(q))
    np.testing.assert_allclose(shape.desired, arm.skeleton(q_d))
    shoulder, elbow, _ = np.asarray(arm.skeleton(q))
    for found, length, angle in (
        (shape.limits[0, 1] - shoulder, arm.length[0], 0.7),
        (shape.limits[1, 0] - elbow, arm.length[1], 0.3 + 0.2),
    ):
        expected = length * np.array([np.cos(angle), np.sin(angle)])
        np.testing.assert_allclose(found, expected, atol=1e-7)
    x = jnp.array([1.0, 2.0, 0.3])
    drawn = shape_of(vessel, x, x, x, x)
    np.testing.assert_allclose(drawn.points, vessel.outline(x))
    assert drawn.limits == ()


class Scripts(HTMLParser):
    """The scripts and comments of a page, as an HTML parser finds them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.comments: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)

    def handle_comment(self, data):
        self.comments.append(data)


NAMES = [
    "<!--<script></script><img src=x> & b",
    'say "no" \\u003c $x ${y} `z` \u2028\u2029',
    "constructor",
]


@pytest.mark.slow
def test_names_cannot_end_or_change_the_script_of_a_page(two_laws, tmp_path):
    scenario = ij.presets.zhang_yan_2024()
    page = ij.explore(dict.fromkeys(NAMES, scenario), duration=0.02, dt=2e-3)
    data = re.search(r"const LOOPS = (.*);", page.text)[1]
    assert not set(data) & set("<>&\u2028\u2029")
    assert list(json.loads(data)) == NAMES
    found, plain = Scripts(page.text), Scripts(two_laws.text)
    assert found.tags == plain.tags and found.comments == plain.comments
    last = in_node(page, tmp_path, [{}, {"law": NAMES[0]}, {"law": "constructor"}])[-1]
    assert last["laws"] == NAMES and last["law"] == "constructor"


def test_names_of_scenarios_are_words(monkeypatch):
    monkeypatch.setattr(live, "export", None)  # nothing is built before the names are checked
    scenario = ij.presets.zhang_yan_2024()
    tables = ({}, {1: scenario}, {"__proto__": scenario}, {"a": 3}, {"a": scenario, "b": None})
    for bad in (*tables, [scenario], None):
        with pytest.raises(ValueError, match=r"scenario: got .*, expected .*cenario"):
            ij.explore(bad)


@pytest.mark.slow
def test_gains_starts_and_bounds_have_sliders(page):
    table = json.loads(re.search(r"const LOOPS = (.*);", page.text)[1])[""]["table"]
    sliders = {p["path"]: p for p in table["parameters"] if "slider" in p}
    expected = {"controller.k1", "controller.K2", "observer.kf", "initial.q"}
    assert expected | {"bounds[0].upper.offset"} <= set(sliders)
    K2 = sliders["controller.K2"]
    assert K2["slider"] == [[4.0, 100.0]] and not K2["each"]
    assert not re.search(r'(?:src|href)="(?!data:)', page.text)


@pytest.mark.slow
def test_a_notebook_shows_it_in_a_frame_and_without_a_compiler_its_figure(
    page, monkeypatch, tmp_path
):
    assert page._repr_html_().startswith("<iframe srcdoc=")

    def missing(*_, **__):
        raise ToolchainError("ziglang is not installed")

    monkeypatch.setattr(live, "export", missing)
    assert_refused("not installed", ij.explore, ij.presets.zhang_yan_2024(), error=ToolchainError)
    monkeypatch.setattr(live, "has_ziglang", lambda: False)
    without = ij.explore(ij.presets.zhang_yan_2024())
    saved = without.save(tmp_path / "live.html").read_text(encoding="utf-8")
    for shown in (without._repr_html_(), saved):
        assert "ziglang is not installed" in shown and "data:image/png" in shown
    monkeypatch.setattr(build, "TIMEOUT", 0.01)
    slow = ["sleep", "9"]
    assert_refused("sleep took more than 0.01 s", build.build, slow, tmp_path, error=ToolchainError)
