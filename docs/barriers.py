"""Pages of the barriers: each plots V1, its slope and alpha between asymmetric bounds."""

from __future__ import annotations

import inspect
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from alt_text import describe
from reference import body

import iblf_jax as ij

LOWER, UPPER = -0.2, 0.4
"""Bounds of the plots [rad] for a reference at 0; the upper one decreases by 0.1 rad/s."""


def tube() -> ij.bounds.Tube:
    """The bounds at one instant."""
    one = jnp.ones(1)
    return ij.bounds.Tube(0 * one, 0 * one, LOWER * one, UPPER * one, 0 * one, -0.1 * one)


def draw(barrier, path: Path) -> str:
    """Draws V1, dV1/dq and alpha of one barrier, inside the bounds and a little beyond; a text for
    readers who do not see the figure.
    """
    from iblf_jax.plotting._style import bound, label, new_figure, styled

    e1 = np.linspace(1.1 * LOWER, 1.1 * UPPER, 600)
    gains = jnp.ones(1), jnp.full(1, 0.1)
    functions = {
        "V_1": ("1", lambda q: barrier.value(tube(), q)),
        r"\partial V_1 / \partial q": ("1/rad", lambda q: barrier.slope(tube(), q)),
        r"\alpha": ("rad/s", lambda q: barrier.virtual_velocity(tube(), q, *gains)),
    }
    with styled():
        figure = new_figure(9.0, 2.6)
        for axes, (symbol, (unit, function)) in zip(
            figure.subplots(1, 3), functions.items(), strict=True
        ):
            y = np.ravel(jax.vmap(jax.jit(function))(jnp.asarray(e1)[:, None]))
            inside = np.abs(y[(e1 > 0.93 * LOWER) & (e1 < 0.93 * UPPER)]).max()
            axes.plot(e1, y)
            axes.set_ylim(-1.5 * inside if y.min() < 0 else -0.05 * inside, 1.5 * inside)
            for limit in (LOWER, UPPER):
                axes.axvline(limit, color=bound(), linewidth=1.0)
            axes.set_xlabel(label("$e_1$", "rad"))
            axes.set_ylabel(label(f"${symbol}$", unit))
        figure.savefig(path, dpi=110)
        return describe(figure)


def write(folder: Path) -> None:
    """Write a page for each barrier, and the list of pages."""
    names = []
    for name, cls in ij.barriers.MEMBERS.items():
        shown = draw(cls(), folder / f"barrier_{name}.png")
        text = (
            f"# {cls.__name__}\n\n{body(inspect.getdoc(cls) or '')}\n\n"
            f"![{cls.__name__}. {shown}](barrier_{name}.png)\n\n"
        )
        conditions = (
            f"The plot has bounds at {LOWER:g} and {UPPER:g} rad; the upper one decreases by 0.1"
            " rad/s; k1 = 1 1/s, o = 0.1 1/s^2."
        )
        (folder / f"barrier_{name}.md").write_text(
            text
            + conditions
            + " The guard extends the functions beyond the bounds along the tangent.\n"
        )
        names.append(f"barrier_{name}")
    listed = "\n".join(names)
    words = (
        "`iblf_jax.barriers` defines a barrier and its guard at the bound. Each member has a page:"
    )
    (folder / "barriers.md").write_text(
        f"# Barriers\n\n{words}\n\n```{{toctree}}\n:maxdepth: 1\n\n{listed}\n```\n"
    )
