"""The part of an MJCF that says how bodies move and what they weigh.

A list of elements and attributes goes on; what draws, collides without weighing anything, senses or refers to other files does not.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

from iblf_jax import checks
from iblf_jax.robots.description import MOST_BODIES, Shown, floats, label

PLACE = "pos quat axisangle xyaxes zaxis euler"
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
    **dict.fromkeys(("motor", "position", "velocity", "intvelocity", "damper", "general"), "name class joint gear forcerange forcelimited"),
}
"""Element -> the attributes of it that go on."""
REFUSED = {
    "replicate": "Write the bodies out.",
    "composite": "It makes bodies that this cannot read.",
    "flexcomp": "It makes bodies that this cannot read.",
    "attach": "Write the model out into one file.",
}
WORDS = ("name", "class", "childclass", "type", "angle", "eulerseq", "inertiafromgeom", "joint", "active", "limited")
"""Attributes that hold words, not numbers (and those that end in limited, or start with body or site)."""


def checked(root: ET.Element) -> str:
    """The copy of an MJCF.

    Raises:
      ValueError: what is wrong, with the name of the element.
    """
    copy = ET.Element("mujoco")
    _copy(root, copy, "")
    bodies = sum(1 for _ in copy.iter("body"))
    if not bodies:
        raise checks.fail("mujoco", Shown("no <body>"), "an MJCF with bodies and joints")
    if bodies > MOST_BODIES:
        raise checks.fail("mujoco", Shown(f"{bodies} bodies"), f"at most {MOST_BODIES}")
    return ET.tostring(copy, encoding="unicode")


def _copy(source: ET.Element, target: ET.Element, section: str) -> None:
    for element in source:
        tag = element.tag
        if tag in REFUSED:
            raise checks.fail(f"<{tag}>", Shown("an element that multiplies or attaches bodies"), "bodies written out", REFUSED[tag])
        if tag not in KEPT or (tag == "geom" and not _weighs(element, source)):
            continue
        attributes = {name: text for name, text in element.items() if name in KEPT[tag].split()}
        for name, text in attributes.items():
            word = name in WORDS or name.endswith("limited") or name.startswith(("body", "site"))
            if not word and text not in ("true", "false", "auto"):
                floats(f"{label(element)}: {name}", text)
        _copy(element, ET.SubElement(target, tag, attributes), section or tag)


def _weighs(geom: ET.Element, body: ET.Element) -> bool:
    """Whether a geom may count for the inertia of its body: not where the body has its own."""
    return body.tag == "default" or body.find("inertial") is None
