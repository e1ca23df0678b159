"""The random numbers of a run: noise of the sensor of a sampled law, process noise of the plant,
and the switching times of a plant whose modes are a Markov chain.

They depend only on the key of the run and on the number of the sample or step.  The three uses have
streams of their own, which are independent.
"""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.simulation.discontinuities import Piece
from iblf_jax.simulation.integrators import STOCHASTIC, TABLEAUS, tableau
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import Sample

NOISE_NAME = "noise"
"""Name of the noise key among the replaced values of a run; no leaf of a scenario has this name."""
NOISE_STREAM = 0x6E6F6973
"""Folded into a key so that the noise is independent of the draws of a study."""
PROCESS_STREAM = 0x7072
"""Distinguishes the increments of process noise from the noise of the sensor."""
BRIDGE_STREAM = 0x6272
"""And those that divide the increment of a step."""
EXTREME_STREAM = 0x6578
"""And those from which the extremes between two instants follow."""
MODES_STREAM = 0x6D6F
"""And the numbers from which switching times follow."""
ROUNDS = 10
MULTIPLIERS = (0x6A09, 0x5BB7)
"""Odd, below 2^15."""
WEYL = (0x9E37, 0xBB67)
WORD = 1 << 16
"""The generator works on words of 16 bits, whose products fit the integers of every backend."""


def noise_key(key: jax.Array, run: int | jax.Array = 0) -> jax.Array:
    """Four words of 16 bits, as floats, for the noise of one run of a study whose seed gave `key`;
    (4,) float32.
    """
    own = jax.random.fold_in(jax.random.fold_in(key, run), NOISE_STREAM)
    return jax.random.bits(own, (4,), jnp.uint16).astype(jnp.float32)


def has_noise(scenario: Scenario) -> bool:
    """Whether a run of a scenario draws random numbers: noise of the sensor, process noise, or
    switching times.
    """
    if scenario.process_noise is not None or scenario.plant.mode_draws:
        return True
    return scenario.sampling is not None and scenario.sensor.draws > 0


def needs_key(scenario: Scenario) -> bool:
    """Whether the inputs of a run contain a key: also where a sampled law has a sensor without
    noise.
    """
    return scenario.sampling is not None or has_noise(scenario)


def noise_values(scenario: Scenario, key: jax.Array, run: int | jax.Array) -> dict[str, jax.Array]:
    """`NOISE_NAME` -> the noise key of one run of a study, which replaces that of the run as leaves
    are replaced; empty for a scenario without noise.
    """
    if not has_noise(scenario):
        return {}
    return {NOISE_NAME: noise_key(key, run)}


def normals(key: jax.Array, sample: jax.Array, draws: int, n: int, stream: int = 0) -> jax.Array:
    """Independent standard normal numbers of one sample, (draws, n); they depend on key, sample and
    index only.

    The generator is counter-based, like Philox: in ten rounds, the halves of products are exchanged
    and combined with the key; then follows the Box-Muller transform. JAX's own generator cannot be
    compiled to the scalar programs of `kernels`.

    Args:
      key: of the run, four words of 16 bits.
      sample: number of the sample, () int.
      draws: numbers a joint.
      n: number of joints.
      stream: of the numbers, a word of 16 bits; 0 for those of a sensor.
    """
    words = _words(key, stream)
    count = draws * n
    flat: list[jax.Array] = []
    for pair in range((count + 1) // 2):
        flat += _pair(words, sample.astype(jnp.int32), pair, key.dtype)
    if not count:
        return jnp.zeros((0, n), key.dtype)
    return jnp.stack(flat[:count]).reshape(draws, n)


def _words(key: jax.Array, stream: int) -> list[jax.Array]:
    """The words of a key for a stream."""
    words = [w.astype(jnp.int32) for w in key]
    if stream:
        words[3] = words[3] ^ stream
    return words


def _pair(key: list[jax.Array], sample: jax.Array, pair: int, dtype) -> list[jax.Array]:
    """Two independent standard normal numbers."""
    first, second = _uniforms(key, sample, pair, dtype)
    size = jnp.sqrt(-2.0 * jnp.log(first))
    angle = 2.0 * np.pi * second
    return [size * jnp.cos(angle), size * jnp.sin(angle)]


def _uniforms(
    key: list[jax.Array], sample: jax.Array, pair: int | jax.Array, dtype
) -> tuple[jax.Array, jax.Array]:
    """Two independent numbers, uniform between 0 and 1."""
    low = WORD - 1
    x = [sample & low, _upper(sample) & low, key[2] ^ pair, key[3]]
    k = [key[0], key[1]]
    for _ in range(ROUNDS):
        a, b = MULTIPLIERS[0] * x[0], MULTIPLIERS[1] * x[2]
        x = [_upper(b) ^ x[1] ^ k[0], b & low, _upper(a) ^ x[3] ^ k[1], a & low]
        k = [(k[0] + WEYL[0]) & low, (k[1] + WEYL[1]) & low]

    def uniform(high: jax.Array, low: jax.Array) -> jax.Array:
        return (high.astype(dtype) * WORD + low.astype(dtype) + 0.5) / float(WORD * WORD)

    return uniform(x[0], x[1]), uniform(x[2], x[3])


def _upper(x: jax.Array) -> jax.Array:
    """The bits of an integer above its lowest word."""
    return jax.lax.div(x, jnp.asarray(WORD, x.dtype))


# --- process noise --------------------------------------------------------------------------------


def check_method(scenario: Scenario, method: str) -> None:
    """Raises ValueError for a method that does not fit the scenario.

    These are an unknown method, a deterministic one for a plant with process noise, a stochastic
    one for a plant without, one of strong order 1 for noise that is not additive, and one of a
    single stage for a loop whose input has a delay.
    """
    stages = tableau(method).c
    _check_kind_of_method(scenario, method)
    if len(stages) > 1 or scenario.actuator.input_delay is None:
        return
    noise = scenario.process_noise
    if noise is not None and not noise.additive:
        expected = "noise that does not depend on the state, as the input has a delay"
        remedy = 'A delay needs method="stochastic_heun", which needs additive noise.'
        raise checks.fail("scenario.process_noise", type(noise).__name__, expected, remedy)
    fitting = '"rk4" or "heun"'
    if noise is not None:
        fitting = '"stochastic_heun"'
    remedy = "Between two steps of Euler's method the command has no value."
    raise checks.fail("method", method, f"{fitting}, as the input has a delay", remedy)


def _check_kind_of_method(scenario: Scenario, method: str) -> None:
    """Raises ValueError for a method that does not fit the process noise of the plant."""
    noise = scenario.process_noise
    if noise is None:
        if method in STOCHASTIC:
            expected = f"one of {', '.join(TABLEAUS)}, as the plant has no process noise"
            raise checks.fail("method", method, expected)
        return
    if method not in STOCHASTIC:
        expected = f"one of {', '.join(STOCHASTIC)}, as the plant has process noise"
        remedy = 'Take method="euler_maruyama", or with_parts(scenario, process_noise=None).'
        raise checks.fail("method", method, expected, remedy)
    if method == "stochastic_heun" and not noise.additive:
        expected = "euler_maruyama, as the noise depends on the state"
        remedy = (
            "The process noise is that of Ito, and Heun's method converges to the solution in the"
            " sense of Stratonovich. Noise that does not depend on x states additive = True."
        )
        raise checks.fail("method", method, expected, remedy)


def brownian_increment(
    scenario: Scenario, key: jax.Array, step: jax.Array, dt: jax.Array
) -> jax.Array:
    """The increment of W over a step, (m, n) [s^0.5].

    Args:
      scenario: with process noise on m levels.
      key: of the run.
      step: number of the step, () int.
      dt: its length, () [s].
    """
    noise = checks.given(scenario.process_noise)
    levels, parts = len(noise.levels), noise.substeps
    first = step.astype(jnp.int32) * parts
    total = normals(key, first, levels, scenario.n, PROCESS_STREAM)
    for part in range(1, parts):
        total = total + normals(key, first + part, levels, scenario.n, PROCESS_STREAM)
    return jnp.sqrt(dt / parts) * total


def with_noise_rates(
    scenario: Scenario, key: jax.Array, step: jax.Array, dt: jax.Array, pieces: tuple[Piece, ...]
) -> tuple[Piece, ...]:
    """The pieces of a step, each with its increment of W as a constant rate, `Piece.noise_rate`.

    The increments of the pieces have the sum of the step's increment: of an increment D over the
    time R that is left, a piece of the length l receives

        l/R D + sqrt(l (R - l)/R) z,   z standard normal                   (Brownian bridge)

    Args:
      scenario: with process noise on m levels.
      key, step, dt: as for `brownian_increment`.
      pieces: of the step.
    """
    noise = checks.given(scenario.process_noise)
    left, rest = dt, brownian_increment(scenario, key, step, dt)
    m, divisions = len(noise.levels), len(pieces) - 1
    z = normals(key, step, m * divisions, scenario.n, BRIDGE_STREAM)
    found = []
    for i, piece in enumerate(pieces[:-1]):
        part, rest = _split(piece.length, left, rest, z[m * i : m * (i + 1)])
        left = left - piece.length
        found.append(piece._replace(noise_rate=_per_time(part, piece.length)))
    last = pieces[-1]
    return (*found, last._replace(noise_rate=_per_time(rest, last.length)))


def _split(
    length: jax.Array, left: jax.Array, rest: jax.Array, z: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The increment over the first `length` of the time that is left, and the remaining one."""
    share = jnp.where(left > 0, length / jnp.where(left > 0, left, 1.0), 1.0)
    variance = length * (1.0 - share)
    deviation = jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0)
    part = share * rest + deviation * z
    return part, rest - part


def _per_time(increment: jax.Array, length: jax.Array) -> jax.Array:
    """An increment as a rate; 0 for a piece without length."""
    return jnp.where(length > 0, increment / jnp.where(length > 0, length, 1.0), 0.0)


def least_distances(
    before: jax.Array, now: jax.Array, variance: jax.Array, uniform: jax.Array
) -> jax.Array:
    """The smallest distance to a wall between two instants, drawn from its distribution.

        P(min < y) = exp(-2 (d_0 - y)(d_1 - y) / (sigma^2 dt)),   y < min(d_0, d_1)
        min = (d_0 + d_1 - sqrt((d_0 - d_1)^2 - 2 sigma^2 dt ln U)) / 2,   U uniform

    Between its values at two instants the level is a Brownian bridge, up to a drift of order dt.
    With the distances at the instants alone, a probability of exit is that of walls that are
    0.58 sigma sqrt(dt) farther away.

    Args:
      before, now: distances d_0 and d_1 at both instants; a wall at infinity stays there.
      variance: sigma^2 dt, >= 0.
      uniform: U in (0, 1].

    Source: P. Baldi, Annals of Probability 23 (1995) 1644-1670, for the use of the law of the
      bridge's extreme; M. Broadie, P. Glasserman, S. Kou, Mathematical Finance 7 (1997) 325-349,
      for the shift of the bounds.
    """
    is_wall = jnp.isfinite(before) & jnp.isfinite(now)
    first, last = (jnp.where(is_wall, x, 1.0) for x in (before, now))
    square = (first - last) ** 2 - 2.0 * variance * jnp.log(uniform)
    root = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    return jnp.where(is_wall, 0.5 * (first + last - root), now)


def distances(scenario: Scenario, sample: Sample) -> Any:
    """The distances of the levels to their lower and upper bounds, (2, m, n), up to the last level
    with bounds; `()` without process noise.
    """
    if scenario.process_noise is None:
        return ()
    x = sample.x[: len(sample.level_lower)]
    return jnp.stack([x - sample.level_lower, sample.level_upper - x])


def with_extremes(
    scenario: Scenario,
    key: jax.Array,
    instant: jax.Array,
    dt: jax.Array,
    sample: Sample,
    x: jax.Array,
    before: jax.Array,
    now: jax.Array,
) -> Sample:
    """A sample with the smallest distances since the instant before, on levels with process noise.

    The uniform numbers depend on key, instant, level, component and side only.

    Args:
      scenario, key: of the run.
      instant: its number, () int; the first one has none before it.
      dt: step, () [s].
      sample: at the instant.
      x: state of the plant there, (r, n), at which the intensity of the noise is taken.
      before, now: `distances` at the instant before and at this one.
    """
    noise = scenario.process_noise
    if noise is None:
        return sample
    n = scenario.n
    words = _words(key, EXTREME_STREAM)
    instant = instant.astype(jnp.int32)
    variances = noise.diffusion(sample.t, x) ** 2 * dt
    rows = list(jnp.moveaxis(now, 1, 0))
    for level, variance in zip(noise.levels, variances, strict=True):
        if level > len(rows) or scenario.bounds[level - 1] is None:
            continue
        pairs = range((level - 1) * n, level * n)
        numbers = [jnp.stack(_uniforms(words, instant, pair, dt.dtype)) for pair in pairs]
        last = rows[level - 1]
        least = least_distances(before[:, level - 1], last, variance, jnp.stack(numbers, axis=1))
        rows[level - 1] = jnp.where(instant > 0, least, last)
    return dataclasses.replace(sample, least_distances=jnp.stack(rows, axis=1))


# --- switching times ------------------------------------------------------------------------------


def realised(scenario: Scenario, key: jax.Array) -> Scenario:
    """The scenario with the switching times and modes of one run, where its plant draws them."""
    draws = scenario.plant.mode_draws
    if not draws:
        return scenario
    dtype = scenario.initial.q.dtype
    words = _words(key, MODES_STREAM)
    numbers = jnp.arange(draws, dtype=jnp.int32)
    pairs = jax.vmap(lambda k: jnp.stack(_uniforms(words, jnp.int32(0), k, dtype)))(numbers)
    # A copy without checks, because the numbers may be traced.
    new = copy.copy(scenario)
    object.__setattr__(new, "plant", scenario.plant.with_path(pairs))
    return new
