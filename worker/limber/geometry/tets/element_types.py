"""Kinds of tetrahedra by their number of nodes: built-in and external.

An element is a description: shape functions, quadrature, and where its nodes are. An external one
is known to a program that calls :func:`register_element`; models, solvers and files then take
meshes of it. The kernels have loops of their own for 4 and 10 nodes and a general one for others.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from limber.core.errors import InputError

EDGES = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
"""Corners of the six edges of a tetrahedron, in VTK's order of the mid-side nodes."""


@dataclass(frozen=True)
class Quadrature:
    """Barycentric points [q, 4] and weights [q] that sum to 1."""

    points: np.ndarray
    weights: np.ndarray


class ElementType(Protocol):
    """What a tetrahedron must state; its first four nodes are the corners.

    Attributes:
        name: Shown in messages.
        node_count: Nodes of one tetrahedron; it identifies the element of a mesh.
        cell_type: Name of the cell in VTU files as meshio has it; empty if VTK has none.
        parents: For each node after the corners, the corners whose mean it is on a straight side.
        mirrored: Order of the nodes that turns a tetrahedron inside out.
    """

    name: str
    node_count: int
    cell_type: str
    parents: tuple[tuple[int, ...], ...]
    mirrored: tuple[int, ...]

    def shape_functions(self, barycentric: np.ndarray) -> np.ndarray:
        """Return the shape functions at barycentric points [q, 4], shape [q, node_count]."""

    def shape_gradients(self, barycentric: np.ndarray) -> np.ndarray:
        """Return their derivatives to the four coordinates, as if independent, shape [q, 4, n]."""

    def stiffness_rule(self, is_curved: bool) -> Quadrature:
        """Return the rule for forces and stiffness."""

    def mass_rule(self) -> Quadrature:
        """Return the rule for the products of two shape functions."""


def quadrature(degree: int) -> Quadrature:
    """Return a rule on the tetrahedron that integrates polynomials of ``degree`` (1 to 5) exactly.

    Degree 4 and 5 are Keast's and Walkington's rules (11 and 14 points).
    """
    if degree <= 1:
        return Quadrature(np.full((1, 4), 0.25), np.ones(1))
    if degree == 2:
        a, b = 0.5854101966249685, 0.1381966011250105
        return Quadrature(np.full((4, 4), b) + (a - b) * np.eye(4), np.full(4, 0.25))
    first, second = 0.31088591926330060980, 0.092735250310891226402
    edge = 0.045503704125649649492
    points = [np.full((4, 4), a) + (1 - 4 * a) * np.eye(4) for a in (first, second)]
    pairs = np.full((6, 4), edge)
    for row, (i, j) in enumerate([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]):
        pairs[row, [i, j]] = 0.5 - edge
    weights = np.repeat([0.11268792571801585080, 0.073493043116361949544,
                         0.042546020777081466438], [4, 4, 6])
    return Quadrature(np.vstack([*points, pairs]), weights)


class Linear:
    """Four nodes, constant strain."""

    name, node_count, cell_type = "linear", 4, "tetra"
    parents: tuple[tuple[int, ...], ...] = ()
    mirrored: tuple[int, ...] = (0, 2, 1, 3)

    def shape_functions(self, barycentric: np.ndarray) -> np.ndarray:
        return barycentric.copy()

    def shape_gradients(self, barycentric: np.ndarray) -> np.ndarray:
        return np.repeat(np.eye(4)[None], len(barycentric), axis=0)

    def stiffness_rule(self, is_curved: bool) -> Quadrature:
        return quadrature(1)

    def mass_rule(self) -> Quadrature:
        return quadrature(5)


class Quadratic:
    """Ten nodes: corners and the middles of the edges, in VTK's order."""

    name, node_count, cell_type = "quadratic", 10, "tetra10"
    parents: tuple[tuple[int, ...], ...] = tuple((int(a), int(b)) for a, b in EDGES)
    mirrored: tuple[int, ...] = (0, 2, 1, 3, 6, 5, 4, 7, 9, 8)

    def shape_functions(self, barycentric: np.ndarray) -> np.ndarray:
        corner = barycentric * (2 * barycentric - 1)
        return np.hstack([corner, 4 * barycentric[:, EDGES[:, 0]] * barycentric[:, EDGES[:, 1]]])

    def shape_gradients(self, barycentric: np.ndarray) -> np.ndarray:
        gradients = np.zeros((len(barycentric), 4, 10))
        for k in range(4):
            gradients[:, k, k] = 4 * barycentric[:, k] - 1
        for number, (i, j) in enumerate(EDGES):
            gradients[:, i, 4 + number] = 4 * barycentric[:, j]
            gradients[:, j, 4 + number] = 4 * barycentric[:, i]
        return gradients

    def stiffness_rule(self, is_curved: bool) -> Quadrature:
        # Four points integrate the linear stiffness of a straight-sided element exactly, and are
        # used for StVK's energy consistently; on curved sides the gradients are not polynomial.
        return quadrature(5 if is_curved else 2)

    def mass_rule(self) -> Quadrature:
        return quadrature(5)


_BUILT_IN: tuple[ElementType, ...] = (Linear(), Quadratic())
_elements: dict[int, ElementType] = {element.node_count: element for element in _BUILT_IN}


def register_element(element: ElementType) -> ElementType:
    """Register an element under its number of nodes, replacing an earlier external one; return it.

    Raises:
        InputError: the number of nodes is a built-in element's or does not agree with ``parents``,
            or the shape functions are not 1 at their own node, 0 at the others, and 1 in sum.
    """
    count = element.node_count
    if count in {built_in.node_count for built_in in _BUILT_IN} or (
            count != 4 + len(element.parents)) or sorted(element.mirrored) != list(range(count)):
        raise InputError(f"The element {element.name!r} has {count} nodes.",
                         "The number identifies an element: it must differ from 4 and 10, and be "
                         "that of the corners, the other nodes and the mirrored order.",
                         "Correct node_count, parents or mirrored.")
    at_nodes = np.vstack([np.eye(4), between_corners(element, np.eye(4)[None])[0]])
    inside = np.array([[0.1, 0.2, 0.3, 0.4]])
    if not (np.allclose(element.shape_functions(at_nodes), np.eye(count), atol=1e-9)
            and np.allclose(element.shape_functions(inside).sum(axis=1), 1.0)):
        raise InputError(f"The shape functions of the element {element.name!r} are inconsistent.",
                         "Each must be 1 at its own node and 0 at the others, and all must sum to "
                         "1 everywhere.", "Correct shape_functions or the order of the nodes.")
    _elements[count] = element
    return element


def element_with(node_count: int) -> ElementType:
    """Return the element with that many nodes; InputError if there is none."""
    if node_count not in _elements:
        known = ", ".join(f"{element.name} ({count})" for count, element in _elements.items())
        raise InputError(f"The tetrahedra have {node_count} nodes.", f"Known elements: {known}.",
                         "Make a mesh of one of them, or register the element.")
    return _elements[node_count]


def is_known(node_count: int) -> bool:
    return node_count in _elements


def elements_by_cell_type() -> dict[str, ElementType]:
    """Return the elements that VTU files can hold, by meshio's name of the cell."""
    return {element.cell_type: element for element in _elements.values() if element.cell_type}


def between_corners(element: ElementType, corners: np.ndarray) -> np.ndarray:
    """Return the values of the nodes after the corners where a field is linear between those, whose
    values are ``corners`` [tet_count, 4, ...]."""
    found = [corners[:, list(parents)].mean(axis=1) for parents in element.parents]
    return np.stack(found, axis=1) if found else corners[:, :0]
