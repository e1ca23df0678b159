"""The live page: its sliders, and its curves against `simulate`, in a browser where there is one."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess

import numpy as np
import pytest

import iblf_jax as ij
from iblf_jax.deployment import live
from iblf_jax.lowering.toolchain import ToolchainError

BROWSER = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
MOVE = """<script>
const moved = document.querySelector('input[name="controller.K2"]');
moved.value = Math.log(30); moved.dispatchEvent(new Event("input"));
</script></body>"""


@pytest.fixture(scope="module")
def page():
    return ij.explore(ij.presets.zhang_yan_2024(), duration=2.0)


def test_gains_starts_and_bounds_have_sliders(page):
    table = json.loads(re.search(r"const LOOPS = (.*);", page.text)[1])[""]["table"]
    sliders = {p["path"]: p for p in table["parameters"] if "slider" in p}
    assert {"controller.k1", "controller.K2", "observer.kf", "initial.q", "bounds.upper.offset"} <= set(sliders)
    assert sliders["controller.K2"]["slider"] == [[4.0, 100.0]] and not sliders["controller.K2"]["each"]
    assert not re.search(r'(?:src|href)="(?!data:)', page.text)


def test_a_notebook_shows_it_in_a_frame_and_without_a_compiler_its_figure(page, monkeypatch):
    assert page._repr_html_().startswith("<iframe srcdoc=")

    def missing(*_, **__):
        raise ToolchainError("ziglang is not installed")

    monkeypatch.setattr(live, "export", missing)
    shown = ij.explore(ij.presets.zhang_yan_2024())._repr_html_()
    assert "ziglang is not installed" in shown and "data:image/png" in shown


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no browser")
def test_a_slider_that_is_moved_changes_the_curve_to_what_simulate_gives(page, tmp_path):
    path = tmp_path / "page.html"
    found = {}
    for name, text in {"before": page.text, "after": page.text.replace("</body>", MOVE)}.items():
        path.write_text(text, encoding="utf-8")
        command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}", "--dump-dom", path.as_uri()]
        dom = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
        found[name] = json.loads(html.unescape(re.search(r'data-run="([^"]*)"', dom)[1]))
    for name, K2, tolerance in (("before", 20.0, 1e-9), ("after", 30.0, 1e-6)):
        scenario = ij.with_parameters(ij.presets.zhang_yan_2024(), {"controller.K2": K2})
        run = ij.simulate(scenario, duration=2.0, dt=1e-3, record_every=4)
        # A slider has 400 places: the nearest to 30 is not 30.
        place = np.exp(np.log(4.0) + np.round((np.log(30.0) - np.log(4.0)) / (np.log(25.0) / 400)) * np.log(25.0) / 400)
        if name == "after":
            run = ij.simulate(ij.with_parameters(scenario, {"controller.K2": place}), duration=2.0, dt=1e-3, record_every=4)
        np.testing.assert_allclose(np.asarray(found[name]["q"]).T, run.q, atol=tolerance)
    assert np.abs(np.subtract(found["before"]["q"], found["after"]["q"])).max() > 1e-4
