"""The part of an MJCF that says how bodies move and what they weigh.

A list of elements and attributes goes on; what draws, collides without weighing anything, senses or refers to other files does not.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

from iblf_jax import checks
from iblf_jax.robots.description import MOST_BODIES, Shown, floats, label

PLACE = "pos quat axisangle xyaxes zaxis euler"
ACTUATOR = "name class joint gear ctrlrange ctrllimited forcerange forcelimited"
KEPT = {
    "compiler": "angle autolimits eulerseq inertiafromgeom inertiagrouprange boundmass boundinertia balanceinertia settotalmass alignfree",
    "option": "gravity",
    "default": "class",
    "worldbody": "",
    "body": f"name childclass {PLACE}",
    "frame": f"name childclass {PLACE}",
    "inertial": f"mass diaginertia fullinertia {PLACE}",
    "joint": "name class type pos axis range limited ref stiffness damping frictionloss armature actuatorfrcrange actuatorfrclimited",
    "freejoint": "name",
    "site": f"name class {PLACE}",
    "geom": f"name class type mass density size fromto group shellinertia {PLACE}",
    "equality": "",
    "connect": "name class active body1 body2 anchor site1 site2",
    "weld": "name class active body1 body2 relpose anchor site1 site2",
    "actuator": "",
    "general": f"{ACTUATOR} gaintype gainprm biastype biasprm",
    **dict.fromkeys(("motor", "position", "velocity", "intvelocity", "damper"), ACTUATOR),
}
"""Element -> the attributes of it that go on."""
COUPLING = "name class active joint1 joint2 polycoef"
"""The attributes of a <joint> in <equality>, which is another thing."""
REFUSED = {
    "replicate": "Write the bodies out.",
    "composite": "Write the bodies out.",
    "flexcomp": "Write the bodies out.",
    "attach": "Write the model out into one file.",
}
WORDS = [
    "name",
    "class",
    "childclass",
    "type",
    "angle",
    "eulerseq",
    "joint",
    "joint1",
    "joint2",
    "body1",
    "body2",
    "site1",
    "site2",
    "gaintype",
    "biastype",
]
"""Attributes that hold words, not numbers."""
SINGLE = ("mass", "density", "ref", "stiffness", "damping", "frictionloss", "armature")
"""Attributes that hold one number."""


def checked(root: ET.Element) -> str:
    """The copy of an MJCF.

    Raises:
      ValueError: what is wrong, with the name of the element.
    """
    copy = ET.Element("mujoco")
    geoms_weigh = any(element.get("inertiafromgeom") == "true" for element in root.iter("compiler"))
    _copy(root, copy, "", geoms_weigh)
    bodies = sum(1 for _ in copy.iter("body"))
    if not bodies:
        raise checks.fail("mujoco", Shown("no <body>"), "an MJCF with bodies and joints")
    if bodies > MOST_BODIES:
        raise checks.fail("mujoco", Shown(f"{bodies} bodies"), f"at most {MOST_BODIES}")
    return ET.tostring(copy, encoding="unicode")


def _copy(source: ET.Element, target: ET.Element, section: str, geoms_weigh: bool) -> None:
    for element in source:
        tag = element.tag
        if tag in REFUSED:
            raise checks.fail(f"<{tag}>", Shown("an element that makes bodies"), "bodies written out", REFUSED[tag])
        if section == "equality" and tag == "tendon":
            raise checks.fail(label(element), Shown("joints coupled by a tendon"), "joints that move by themselves", "Remove it.")
        if tag not in KEPT or (tag == "geom" and not _weighs(element, source, geoms_weigh)):
            continue
        kept = COUPLING if (section, tag) == ("equality", "joint") else KEPT[tag]
        attributes = {name: text for name, text in element.items() if name in kept.split()}
        for name, text in attributes.items():
            if name not in WORDS and text not in ("true", "false", "auto"):
                floats(f"{label(element)}: {name}", text, 1 if name in SINGLE else None)
        _copy(element, ET.SubElement(target, tag, attributes), section or tag, geoms_weigh)


def _weighs(geom: ET.Element, body: ET.Element, geoms_weigh: bool) -> bool:
    """Whether a geom counts for the inertia of its body: not where the body has its own, unless the file says that geoms do."""
    if body.tag == "default" or (body.find("inertial") is not None and not geoms_weigh) or geom.get("mass", "").strip() == "0":
        return body.tag == "default" and geom.get("type") != "mesh"
    if geom.get("mesh") is not None or geom.get("type") in ("mesh", "sdf", "hfield"):
        mend = "Meshes are not opened: give the body an <inertial>."
        raise checks.fail(f"{label(body)}: {label(geom)}", Shown("an inertia from a mesh"), "masses and inertias in numbers", mend)
    return True
