"""URDF: rigid links on revolute joints, with springs as Gazebo and related programs read them."""

from xml.etree import ElementTree

import numpy as np

from limber.mechanics.materials.materials import RayleighDamping
from limber.results.exports.rigid_links import RodTree

_LEAST_MASS, _LEAST_INERTIA = 1e-9, 1e-12
_AXES = ("bend1", "bend2", "twist")
_WIDEST = 1.5
"""Limit of a joint [rad], far beyond the rotation of any link of a branch."""


def urdf_text(tree: RodTree, damping: RayleighDamping, name: str) -> str:
    """Return a URDF model of a branch; link ``link0`` is held by ``world``.

    URDF has no springs. Stiffness and the unstressed angle of each spring are written in
    ``<gazebo>`` (springStiffness, springReference) and again in ``<limber>``, for the user's own
    programs. A joint rotates about one axis, so there are two links without size between
    neighbours.

    Args:
        tree: From :func:`limber.results.exports.rigid_links.rod_tree`.
        damping: Only its stiffness-proportional part is used.
        name: Name of the model.
    """
    root = ElementTree.Element("robot", name=name)
    ElementTree.SubElement(root, "link", name="world")
    slack = tree.carried
    for link in range(tree.count):
        _add_link(root, tree, link)
        parent = int(tree.parent[link])
        if parent < 0:
            joint = ElementTree.SubElement(root, "joint", name="base", type="fixed")
            _connect(joint, "world", "link0", tree.joint[0])
            continue
        holder, origin = f"link{parent}", tree.joint[link] - tree.joint[parent]
        for number, label in enumerate(_AXES):
            held = f"link{link}" if number == 2 else f"link{link}_{label}"
            if number < 2:
                _add_inertial(ElementTree.SubElement(root, "link", name=held), 0.0, np.zeros(3),
                              np.zeros((3, 3)))
            _add_joint(root, f"joint{link}_{label}", holder, held, origin, tree.axes[link, number],
                       float(tree.stiffness[link, number]), float(slack[link, number]), damping)
            holder, origin = held, np.zeros(3)
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_link(root: ElementTree.Element, tree: RodTree, link: int) -> None:
    element = ElementTree.SubElement(root, "link", name=f"link{link}")
    _add_inertial(element, float(tree.mass[link]), tree.centre[link] - tree.joint[link],
                  tree.inertia[link])
    vector = tree.end[link] - tree.joint[link]
    length = float(np.linalg.norm(vector))
    if length < 1e-6:
        return
    for kind in ("visual", "collision"):
        part = ElementTree.SubElement(element, kind)
        # A cylinder's axis is z through its centre.
        roll_pitch_yaw = (0.0, float(np.arccos(np.clip(vector[2] / length, -1.0, 1.0))),
                          float(np.arctan2(vector[1], vector[0])))
        ElementTree.SubElement(part, "origin", xyz=_numbers(vector / 2),
                               rpy=_numbers(roll_pitch_yaw))
        shape = ElementTree.SubElement(part, "geometry")
        ElementTree.SubElement(shape, "cylinder", radius=f"{tree.radius[link]:.6g}",
                               length=f"{length:.9g}")


def _add_inertial(element: ElementTree.Element, mass: float, centre: np.ndarray,
                  inertia: np.ndarray) -> None:
    part = ElementTree.SubElement(element, "inertial")
    ElementTree.SubElement(part, "origin", xyz=_numbers(centre), rpy="0 0 0")
    ElementTree.SubElement(part, "mass", value=f"{max(mass, _LEAST_MASS):.9g}")
    i = inertia + _LEAST_INERTIA * np.eye(3)
    ElementTree.SubElement(part, "inertia", ixx=f"{i[0, 0]:.9g}", iyy=f"{i[1, 1]:.9g}",
                           izz=f"{i[2, 2]:.9g}", ixy=f"{i[0, 1]:.9g}", ixz=f"{i[0, 2]:.9g}",
                           iyz=f"{i[1, 2]:.9g}")


def _add_joint(root: ElementTree.Element, name: str, parent: str, child: str, origin: np.ndarray,
               axis: np.ndarray, stiffness: float, slack: float, damping: RayleighDamping) -> None:
    joint = ElementTree.SubElement(root, "joint", name=name, type="revolute")
    _connect(joint, parent, child, origin)
    ElementTree.SubElement(joint, "axis", xyz=_numbers(axis))
    ElementTree.SubElement(joint, "limit", lower=f"{-_WIDEST}", upper=f"{_WIDEST}",
                           effort="1000", velocity="1000")
    ElementTree.SubElement(joint, "dynamics", damping=f"{damping.stiffness * stiffness:.9g}",
                           friction="0")
    spring = {"spring_stiffness": f"{stiffness:.9g}", "spring_reference": f"{slack:.9g}"}
    ElementTree.SubElement(joint, "limber", spring)
    gazebo = ElementTree.SubElement(root, "gazebo", reference=name)
    ElementTree.SubElement(gazebo, "springStiffness").text = spring["spring_stiffness"]
    ElementTree.SubElement(gazebo, "springReference").text = spring["spring_reference"]


def _connect(joint: ElementTree.Element, parent: str, child: str, origin: np.ndarray) -> None:
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=_numbers(origin), rpy="0 0 0")


def _numbers(values: np.ndarray | tuple[float, ...]) -> str:
    return " ".join(f"{value:.9g}" for value in values)
