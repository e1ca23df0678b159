"""Laws whose gain depends on the time and on V, without JAX and without the package: a second
opinion.

`Powers` and `Prescribed` are the gains g(t, V) that are added to the constant gain of a level, for
numbers and for the power series of `independent_chains`, whose cases may have one for each level.

`Arm` is the law of a two-link arm under TransformedError,

    tau = C alpha + G + M alpha' - K2 e2 - s - g2(t, W) M e2,   W = 1/2 e2^T M e2,

with alpha' by complex steps along (1, q').
"""

from __future__ import annotations

from dataclasses import dataclass

import independent
import numpy as np
from independent_chains import Series, exp, log


@dataclass(frozen=True)
class Powers:
    """g = sum of k_j (z^2 + delta^2)^((p_j - 1)/2), one for finite and two for fixed time."""

    terms: tuple
    delta: float

    def gain(self, t, V):
        """The gain at a value of V; numbers or series."""
        total = 0.0
        for size, power in self.terms:
            total = total + size * exp((power - 1.0) / 2.0 * log(2.0 * V + self.delta**2))
        return total


@dataclass(frozen=True)
class Prescribed:
    """g = order/(T - t) until T - t = 2 order/cap, and smoothly up to cap at T."""

    T: float
    order: float
    cap: float

    def gain(self, t, V):
        """The gain at a time; numbers or series."""
        now = t.c[0] if isinstance(t, Series) else t
        width, rest = 2.0 * self.order / self.cap, self.T - t
        if np.real(self.T - now) >= width:
            return self.order / rest
        if np.real(self.T - now) <= 0.0:
            return self.cap + 0.0 * rest
        # The mean of a step from 0 to 1 with three continuous derivatives, integrated by its terms.
        u = rest * (1.0 / width)
        integral, power = 0.0, u * u * u * u * u
        for n, factor in enumerate((35.0, -84.0, 70.0, -20.0)):
            integral = integral + factor / (5 + n) * power
            power = power * u
        return self.order / (width * (0.5 + integral))


@dataclass
class Arm(independent.Loop):
    """The paper's arm under TransformedError, corrected, with decays."""

    first: object = None
    second: object = None

    def tube(self, t):
        """x_d, lower and upper at a real or complex time, and their rates."""
        return [_sine_at(parts, t) for parts in (self.reference, self.lower, self.upper)]

    def mapped(self, t, q):
        """z, dz/dq and the rate of z at fixed e1."""
        (x_d, dx_d), (low, dlow), (up, dup) = self.tube(t)
        e, k_l, k_u = q - x_d, x_d - low, up - x_d
        dk_l, dk_u = dx_d - dlow, dup - dx_d
        room = (k_l + e) * (k_u - e)
        z = e * k_l * k_u / room
        z_e = k_l * k_u * (k_l * k_u + e**2) / room**2
        z_t = z * (dk_l / k_l + dk_u / k_u - dk_l / (k_l + e) - dk_u / (k_u - e))
        return z, z_e, z_t, dx_d

    def alpha(self, t, q):
        """The virtual velocity."""
        z, z_e, z_t, dx_d = self.mapped(t, q)
        gain = self.k1 + np.array([self.first.gain(t, 0.5 * x * x) for x in z])
        return dx_d - (gain * z + z_t) / z_e

    def torque(self, t, q, dq):
        """The command."""
        step = 1e-30
        alpha = self.alpha(t, q)
        dalpha = self.alpha(t + 1j * step, q + 1j * step * dq).imag / step
        M, C, G, _ = self.arm(q)
        z, z_e, _, _ = self.mapped(t, q)
        e2 = dq - alpha
        W = 0.5 * e2 @ M @ e2
        tau = C(dq) @ alpha + G + M @ dalpha - self.K2 * e2 - z * z_e
        return tau - self.second.gain(t, W) * (M @ e2)


def _sine_at(parts, t):
    """A sinusoid of the arm at a real or complex time, and its rate."""
    offset, amplitude, frequency, phase = (np.asarray(x, float) * np.ones(2) for x in parts)
    angle = frequency * t + phase
    return offset + amplitude * np.sin(angle), amplitude * frequency * np.cos(angle)
