"""Status flags of a run: code inside `jit` raises nothing, and each run carries its status to the
end.

`Status.OK` is 0.  Flags combine: a run may violate a bound and saturate its torque.  The flags of
`FAILED` mean that a run is invalid or not acceptable; the others record events during the run.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping

import jax.numpy as jnp


class Status(enum.IntFlag):
    """Bit flags of one run."""

    OK = 0
    BOUND_VIOLATED = 1
    """A joint touched or left its bound."""
    NOT_FINITE = 2
    """The state diverged (NaN, infinity, a joint faster than VELOCITY_LIMIT, or V is NaN); it was
    frozen at its last valid value."""
    STEP_TOO_LARGE = 4
    """dt is beyond the stability limit of the integrator for the fastest mode of the closed
    loop."""
    INFEASIBLE_REFERENCE = 8
    """The reference touches or leaves a bound during the run. Assumption 2 fails: no law can follow
    the reference and keep the bound."""
    TORQUE_SATURATED = 16
    """The torque that the law commanded was cut to the actuator's limit."""
    GUARD_ACTIVE = 32
    """A joint came so near its bound that the barrier's slope was limited to its greatest finite
    value."""
    INADMISSIBLE_DRAW = 64
    """A study drew a value that its leaf does not admit (a negative mass, say): the run was not
    made, its metrics are NaN."""
    INACCURATE = 128
    """The estimated error of the positions is more than 0.5 % of the width of the tube
    (`error_estimate.TOLERANCE`): take a smaller dt.  In a loop that rounds a reading or a torque
    it may be the error by another code (`error_growth`), which a finer resolution reduces."""
    GUARD_STAYED = 256
    """The guard was active after the first instant: there the loop ran with a softer barrier than
    the requested one."""

    SAMPLING_TOO_SLOW = 512
    """Deviations of the loop grow from one period to the next (spectral radius above 1) at one of
    the assessed states of this run, and not in continuous time: sample faster.  Another start may
    visit states where they do not."""

    VELOCITY_VIOLATED = 1024
    """A joint's velocity touched or left its bound."""
    ALPHA_INFEASIBLE = 2048
    """The virtual velocity touched or left the velocity bounds. No law that follows it can keep
    them there, and the theorem makes no claim."""

    FILTER_INFEASIBLE = 4096
    """No torque satisfied all conditions of the safety filter at some time: the torque violated
    them by the least slack, which the run records."""

    REGION_VIOLATED = 8192
    """The tip, or the origin of a joint, left its region or touched its boundary."""

    INFINITE_SLOPE = 16384
    """A run is inaccurate, or its step too large, and a derivative of the loop is infinite or
    nearly infinite at one of the sampled instants.  Examples: |e2|^a sign(e2) with a < 1 at e2 = 0,
    and sharp dry friction at a reversal."""

    STATE_BOUND_VIOLATED = 32768
    """A level of the state, from the third on, touched or left its bound."""
    SINGULAR_GAIN = 65536
    """The input of the law was not finite: the gain of a level was singular, or a term of the law
    had no value there."""

    MODES_EXHAUSTED = 1 << 21
    """A plant whose modes are a Markov chain would have switched more often than a run of it can:
    from then on the run is not one of the chain."""


VIOLATED = (
    Status.BOUND_VIOLATED
    | Status.VELOCITY_VIOLATED
    | Status.REGION_VIOLATED
    | Status.STATE_BOUND_VIOLATED
)
"""The flags of violated constraints."""

FAILED = (
    VIOLATED
    | Status.NOT_FINITE
    | Status.STEP_TOO_LARGE
    | Status.INFEASIBLE_REFERENCE
    | Status.INADMISSIBLE_DRAW
    | Status.SINGULAR_GAIN
)
"""The flags of a failed run."""

LOST = Status.BOUND_VIOLATED | Status.NOT_FINITE
"""The flags of a run that left its bounds or diverged, perhaps not because of its step."""

UNTRUSTED = Status.NOT_FINITE | Status.STEP_TOO_LARGE
"""The flags of a run whose results are meaningless: no loss and no certificate uses them."""

VELOCITY_LIMIT = 1e4
"""Speed above which a run counts as diverged [rad/s, or m/s]. No robot is so fast. Stopping there
keeps every number finite in float32, so a batch and its gradient contain no infinity."""

WORDS = {
    Status.BOUND_VIOLATED: "a bound was violated",
    Status.NOT_FINITE: "the state ran away and was frozen",
    Status.STEP_TOO_LARGE: "the time step is too large for the closed loop",
    Status.INFEASIBLE_REFERENCE: "the reference leaves the bounds",
    Status.TORQUE_SATURATED: "the torque was saturated",
    Status.GUARD_ACTIVE: "the guard at the bound was active",
    Status.INADMISSIBLE_DRAW: "a drawn parameter was inadmissible, so the run was not made",
    Status.INACCURATE: (
        "the positions are inaccurate: the time step is too large, or a rounded signal may differ"
    ),
    Status.GUARD_STAYED: "the guard stayed active beyond the first instant",
    Status.SAMPLING_TOO_SLOW: "the law is sampled too slowly",
    Status.VELOCITY_VIOLATED: "a velocity bound was violated",
    Status.REGION_VIOLATED: "a region was left",
    Status.FILTER_INFEASIBLE: "the safety filter's conditions could not all be met",
    Status.INFINITE_SLOPE: (
        "a derivative of the loop is infinite, or nearly so, at an isolated instant"
    ),
    Status.STATE_BOUND_VIOLATED: "a bound of a level above the second was violated",
    Status.SINGULAR_GAIN: "the law's input was not finite: a level's gain was singular",
    Status.ALPHA_INFEASIBLE: "the virtual velocity left the velocity bounds",
    Status.MODES_EXHAUSTED: "the plant has more switches than its `switches`",
}
"""The text of each flag, in the order in which `describe` lists them."""


WORDS_OF_LEVELS = WORDS | {
    Status.TORQUE_SATURATED: "the input was saturated",
    Status.VELOCITY_VIOLATED: "a bound of the second level was violated",
    Status.INACCURATE: (
        "the components of the first level are inaccurate: the time step is too large, or a"
        " rounded signal may differ"
    ),
    Status.ALPHA_INFEASIBLE: "a virtual control left the bounds of its level",
}
"""The text of each flag for plants in strict-feedback form."""


def describe(status: int, texts: Mapping[Status, str] = WORDS) -> str:
    """The flags of one run in words, "ok" if there is none; `texts` are those of each flag."""
    words = [text for flag, text in texts.items() if int(status) & flag]
    return "; ".join(words) or "ok"


def has_flag(status, which: Status):
    """Whether `status`, a number or an array of flags, has any of these flags."""
    return status & int(which) != 0


def flag(condition, which: Status):
    """`which` as an int32 where `condition` holds, else 0; for use inside a compiled loop."""
    return jnp.where(condition, jnp.int32(int(which)), jnp.int32(0))
