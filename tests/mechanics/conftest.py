"""The branch that several tests of mechanics bend."""

import numpy as np
import pytest
from tests.subjects.meshes import box_mesh

from limber.store import Branch


@pytest.fixture
def folder(tmp_path):
    """A branch folder with the mesh of a short beam."""
    mesh = box_mesh((0.01, 0.01, 0.3), (1, 1, 20))
    count = mesh.tet_count
    mesh = mesh.with_data(
        cell_data={"young": np.full(count, 1e9), "poisson": np.full(count, 0.35),
                   "density": np.full(count, 900.0)},
        point_data={"grasp": (np.abs(mesh.nodes[:, 2] - 0.2) < 0.011).astype(np.int64)})
    branch = Branch.create(tmp_path / "beam.branch")
    with branch.stage("reconstruct") as stage:
        mesh.write(stage.path("mesh.vtu"))
    return branch.folder
