"""Figures and animations: what they show is what the runs hold, whatever the runs are."""

import dataclasses
import itertools
import warnings

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.style
import numpy as np
import pytest
from conftest import SHORT
from made_up_runs import Arm3D, chain, made_up, runaway
from matplotlib.colors import to_hex
from matplotlib.text import Text
from PIL import Image

import iblf_jax as ij
from iblf_jax import plotting
from iblf_jax.plotting import _style
from iblf_jax.plotting._arm import Scene, motions_of
from iblf_jax.plotting._curves import curves_of, thinned

SIX = [f"figure_{k}" for k in range(1, 7)]


@pytest.fixture(scope="module")
def runs(paper, short_run):
    """The start of the paper's run, with two gains."""
    return {
        "k1=2": short_run,
        "k1=4": ij.simulate(ij.with_parameters(paper, {"controller.k1": 4.0}), **SHORT),
    }


def lines_of(axes, name):
    return [line for line in axes.get_lines() if line.get_label() == name]


def texts_of(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def drawn(figure):
    """Draws the figure for good; any warning of matplotlib's is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return figure._repr_png_()


@pytest.mark.slow
def test_the_paper_s_figures_have_their_panels_and_units(runs):
    figures = plotting.paper_figures(runs)
    assert list(figures) == SIX
    labels = {
        name: [axes.get_ylabel() for axes in figure.axes if axes.get_ylabel()]
        for name, figure in figures.items()
    }
    assert labels["figure_1"] == ["(a) $x_{11}$ [rad]", "(b) $e_{11}$ [rad]"]
    assert labels["figure_2"] == ["(a) $x_{12}$ [rad]", "(b) $e_{12}$ [rad]"]
    assert labels["figure_3"] == ["(a) $e_{21}$ [rad/s]", "(b) $e_{22}$ [rad/s]"]
    assert labels["figure_4"] == [r"(a) $f_{s\_un,1}$ [N m]", r"(b) $f_{s\_un,2}$ [N m]"]
    assert labels["figure_5"] == [r"(a) $\tau_{1}$ [N m]", r"(b) $\tau_{2}$ [N m]"]
    assert labels["figure_6"] == ["$x_{12}$ [rad]"]
    for name, figure in figures.items():
        assert len(figure.axes) == (1 if name == "figure_6" else 4), name
        assert set(runs) <= {text.split(" ")[0] for text in texts_of(figure)}, name
        assert figure.axes[-1].get_xlabel() in ("time $t$ [s]", "$x_{11}$ [rad]")
        assert figure.get_suptitle().startswith(f"Figure {name[-1]}. ")
        assert "failed" not in figure.get_suptitle()


def test_what_is_drawn_is_what_the_run_holds(runs):
    run = runs["k1=2"]
    figure = plotting.joint(run, 1)
    position, _, error, _ = figure.axes
    (line,) = lines_of(position, "$q$")
    np.testing.assert_array_equal(line.get_xydata(), np.stack([run.t, run.q[:, 1]], axis=-1))
    (reference,) = lines_of(position, "reference $q_d$")
    np.testing.assert_array_equal(reference.get_ydata(), run.q_d[:, 1])
    (lower,) = lines_of(position, "bounds")
    np.testing.assert_array_equal(lower.get_ydata(), run.lower[:, 1])
    (k_l,) = lines_of(error, "bounds")
    np.testing.assert_allclose(k_l.get_ydata(), run.lower[:, 1] - run.q_d[:, 1])
    for field, make in (
        ("e2", plotting.velocity_errors),
        ("tau", plotting.torques),
        ("disturbance_estimate", plotting.uncertain_terms),
    ):
        line = make(run).axes[2].get_lines()[-1]
        np.testing.assert_array_equal(line.get_ydata(), np.asarray(getattr(run, field))[:, 1])
    (path,) = lines_of(plotting.phase_portrait(run, (1, 0)).axes[0], "$q$")
    np.testing.assert_array_equal(path.get_xydata(), run.q[:, ::-1])


def test_the_zoom_shows_the_start_at_full_resolution_and_whole(runs):
    figure = plotting.joint(runs, 0, zoom=0.25)
    inset = figure.axes[1]
    assert inset.get_xlim() == (0.0, 0.25)
    (line,) = lines_of(inset, "k1=2")
    assert len(line.get_xdata()) == 251
    assert inset.get_ylim()[0] < min(line.get_ydata()) < max(line.get_ydata()) < inset.get_ylim()[1]


def test_the_zoom_is_as_long_as_the_transient():
    run = made_up(chain(2), duration=20.0)
    ends = [make(run).axes[1].get_xlim()[1] for make in (plotting.torques, plotting.joint)]
    assert 0.2 < ends[0] < ends[1] < 4.0, (
        "the torque settles at a rate of 9 1/s, the error at 3 1/s"
    )


def test_shared_bounds_and_uncertain_terms_are_drawn_once_others_each():
    one, same, wider = made_up(chain(2)), made_up(chain(2), shift=0.02), made_up(chain(2))
    upper = wider.level_upper + 0.2
    wider = dataclasses.replace(wider, level_upper=upper, disturbance=2 * wider.disturbance)
    for pair, sides, terms in (
        ({"a": one, "b": same}, 1, ["$f$"]),
        ({"a": one, "b": wider}, 2, ["a $f$", "b $f$"]),
    ):
        assert len(lines_of(plotting.joint(pair).axes[0], "bounds")) == sides
        assert [
            text for text in texts_of(plotting.uncertain_terms(pair)) if text.endswith("$f$")
        ] == terms


def test_runs_of_different_length_and_record_share_one_time_axis():
    runs = {
        "long": made_up(chain(2), duration=6.0),
        "short": made_up(chain(2), duration=2.0, dt=0.05),
    }
    axes = plotting.joint(runs).axes[0]
    assert axes.get_xlim() == (0.0, 6.0)
    assert lines_of(axes, "short")[0].get_xdata()[-1] == pytest.approx(2.0)
    assert lines_of(axes, "reference $q_d$")[0].get_xdata()[-1] == pytest.approx(6.0)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 4])
def test_every_figure_scales_to_n_joints(n):
    run = made_up(chain(n))
    for make in (plotting.velocity_errors, plotting.uncertain_terms, plotting.torques):
        assert len(make({"a": run, "b": run}).axes) == 2 * n
    figure = run.plot()
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[:n] == [f"joint {k}" for k in range(n)]
    assert len(figure.axes) == n + (6 if n > 1 else 5)
    drawn(figure)


def test_the_overview_names_units_and_status(runs):
    figure = runs["k1=2"].plot()
    labels = {axes.get_ylabel() for axes in figure.axes}
    assert {
        "position $q$ [rad]",
        "error $e_1$ [rad]",
        r"relative error $\xi$ [1]",
        r"torque $\tau$ [N m]",
    } <= labels
    assert figure.get_suptitle() == "Overview of the run\nstatus: ok"
    assert runs["k1=2"].plot(title="mine").get_suptitle().startswith("mine")


@pytest.mark.slow
def test_a_failed_run_is_named_cut_and_does_not_flatten_the_others():
    good, bad = made_up(chain(2)), runaway(chain(2))
    runs = {"good": good, "bad": bad}
    for name, figure in plotting.paper_figures(runs).items():
        assert (
            "bad: a bound was violated; the state ran away and was frozen"
            in figure.get_suptitle().replace("\n", " ")
        ), name
        low, high = figure.axes[0].get_ylim()
        assert high - low < 40, f"{name} is flattened: {low} to {high}"
    axes = plotting.joint(runs).axes[0]
    assert lines_of(axes, "bad")[0].get_xdata()[-1] == pytest.approx(1.5), (
        "drawn until it was frozen"
    )
    assert any(line.get_marker() == "x" for line in axes.get_lines()), (
        "the place where it broke is marked"
    )
    drawn(bad.plot())
    drawn(plotting.phase_portrait(runs))
    only = plotting.torques(bad).axes[0].get_ylim()
    assert np.ptp(only) < 1e3


@pytest.mark.slow
def test_a_run_without_one_finite_number_still_gives_a_figure():
    run = made_up(chain(2), status=int(ij.Status.NOT_FINITE))
    run = jax.tree.map(lambda x: x * jnp.nan if x.ndim == 2 else x, run)
    drawn(run.plot())
    drawn(plotting.joint(run))


@pytest.mark.slow
def test_a_run_of_one_sample_is_drawn():
    run = jax.tree.map(lambda x: x[:1] if jnp.ndim(x) else x, made_up(chain(2)))
    plotting.paper_figures(run)
    drawn(run.plot())


def test_bad_arguments_are_named(runs, tmp_path):
    run = made_up(chain(2))
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), run)
    with pytest.raises(ValueError, match=r"batch of 2 runs.*run\[0\]"):
        plotting.overview(batch)
    with pytest.raises(ValueError, match=r"runs\['b'\].*run\[0\]"):
        plotting.joint({"a": run, "b": batch})
    plotting.joint(batch[1])
    with pytest.raises(ValueError, match=r"joint: got 2, expected a joint, 0 to 1"):
        plotting.joint(run, 2)
    with pytest.raises(ValueError, match="at least one run"):
        plotting.torques({})
    with pytest.raises(ValueError, match="a Rollout"):
        plotting.torques([1.0])
    with pytest.raises(ValueError, match="a Rollout"):
        plotting.overview({"a": run})
    with pytest.raises(ValueError, match="number of joints"):
        plotting.torques({"a": run, "b": made_up(chain(3))})
    with pytest.raises(ValueError, match="two different joints"):
        plotting.phase_portrait(run, (1, 1))
    with pytest.raises(ValueError, match=r"zoom: got -1\.0"):
        plotting.joint(run, zoom=-1.0)
    with pytest.raises(ValueError, match="formats: got 'docx'"):
        plotting.save({"a": plotting.torques(run)}, tmp_path, ("docx",))
    for path, options, said in (
        ("a.mp4", {}, r"\.gif or \.html"),
        ("a.gif", {"fps": 0}, "fps: got 0"),
        ("a.gif", {"speed": -1}, "speed"),
    ):
        with pytest.raises(ValueError, match=said):
            plotting.animate(run, tmp_path / path, **options)
    assert not list(tmp_path.iterdir()), "nothing is written when an argument is bad"


@pytest.mark.slow
def test_save_writes_every_format(runs, tmp_path):
    figures = plotting.paper_figures(runs)
    paths = plotting.save({"figure_6": figures["figure_6"]}, tmp_path / "new" / "folder")
    assert [path.name for path in paths] == ["figure_6.png", "figure_6.pdf"]
    assert paths[1].read_bytes().startswith(b"%PDF")
    assert Image.open(paths[0]).size[0] > 800
    assert figures["figure_6"].get_layout_engine() is not None


@pytest.mark.slow
def test_no_global_state_is_touched_and_no_figure_stays_open(runs):
    from matplotlib import pyplot

    before = dict(matplotlib.rcParams)
    figure = plotting.joint(runs)
    assert drawn(figure).startswith(b"\x89PNG"), "a notebook shows this"
    assert dict(matplotlib.rcParams) == before
    assert pyplot.get_fignums() == []


def colours_of(figure):
    """Colours of all text that is shown."""
    texts = [
        text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()
    ]
    return {to_hex(text.get_color()) for text in texts}


@pytest.mark.slow
def test_figures_follow_the_user_s_style(runs):
    with matplotlib.rc_context(
        matplotlib.style.library["dark_background"] | {"font.size": 16.0, "lines.linewidth": 3.0}
    ):
        cycle = matplotlib.rcParams["axes.prop_cycle"].by_key()["color"]
        figures = [plotting.joint(runs), runs["k1=2"].plot(), plotting.phase_portrait(runs)]
    for figure in figures:
        drawn(
            figure
        )  # outside of the user's context: the figure keeps the style that it was made in
        assert to_hex(figure.get_facecolor()) == to_hex(figure.axes[0].get_facecolor()) == "#000000"
        assert colours_of(figure) == {"#ffffff"}
        assert figure.axes[0].xaxis.label.get_size() == pytest.approx(16.0)
        assert figure.axes[0].get_yticklabels()[0].get_size() == pytest.approx(16.0 * 8 / 9)
    (line,) = lines_of(figures[0].axes[0], "k1=4")
    assert (to_hex(line.get_color()), line.get_linewidth()) == (cycle[1], 3.0)
    with matplotlib.rc_context(
        {"axes.grid": True, "grid.color": "red", "text.color": "blue", "axes.facecolor": "#eeeeee"}
    ):
        axes = plotting.joint(runs).axes[0]
    assert to_hex(axes.get_xgridlines()[0].get_color()) == "#ff0000"
    assert to_hex(axes.get_facecolor()) == "#eeeeee"
    assert axes.xaxis.label.get_size() == 9.0
    assert to_hex(lines_of(axes, "k1=4")[0].get_color()) == _style.COLOURS[1].lower()


@ij.component
class NamedArm(Arm3D):
    joints = ("base_yaw", "_hidden", "cost$5$")


@pytest.mark.slow
def test_joints_have_the_names_of_the_robot_s_file():
    run = made_up(NamedArm(3), duration=1.0)
    figure = run.plot()
    assert [axes.get_title() for axes in figure.axes[:3]] == ["base_yaw", " _hidden", r"cost\$5\$"]
    assert {"base_yaw", " _hidden", r"cost\$5\$"} <= set(texts_of(figure))
    drawn(figure)
    assert plotting.torques(run).axes[0].get_ylabel().startswith("base_yaw\n")
    assert "of  _hidden" in plotting.joint(run, 1).get_suptitle()
    curves = curves_of(run)
    bars = Scene(curves, *motions_of(curves, np.linspace(0.0, 1.0, 3))).bars
    assert [text.get_text() for text in bars.get_yticklabels()] == [
        "base_yaw",
        " _hidden",
        r"cost\$5\$",
    ]


def test_a_spike_is_cut_and_named():
    calm = made_up(chain(2))
    spiky = dataclasses.replace(calm, tau=calm.tau.at[3, 1].set(-4321.5))
    for run, said in ((calm, []), (spiky, ["peak \N{MINUS SIGN}4321.5 N m, joint 1, t = 0.03 s"])):
        (axes,) = [axes for axes in run.plot().axes if "torque" in axes.get_ylabel()]
        assert [text.get_text() for text in axes.texts] == said
        assert np.ptp(axes.get_ylim()) < 60


@pytest.mark.slow
def test_no_row_has_a_panel_alone_and_no_labels_meet():
    assert [_style.row_sizes(n, 4) for n in (1, 5, 13)] == [[1], [3, 2], [4, 3, 3, 3]]
    with _style.styled():
        figure = _style.new_figure(10.0, 8.0)
        rows = _style.panel_rows(figure, 13, 4)
    for axes in itertools.chain(*rows):
        axes.set_xlabel(
            "plant.link[the_very_long_name_of_a_link_of_somebody].friction_width [rad/s]"
        )
        axes.set_ylabel("worst xi margin of all joints together, as a part of the bound [1]")
    figure.draw_without_rendering()  # at the figure's own resolution, in which extents are given
    boxes = [axes.xaxis.label.get_window_extent() for axes in itertools.chain(*rows)]
    boxes += [axes.yaxis.label.get_window_extent() for axes in itertools.chain(*rows)]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


@pytest.mark.parametrize(
    "words",
    [
        "plant.link[forearm_2].mass [kg]",
        r"$f$ (broad), $\hat f$ [N m]",
        r"cost\$5\$ of 0.05",
        "x" * 50,
        "",
    ],
)
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
    assert len(thin_t) < 3000
    assert (thin_t[0], thin_t[-1]) == (0.0, 1.0)
    assert np.nanmax(thin_y) == 9.0
    assert np.nanmin(thin_y) == -9.0
    np.testing.assert_array_equal(thin_y, y[np.searchsorted(t, thin_t)])


@pytest.mark.slow
@pytest.mark.parametrize("plant", [chain(4), Arm3D(3)], ids=["plane", "space"])
def test_an_animation_moves(plant, tmp_path):
    runs = {"a": made_up(plant, duration=1.0), "b": made_up(plant, duration=0.5, shift=0.1)}
    path = plotting.animate(runs, tmp_path / "arm.gif", fps=4)
    with Image.open(path) as film:
        assert film.n_frames == 5
        assert film.info["duration"] == 250
        pictures = []
        for frame in (0, 2, 4):
            film.seek(frame)
            pictures.append(np.asarray(film.convert("RGB")).astype(int))
    assert pictures[0][0, 0].tolist() == [255, 255, 255]
    assert all(np.abs(a - b).max() > 50 for a, b in itertools.pairwise(pictures))


@pytest.mark.slow
def test_an_animation_as_a_page(tmp_path):
    path = plotting.animate(
        made_up(chain(2), duration=1.0), tmp_path / "arm.html", fps=8, speed=2.0
    )
    page = path.read_text()
    assert page.count("data:image/png;base64") == 5
    assert "<input" in page


def test_joint_limits_are_drawn_where_the_robot_would_be_at_them():
    from iblf_jax.plotting._arm import FAN_RADIUS

    plant, run = chain(3), made_up(chain(3))
    world, (motion,) = motions_of(curves_of(run), np.array([0.7]))
    q = motion.q[0]
    for joint in range(3):
        for bound, corner in ((world.lower[0, joint], 1), (world.upper[0, joint], -2)):
            there = np.asarray(plant.skeleton(jnp.asarray(q).at[joint].set(bound)))
            expected = there[joint] + FAN_RADIUS * (there[joint + 1] - there[joint])
            np.testing.assert_allclose(world.fans[0, joint, corner], expected, atol=1e-6)


@pytest.mark.slow
def test_the_paper_s_figures_3_and_5_magnify_the_transient_in_half_of_their_width():
    runs = made_up(chain(2), duration=20.0)
    figures = plotting.paper_figures(runs, note="the arm is assumed")
    for name in ("figure_3", "figure_5"):
        figure = drawn_figure(figures[name])
        main, inset = (axes.get_position().width for axes in figure.axes[:2])
        assert inset == pytest.approx(main, rel=0.05), name
        assert "the transient" in figure.axes[1].get_title()
        end = figure.axes[1].get_xlim()[1]
        assert end < plotting.velocity_errors(runs).axes[1].get_xlim()[1]
    assert all("the arm is assumed" in figure.get_suptitle() for figure in figures.values())


def drawn_figure(figure):
    """The figure with its final layout."""
    figure.draw_without_rendering()
    return figure
