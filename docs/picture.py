"""Draws the README's picture, docs/arm.gif: `python docs/picture.py`."""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "Agg")
import jax

jax.config.update("jax_enable_x64", True)

import iblf_jax as ij
from iblf_jax import plotting

run = ij.simulate(ij.presets.zhang_yan_2024(), duration=6.4, dt=1e-3, record_every=20)
print(plotting.animate(run, Path(__file__).with_name("arm.gif"), fps=8.0, speed=1.0))
