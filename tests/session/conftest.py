"""What tests of the session share: a small branch folder."""

from pathlib import Path

import pytest

from limber.geometry.tets.tree_sweep import straight_beam
from limber.store import Branch


@pytest.fixture(scope="module")
def branch_folder(tmp_path_factory) -> Path:
    """A branch folder with a beam of 20 cm."""
    folder = tmp_path_factory.mktemp("session") / "beam.branch"
    mesh = straight_beam(0.2, 0.004, 0.003, slice_count=10, young=1e8, grasp_fraction=0.7)
    branch = Branch.create(folder)
    with branch.stage("mesh") as stage:
        mesh.write(stage.path("mesh.vtu"))
    return folder
