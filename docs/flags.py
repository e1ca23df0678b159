"""The page "Why did my run fail?": an example run for every status flag, its figure, and the
remedy.

The tests write the sections by `section` to `out/site/flags`. `docs/build.py` reads them there, and
writes the sections that are missing or older than this file.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gallery
import jax.numpy as jnp
from alt_text import describe

import iblf_jax as ij
from iblf_jax import plotting

MADE = gallery.ROOT / "out" / "site" / "flags"


class Case(NamedTuple):
    """An example of a flag.

    `run` returns a run that has the flag, a scenario where no run is possible, or None where there
    is no figure.
    """

    run: Callable[[], Any]
    meaning: str
    remedy: str
    draw: Callable = plotting.positions


def _paper(**parts: Any) -> ij.Scenario:
    return ij.with_parts(ij.presets.zhang_yan_2024(), **parts)


def _run(scenario: ij.Scenario, duration: float = 2.0, dt: float = 1e-3, **options: Any):
    return ij.simulate(scenario, duration=duration, dt=dt, **options)


def _weak(limit: list[float]) -> ij.Scenario:
    return _paper(
        controller=ij.controllers.Saturated(ij.presets.zhang_yan_2024().controller, limit=limit)
    )


def _switching() -> ij.Scenario:
    """The paper's arm with a load that comes and goes more often than a run can follow."""
    arm = ij.presets.zhang_yan_2024().plant
    rates = [[-5.0, 5.0], [5.0, -5.0]]
    return _paper(
        plant=ij.plants.MarkovSwitched(arm, {"payload": (0.0, 0.5)}, rates=rates, switches=2)
    )


def _flexible() -> ij.Scenario:
    """A flexible arm with bounds on the velocities of its motors that its law does not know."""
    narrow = ij.Bounds(lower=ij.bounds.Constant(-0.3), upper=ij.bounds.Constant(0.3))
    preset = ij.presets.flexible_joint_two_link()
    return ij.with_parts(
        preset,
        bounds=(preset.bounds[0], None, None, narrow),
        controller=ij.controllers.BarrierBackstepping(k=(3.0, 20.0, 60.0, 150.0)),
    )


def _singular() -> ij.Scenario:
    """A chain of three integrators that loses its input."""

    def gain(t, x):
        one = jnp.ones_like(x[0])
        return jnp.stack([one, one, jnp.where(t < 0.2, one, 0.0 * one)])

    wide = ij.Bounds(lower=ij.bounds.Constant(-1.0), upper=ij.bounds.Constant(1.0))
    return ij.Scenario(
        plant=ij.plants.StrictFeedback(lambda t, x: jnp.zeros_like(x), gain, n=1, order=3),
        reference=ij.references.Sinusoid(offset=0.0, amplitude=0.5),
        bounds=wide,
        controller=ij.controllers.BarrierBackstepping(k=(2.0, 10.0, 30.0)),
        initial=ij.Initial(x=[[0.1], [0.0], [0.0]]),
    )


def _meeting() -> ij.Scenario:
    """A scenario whose upper bound decreases to the reference of the first joint."""
    upper = ij.bounds.Sinusoid(offset=0.66, amplitude=0.2, frequency=1.0, phase=1.5707963)
    return _paper(
        bounds=ij.Bounds(lower=ij.bounds.Constant(0.0), upper=upper),
        initial=ij.Initial(q=[0.6, 0.6]),
    )


def _near_the_bound() -> ij.Scenario:
    return ij.with_parameters(ij.presets.zhang_yan_2024(), {"initial.q": [1.0397, 0.8]})


def _slow() -> ij.Scenario:
    """The paper's scenario with narrow bounds on the velocities, which its law does not know."""
    paper = _paper()
    narrow = ij.Bounds(lower=ij.bounds.Constant(-0.4), upper=ij.bounds.Constant(0.6))
    return ij.with_parts(paper, bounds=(paper.bounds[0], narrow))


def _sampled(period: float, delay: float = 0.0) -> ij.Scenario:
    return ij.with_parts(
        ij.presets.zhang_yan_2024(variant="corrected"), sampling=ij.Sampling(period, delay)
    )


def _filtered() -> ij.Scenario:
    law = ij.controllers.SafetyFilter(
        ij.controllers.ComputedTorque(Kp=25.0, Kd=10.0), limit=[5.0, 1.0]
    )
    return _paper(controller=law)


@ij.component
class PowerOfE2:
    """A finite-time law, tau = ... - K2 e2 - c |e2|^0.6 sign(e2), whose derivative is infinite at
    e2 = 0.
    """

    K2: Any = ij.leaf("N m s/rad", sign="positive")
    c: Any = ij.leaf("N m", sign="positive")

    def command(self, t, q, dq, f_hat, context, state):
        """The torque."""
        tube, model = context.tube(t), context.model
        alpha = tube.dq_d - 2.0 * (q - tube.q_d)
        e2 = dq - alpha
        acceleration = tube.ddq_d - 2.0 * (dq - tube.dq_d)
        tau = model.coriolis(q, dq, dq) + model.gravity(q) + model.mass_matrix(q) @ acceleration
        tau = tau - f_hat - self.K2 * e2 - self.c * jnp.sign(e2) * jnp.abs(e2) ** 0.6
        none = jnp.zeros(q.shape, bool)
        return ij.controllers.Command(tau, alpha, (q - tube.q_d) ** 2, none, none), ()


def _at_rest() -> ij.Scenario:
    """A scenario that starts at e2 = 0."""
    scenario = _paper(controller=PowerOfE2(K2=5.0, c=2.0))
    tube = scenario.context.tube(jnp.zeros(()))
    return ij.with_parts(scenario, initial=ij.Initial(tube.q_d, tube.dq_d))


CASES: dict[str, Case] = {
    "BOUND_VIOLATED": Case(
        lambda: _run(_weak([4.0, 1.0])),
        "A joint touched or violated its bound. In this example the motors are too weak for the"
        " weight of the arm, so that no law can satisfy the bounds.",
        "Inspect the first violation (`run.metrics.first_violation_time`), and check whether the"
        " torque was saturated or the start was outside the bounds. Otherwise the gains are too"
        " small for the uncertain term: increase `K2`, or `k` and `weights` of"
        " `BarrierBackstepping` and the gain of its `LevelObserver`, or tune the gains.",
    ),
    "NOT_FINITE": Case(
        lambda: _run(_sampled(4e-3, 4e-3), dt=4e-3),
        "The state diverged and was frozen at its last finite value. The signals after this instant"
        " have no meaning. In this example the law is sampled too slowly.",
        "Other flags of the same run name the reason, such as a time step or a sampling period that"
        " is too large. Otherwise reduce the gains.",
    ),
    "STEP_TOO_LARGE": Case(
        lambda: _run(_paper(), dt=0.04),
        "The product of dt and the fastest eigenvalue of the closed loop is outside the stability"
        " region of the integrator. The oscillation is numerical and not physical.",
        "Use the step that the warning names, or the one that `ij.recommended_dt(scenario,"
        " duration=...)` returns.",
    ),
    "INFEASIBLE_REFERENCE": Case(
        _meeting,
        "The reference touches or violates a bound, so that no law can follow it and satisfy the"
        " bounds (Assumption 2). A single run raises an error that names joint and time; runs of a"
        " batch or a study have this flag. A safety filter satisfies its bounds for every"
        " reference, so its runs do not have the flag.",
        "Change the reference, or widen the bounds. `ij.plotting.tube(scenario)` plots both without"
        " a simulation.",
        lambda scenario: plotting.tube(scenario, duration=4.0),
    ),
    "TORQUE_SATURATED": Case(
        lambda: _run(_weak([9.0, 4.0])),
        "The commanded torque exceeded its limit. This flag is a remark and not a failure, but"
        " `run.ok` is false: in this example the bounds are satisfied.",
        "No action is needed if the bounds are satisfied and no certificate is required. Otherwise"
        " reduce the gains, or tune them with `peak_torque_below`.",
        plotting.torques,
    ),
    "GUARD_ACTIVE": Case(
        lambda: _run(_near_the_bound()),
        "The distance of a joint from its bound was below a thousandth of its range, where a guard"
        " limits the slope of the barrier. In this example the run starts there.",
        "No action is needed if the guard was active at the start only. The argument `guard=` of a"
        " barrier changes the default of 1e-3.",
    ),
    "GUARD_STAYED": Case(
        lambda: _run(_weak([4.0, 1.0])),
        "The guard was active beyond the first instant. Meanwhile the slope of the barrier was"
        " smaller than that of the requested law.",
        "The run does not represent the law. Find the reason for the small distance from the bound:"
        " torque limits, a payload, or too large a time step.",
    ),
    "INACCURATE": Case(
        lambda: _run(_paper(), dt=5e-3),
        "The estimated error of the positions exceeds 0.5 % of the distance between the bounds. The"
        " numbers of this run are not reliable.",
        "Use the time step that the warning names.",
    ),
    "INFINITE_SLOPE": Case(
        lambda: _run(_at_rest(), dt=1e-2),
        "The run is inaccurate, or its time step is too large, and at an isolated instant a"
        " derivative of the closed loop is infinite: in this example that of |e2|^0.6 sign(e2) with"
        " respect to e2, at e2 = 0. It is not an eigenvalue of the loop, and the assessment of the"
        " time step excludes it.",
        "Use the time step that the warning names, or replace the power by e2 (e2^2 + delta^2)^((a"
        " - 1)/2) with a small delta.",
    ),
    "SAMPLING_TOO_SLOW": Case(
        lambda: _run(_sampled(4e-3), dt=1e-3),
        "The one-period map of the sampled loop is unstable: its spectral radius,"
        " `run.metrics.sampling_radius`, is above 1 at a state that this run visits. Slow growth"
        " that the loop shows in continuous time as well does not raise the flag.",
        "Use a shorter period; `ij.recommended_period(scenario, duration=...)` returns one. Or"
        " change the term that limits the loop, which the warning names: the slope of the barrier"
        " (`weight`), `K2`, `kf`, a filter, a lag or the delay.",
    ),
    "VELOCITY_VIOLATED": Case(
        lambda: _run(_slow()),
        "A joint exceeded its velocity bound. The law of this example does not use velocity"
        " bounds.",
        "Use `controllers.BarrierBackstepping` with two barriers, which bounds positions and"
        " velocities, or reduce `k1`.",
        plotting.velocities,
    ),
    "ALPHA_INFEASIBLE": Case(
        lambda: _run(_slow()),
        "The virtual velocity alpha violates the velocity bounds, so that no law that follows alpha"
        " can satisfy them.",
        "Reduce `k1`, start nearer to the reference, or widen the velocity bounds.",
        plotting.velocities,
    ),
    "FILTER_INFEASIBLE": Case(
        lambda: _run(_filtered()),
        "No torque satisfies both the conditions of the safety filter and the torque limits. The"
        " filter used the torque with the smallest violation of the conditions.",
        "`run.slack` is the size of the violation. Increase the torque limits, reduce the rates of"
        " the conditions (`a1`, `a2`), or change the start.",
    ),
    "REGION_VIOLATED": Case(
        lambda: _run(
            _paper(regions=(ij.regions.HalfSpace(normal=[0.0, 1.0], offset=0.45),)), duration=4.0
        ),
        "The tip, or the origin of a joint, touched or crossed the boundary of a region. The law of"
        " this example does not use regions.",
        "Wrap the law in a `controllers.SafetyFilter`, or change the reference."
        " `run.metrics.region_margin` is the size of the violation.",
        plotting.workspace,
    ),
    "STATE_BOUND_VIOLATED": Case(
        lambda: _run(_flexible(), dt=5e-4),
        "A level of the state above the second touched or left its bound: in this example the"
        " velocity of a motor of a flexible arm, whose law has no barrier on that level.",
        "Use `controllers.BarrierBackstepping` with a barrier on that level, reduce the gains, or"
        " widen the bounds. `run.metrics.level_margin` is the size of the violation.",
        plotting.levels,
    ),
    "SINGULAR_GAIN": Case(
        lambda: _run(_singular(), duration=0.4),
        "The input of the law was not finite: the gain of a level was singular, so that the level"
        " cannot be controlled there. In this example the gain of the last level is zero after"
        " 0.2 s.",
        "Keep the state away from the singularity by bounds, or change the plant's coordinates.",
        plotting.levels,
    ),
    "MODES_EXHAUSTED": Case(
        lambda: _run(_switching()),
        "The modes of the plant are a Markov chain, and its path in this run has more switches than"
        " the plant allows. From then on the run remains in the last mode.",
        "Increase `switches` of `MarkovSwitched`. A longer path makes a step slower.",
    ),
    "INADMISSIBLE_DRAW": Case(
        lambda: None,
        "A draw of a study was physically impossible, for example a negative mass. The run was not"
        " simulated, and its metrics are NaN.",
        "Narrow the distribution. `study.made` marks the runs that were simulated; statistics"
        " contain no others.",
    ),
}
"""Flag -> a run that has it."""


def section(name: str) -> str:
    """Run the example of a flag, and write its section and its figure.

    Raises:
      ValueError: the run does not have the flag.
    """
    MADE.mkdir(parents=True, exist_ok=True)
    case = CASES[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = case.run()
    lines = [
        f"<!-- {gallery.digest(Path(__file__))} -->",
        f"## {name}",
        "",
        case.meaning,
        "",
        f"**Remedy.** {case.remedy}",
        "",
    ]
    if run is not None:
        if isinstance(run, ij.Rollout) and not int(run.status) & int(ij.Status[name]):
            raise ValueError(f"the run of {name} has {ij.Status(int(run.status))!r}")
        figure = case.draw(run)
        figure.savefig(MADE / f"flag_{name.lower()}.png", dpi=100)
        lines += [f"![{describe(figure)}](flag_{name.lower()}.png)", ""]
    text = "\n".join(lines)
    _kept(name).write_text(text)
    return text


def _kept(name: str) -> Path:
    return MADE / f"{name.lower()}.md"


def is_made(name: str) -> bool:
    """Whether the section of a flag, as this file has it now, is there."""
    return gallery.is_of(_kept(name), Path(__file__))


def write(folder: Path) -> None:
    """Write the page, of sections that were made before.

    Raises:
      ValueError: a flag has no example.
    """
    missing = {flag.name for flag in ij.Status if flag} - set(CASES)
    if missing:
        raise ValueError(f"flags without a section: {sorted(missing)}")
    lines = [
        "# Why did my run fail?",
        "",
        (
            "Runs, batches and studies have status flags, `ij.Status`. Each section shows a run"
            " that has the flag. `run.ok` is true if no flag is set; a run has failed if it has a"
            " flag of `ij.status.FAILED`. The other flags are remarks, or limit what the numbers of"
            " a run mean."
        ),
    ]
    lines += ["", "```python", "flags = ij.Status(int(run.status))"]
    lines += ["run.ok, flags, bool(flags & ij.status.FAILED)", "```", ""]
    lines += [_kept(name).read_text() for name in CASES]
    for picture in MADE.glob("*.png"):
        shutil.copy(picture, folder)
    (folder / "why_did_my_run_fail.md").write_text("\n".join(lines))
