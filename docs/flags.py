"""The page "Why did my run fail?": a run for every status flag, its picture, and what to do.

The tests make the sections with `section`, which keeps them in `out/site/flags`; `docs/build.py`
takes them from there, and makes what is missing or older than this file.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gallery
import jax.numpy as jnp

import iblf_jax as ij
from iblf_jax import plotting

MADE = gallery.ROOT / "out" / "site" / "flags"


class Case(NamedTuple):
    """A run that raises a flag; a scenario where none can be made, None where there is nothing to
    see.
    """

    run: Callable[[], Any]
    says: str
    mend: str
    draw: Callable = plotting.positions


def _paper(**parts: Any) -> ij.Scenario:
    return ij.with_parts(ij.presets.zhang_yan_2024(), **parts)


def _run(scenario: ij.Scenario, duration: float = 2.0, dt: float = 1e-3, **options: Any):
    return ij.simulate(scenario, duration=duration, dt=dt, **options)


def _weak(limit: list[float]) -> ij.Scenario:
    return _paper(
        controller=ij.controllers.Saturated(ij.presets.zhang_yan_2024().controller, limit=limit)
    )


def _meeting() -> ij.Scenario:
    """The upper bound comes down to the reference of the first joint."""
    upper = ij.bounds.Sinusoid(offset=0.66, amplitude=0.2, frequency=1.0, phase=1.5707963)
    return _paper(
        bounds=ij.Bounds(lower=ij.bounds.Constant(0.0), upper=upper),
        initial=ij.Initial(q=[0.6, 0.6]),
    )


def _near_the_wall() -> ij.Scenario:
    return ij.with_parameters(ij.presets.zhang_yan_2024(), {"initial.q": [1.0397, 0.8]})


def _speeds(lower: float) -> ij.Bounds:
    return ij.Bounds(lower=ij.bounds.Constant(lower), upper=ij.bounds.Constant(0.6))


def _sampled(period: float, delay: float = 0.0) -> ij.Scenario:
    return ij.with_parts(
        ij.presets.zhang_yan_2024(reading="corrected"), sampling=ij.Sampling(period, delay)
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

    def init(self, q, dq, context):
        """No state."""
        return ()

    def command(self, t, q, dq, f_hat, context, state):
        """The torque."""
        tube, model = context.tube(t), context.model
        alpha = tube.dq_d - 2.0 * (q - tube.q_d)
        e2 = dq - alpha
        wanted = tube.ddq_d - 2.0 * (dq - tube.dq_d)
        tau = model.coriolis(q, dq, dq) + model.gravity(q) + model.mass_matrix(q) @ wanted
        tau = tau - f_hat - self.K2 * e2 - self.c * jnp.sign(e2) * jnp.abs(e2) ** 0.6
        none = jnp.zeros(q.shape, bool)
        return ij.controllers.Command(tau, alpha, (q - tube.q_d) ** 2, none, none), ()


def _at_rest() -> ij.Scenario:
    """It starts at e2 = 0."""
    scenario = _paper(controller=PowerOfE2(K2=5.0, c=2.0))
    tube = scenario.context.tube(jnp.zeros(()))
    return ij.with_parts(scenario, initial=ij.Initial(tube.q_d, tube.dq_d))


CASES: dict[str, Case] = {
    "BOUND_VIOLATED": Case(
        lambda: _run(_weak([4.0, 1.0])),
        "A joint touched or left its bound. Here the motors are too weak for the arm's own weight,"
        " so that no law could have kept it.",
        "Look at the first violation (`run.metrics.first_violation_time`), and whether the torque"
        " was saturated or the start was outside. If neither, the law was not strong enough against"
        " what it did not know: raise `K2`, or tune.",
    ),
    "NOT_FINITE": Case(
        lambda: _run(_sampled(4e-3, 4e-3), dt=4e-3),
        "The state ran away, and was frozen at its last good value: nothing after that is a motion."
        " Here the law is sampled too slowly.",
        "Other flags of the same run say why: a step that is too large, a period that is too long."
        " Otherwise the gains are too high.",
    ),
    "STEP_TOO_LARGE": Case(
        lambda: _run(_paper(), dt=0.04),
        "dt times the loop's fastest mode is beyond what the integrator can do. What you see is the"
        " integrator's, not the robot's.",
        "Take the step that the warning names, or the one of `ij.recommended_dt(scenario,"
        " duration=...)`.",
    ),
    "INFEASIBLE_REFERENCE": Case(
        _meeting,
        "The reference touches or leaves a bound: no law can follow it and stay inside (Assumption"
        " 2). A single run raises an error that names joint and time; in a batch or a study it is"
        " this flag. A safety filter keeps its bounds wherever the reference goes, so its runs do"
        " not raise it.",
        "Move the reference, or widen the bounds. `ij.plotting.tube(scenario)` shows both before"
        " anything is run.",
        lambda scenario: plotting.tube(scenario, duration=4.0),
    ),
    "TORQUE_SATURATED": Case(
        lambda: _run(_weak([9.0, 4.0])),
        "The law asked for more torque than there is. It is a remark, not a failure: here the"
        " bounds hold.",
        "Nothing, if the bounds hold and nothing is to be certified. Else lower the gains, or tune"
        " with `peak_torque_below`.",
        plotting.torques,
    ),
    "GUARD_ACTIVE": Case(
        lambda: _run(_near_the_wall()),
        "A joint was within a thousandth of its bound, where the barrier's slope is held at a large"
        " finite value. Here it starts there.",
        "Nothing, if it was at the start alone. A barrier takes `guard=` if the default of 1e-3 is"
        " too wide for you.",
    ),
    "GUARD_STAYED": Case(
        lambda: _run(_weak([4.0, 1.0])),
        "The guard was at work beyond the first instant: there another law ran, softer than the one"
        " that was asked for.",
        "Do not judge the law by this run. See why it comes so near its bound: torque limits, a"
        " payload, too large a step.",
    ),
    "INACCURATE": Case(
        lambda: _run(_paper(), dt=5e-3),
        "The estimated error of the positions is more than 0.5 % of the tube. Its numbers are not"
        " to be used.",
        "Take the step that the warning names.",
    ),
    "INFINITE_SLOPE": Case(
        lambda: _run(_at_rest(), dt=1e-2),
        "The run is inaccurate, or its step too large, and at an isolated instant a derivative of"
        " the loop is infinite: here that of |e2|^0.6 sign(e2) with respect to e2, at e2 = 0. It is"
        " no fast mode, and the time step is judged without it.",
        "Take the step that the warning names, or write such a power as e2 (e2^2 + delta^2)^((a -"
        " 1)/2) with a small delta.",
    ),
    "SAMPLING_TOO_SLOW": Case(
        lambda: _run(_sampled(4e-3), dt=1e-3),
        "From one period to the next the loop grows: `run.metrics.sampling_radius` is above 1.",
        "Sample faster; `ij.recommended_period(scenario, duration=...)` says how fast. Or change"
        " the term that limits the loop: the warning names it, be it the slope of the barrier"
        " (`weight`), `K2`, `kf`, a filter, a lag or the delay.",
    ),
    "VELOCITY_VIOLATED": Case(
        lambda: _run(_paper(velocity_bounds=_speeds(-0.4))),
        "A joint was faster than its velocity bound, which this law does not know.",
        "Take `controllers.FullState`, which keeps both, or lower `k1`, which asks for less speed.",
        plotting.velocities,
    ),
    "ALPHA_INFEASIBLE": Case(
        lambda: _run(_paper(velocity_bounds=_speeds(-0.4))),
        "The velocity that the law wants, alpha, leaves the velocity bounds: no law that follows it"
        " can keep them.",
        "Lower `k1`, start nearer to the reference, or widen the velocity bounds.",
        plotting.velocities,
    ),
    "FILTER_INFEASIBLE": Case(
        lambda: _run(_filtered()),
        "A safety filter's conditions and its torque limits have nothing in common. The torque"
        " broke the conditions by the least.",
        "`run.slack` says by how much. More torque, slower conditions (`a1`, `a2`), or another"
        " start.",
    ),
    "REGION_VIOLATED": Case(
        lambda: _run(
            _paper(regions=(ij.regions.HalfSpace(normal=[0.0, 1.0], offset=0.45),)), duration=4.0
        ),
        "The tip, or the origin of a joint, touched or crossed the wall of a region. Here the law"
        " does not know the wall.",
        "Put a `controllers.SafetyFilter` around the law, or move the reference."
        " `run.metrics.region_margin` says by how much.",
        plotting.workspace,
    ),
    "INADMISSIBLE_DRAW": Case(
        lambda: None,
        "Of studies: a draw was no robot at all, such as one with a negative mass. The run was not"
        " made; its metrics are NaN.",
        "Narrow the distribution. `study.made` says which runs were made, and no statistic counts"
        " the others.",
    ),
}
"""Flag -> a run that raises it."""


def section(name: str) -> str:
    """Runs the case of a flag and writes its section, the picture beside it; raises if the run does
    not raise the flag.
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
        case.says,
        "",
        f"**What to do.** {case.mend}",
        "",
    ]
    if run is not None:
        if isinstance(run, ij.Rollout) and not int(run.status) & int(ij.Status[name]):
            raise ValueError(f"the run of {name} has {ij.Status(int(run.status))!r}")
        case.draw(run).savefig(MADE / f"flag_{name.lower()}.png", dpi=100)
        lines += [f"![{name}](flag_{name.lower()}.png)", ""]
    text = "\n".join(lines)
    _kept(name).write_text(text)
    return text


def _kept(name: str) -> Path:
    return MADE / f"{name.lower()}.md"


def write(folder: Path) -> None:
    """Writes the page; raises if a run does not raise its flag, or a flag has no run."""
    missing = {flag.name for flag in ij.Status if flag} - set(CASES)
    if missing:
        raise ValueError(f"flags without a section: {sorted(missing)}")
    lines = [
        "# Why did my run fail?",
        "",
        (
            "A run, a batch and a study carry status flags, `ij.Status`. Each section has a run"
            " that raises its flag."
        ),
    ]
    lines += ["", "```python", "run.ok, ij.Status(int(run.status))", "```", ""]
    lines += [
        _kept(name).read_text() if gallery.is_of(_kept(name), Path(__file__)) else section(name)
        for name in CASES
    ]
    for picture in MADE.glob("*.png"):
        shutil.copy(picture, folder)
    (folder / "why_did_my_run_fail.md").write_text("\n".join(lines))
