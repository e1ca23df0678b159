"""Figures and animations: what they show is what the runs hold, whatever the runs are."""

import functools
import itertools

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.style
import numpy as np
import pytest
from conftest import SHORT
from drawing import drawn, lines_of
from made_up_runs import Arm3D, chain, made_up, runaway
from matplotlib import pyplot
from matplotlib.colors import to_hex
from matplotlib.text import Text
from PIL import Image
from refused import assert_refused

import iblf_jax as ij
from iblf_jax import plotting
from iblf_jax.plotting import _style
from iblf_jax.plotting._arm import FAN_RADIUS, Scene, motions_of
from iblf_jax.plotting._curves import curves_of, thinned


@pytest.fixture(scope="module")
def runs(paper, short_run):
    return {
        "k1=2": short_run,
        "k1=4": ij.simulate(ij.with_parameters(paper, {"controller.k1": 4.0}), **SHORT),
    }


@pytest.mark.slow
def test_the_paper_s_figures_of_a_long_run_magnify_the_transient():
    longer = made_up(chain(2), duration=20.0)
    figures = plotting.paper_figures(longer, note="the arm is assumed")
    for name in ("figure_3", "figure_5"):
        figures[name].draw_without_rendering()
        first, second = figures[name].axes[:2]
        # They magnify the transient in half of their width.
        width = first.get_position().width
        assert second.get_position().width == pytest.approx(width, rel=0.05), name
        assert "the transient" in second.get_title()
        assert second.get_xlim()[1] < plotting.velocity_errors(longer).axes[1].get_xlim()[1]
    for name, figure in figures.items():
        title = figure.get_suptitle()
        assert title.startswith(f"Figure {name[-1]}. ") and "the arm is assumed" in title


def test_what_is_drawn_is_what_the_run_holds(runs):
    run = runs["k1=2"]
    figure = plotting.joint(run, 1)
    position, _, error, _ = figure.axes
    for axes, name, expected in (
        (position, "$q$", run.q),
        (position, "reference $q_d$", run.q_d),
        (position, "bounds", run.lower),
        (error, "bounds", run.lower - run.q_d),
    ):
        (line,) = lines_of(axes, name)
        np.testing.assert_array_equal(line.get_xdata(), run.t, err_msg=name)
        np.testing.assert_allclose(line.get_ydata(), expected[:, 1], rtol=1e-15, err_msg=name)
    for field, make in (
        ("e2", plotting.velocity_errors),
        ("tau", plotting.torques),
        ("disturbance_estimate", plotting.uncertain_terms),
    ):
        line = make(run).axes[2].get_lines()[-1]
        np.testing.assert_array_equal(line.get_ydata(), np.asarray(getattr(run, field))[:, 1])
    (path,) = lines_of(plotting.phase_portrait(run, (1, 0)).axes[0], "$q$")
    np.testing.assert_array_equal(path.get_xydata(), run.q[:, ::-1])


def test_zooms_and_time_axes_show_runs_whole(runs):
    inset = plotting.joint(runs, 0, zoom=0.25).axes[1]
    assert inset.get_xlim() == (0.0, 0.25)
    (line,) = lines_of(inset, "k1=2")
    assert len(line.get_xdata()) == 251
    assert inset.get_ylim()[0] < min(line.get_ydata()) < max(line.get_ydata()) < inset.get_ylim()[1]
    # Runs of different length and record share one time axis.
    short = made_up(chain(2), duration=2.0, dt=0.05)
    runs = {"long": made_up(chain(2), duration=6.0), "short": short}
    axes = plotting.joint(runs).axes[0]
    assert axes.get_xlim() == (0.0, 6.0)
    assert lines_of(axes, "short")[0].get_xdata()[-1] == pytest.approx(2.0)
    assert lines_of(axes, "reference $q_d$")[0].get_xdata()[-1] == pytest.approx(6.0)


@pytest.mark.slow
def test_a_failed_run_is_named_cut_and_does_not_flatten_the_others():
    good, bad = made_up(chain(2)), runaway(chain(2))
    runs = {"good": good, "bad": bad}
    words = "bad: a bound was violated; the state ran away and was frozen"
    for name, figure in plotting.paper_figures(runs).items():
        assert words in figure.get_suptitle().replace("\n", " "), name
        low, high = figure.axes[0].get_ylim()
        assert high - low < 40, f"{name} is flattened: {low} to {high}"
    axes = plotting.joint(runs).axes[0]
    # It is drawn until it was frozen, and the place where it broke is marked.
    assert lines_of(axes, "bad")[0].get_xdata()[-1] == pytest.approx(1.5)
    assert any(line.get_marker() == "x" for line in axes.get_lines())
    drawn(bad.plot())
    assert good.plot().get_suptitle() == "Overview of the run\nstatus: ok"
    assert good.plot(title="mine").get_suptitle().startswith("mine")
    drawn(plotting.phase_portrait(runs))
    only = plotting.torques(bad).axes[0].get_ylim()
    assert np.ptp(only) < 1e3


ODD = {
    "not finite": lambda x: x * jnp.nan if x.ndim == 2 else x,
    "one sample": lambda x: x[:1] if jnp.ndim(x) else x,
}


@pytest.mark.slow
@pytest.mark.parametrize("case", ODD)
def test_a_run_without_finite_numbers_or_of_one_sample_is_drawn(case):
    run = jax.tree.map(ODD[case], made_up(chain(2), status=int(ij.Status.NOT_FINITE)))
    plotting.paper_figures(run)
    drawn(run.plot())
    drawn(plotting.joint(run))


def test_bad_arguments_are_named(tmp_path):
    run = made_up(chain(2))
    batch = jax.tree.map(lambda x: np.stack([x, x]), run)
    plotting.joint(batch[1])
    film = tmp_path / "a.gif"
    for words, function, *arguments in (
        (r"batch of 2 runs.*run\[0\]", plotting.overview, batch),
        (r"runs\['b'\].*run\[0\]", plotting.joint, {"a": run, "b": batch}),
        ("expected a joint, 0 to 1, or its name. There", plotting.joint, run, "elbow"),
        ("at least one run", plotting.torques, {}),
        ("a Rollout", plotting.torques, [1.0]),
        ("a Rollout", plotting.overview, {"a": run}),
        ("number of joints", plotting.torques, {"a": run, "b": made_up(chain(3))}),
        ("two different joints", plotting.phase_portrait, run, (1, 1)),
        (r"zoom: got -1\.0", functools.partial(plotting.joint, zoom=-1.0), run),
        ("formats: got 'docx'", plotting.save, {"a": plotting.torques(run)}, tmp_path, ("docx",)),
        (r"\.gif or \.html", plotting.animate, run, tmp_path / "a.mp4"),
        ("fps: got 0", functools.partial(plotting.animate, fps=0), run, film),
        ("speed", functools.partial(plotting.animate, speed=-1), run, film),
    ):
        assert_refused(words, function, *arguments)
    assert not list(tmp_path.iterdir()), "nothing is written when an argument is bad"


def colours_of(figure):
    """Colours of all text that is shown."""
    texts = [x for x in figure.findobj(Text) if x.get_visible() and x.get_text().strip()]
    return {to_hex(text.get_color()) for text in texts}


@pytest.mark.slow
def test_figures_follow_the_user_s_style(runs):
    dark = matplotlib.style.library["dark_background"]
    with matplotlib.rc_context(dark | {"font.size": 16.0, "lines.linewidth": 3.0}):
        cycle = matplotlib.rcParams["axes.prop_cycle"].by_key()["color"]
        figures = [plotting.joint(runs), runs["k1=2"].plot(), plotting.phase_portrait(runs)]
    for figure in figures:
        # Outside of the user's context the figure keeps the style that it was made in.
        drawn(figure)
        assert to_hex(figure.get_facecolor()) == to_hex(figure.axes[0].get_facecolor()) == "#000000"
        assert colours_of(figure) == {"#ffffff"}
        assert figure.axes[0].xaxis.label.get_size() == pytest.approx(16.0)
        assert figure.axes[0].get_yticklabels()[0].get_size() == pytest.approx(16.0 * 8 / 9)
    (line,) = lines_of(figures[0].axes[0], "k1=4")
    assert (to_hex(line.get_color()), line.get_linewidth()) == (cycle[1], 3.0)
    before = dict(matplotlib.rcParams)
    drawn(plotting.joint(runs))
    assert dict(matplotlib.rcParams) == before and pyplot.get_fignums() == []


@ij.component
class NamedArm(Arm3D):
    joints = ("base_yaw", "_hidden", "cost$5$")


@pytest.mark.slow
def test_joints_have_the_names_of_the_robot_s_file():
    run = made_up(NamedArm(3), duration=1.0)
    figure = run.plot()
    names = ["base_yaw", " _hidden", r"cost\$5\$"]
    assert [axes.get_title() for axes in figure.axes[:3]] == names
    assert set(names) <= {text.get_text() for text in figure.legends[0].get_texts()}
    drawn(figure)
    assert plotting.torques(run).axes[0].get_ylabel().startswith("base_yaw\n")
    assert "of  _hidden" in plotting.joint(run, 1).get_suptitle()
    curves = curves_of(run)
    bars = Scene(curves, *motions_of(curves, np.linspace(0.0, 1.0, 3))).bars
    assert [text.get_text() for text in bars.get_yticklabels()] == names


LABELS = ["plant.link[forearm_2].mass [kg]", r"$f$ (broad), $\hat f$ [N m]", r"cost\$5\$ of 0.05"]


@pytest.mark.parametrize("words", [*LABELS, "x" * 50, ""])
def test_a_wrapped_label_keeps_its_words_and_formulas(words):
    lines = _style.wrapped(words, 9).split("\n")
    assert "".join(lines).replace(" ", "") == words.replace(" ", "")
    assert all(line.replace(r"\$", "").count("$") % 2 == 0 for line in lines)
    assert all(len(line) <= 9 or "$" in line for line in lines)


def test_thinning_keeps_every_peak_and_both_ends():
    t = np.linspace(0.0, 1.0, 100_001)
    y = np.sin(7 * t)
    y[[333, 77_777]] = 9.0, -9.0
    y[500] = np.nan
    thin_t, thin_y = thinned(t, y)
    assert len(thin_t) < 3000 and (thin_t[0], thin_t[-1]) == (0.0, 1.0)
    assert (np.nanmin(thin_y), np.nanmax(thin_y)) == (-9.0, 9.0)
    np.testing.assert_array_equal(thin_y, y[np.searchsorted(t, thin_t)])


@pytest.mark.slow
def test_an_animation_moves_in_a_film_and_on_a_page(tmp_path):
    plant = chain(4)
    runs = {"a": made_up(plant, duration=1.0), "b": made_up(plant, duration=0.5, shift=0.1)}
    path = plotting.animate(runs, tmp_path / "arm.gif", fps=4)
    pictures = []
    with Image.open(path) as film:
        assert (film.n_frames, film.info["duration"]) == (5, 250)
        for frame in (0, 2, 4):
            film.seek(frame)
            pictures.append(np.asarray(film.convert("RGB")).astype(int))
    assert pictures[0][0, 0].tolist() == [255, 255, 255]
    assert all(np.abs(a - b).max() > 50 for a, b in itertools.pairwise(pictures))
    page = plotting.animate(runs, tmp_path / "arm.html", fps=8, speed=2.0).read_text()
    assert page.count("data:image/png;base64") == 5 and "<input" in page


def test_joint_limits_are_drawn_where_the_robot_would_be_at_them():
    plant, run = chain(3), made_up(chain(3))
    world, (motion,) = motions_of(curves_of(run), np.array([0.7]))
    q = motion.q[0]
    for joint in range(3):
        for bound, corner in ((world.lower[0, joint], 1), (world.upper[0, joint], -2)):
            there = np.asarray(plant.skeleton(jnp.asarray(q).at[joint].set(bound)))
            expected = there[joint] + FAN_RADIUS * (there[joint + 1] - there[joint])
            np.testing.assert_allclose(world.fans[0, joint, corner], expected, atol=1e-6)
