"""Laws whose gain depends on the time and on V, without JAX and without the package: a second
opinion.

`Powers` and `Prescribed` are the gains g(t, V) that are added to the constant gain of a level, for
numbers and for the power series of `independent_chains`, whose cases may have one for each level.

`Arm` is the law of a two-link arm under TransformedError,

    tau = C alpha + G + M alpha' - K2 e2 - s - g2(t, W) M e2,   W = 1/2 e2^T M e2,

with alpha' by complex steps along (1, q').
"""

from dataclasses import dataclass

import independent
import numpy as np
from independent_chains import Series, Sine, Tube, clock, exp, log, mapping


@dataclass(frozen=True)
class Powers:
    """g = sum of k_j (z^2 + delta^2)^((p_j - 1)/2), one for finite and two for fixed time."""

    terms: tuple
    delta: float

    def gain(self, t, V):
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
        sides = (self.reference, self.lower, self.upper)
        return [Sine(*side).at(clock(t, 2)).c for side in sides]

    def first_level(self, t, q):
        """The terms of the barrier, of which a is the virtual velocity."""
        (x_d, dx_d), (low, dlow), (up, dup) = self.tube(t)
        tube = Tube(q - x_d, dx_d, x_d - low, up - x_d, dx_d - dlow, dup - dx_d)
        return mapping(tube, self.k1 + self.first.gain(t, mapping(tube, self.k1).V))

    def torque(self, t, q, dq):
        step = 1e-30
        _, s, alpha, _ = self.first_level(t, q)
        dalpha = self.first_level(t + 1j * step, q + 1j * step * dq).a.imag / step
        M, C, G, _ = self.arm(q)
        e2 = dq - alpha
        tau = C(dq) @ alpha + G + M @ dalpha - self.K2 * e2 - s
        return tau - self.second.gain(t, 0.5 * e2 @ M @ e2) * (M @ e2)
