"""A cylinder model alone becomes a closed mesh: as our own branch, by another program's file."""

from pathlib import Path

import numpy as np
import pytest

from limber.cli.main import call
from limber.core.errors import InputError
from limber.geometry.bodies import body_format, mesh_model
from limber.geometry.io.skeletons import SKELETONS, read_skeleton
from limber.geometry.settings import MeshSurfaceSettings
from limber.stages.results.export import ExportSettings, export
from limber.stages.shape.mesh import mesh_surface
from limber.store import Branch
from limber.store.loading import load_branch, load_mesh, load_skeleton

EXAMPLE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


def test_a_model_of_another_program_becomes_the_branch_again(tmp_path):
    """TreeQSM's .mat: the same axes and wood, closed, and it hangs like any branch."""
    export(EXAMPLE, tmp_path / "tree.mat", ExportSettings())
    folder = tmp_path / "a.branch"
    assert call(["mesh", str(tmp_path / "tree.mat"), "-o", str(folder), "--no-upright",
                 "--young", "2e8", "--json"]) == 0
    known, made = Branch.open(EXAMPLE), Branch.open(folder, verify=True)
    told = made.manifest.stages["mesh"].result
    assert told["watertight"] and told["branch_count"] == load_skeleton(known).branch_count
    volume = float(load_mesh(known).volumes.sum())
    assert told["mesh_volume_m3"] == pytest.approx(volume, rel=0.05)
    one, other = load_skeleton(known), load_skeleton(made)
    assert other.length == pytest.approx(one.length, rel=1e-6)
    np.testing.assert_allclose(other.nodes[-1] - other.nodes[0], one.nodes[-1] - one.nodes[0],
                               atol=1e-6)
    assert (load_branch(made).model.young == 2e8).all()


def test_the_unit_of_a_model_is_asked_about(tmp_path):
    """A skeleton in millimetres that was read as metres; and one of 1.7e18 m."""
    for height, text in ((71.9, "71.9 m long.*--unit mm"), (1.7e18, "1.7e.18 m long")):
        path = tmp_path / "long.swc"
        path.write_text(f"1 0 0 0 0 5 -1\n2 0 0 0 {0.5 * height} 5 1\n3 0 0 0 {height} 5 2\n")
        with pytest.raises(InputError, match=text):
            mesh_model(path, MeshSurfaceSettings())


def test_a_model_without_a_root_is_refused(tmp_path):
    """The first cylinder hangs on itself."""
    text = (EXAMPLE / "skeleton.csv").read_text()
    assert "\n0,-1," in text
    (tmp_path / "tree.csv").write_text(text.replace("\n0,-1,", "\n0,0,", 1))
    with pytest.raises(InputError, match="has 0 cylinders without a parent"):
        read_skeleton(tmp_path / "tree.csv")


def is_model(path):
    return body_format(path) in SKELETONS.readers()


def test_what_is_a_model_and_what_is_refused(tmp_path):
    for name, columns in (("rtwig.csv", "rtwig"), ("simple.csv", "simpleforest")):
        export(EXAMPLE, tmp_path / name, ExportSettings(columns=columns))
        assert is_model(tmp_path / name) and read_skeleton(tmp_path / name).length > 0.1
    (tmp_path / "sections.csv").write_text("# drawn\nx,y,z,width,height\n0,0,0,1,1\n0,0,9,1,1\n")
    assert not is_model(tmp_path / "sections.csv") and not is_model(tmp_path / "a.stl")
    assert is_model(tmp_path / "tree.swc")
    (tmp_path / "thin.swc").write_text("1 0 0 0 0 0 -1\n2 0 0 0 1 0.1 1\n")
    for path, settings, told in (
            ("thin.swc", MeshSurfaceSettings(), "radius 0"),
            ("rtwig.csv", MeshSurfaceSettings(root=(0.0, 0.0, 0.0)), "defines its own root")):
        with pytest.raises(InputError, match=told):
            mesh_surface(tmp_path / path, tmp_path / "b.branch", settings)
    assert not (tmp_path / "b.branch").exists()
