"""Structured meshes, whose volume is exact."""

from itertools import permutations, product

import numpy as np

from limber.geometry.tets.tet_mesh import TetMesh


def box_mesh(size=(0.01, 0.01, 0.03), counts=(2, 2, 3), quadratic=True) -> TetMesh:
    """A box centred on the z axis from z = 0, each cell split into six tetrahedra (Kuhn)."""
    axes = [np.linspace(-s / 2, s / 2, n + 1) for s, n in zip(size[:2], counts[:2], strict=True)]
    axes.append(np.linspace(0, size[2], counts[2] + 1))
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    shape = [n + 1 for n in counts]
    tets = []
    for cell in product(*(range(n) for n in counts)):
        for turn in permutations(range(3)):
            corner = list(cell)
            tet = [np.ravel_multi_index(corner, shape)]
            for axis in turn:
                corner[axis] += 1
                tet.append(np.ravel_multi_index(corner, shape))
            tets.append(tet)
    mesh = TetMesh(nodes, np.array(tets)).oriented()
    mesh = mesh.quadratic() if quadratic else mesh
    return mesh.with_data(point_data={"fixed": (mesh.nodes[:, 2] < 1e-9).astype(np.int64)})


def round_mesh(radius_base, radius_tip, length, rings, layers, quadratic=True) -> TetMesh:
    """A round, linearly tapered bar along z: a box whose square section is mapped to a disc."""
    mesh = box_mesh((2.0, 2.0, length), (rings, rings, layers), quadratic=False)
    square = mesh.nodes[:, :2]
    largest = np.abs(square).max(axis=1)
    norm = np.maximum(np.linalg.norm(square, axis=1), 1e-12)
    radius = radius_base + (radius_tip - radius_base) * mesh.nodes[:, 2] / length
    nodes = mesh.nodes.copy()
    nodes[:, :2] = square * (largest / norm * radius)[:, None]
    mesh = TetMesh(nodes, mesh.tets).oriented()
    mesh = mesh.quadratic() if quadratic else mesh
    return mesh.with_data(point_data={"fixed": (mesh.nodes[:, 2] < 1e-9).astype(np.int64)})
