"""A proof as labelled data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from iblf_jax.proofs.result import Proof
from iblf_jax.simulation.units import signal_unit
from iblf_jax.world import plants

if TYPE_CHECKING:
    import xarray


def proof_to_xarray(proof: Proof) -> xarray.Dataset:
    """Tube, ranges of the parameters, weights and verdict of a proof as a Dataset.

    Args:
      proof: the result of `ij.prove`.

    Returns:
      Variables with the dimensions `time` and `joint`, `path` and `end`, or `weight`.
    """
    import xarray

    tube = proof.tube
    unit = signal_unit(proof.scenario, "q")
    data: dict[str, Any] = {
        name: (("time", "joint"), values, {"units": unit})
        for name, values in tube._asdict().items()
        if name not in ("t", "xi")
    }
    data["xi"] = (("time", "joint"), tube.xi, {"units": "1"})
    data["range"] = (("path", "end"), np.array(list(proof.ranges.values())).reshape(-1, 2), {})
    data["largest_rate"] = (("weight",), np.array(list(proof.rates.values())), {})
    of_torque = {"units": signal_unit(proof.scenario, "tau")}
    if proof.torque is not None:
        ends = np.stack([proof.torque.lowest, proof.torque.highest], axis=1)
        data["torque"] = (("joint", "end"), ends, of_torque)
    start = proof.start
    if start is not None:
        data["start_torque"] = (("joint",), start.torque, of_torque)
    attributes = {
        "verdict": str(proof.verdict),
        "statement": proof.sentence(),
        "assumptions": " ".join(proof.assumptions),
        **{name: getattr(proof, name) for name in ("level", "weight", "duration", "boxes")},
        **{name: getattr(proof, name) for name in ("done", "seconds")},
        **({} if start is None else {"start_level": start.level}),
    }
    coordinates = {
        "time": ("time", tube.t, {"units": "s"}),
        "joint": list(plants.component_names(proof.scenario.plant)),
        "path": list(proof.ranges),
        "end": ["low", "high"],
        "weight": list(proof.rates),
    }
    return xarray.Dataset(data, coordinates, attributes)
