"""Checks a URDF and copies the elements that define the kinematics and the inertias of its links.

The `mujoco` library receives a copy with links and joints, of which every number is checked. Masses
and inertias, faults of links and joints, and mimic joints are kept separately, because they matter
only for the links and joints of the chain.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from iblf_jax.core import checks
from iblf_jax.world.robots.description import MAX_BODIES, MAX_RANGE, Shown, floats, label
from iblf_jax.world.robots.mjcf import Tendons
from iblf_jax.world.robots.repair import Fault, Weight, checked_weight, fault, symmetric

if TYPE_CHECKING:
    import mujoco

MOVABLE = ("revolute", "continuous", "prismatic")
INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
ZERO = [0.0, 0.0, 0.0]
NONNEGATIVE = "a number >= 0"


class Mimic(NamedTuple):
    """A joint that follows another: q = multiplier * q_master + offset."""

    master: str
    multiplier: float
    offset: float

    @property
    def shown(self) -> str:
        """The text by which messages show it."""
        return f"a mimic of {self.master!r} in the chain"


class Urdf(NamedTuple):
    """The checked content of a URDF."""

    text: str
    """The copy for the library."""
    root: str
    """Name of the link that no joint moves."""
    mimics: dict[str, Mimic]
    weights: dict[str, Weight]
    """Link -> its mass and inertia about the centre of mass in the copy, along the link's axes."""
    pose_faults: dict[str, Fault]
    """Link -> fault of its origin; matters for a link in the chain or carried by it."""
    axis_faults: dict[str, Fault]
    """Joint -> fault of its kind or axis; matters if the joint moves or is locked at another
    position than 0."""
    motion_faults: dict[str, list[Fault]]
    """Joint -> faults of its range, torque, speed or friction; matter if the joint moves."""
    speeds: dict[str, float]
    """Joint -> its largest speed, if it has one; the library does not keep it."""
    tendons: Tendons = {}  # noqa: RUF012
    """Constraints on tendons; a URDF has none."""

    def separate_weights(self, spec: mujoco.MjSpec) -> list[tuple[Any, Weight]]:
        """The library's bodies with their weights.

        The copy does not contain them, because the library would also reject faults of bodies that
        the chain does not carry.
        """
        return [
            (body, self.weights[body.name]) for body in spec.bodies if body.name in self.weights
        ]


def checked(robot: ET.Element) -> Urdf:
    """The checked content of a URDF.

    Raises:
      ValueError: a fault of the tree of links, with the name of the link or joint.
    """
    links = _by_name(robot, "link")
    joints = _by_name(robot, "joint")
    if not links:
        raise checks.fail("robot", Shown("no <link>"), "a URDF with links and joints")
    if len(links) > MAX_BODIES:
        raise checks.fail("robot", Shown(f"{len(links)} links"), f"at most {MAX_BODIES}")
    parent_of = {
        _end(joint, "child", links): _end(joint, "parent", links) for joint in joints.values()
    }
    _is_tree(links, joints, parent_of)
    root = next(name for name in links if name not in parent_of)
    found = Urdf("", root, {}, {}, {}, {}, {}, {})
    copy = ET.Element("robot", name="robot")
    for name, link in links.items():
        found.weights[name], centre = _weight(link)
        inertial = ET.SubElement(ET.SubElement(copy, "link", name=name), "inertial")
        ET.SubElement(inertial, "origin", xyz=_words(centre))
        ET.SubElement(inertial, "mass", value="1")
        ET.SubElement(inertial, "inertia", dict(zip(INERTIA, "111000", strict=True)))
    for joint in joints.values():
        copy.append(_joint(joint, found))
    for name, mimic in found.mimics.items():
        if mimic.master not in joints:
            error = checks.fail(f"joint {name!r}: mimic", mimic.master, "the name of a joint")
            repaired = "one that moves by itself"
            found.motion_faults[name].append(Fault(f"joint {name!r}", mimic.shown, error, repaired))
    return found._replace(text=ET.tostring(copy, encoding="unicode"))


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


def _is_tree(
    links: dict[str, ET.Element], joints: dict[str, ET.Element], parent_of: dict[str, str]
) -> None:
    """Raises ValueError unless the links form one tree."""
    seen: dict[str, str] = {}
    for name, joint in joints.items():
        child = _end(joint, "child", links)
        if child in seen:
            remedy = "A closed chain has no serial one: cut it open at a joint."
            got = Shown(f"two parents, by joints {seen[child]!r} and {name!r}")
            raise checks.fail(f"link {child!r}", got, "one parent", remedy)
        seen[child] = name
    roots = [name for name in links if name not in parent_of]
    if len(roots) > 1:
        got = Shown(f"links without a parent: {', '.join(map(repr, roots[:5]))}")
        raise checks.fail("robot", got, "one root", "Connect them by joints.")
    for name in links:
        ancestors = {name}
        above = name
        while above in parent_of:
            above = parent_of[above]
            if above in ancestors:
                expected = "links that hang on one root"
                remedy = "A closed chain: cut it open at a joint."
                raise checks.fail(f"link {name!r}", Shown("a ring of joints"), expected, remedy)
            ancestors.add(above)


def _one(parent: ET.Element, tag: str) -> ET.Element | None:
    found = parent.findall(tag)
    if len(found) > 1:
        got = Shown(f"{len(found)} of them")
        raise checks.fail(f"{label(parent)}: <{tag}>", got, "one at most")
    return next(iter(found), None)


def _origin(parent: ET.Element, where: str) -> tuple[list[float], list[float]]:
    """Position and roll, pitch, yaw of an element's <origin>."""
    origin = _one(parent, "origin")
    if origin is None:
        return ZERO, ZERO
    xyz = floats(f"{where}: origin xyz", origin.get("xyz", "0 0 0"), 3)
    rpy = floats(f"{where}: origin rpy", origin.get("rpy", "0 0 0"), 3)
    return xyz, rpy


def _weight(link: ET.Element) -> tuple[Weight, list[float]]:
    """Mass and inertia of a link, and its centre of mass."""
    where = label(link)
    try:
        inertial = _one(link, "inertial")
        if inertial is None:
            return Weight(), ZERO
        return _inertial(where, inertial)
    except ValueError as error:
        return Weight(fault=Fault(where, "", error)), ZERO


def _inertial(where: str, inertial: ET.Element) -> tuple[Weight, list[float]]:
    from scipy.spatial.transform import Rotation

    mass, inertia = _one(inertial, "mass"), _one(inertial, "inertia")
    if mass is None:
        raise checks.fail(f"{where}: inertial", Shown("no <mass>"), "a mass [kg]")
    (kg,) = floats(f"{where}: mass", mass.get("value", ""), 1)
    centre, rpy = _origin(inertial, f"{where}: inertial")
    if inertia is None:
        if kg <= 0:
            return checked_weight(where, kg, np.zeros((3, 3))), centre
        error = checks.fail(f"{where}: inertial", Shown("no <inertia>"), "an inertia [kg m^2]")
        point = Fault(f"{where}: inertia", "nothing", error, "that of a point, 0 kg m^2")
        return Weight(kg, fault=point), centre
    products = dict.fromkeys(INERTIA[3:], "0")  # which may be left out
    xx, yy, zz, xy, xz, yz = (
        floats(f"{where}: inertia {name}", inertia.get(name, products.get(name, "")), 1)[0]
        for name in INERTIA
    )
    R = Rotation.from_euler("xyz", rpy).as_matrix()  # about fixed axes, one after the other
    J = symmetric(xx, yy, zz, xy, xz, yz)
    return checked_weight(where, kg, R @ J @ R.T), centre


def _joint(joint: ET.Element, found: Urdf) -> ET.Element:
    """The copy of a joint, with default values in place of faulty ones; `found` gets the faults."""
    where, name, kind = label(joint), str(joint.get("name")), joint.get("type", "")
    parent, child = (str(joint.findall(which)[0].get("link")) for which in ("parent", "child"))
    copied_kind = "continuous"  # a revolute joint too, until its range is known
    if kind in ("fixed", "prismatic"):
        copied_kind = kind
    copy = ET.Element("joint", name=name, type=copied_kind)
    xyz, rpy = ZERO, ZERO
    try:
        xyz, rpy = _origin(joint, where)
    except ValueError as error:
        found.pose_faults[child] = Fault(where, "", error)
    ET.SubElement(copy, "origin", xyz=_words(xyz), rpy=_words(rpy))
    ET.SubElement(copy, "parent", link=parent)
    ET.SubElement(copy, "child", link=child)
    if kind == "fixed":
        return copy
    axis = [1.0, 0.0, 0.0]
    try:
        axis = _axis(joint, where, kind)
    except ValueError as error:
        found.axis_faults[name] = Fault(where, "", error)
    ET.SubElement(copy, "axis", xyz=_words(axis))
    faults = found.motion_faults[name] = []
    for read in (_limit, _dynamics, _mimic):
        try:
            faults += read(joint, where, copy, found)
        except ValueError as error:
            faults.append(Fault(where, "", error))
    return copy


def _words(numbers: list[float]) -> str:
    return " ".join(map(repr, numbers))


def _axis(joint: ET.Element, where: str, kind: str) -> list[float]:
    if kind not in MOVABLE:
        remedy = ""
        if kind in ("floating", "planar"):
            remedy = "Floating and planar joints are not part of a serial arm."
        raise checks.fail(
            f"{where}: type", kind, "revolute, continuous, prismatic or fixed", remedy
        )
    axis = _one(joint, "axis")
    if axis is None:
        return [1.0, 0.0, 0.0]
    direction = floats(f"{where}: axis", axis.get("xyz", "1 0 0"), 3)
    if not np.linalg.norm(direction) > 1e-6:
        raise checks.fail(f"{where}: axis", direction, "a direction")
    return direction


def _limit(joint: ET.Element, where: str, copy: ET.Element, found: Urdf) -> list[Fault]:
    """Copies the range and the largest torque of a joint, and adds its largest speed to `found`;
    returns the faults of values that are left out.
    """
    limit = _one(joint, "limit")
    is_continuous = joint.get("type") == "continuous"
    faults = []
    if limit is None:
        if is_continuous:
            return []
        remedy = 'Add <limit lower="..." upper="..."/>, or make it continuous.'
        expected = "the range of a joint that is not continuous"
        return [fault(f"{where}: limit", Shown("nothing"), expected, "no limits", remedy=remedy)]
    names = ["effort", "velocity"]
    if not is_continuous:
        names = ["lower", "upper", *names]
    values = {
        name: floats(f"{where}: limit {name}", limit.get(name, "0"), 1, most=MAX_RANGE)[0]
        for name in names
    }
    if not is_continuous and not values["lower"] < values["upper"]:
        got = (values.pop("lower"), values.pop("upper"))
        faults.append(fault(f"{where}: limit", got, "lower < upper", "no limits"))
    if values["effort"] < 0:
        faults.append(fault(f"{where}: effort", values.pop("effort"), NONNEGATIVE, "no limit"))
    speed = values.pop("velocity")
    if speed > 0:
        found.speeds[str(joint.get("name"))] = speed
    elif speed < 0:
        faults.append(fault(f"{where}: velocity", speed, NONNEGATIVE, "no limit"))
    if "lower" in values and copy.get("type") == "continuous":
        copy.set("type", "revolute")
    ET.SubElement(copy, "limit", {name: repr(value) for name, value in values.items()})
    return faults


def _dynamics(joint: ET.Element, where: str, copy: ET.Element, _: Urdf) -> list[Fault]:
    """Copies damping and friction of a joint; returns their faults."""
    dynamics, faults = _one(joint, "dynamics"), []
    if dynamics is None:
        return []
    found = {
        name: floats(f"{where}: {name}", dynamics.get(name, "0"), 1, most=MAX_RANGE)[0]
        for name in ("damping", "friction")
    }
    for name, value in found.items():
        if value < 0:
            faults.append(fault(f"{where}: {name}", value, NONNEGATIVE, "0"))
    ET.SubElement(copy, "dynamics", {name: repr(max(value, 0.0)) for name, value in found.items()})
    return faults


def _mimic(joint: ET.Element, where: str, _: ET.Element, found: Urdf) -> list[Fault]:
    """Adds the joint that a mimic joint follows to `found`."""
    mimic = _one(joint, "mimic")
    if mimic is not None:
        (multiplier,) = floats(f"{where}: mimic multiplier", mimic.get("multiplier", "1"), 1)
        (offset,) = floats(f"{where}: mimic offset", mimic.get("offset", "0"), 1)
        found.mimics[str(joint.get("name"))] = Mimic(mimic.get("joint", ""), multiplier, offset)
    return []
