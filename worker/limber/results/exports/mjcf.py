"""MuJoCo's MJCF: rigid links on hinges with springs, hanging as the branch was scanned."""

from collections.abc import Mapping
from xml.etree import ElementTree

import numpy as np

from limber.mechanics.materials.materials import RayleighDamping
from limber.results.exports.rigid_links import RodTree

_TIMESTEP = 1e-3


def mjcf_text(tree: RodTree, damping: RayleighDamping, name: str,
              sites: Mapping[str, tuple[float, float, float]]) -> str:
    """Return an MJCF model that is at rest in its scanned shape.

    Each link except the fixed one has three hinges (two for bending, one for torsion). Of Rayleigh
    damping, MJCF supports the stiffness-proportional part but not the mass-proportional part.

    Args:
        tree: From :func:`limber.results.exports.rigid_links.rod_tree`.
        damping: Identified or assumed damping.
        name: Name of the model.
        sites: Positions on the branch [m] to follow, by name.
    """
    root = ElementTree.Element("mujoco", model=name)
    root.append(ElementTree.Comment(
        f" Limber: m, kg, s. Damping: {damping.stiffness:.6g} s times the stiffness. The part of "
        f"{damping.mass:.6g} 1/s times the mass is omitted, because MJCF cannot express it. "))
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    ElementTree.SubElement(root, "option", timestep=f"{_TIMESTEP:g}", integrator="implicitfast",
                           gravity=_numbers(tree.gravity))
    default = ElementTree.SubElement(root, "default")
    # The links of a branch do not collide with each other.
    ElementTree.SubElement(default, "geom", contype="0", conaffinity="1", mass="0",
                           rgba="0.45 0.33 0.22 1")
    world = ElementTree.SubElement(root, "worldbody")
    bodies: dict[int, ElementTree.Element] = {}
    slack = tree.carried
    for link in range(tree.count):
        parent = int(tree.parent[link])
        holder = world if parent < 0 else bodies[parent]
        origin = tree.joint[link] - (tree.joint[parent] if parent >= 0 else 0.0)
        body = ElementTree.SubElement(holder, "body", name=f"link{link}", pos=_numbers(origin))
        bodies[link] = body
        if parent >= 0:
            for axis in range(3):
                stiffness = float(tree.stiffness[link, axis])
                ElementTree.SubElement(
                    body, "joint", name=f"link{link}_{'bend1 bend2 twist'.split()[axis]}",
                    type="hinge", axis=_numbers(tree.axes[link, axis]),
                    stiffness=f"{stiffness:.9g}", springref=f"{slack[link, axis]:.9g}",
                    damping=f"{damping.stiffness * stiffness:.9g}")
        _add_inertial(body, tree, link)
        vector = tree.end[link] - tree.joint[link]
        if np.linalg.norm(vector) > 1e-6:
            ElementTree.SubElement(body, "geom", type="capsule", size=f"{tree.radius[link]:.6g}",
                                   fromto=f"0 0 0 {_numbers(vector)}")
    for label, point in sites.items():
        link = tree.link_at(point)
        ElementTree.SubElement(bodies[link], "site", name=label, size="0.004",
                               pos=_numbers(np.asarray(point) - tree.joint[link]))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_inertial(body: ElementTree.Element, tree: RodTree, link: int) -> None:
    inertia = tree.inertia[link]
    # MuJoCo does not accept a body whose mass rounds to zero.
    floor = 1e-12 * np.eye(3)
    i = inertia + floor
    ElementTree.SubElement(
        body, "inertial", mass=f"{max(tree.mass[link], 1e-9):.9g}",
        pos=_numbers(tree.centre[link] - tree.joint[link]),
        fullinertia=_numbers((i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2])))


def _numbers(values: np.ndarray | tuple[float, ...]) -> str:
    return " ".join(f"{value:.9g}" for value in values)
