"""The check of a URDF, element by element, and the part of it that says how links move and what they weigh.

The copy that goes on holds links with their inertials, and joints; each number has been looked at.  Mimic joints go apart: whether one
matters is known when the chain is.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import NamedTuple

import numpy as np

from iblf_jax import checks
from iblf_jax.robots.description import MOST_BODIES, Shown, floats, label

MOVING = ("revolute", "continuous", "prismatic")
INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


class Mimic(NamedTuple):
    """A joint that follows another: q = multiplier * q_master + offset."""

    master: str
    multiplier: float
    offset: float


class Urdf(NamedTuple):
    """What a URDF holds, checked."""

    text: str
    """The copy."""
    root: str
    """Name of the link that no joint moves."""
    mimics: dict[str, Mimic]


def checked(robot: ET.Element) -> Urdf:
    """The copy of a URDF.

    Raises:
      ValueError: what is wrong, with the name of the link or joint.
    """
    links = _by_name(robot, "link")
    joints = _by_name(robot, "joint")
    if not links:
        raise checks.fail("robot", Shown("no <link>"), "a URDF with links and joints")
    if len(links) > MOST_BODIES:
        raise checks.fail("robot", Shown(f"{len(links)} links"), f"at most {MOST_BODIES}")
    parent_of = {_end(joint, "child", links): (_end(joint, "parent", links), name) for name, joint in reversed(joints.items())}
    _is_tree(links, joints, parent_of)
    root = next(name for name in links if name not in parent_of)
    moves = _moving(links, joints, parent_of)
    copy = ET.Element("robot", name="robot")
    for name, link in links.items():
        ET.SubElement(copy, "link", name=name).extend(_inertial(link) if name in moves else [])
    mimics: dict[str, Mimic] = {}
    for joint in joints.values():
        copy.append(_joint(joint, mimics))
    for name, mimic in mimics.items():
        if mimic.master not in joints:
            raise checks.fail(f"joint {name!r}: mimic", mimic.master, "the name of a joint")
    return Urdf(ET.tostring(copy, encoding="unicode"), root, mimics)


def _by_name(robot: ET.Element, tag: str) -> dict[str, ET.Element]:
    found: dict[str, ET.Element] = {}
    for element in robot.findall(tag):
        name = element.get("name", "")
        if not name.strip():
            raise checks.fail(f"<{tag}>", Shown("one without a name"), "a name for each")
        if name in found:
            raise checks.fail(f"{tag} {name!r}", Shown("two of this name"), "names that differ")
        found[name] = element
    return found


def _end(joint: ET.Element, which: str, links: dict[str, ET.Element]) -> str:
    ends = joint.findall(which)
    if len(ends) != 1 or ends[0].get("link") not in links:
        got = ends[0].get("link") if len(ends) == 1 else Shown(f"{len(ends)} of them")
        raise checks.fail(f"{label(joint)}: {which}", got, "the name of one link of this file")
    return str(ends[0].get("link"))


def _is_tree(links: dict[str, ET.Element], joints: dict[str, ET.Element], parent_of: dict[str, tuple[str, str]]) -> None:
    """Raises where a link has two parents, or none of the links is the root of all."""
    seen: dict[str, str] = {}
    for name, joint in joints.items():
        child = _end(joint, "child", links)
        if child in seen:
            mend = "A closed chain has no serial one: cut it open at a joint."
            raise checks.fail(f"link {child!r}", Shown(f"two parents, by joints {seen[child]!r} and {name!r}"), "one parent", mend)
        seen[child] = name
    roots = [name for name in links if name not in parent_of]
    if len(roots) > 1:
        raise checks.fail(
            "robot", Shown(f"links without a parent: {', '.join(map(repr, roots[:5]))}"), "one root", "Connect them by joints."
        )
    reached = set(roots)
    children: dict[str, list[str]] = {}
    for child, (parent, _) in parent_of.items():
        children.setdefault(parent, []).append(child)
    frontier = list(roots)
    while frontier:
        below = [child for parent in frontier for child in children.get(parent, ())]
        reached.update(below)
        frontier = below
    if len(reached) < len(links):
        lost = next(name for name in links if name not in reached)
        raise checks.fail(
            f"link {lost!r}", Shown("a ring of joints"), "links that hang on one root", "A closed chain: cut it open at a joint."
        )


def _moving(links: dict[str, ET.Element], joints: dict[str, ET.Element], parent_of: dict[str, tuple[str, str]]) -> set[str]:
    """The links that some joint can move."""
    moves: dict[str, bool] = {}
    for name in links:
        trail = []
        while name not in moves and name in parent_of:
            trail.append(name)
            if joints[parent_of[name][1]].get("type") != "fixed":
                break
            name = parent_of[name][0]
        answer = moves.get(name, False) if not trail or trail[-1] != name else True
        moves.update(dict.fromkeys(trail, answer))
    return {name for name, yes in moves.items() if yes}


def _one(parent: ET.Element, tag: str) -> ET.Element | None:
    found = parent.findall(tag)
    if len(found) > 1:
        raise checks.fail(f"{label(parent)}: <{tag}>", Shown(f"{len(found)} of them"), "one at most")
    return found[0] if found else None


def _origin(parent: ET.Element, where: str) -> ET.Element:
    origin = _one(parent, "origin")
    copy = ET.Element("origin")
    for name in ("xyz", "rpy"):
        text = origin.get(name, "0 0 0") if origin is not None else "0 0 0"
        copy.set(name, " ".join(map(repr, floats(f"{where}: origin {name}", text, 3))))
    return copy


def _inertial(link: ET.Element) -> list[ET.Element]:
    """The inertial of a link that moves, as a list of one; none if it has none."""
    where, inertial = label(link), _one(link, "inertial")
    if inertial is None:
        return []
    mass, inertia = _one(inertial, "mass"), _one(inertial, "inertia")
    if mass is None:
        raise checks.fail(f"{where}: inertial", Shown("no <mass>"), "a mass [kg]")
    (kg,) = floats(f"{where}: mass", mass.get("value", ""), 1)
    if kg < 0:
        raise checks.fail(f"{where}: mass", kg, "a mass >= 0 kg")
    if inertia is None:
        if kg > 0:
            raise checks.fail(f"{where}: inertial", Shown("no <inertia>"), "an inertia [kg m^2]")
        return []
    numbers = [floats(f"{where}: inertia {name}", inertia.get(name, "0" if name in INERTIA[3:] else ""), 1)[0] for name in INERTIA]
    if kg == 0:
        if any(numbers):
            mend = "Give it its mass, or remove its inertia: tools differ in what they make of this."
            raise checks.fail(f"{where}: inertial", Shown("an inertia without a mass"), "both or neither", mend)
        return []
    check_inertia(where, np.array(numbers))
    copy = ET.Element("inertial")
    copy.append(_origin(inertial, f"{where}: inertial"))
    ET.SubElement(copy, "mass", value=repr(kg))
    ET.SubElement(copy, "inertia", {name: repr(x) for name, x in zip(INERTIA, numbers, strict=True)})
    return [copy]


def check_inertia(where: str, numbers: np.ndarray) -> None:
    """Raises unless xx yy zz xy xz yz are the inertia of a body: positive definite, no principal moment above the sum of the others."""
    xx, yy, zz, xy, xz, yz = numbers
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    shown = Shown("principal moments " + ", ".join(f"{x:.4g}" for x in moments))
    if not moments[0] > 0:
        raise checks.fail(f"{where}: inertia", shown, "a positive definite inertia [kg m^2]", "A body that moves needs one.")
    if moments[2] > (moments[0] + moments[1]) * (1 + 1e-6):
        mend = "No body has such an inertia: look at the units, the signs and the frame."
        raise checks.fail(f"{where}: inertia", shown, "none above the sum of the two others", mend)


def _joint(joint: ET.Element, mimics: dict[str, Mimic]) -> ET.Element:
    where, kind = label(joint), joint.get("type", "")
    if kind not in (*MOVING, "fixed"):
        mend = "Floating and planar joints are not part of a serial arm." if kind in ("floating", "planar") else ""
        raise checks.fail(f"{where}: type", kind, "revolute, continuous, prismatic or fixed", mend)
    copy = ET.Element("joint", name=str(joint.get("name")), type=kind)
    copy.append(_origin(joint, where))
    for which in ("parent", "child"):
        ET.SubElement(copy, which, link=str(joint.findall(which)[0].get("link")))
    if kind == "fixed":
        return copy
    axis = _one(joint, "axis")
    direction = floats(f"{where}: axis", axis.get("xyz", "1 0 0") if axis is not None else "1 0 0", 3)
    if not np.linalg.norm(direction) > 1e-6:
        raise checks.fail(f"{where}: axis", direction, "a direction")
    ET.SubElement(copy, "axis", xyz=" ".join(map(repr, direction)))
    _limit(joint, where, kind, copy)
    dynamics = _one(joint, "dynamics")
    if dynamics is not None:
        found = {name: floats(f"{where}: {name}", dynamics.get(name, "0"), 1)[0] for name in ("damping", "friction")}
        for name, value in found.items():
            if value < 0:
                raise checks.fail(f"{where}: {name}", value, "a number >= 0")
        ET.SubElement(copy, "dynamics", {name: repr(value) for name, value in found.items()})
    mimic = _one(joint, "mimic")
    if mimic is not None:
        (multiplier,), (offset,) = (
            floats(f"{where}: mimic {name}", mimic.get(name, default), 1) for name, default in (("multiplier", "1"), ("offset", "0"))
        )
        mimics[str(joint.get("name"))] = Mimic(mimic.get("joint", ""), multiplier, offset)
    return copy


def _limit(joint: ET.Element, where: str, kind: str, copy: ET.Element) -> None:
    limit = _one(joint, "limit")
    if limit is None:
        if kind != "continuous":
            mend = 'Add <limit lower="..." upper="..."/>, or make it continuous.'
            raise checks.fail(f"{where}: limit", Shown("nothing"), "the range of a joint that is not continuous", mend)
        return
    values = {name: floats(f"{where}: limit {name}", limit.get(name, "0"), 1)[0] for name in ("lower", "upper", "effort")}
    if kind != "continuous" and not values["lower"] < values["upper"]:
        raise checks.fail(f"{where}: limit", (values["lower"], values["upper"]), "lower < upper")
    if values["effort"] < 0:
        raise checks.fail(f"{where}: effort", values["effort"], "a number >= 0")
    if kind == "continuous":
        values = {"effort": values["effort"]}
    ET.SubElement(copy, "limit", {name: repr(value) for name, value in values.items()})
