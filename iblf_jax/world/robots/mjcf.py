"""The part of an MJCF that defines how bodies move and what they weigh.

The copy keeps a list of elements and attributes; it drops visuals, collision geometry without mass
and sensors.  The library resolves defaults, and it rejects a whole model for a faulty weight of a
body that may not belong to the chain.  `Mjcf.separate_weights` therefore replaces such weights
before the library compiles the model, and they are validated only where the chain carries the body.
The library receives those meshes that define the weight of a body, as bytes that were read here.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from iblf_jax.core import checks
from iblf_jax.world.robots.description import (
    LARGEST_NUMBER,
    MAX_BODIES,
    MAX_BYTES,
    MAX_NUMBERS,
    MAX_RANGE,
    Shown,
    floats,
    label,
)
from iblf_jax.world.robots.meshes import Meshes
from iblf_jax.world.robots.repair import Fault, Weight, checked_weight, symmetric

if TYPE_CHECKING:
    import mujoco

PLACE = "pos quat axisangle xyaxes zaxis euler"
ACTUATOR = "name class joint gear ctrlrange ctrllimited forcerange forcelimited inheritrange"
KEPT = {
    "compiler": (
        "angle autolimits eulerseq fitaabb inertiafromgeom inertiagrouprange boundmass boundinertia"
        " balanceinertia settotalmass alignfree"
    ),
    "option": "gravity",
    "flag": "gravity",
    "default": "class",
    "asset": "",
    "mesh": (
        "name class file content_type vertex face scale refpos refquat inertia maxhullvert builtin"
        " params"
    ),
    "worldbody": "",
    "body": f"name childclass mocap gravcomp {PLACE}",
    "frame": f"name childclass {PLACE}",
    "inertial": f"mass diaginertia fullinertia {PLACE}",
    "joint": (
        "name class type pos axis range limited ref stiffness damping frictionloss armature"
        " actuatorfrcrange actuatorfrclimited"
    ),
    "freejoint": "name",
    "site": f"name class {PLACE}",
    "geom": (
        f"name class type mesh hfield mass density size fromto group shellinertia fitscale {PLACE}"
    ),
    "equality": "",
    "connect": "name class active body1 body2 anchor site1 site2",
    "weld": "name class active body1 body2 relpose anchor site1 site2",
    "actuator": "",
    "general": f"{ACTUATOR} gaintype gainprm biastype biasprm",
    **dict.fromkeys(("motor", "position", "velocity", "intvelocity", "damper"), ACTUATOR),
}
"""Element -> its attributes that the copy keeps."""
COUPLING = "name class active joint1 joint2 polycoef"
"""The attributes of a <joint> in <equality>, which is a constraint between joints."""
REFUSED = {
    "replicate": "Write the bodies out.",
    "composite": "Write the bodies out.",
    "flexcomp": "Write the bodies out.",
    "attach": "Write the model out into one file.",
}
WORDS = (
    "mesh hfield file content_type inertia builtin name class childclass type angle eulerseq"
    " joint joint1 joint2 body1 body2 site1 site2 gaintype biastype"
)
"""Attributes that hold words, not numbers."""
MESH_TYPES = ("mjGEOM_MESH", "mjGEOM_SDF", "mjGEOM_HFIELD")
"""The library's names of geoms whose shape is in a file."""
LONG_ATTRIBUTES = "vertex face"
"""Attributes whose number of numbers is limited only by the size of the file."""
SCALAR_ATTRIBUTES = "gravcomp mass density ref stiffness damping frictionloss armature"
"""Attributes that hold one number."""
RANGE_ATTRIBUTES = "damping frictionloss range ctrlrange forcerange actuatorfrcrange"
"""Attributes in which a very large number may mean "none" or "locked"."""
SWITCHES = ("true", "false", "auto", "enable", "disable")
MIN_INERTIA = 1e-15
"""Mass [kg] and moments [kg m^2] below which the library refuses a body that moves."""

Tendons = dict[str, tuple[set[str], set[str]]]
"""Constraints on tendons: label -> (joints, sites) that they couple."""


class Mjcf(NamedTuple):
    """The checked content of an MJCF."""

    text: str
    """The copy for the library."""
    tendons: Tendons
    folder: Path
    """Where its meshes are."""
    bare: bool
    """Whether `folder` has them under their bare names, without the folders in the file."""
    root: str = "world"
    """Name of the body that no joint moves."""
    speeds: dict[str, float] = {}  # noqa: RUF012
    """Joint -> its largest speed, which an MJCF does not have."""

    def separate_weights(self, spec: mujoco.MjSpec) -> list[tuple[Any, Weight]]:
        """Replaces every weight that the library would reject or cannot know by a valid one, and
        returns the weights of the file.

        Args:
          spec: the library's, parsed and not compiled; it is changed.

        Returns:
          Bodies of it with their weights, along the axes and about the origin of the inertial frame
          that the library gives them.
        """
        c, out = spec.compiler, []
        meshes = Meshes(spec, self.folder, self.bare)
        bounded = c.boundmass > 0 or c.boundinertia > 0 or c.settotalmass > 0
        low, high = c.inertiagrouprange
        for body in spec.bodies:
            where, from_geoms, fault = f"body {body.name!r}", False, None
            by_geoms = int(c.inertiafromgeom) == 1 or (
                int(c.inertiafromgeom) == 2 and not body.explicitinertial
            )
            for geom in list(body.geoms):
                has_mass = geom.mass != 0 and not (np.isnan(geom.mass) and geom.density == 0)
                weighs = body.name != "world" and has_mass and low <= geom.group <= high
                shaped = geom.meshname or geom.hfieldname or geom.type.name in MESH_TYPES
                problem = None
                if weighs and shaped and by_geoms:
                    problem = meshes.problem(geom)
                fault = fault or problem
                if not weighs or problem or (shaped and not by_geoms):
                    spec.delete(geom)
                else:
                    from_geoms = True
            if fault:
                out.append(
                    (body, Weight(fault=Fault(where, "", checks.with_location(where, fault))))
                )
            elif (by_geoms and from_geoms) or bounded:
                continue
            else:
                weight = _explicit(body, where, bool(c.balanceinertia))
                if weight is None:
                    continue
                out.append((body, weight))
            body.explicitinertial, body.mass, body.inertia = True, 1.0, np.ones(3)
            body.fullinertia = [np.nan, 0, 0, 0, 0, 0]
            if np.isnan(body.ipos).any():
                body.ipos = np.zeros(3)
            if int(c.inertiafromgeom) == 1:
                for geom in list(body.geoms):
                    spec.delete(geom)
        meshes.leave()
        return out


def checked(root: ET.Element, folder: Path) -> Mjcf:
    """The copy of an MJCF, whose meshes' folders are named from `folder` on.

    Raises:
      ValueError: what is wrong, with the name of the element.
    """
    copy = ET.Element("mujoco")
    _copy(root, copy, "")
    bodies = sum(1 for _ in copy.iter("body"))
    if not bodies:
        raise checks.fail("mujoco", Shown("no <body>"), "an MJCF with bodies and joints")
    if bodies > MAX_BODIES:
        raise checks.fail("mujoco", Shown(f"{bodies} bodies"), f"at most {MAX_BODIES}")
    meshes, bare = "", False
    for compiler in root.findall("compiler"):
        meshes = compiler.get("meshdir", compiler.get("assetdir", meshes))
        bare = compiler.get("strippath", str(bare).lower()) == "true"
    # The joints and sites that each constraint on tendons ties together.
    defined = {tendon.get("name"): tendon for tendon in root.findall("tendon/*")}
    ties: Tendons = {}
    for element in root.findall("equality/tendon"):
        joints, sites = ties[label(element)] = (set(), set())
        for which in ("tendon1", "tendon2"):
            tendon = defined.get(element.get(which), ET.Element("tendon"))
            joints |= {x.get("joint", "") for x in tendon.findall("joint")}
            sites |= {x.get("site", "") for x in tendon.findall("site")}
    return Mjcf(ET.tostring(copy, encoding="unicode"), ties, folder / meshes, bare)


def _copy(source: ET.Element, target: ET.Element, section: str) -> None:
    for element in source:
        tag = element.tag
        if tag in REFUSED:
            got = Shown("an element that makes bodies")
            raise checks.fail(f"<{tag}>", got, "bodies written out", REFUSED[tag])
        drives_no_joint = section == "actuator" and element.get("joint") is None
        if tag not in KEPT or drives_no_joint:
            continue
        kept = KEPT[tag]
        if (section, tag) == ("equality", "joint"):
            kept = COUPLING
        attributes = {name: text for name, text in element.items() if name in kept.split()}
        for name, text in attributes.items():
            if name in WORDS.split() or text in SWITCHES:
                continue
            count = 1 if name in SCALAR_ATTRIBUTES.split() else None
            most = MAX_RANGE if name in RANGE_ATTRIBUTES.split() else LARGEST_NUMBER
            longest = MAX_BYTES if name in LONG_ATTRIBUTES.split() else MAX_NUMBERS
            floats(f"{label(element)}: {name}", text, count, most=most, longest=longest)
        _copy(element, ET.SubElement(target, tag, attributes), section or tag)


def _explicit(body: mujoco.MjsBody, where: str, balanced: bool) -> Weight | None:
    """The weight in a body's <inertial>, zero if it has none; None if the library accepts it."""
    if not body.explicitinertial:
        return Weight()
    J = np.diag(body.inertia)
    if not np.isnan(body.fullinertia[0]):
        J = symmetric(*body.fullinertia)
    moments = np.linalg.eigvalsh(J)
    is_possible = balanced or moments[2] <= moments[0] + moments[1]
    if min(body.mass, moments[0]) >= MIN_INERTIA and is_possible:
        return None
    return checked_weight(where, float(body.mass), J)
